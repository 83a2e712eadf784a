//! Kernels as compiled by Mesa for GPUs that are not present, compared with the stored results: tests/golden/kernels, a
//! file per chip, which `NERTCA_BLESS=1` rewrites.

use crate::program::program;
use crate::root::root;
use nertca_vk_twins::inventory::{Compiled, differences};
use serde_json::{Value, json};
use std::path::PathBuf;
use std::process::{Command, Output};

/// Chips, and whether register spilling is forbidden: Intel's matrix kernels spill, because their compiler unrolls them.
const CHIPS: [(&str, bool); 7] = [
    ("nvidia:ga102", true),
    ("nvidia:ad102", true),
    ("nvidia:gh100", true),
    ("nvidia:gb202", true),
    ("amd:navi31", true),
    ("amd:gfx1201", true),
    ("intel:bmg", false),
];
const PRESETS: [&str; 6] = ["fast", "fast-mlp", "paper", "r2-gaussian", "x-gaussian", "sax-nerf"];

/// Runs the program for a chip.
fn on(chip: &str, arguments: &[&str]) -> Output {
    let plain = program();
    let mut command = Command::new(root().join("tools/null-gpu"));
    command.arg(chip).arg(plain.get_program()).args(arguments);
    plain.get_envs().for_each(|(key, value)| {
        command.env(key, value.unwrap_or_default());
    });
    command.output().unwrap()
}

/// Output of `kernels --json` for a preset on a chip.
fn listed(chip: &str, preset: &str) -> Value {
    let output = on(chip, &["kernels", "--json", "--preset", preset]);
    assert!(output.status.success(), "{chip} {preset}: {}", String::from_utf8_lossy(&output.stderr));
    serde_json::from_slice(&output.stdout).unwrap()
}

fn kernels(answer: &Value) -> Vec<Compiled> {
    serde_json::from_value(answer["kernels"].clone()).unwrap()
}

/// Writes the output of `kernels --json`, one kernel per line.
fn write(file: &PathBuf, answer: &Value, all: &[Compiled]) {
    let rows: Vec<String> = all.iter().map(|kernel| serde_json::to_string(kernel).unwrap()).collect();
    let head = |key: &str| serde_json::to_string(&answer[key]).unwrap();
    let text = format!(
        "{{\"device\": {}, \"driver\": {}, \"paths\": {}, \"preset\": {},\n\"kernels\": [\n{}\n]}}\n",
        head("device"),
        head("driver"),
        head("paths"),
        json!(PRESETS.join(", ")),
        rows.join(",\n")
    );
    std::fs::write(file, text).unwrap();
}

#[test]
#[ignore = "downloads Mesa's drivers: run by `tools/test --packages`"]
fn kernels_are_as_good_as_they_were() {
    let mut worse = Vec::new();
    for (chip, without_spills) in CHIPS {
        let answers = PRESETS.map(|preset| listed(chip, preset));
        let mut all: Vec<Compiled> = answers.iter().flat_map(kernels).collect();
        all.sort_by_key(|c| (c.kernel.clone(), c.lanes, c.constants.clone()));
        all.dedup();
        assert!(all.len() > 40, "{chip}: {} kernels", all.len());
        assert!(
            all.iter().all(|c| c.registers.is_some() && c.spills.is_some()),
            "{chip} tells of registers and spills"
        );
        let spilling = all.iter().filter(|c| without_spills && c.spills != Some(0.0));
        worse.extend(spilling.map(|c| format!("{chip}: {} spills", c.name())));
        let (_, name) = chip.split_once(':').unwrap();
        let file = root().join(format!("tests/golden/kernels/{name}.json"));
        if std::env::var_os("NERTCA_BLESS").is_some() {
            write(&file, &answers[0], &all);
        }
        let before: Value = serde_json::from_slice(&std::fs::read(&file).unwrap()).unwrap();
        let found = differences(&kernels(&before), &all);
        println!("{chip}, {} then, {} now", before["driver"], answers[0]["driver"]);
        found.other.iter().chain(&found.worse).for_each(|difference| println!("  {difference}"));
        worse.extend(found.worse.into_iter().map(|difference| format!("{chip}: {difference}")));
    }
    assert!(worse.is_empty(), "{}", worse.join("\n"));
}

#[test]
#[ignore = "downloads Mesa's drivers: run by `tools/test --packages`"]
fn the_self_test_fails_in_words_on_devices_that_compute_nothing() {
    for (chip, _) in CHIPS {
        let output = on(chip, &["selftest", "--json"]);
        let words = String::from_utf8_lossy(&output.stderr);
        assert_eq!(output.status.code(), Some(3), "{chip}: {words}");
        assert!(words.contains("comparisons failed on") && words.contains("gaussian_project"), "{chip}: {words}");
        let answer: Value = serde_json::from_slice(&output.stdout).unwrap();
        let rows = answer["rows"].as_array().unwrap();
        let passes = |row: &&Value| row["deviation"].as_f64().is_some_and(|d| d <= row["tolerance"].as_f64().unwrap());
        let passed: Vec<&Value> = rows.iter().filter(passes).map(|row| &row["stages"]).collect();
        assert!(answer["ok"] == Value::Bool(false) && rows.len() > 40 && passed.len() < 4, "{chip}: {passed:?}");
    }
}

#[test]
#[ignore = "downloads Mesa's drivers: run by `tools/test --packages`"]
fn training_fails_in_words_on_devices_that_compute_nothing() {
    const NO_DEVICE: i32 = 3;
    const DEVICE_LOST: i32 = 75;
    let home = tempfile::tempdir().unwrap();
    let data = home.path().join("data");
    let made = program().arg("phantom").arg(&data).args(["--size", "40", "--phases", "3"]).output().unwrap();
    assert!(made.status.success(), "{}", String::from_utf8_lossy(&made.stderr));
    let small = [
        "r2.voxels=24",
        "r2.tv_vol_size=8",
        "r2.n_points=200",
        "sax.window_num=1",
        "sax.window_size=4",
        "sax.n_rays=8",
        "sax.n_samples=16",
    ];
    for (chip, _) in CHIPS {
        for preset in [&PRESETS[..], &["nerf-ca"]].concat() {
            let run = home.path().join(format!("{}-{preset}", chip.replace(':', "-")));
            let of_preset = small.iter().filter(|s| preset.starts_with(s.split('.').next().unwrap_or_default()));
            let settings = of_preset.flat_map(|s| ["--set", s]);
            let mut arguments = vec!["train", data.to_str().unwrap(), "-o", run.to_str().unwrap(), "--preset", preset];
            arguments.extend(settings.chain(["--set", "train.iterations=20"]));
            let output = on(chip, &arguments);
            let words = String::from_utf8_lossy(&output.stderr);
            let fails = matches!(output.status.code(), Some(NO_DEVICE | DEVICE_LOST));
            assert!(fails && words.lines().any(|line| line.starts_with("nertca-vk: ")), "{chip} {preset}: {words}");
        }
    }
}
