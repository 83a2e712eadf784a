//! The network on cooperative matrices against the f64 twin and the f32 path, with validation on. `tools/test` runs
//! this on the newest lavapipe; on a device without matrices it says so and checks nothing, unless
//! `NERTCA_MATRICES=require`.
#![allow(missing_docs, clippy::unwrap_used, clippy::expect_used)]

mod common;

use common::{expect_silence, gpu, small_config, small_dataset};
use nertca_vk::cpu::{march, step};
use nertca_vk::gpu::device::Gpu;
use nertca_vk::kernels::{Layers, Tuning};
use nertca_vk::output::render::Renderer;
use nertca_vk::train::plan::Plan;
use nertca_vk::train::trainer::Trainer;

/// A device and its matrix path, if it has one.
fn matrices() -> Option<(Gpu, Tuning)> {
    let gpu = gpu();
    if gpu.info().matrices.is_empty() {
        assert!(std::env::var("NERTCA_MATRICES").is_err(), "{} has no cooperative matrices", gpu.info().name);
        eprintln!("SKIPPED: {} has no cooperative matrices", gpu.info().name);
        return None;
    }
    let tuning = Tuning::for_device(gpu.info()).with_layers(Some(Layers::Matrices));
    Some((gpu, tuning))
}

/// Each covers what the others do not: no skip and a skip layer; the skip layer last; one layer; odd bands; several
/// chunks; more tiles than workgroups; fewer samples than a tile.
const CASES: &[(&str, &[&str])] = &[
    ("fast", &["dynamic.width=48", "dynamic.bands=5"]),
    ("public-code", &["dynamic.occlusion=1e-3", "loss.normalise=true"]),
    ("fast", &["dynamic.layers=3", "dynamic.skip_layer=3", "dynamic.width=64", "train.rays=100"]),
    ("paper", &["dynamic.layers=1", "dynamic.width=16", "loss.normalise=true", "dynamic.latent=12"]),
    ("fast", &["train.rays=1", "march.dynamic_samples=7"]),
];

#[test]
fn losses_and_gradients_match() {
    let Some((gpu, tuning)) = matrices() else { return };
    let dataset = small_dataset(13, 11);
    for (preset, settings) in CASES {
        let plan = Plan::new(&small_config(preset, settings), &dataset).unwrap();
        let params = plan.params.initial(&plan.config);
        let twin: Vec<f64> = params.iter().map(|v| f64::from(*v)).collect();
        let mut trainer = Trainer::new(&gpu, plan, &dataset, tuning.clone()).unwrap();
        let got = trainer.advance(1).unwrap()[0];
        let plan = trainer.plan();
        let (want, gradient) = step::loss_and_gradient(plan, &twin, 0, &march::batch(plan, 0));
        for (name, g, w) in [("data", got.data, want.data), ("occlusion", got.occlusion, want.occlusion)] {
            assert!((g - w).abs() <= 1e-3 * w.abs() + 1e-12, "{preset} {settings:?} {name}: {g} against {w}");
        }
        let on_device: Vec<f32> = gpu.download(trainer.buffers().get("gradient").unwrap(), 0, plan.params.len).unwrap();
        for tensor in plan.params.tensors() {
            // f16 has eleven bits and a network of a few layers adds some thousand roundings: errors of single
            // entries scatter, their norm does not. A ReLU on the other side of its kink changes a whole column.
            let (mut error, mut norm) = (0.0, 0.0);
            for at in &tensor.positions {
                let want = gradient[*at as usize];
                error += (f64::from(on_device[*at as usize]) - want).powi(2);
                norm += want * want;
            }
            let relative = (error / norm).sqrt();
            println!("{preset} {settings:?} {}: {relative:.1e}", tensor.name);
            assert!(norm > 0.0, "{preset} {settings:?} {} has no gradient at all", tensor.name);
            assert!(relative < 5e-3, "{preset} {settings:?} {}: {relative:.1e} off", tensor.name);
        }
    }
    expect_silence(gpu);
}
