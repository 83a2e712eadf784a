//! Gaussians: projection against quadrature, twins against finite differences and PyTorch, kernels against twins.

use crate::common;
use crate::common::{drop_first_view, expect_agreement, expect_silence, gpu, phantom, relative_error};
use crate::gaussian_field::small_phantom;
use crate::golden_file::Golden;
use glam::DVec3;
use nertca_vk::error::Result;
use nertca_vk::gaussians::field::{Gaussians, MovingGaussians};
use nertca_vk::gaussians::particles::Particles;
use nertca_vk::gaussians::view::SplatView;
use nertca_vk::gpu::device::Gpu;
use nertca_vk::kernels::layout::{Gaussian, GaussianSetup};
use nertca_vk::methods::dynamic_gaussians::deformable::{DeformableTrainer, Earlier};
use nertca_vk::methods::dynamic_gaussians::per_phase::GaussianTrainer;
use nertca_vk::methods::dynamic_gaussians::rules::{GaussianRules, Rules};
use nertca_vk::methods::dynamic_gaussians::setup;
use nertca_vk::methods::dynamic_gaussians::soft_hull::carve::SoftMotion;
use nertca_vk::methods::dynamic_gaussians::targets::Targets;
use nertca_vk::methods::dynamic_gaussians::targets::shared_images::SharedImages;
use nertca_vk::scan::dataset::{Dataset, Frame};
use nertca_vk_twins::reference::dynamic_gaussians::{DeformableParams, loss_and_gradient};
use nertca_vk_twins::reference::gaussians::{self as reference, N_PARAMS, Params, params};
use nertca_vk_twins::reference::maxima::maxima;
use nertca_vk_twins::selftest::dynamic_gaussians;
use nertca_vk_twins::selftest::gaussians::{self, TENSORS, device_gradient, numbers, twin};
use nertca_vk_twins::selftest::problems::{
    self, ANGLES_DEG, deformable_case, fillings, moving_set, random_gaussians, units,
};
use nertca_vk_vessels::score::metrics;
use nertca_vk_vessels::vessels::threshold::VESSEL_SHARE;
use std::time::Instant;

/// The default fit.
fn config() -> Rules {
    problems::default_rules().unwrap()
}

/// The default fit with other Gaussians.
fn with_gaussians(gaussians: GaussianRules) -> Rules {
    Rules { gaussians, ..config() }
}

fn targets(width: usize, height: usize, n_phases: usize) -> Targets {
    problems::targets(width, height, n_phases).unwrap()
}

fn hard_case() -> (Targets, Vec<Gaussian>) {
    problems::hard_case().unwrap()
}

fn with_phases(rows: &[Gaussian]) -> Vec<(Params, usize)> {
    rows.iter().map(|g| (params(g), g.phase as usize)).collect()
}

#[test]
fn exact_integrals_are_those_of_quadrature() {
    let targets = targets(17, 14, 2);
    let setup = setup::gaussian_setup(&targets, &config().gaussians);
    for g in random_gaussians(30, 2, 8.0, 1) {
        let p = params(&g);
        for view in &targets.views {
            let (_, u, v) = view.project(DVec3::new(p[0], p[1], p[2]));
            let (u, v) = (u + 0.6, v - 0.9);
            let (ray, exact) = (view.ray(u, v), reference::exact_integral(&p, &setup, view, u, v));
            let closest = (DVec3::new(p[0], p[1], p[2]) - view.source).dot(ray.normalize());
            // The trapezoidal rule for a Gaussian converges faster than any power of the step.
            let h = 0.02;
            let at = |k: i32| view.source + ray.normalize() * (closest + h * f64::from(k));
            let sum: f64 = (-2000..=2000).map(|k| h * reference::density(&p, &setup, at(k))).sum();
            assert!((sum - exact).abs() < 1e-6 * exact.max(1e-3), "{sum} against {exact}");
        }
    }
}

