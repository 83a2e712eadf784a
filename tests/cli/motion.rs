//! Motion known between phases: images at any moment, and motion files that other tools read.

use crate::common;
use crate::common::{expect_silence, gpu, small_config, small_dataset, tuning};
use crate::program::program;
use crate::python::python;
use glam::{DMat3, DVec3};
use nertca_vk::checkpoint::Checkpoint;
use nertca_vk::fields::state::FieldsState;
use nertca_vk::formats::npy;
use nertca_vk::gaussians::field::{GaussianField, Gaussians, MovingGaussians, Units};
use nertca_vk::gaussians::view::SplatView;
use nertca_vk::kernels::layout::{Gaussian, GaussianSetup, MotionGridSetup};
use nertca_vk::model::Model;
use nertca_vk::plan::Plan;
use nertca_vk::render::renderer::Renderer;
use nertca_vk_twins::reference::gaussians::{Params, exact_integral, params};
use serde_json::{Value, json};
use std::path::Path;
use std::process::Output;
use std::sync::Arc;

const PHASES: usize = 3;
const UNITS: Units = Units { pixel: 0.012, strongest: 0.7 };
const NODES: u32 = 5;
const HALF_SIDE: f64 = 44.0;
/// Columns and rows of the pictures.
const SIZE: [usize; 2] = [19, 15];
/// Phase at which Gaussians are at their stored positions.
const REST: usize = 1;

/// Displacement of a point by the grid at each phase: linear in the point, so that a grid represents it exactly.
fn displacement(x: DVec3, phase: usize) -> DVec3 {
    let turn =
        DMat3::from_cols(DVec3::new(0.06, 0.02, -0.03), DVec3::new(-0.05, 0.04, 0.01), DVec3::new(0.02, -0.04, 0.03));
    match phase {
        REST => DVec3::ZERO,
        0 => turn * x + DVec3::new(2.0, -3.0, 1.0),
        _ => 0.5 * (turn * x) + DVec3::new(-1.5, 0.5, 3.0),
    }
}

/// Own motion of Gaussian `i`: amplitudes of cos - 1 and of sin.
fn own(i: usize) -> [DVec3; 2] {
    let wave = |k: f64| 0.8 * (k * (i + 1) as f64).sin();
    [DVec3::new(wave(0.7), wave(1.3), wave(2.1)), DVec3::new(wave(1.9), wave(0.4), wave(1.1))]
}

fn rest(i: usize) -> DVec3 {
    let wave = |k: f64| 9.0 * (k * (i + 1) as f64).sin();
    DVec3::new(wave(0.9), wave(1.7), wave(2.9))
}

/// Position of Gaussian `i`, computed without the library.
fn place(i: usize, phase: f64) -> DVec3 {
    let (before, share) = (phase as usize % PHASES, phase.fract());
    let x = rest(i);
    let moved = (1.0 - share) * displacement(x, before) + share * displacement(x, (before + 1) % PHASES);
    let own_at = |phase: usize| {
        let angle = std::f64::consts::TAU * (phase as f64 - REST as f64) / PHASES as f64;
        (angle.cos() - 1.0) * own(i)[0] + angle.sin() * own(i)[1]
    };
    x + moved + own_at(before).lerp(own_at(before + 1), share)
}

fn tree() -> MovingGaussians {
    let step = 2.0 * HALF_SIDE / f64::from(NODES - 1);
    let n = NODES as usize;
    let node = |i: usize| DVec3::new((i % n) as f64, (i / n % n) as f64, (i / n / n) as f64) * step - HALF_SIDE;
    let pack = |v: DVec3| [v.x as f32, v.y as f32, v.z as f32, 0.0];
    let gaussian = |i: usize| Gaussian {
        position: rest(i).as_vec3().to_array(),
        log_density: -1.0 + 0.1 * i as f32,
        log_scale: [0.1 * i as f32, 0.4, -0.2],
        phase: REST as u32,
        rotation: [1.0, 0.2 * i as f32, -0.3, 0.5],
    };
    MovingGaussians {
        rest: Gaussians {
            units: UNITS,
            n_phases: PHASES,
            // The cut is so far out that the truncated part is negligible.
            setup: GaussianSetup { cut: 6.0, min_scale: 0.4, max_scale: 3.0, ..GaussianSetup::default() },
            rows: (0..6).map(gaussian).collect(),
            step: 1,
            is_crowd: false,
            agreement: None,
            intensities: None,
        },
        setup: MotionGridSetup {
            n_nodes: NODES,
            half_side: HALF_SIDE as f32,
            inverse_step: (1.0 / step) as f32,
            n_basis: 2,
            rest_phase: REST as u32,
            ..MotionGridSetup::default()
        },
        grid: (0..PHASES).flat_map(|t| (0..n.pow(3)).map(move |i| pack(displacement(node(i), t)))).collect(),
        own: (0..6).flat_map(|i| own(i).map(pack)).collect(),
        filling: None,
    }
}

