//! Adjustment of views with the field of a fit in the loop: columns against f64 twins, planted errors of poses, whole adjustments.

use crate::common::{add_training_frames, expect_silence, gpu, run, tuning};
use crate::disagreeing::{PHASES, Shot, Studio, Wrong};
use glam::DVec3;
use nertca_vk::calibrate::correction::Calibration;
use nertca_vk::calibrate::pose::Poses;
use nertca_vk::calibrate::{adjusted, calibrate};
use nertca_vk::config::sections::GaussiansSettings;
use nertca_vk::config::{AdjustMode, Config, Preset};
use nertca_vk::fields::scale::dynamic_half;
use nertca_vk::fitting::fit::{AdjustTask, FitField, MadeFit, Start, Use};
use nertca_vk::gaussians::field::MovingGaussians;
use nertca_vk::gaussians::view::SplatView;
use nertca_vk::geometry::MM_PER_UNIT;
use nertca_vk::gpu::device::Gpu;
use nertca_vk::methods;
use nertca_vk::methods::dynamic_gaussians::adjust::poses::Stands;
use nertca_vk::methods::dynamic_gaussians::adjust::residual::misfit;
use nertca_vk::methods::dynamic_gaussians::adjust::step::FieldInLoop;
use nertca_vk::methods::dynamic_gaussians::deformable::DeformableTrainer;
use nertca_vk::methods::dynamic_gaussians::made::MadeGaussians;
use nertca_vk::methods::dynamic_gaussians::rules::Rules;
use nertca_vk::methods::dynamic_gaussians::soft_hull::carve::SoftMotion;
use nertca_vk::methods::dynamic_gaussians::targets::Targets;
use nertca_vk::plan::Plan;
use nertca_vk::scan::dataset::Dataset;
use nertca_vk::train::trainer::Trainer;
use nertca_vk_runs::session::{Progress, Session, SessionOptions, State};
use nertca_vk_twins::reference::gaussians::{params, project};
use nertca_vk_twins::selftest::problems::with_values;
use std::sync::{Arc, Condvar, Mutex, OnceLock};
use std::time::Duration;

const SIZE: usize = 64;

fn fast() -> Config<GaussiansSettings> {
    Config::preset(Preset::Fast).of().unwrap()
}

/// A shot of three views that agree, made once.
pub fn views_that_agree() -> &'static Shot {
    static SHOT: OnceLock<Shot> = OnceLock::new();
    SHOT.get_or_init(|| {
        let gpu = gpu();
        let shot = Studio::new(&gpu, SIZE, 1).shoot(3, Wrong::default());
        expect_silence(gpu);
        shot
    })
}

/// A short fit to the stated geometry of a dataset.
fn fitted(gpu: &Gpu, dataset: &Dataset) -> DeformableTrainer {
    let mut config = Rules::of(&fast());
    config.gaussians.iterations = 60;
    // As broad as where poses are adjusted.
    config.gaussians.min_scale = 1.2;
    // Where a Gaussian is cut off, its image has no derivative.
    config.gaussians.cut = 5.0;
    let motion = SoftMotion::new(dataset, dynamic_half(0.0, dataset), 96);
    let targets = Targets::new(dataset, &motion, &config.gaussians).unwrap();
    let mut trainer = DeformableTrainer::new(gpu, targets, &config).unwrap();
    while trainer.step() < config.gaussians.iterations {
        trainer.advance(config.gaussians.iterations).unwrap();
    }
    trainer
}

/// Errors of poses of about a pixel, with displacements and contrasts that differ from frame to frame.
fn wrong_poses(n_views: usize) -> Poses {
    let mut poses = Poses::stated(n_views, PHASES as usize);
    let wave = |k: usize| (1.7 * k as f64 + 0.4).sin();
    for (v, pose) in poses.views.iter_mut().enumerate() {
        pose.angles_deg = [0.2 * wave(v), -0.2 * wave(v + 5)];
        pose.shift = DVec3::new(wave(v), wave(v + 3), wave(v + 7)) * 0.4 / MM_PER_UNIT;
        for t in 0..PHASES as usize {
            poses.heart[v][t] = DVec3::new(wave(t), wave(t + v), wave(t + 4)) * 0.2 / MM_PER_UNIT;
        }
        // Opposite excesses of contrast: their mean is that of the field.
        (0..PHASES as usize).for_each(|t| poses.gains[v][t] = if (t + v) % 2 == 0 { 0.15 } else { -0.15 });
    }
    poses
}