#[test]
fn the_affine_projection_is_as_good_as_the_cut() {
    let targets = targets(61, 52, 2);
    let setup = setup::gaussian_setup(&targets, &config().gaussians);
    let mut worst = 0f64;
    for g in random_gaussians(40, 2, 14.0, 2) {
        let p = params(&g);
        for view in &targets.views {
            let seen = reference::project(&p, view, &setup).unwrap();
            let mut image = vec![0.0; targets.n_pixels()];
            seen.splat(&setup, &mut image);
            for (pixel, value) in image.iter().enumerate().filter(|(_, v)| **v > 0.0) {
                let (column, row) = ((pixel % 61) as f64, (pixel / 61) as f64);
                let exact = reference::exact_integral(&p, &setup, view, column, row);
                worst = worst.max((value - exact).abs() / seen.amplitude);
            }
        }
    }
    let cut = (-0.5 * f64::from(setup.cut).powi(2)).exp();
    println!("affine against exact: {worst:.2e} of the peak; the cut: {cut:.2e}");
    assert!(worst < cut && worst > 1e-7, "{worst}");
}

#[test]
fn twin_gradient_is_the_derivative_of_the_twin_loss() {
    let targets = targets(17, 14, 2);
    // With this cut no pixel crosses the boundary.
    let setup = GaussianSetup { cut: 12.0, ..setup::gaussian_setup(&targets, &config().gaussians) };
    let mut all = with_phases(&random_gaussians(9, 2, 5.0, 3));
    // A scale beyond its bound has no gradient.
    all[0].0[4] = 2.0;
    let (_, _, gradient) = twin(&targets, &setup, &all);
    assert_eq!(gradient[0][4], 0.0);
    let largest = gradient.iter().flatten().fold(0f64, |m, g| m.max(g.abs()));
    for i in 0..all.len() {
        for (k, want) in gradient[i].iter().enumerate() {
            let loss = |h: f64| {
                let mut moved = all.clone();
                moved[i].0[k] += h;
                twin(&targets, &setup, &moved).1
            };
            let h = 1e-6;
            let difference = (loss(h) - loss(-h)) / (2.0 * h);
            let error = (difference - want).abs();
            assert!(error <= 1e-5 * want.abs() + 1e-7 * largest, "Gaussian {i}, {k}: {difference} against {want}");
        }
    }
}

#[test]
fn every_stage_of_an_iteration_matches() {
    let gpu = gpu();
    expect_agreement(|findings| gaussians::compare(&gpu, findings));
    // This Gaussian is outside every view.
    let (targets, rows) = hard_case();
    let mut trainer = GaussianTrainer::with(&gpu, targets, &config(), &Particles::fresh(rows.clone())).unwrap();
    trainer.advance(1).unwrap();
    assert_eq!(device_gradient(&gpu, trainer.particles(), rows.len()).unwrap()[5], [0.0; N_PARAMS]);
    drop(trainer);
    expect_silence(gpu);
}

#[test]
fn runs_repeat_bit_by_bit() {
    let gpu = gpu();
    let (targets, rows) = hard_case();
    let train = |stops: &[u32]| {
        let config = with_gaussians(GaussianRules { iterations: 30, grow_at: 0, ..config().gaussians });
        let particles = Particles::fresh(rows.clone());
        let mut trainer = GaussianTrainer::with(&gpu, targets.clone(), &config, &particles).unwrap();
        let mut losses = Vec::new();
        for stop in stops {
            while trainer.step() < *stop {
                losses.extend(trainer.advance(*stop).unwrap());
            }
        }
        (trainer.model().unwrap().rows, losses)
    };
    let (whole, parts) = (train(&[30]), train(&[7, 9, 30]));
    assert_eq!(whole.1.len(), 30);
    assert_eq!(whole, parts);
    assert!(whole.1[29] < 0.9 * whole.1[0], "the loss must fall: {:?}", whole.1);
    expect_silence(gpu);
}

impl Golden {
    fn size(&self, key: &str) -> usize {
        self.case[key].as_u64().unwrap() as usize
    }

    /// Views and images of the script, with the C-arm of [`c_arm`].
    fn targets(&self) -> Targets {
        let (width, height) = (self.size("width_px"), self.size("height_px"));
        let n_phases = self.size("phases");
        let mut weight = Vec::new();
        let mut out = Targets { low: Vec::new(), high: Vec::new(), ..targets(width, height, n_phases) };
        out.image_of = vec![None; n_phases * ANGLES_DEG.len()];
        out.n_images = 0;
        let missing = [self.case["missing"][0][0].as_u64().unwrap(), self.case["missing"][0][1].as_u64().unwrap()];
        for phase in 0..n_phases {
            for view in 0..ANGLES_DEG.len() {
                if missing == [phase as u64, view as u64] {
                    continue;
                }
                out.image_of[phase * ANGLES_DEG.len() + view] = Some(out.n_images);
                out.n_images += 1;
                let tensor = |name: &str| self.get(&format!("{name}/{view}/{phase}")).into_iter().map(|v| v as f32);
                out.low.extend(tensor("low"));
                out.high.extend(tensor("high"));
                weight.extend(tensor("weight"));
            }
        }
        out.weight = SharedImages::of_each(weight, width * height);
        out
    }