/// An untrained model with a dynamic field.
fn model(preset: &str, moving: Option<GaussianField>) -> Model {
    let dataset = small_dataset(SIZE[0], SIZE[1]);
    let plan = Plan::new(&small_config(preset, &[]), &dataset).unwrap();
    Model {
        params: plan.params.initial(plan.config.seed),
        config: plan.config,
        scene: plan.scene,
        param_map: plan.params,
        hull: None,
        gaussians: moving,
        field: None,
        step: 40,
        vessel_attenuation: None,
        c_arm: dataset.reference_c_arm(),
        image_size: SIZE,
    }
}

fn moving_model() -> Model {
    model("fast", Some(GaussianField::Moving(tree())))
}

fn saved(model: Model, path: &Path) -> String {
    let fit = Arc::new(FieldsState::fresh(model.step, model.param_map.len));
    let checkpoint = Checkpoint { model, fit, data_fingerprint: "none".into() };
    checkpoint.write(path).unwrap();
    path.to_str().unwrap().to_owned()
}

fn nertca(args: &[&str]) -> Output {
    program().arg("--validate").args(args).output().unwrap()
}

#[track_caller]
fn ok(args: &[&str]) -> String {
    let out = nertca(args);
    assert!(out.status.success(), "{args:?}: {}", String::from_utf8_lossy(&out.stderr));
    String::from_utf8(out.stdout).unwrap()
}

#[track_caller]
fn refuses(args: &[&str], parts: &[&str]) {
    let out = nertca(args);
    let stderr = String::from_utf8_lossy(&out.stderr);
    assert_eq!(out.status.code(), Some(2), "{args:?}: {stderr}");
    parts.iter().for_each(|part| assert!(stderr.contains(part), "{args:?} does not name `{part}`: {stderr}"));
}

#[test]
fn any_moment_of_the_beat_can_be_rendered() {
    let (gpu, dataset) = (gpu(), small_dataset(SIZE[0], SIZE[1]));
    let [width, height] = SIZE;
    let (rays, field) = (&dataset.views[0].rays, tree());
    let renderer = Renderer::new(&gpu, &moving_model(), tuning(&gpu)).unwrap();
    let at = |phase: f64| renderer.render_at(rays, width, height, phase).unwrap();
    let whole = |phase: u32| renderer.render(rays, width, height, phase).unwrap();
    let view = SplatView::new(rays, UNITS);
    for phase in [0.0, 0.25, 1.5, 2.0, 2.75] {
        let seen = at(phase);
        let field: Vec<Params> = (0..6)
            .map(|i| {
                let mut p = params(&field.rest.rows[i]);
                p[..3].copy_from_slice(&place(i, phase).to_array());
                p
            })
            .collect();
        let want: Vec<f64> = (0..width * height)
            .map(|pixel| {
                let (u, v) = ((pixel % width) as f64, (pixel / width) as f64);
                let of = |p: &Params| exact_integral(p, &tree().rest.setup, &view, u, v);
                UNITS.strongest * field.iter().map(of).sum::<f64>()
            })
            .collect();
        let (error, pixel) = common::relative_error(&seen.dynamic_integral, &want);
        assert!(error < 1e-4, "phase {phase}: off by {error} of the largest at pixel {pixel}");
        assert!(want.iter().copied().fold(0.0, f64::max) > 0.1, "the case must show something");
        assert_eq!(seen.static_integral, whole(0).static_integral, "the static field stands still");
    }
    // Whole phases are unchanged, also after moments between them; the beat is periodic.
    for phase in 0..PHASES {
        assert_eq!(at(phase as f64).dynamic_integral, whole(phase as u32).dynamic_integral);
        assert_eq!(at(phase as f64).total_max, whole(phase as u32).total_max);
    }
    assert_eq!(at(PHASES as f64).dynamic_integral, whole(0).dynamic_integral);
    for bad in [-0.5, 3.2, f64::NAN, f64::INFINITY] {
        let error = renderer.render_at(rays, width, height, bad).unwrap_err().to_string();
        assert!(error.contains("0 to 3"), "{bad}: {error}");
    }
    // After a change, the new field is rendered from the next picture, also between phases.
    let mut other = tree();
    other.rest.rows.iter_mut().for_each(|g| g.log_density = -30.0);
    renderer.set_gaussians(&GaussianField::Moving(other)).unwrap();
    assert!(at(0.5).dynamic_integral.iter().all(|v| *v < 1e-9));
    // Fields that are known at whole phases only give an error.
    renderer.set_gaussians(&GaussianField::PerPhase(tree().expand())).unwrap();
    assert_eq!(at(2.0).dynamic_integral, whole(2).dynamic_integral);
    let between = renderer.render_at(rays, width, height, 0.5).unwrap_err().to_string();
    assert!(between.contains("between two phases") && between.contains("gaussians.form = \"deformable\""), "{between}");
    assert!(renderer.render_at(rays, width, height, 3.0).unwrap_err().to_string().contains("0 to 2"));
    drop(renderer);
    expect_silence(gpu);
}