/// Images of a field in f64, `[image][pixel]`.
fn twin(field: &MovingGaussians, targets: &Targets, views: &[SplatView]) -> Vec<f64> {
    let mut images = vec![0.0; targets.n_images * targets.n_pixels()];
    for (at, image) in targets.image_of.iter().enumerate() {
        let Some(image) = *image else { continue };
        let view = &views[image];
        let pixels = &mut images[image * targets.n_pixels()..][..targets.n_pixels()];
        for g in field.at((at / targets.n_views) as f64 + view.after_phase) {
            if let Some(projection) = project(&params(&g), view, &field.rest.setup) {
                projection.splat(&field.rest.setup, pixels);
            }
        }
    }
    images
}

fn norm(values: impl Iterator<Item = f64>) -> f64 {
    values.map(|v| v * v).sum::<f64>().sqrt()
}

#[test]
fn columns_are_derivatives_of_the_twin() {
    let gpu = gpu();
    let dataset = &views_that_agree().dataset;
    let trainer = fitted(&gpu, dataset);
    let stands = Stands::new(dataset, vec![0, 1, 2]);
    let field = FieldInLoop::new(&trainer, &stands);
    let deformable = trainer.deformable().unwrap();
    let poses = wrong_poses(3);
    let images = |poses: &Poses| twin(&deformable, &field.targets, &stands.seen(&field.targets, poses));
    let drawn = field.drawn(&poses).unwrap();
    let expected = images(&poses);
    let apart = norm(drawn.iter().zip(&expected).map(|(a, b)| f64::from(*a) - b)) / norm(expected.iter().copied());
    assert!(apart < 1e-3, "images differ by {apart}");
    for (unknown, column) in field.columns(&poses).unwrap().iter().enumerate() {
        let step = if unknown < 2 { 1e-3 } else { 1e-5 };
        let moved = |step: f64| {
            let mut moved = poses.clone();
            for (pose, stand) in moved.views.iter_mut().zip(&stands.stands) {
                match unknown.checked_sub(2) {
                    None => pose.angles_deg[unknown] += step,
                    Some(axis) => pose.shift += step * stand.axes().col(axis),
                }
            }
            images(&moved)
        };
        let (ahead, behind) = (moved(step), moved(-step));
        let slope: Vec<f64> = ahead.iter().zip(&behind).map(|(a, b)| (a - b) / (2.0 * step)).collect();
        let apart = norm(column.iter().zip(&slope).map(|(a, b)| f64::from(*a) - b)) / norm(slope.iter().copied());
        println!("unknown {unknown}: {apart:.4}");
        assert!(apart < 0.05, "the derivatives by unknown {unknown} differ by {apart}");
    }
}

#[test]
fn planted_errors_of_poses_and_contrasts_are_found() {
    let gpu = gpu();
    let dataset = &views_that_agree().dataset;
    let trainer = fitted(&gpu, dataset);
    let stands = Stands::new(dataset, vec![0, 1, 2]);
    let mut field = FieldInLoop::new(&trainer, &stands);
    let truth = wrong_poses(3);
    // Images that show the field at the true poses, in front of a flat background.
    let drawn = field.drawn(&truth).unwrap();
    field.set_contrasts(&truth);
    let pixels = field.targets.n_pixels();
    field.targets.images =
        drawn.iter().enumerate().map(|(p, d)| 2.0 + field.targets.contrast[p / pixels] * d).collect();
    field.targets.noise.fill(0.0);
    field.targets.weight.fill(1.0);
    let distance = |poses: &Poses| {
        let (a, b) = (stands.seen(&field.targets, poses), stands.seen(&field.targets, &truth));
        let points = [DVec3::ZERO, DVec3::X * 10.0, DVec3::Y * 10.0, DVec3::Z * 10.0];
        let of = |(a, b): (&SplatView, &SplatView)| {
            points.map(|p| (a.project(p).1 - b.project(p).1).hypot(a.project(p).2 - b.project(p).2))
        };
        let all: Vec<f64> = a.iter().zip(&b).flat_map(of).collect();
        (norm(all.iter().copied()).powi(2) / all.len() as f64).sqrt()
    };
    let contrast = |poses: &Poses| {
        let apart = poses.gains.iter().flatten().zip(truth.gains.iter().flatten()).map(|(a, b)| (a - b).abs());
        apart.fold(0.0, f64::max)
    };
    let stated = Poses::stated(3, PHASES as usize);
    let (before, misfit_at) = (distance(&stated), |field: &FieldInLoop<'_>, poses: &Poses| {
        misfit(&field.targets, &field.drawn(poses).unwrap())
    });
    let mut poses = stated.clone();
    let mut stepping = FieldInLoop::new(&trainer, &stands);
    stepping.targets = field.targets.clone();
    stepping.set_contrasts(&poses);
    let misfit_before = misfit_at(&stepping, &poses);
    for _ in 0..8 {
        poses = stepping.stepped(&poses, 2).unwrap();
        println!("{:.3} px, contrast {:.3}", distance(&poses), contrast(&poses));
    }
    stepping.set_contrasts(&poses);
    let (after, misfit_after) = (distance(&poses), misfit_at(&stepping, &poses));
    println!(
        "{before:.3} px to {after:.3} px, contrast {:.4}, misfit {misfit_before:.4} to {misfit_after:.4}",
        contrast(&poses)
    );
    assert!(before > 0.5 && after < 0.1 * before, "{before} px to {after} px");
    assert!(contrast(&poses) < 0.03, "contrasts differ by {}", contrast(&poses));
    assert!(misfit_after < 0.1 * misfit_before, "misfit {misfit_before} to {misfit_after}");
}

