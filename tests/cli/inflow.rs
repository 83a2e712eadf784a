//! Contrast that arrives during the acquisition: phase 0 shows nothing, and the reconstruction rests at a later phase.

use crate::said::{run, text};
use nertca_vk::config::{Config, Preset};
use nertca_vk::methods::dynamic_gaussians::data::GaussianData;
use nertca_vk::plan::Plan;
use nertca_vk::scan::dataset::Dataset;
use serde_json::Value;
use std::path::{Path, PathBuf};

/// Number of phases of one second, in which contrast reaches the ends of the vessels after 0.4 s: from phase 4 they are
/// full.
const PHASES: usize = 10;
const FULL_FROM: usize = 4;

/// A phantom of 64 x 64 pixels.
fn phantom(directory: &Path, extra: &[&str]) -> PathBuf {
    let data = directory.join("data");
    run(&[&["phantom", text(&data), "--size", "64", "--no-volumes"], extra].concat(), true);
    data
}

/// Phase at which Gaussians of a form rest, and the notes of the plan.
fn rest_phase(data: &Path, form: &str) -> (usize, Vec<String>) {
    let config = Config::load(Some(Preset::Fast), None, &[format!("gaussians.form={form}")]).unwrap();
    let plan = Plan::new(&config, &Dataset::open(data).unwrap()).unwrap();
    (plan.data::<GaussianData>().unwrap().targets.rest_phase, plan.notes)
}

#[test]
fn a_tree_rests_where_vessels_are_full() {
    let directory = tempfile::tempdir().unwrap();
    let data = phantom(directory.path(), &["--inflow", "0.4"]);
    let (rest, notes) = rest_phase(&data, "tree");
    assert!((FULL_FROM..PHASES).contains(&rest), "rests at phase {rest}");
    assert!(notes.iter().any(|note| note.contains(&format!("from phase {rest},"))), "{notes:?}");

    let finished = directory.path().join("run");
    let tree = ["--preset", "fast", "--set", "gaussians.form=tree"];
    let said = run(&[&["train", text(&data), "-o", text(&finished)], &tree[..]].concat(), true);
    assert!(said.contains(&format!("from phase {rest},")), "{said}");
    let evaluation: Value =
        serde_json::from_slice(&std::fs::read(finished.join("report/evaluation.json")).unwrap()).unwrap();
    let images = evaluation["images"].as_array().unwrap();
    let mean_dice = |wanted: &dyn Fn(usize) -> bool| {
        let dice: Vec<f64> = images
            .iter()
            .filter(|image| wanted(image["phase"].as_u64().unwrap() as usize))
            .map(|image| image["dice_dynamic"].as_f64().unwrap())
            .collect();
        dice.iter().sum::<f64>() / dice.len() as f64
    };
    // With phase 0 as the phase of rest the values are 0.1 and 0.2.
    let (full, filling) = (mean_dice(&|phase| phase > FULL_FROM), mean_dice(&|phase| phase < FULL_FROM));
    assert!(full > 0.8 && filling > 0.4, "{full} where vessels are full, {filling} where they are being filled");
}

#[test]
fn sets_per_phase_are_taken_where_vessels_fill() {
    let directory = tempfile::tempdir().unwrap();
    let (_, notes) = rest_phase(&phantom(directory.path(), &["--inflow", "0.2"]), "auto");
    assert!(notes.iter().any(|note| note.contains("contrast agent flows in or out during the beat")), "{notes:?}");
}

#[test]
fn full_vessels_rest_at_phase_0() {
    let directory = tempfile::tempdir().unwrap();
    let (rest, notes) = rest_phase(&phantom(directory.path(), &["--photons", "2e7"]), "auto");
    assert_eq!(rest, 0, "{notes:?}");
    let tells = |what: &str| notes.iter().any(|note| note.contains(what));
    assert!(tells("one deformable set of Gaussians") && !tells("from phase"), "{notes:?}");
}