#[test]
fn the_program_renders_between_phases() {
    let dir = tempfile::tempdir().unwrap();
    let file = |name: &str| dir.path().join(name).to_str().unwrap().to_owned();
    let run = saved(moving_model(), &dir.path().join("tree.safetensors"));
    let picture = |name: &str, extra: &[&str]| {
        ok(&[&["render", &run, "--component", "dynamic", "--out", &file(name)], extra].concat());
        npy::read(Path::new(&file(name)), 1 << 20).unwrap()
    };
    let all = picture("all.npy", &["--phase", "all"]);
    let smooth = picture("smooth.npy", &["--phase", "all", "--between", "1"]);
    let between = picture("between.npy", &["--phase", "2.5"]);
    assert_eq!((&all.shape[..], &smooth.shape[..]), (&[3, 15, 19][..], &[6, 15, 19][..]));
    let n = SIZE[0] * SIZE[1];
    for phase in 0..PHASES {
        assert_eq!(smooth.values[2 * phase * n..][..n], all.values[phase * n..][..n], "phase {phase}");
    }
    assert_eq!(between.shape, [15, 19]);
    let neighbours = [&all.values[2 * n..], &all.values[..n]];
    assert!(neighbours.iter().all(|whole| **whole != between.values[..]), "what moves is at neither phase");
    assert_eq!(
        smooth.values[5 * n..],
        between.values[..],
        "the last picture lies between the last phase and the first"
    );
    assert_eq!(picture("next.npy", &["--phase", "3"]).values, all.values[..n], "the next beat's first phase");
    ok(&["render", &run, "--phase", "all", "--between", "2", "--out", &file("smooth.gif")]);
    let gif = std::io::BufReader::new(std::fs::File::open(file("smooth.gif")).unwrap());
    let frames = image::AnimationDecoder::into_frames(image::codecs::gif::GifDecoder::new(gif).unwrap());
    let frames = frames.collect_frames().unwrap();
    assert_eq!(frames.len(), 9);
    assert_eq!(frames[0].delay().numer_denom_ms(), (30, 1), "the beat takes as long as without");

    let render = ["render", &run, "--out", "x.npy", "--phase"];
    for bad in ["3.01", "-1", "nan", "one"] {
        refuses(&[&render[..], &[bad]].concat(), &["--phase", "0 to 3"]);
    }
    refuses(&[&render[..], &["1", "--between", "2"]].concat(), &["--between", "--phase all"]);
    refuses(&[&render[..], &["1.5", "--baked"]].concat(), &["--baked", "whole phases"]);
    let sets =
        saved(model("fast", Some(GaussianField::PerPhase(tree().expand()))), &dir.path().join("sets.safetensors"));
    let network = saved(model("fast-mlp", None), &dir.path().join("network.safetensors"));
    refuses(&["render", &sets, "--out", "x.npy", "--phase", "0.5"], &["between two phases", "whole", "deformable"]);
    refuses(&["render", &sets, "--out", "x.npy", "--phase", "3"], &["--phase", "0 to 2"]);
    // A network has latents between those of two phases.
    let [first, between, last, closed] = ["0", "2.5", "2", "3"].map(|phase| {
        ok(&["render", &network, "--component", "dynamic", "--phase", phase, "--out", &file("network.npy")]);
        npy::read(Path::new(&file("network.npy")), 1 << 20).unwrap().values
    });
    assert_eq!(first, closed, "the next beat's first phase");
    assert!(between != first && between != last, "what the network shows is at neither phase");
}