fn error_px(shot: &Shot, dataset: &Dataset) -> f64 {
    shot.error_px(&|view, phase| dataset.heart_rays_at(view, phase as u32))
}

/// Adjusts the views of a shot, starting from a calibration, and returns the calibration and the fit that the run takes over.
fn adjust(gpu: &Gpu, shot: &Shot, calibration: &Calibration) -> (Calibration, MadeFit) {
    let config = fast().into_any();
    let task = AdjustTask { gpu, config: &config, dataset: &shot.dataset, calibration };
    let outcome = methods::of(&config).abilities.adjust_views.unwrap()(&task, &mut |_| Ok(())).unwrap().unwrap();
    let after = adjusted(&shot.dataset, calibration.clone(), outcome.adjusted).unwrap();
    println!("{}", after.notes.join("; "));
    (after, outcome.made.unwrap())
}

fn made_before(made: &MadeFit) -> Start<'_> {
    Start { made: Some(made), ..Start::default() }
}

/// Trains to the end of the Gaussians with and without the fit that an adjustment has left, and checks that the results are the same.
fn expect_taken_over(gpu: &Gpu, dataset: &Dataset, made: &MadeFit) {
    let config = fast().into_any();
    let plan = || Plan::new(&config, dataset).unwrap();
    let mut with = Trainer::begin(gpu, plan(), dataset, tuning(gpu), made_before(made)).unwrap();
    let mut without = Trainer::new(gpu, plan(), dataset, tuning(gpu)).unwrap();
    let end = config.gaussian_iterations();
    assert!(without.preparation().is_some(), "a fit from scratch prepares its Gaussians");
    // Where views were adjusted, other fits come first.
    if dataset.frames.iter().all(|frame| frame.contrast == 1.0) {
        assert_eq!(with.preparation(), None, "the fit is made already");
    }
    let losses = [run(&mut with, end), run(&mut without, end)];
    assert_eq!(losses[0], losses[1]);
    assert_eq!(with.model().unwrap().gaussians, without.model().unwrap().gaussians);
}

#[test]
fn views_that_agree_are_not_adjusted() {
    let gpu = gpu();
    let shot = Studio::new(&gpu, 100, 1).shoot(4, Wrong { seed: 11, ..Wrong::default() });
    let calibration = calibrate(&shot.dataset, fast().into_any().calibration()).unwrap();
    let (after, made) = adjust(&gpu, &shot, &calibration);
    let record = after.adjustment.clone().unwrap();
    println!("{record:?}");
    assert!(!record.accepted, "{record:?}");
    let (before, after) = (shot.dataset.corrected(&calibration).unwrap(), shot.dataset.corrected(&after).unwrap());
    assert!(before.frames.iter().zip(&after.frames).all(|(a, b)| a.contrast == b.contrast));
    assert_eq!(error_px(&shot, &before), error_px(&shot, &after));
    expect_taken_over(&gpu, &after, &made);
    let made: &MadeGaussians = made.downcast_ref().unwrap();
    let other: MadeFit = Arc::new(MadeGaussians { fingerprint: "of other data".into(), ..made.clone() });
    let plan = Plan::new(&fast().into_any(), &after).unwrap();
    let trainer = Trainer::begin(&gpu, plan, &after, tuning(&gpu), made_before(&other)).unwrap();
    assert!(trainer.preparation().is_some(), "the fit to other data is not taken over");
}