    fn gaussians(&self, prefix: &str) -> Vec<Gaussian> {
        let get =
            |name: &str| -> Vec<f32> { self.get(&format!("{prefix}/{name}")).iter().map(|v| *v as f32).collect() };
        let (position, scale, rotation, density) = (get("position"), get("scale"), get("rotation"), get("density"));
        let phases = self.size("phases");
        (0..density.len())
            .map(|i| Gaussian {
                position: position[3 * i..][..3].try_into().unwrap(),
                log_density: density[i],
                log_scale: scale[3 * i..][..3].try_into().unwrap(),
                phase: (i % phases) as u32,
                rotation: rotation[4 * i..][..4].try_into().unwrap(),
            })
            .collect()
    }
}

#[test]
fn golden_values_of_pytorch() {
    let gpu = gpu();
    let golden = Golden::open("gaussians", "tools/reference_gaussians.py");
    let (targets, rows) = (golden.targets(), golden.gaussians("start"));
    let iterations = golden.size("iterations") as u32;
    let config = with_gaussians(GaussianRules { iterations, grow_at: 0, ..config().gaussians });
    let mut trainer = GaussianTrainer::with(&gpu, targets.clone(), &config, &Particles::fresh(rows.clone())).unwrap();
    let (images, loss, gradient) = twin(&targets, trainer.setup(), &with_phases(&rows));
    let want_loss = golden.get("loss")[0];
    // Constants are f32 in the twin, and f64 in the script.
    assert!((loss - want_loss).abs() < 1e-6 * want_loss, "{loss} against {want_loss}");
    let pixels = targets.n_pixels();
    for phase in 0..targets.n_phases {
        for (view, image) in targets.image_of[phase * 3..][..3].iter().enumerate() {
            let Some(image) = image else { continue };
            let want = golden.get(&format!("image/{view}/{phase}"));
            let got: Vec<f32> = images[image * pixels..][..pixels].iter().map(|v| *v as f32).collect();
            let (error, at) = relative_error(&got, &want);
            assert!(error < 1e-6, "twin, image {view}/{phase}, pixel {at}: {error:.1e}");
        }
    }
    let got = trainer.advance(1).unwrap()[0];
    assert!((got - want_loss).abs() < 1e-4 * want_loss, "{got} against {want_loss}");
    let on_device = device_gradient(&gpu, trainer.particles(), trainer.count() as usize).unwrap();
    while trainer.step() < golden.size("updates") as u32 {
        trainer.advance(golden.size("updates") as u32).unwrap();
    }
    let last: Vec<Params> = trainer.model().unwrap().rows.iter().map(params).collect();
    for (name, range) in TENSORS {
        let compare = |who: &str, all: &[Params], want: &str, tolerance: f64| {
            let want = golden.get(&format!("{want}/{name}"));
            let got: Vec<f32> = numbers(all, range.clone()).iter().map(|v| *v as f32).collect();
            let (error, at) = relative_error(&got, &want);
            println!("{who} {name} {error:.1e}");
            assert!(error < tolerance, "{who} {name}[{at}]: {} against {} ({error:.1e})", got[at], want[at]);
        };
        compare("twin gradient", &gradient, "gradient", 1e-5);
        compare("device gradient", &on_device, "gradient", 1e-4);
        compare("device after ten updates", &last, "final", 1e-3);
    }
    for row in golden.get("exact").chunks(4) {
        let value = reference::exact_integral(
            &params(&rows[row[0] as usize]),
            trainer.setup(),
            &targets.views[0],
            row[1],
            row[2],
        );
        assert!((value - row[3]).abs() < 1e-6 * row[3], "{value} against {}", row[3]);
    }
    drop(trainer);
    expect_silence(gpu);
}

