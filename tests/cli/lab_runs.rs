//! Runs as a cath lab makes them, of a real tree in a real chest, through the program: `phantom --runs`, `import --gate-by-images`, `train`,
//! against the truth of the runs.

use crate::program::program;
use crate::shared;
use serde_json::{Value, json};
use std::path::Path;
use std::process::Output;

/// Beats per minute of the runs.
const RATES: [f64; 3] = [70.0, 82.0, 65.0];
/// Cardiac phases.
const PHASES: f64 = 10.0;
/// Minimum share of the way to the ends of the vessels that contrast agent has reached in a frame that is used.
const LEAST_FILLED: f64 = 0.6;
/// Minimum mean Dice of unseen views.
const LEAST_DICE: f64 = 0.5;

fn nertca(args: &[&str]) -> Output {
    let out = program().args(args).output().unwrap();
    assert!(out.status.success(), "{args:?}: {}", String::from_utf8_lossy(&out.stderr));
    out
}

fn read(file: &Path) -> Value {
    serde_json::from_slice(&std::fs::read(file).unwrap()).unwrap()
}

fn text(path: &Path) -> &str {
    path.to_str().unwrap()
}

/// Numbers after a phrase in the lines of some text, one for each line that has it.
fn numbers_after(text: &str, phrase: &str) -> Vec<f64> {
    let number = |line: &str| {
        let rest = &line[line.find(phrase)? + phrase.len()..];
        let end = rest.find(|c: char| !c.is_ascii_digit() && c != '.' && c != '-').unwrap_or(rest.len());
        rest[..end].parse().ok()
    };
    text.lines().filter_map(number).collect()
}

/// Frames of a view in a `truth.json`.
fn of_view(truth: &Value, view: usize) -> Vec<&Value> {
    let frames = truth["frames"].as_array().unwrap().iter();
    frames.filter(|frame| frame["view"].as_u64() == Some(view as u64)).collect()
}

/// Difference of two phases, from -5 to 5.
fn apart(a: f64, b: f64) -> f64 {
    (a - b + 0.5 * PHASES).rem_euclid(PHASES) - 0.5 * PHASES
}

/// Adds the unseen views of the true dataset to the imported one, at its phases.
fn add_unseen_views(imported: &Path, exact: &Path, begins: f64) {
    let mut manifest = read(&imported.join("dataset.json"));
    let unseen = read(&exact.join("dataset.json"));
    for frame in unseen["frames"].as_array().unwrap().iter().filter(|frame| frame["split"] == "validation") {
        let mut frame = frame.clone();
        frame["phase"] = json!((frame["phase"].as_f64().unwrap() - begins).rem_euclid(PHASES));
        for file in ["image", "mask"].map(|key| frame[key].as_str().unwrap()) {
            std::fs::create_dir_all(imported.join(file).parent().unwrap()).unwrap();
            std::fs::copy(exact.join(file), imported.join(file)).unwrap();
        }
        manifest["frames"].as_array_mut().unwrap().push(frame);
    }
    std::fs::write(imported.join("dataset.json"), manifest.to_string()).unwrap();
}

#[test]
#[ignore = "long: tools/test --all"]
fn runs_of_a_lab_become_a_tree() {
    let Some(anatomy) = shared::shared("anatomy") else { return };
    let directory = tempfile::tempdir().unwrap();
    let at = |name: &str| directory.path().join(name);
    let (exact, runs, data) = (at("exact"), at("runs"), at("data"));
    let (tree, thorax) = (anatomy.join("coronary_tree_hra.json"), anatomy.join("thorax_ct.nii.gz"));
    let rates = RATES.map(|rate| rate.to_string()).join(",");
    nertca(
        &[
            &["phantom", text(&exact), "--tree", text(&tree), "--background", text(&thorax), "--fov", "120"][..],
            &["--views", "3", "--size", "128", "--no-volumes", "--test-angles=-5,40", "--photons", "1e6"],
            &["--runs", text(&runs), "--panning", "6", "--breathing", "2", "--inflow", "0.4"],
            &["--heart-rate", &rates, "--geometry-error", "0.3,0"],
        ]
        .concat(),
    );
    let files: Vec<_> = (0..3).map(|view| runs.join(format!("view{view}.dcm"))).collect();
    let files: Vec<&str> = files.iter().map(|file| text(file)).collect();
    let import =
        [&["import", "dicom"], &files[..], &["--gate-by-images", "--keep-references", "-o", text(&data)]].concat();
    let said = String::from_utf8(nertca(&import).stderr).unwrap();
    let found: Vec<f64> = (0..3).flat_map(|view| numbers_after(&said, &format!("view{view}: "))).collect();
    for rate in RATES {
        let near = |found: &&f64| (**found / rate - 1.0).abs() < 0.03;
        assert!(found.iter().any(|found| near(&found)), "no {rate} beats per minute: {said}");
    }
    // The images are frames of one beat that is filled, and all runs show the same part of the beat at the same phase.
    let truth = read(&runs.join("truth.json"));
    let manifest = read(&data.join("dataset.json"));
    assert_eq!(manifest["vessels_alone"], true);
    nertca(&["check", text(&data)]);
    let references = read(&data.join("references.json"));
    let mut errors: Vec<(u64, f64)> = Vec::new();
    for image in references["images"].as_array().unwrap() {
        let view = image["run"].as_u64().unwrap();
        let number = image["frames"][0].as_u64().unwrap() as usize - 1;
        let taken = of_view(&truth, view as usize)[number];
        let filled = taken["filled_to"].as_f64().unwrap();
        assert!(filled >= LEAST_FILLED, "frame {number} of view {view} is filled to {filled}: {said}");
        let frames = manifest["frames"].as_array().unwrap();
        let stated = frames.iter().find(|frame| frame["image"] == image["image"]).unwrap();
        errors.push((view, apart(taken["beat_phase"].as_f64().unwrap(), stated["phase"].as_f64().unwrap())));
    }
    // The first run begins at any phase; the others agree with it.
    let mean = |of: &dyn Fn(u64) -> bool, begins: f64| {
        let of: Vec<f64> =
            errors.iter().filter(|(view, _)| of(*view)).map(|(_, error)| apart(*error, begins)).collect();
        assert!(of.len() >= 9, "{errors:?}");
        of.iter().sum::<f64>() / of.len() as f64
    };
    let begins = errors[0].1 + mean(&|view| view == 0, errors[0].1);
    for other in 1..3 {
        let off = mean(&|view| view == other, begins);
        assert!(off.abs() < 0.8, "run {other} is {off} phases apart: {said}");
    }
    add_unseen_views(&data, &exact, begins);
    nertca(&["train", text(&data), "-o", text(&at("run")), "--stop-at", "130"]);
    let dice = read(&at("run").join("report/evaluation.json"))["dice"]["dynamic"].as_f64().unwrap();
    assert!(dice > LEAST_DICE, "Dice {dice}: {said}");
}