/// LPS mm of a vector along (posterior, left, superior) in pixels.
fn lps_mm(x: DVec3) -> [f64; 3] {
    [x.y, x.x, x.z].map(|v| v * UNITS.pixel * 100.0)
}

#[test]
fn motion_opens_in_other_tools() {
    let dir = tempfile::tempdir().unwrap();
    let to = |name: &str| dir.path().join(name).to_str().unwrap().to_owned();
    let run = saved(moving_model(), &dir.path().join("tree.safetensors"));
    let export = |name: &str, extra: &[&str]| ok(&[&["export", &run, "--motion", "--out", &to(name)], extra].concat());
    export("field.nrrd", &[]);
    export("zipped.nrrd", &["--compress"]);
    export("one.nrrd", &["--phase", "1"]);
    assert_eq!(export("field.vtk", &[]).lines().count(), PHASES);
    export("one.vtk", &["--phase", "1"]);
    export("lines.vtk", &["--trajectories"]);
    // The expected content of the files is computed from the tree, at positions between nodes.
    let tree = tree();
    let places: Vec<DVec3> = (0..7).map(|i| 3.5 * rest(i)).collect();
    assert!(places.iter().all(|x| x.abs().max_element() < HALF_SIDE));
    let expected = json!({
        "phases": PHASES,
        "rest_phase": REST,
        "size": NODES,
        "places_mm": places.iter().map(|x| lps_mm(*x)).collect::<Vec<_>>(),
        "displacements_mm": (0..PHASES)
            .map(|t| places.iter().map(|x| lps_mm(tree.carried(*x, t as f64) - *x)).collect::<Vec<_>>())
            .collect::<Vec<_>>(),
        "trajectories_mm": (0..6)
            .map(|i| (0..PHASES).map(|t| lps_mm(place(i, t as f64))).collect::<Vec<_>>())
            .collect::<Vec<_>>(),
        "scales_mm": (0..6)
            .map(|i| {
                let mut mm = [0.1 * f64::from(i), 0.4, -0.2].map(|log| f64::exp(log) * UNITS.pixel * 100.0);
                mm.sort_by(f64::total_cmp);
                mm
            })
            .collect::<Vec<_>>(),
        "attenuation_per_mm": (0..6)
            .map(|i| (-1.0 + 0.1 * f64::from(i)).exp() * UNITS.strongest / (UNITS.pixel * 100.0))
            .collect::<Vec<_>>(),
    });
    std::fs::write(to("expected.json"), expected.to_string()).unwrap();
    let script = crate::root::root().join("tests/python/check_motion.py");
    let outcome = python().arg(script).arg(dir.path()).output().unwrap();
    assert!(outcome.status.success(), "{}", String::from_utf8_lossy(&outcome.stderr));
}

#[test]
fn splats_open_in_other_tools() {
    let dir = tempfile::tempdir().unwrap();
    let to = |name: &str| dir.path().join(name).to_str().unwrap().to_owned();
    let run = saved(moving_model(), &dir.path().join("tree.safetensors"));
    assert_eq!(ok(&["export", &run, "--splats", "--out", &to("beat.ply")]).lines().count(), PHASES);
    ok(&["export", &run, "--spacing", "2", "--out", &to("beat.nrrd")]);
    let densities: Vec<f64> = (0..6).map(|i| (-1.0 + 0.1 * f64::from(i)).exp()).collect();
    let expected = json!({
        "attenuation_per_mm":
            densities.iter().map(|d| d * UNITS.strongest / (UNITS.pixel * 100.0)).collect::<Vec<_>>(),
        "rest_phase": REST,
        "places_mm": (0..6).map(|i| lps_mm(rest(i))).collect::<Vec<_>>(),
    });
    std::fs::write(to("expected.json"), expected.to_string()).unwrap();
    let script = crate::root::root().join("tests/python/check_splats.py");
    let outcome = python().arg(script).arg(dir.path()).output().unwrap();
    assert!(outcome.status.success(), "{}", String::from_utf8_lossy(&outcome.stderr));
    // One phase is one file of the given name.
    assert_eq!(ok(&["export", &run, "--splats", "--phase", "2", "--out", &to("one.ply")]).trim(), to("one.ply"));
    assert_eq!(std::fs::read(to("one.ply")).unwrap(), std::fs::read(to("beat_0002.ply")).unwrap());
    let network = saved(model("fast-mlp", None), &dir.path().join("network.safetensors"));
    refuses(&["export", &network, "--splats", "--out", &to("x.ply")], &["network", "--mesh"]);
    refuses(&["export", &run, "--splats", "--out", &to("x.obj")], &["x.obj", ".ply"]);
    refuses(&["export", &run, "--splats", "--out", &to("beat.ply")], &["--force"]);
}