#[test]
fn impossible_runs_are_refused_in_words() {
    let gpu = gpu();
    let (targets, rows) = hard_case();
    let fault = GaussianTrainer::with(&gpu, targets.clone(), &config(), &Particles::default()).err().unwrap();
    assert!(fault.to_string().contains("gaussians.count"), "{fault}");
    let mut broken = rows.clone();
    broken[3].log_density = f32::NAN;
    let mut trainer = GaussianTrainer::with(&gpu, targets, &config(), &Particles::fresh(broken)).unwrap();
    let outcome = trainer.advance(1).and_then(|_| trainer.model());
    assert!(outcome.err().unwrap().to_string().contains("diverged"));
    drop(trainer);
    expect_silence(gpu);
}

/// Runs a complete fit with the settings.
fn fit_of(gpu: &Gpu, dataset: &Dataset, config: &Rules, form: Train) -> Result<Gaussians> {
    let targets = Targets::new(dataset, &SoftMotion::new(dataset, 0.3, 32), &config.gaussians)?;
    form(gpu, targets, config)
}

fn check_finite(model: &Gaussians, what: &str) {
    let finite = |g: &Gaussian| params(g).iter().all(|v| v.is_finite());
    assert!(!model.rows.is_empty() && model.rows.iter().all(finite), "{what}");
}

#[test]
fn degenerate_data_are_fitted_or_refused_in_words() {
    let gpu = gpu();
    let config = with_gaussians(GaussianRules { iterations: 60, count: 40, ..config().gaussians });
    let all = common::small_dataset(32, 32);
    for (name, form) in FORMS {
        let refused = |dataset: &Dataset, config: &Rules, part: &str| {
            let fault =
                fit_of(&gpu, dataset, config, form).err().unwrap_or_else(|| panic!("{name}: {part}")).to_string();
            assert!(fault.contains(part), "{name}: {fault}");
        };
        let fitted = |dataset: &Dataset, what: &str| {
            check_finite(&fit_of(&gpu, dataset, &config, form).unwrap_or_else(|e| panic!("{name}, {what}: {e}")), what);
        };
        fitted(&all, "all");
        let kept = |keep: &dyn Fn(&Frame) -> bool| {
            let mut dataset = all.clone();
            dataset.frames.retain(|f| keep(f));
            dataset
        };
        let first = all.training_views()[0];
        refused(&kept(&|f| f.view == first), &config, "only one training view has two phases");
        refused(&kept(&|f| f.phase == 0), &config, "no training view has two phases");
        let (one, other) = (all.frames[0].phase, all.frames.iter().map(|f| f.phase).max().unwrap());
        fitted(&kept(&|f| f.phase == one || f.phase == other), "two phases");
        let mut still = all.clone();
        still.frames.iter_mut().for_each(|f| f.integrals.fill(1.0));
        refused(&still, &config, "nothing changes over the beat");
        let mut broken = all.clone();
        broken.frames[0].integrals[5] = f32::NAN;
        let view = broken.frames[0].view;
        refused(&broken, &config, &format!("view {view}"));
        let none = with_gaussians(GaussianRules { prune_threshold: 1e3, ..config.gaussians.clone() });
        refused(&all, &none, "no Gaussian is left");
    }
    expect_silence(gpu);
}

/// Half side of the default phantom's box, world units.
const HALF: f64 = 0.2546;

fn targets_of(dataset: &Dataset) -> Targets {
    Targets::new(dataset, &SoftMotion::new(dataset, HALF, 112), &config().gaussians).unwrap()
}

fn train_phases(gpu: &Gpu, targets: Targets, config: &Rules) -> Result<Gaussians> {
    let until = config.gaussians.iterations;
    let mut trainer = GaussianTrainer::new(gpu, targets, config)?;
    while trainer.step() < until {
        trainer.advance(until)?;
    }
    trainer.model()
}

fn train_tree(gpu: &Gpu, targets: Targets, config: &Rules) -> Result<Gaussians> {
    let until = config.gaussians.iterations;
    let mut trainer = DeformableTrainer::new(gpu, targets, config)?;
    while trainer.step() < until {
        trainer.advance(until)?;
    }
    Ok(trainer.deformable()?.expand())
}

