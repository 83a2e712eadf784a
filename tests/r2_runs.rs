//! R2-Gaussian through the program: training, resuming, scoring, rendering, export and timing.
#![allow(missing_docs, clippy::unwrap_used, clippy::expect_used)]

#[path = "common/program.rs"]
mod program;

use program::program;
use serde_json::Value;

#[track_caller]
fn ok(args: &[&str]) -> String {
    let out = program().arg("--validate").args(args).output().unwrap();
    assert!(out.status.success(), "{args:?}: {}", String::from_utf8_lossy(&out.stderr));
    String::from_utf8(out.stdout).unwrap()
}

#[test]
fn the_program_trains_resumes_scores_draws_exports_and_times() {
    let directory = tempfile::tempdir().unwrap();
    let path = |name: &str| directory.path().join(name).to_str().unwrap().to_owned();
    let (data, whole, parts) = (path("data"), path("whole"), path("parts"));
    ok(&["phantom", &data, "--size", "24", "--phases", "3", "--views", "3", "--no-volumes"]);
    let mut settings = vec!["--preset", "r2-gaussian"];
    for setting in [
        "train.iterations=40",
        "train.validate_every=20",
        "train.checkpoint_every=20",
        "r2.n_points=60",
        "r2.voxels=24",
        "r2.tv_vol_size=8",
        "r2.densification_interval=8",
        "r2.densify_from_iter=4",
        "r2.densify_until_iter=30",
    ] {
        settings.extend(["--set", setting]);
    }
    let said = ok(&[&["train", &data, "-o", &whole, "--json"], &settings[..]].concat());
    assert!(said.contains("a static method") && said.contains("\"validation\""), "{said}");
    ok(&[&["train", &data, "-o", &parts, "--stop-at", "13", "--no-eval"], &settings[..]].concat());
    ok(&["train", &data, "-o", &parts, "--resume", "--no-eval"]);
    let bytes = |run: &str| std::fs::read(format!("{run}/checkpoint-0000040.safetensors")).unwrap();
    assert!(bytes(&whole) == bytes(&parts), "a resumed run comes to the same bits");
    let score: Value = serde_json::from_str(&ok(&["eval", &whole, "--json"])).unwrap();
    assert_eq!(score["dice"]["dynamic"], score["dice"]["total"], "there is no static field");
    let info: Value = serde_json::from_str(&ok(&["info", &whole, "--json"])).unwrap();
    assert_eq!(
        (&info["config"]["gaussians"]["form"], &info["config"]["static"]["form"]),
        (&"r2".into(), &"none".into())
    );
    ok(&["render", &whole, "--phase", "1", "-o", &path("view.png")]);
    ok(&[
        "render",
        &whole,
        "--baked",
        "--projection",
        "mip",
        "--component",
        "dynamic",
        "--phase",
        "1",
        "-o",
        &path("mip.png"),
    ]);
    ok(&["export", &whole, "--component", "dynamic", "--spacing", "3", "-o", &path("vessels.nrrd")]);
    let bench = [&["bench", &data, "--kernels", "--iterations", "2", "--repeats", "2"], &settings[..]].concat();
    let said = ok(&bench);
    assert!(said.contains("form r2") && said.contains("ssim_columns") && !said.contains("static field"), "{said}");
    let kernels: Value = serde_json::from_str(&ok(&["kernels", "--preset", "r2-gaussian", "--json"])).unwrap();
    let listed: Vec<&str> =
        kernels["kernels"].as_array().unwrap().iter().map(|k| k["kernel"].as_str().unwrap()).collect();
    assert!(listed.contains(&"r2_update") && !listed.iter().any(|k| k.starts_with("tree_")), "{listed:?}");
}