#[test]
fn motion_that_is_not_known_is_not_exported() {
    let dir = tempfile::tempdir().unwrap();
    let out = dir.path().join("x.nrrd");
    let sets =
        saved(model("fast", Some(GaussianField::PerPhase(tree().expand()))), &dir.path().join("sets.safetensors"));
    let network = saved(model("fast-mlp", None), &dir.path().join("network.safetensors"));
    let moves = saved(moving_model(), &dir.path().join("tree.safetensors"));
    let export = |run: &str, extra: &[&str], parts: &[&str]| {
        refuses(&[&["export", run, "--motion", "--out", out.to_str().unwrap()], extra].concat(), parts);
        assert!(!out.exists());
    };
    export(&sets, &[], &["gaussians.form", "per phase", "\"deformable\""]);
    export(&network, &[], &["gaussians.form", "network", "\"deformable\""]);
    export(&moves, &["--phase", "3"], &["--phase", "0 to 2"]);
    export(&moves, &["--trajectories"], &["--out", ".vtk"]);
    export(&moves, &["--mesh"], &["--mesh"]);
    let to = |name: &str| dir.path().join(name).to_str().unwrap().to_owned();
    refuses(&["export", &moves, "--motion", "--out", &to("x.mha")], &["x.mha", ".nrrd .vtk"]);
    refuses(&["export", &moves, "--motion", "--compress", "--out", &to("x.vtk")], &["x.vtk", "NRRD"]);
    refuses(&["export", &moves, "--trajectories", "--out", &to("x.vtk")], &["--motion"]);
}

#[test]
fn a_run_of_gaussians_is_described() {
    let dir = tempfile::tempdir().unwrap();
    let run = saved(moving_model(), &dir.path().join("tree.safetensors"));
    let info: Value = serde_json::from_str(&ok(&["info", &run, "--json"])).unwrap();
    let told = &info["gaussians"];
    assert_eq!((&told["form"], &told["count"], &told["rest_phase"]), (&json!("deformable"), &json!(6), &json!(REST)));
    // There are 11 values per Gaussian, two vectors of own motion, and the grid.
    assert_eq!(told["bytes"], 4 * (6 * 11 + 6 * 2 * 3 + PHASES * 125 * 3));
    for phase in 0..PHASES {
        let mm: Vec<f64> =
            (0..6).map(|i| 100.0 * UNITS.pixel * place(i, phase as f64).distance(place(i, 0.0))).collect();
        let of = &told["displacement_from_phase_0"][phase];
        let (mean, largest) = (mm.iter().sum::<f64>() / 6.0, mm.iter().copied().fold(0.0, f64::max));
        assert!((of["mean_mm"].as_f64().unwrap() - mean).abs() < 1e-4, "{of} at phase {phase}, not {mean}");
        assert!((of["largest_mm"].as_f64().unwrap() - largest).abs() < 1e-4, "{of} at phase {phase}, not {largest}");
    }
    let text = ok(&["info", &run]);
    assert!(
        text.contains("form: \"deformable\"") && text.contains("count: 6") && !text.contains("hull_share"),
        "{text}"
    );
    let network = saved(model("fast-mlp", None), &dir.path().join("network.safetensors"));
    let info: Value = serde_json::from_str(&ok(&["info", &network, "--json"])).unwrap();
    assert_eq!(info["gaussians"], Value::Null);
}
