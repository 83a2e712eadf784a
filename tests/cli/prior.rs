//! Reconstructions from two views with a prior tree, through the program.

use crate::program::program;
use serde_json::Value;
use std::path::{Path, PathBuf};
use std::sync::OnceLock;
use tempfile::TempDir;

/// Size of a heart relative to that of the default phantom.
const HEART: f64 = 2.7;

fn text(path: &Path) -> &str {
    path.to_str().unwrap()
}

#[track_caller]
fn ok(args: &[&str]) -> String {
    let out = program().args(args).output().unwrap();
    assert!(out.status.success(), "{args:?}: {}", String::from_utf8_lossy(&out.stderr));
    String::from_utf8(out.stdout).unwrap()
}

/// Reads a tree, changes its points at rest (RAS, mm) and writes it.
fn changed(from: &Path, to: &Path, whole_beat: bool, radius: f64, change: impl Fn([f64; 3]) -> [f64; 3]) {
    let mut tree: Value = serde_json::from_slice(&std::fs::read(from).unwrap()).unwrap();
    if !whole_beat {
        tree["points_mm"].as_array_mut().unwrap().truncate(1);
    }
    for point in tree["points_mm"].as_array_mut().unwrap().iter_mut().flat_map(|shape| shape.as_array_mut().unwrap()) {
        let at: [f64; 3] = serde_json::from_value(point.clone()).unwrap();
        *point = serde_json::to_value(change(at)).unwrap();
    }
    for value in tree["radius_mm"].as_array_mut().unwrap() {
        *value = (radius * value.as_f64().unwrap()).into();
    }
    std::fs::write(to, tree.to_string()).unwrap();
}

struct Data {
    directory: TempDir,
    /// Dataset of two views with the true vessels.
    data: PathBuf,
    /// True tree.
    tree: PathBuf,
}

/// Two views of a beating tree at the scale of a heart, made once.
fn data() -> &'static Data {
    static DATA: OnceLock<Data> = OnceLock::new();
    DATA.get_or_init(|| {
        let directory = tempfile::tempdir().unwrap();
        let at = |name: &str| directory.path().join(name);
        ok(&["phantom", text(&at("small")), "--size", "16", "--phases", "6", "--volumes-every", "6"]);
        let (small, tree, data) = (at("small/volumes/tree.json"), at("tree.json"), at("data"));
        changed(&small, &tree, true, HEART, |p| p.map(|v| HEART * v));
        let views =
            ["--angles=-30,30;60,-30", "--test-angles=-5,40", "--phases", "6", "--volumes-every", "3", "--size", "80"];
        ok(&[&["phantom", text(&data), "--tree", text(&tree), "--centre"], &views[..]].concat());
        Data { tree: data.join("volumes/tree.json"), directory, data }
    })
}

/// Trains up to an iteration with further arguments; returns its notes.
fn notes(run: &Path, more: &[&str]) -> String {
    let said = ok(&[&["train", text(&data().data), "-o", text(run), "--no-eval", "--json"], more].concat());
    let started = said.lines().find(|line| line.contains("\"started\"")).unwrap();
    serde_json::from_str::<Value>(started).unwrap()["notes"].to_string()
}

/// Settings for runs of which only the notes are read: those are made from the calibrated views, before any fit.
const ONE_FIT: [&str; 4] = ["--set", "calibrate.adjust=off", "--set", "gaussians.fits=1"];

/// Share of the true centreline that a run has found.
fn found(run: &Path) -> f64 {
    let scores: Value = serde_json::from_str(&ok(&["eval", text(run), "--json"])).unwrap();
    scores["volume"]["mean"]["true_centreline_found"].as_f64().unwrap()
}

