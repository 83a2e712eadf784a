//! Runs with networks (the presets of NeRF-CA and NerT-CA), through the program.

use crate::program::program;
use serde_json::Value;
use std::path::Path;

/// Output of the program, with validation; it must succeed.
fn ok(arguments: &[&str]) -> String {
    let output = program().arg("--validate").args(arguments).output().unwrap();
    assert!(output.status.success(), "{arguments:?}: {}", String::from_utf8_lossy(&output.stderr));
    String::from_utf8(output.stdout).unwrap()
}

fn text(path: &Path) -> &str {
    path.to_str().unwrap()
}

#[test]
fn the_program_trains_resumes_scores_draws_exports_and_times_them() {
    const TINY: &[&str] = &[
        "--preset=nerf-ca",
        "--set=train.rays=32",
        "--set=train.iterations=12",
        "--set=train.checkpoint_every=6",
        "--set=train.validate_every=0",
        "--set=march.dynamic_samples=24",
        "--set=march.render_samples=24",
        "--set=dynamic.layers=2",
        "--set=dynamic.width=16",
    ];
    let directory = tempfile::tempdir().unwrap();
    let at = |name: &str| directory.path().join(name);
    let (data, run, whole) = (at("data"), at("run"), at("whole"));
    ok(&["phantom", text(&data), "--size", "24", "--phases", "3"]);
    let said = ok(&[&["train", text(&data), "-o", text(&whole), "--json", "--no-eval"], TINY].concat());
    assert!(said.contains("whole rays") && said.contains("favour_static"), "{said}");
    ok(&[&["train", text(&data), "-o", text(&run), "--stop-at", "6", "--no-eval"], TINY].concat());
    let scored = ok(&["train", text(&data), "-o", text(&run), "--resume"]);
    assert!(scored.contains("Dice"), "{scored}");
    let tensors = |run: &Path| std::fs::read(run.join("checkpoint-0000012.safetensors")).unwrap();
    assert!(tensors(&run) == tensors(&whole), "a run that was stopped and resumed differs");
    ok(&["eval", text(&run)]);
    for (name, what) in [
        ("total.npy", &["--component", "total"][..]),
        ("static.npy", &["--component", "static"]),
        ("mip.png", &["--component", "dynamic", "--projection", "mip", "--phase", "1.5"]),
    ] {
        ok(&[&["render", text(&run), "--primary", "40", "-o", text(&at(name))], what].concat());
    }
    let floats = |name: &str| -> Vec<f32> {
        let bytes = std::fs::read(at(name)).unwrap();
        bytes[bytes.len() - 4 * 24 * 24..].chunks(4).map(|b| f32::from_le_bytes(b.try_into().unwrap())).collect()
    };
    let (still, total) = (floats("static.npy"), floats("total.npy"));
    let mean = |v: &[f32]| v.iter().sum::<f32>() / v.len() as f32;
    assert!(mean(&still) > 0.0 && mean(&total) > mean(&still));
    ok(&["export", text(&run), "--spacing", "20", "-o", text(&at("volume.nrrd"))]);
    assert!(ok(&["info", text(&run)]).contains("nerf-ca"));
    let listed: Value = serde_json::from_str(&ok(&["kernels", "--preset", "nerf-ca", "--json"])).unwrap();
    let listed = listed["kernels"].as_array().unwrap();
    assert!(
        ["loss_samples", "march_fwd_samples"]
            .iter()
            .all(|name| { listed.iter().any(|kernel| kernel["kernel"].as_str().unwrap().starts_with(name)) })
    );
    let timed =
        ok(&[&["bench", text(&data), "--warm-up", "0", "--iterations", "1", "--repeats", "1", "--kernels"], TINY]
            .concat());
    assert!(timed.contains("loss_samples") && timed.contains("network passes only"), "{timed}");
}

/// Warnings of NerT-CA's presets: the published box, and a dynamic field that vanishes at the delay, as normalised losses make it.
#[test]
fn runs_without_vessels_are_told_when_they_begin_and_when_the_field_vanishes() {
    const SMALL: &[&str] = &[
        "--set=train.rays=128",
        "--set=train.iterations=60",
        "--set=train.validate_every=40",
        "--set=march.dynamic_samples=32",
        "--set=march.static_samples=32",
        "--set=dynamic.width=32",
        "--set=dynamic.delay=20",
        "--no-eval",
    ];
    let directory = tempfile::tempdir().unwrap();
    let data = directory.path().join("data");
    ok(&["phantom", text(&data), "--size", "32", "--phases", "4", "--views", "4", "--no-volumes"]);
    let said = |name: &str, more: &[&str]| {
        let run = directory.path().join(name);
        let out = program().args(["train", text(&data), "-o", text(&run)]).args(SMALL).args(more).output().unwrap();
        assert!(out.status.success(), "{out:?}");
        String::from_utf8(out.stderr).unwrap()
    };
    let vanished = said("vanishes", &["--preset", "public-code", "--set", "loss.normalise=true"]);
    let wide = "warning: the box of the dynamic field reaches 100 mm each way, but the views see 25 mm together";
    assert!(vanished.contains(wide), "{vanished}");
    let zero = "warning: after 40 iterations the dynamic field is zero everywhere";
    assert_eq!(vanished.matches(zero).count(), 1, "{vanished}");
    assert!(!vanished.contains("after 60 iterations the dynamic"), "the warning comes once: {vanished}");
    let lives = said("lives", &["--preset", "nert-ca"]);
    assert!(!lives.contains("warning: the box") && !lives.contains("is zero everywhere"), "{lives}");
}
