//! Methods with a room of their own through the program: training, resuming, scoring, rendering, export and timing.

use crate::program::program;
use serde_json::{Value, json};

#[track_caller]
fn ok(args: &[&str]) -> String {
    let out = program().arg("--validate").args(args).output().unwrap();
    assert!(out.status.success(), "{args:?}: {}", String::from_utf8_lossy(&out.stderr));
    String::from_utf8(out.stdout).unwrap()
}

/// A method, a short run of it, and the parts of the program's output that differ between methods.
struct Method {
    preset: &'static str,
    /// Iterations of the run; states are kept and images are scored after each half.
    iterations: u32,
    /// Iterations after which the run that is resumed stops.
    stop_at: &'static str,
    /// Settings of the method.
    settings: &'static [&'static str],
    /// Entries of `info --json`, by their JSON pointers.
    info: Vec<(&'static str, Value)>,
    /// Flags of each rendering.
    renderings: &'static [&'static [&'static str]],
    /// Text in the output of `bench`.
    timed: [&'static str; 2],
    /// Text that the output of `bench` must not have.
    not_timed: &'static str,
    /// Tells whether a kernel is one that `kernels` lists for the method.
    is_own_kernel: fn(&str) -> bool,
    /// Beginning of the names of kernels of another method.
    other_kernels: &'static str,
}

/// Runs a method through the program. `check_score` gets the output of `eval --json` and the run.
fn trains_resumes_scores_draws_exports_and_times(method: &Method, check_score: impl FnOnce(&Value, &str)) {
    let directory = tempfile::tempdir().unwrap();
    let path = |name: &str| directory.path().join(name).to_str().unwrap().to_owned();
    let (data, whole, parts) = (path("data"), path("whole"), path("parts"));
    ok(&["phantom", &data, "--size", "24", "--phases", "3", "--views", "3", "--no-volumes"]);
    let half = method.iterations / 2;
    let length = [
        format!("train.iterations={}", method.iterations),
        format!("train.validate_every={half}"),
        format!("train.checkpoint_every={half}"),
    ];
    let mut settings = vec!["--preset", method.preset];
    for setting in length.iter().map(String::as_str).chain(method.settings.iter().copied()) {
        settings.extend(["--set", setting]);
    }
    let said = ok(&[&["train", &data, "-o", &whole, "--json"], &settings[..]].concat());
    assert!(said.contains("a static method") && said.contains("\"validation\""), "{said}");
    ok(&[&["train", &data, "-o", &parts, "--stop-at", method.stop_at, "--no-eval"], &settings[..]].concat());
    ok(&["train", &data, "-o", &parts, "--resume", "--no-eval"]);
    let bytes = |run: &str| std::fs::read(format!("{run}/checkpoint-{:07}.safetensors", method.iterations)).unwrap();
    assert!(bytes(&whole) == bytes(&parts), "a resumed run comes to the same bits");
    let score: Value = serde_json::from_str(&ok(&["eval", &whole, "--json"])).unwrap();
    assert_eq!(score["dice"]["dynamic"], score["dice"]["total"], "there is no static field");
    check_score(&score, &whole);
    let info: Value = serde_json::from_str(&ok(&["info", &whole, "--json"])).unwrap();
    assert!(info["config"].get("static").is_none(), "a configuration has the sections of its own method alone");
    for (entry, value) in &method.info {
        assert_eq!(info.pointer(entry), Some(value), "{entry}");
    }
    for (k, flags) in method.renderings.iter().enumerate() {
        let file = path(&format!("view-{k}.png"));
        ok(&[&["render", &whole, "--phase", "1", "-o", &file], &flags[..]].concat());
    }
    ok(&["export", &whole, "--component", "dynamic", "--spacing", "3", "-o", &path("vessels.nrrd")]);
    let bench = [&["bench", &data, "--kernels", "--iterations", "2", "--repeats", "2"], &settings[..]].concat();
    let said = ok(&bench);
    assert!(method.timed.iter().all(|part| said.contains(part)) && !said.contains(method.not_timed), "{said}");
    let kernels: Value = serde_json::from_str(&ok(&["kernels", "--preset", method.preset, "--json"])).unwrap();
    let listed: Vec<&str> =
        kernels["kernels"].as_array().unwrap().iter().map(|k| k["kernel"].as_str().unwrap()).collect();
    assert!(
        listed.iter().any(|k| (method.is_own_kernel)(k)) && !listed.iter().any(|k| k.starts_with(method.other_kernels)),
        "{listed:?}"
    );
}

#[test]
#[ignore = "long: tools/test --all"]
fn r2_gaussian_trains_resumes_scores_draws_exports_and_times() {
    let method = Method {
        preset: "r2-gaussian",
        iterations: 40,
        stop_at: "13",
        settings: &[
            "r2.n_points=60",
            "r2.voxels=24",
            "r2.tv_vol_size=8",
            "r2.densification_interval=8",
            "r2.densify_from_iter=4",
            "r2.densify_until_iter=30",
        ],
        info: vec![("/config/preset", json!("r2-gaussian"))],
        renderings: &[&[], &["--baked", "--projection", "mip", "--component", "dynamic"]],
        timed: ["form R2-Gaussian", "ssim_columns"],
        not_timed: "static field",
        is_own_kernel: |k| k == "r2_update",
        other_kernels: "tree_",
    };
    trains_resumes_scores_draws_exports_and_times(&method, |_, _| ());
}

#[test]
fn sax_nerf_trains_resumes_scores_draws_exports_and_times() {
    let method = Method {
        preset: "sax-nerf",
        iterations: 12,
        stop_at: "5",
        settings: &[
            "sax.num_levels=4",
            "sax.log2_hashmap_size=10",
            "sax.window_num=1",
            "sax.window_size=4",
            "sax.n_rays=16",
            "sax.n_samples=8",
            "sax.lrate_step=10",
        ],
        info: vec![("/config/preset", json!("sax-nerf")), ("/sax/fields", json!(3))],
        renderings: &[&[], &["--projection", "mip", "--component", "dynamic"]],
        timed: ["sax_linear_back", "sax_encode"],
        not_timed: "march_fwd",
        is_own_kernel: |k| k.starts_with("sax_encode_bwd"),
        other_kernels: "gaussian_",
    };
    trains_resumes_scores_draws_exports_and_times(&method, |_, _| ());
}

#[test]
#[ignore = "long: tools/test --all"]
fn x_gaussian_trains_resumes_scores_draws_exports_and_times() {
    let method = Method {
        preset: "x-gaussian",
        iterations: 40,
        stop_at: "13",
        settings: &[
            "x.voxels=8",
            "x.interval=2",
            "x.densification_interval=8",
            "x.densify_from_iter=4",
            "x.densify_until_iter=30",
            "x.opacity_reset_interval=20",
        ],
        info: vec![("/config/preset", json!("x-gaussian"))],
        renderings: &[
            &[],
            &["--baked", "--projection", "mip", "--component", "dynamic"],
            &["--baked", "--component", "dynamic"],
        ],
        timed: ["form X-Gaussian", "x_blend_back"],
        not_timed: "static field",
        is_own_kernel: |k| k == "x_update",
        other_kernels: "r2_voxel",
    };
    trains_resumes_scores_draws_exports_and_times(&method, |score, run| {
        assert_eq!(score["dice"]["dynamic"], score["dice_published"]["paper"], "the published threshold");
        assert!(score["threshold"]["rule"].as_str().unwrap().contains("opacities"), "{score}");
        // The comparison is with images of a range from 0 to 1, as it renders them.
        assert!((3.0..60.0).contains(&score["psnr"].as_f64().unwrap()), "{}", score["psnr"]);
        // Each image has a threshold of its own.
        let images = score["images"].as_array().unwrap();
        let otsu: Vec<f64> = images.iter().map(|image| image["dice_otsu"].as_f64().unwrap()).collect();
        let mean = otsu.iter().sum::<f64>() / otsu.len() as f64;
        assert!((score["dice_otsu"].as_f64().unwrap() - mean).abs() < 1e-12);
        assert!(ok(&["eval", run]).contains("Dice at Otsu's threshold of each image"));
    });
}
