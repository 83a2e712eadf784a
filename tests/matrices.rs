//! The network on cooperative matrices against the f64 twin and the f32 path, with validation on. `tools/test` runs
//! this on the newest lavapipe; on a device without matrices it says so and checks nothing, unless
//! `NERTCA_MATRICES=require`.
#![allow(missing_docs, clippy::unwrap_used, clippy::expect_used)]

mod common;

use common::{expect_silence, gpu, relative_error, run, small_config, small_dataset};
use nertca_vk::gpu::device::Gpu;
use nertca_vk::kernels::layout::DeviceState;
use nertca_vk::kernels::tuning::{Layers, MatrixTuning, Tuning};
use nertca_vk::network::FIRST_LOSS_SCALE;
use nertca_vk::plan::Plan;
use nertca_vk::reference::field::Precision;
use nertca_vk::reference::{march, step};
use nertca_vk::render::renderer::Renderer;
use nertca_vk::train::calibrate::{self, Verdict};
use nertca_vk::train::trainer::Trainer;

/// The twin rounds where the kernels round.
const F16: Precision = Precision::F16 { loss_scale: FIRST_LOSS_SCALE as f64 };

/// A device and its matrix path, if it has one.
fn matrices() -> Option<(Gpu, Tuning)> {
    let gpu = gpu();
    if gpu.info().matrices.is_empty() {
        assert!(std::env::var("NERTCA_MATRICES").is_err(), "{} has no cooperative matrices", gpu.info().name);
        eprintln!("SKIPPED: {} has no cooperative matrices", gpu.info().name);
        return None;
    }
    let tuning = Tuning::for_device(gpu.info()).with_layers(Layers::Matrices, String::new());
    Some((gpu, tuning))
}

/// Each covers what the others do not: no skip and a skip layer; the skip layer last; one layer; odd bands; several
/// chunks; more tiles than workgroups; fewer samples than a tile; loops unrolled as on a GPU, with large tiles.
const CASES: &[(&str, &[&str], MatrixTuning)] = &[
    ("fast-mlp", &["dynamic.width=48", "dynamic.bands=5"], CPU),
    ("public-code", &["dynamic.occlusion=1e-3", "loss.normalise=true"], CPU),
    ("fast-mlp", &["dynamic.layers=3", "dynamic.skip_layer=3", "dynamic.width=64", "train.rays=100"], CPU),
    ("paper", &["dynamic.layers=1", "dynamic.width=16", "loss.normalise=true", "dynamic.latent=12"], CPU),
    ("fast-mlp", &["train.rays=1", "march.dynamic_samples=7"], CPU),
    (
        "fast-mlp",
        &["dynamic.width=32", "dynamic.layers=3", "dynamic.bands=4", "train.rays=60"],
        MatrixTuning { workgroups: 3, largest_tile: 128, unroll: true },
    ),
];
const CPU: MatrixTuning = MatrixTuning { workgroups: 4, largest_tile: 32, unroll: false };