/// Another seed keeps the motion of a fit and nothing else.
#[test]
fn a_reseeded_fit_moves_as_the_earlier_one_and_has_gaussians_of_its_own() {
    let gpu = gpu();
    let dataset = small_phantom();
    let config = with_gaussians(GaussianRules { iterations: 30, ..config().gaussians });
    let fitted = |trainer: &mut DeformableTrainer| {
        let mut losses = Vec::new();
        while trainer.step() < config.gaussians.iterations {
            losses.extend(trainer.advance(config.gaussians.iterations).unwrap());
        }
        losses
    };
    let mut first = DeformableTrainer::new(&gpu, targets_of(dataset), &config).unwrap();
    fitted(&mut first);
    let earlier = first.deformable().unwrap();
    let other = Rules { seed: config.seed + 1, ..config.clone() };
    let from = Earlier { field: &earlier, step: 0, reseeds: true };
    let mut second = DeformableTrainer::after(&gpu, targets_of(dataset), &other, from).unwrap();
    let seeded = second.deformable().unwrap();
    assert_eq!((second.step(), seeded.rest.rows.len()), (0, config.gaussians.count as usize));
    let n_basis = seeded.setup.n_basis as usize;
    let own = |set: &MovingGaussians, i: usize| set.own[i * n_basis..][..n_basis].to_vec();
    let mut farthest = 0f64;
    for (i, g) in seeded.rest.rows.iter().enumerate() {
        assert_eq!(g.phase, seeded.setup.rest_phase);
        let x = DVec3::from_array(g.position.map(f64::from));
        let moved = [&seeded, &earlier].map(|set| set.carried(x, 2.0));
        assert!(moved[0].distance(moved[1]) < 1e-3, "{} and {}", moved[0], moved[1]);
        assert_eq!(own(&seeded, i), own(&earlier, earlier.nearest(x)));
        farthest = farthest.max(moved[0].distance(x));
        assert!(earlier.rest.rows.iter().all(|other| other.position != g.position));
    }
    let losses = fitted(&mut second);
    println!("displacements of up to {farthest} pixels, loss {} to {}", losses[0], losses[29]);
    assert!(farthest > 0.3, "the earlier fit moves: {farthest} pixels");
    assert!(losses[29] < 0.5 * losses[0], "{losses:?}");
    drop((first, second));
    expect_silence(gpu);
}

/// Mean Dice over the validation images, where the maximum attenuation along the ray is at least a fifth of the vessel's.
fn dice(model: &Gaussians, dataset: &Dataset) -> f64 {
    let level = VESSEL_SHARE * dataset.vessel_attenuation.unwrap();
    let of = |frame: &Frame| {
        let view = SplatView::new(&dataset.views[frame.view].rays, model.units);
        let seen = maxima(model, &view, dataset.width, dataset.height, frame.phase as usize);
        let found: Vec<bool> = seen.iter().map(|v| *v >= level).collect();
        metrics::dice(&found, frame.mask.as_ref().unwrap())
    };
    dataset.validation().iter().map(of).sum::<f64>() / dataset.validation().len() as f64
}

/// Minimum Dice of a set per phase, with 4 and 3 views; measured 0.846 and 0.763, at least 0.840 and 0.753 with two other
/// seeds.
const PHASE_DICE: [f64; 2] = [0.82, 0.73];
/// Minimum Dice of a tree; measured 0.846 and 0.813, at least 0.853 and 0.775 with two other seeds.
const TREE_DICE: [f64; 2] = [0.82, 0.74];

type Train = fn(&Gpu, Targets, &Rules) -> Result<Gaussians>;
const FORMS: [(&str, Train); 2] = [("phase", train_phases), ("tree", train_tree)];

/// The true volume scores 0.905 by this rule.
#[test]
fn the_default_phantom_is_reconstructed() {
    let gpu = gpu();
    let directory = tempfile::tempdir().unwrap();
    let mut dataset = phantom(&gpu, directory.path(), 100, 4);
    for (index, n_views) in [4, 3].into_iter().enumerate() {
        if n_views == 3 {
            drop_first_view(&mut dataset);
        }
        let targets = targets_of(&dataset);
        for ((form, train), min) in FORMS.into_iter().zip([PHASE_DICE, TREE_DICE]) {
            let start = Instant::now();
            let model = train(&gpu, targets.clone(), &config()).unwrap();
            let seconds = start.elapsed().as_secs_f64();
            let dice = dice(&model, &dataset);
            println!("{form}, {n_views} views: Dice {dice:.3}, {} Gaussians, {seconds:.1} s", model.rows.len());
            assert!(dice >= min[index], "{form}, {n_views} views: {dice}");
        }
    }
    expect_silence(gpu);
}

