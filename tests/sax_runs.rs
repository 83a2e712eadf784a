//! SAX-NeRF through the program: training, resuming, scoring, rendering, export and timing.
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
    let mut settings = vec!["--preset", "sax-nerf"];
    for setting in [
        "train.iterations=12",
        "train.validate_every=6",
        "train.checkpoint_every=6",
        "sax.num_levels=4",
        "sax.log2_hashmap_size=10",
        "sax.window_num=1",
        "sax.window_size=4",
        "sax.n_rays=16",
        "sax.n_samples=8",
        "sax.lrate_step=10",
    ] {
        settings.extend(["--set", setting]);
    }
    let said = ok(&[&["train", &data, "-o", &whole, "--json"], &settings[..]].concat());
    assert!(said.contains("a static method") && said.contains("\"validation\""), "{said}");
    ok(&[&["train", &data, "-o", &parts, "--stop-at", "5", "--no-eval"], &settings[..]].concat());
    ok(&["train", &data, "-o", &parts, "--resume", "--no-eval"]);
    let bytes = |run: &str| std::fs::read(format!("{run}/checkpoint-0000012.safetensors")).unwrap();
    assert!(bytes(&whole) == bytes(&parts), "a resumed run comes to the same bits");
    let score: Value = serde_json::from_str(&ok(&["eval", &whole, "--json"])).unwrap();
    assert_eq!(score["dice"]["dynamic"], score["dice"]["total"], "there is no static field");
    let info: Value = serde_json::from_str(&ok(&["info", &whole, "--json"])).unwrap();
    assert_eq!(
        (&info["config"]["dynamic"]["form"], &info["config"]["static"]["form"], &info["sax"]["fields"]),
        (&"lineformer".into(), &"none".into(), &3.into())
    );
    ok(&["render", &whole, "--phase", "1", "-o", &path("view.png")]);
    let mip = path("mip.png");
    ok(&["render", &whole, "--projection", "mip", "--component", "dynamic", "--phase", "1", "-o", &mip]);
    ok(&["export", &whole, "--component", "dynamic", "--spacing", "3", "-o", &path("vessels.nrrd")]);
    let bench = [&["bench", &data, "--kernels", "--iterations", "2", "--repeats", "2"], &settings[..]].concat();
    let said = ok(&bench);
    assert!(said.contains("sax_linear_back") && said.contains("sax_encode") && !said.contains("march_fwd"), "{said}");
    let kernels: Value = serde_json::from_str(&ok(&["kernels", "--preset", "sax-nerf", "--json"])).unwrap();
    let listed: Vec<&str> =
        kernels["kernels"].as_array().unwrap().iter().map(|k| k["kernel"].as_str().unwrap()).collect();
    assert!(
        listed.iter().any(|k| k.starts_with("sax_encode_bwd")) && !listed.iter().any(|k| k.starts_with("gaussian_")),
        "{listed:?}"
    );
}
