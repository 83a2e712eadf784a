//! Runs whose moving field is made of Gaussians, from outside: their page.
#![allow(missing_docs, clippy::unwrap_used, clippy::expect_used)]

#[path = "common/program.rs"]
mod program;

use program::program;
use serde_json::Value;
use std::sync::OnceLock;

const PHASES: u64 = 4;

/// A short run of a tree.
const SHORT: &[&str] = &[
    "--set",
    "gaussians.form=tree",
    "--set",
    "gaussians.iterations=12",
    "--set",
    "gaussians.grow_at=6",
    "--set",
    "gaussians.count=60",
    "--set",
    "tree.warm_iterations=20",
    "--set",
    "tree.track_iterations=5",
    "--set",
    "train.iterations=30",
    "--set",
    "train.rays=64",
    "--set",
    "train.validate_every=0",
    "--set",
    "march.render_samples=64",
    "--set",
    "train.chunk_samples=16384",
];

#[track_caller]
fn ok(args: &[&str]) -> String {
    let out = program().arg("--validate").args(args).output().unwrap();
    assert!(out.status.success(), "{args:?}: {}", String::from_utf8_lossy(&out.stderr));
    String::from_utf8(out.stdout).unwrap()
}

/// A phantom, made once.
fn data() -> &'static str {
    static DATA: OnceLock<(tempfile::TempDir, String)> = OnceLock::new();
    let (_, data) = DATA.get_or_init(|| {
        let dir = tempfile::tempdir().unwrap();
        let data = dir.path().join("data").to_str().unwrap().to_owned();
        ok(&["phantom", &data, "--size", "24", "--phases", "4", "--views", "3", "--no-volumes"]);
        (dir, data)
    });
    data
}

#[test]
fn the_page_tells_of_gaussians_and_their_motion() {
    let dir = tempfile::tempdir().unwrap();
    let run = dir.path().join("run");
    ok(&[&["train", data(), "-o", run.to_str().unwrap(), "--preset", "fast"], SHORT].concat());
    let page = std::fs::read_to_string(run.join("report.html")).unwrap();
    let info: Value = serde_json::from_str(&ok(&["info", run.to_str().unwrap(), "--json"])).unwrap();
    let told = &info["gaussians"];
    assert!(page.contains(&format!("<td>{}, one set that moves", told["count"])), "their number is missing");
    for phase in 0..PHASES as usize {
        let of = |key: &str| told["displacement_from_phase_0"][phase][key].as_f64().unwrap();
        let row = format!("<td>{phase}</td><td>{:.2}</td><td>{:.2}</td>", of("mean_mm"), of("largest_mm"));
        assert!(page.contains(&row), "`{row}` is missing");
    }
    assert!(page.contains("Motion along a vessel is not observed"));
    assert!(
        !page.contains("<td>hull</td>") && !page.contains("No motion hull was used"),
        "there is no hull to speak of"
    );
}
