//! Gaussians as a model's dynamic field: rendering against f64, checkpoints, whole runs.

use crate::common;
use crate::common::{expect_agreement, expect_silence, gpu, phantom, run, tuning};
use glam::DVec3;
use nertca_vk::checkpoint::{self, Checkpoint};
use nertca_vk::config::sections::GaussiansSettings;
use nertca_vk::config::{AdjustMode, Config, Preset};
use nertca_vk::error::Error;
use nertca_vk::fields::state::FieldsState;
use nertca_vk::gaussians::field::{GaussianField, Gaussians, MovingGaussians};
use nertca_vk::gpu::device::Gpu;
use nertca_vk::kernels::layout::DeviceState;
use nertca_vk::methods::dynamic_gaussians::trainer::GaussiansFit;
use nertca_vk::model::Model;
use nertca_vk::model::component::Component;
use nertca_vk::plan::Plan;
use nertca_vk::render::grid::PatientGrid;
use nertca_vk::render::renderer::Renderer;
use nertca_vk::scan::dataset::Dataset;
use nertca_vk::train::trainer::Trainer;
use nertca_vk_runs::run::events::Event;
use nertca_vk_runs::run::reconstruct::{RunOptions, reconstruct};
use nertca_vk_twins::selftest::blobs;
use nertca_vk_twins::selftest::problems::{drawn_fields, with_values};
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, OnceLock};

/// The default phantom in 40 x 40 pixels, made once.
pub fn small_phantom() -> &'static Dataset {
    static DATASET: OnceLock<(tempfile::TempDir, Dataset)> = OnceLock::new();
    let (_, dataset) = DATASET.get_or_init(|| {
        let (gpu, directory) = (gpu(), tempfile::tempdir().unwrap());
        let dataset = phantom(&gpu, &directory.path().join("phantom"), 40, 4);
        expect_silence(gpu);
        (directory, dataset)
    });
    dataset
}

/// Creates a model of a dataset with the dynamic field `field`.
fn model(gpu: &Gpu, dataset: &Dataset, field: GaussianField) -> Model {
    blobs::model(gpu, dataset, field, &tuning(gpu)).unwrap()
}

#[test]
fn integrals_and_maxima_match_their_twin() {
    let gpu = gpu();
    expect_agreement(|findings| blobs::compare_rays(&gpu, &tuning(&gpu), findings));
    let dataset = common::small_dataset(37, 29);
    for field in drawn_fields() {
        let renderer = Renderer::new(&gpu, &model(&gpu, &dataset, field), tuning(&gpu)).unwrap();
        let seen = renderer.render(&dataset.views[1].rays, 37, 29, 2).unwrap();
        // The static field is nearly flat, so the maximum of the sum is nearly the sum of the maxima.
        for ((total, still), moving) in seen.total_max.iter().zip(&seen.static_max).zip(&seen.dynamic_max) {
            assert!(*total >= still.max(*moving) * 0.999 && *total <= (still + moving) * 1.001);
        }
        assert!(seen.dynamic_max.iter().filter(|m| **m > 0.0).count() > 60, "the case must show something");
    }
    expect_silence(gpu);
}

/// A renderer keeps the background of a view, which is that of the same model alone.
#[test]
fn a_view_is_drawn_as_by_a_renderer_that_drew_nothing_else() {
    let gpu = gpu();
    let dataset = common::small_dataset(37, 29);
    let new = |model: &Model| Renderer::new(&gpu, model, tuning(&gpu)).unwrap();
    let seen = |renderer: &Renderer, view: usize| {
        let seen = renderer.render(&dataset.views[view].rays, 37, 29, 2).unwrap();
        [seen.static_integral, seen.dynamic_integral, seen.static_max, seen.dynamic_max, seen.total_max]
    };
    let [field, _] = drawn_fields();
    let first = model(&gpu, &dataset, field);
    let mut other = first.clone();
    other.params.iter_mut().for_each(|p| *p *= 1.5);
    let renderer = new(&first);
    // At another phase, and through another view.
    renderer.render(&dataset.views[1].rays, 37, 29, 0).unwrap();
    renderer.render(&dataset.views[0].rays, 37, 29, 0).unwrap();
    assert_eq!(seen(&renderer, 1), seen(&new(&first), 1));
    renderer.set_model(&other).unwrap();
    assert_eq!(seen(&renderer, 1), seen(&new(&other), 1));
    assert_ne!(seen(&new(&other), 1)[0], seen(&new(&first), 1)[0]);
    drop(renderer);
    expect_silence(gpu);
}

#[test]
fn cells_match_their_twin() {
    let gpu = gpu();
    expect_agreement(|findings| blobs::compare_cells(&gpu, &tuning(&gpu), findings));
    expect_silence(gpu);
}

