//! Two networks as the fields (the preset `nerf-ca`): every stage equals its twin, runs learn, repeat and resume with equal
//! bits, and learning ends where an entropy vanishes. On cooperative matrices as well, where a device has them.

use crate::common::{expect_agreement, expect_silence, gpu, run, small_config, small_dataset, tuning, uneven_dataset};
use nertca_vk::checkpoint::Checkpoint;
use nertca_vk::config::{Config, Preset};
use nertca_vk::fields::state::FieldsState;
use nertca_vk::gpu::buffer::Operands;
use nertca_vk::gpu::device::Gpu;
use nertca_vk::kernels::stages::matrix_shape;
use nertca_vk::kernels::tuning::{Layers, Tuning};
use nertca_vk::model::component::Component;
use nertca_vk::plan::Plan;
use nertca_vk::render::baked::Baked;
use nertca_vk::render::grid::Grid;
use nertca_vk::render::quantity::{Projection, Quantity};
use nertca_vk::render::renderer::Renderer;
use nertca_vk::scan::dataset::Dataset;
use nertca_vk::train::trainer::Trainer;
use nertca_vk_twins::selftest::{drawing, networks};
use std::sync::Arc;

/// Paths of a device: as for an old lavapipe, as for GPUs, and matrices where available.
fn paths(gpu: &Gpu) -> Vec<Tuning> {
    let f32_layers = |operands, lanes| Tuning {
        operands,
        layer_lanes: lanes,
        weight_lanes: lanes,
        chunk_samples: 1 << 16,
        ..tuning(gpu).with_layers(Layers::F32, String::new())
    };
    let mut paths = vec![f32_layers(Operands::Texel, 8), f32_layers(Operands::Storage, 32)];
    if matrix_shape(gpu.info()).is_some() {
        paths.push(tuning(gpu).with_layers(Layers::Matrices, String::new()));
    } else {
        assert!(std::env::var("NERTCA_MATRICES").is_err(), "{} has no cooperative matrices", gpu.info().name);
        eprintln!("{} has no cooperative matrices: two networks are compared in f32 alone", gpu.info().name);
    }
    paths
}

fn state(checkpoint: &Checkpoint) -> FieldsState {
    checkpoint.state::<FieldsState>().unwrap().clone()
}

#[test]
fn every_stage_of_an_iteration_matches() {
    let gpu = gpu();
    for path in paths(&gpu) {
        for dataset in [small_dataset(13, 11), uneven_dataset(13, 11)] {
            expect_agreement(|findings| {
                networks::CASES.iter().try_for_each(|case| networks::compare(&gpu, &dataset, case, &path, findings))
            });
        }
    }
    expect_silence(gpu);
}

#[test]
fn views_and_volumes_equal_the_twin() {
    let gpu = gpu();
    for path in paths(&gpu) {
        expect_agreement(|findings| {
            drawing::compare_views(&gpu, Preset::NerfCa, &path, findings)?;
            drawing::compare_volumes(&gpu, &path, findings)
        });
    }
    expect_silence(gpu);
}

/// A configuration that learns quickly and contains all changes of the loss weights.
fn quick(settings: &[&str]) -> Config {
    let quick = [
        "networks.gain=0.5",
        "networks.delay=20",
        "networks.ramp=60",
        "networks.stop_after=0",
        "dynamic.lr=3e-3",
        "static.lr=3e-3",
        "train.iterations=120",
        "train.rays=64",
    ];
    small_config("nerf-ca", &[&quick, settings].concat())
}

fn start(gpu: &Gpu, config: &Config, dataset: &Dataset) -> Trainer {
    Trainer::new(gpu, Plan::new(config, dataset).unwrap(), dataset, tuning(gpu)).unwrap()
}

fn resume(gpu: &Gpu, config: &Config, dataset: &Dataset, saved: &Checkpoint) -> Trainer {
    let plan = Plan::new(config, dataset).unwrap().in_scene(saved.model.scene.clone());
    Trainer::resume(gpu, plan, dataset, tuning(gpu), saved).unwrap()
}

/// Writes a checkpoint to bytes and reads it back.
fn through_a_file(saved: &Checkpoint) -> Checkpoint {
    Checkpoint::from_bytes(&saved.to_bytes().unwrap(), "checkpoint".as_ref()).unwrap()
}

#[test]
fn runs_learn_repeat_and_resume_bit_by_bit() {
    let gpu = gpu();
    let dataset = uneven_dataset(13, 11);
    let config = quick(&[]);
    let mut whole = start(&gpu, &config, &dataset);
    let losses = run(&mut whole, 120);
    let mut parts = start(&gpu, &config, &dataset);
    let mut again = run(&mut parts, 47);
    let saved = through_a_file(&parts.checkpoint().unwrap());
    let mut resumed = resume(&gpu, &config, &dataset, &saved);
    again.extend(run(&mut resumed, 120));
    assert_eq!(losses, again, "losses differ between equal runs");
    let (want, got) = (whole.checkpoint().unwrap(), resumed.checkpoint().unwrap());
    assert!(want.model.params == got.model.params && state(&want).moments == state(&got).moments);
    let mean = |l: &[f64]| l.iter().sum::<f64>() / l.len() as f64;
    assert!(mean(&losses[100..]) < 0.3 * mean(&losses[..5]), "{:?} {:?}", &losses[..5], &losses[115..]);
    // Both fields learn, and rendering shows the trained parameters.
    let split = want.model.param_map.static_len;
    let first = whole.plan().params.initial(config.seed);
    let moved = |range: std::ops::Range<usize>| range.filter(|i| want.model.params[*i] != first[*i]).count();
    assert!(moved(0..split) > split / 2 && moved(split..first.len()) > (first.len() - split) / 2);
    drop((whole, parts, resumed));
    expect_silence(gpu);
}