#[test]
fn maxima_are_those_of_the_field() {
    let targets = targets(33, 27, 2);
    let setup = GaussianSetup { cut: 6.0, ..setup::gaussian_setup(&targets, &config().gaussians) };
    let model = Gaussians {
        units: units(),
        n_phases: 2,
        setup,
        rows: random_gaussians(40, 2, 8.0, 6),
        step: 0,
        is_crowd: false,
        agreement: None,
        intensities: None,
    };
    let view = &targets.views[1];
    let seen = maxima(&model, view, 33, 27, 1);
    let field: Vec<Params> = model.at(1).map(params).collect();
    let mut largest = 0f64;
    for (pixel, value) in seen.iter().enumerate().step_by(13) {
        let ray = view.ray((pixel % 33) as f64, (pixel / 33) as f64);
        let middle = view.project(DVec3::ZERO).0;
        // The expected value is found by brute force, from all Gaussians and with small steps.
        let at = |k: i32| view.source + ray * (middle + 0.05 * f64::from(k));
        let sum = |x: DVec3| field.iter().map(|p| reference::density(p, &setup, x)).sum::<f64>();
        let want = (-600..=600).map(|k| sum(at(k))).fold(0.0, f64::max) * units().attenuation();
        largest = largest.max(want);
        // Steps of a quarter of a pixel miss a peak of scale 0.4 by at most 5 %, tails beyond 3.2 sigma by 0.6 %.
        assert!((value - want).abs() < 0.06 * want + 1e-4, "pixel {pixel}: {value} against {want}");
    }
    assert!(largest > 1.0, "the case must show something: {largest}");
}

#[test]
fn tree_twin_gradient_is_the_derivative_of_its_loss() {
    let (targets, rows, Rules { deformable: settings, .. }) = deformable_case().unwrap();
    let setup = GaussianSetup { cut: 12.0, ..setup::gaussian_setup(&targets, &config().gaussians) };
    let tree = setup::deformable_setup(&targets, &settings);
    let mut p = moving_set(&rows[..7], &tree, targets.n_phases);
    p.filling = fillings(7, targets.n_phases, targets.rest_phase);
    let (_, _, gradient) = loss_and_gradient(&targets, &setup, &tree, &p);
    let check = |what: &str, want: f64, change: &dyn Fn(&mut DeformableParams, f64)| {
        let loss = |h: f64| {
            let mut moved = p.clone();
            change(&mut moved, h);
            loss_and_gradient(&targets, &setup, &tree, &moved).1
        };
        let h = 1e-6;
        let difference = (loss(h) - loss(-h)) / (2.0 * h);
        assert!((difference - want).abs() <= 1e-5 * want.abs() + 1e-5, "{what}: {difference} against {want}");
        want.abs() > 1e-3
    };
    let mut seen = 0;
    for i in (0..p.own.len()).step_by(7) {
        seen += usize::from(check("own motion", gradient.own[i].y, &|p, h| p.own[i].y += h));
    }
    let rest = targets.rest_phase * tree.nodes()..(targets.rest_phase + 1) * tree.nodes();
    for i in (0..p.grid.len()).filter(|i| !rest.contains(i)).step_by(23) {
        seen += usize::from(check("grid", gradient.grid[i].x, &|p, h| p.grid[i].x += h));
    }
    for i in 0..7 {
        seen += usize::from(check("log-scale", gradient.rows[i][5], &|p, h| p.rows[i][5] += h));
    }
    let mut filled = 0;
    for i in (0..p.filling.len()).filter(|i| i % targets.n_phases != targets.rest_phase) {
        filled += usize::from(check("filling", gradient.filling[i], &|p, h| p.filling[i] += h));
    }
    assert!(seen > 10 && filled > 10, "the case must have gradients");
    assert!(gradient.grid[rest].iter().all(|g| *g == DVec3::ZERO), "the grid rests at a phase");
}

#[test]
fn tree_kernels_match_their_twin() {
    let gpu = gpu();
    expect_agreement(|findings| dynamic_gaussians::compare(&gpu, findings));
    let (targets, rows, config) = deformable_case().unwrap();
    let trainer = DeformableTrainer::with(&gpu, targets.clone(), &config, &Particles::fresh(rows.clone())).unwrap();
    assert_eq!(trainer.deformable().unwrap().expand().rows.len(), rows.len() * targets.n_phases);
    drop(trainer);
    expect_silence(gpu);
}