#[test]
fn bounds_hold_all_around_their_points() {
    let gpu = gpu();
    let dataset = common::small_dataset(13, 11);
    // Four fine points along each side of the cube around a coarse point.
    let (step, n) = (0.125, 96);
    let first = -0.5 * step * f64::from(n);
    let (origin_mm, spacing_mm) = (DVec3::splat(first), DVec3::splat(step));
    let fine = PatientGrid { origin_mm, spacing_mm, size: [n; 3] };
    let coarse = PatientGrid { origin_mm: origin_mm + 1.5 * step, spacing_mm: 4.0 * spacing_mm, size: [n / 4; 3] };
    let away_mm = 1.5 * step * 3f64.sqrt();
    for field in drawn_fields() {
        let renderer = Renderer::new(&gpu, &model(&gpu, &dataset, field), tuning(&gpu)).unwrap();
        let values = renderer.sample_patient(Component::Dynamic, 1, &fine).unwrap();
        let [min, max] = renderer.bound_patient(1, &coarse, away_mm).unwrap().unwrap();
        let largest = values.iter().copied().fold(0.0, f32::max);
        for (i, value) in values.iter().enumerate() {
            let n = n as usize;
            let [x, y, z] = [i % n, i / n % n, i / (n * n)].map(|k| k / 4);
            let at = (z * (n / 4) + y) * (n / 4) + x;
            let rounding = 1e-5 * largest;
            assert!(min[at] <= value + rounding, "{i}: at least {} instead of {value}", min[at]);
            assert!(max[at] >= value - rounding, "{i}: at most {} instead of {value}", max[at]);
        }
        // The bounds are informative.
        assert!(min.iter().any(|v| *v > 0.01 * largest) && max.contains(&0.0), "nothing is told");
    }
    expect_silence(gpu);
}

/// A deformable set with fillings.
fn filled_field() -> GaussianField {
    let [_, GaussianField::Moving(mut set)] = drawn_fields() else { unreachable!() };
    let value = |i: usize| 0.55 + 0.45 * (0.7 * i as f32).sin();
    set.filling = Some((0..set.rest.rows.len() * set.rest.n_phases).map(value).collect());
    GaussianField::Moving(set)
}

#[test]
fn impossible_fillings_are_refused_by_name() {
    let gpu = gpu();
    let model = model(&gpu, &common::small_dataset(13, 11), filled_field());
    let state = FieldsState::fresh(model.step, model.param_map.len);
    for bad in [-0.1, 0.0, 1.2, f32::NAN] {
        let mut model = model.clone();
        if let Some(GaussianField::Moving(MovingGaussians { filling: Some(filling), .. })) = &mut model.gaussians {
            filling[5] = bad;
        }
        let saved = Checkpoint { model, fit: Arc::new(state.clone()), data_fingerprint: String::new() };
        let refused = Checkpoint::from_bytes(&saved.to_bytes().unwrap(), Path::new("test")).err().unwrap().to_string();
        assert!(refused.contains("gaussians.filling"), "{bad}: {refused}");
    }
    expect_silence(gpu);
}

#[test]
fn checkpoints_keep_every_bit() {
    let gpu = gpu();
    let dataset = common::small_dataset(13, 11);
    for field in drawn_fields().into_iter().chain([filled_field()]) {
        let model = model(&gpu, &dataset, field);
        let moments = vec![[0.25, 0.5]; model.param_map.len];
        let state = FieldsState { moments, ..FieldsState::fresh(model.step, 0) };
        let saved = Checkpoint { model, fit: Arc::new(state), data_fingerprint: "x".into() };
        let bytes = saved.to_bytes().unwrap();
        let read = Checkpoint::from_bytes(&bytes, Path::new("test")).unwrap();
        assert_eq!(read.to_bytes().unwrap(), bytes);
        for phase in 0..3 {
            let at = |c: &Checkpoint| c.model.gaussians.as_ref().unwrap().at(phase);
            assert_eq!(at(&read), at(&saved));
            let imaged = |c: &Checkpoint| c.model.gaussians.as_ref().unwrap().imaged_at_time(phase as f64 + 0.25);
            assert_eq!(imaged(&read), imaged(&saved));
        }
        let statics = saved.model.param_map.static_len;
        assert_eq!(read.model.params[..statics], saved.model.params[..statics]);
    }
    expect_silence(gpu);
}

