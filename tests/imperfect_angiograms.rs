//! Angiograms as a cath lab makes them, through the program: each imperfection alone must cost little. docs/performance.md has the
//! full table, on real anatomy.
#![allow(missing_docs, clippy::unwrap_used, clippy::expect_used, reason = "tests")]

#[path = "common/program.rs"]
mod program;

use program::program;
use serde_json::Value;
use std::path::Path;

/// What is done to the angiograms of a phantom at 0.37 of a heart's size, and the most Dice it may cost.
const IMPERFECTIONS: [(&str, &[&str], f64); 5] = [
    ("views that disagree", &["--geometry-error", "0.5,0.7"], 0.08),
    ("breathing", &["--breathing", "1"], 0.08),
    ("noise", &["--photons", "3e7"], 0.08),
    ("contrast", &["--contrast-variation", "20"], 0.08),
    ("blades", &["--collimate", "0.1"], 0.08),
];

/// Mean Dice at unseen views.
fn dice(directory: &Path, imperfection: &[&str]) -> f64 {
    let [data, run] = ["data", "run"].map(|name| directory.join(name).to_str().unwrap().to_owned());
    let phantom = ["phantom", &data, "--size", "80", "--phases", "8", "--no-volumes"];
    for args in [[&phantom, imperfection].concat(), vec!["train", &data, "--out", &run]] {
        let out = program().args(&args).output().unwrap();
        assert!(out.status.success(), "{args:?}: {}", String::from_utf8_lossy(&out.stderr));
    }
    let report: Value =
        serde_json::from_slice(&std::fs::read(Path::new(&run).join("report/evaluation.json")).unwrap()).unwrap();
    report["dice"]["dynamic"].as_f64().unwrap()
}

#[test]
fn imperfect_angiograms_cost_little() {
    let measured = |imperfection: &[&str]| dice(tempfile::tempdir().unwrap().path(), imperfection);
    let perfect = measured(&[]);
    println!("perfect: Dice {perfect:.3}");
    assert!(perfect > 0.85, "{perfect}");
    for (name, imperfection, most) in IMPERFECTIONS {
        let dice = measured(imperfection);
        println!("{name}: Dice {dice:.3}, {:.3} less", perfect - dice);
        assert!(perfect - dice < most, "{name} ({imperfection:?}): {dice} where perfect angiograms give {perfect}");
    }
}