#[test]
fn learning_ends_where_an_entropy_vanishes() {
    let gpu = gpu();
    let dataset = small_dataset(13, 11);
    // Any entropy is below this threshold.
    let config = quick(&["networks.stop_after=30", "networks.stop_below=1", "networks.gain=0.01"]);
    let to_the_end = |trainer: &mut Trainer| {
        let mut losses = Vec::new();
        while trainer.step() < 120 {
            losses.extend(trainer.advance(120).unwrap());
        }
        losses
    };
    let mut whole = start(&gpu, &config, &dataset);
    let losses = to_the_end(&mut whole);
    let stopped: Vec<_> = losses.iter().map(|loss| (loss.networks.unwrap().stopped, loss.total())).collect();
    // The iteration that detects it is the last to learn; all following ones report it.
    assert_eq!(stopped.iter().position(|(stopped, _)| *stopped), Some(30));
    assert!(stopped[30..].iter().all(|after| *after == stopped[30]));
    let mut until = start(&gpu, &config, &dataset);
    run(&mut until, 31);
    let then = through_a_file(&until.checkpoint().unwrap());
    assert!(state(&then).stopped);
    assert_eq!(then.model.params, whole.model().unwrap().params);
    let mut resumed = resume(&gpu, &config, &dataset, &then);
    assert_eq!(to_the_end(&mut resumed), losses[31..], "what a resumed run says differs");
    assert_eq!(then.model.params, resumed.model().unwrap().params);
    // The first is saved long after learning ended, the second before the run continues.
    let at_the_end = state(&whole.checkpoint().unwrap()).last_report;
    assert!(!at_the_end.is_empty() && at_the_end == state(&resumed.checkpoint().unwrap()).last_report);
    let at_once = resume(&gpu, &config, &dataset, &then).checkpoint().unwrap();
    assert_eq!(state(&at_once).last_report, state(&then).last_report);
    let on = quick(&["networks.gain=0.01"]);
    let mut learning = start(&gpu, &on, &dataset);
    run(&mut learning, 120);
    assert_ne!(then.model.params, learning.model().unwrap().params);
    drop((whole, until, resumed, learning));
    expect_silence(gpu);
}

/// Fields that are constant everywhere, which images and volumes must show.
#[test]
fn fields_of_one_number_are_drawn_as_such() {
    let gpu = gpu();
    let dataset = small_dataset(13, 11);
    let mut trainer = start(&gpu, &quick(&["march.render_samples=200", "march.along_axis=true"]), &dataset);
    let mut model = trainer.model().unwrap();
    model.params.fill(0.0);
    let [still, moving] = [1.0f32, -1.0];
    model.params[model.param_map.static_network.as_ref().unwrap().out_bias] = still;
    model.params[model.param_map.dynamic_network.as_ref().unwrap().out_bias] = moving;
    let renderer = Renderer::new(&gpu, &model, tuning(&gpu)).unwrap();
    let view = renderer.render(&dataset.views[1].rays, 13, 11, 1).unwrap();
    let attenuation = |feature: f32| 0.5 * (1.0 + feature.exp()).ln();
    // Depths extend over 1.8 world units along the axis.
    for (got, feature) in [(&view.static_integral, still), (&view.dynamic_integral, moving)] {
        assert!(got.iter().all(|v| (v / (1.8 * attenuation(feature)) - 1.0).abs() < 1e-4), "{:?}", &got[..3]);
    }
    for (got, want) in [
        (&view.static_max, attenuation(still)),
        (&view.dynamic_max, attenuation(moving)),
        (&view.total_max, attenuation(still) + attenuation(moving)),
    ] {
        assert!(got.iter().all(|v| (v / want - 1.0).abs() < 1e-5), "{:?} {want}", &got[..3]);
    }
    let renderer = Arc::new(renderer);
    let baked = Baked::new(renderer.clone(), 24).unwrap();
    for (component, feature) in [(Component::Static, still), (Component::Dynamic, moving)] {
        let quantity = Quantity { component, projection: Projection::Drr };
        let image = baked.render(&dataset.views[1].rays, 13, 11, 1, quantity).unwrap();
        let want = 1.8 * attenuation(feature);
        // Volumes are f16.
        assert!(image.iter().all(|v| (v / want - 1.0).abs() < 1e-3), "{:?} {want}", &image[..3]);
    }
    let grid = Grid { origin: glam::DVec3::splat(-0.2), spacing: glam::DVec3::splat(0.1), size: [5, 4, 3] };
    let total = renderer.sample(Component::Total, 2, &grid).unwrap();
    assert!(total.iter().all(|v| (v / (attenuation(still) + attenuation(moving)) - 1.0).abs() < 1e-5), "{total:?}");
    drop((baked, renderer, trainer));
    expect_silence(gpu);
}