#[test]
fn damaged_gaussians_are_refused_by_name() {
    let gpu = gpu();
    let model = model(&gpu, &common::small_dataset(13, 11), drawn_fields()[0].clone());
    let state = FieldsState::fresh(model.step, model.param_map.len);
    let refused = |change: &dyn Fn(&mut Gaussians)| {
        let mut model = model.clone();
        if let Some(GaussianField::PerPhase(sets)) = &mut model.gaussians {
            change(sets);
        }
        let saved = Checkpoint { model, fit: Arc::new(state.clone()), data_fingerprint: String::new() };
        Checkpoint::from_bytes(&saved.to_bytes().unwrap(), Path::new("test")).err().unwrap().to_string()
    };
    assert!(refused(&|s| s.rows[3].log_density = f32::NAN).contains("gaussians.log_density"));
    assert!(refused(&|s| s.rows[3].phase = 3).contains("gaussians.phase"));
    assert!(refused(&|s| s.units.pixel = 0.0).contains("gaussians"));
    expect_silence(gpu);
}

/// A run short enough for tests: 20 iterations of Gaussians, 12 of the static field.
fn short_run(form: &str) -> Config<GaussiansSettings> {
    let settings = [
        "train.iterations=32",
        "train.checkpoint_every=1000",
        "gaussians.iterations=20",
        "gaussians.background_every=8",
        "gaussians.grow_at=10",
        "gaussians.clear_at=14",
        "gaussians.count=120",
        "deformable.warm_iterations=12",
        "deformable.track_iterations=4",
        // With the preset's smoothness, the static field learns too little to be visible in so few iterations.
        "static.tv=1",
    ];
    let form = format!("gaussians.form={form}");
    with_values(&Config::preset(Preset::Fast), settings.into_iter().chain([form.as_str()])).unwrap().of().unwrap()
}

#[test]
fn resume_equals_no_interruption() {
    let gpu = gpu();
    let directory = tempfile::tempdir().unwrap();
    let dataset = small_phantom();
    // With an adjustment of views, the fit is done before the run, and its iterations pass at once.
    let (off, auto) = (AdjustMode::Off, AdjustMode::Auto);
    for (form, fits, adjust) in [("phase", 1, off), ("tree", 1, off), ("tree", 2, off), ("tree", 1, auto)] {
        let mut config = short_run(form);
        (config.gaussians.fits, config.adjustment.adjust) = (fits, adjust);
        let go = |name: &str, resume: bool, stop: Option<&dyn Fn(&Event) -> bool>| {
            let path = directory.path().join(format!("{form}-{fits}-{adjust:?}-{name}"));
            let cancel = AtomicBool::new(false);
            let options = RunOptions { tuning: &tuning(&gpu), run: &path, resume, stop_at: None, cancel: &cancel };
            let config = config.clone().into_any();
            let outcome = reconstruct(&gpu, &config, dataset, &options, &mut |event| {
                if stop.is_some_and(|stop| stop(event)) {
                    cancel.store(true, Ordering::Relaxed);
                }
            });
            match (outcome, stop) {
                (Ok(()), None) | (Err(Error::Interrupted), Some(_)) => {}
                (outcome, _) => panic!("{form}, {fits} fits, {adjust:?}, {name}: {outcome:?}"),
            }
            std::fs::read(checkpoint::newest(&path).unwrap()).unwrap()
        };
        let whole = go("whole", false, None);
        let after = |n: u32| move |e: &Event| matches!(e, Event::Progress { loss, .. } if loss.step >= n);
        let (first, second) = (after(10), after(25));
        let preparing = |share: f64| move |e: &Event| matches!(e, Event::Preparing { share: done } if *done >= share);
        let (warming, tracking) = (preparing(0.2), preparing(0.6));
        type Stop<'a> = (&'a str, &'a dyn Fn(&Event) -> bool);
        let mut stops: Vec<Stop<'_>> =
            vec![("while Gaussians are fitted", &first), ("while the still field is trained", &second)];
        if form == "tree" && adjust == off {
            stops.extend([("among the phases' own", &warming as &dyn Fn(&Event) -> bool), ("on the way", &tracking)]);
        }
        for (name, stop) in stops {
            assert_ne!(go(name, false, Some(stop)), whole);
            assert_eq!(go(name, true, None), whole, "{form}, stopped {name}");
        }
        let read = Checkpoint::from_bytes(&whole, Path::new("whole")).unwrap();
        assert_eq!(read.model.step, 32);
        assert_eq!(matches!(read.model.gaussians, Some(GaussianField::Moving(_))), form == "tree");
    }
    expect_silence(gpu);
}