/// Default settings, with few iterations of the static field after those of the Gaussians.
fn brief() -> Config {
    let mut config = fast();
    config.train.iterations = config.gaussians.iterations + 10;
    config.into_any()
}

/// A session with the frames of a shot.
pub fn session_with(gpu: &Gpu, shot: &Shot, config: Config) -> Session {
    let dataset = &shot.dataset;
    let options = SessionOptions {
        config,
        phases: dataset.n_phases,
        depth_half_extent_mm: 0.5 * (dataset.depth_range.1 - dataset.depth_range.0) * MM_PER_UNIT,
        vessel_attenuation_per_mm: None,
        still: false,
        deterministic: true,
    };
    let session = Session::new(Some(gpu.clone()), Some(tuning(gpu)), options).unwrap();
    add_training_frames(&session, dataset);
    session
}

#[test]
#[ignore = "long: tools/test --all"]
fn a_session_adjusts_its_views_when_training_has_ended_and_trains_on() {
    let gpu = gpu();
    let wrong = Wrong { angle_deg: 0.2, shift_mm: 0.3, breathing_mm: 0.6, noise: 0.02, seed: 11 };
    let mut shot = Studio::new(&gpu, 100, 1).shoot(3, wrong);
    // Contrasts that differ from frame to frame: calibration does not know them.
    for frame in &mut shot.dataset.frames {
        let contrast = if (frame.phase as usize + frame.view).is_multiple_of(2) { 1.15 } else { 0.85 };
        frame.integrals = frame.integrals.iter().map(|integral| contrast * integral).collect::<Vec<_>>().into();
    }
    let session = session_with(&gpu, &shot, brief());
    let steps = Arc::new(Mutex::new(Vec::new()));
    let seen = steps.clone();
    let observe = move |progress: &Progress| {
        seen.lock().unwrap().push(progress.loss.step);
        true
    };
    session.start(Box::new(observe)).unwrap();
    assert!(session.wait(Duration::from_secs(1800)), "training ends");
    assert_eq!(session.state(), State::Finished);
    let calibration = session.calibration().unwrap();
    let record = calibration.adjustment.clone().unwrap();
    let corrected = shot.dataset.corrected(&calibration).unwrap();
    let (before, after) = (error_px(&shot, &shot.dataset), error_px(&shot, &corrected));
    println!("{before:.3} px to {after:.3} px, {record:?}");
    assert!(record.accepted && before > 0.5 && after < 0.5 * before, "{before} px to {after} px, {record:?}");
    let steps = steps.lock().unwrap();
    assert!(steps.windows(2).any(|pair| pair[1] < pair[0]), "training went on with the corrected views: {steps:?}");
    assert_eq!(steps.last(), Some(&session.step()));
    // The field that is shown belongs to the corrected views: their frames are taken in, and drawn where the frames show them.
    let model = session.checkpoint().unwrap().model;
    assert_eq!(model.step, brief().train.iterations);
    assert!(model.gaussians.as_ref().unwrap().rows().agreement.is_some(), "the mean of several fits");
    assert!(session.corrected_frame(0).unwrap().view.is_some());
    // Training that is started again has nothing left to do.
    session.start(Box::new(|_| true)).unwrap();
    assert!(session.wait(Duration::from_secs(1800)) && session.state() == State::Finished);
    assert_eq!(session.checkpoint().unwrap().model.gaussians, model.gaussians);
    expect_silence_of(session, gpu);
}

#[test]
fn a_session_that_is_stopped_while_it_adjusts_keeps_its_reconstruction() {
    let gpu = gpu();
    let session = Arc::new(session_with(&gpu, views_that_agree(), brief()));
    let end = brief().train.iterations;
    let reached = Arc::new((Mutex::new(false), Condvar::new()));
    let tell = reached.clone();
    let observe = move |progress: &Progress| {
        *tell.0.lock().unwrap() |= progress.loss.step == end;
        tell.1.notify_all();
        true
    };
    session.start(Box::new(observe)).unwrap();
    let at_end = reached.0.lock().unwrap();
    let (at_end, out) = reached.1.wait_timeout_while(at_end, Duration::from_secs(900), |at_end| !*at_end).unwrap();
    assert!(*at_end && !out.timed_out(), "training reaches its end");
    drop(at_end);
    session.stop().unwrap();
    // The adjustment was stopped, had not begun, or was faster than this thread.
    assert!(matches!(session.state(), State::Idle | State::Finished), "{:?}", session.state());
    assert_eq!(session.checkpoint().unwrap().model.step, end);
    // Views that agree are looked at once more, and stay as they are.
    session.start(Box::new(|_| true)).unwrap();
    assert!(session.wait(Duration::from_secs(900)) && session.state() == State::Finished);
    let record = session.calibration().unwrap().adjustment.unwrap();
    println!("{record:?}");
    assert!(!record.accepted && record.misfit_after.is_none(), "{record:?}");
    expect_silence_of(Arc::into_inner(session).unwrap(), gpu);
}

