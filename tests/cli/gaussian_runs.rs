//! Runs with a dynamic field of Gaussians, through the program: their page and their measurements.

use crate::program::program;
use serde_json::{Value, json};
use std::path::Path;
use std::sync::OnceLock;

const PHASES: u64 = 4;
const VIEWS: u64 = 3;
const GAUSSIAN_ITERATIONS: u32 = 12;
const STILL_ITERATIONS: u32 = 18;

/// A short run of a tree.
const SHORT: &[&str] = &[
    "--set",
    "gaussians.form=tree",
    "--set",
    "gaussians.iterations=12",
    "--set",
    "gaussians.count=60",
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

/// A phantom, created once.
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

/// Calls of the short run to its device, with its scores: submits depend on the pace of the device, which is not looked at here. A call more
/// costs microseconds on a CPU, and tens of them on a GPU.
const MAX_RECORDINGS: u64 = 1_500;
const MAX_BUFFERS: u64 = 2_100;

#[test]
fn a_run_records_the_times_of_its_stages_and_its_calls_to_the_device() {
    let dir = tempfile::tempdir().unwrap();
    let run = dir.path().join("run");
    let args = [&["train", data(), "-o", run.to_str().unwrap(), "--preset", "fast", "--timings"], SHORT].concat();
    let said = String::from_utf8(program().args(args).output().unwrap().stderr).unwrap();
    let record = read(&run.join("run.json"));
    let stages: Vec<&str> =
        record["stages"].as_array().unwrap().iter().map(|time| time["stage"].as_str().unwrap()).collect();
    assert_eq!(stages, ["read", "device", "calibrate", "plan", "prepare", "iterate", "score", "tree", "report"]);
    assert!(stages.iter().all(|stage| said.contains(&format!("\n{stage} "))), "{said}");
    let call = |name: &str| record["calls"][name].as_u64().unwrap();
    println!("{}", record["calls"]);
    assert!(said.contains(&format!("{} submits", call("submits"))), "{said}");
    assert!(call("recordings") <= MAX_RECORDINGS && call("buffers") <= MAX_BUFFERS, "{}", record["calls"]);
}

#[test]
fn the_page_tells_of_gaussians_and_their_motion() {
    let dir = tempfile::tempdir().unwrap();
    let run = dir.path().join("run");
    ok(&[&["train", data(), "-o", run.to_str().unwrap(), "--preset", "fast"], SHORT].concat());
    let page = std::fs::read_to_string(run.join("report.html")).unwrap();
    let info: Value = serde_json::from_str(&ok(&["info", run.to_str().unwrap(), "--json"])).unwrap();
    let told = &info["gaussians"];
    assert!(page.contains(&format!("<td>{}, one deformable set", told["count"])), "their number is missing");
    for phase in 0..PHASES as usize {
        let of = |key: &str| told["displacement_from_phase_0"][phase][key].as_f64().unwrap();
        let row = format!("<td>{phase}</td><td>{:.2}</td><td>{:.2}</td>", of("mean_mm"), of("largest_mm"));
        assert!(page.contains(&row), "`{row}` is missing");
    }
    assert_eq!(page.matches("alt=\"hull in view").count() as u64, VIEWS);
    assert!(page.contains("Motion along a vessel is not observed"));
    assert!(
        !page.contains("<td>hull</td>") && !page.contains("No motion hull was used"),
        "there is no hull to speak of"
    );
}

fn median(timing: &Value) -> f64 {
    let mut ms: Vec<f64> = timing["ms"].as_array().unwrap().iter().map(|v| v.as_f64().unwrap()).collect();
    assert_eq!(ms.len(), 3);
    ms.sort_by(f64::total_cmp);
    ms[1]
}

fn read(file: &Path) -> Value {
    serde_json::from_slice(&std::fs::read(file).unwrap()).unwrap()
}

/// Three short repeats.
const TIMES: [&str; 6] = ["--warm-up", "0", "--iterations", "2", "--repeats", "3"];

#[test]
fn gaussians_are_measured_as_they_run() {
    let dir = tempfile::tempdir().unwrap();
    let (file, old) = (dir.path().join("bench.json"), dir.path().join("old.json"));
    let bench = [&["bench", data(), "--kernels", "--preset", "fast"], &TIMES[..], SHORT].concat();
    let said = ok(&[&bench[..], &["--json", file.to_str().unwrap()]].concat());
    for part in [
        "Gaussians, form deformable",
        "static field after them",
        "pairs of a Gaussian and a pixel",
        "of the f32 peak",
        "37:00",
    ] {
        assert!(said.contains(part), "`{part}` is missing: {said}");
    }
    assert!(!said.contains("with the network"), "nobody asks it: {said}");
    assert!(!said.contains("x as fast"), "it is another method than that of the 37 minutes: {said}");
    let report = read(&file);
    assert_eq!((&report["after"], &report["network_cost"]), (&Value::Null, &Value::Null));
    let gaussians = &report["gaussians"];
    let work = &gaussians["work"];
    assert_eq!(work["splats"].as_u64().unwrap(), gaussians["count"].as_u64().unwrap() * PHASES * VIEWS);
    let pairs = work["pairs"].as_u64().unwrap();
    assert!(pairs > work["splats"].as_u64().unwrap() / 2 && pairs < 24 * 24 * work["splats"].as_u64().unwrap());
    assert!((work["gflop"].as_f64().unwrap() - 52e-9 * pairs as f64).abs() < 1e-12);
    let still = STILL_ITERATIONS as f64 * median(&report["before"]);
    let whole = (f64::from(GAUSSIAN_ITERATIONS) * median(gaussians) + still) * 1e-3
        + gaussians["preparation_s"].as_f64().unwrap();
    assert!((report["whole_run_s"].as_f64().unwrap() - whole).abs() < 1e-9);
    assert_eq!((&gaussians["iterations"], &report["before"]["iterations"]), (&json!(2), &json!(2)));
    // Passes of both parts, and none of the network or of tracking.
    let passes = report["passes_ms"].as_object().unwrap();
    for name in [
        "deformable_project",
        "gaussian_splat",
        "gaussian_residual",
        "gaussian_moments",
        "deformable_grid_update",
        "adam",
    ] {
        // The variant depends on the device.
        assert!(passes.iter().any(|(pass, ms)| pass.starts_with(name) && ms.as_f64().unwrap() > 0.0), "{name}");
    }
    assert!(!passes.contains_key("deformable_guess") && !passes.contains_key("gaussian_update"));
    // A tree has two rounds over splats, each once per iteration.
    assert_eq!(report["passes_per_iteration"]["deformable_grid_update"], 1.0);
    assert_eq!(report["passes_per_iteration"].as_object().unwrap().len(), passes.len());
    // A report of a version without Gaussians.
    let mut older = report.clone();
    let fields = older.as_object_mut().unwrap();
    fields.remove("gaussians");
    fields.insert("after".into(), report["before"].clone());
    fields.insert("network_cost".into(), json!({ "forward": 1, "weights": 1, "inputs": 1 }));
    std::fs::write(&old, older.to_string()).unwrap();
    let said = ok(&[&bench[..], &["--compare", old.to_str().unwrap()]].concat());
    assert!(said.contains("whole run, extrapolated") && !said.contains("Gaussians, ms"), "{said}");
    let said = ok(&[&bench[..], &["--compare", file.to_str().unwrap()]].concat());
    assert!(said.contains("Gaussians, ms") && said.contains("without the network, ms"), "{said}");
}