#[test]
fn the_still_field_learns_what_gaussians_leave() {
    let gpu = gpu();
    let dataset = small_phantom();
    let mut config = short_run("phase");
    // After so few iterations, vessels are not dense yet.
    (config.train.iterations, config.gaussians.clear_at) = (160, 0);
    let config = config.into_any();
    let mut trainer = Trainer::new(&gpu, Plan::new(&config, dataset).unwrap(), dataset, tuning(&gpu)).unwrap();
    let losses = run(&mut trainer, 160);
    assert_eq!(losses.len(), 160);
    assert!(losses[19] < 0.7 * losses[0], "Gaussians: {} to {}", losses[0], losses[19]);
    println!("Gaussians: {} to {}, still field: {} to {}", losses[0], losses[19], losses[20], losses[159]);
    assert!(losses[159] < 0.5 * losses[20], "still field: {} to {}", losses[20], losses[159]);
    let model = trainer.model().unwrap();
    let renderer = Renderer::new(&gpu, &model, tuning(&gpu)).unwrap();
    let frame = dataset.training()[0].clone();
    let seen = renderer.render(&dataset.views[frame.view].rays, dataset.width, dataset.height, frame.phase).unwrap();
    let mean = |v: &[f32]| v.iter().map(|v| f64::from(*v)).sum::<f64>() / v.len() as f64;
    let (measured, total) = (mean(&frame.integrals), mean(&seen.total_integral()));
    assert!((total / measured - 1.0).abs() < 0.05, "{total} against {measured}");
    assert!(mean(&seen.dynamic_integral) > 0.0);
    drop((renderer, trainer));
    expect_silence(gpu);
}

#[test]
fn other_images_begin_the_fit_anew_and_keep_device_and_host_in_step() {
    let gpu = gpu();
    let mut dataset = small_phantom().clone();
    let config = short_run("phase").into_any();
    let mut trainer = Trainer::new(&gpu, Plan::new(&config, &dataset).unwrap(), &dataset, tuning(&gpu)).unwrap();
    run(&mut trainer, 32);
    let saved = trainer.checkpoint().unwrap();
    drop(trainer);
    dataset.frames.remove(3);
    let plan = Plan::new(&config, &dataset).unwrap().in_scene(saved.model.scene.clone());
    let mut trainer = Trainer::carry_on(&gpu, plan, &dataset, tuning(&gpu), &saved).unwrap();
    assert_eq!(trainer.step(), 0);
    let losses = run(&mut trainer, 32);
    assert_eq!(losses.len(), 32);
    assert!(losses.iter().all(|l| l.is_finite() && *l > 0.0), "{losses:?}");
    // Schedules and losses are indexed by the device's count.
    let state: Vec<DeviceState> =
        gpu.download(&trainer.fit::<GaussiansFit>().unwrap().fields().forward().state, 0, 1).unwrap();
    assert_eq!(state[0].step, 32);
    drop(trainer);
    expect_silence(gpu);
}

#[test]
fn the_mean_of_fits_holds_all_of_them_and_their_agreement() {
    let gpu = gpu();
    let dataset = small_phantom();
    let field = |form: &str, seed: u32, fits: u32| {
        let mut config = short_run(form);
        (config.seed, config.gaussians.fits, config.train.iterations) = (seed, fits, 21);
        let config = config.into_any();
        let mut trainer = Trainer::new(&gpu, Plan::new(&config, dataset).unwrap(), dataset, tuning(&gpu)).unwrap();
        let losses = run(&mut trainer, 21);
        assert_eq!(losses.len(), 21, "the iterations of the last fit, and one of the static field");
        (losses, trainer.model().unwrap().gaussians.unwrap())
    };
    for form in ["phase", "tree"] {
        let members = [field(form, 1, 1), field(form, 1001, 1)];
        let (losses, mean) = field(form, 1, 2);
        assert_eq!(losses[..20], members[0].0[..20], "the losses are those of the run's seed");
        // The second fit of a deformable set takes its motion from the first one, so it is not that of its seed alone.
        let is_whole = form == "phase";
        for phase in [0, 2] {
            let known = members.iter().take(if is_whole { 2 } else { 1 });
            let want: Vec<_> = known.flat_map(|(_, member)| member.at(phase)).collect();
            let got = mean.at(phase);
            assert!(if is_whole { got.len() == want.len() } else { got.len() > want.len() }, "{form}: {}", got.len());
            for (got, want) in got.iter().zip(&want) {
                assert!((got.log_density - want.log_density - (2.0f32 / 3.0).ln()).abs() < 1e-5);
                let apart = (0..3).map(|k| (got.position[k] - want.position[k]).abs()).fold(0.0, f32::max);
                assert!(apart < 1e-3, "{form}, phase {phase}: {apart} pixels");
            }
        }
        let agreement = mean.rows().agreement.clone().unwrap();
        println!("{form}: {:.3}", agreement.overall);
        assert!(agreement.overall > 0.3 && agreement.overall < 1.0, "{}", agreement.overall);
        assert_eq!(agreement.of_gaussians.len(), mean.rows().rows.len());
        assert_eq!(members[0].1.rows().agreement, None);
    }
    expect_silence(gpu);
}