#[test]
fn losses_and_gradients_match() {
    let Some((gpu, tuning)) = matrices() else { return };
    let dataset = small_dataset(13, 11);
    for (preset, settings, sizes) in CASES {
        let plan = Plan::new(&small_config(preset, settings), &dataset).unwrap();
        let params = plan.params.initial(&plan.config);
        let twin: Vec<f64> = params.iter().map(|v| f64::from(*v)).collect();
        let path = Tuning { matrices: *sizes, ..tuning.clone() };
        let mut trainer = Trainer::new(&gpu, plan, &dataset, path).unwrap();
        let got = trainer.advance(1).unwrap()[0];
        let plan = trainer.plan();
        let (want, gradient) = step::loss_and_gradient(plan, &twin, 0, &march::batch(plan, 0), F16);
        for (name, g, w) in [("data", got.data, want.data), ("occlusion", got.occlusion, want.occlusion)] {
            assert!((g - w).abs() <= 1e-4 * w.abs() + 1e-12, "{preset} {settings:?} {name}: {g} against {w}");
        }
        let on_device: Vec<f32> = gpu.download(&trainer.training().gradient, 0, plan.params.len).unwrap();
        for tensor in plan.params.tensors() {
            let (mut error, mut norm) = (0.0, 0.0);
            for at in &tensor.positions {
                let want = gradient[*at as usize];
                error += (f64::from(on_device[*at as usize]) - want).powi(2);
                norm += want * want;
            }
            let relative = (error / norm).sqrt();
            assert!(norm > 0.0, "{preset} {settings:?} {} has no gradient at all", tensor.name);
            // The twin rounds to f16 where the kernels do; sums in f32 now and then round to the other neighbour.
            assert!(relative < 2e-4, "{preset} {settings:?} {}: {relative:.1e} off", tensor.name);
        }
        // The same in plain f64: what f16 costs.
        let (_, exact) = step::loss_and_gradient(plan, &twin, 0, &march::batch(plan, 0), Precision::Exact);
        let norm = |v: &dyn Fn(usize) -> f64| (0..exact.len()).map(|i| v(i).powi(2)).sum::<f64>().sqrt();
        let off = norm(&|i| exact[i] - f64::from(on_device[i])) / norm(&|i| exact[i]);
        assert!(off < 3e-2, "{preset} {settings:?}: f16 puts the gradient {off:.1e} off");
    }
    expect_silence(gpu);
}

#[test]
fn training_repeats_bit_by_bit_resumes_and_follows_f32() {
    let Some((gpu, tuning)) = matrices() else { return };
    let dataset = small_dataset(13, 11);
    let config = small_config("fast-mlp", &["dynamic.lr=3e-3", "train.iterations=120", "train.rays=64"]);
    let start = |layers| {
        let tuning = tuning.clone().with_layers(layers, String::new());
        Trainer::new(&gpu, Plan::new(&config, &dataset).unwrap(), &dataset, tuning).unwrap()
    };
    let mut whole = start(Layers::Matrices);
    let losses = run(&mut whole, 120);
    let mut parts = start(Layers::Matrices);
    let mut again = run(&mut parts, 47);
    let saved = parts.checkpoint().unwrap();
    let plan = Plan::new(&config, &dataset).unwrap().in_scene(saved.model.scene.clone());
    let mut resumed = Trainer::resume(&gpu, plan, &dataset, tuning.clone(), &saved).unwrap();
    again.extend(run(&mut resumed, 120));
    assert_eq!(losses, again, "losses differ between equal runs");
    assert_eq!(whole.model().unwrap().params, resumed.model().unwrap().params);
    assert_eq!(whole.checkpoint().unwrap().loss_scale, resumed.checkpoint().unwrap().loss_scale);
    let f32_losses = run(&mut start(Layers::F32), 120);
    let mean = |l: &[f64]| l.iter().sum::<f64>() / l.len() as f64;
    let (end, f32_end) = (mean(&losses[100..]), mean(&f32_losses[100..]));
    assert!(end < 0.3 * mean(&losses[..5]), "{end}");
    assert!((end - f32_end).abs() < 0.15 * f32_end, "{end} against {f32_end} in f32");
    drop((whole, parts, resumed));
    expect_silence(gpu);
}

#[test]
fn an_overflow_skips_the_update_and_halves_the_scale() {
    let Some((gpu, tuning)) = matrices() else { return };
    let dataset = small_dataset(13, 11);
    let plan = Plan::new(&small_config("fast-mlp", &[]), &dataset).unwrap();
    let (before, first) = (plan.params.initial(&plan.config), plan.params.static_len);
    let mut trainer = Trainer::new(&gpu, plan, &dataset, tuning).unwrap();
    let huge = DeviceState { step: 0, loss_scale: 2f32.powi(60), overflowed: 0, good_updates: 7 };
    gpu.upload(&trainer.forward().state, 0, &[huge]).unwrap();
    trainer.advance(1).unwrap();
    let after = trainer.model().unwrap().params;
    assert_eq!(before[first..], after[first..], "the network moved");
    assert_ne!(before[..first], after[..first], "the static field needs no scale");
    let state = |trainer: &Trainer| -> DeviceState { gpu.download(&trainer.forward().state, 0, 1).unwrap()[0] };
    assert_eq!(state(&trainer), DeviceState { step: 1, loss_scale: 2f32.powi(59), overflowed: 0, good_updates: 0 });
    // Back and back until gradients fit; then the network moves again.
    run(&mut trainer, 40);
    assert!(state(&trainer).good_updates > 0, "{:?}", state(&trainer));
    assert_ne!(before[first..], trainer.model().unwrap().params[first..]);
    drop(trainer);
    expect_silence(gpu);
}