#[test]
fn a_displaced_prior_resolves_the_depth_of_two_views() {
    let Data { directory, tree, .. } = data();
    let at = |name: &str| directory.path().join(name);
    // What a CT of another day states: displaced, and slightly larger.
    let prior = at("prior.json");
    changed(tree, &prior, false, 1.0, |[r, a, s]| [1.03 * r + 4.0, 1.03 * a - 3.0, 1.03 * s + 5.0]);
    let alone = notes(&at("without"), &["--stop-at", "130"]);
    assert!(!alone.contains("prior") && alone.contains("the mean of 5 fits"), "{alone}");
    let said = notes(&at("with"), &["--stop-at", "130", "--prior", text(&prior)]);
    assert!(said.contains("the prior's vessels, moved by"), "{said}");
    let [without, with] = [found(&at("without")), found(&at("with"))];
    println!("found: {without} without a prior, {with} with one");
    assert!(with > 0.68 && with > without + 0.1, "{without} without a prior, {with} with one");
    agreement_of_fits_is_stated(&at("without"));
}

/// Each point of a tree from two views has the share of the other fits that have a vessel there.
fn agreement_of_fits_is_stated(run: &Path) {
    let file = run.join("doubt.json");
    let out = program().args(["tree", text(run), "--phase", "0", "-o", text(&file)]).output().unwrap();
    let said = String::from_utf8_lossy(&out.stderr);
    assert!(out.status.success() && said.contains("less than 75 % of the other fits have"), "{said}");
    let tree: Value = serde_json::from_slice(&std::fs::read(&file).unwrap()).unwrap();
    let branches = tree["phases"][0]["branches"].as_array().unwrap();
    let numbers = |value: &Value| -> Vec<f64> { serde_json::from_value(value.clone()).unwrap() };
    let shares: Vec<Vec<f64>> = branches.iter().map(|branch| numbers(&branch["agreement"])).collect();
    for (branch, shares) in branches.iter().zip(&shares) {
        assert_eq!(shares.len(), branch["points_mm"].as_array().unwrap().len());
    }
    let all: Vec<f64> = shares.concat();
    assert!(all.iter().all(|share| (0.0..=1.0).contains(share)), "{all:?}");
    let agreed = all.iter().filter(|share| **share > 0.9).count();
    assert!(agreed > 0 && agreed < all.len(), "some places are doubtful, others are not: {all:?}");
}

#[test]
fn a_run_keeps_its_prior_until_it_starts_over() {
    let Data { directory, tree, .. } = data();
    let run = directory.path().join("kept");
    let short = [&["--set", "gaussians.iterations=12", "--set", "train.iterations=30"], &ONE_FIT[..]].concat();
    let first = notes(&run, &[&["--stop-at", "6", "--prior", text(tree)], &short[..]].concat());
    let resumed = notes(&run, &["--resume"]);
    for said in [first, resumed] {
        assert!(said.contains("the prior's vessels, moved by"), "{said}");
    }
    let over = notes(&run, &[&["--force", "--stop-at", "6"], &short[..]].concat());
    assert!(!over.contains("prior"), "{over}");
}

#[test]
fn the_views_have_the_last_word() {
    let Data { directory, tree, .. } = data();
    let (run, other) = (directory.path().join("contrary"), directory.path().join("other.json"));
    // A straight line of 300 mm is not this heart.
    let far = |[r, a, s]: [f64; 3]| [40.0 * (r + a + s), 0.0, 0.0];
    changed(tree, &other, false, 1.0, far);
    let said = notes(&run, &[&["--stop-at", "6", "--prior", text(&other)], &ONE_FIT[..]].concat());
    assert!(said.contains("so that the prior is not used"), "{said}");
}

#[test]
fn a_prior_that_cannot_be_used_is_refused() {
    let Data { directory, data, tree } = data();
    let (run, broken) = (directory.path().join("refused"), directory.path().join("broken.json"));
    std::fs::write(&broken, "{}").unwrap();
    for (arguments, parts) in [
        (vec!["--prior", text(tree), "--preset", "paper"], ["--prior", "`fast` only", "`paper`"]),
        (vec!["--prior", text(&broken)], ["broken.json", "branches", ""]),
        (vec!["--prior", "no-such-file.nrrd"], ["no-such-file.nrrd", "", ""]),
    ] {
        let out = program().args([&["train", text(data), "-o", text(&run)], &arguments[..]].concat()).output().unwrap();
        let said = String::from_utf8_lossy(&out.stderr);
        assert!(!out.status.success() && parts.iter().all(|part| said.contains(part)), "{arguments:?}: {said}");
        assert!(!run.exists(), "nothing is written before the prior is known to be right");
    }
}