/// Settings of short fits, of which two views need several.
fn short() -> Config {
    let mut config = fast();
    config.adjustment.adjust = AdjustMode::Off;
    (config.gaussians.iterations, config.train.iterations) = (30, 40);
    config.into_any()
}

fn of_two_views() -> Shot {
    let mut shot = views_that_agree().clone();
    shot.dataset.frames.retain(|frame| frame.view < 2);
    shot.dataset.views.truncate(2);
    shot
}

#[test]
fn a_session_ends_with_the_mean_of_fits_and_goes_on_from_a_single_one() {
    let gpu = gpu();
    let shot = of_two_views();
    let gaussians = |session: &Session| session.checkpoint().unwrap().model.gaussians.unwrap();
    let single = session_with(&gpu, &shot, short());
    single.train(u32::MAX, &mut |_| true).unwrap();
    assert!(gaussians(&single).rows().agreement.is_none(), "training in the caller's thread makes a single fit");
    let refined = session_with(&gpu, &shot, short());
    refined.start(Box::new(|_| true)).unwrap();
    assert!(refined.wait(Duration::from_secs(900)) && refined.state() == State::Finished);
    // The mean is that of a run with the same images.
    let calibration = refined.calibration().unwrap();
    let dataset = shot.dataset.corrected(&calibration).unwrap();
    let mut run_of_mean = Trainer::new(&gpu, Plan::new(&short(), &dataset).unwrap(), &dataset, tuning(&gpu)).unwrap();
    run(&mut run_of_mean, short().train.iterations);
    let mean = gaussians(&refined);
    assert!(mean.rows().agreement.is_some());
    assert_eq!(mean.rows().rows, run_of_mean.model().unwrap().gaussians.unwrap().rows().rows);
    drop(run_of_mean);
    // Other frames: both go on from the single fit.
    for session in [&single, &refined] {
        session.remove_frame(3).unwrap();
        session.train(5, &mut |_| true).unwrap();
    }
    assert_eq!(gaussians(&refined), gaussians(&single));
    single.stop().unwrap();
    drop(single);
    expect_silence_of(refined, gpu);
}

#[test]
fn an_earlier_field_is_shown_until_the_first_of_several_fits_is_done() {
    let gpu = gpu();
    let shot = of_two_views();
    let preparation = ["deformable.warm_iterations=20", "deformable.track_iterations=5"];
    let (dataset, config) = (&shot.dataset, with_values(&short(), preparation).unwrap());
    let mut alone = config.with(&["gaussians.fits=1".into()]).unwrap();
    alone.seed += 1;
    let mut first = Trainer::new(&gpu, Plan::new(&alone, dataset).unwrap(), dataset, tuning(&gpu)).unwrap();
    run(&mut first, config.gaussian_iterations());
    let earlier = first.model().unwrap().gaussians.unwrap();
    drop(first);
    let kept = FitField::of_gaussians(earlier.clone());
    let from = Start { field: Some((&kept, Use::Show)), ..Start::default() };
    let plan = Plan::new(&config, dataset).unwrap();
    let mut trainer = Trainer::begin(&gpu, plan, dataset, tuning(&gpu), from).unwrap();
    let shown = |trainer: &Trainer| trainer.feed().gaussians.unwrap().lock().unwrap().1.clone();
    let mut shares = Vec::new();
    while trainer.shows_earlier() {
        assert_eq!(shown(&trainer), earlier);
        shares.push(trainer.preparation().unwrap());
        trainer.advance(config.train.iterations).unwrap();
    }
    assert!(shares.len() > 5 && shares.windows(2).all(|pair| pair[0] <= pair[1]), "{shares:?}");
    assert_eq!(trainer.preparation(), Some(0.2), "the first of five fits is done");
    assert!(shown(&trainer) != earlier && shown(&trainer).rows().agreement.is_none());
    drop(trainer);
    expect_silence(gpu);
}

fn expect_silence_of(session: Session, gpu: Gpu) {
    session.stop().unwrap();
    drop(session);
    expect_silence(gpu);
}