#[test]
fn renderings_equal_the_twin() {
    let Some((gpu, tuning)) = matrices() else { return };
    let dataset = small_dataset(12, 10);
    let config = small_config("public-code", &["loss.normalise=true", "train.chunk_samples=1500"]);
    let mut trainer = Trainer::new(&gpu, Plan::new(&config, &dataset).unwrap(), &dataset, tuning.clone()).unwrap();
    run(&mut trainer, 20);
    let model = trainer.model().unwrap();
    let renderer = Renderer::new(&gpu, &model, tuning).unwrap();
    let view = &dataset.views[2].rays;
    let got = renderer.render(view, 12, 10, 2).unwrap().dynamic_integral;
    let mut plan = Plan::new(&config, &dataset).unwrap().in_scene(model.scene.clone());
    plan.setup.jitter = 0;
    plan.setup.n_dynamic_samples = config.march.render_samples;
    let params: Vec<f64> = model.params.iter().map(|v| f64::from(*v)).collect();
    let want: Vec<f64> = (0..120u32)
        .map(|pixel| {
            let (anchor, direction) = view.pixel(f64::from(pixel % 12), f64::from(pixel / 12));
            let ray = march::Ray { anchor, direction, phase: 2, target: 0.0, temporal: [0.0; 2], id: pixel };
            march::fwd(&plan, &params, 20, &ray, false, F16).dynamic_integral
        })
        .collect();
    let (error, at) = relative_error(&got, &want);
    // A pixel whose ray grazes a box face may gain or lose one sample in f32.
    assert!(error < 2e-3, "[{at}]: {} against {}", got[at], want[at]);
    drop((trainer, renderer));
    expect_silence(gpu);
}

#[test]
fn both_paths_are_timed_and_the_verdict_is_kept() {
    let Some((gpu, tuning)) = matrices() else { return };
    let config = small_config("fast-mlp", &[]);
    let verdict = calibrate::measure(&gpu, &config, &small_dataset(13, 11), &tuning).unwrap();
    assert!(verdict.f32_ms > 0.0 && verdict.matrices_ms > 0.0);
    for (f32_ms, matrices_ms, faster) in
        [(2.0, 1.0, Layers::Matrices), (1.0, 2.0, Layers::F32), (1.0, 1.0, Layers::F32)]
    {
        let applied = Verdict { f32_ms, matrices_ms }.apply(tuning.clone());
        assert_eq!(applied.layers, faster);
        let told = format!("{f32_ms:.3} ms per iteration in f32, {matrices_ms:.3} ms on matrices");
        assert!(applied.reasons.iter().any(|r| r.contains(&told)), "{:?}", applied.reasons);
    }
    let cache = tempfile::tempdir().unwrap();
    assert_eq!(calibrate::recall(cache.path(), gpu.info(), &config), None);
    calibrate::remember(cache.path(), gpu.info(), &config, verdict).unwrap();
    let recalled = calibrate::recall(cache.path(), gpu.info(), &config).unwrap();
    assert!((recalled.f32_ms - verdict.f32_ms).abs() < 1e-9);
    let wider = small_config("fast-mlp", &["dynamic.width=64"]);
    assert_eq!(calibrate::recall(cache.path(), gpu.info(), &wider), None, "another network, another verdict");
    std::fs::write(cache.path().join("paths.json"), "{").unwrap();
    assert_eq!(calibrate::recall(cache.path(), gpu.info(), &config), None);
    expect_silence(gpu);
}
