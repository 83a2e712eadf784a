//! R2-Gaussian (the preset `r2-gaussian`): stages equal their twins, and the twins agree with PyTorch and finite
//! differences; runs fit images of Gaussians, repeat and resume with equal bits across density control; each phase uses its
//! own images only.

use crate::common::{
    expect_agreement, expect_silence, gpu, relative_error, run, small_dataset, tuning, uneven_dataset,
};
use crate::golden_file::Golden;
use crate::one_phase::dataset;
use glam::{DMat3, DQuat, DVec2, DVec3};
use nertca_vk::checkpoint::Checkpoint;
use nertca_vk::config::sections::R2Settings;
use nertca_vk::config::{Config, Preset};
use nertca_vk::error::Error;
use nertca_vk::fitting::shown::SetsFit;
use nertca_vk::gaussians::field::GaussianField;
use nertca_vk::gpu::device::Gpu;
use nertca_vk::kernels::layout::{PictureTurn, R2Gaussian};
use nertca_vk::methods::r2_gaussian::data::R2Data;
use nertca_vk::methods::r2_gaussian::densify::densified;
use nertca_vk::methods::r2_gaussian::fdk::back_projection;
use nertca_vk::methods::r2_gaussian::parameters::{ScaleBounds, round, softplus};
use nertca_vk::methods::r2_gaussian::setup::{gaussian_setup, turns};
use nertca_vk::methods::r2_gaussian::start::first_rows;
use nertca_vk::methods::r2_gaussian::state::R2State;
use nertca_vk::methods::r2_gaussian::trainer::R2Trainer;
use nertca_vk::plan::Plan;
use nertca_vk::render::renderer::Renderer;
use nertca_vk::scan::dataset::{Dataset, View};
use nertca_vk::train::trainer::Trainer;
use nertca_vk_twins::reference::gaussians::{N_PARAMS, Params};
use nertca_vk_twins::reference::r2_gaussian::{self as reference, params};
use nertca_vk_twins::reference::r2_gaussian_chords::Chords;
use nertca_vk_twins::reference::ssim;
use nertca_vk_twins::selftest::gaussians::{TENSORS, numbers, of_rows};
use nertca_vk_twins::selftest::r2_gaussian::{compare, hard_case, small_config, twin};
use std::collections::BTreeSet;
use std::sync::Arc;

fn config(settings: &[&str]) -> Config<R2Settings> {
    small_config(settings).unwrap()
}

#[test]
fn every_stage_of_an_iteration_matches() {
    let gpu = gpu();
    expect_agreement(|findings| compare(&gpu, findings));
    expect_silence(gpu);
}

fn with_sets(rows: &[R2Gaussian]) -> Vec<(Params, usize)> {
    rows.iter().map(|g| (params(g), g.set as usize)).collect()
}

#[test]
fn twin_gradient_is_the_derivative_of_the_twin_loss() {
    for integral in ["r2.integral=affine", "r2.integral=exact"] {
        expect_derivatives(&config(&["r2.tv_moves_centres=true", "r2.lambda_tv=3", "r2.tv_vol_size=9", integral]));
    }
}

fn expect_derivatives(config: &Config<R2Settings>) {
    let gpu = gpu();
    let (data, rows) = hard_case(config).unwrap();
    let fit = R2Trainer::with(&gpu, data, config, &R2State::fresh(rows.clone()), 0).unwrap();
    let shown = &turns(fit.data(), config)[..fit.data().n_sets()];
    let mut all = with_sets(&rows);
    // Gaussians are wide enough for several voxels; those far away or almost transparent come last.
    all.iter_mut().for_each(|(p, _)| (4..7).for_each(|k| p[k] += 0.4));
    let n = fit.data().n_sets() as f64;
    let (_, gradient) = twin(fit.data(), fit.setups(), shown, &all);
    let largest = gradient.iter().flatten().fold(0f64, |m, g| m.max(g.abs()));
    let mut compared = 0;
    for i in [0, 1, 2, 3, 4, 8, 9, 10, 11, 12] {
        for (k, want) in gradient[i].iter().enumerate() {
            let loss = |h: f64| {
                let mut moved = all.clone();
                moved[i].0[k] += h;
                twin(fit.data(), fit.setups(), shown, &moved).0
            };
            let h = 1e-6;
            // The reported loss is the mean over the sets.
            let difference = n * (loss(h) - loss(-h)) / (2.0 * h);
            let error = (difference - want).abs();
            assert!(error <= 1e-4 * want.abs() + 1e-6 * largest, "Gaussian {i}, {k}: {difference} against {want}");
            compared += usize::from(want.abs() > 1e-4 * largest);
        }
    }
    assert!(compared > 60, "{compared}");
    drop(fit);
    expect_silence(gpu);
}

#[test]
fn the_gradient_of_ssim_is_its_derivative() {
    let (width, height) = (13, 9);
    let wave = |k: f64| (0..width * height).map(|i| 0.5 + 0.4 * (k * i as f64).sin()).collect::<Vec<f64>>();
    let (x, y) = (wave(0.31), wave(0.47));
    let (_, gradient) = ssim::picture_loss(&x, &y, width, 0.25);
    for (p, want) in gradient.iter().enumerate() {
        let loss = |h: f64| {
            let mut moved = x.clone();
            moved[p] += h;
            ssim::picture_loss(&moved, &y, width, 0.25).0
        };
        let difference = (loss(1e-6) - loss(-1e-6)) / 2e-6;
        assert!((difference - want).abs() < 1e-7, "{p}: {difference} against {want}");
    }
    assert!((ssim::picture_loss(&y, &y, width, 0.25).0).abs() < 1e-15);
}

/// Compares sums along rays, and the outline of the region within the cut, for long and short Gaussians.
#[test]
fn exact_line_integrals_are_sums_along_rays() {
    let config = config(&["r2.integral=exact"]);
    let (data, rows) = hard_case(&config).unwrap();
    let (setup, bounds) = (gaussian_setup(&data, &config), ScaleBounds::of(&config.r2));
    let view = &data.views[0];
    let mut compared = 0;
    for g in [&rows[0], &rows[1], &rows[3], &rows[4]] {
        let p = params(g);
        let scale = DVec3::new(p[4], p[5], p[6]).map(|stored| bounds.scale(stored));
        let axes = DMat3::from_quat(DQuat::from_xyzw(p[8], p[9], p[10], p[7]).normalize());
        let whitened = |x: DVec3| axes.transpose() * x / scale;
        let [centre, widest] = [DVec3::new(p[0], p[1], p[2]), DVec3::splat(scale.max_element())];
        let seen = Chords::of(&p, view, &setup).unwrap();
        let mut picture = vec![0.0; data.n_pixels()];
        seen.splat(&setup, &mut picture);
        let inside: BTreeSet<usize> = seen.pixels(&setup).map(|(pixel, _)| pixel).collect();
        for (pixel, got) in picture.iter().enumerate() {
            let ray = view.ray((pixel % data.width) as f64, (pixel / data.width) as f64);
            let (a, b) = (whitened(view.source - centre), whitened(ray));
            let middle = -a.dot(b) / b.length_squared();
            let nearest = (a + middle * b).length();
            assert!(inside.contains(&pixel) || nearest > f64::from(setup.cut), "{pixel} is left out");
            if !inside.contains(&pixel) || !pixel.is_multiple_of(7) {
                continue;
            }
            let steps = 4000;
            let step = 16.0 * widest.x / f64::from(steps);
            let at = |k: i32| a + (middle + step * f64::from(k - steps / 2)) * b;
            let sum: f64 = (0..=steps).map(|k| f64::exp(-0.5 * at(k).length_squared())).sum();
            let want = softplus(p[3]) * sum * step * ray.length();
            assert!((got - want).abs() <= 1e-9 * softplus(p[3]), "{pixel}: {got} {want}");
            compared += 1;
        }
        // The box is no wider than necessary: a ray along each side of it passes within the cut.
        for (half, along) in [(seen.half_box.x, DVec2::X), (seen.half_box.y, DVec2::Y)] {
            let side =
                |sign: f64| (-4000..=4000).map(move |k| sign * half * along + f64::from(k) * 0.02 * along.perp());
            let offsets = side(1.0).chain(side(-1.0));
            let near = |d: DVec2| {
                let (a, b) = (whitened(view.source - centre), whitened(view.ray(seen.mean.x + d.x, seen.mean.y + d.y)));
                (a - a.dot(b) / b.length_squared() * b).length()
            };
            let min = offsets.map(near).fold(f64::INFINITY, f64::min);
            assert!((min - f64::from(setup.cut)).abs() < 1e-3, "{min} at the box's side");
        }
    }
    assert!(compared > 20, "{compared}");
}

/// State of the fit in a checkpoint.
fn state_of(checkpoint: &Checkpoint) -> R2State {
    checkpoint.state::<R2State>().unwrap().clone()
}

fn data_of(dataset: &Dataset, config: &Config<R2Settings>) -> R2Data {
    Plan::new(&config.clone().into_any(), dataset).unwrap().data::<R2Data>().unwrap().clone()
}

#[test]
fn golden_values_of_pytorch() {
    expect_golden("r2", "affine");
    expect_golden("r2_exact", "exact");
}

fn expect_golden(file: &str, integral: &str) {
    let gpu = gpu();
    let golden = Golden::open(file, "tools/reference_r2.py");
    let number = |key: &str| golden.case[key].as_f64().unwrap();
    let f32s = |name: &str| golden.get(name).iter().map(|v| *v as f32).collect::<Vec<f32>>();
    let angles = [0, 1].map(|v| [0, 1].map(|k| golden.case["angles"][v][k].as_f64().unwrap()));
    let half = number("half_mm") / 100.0;
    // Densities in the script are per half side.
    let image = |v: usize, _: &View| f32s(&format!("image/{v}")).iter().map(|y| y * half as f32).collect();
    let dataset = dataset(&angles, [number("width_px") as usize, number("height_px") as usize], image);
    let settings = [
        format!("train.iterations={}", number("iterations")),
        format!("r2.half_extent_mm={}", number("half_mm")),
        format!("r2.voxels={}", number("voxels")),
        format!("r2.tv_vol_size={}", number("tv_box")),
        format!("r2.integral={integral}"),
        "r2.tv_moves_centres=true".into(),
    ];
    let config = config(&settings.iter().map(String::as_str).collect::<Vec<_>>());
    let rows = |prefix: &str| -> Vec<R2Gaussian> {
        let get = |name: &str| f32s(&format!("{prefix}/{name}"));
        let (position, scale, rotation, density) = (get("position"), get("scale"), get("rotation"), get("density"));
        let row = |i: usize| R2Gaussian {
            position: position[3 * i..][..3].try_into().unwrap(),
            density: density[i],
            scale: scale[3 * i..][..3].try_into().unwrap(),
            set: 0,
            rotation: rotation[4 * i..][..4].try_into().unwrap(),
        };
        (0..density.len()).map(row).collect()
    };
    let start = rows("start");
    let state = R2State::fresh(start.clone());
    let mut fit = R2Trainer::with(&gpu, data_of(&dataset, &config), &config, &state, 0).unwrap();
    let (shown, corner) = (golden.case["shown"].as_array().unwrap(), f32s("corner"));
    let turn = |(step, image): (usize, &serde_json::Value)| PictureTurn {
        corner: corner[3 * step..][..3].try_into().unwrap(),
        image: image.as_u64().unwrap() as u32,
    };
    let turns: Vec<PictureTurn> = shown.iter().enumerate().map(turn).collect();
    gpu.upload(&fit.buffers().picture_turns, 0, &turns).unwrap();
    let (loss, gradient) = twin(fit.data(), fit.setups(), &turns[..1], &with_sets(&start));
    let want_loss: f64 = golden.get("terms").iter().sum();
    assert!((loss / want_loss - 1.0).abs() < 1e-6, "{loss} against {want_loss}");
    let got = fit.advance(1).unwrap()[0];
    assert!((got / want_loss - 1.0).abs() < 1e-4, "{got} against {want_loss}");
    let pixels: Vec<i32> = gpu.download(&fit.buffers().splat_images, 0, dataset.n_pixels()).unwrap();
    let picture: Vec<f32> = pixels.iter().map(|v| *v as f32 / fit.setups().0.fixed_point).collect();
    let (error, at) = relative_error(&picture, &golden.get("picture"));
    assert!(error < 1e-4, "picture[{at}]: {error:.1e}");
    let on_device = of_rows(&gpu.download(&fit.particles().gaussian_gradient, 0, start.len()).unwrap());
    let updates = number("updates") as u32;
    while fit.step() < updates {
        fit.advance(updates).unwrap();
    }
    let last: Vec<Params> = fit.state().unwrap().rows.iter().map(params).collect();
    for (name, range) in TENSORS {
        let compare = |who: &str, all: &[Params], want: &str, tolerance: f64| {
            let want = golden.get(&format!("{want}/{name}"));
            let got: Vec<f32> = numbers(all, range.clone()).iter().map(|v| *v as f32).collect();
            let (error, at) = relative_error(&got, &want);
            println!("{who} {name} {error:.1e}");
            assert!(error < tolerance, "{who} {name}[{at}]: {} against {} ({error:.1e})", got[at], want[at]);
        };
        compare("twin gradient", &gradient, "gradient", 2e-5);
        compare("device gradient", &on_device, "gradient", 1e-4);
        compare("device after ten updates", &last, "final", 1e-3);
    }
    drop(fit);
    expect_silence(gpu);
}

const SIDES: &[[f64; 2]] = &[[-30.0, 25.0], [60.0, -20.0], [5.0, 8.0]];

/// A few round Gaussians in a volume of 20 mm, and exact images of them.
fn phantom_of_gaussians(settings: &[&str]) -> (Dataset, Config<R2Settings>, Vec<R2Gaussian>) {
    let all = [&["r2.half_extent_mm=20", "r2.normalise=false", "train.iterations=300"], settings].concat();
    let config = config(&all);
    let bounds = ScaleBounds::of(&config.r2);
    let rows: Vec<R2Gaussian> = [(DVec3::new(0.1, -0.2, 0.05), 0.9, 0.12), (DVec3::new(-0.15, 0.1, -0.1), 0.6, 0.2)]
        .iter()
        .map(|(x, density, scale)| round(*x, *density, *scale, bounds, 0))
        .collect();
    let image = |_: usize, view: &View| {
        let pixel = |p: usize| {
            let (anchor, direction) = view.rays.pixel((p % 33) as f64, (p / 33) as f64);
            let (along, half) = (direction.normalize(), 0.2);
            let of = |g: &R2Gaussian| {
                let (to, scale) = (anchor - half * g.centre(), half * g.scales(bounds).x);
                let across = to - along * to.dot(along);
                let peak = g.attenuation() * std::f64::consts::TAU.sqrt() * scale;
                peak * (-0.5 * across.length_squared() / scale.powi(2)).exp()
            };
            rows.iter().map(of).sum::<f64>() as f32
        };
        (0..33 * 27).map(pixel).collect()
    };
    (dataset(SIDES, [33, 27], image), config, rows)
}

#[test]
fn gaussians_are_seen_and_drawn_as_the_closed_form_has_them() {
    let gpu = gpu();
    let (dataset, config, rows) = phantom_of_gaussians(&[]);
    let peak = dataset.frames[0].integrals.iter().fold(0f32, |m, v| m.max(*v));
    let mut trainer =
        Trainer::new(&gpu, Plan::new(&config.clone().into_any(), &dataset).unwrap(), &dataset, tuning(&gpu)).unwrap();
    let mut saved = trainer.checkpoint().unwrap();
    let fit = R2Trainer::with(&gpu, data_of(&dataset, &config), &config, &R2State::fresh(rows), 0).unwrap();
    saved.model.gaussians = Some(GaussianField::PerPhase(fit.model().unwrap()));
    let renderer = Renderer::new(&gpu, &saved.model, tuning(&gpu)).unwrap();
    for (frame, view) in dataset.frames.iter().zip(&dataset.views) {
        let drawn = renderer.render(&view.rays, 33, 27, 0).unwrap();
        // The maximum error is due to the cut.
        let off = drawn.dynamic_integral.iter().zip(&frame.integrals).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
        assert!(off < 1e-3 * peak, "{off} of {peak}");
        assert!(drawn.static_integral.iter().all(|v| *v == 0.0) && drawn.static_max.iter().all(|v| *v == 0.0));
        let max = drawn.total_max.iter().fold(0f32, |m, v| m.max(*v));
        // The peak of the denser Gaussian between pixels, plus a small contribution of the other.
        assert!((0.93..0.98).contains(&max), "{max}");
    }
    // The fit agrees: its remaining loss is due to the affine approximation.
    let turns = turns(fit.data(), &config);
    let (loss, _) = twin(fit.data(), fit.setups(), &turns[..1], &with_sets(&fit.state().unwrap().rows));
    let nothing: Vec<(Params, usize)> = Vec::new();
    let (empty, _) = twin(fit.data(), fit.setups(), &turns[..1], &nothing);
    assert!(loss < 0.03 * empty, "{loss} of {empty}");
    drop((trainer, renderer, fit));
    expect_silence(gpu);
}

#[test]
fn a_fit_finds_what_gaussians_can_show() {
    let gpu = gpu();
    let (dataset, config, _) = phantom_of_gaussians(&[
        "r2.init=random",
        "r2.n_points=40",
        "r2.density_lr_init=0.05",
        "r2.position_lr_init=3e-3",
        "r2.scaling_lr_init=0.02",
        "r2.lambda_tv=0",
    ]);
    let mut trainer =
        Trainer::new(&gpu, Plan::new(&config.clone().into_any(), &dataset).unwrap(), &dataset, tuning(&gpu)).unwrap();
    let losses = run(&mut trainer, 300);
    let mean = |l: &[f64]| l.iter().sum::<f64>() / l.len() as f64;
    let (first, last) = (mean(&losses[..9]), mean(&losses[291..]));
    assert!(last < 0.1 * first, "{first} to {last}");
    drop(trainer);
    expect_silence(gpu);
}

#[test]
fn clones_show_the_same_picture_and_split_ones_another() {
    let (dataset, config, rows) = phantom_of_gaussians(&[]);
    let gpu = gpu();
    let fit = R2Trainer::with(&gpu, data_of(&dataset, &config), &config, &R2State::fresh(rows.clone()), 0).unwrap();
    let picture = |rows: &[R2Gaussian]| {
        let mut picture = vec![0.0; 33 * 27];
        for g in rows {
            let seen = reference::project(&params(g), &fit.data().views[0], fit.setups().0).unwrap();
            seen.splat(fit.setups().0, &mut picture);
        }
        picture
    };
    let mut state = R2State::fresh(rows.clone());
    state.statistics = vec![[1.0, 1.0]; rows.len()];
    let after = |limit: f64| {
        let r2 = nertca_vk::config::sections::R2 { size_limit: limit, ..config.r2.clone() };
        densified(&state, 1, &r2, 1, 600)
    };
    let (before, cloned, split) = (picture(&rows), picture(&after(1.0).rows), picture(&after(0.0).rows));
    let peak = before.iter().fold(0f64, |m, v| m.max(*v));
    let off = |other: &[f64]| before.iter().zip(other).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
    assert!(after(1.0).rows.len() == 4 && off(&cloned) < 1e-6 * peak, "{}", off(&cloned));
    assert!(after(0.0).rows.len() == 4 && off(&split) > 0.05 * peak, "{}", off(&split));
    drop(fit);
    expect_silence(gpu);
}

/// A short configuration with strong effects of density control.
fn short(static_data: &str) -> Config<R2Settings> {
    let data = format!("r2.static_data={static_data}");
    config(&[
        &data,
        "train.iterations=60",
        "r2.densification_interval=10",
        "r2.densify_from_iter=5",
        "r2.densify_until_iter=45",
        "r2.densify_grad_threshold=1e-7",
        "r2.density_thresh=0.01",
        "r2.densify_scale_threshold=0.15",
    ])
}

fn start(gpu: &Gpu, config: &Config<R2Settings>, dataset: &Dataset) -> Trainer {
    Trainer::new(gpu, Plan::new(&config.clone().into_any(), dataset).unwrap(), dataset, tuning(gpu)).unwrap()
}

#[test]
fn runs_repeat_and_resume_bit_by_bit_across_density_control() {
    let gpu = gpu();
    let dataset = uneven_dataset(13, 11);
    for static_data in ["per-phase", "pooled"] {
        let config = short(static_data);
        let mut whole = start(&gpu, &config, &dataset);
        let losses = run(&mut whole, 60);
        // One stop is not at the end of a submit, the other is just after density control.
        for stop in [27, 30] {
            let mut parts = start(&gpu, &config, &dataset);
            let mut again = run(&mut parts, stop);
            let saved = parts.checkpoint().unwrap();
            let read = Checkpoint::from_bytes(&saved.to_bytes().unwrap(), "checkpoint".as_ref()).unwrap();
            assert_eq!((state_of(&read), &read.model.gaussians), (state_of(&saved), &saved.model.gaussians));
            let plan = Plan::new(&config.clone().into_any(), &dataset).unwrap().in_scene(read.model.scene.clone());
            let mut resumed = Trainer::resume(&gpu, plan, &dataset, tuning(&gpu), &read).unwrap();
            assert_eq!(resumed.step(), stop);
            again.extend(run(&mut resumed, 60));
            assert_eq!(losses, again, "{static_data}, stopped at {stop}");
            let (want, got) = (whole.checkpoint().unwrap(), resumed.checkpoint().unwrap());
            assert!(
                state_of(&want) == state_of(&got) && want.model.gaussians == got.model.gaussians,
                "{static_data}, {stop}"
            );
        }
        let state = state_of(&whole.checkpoint().unwrap());
        let first = first_rows(&data_of(&dataset, &config), &config.r2, config.seed).0.len();
        assert!(state.rows.len() > first, "{} after {first}", state.rows.len());
    }
    expect_silence(gpu);
}

#[test]
fn each_phase_sees_its_own_images_alone_unless_all_are_pooled() {
    let gpu = gpu();
    let dataset = small_dataset(13, 11);
    let mut other = dataset.clone();
    let changed = other.frames.iter_mut().filter(|f| f.phase == 1);
    changed.for_each(|f| f.integrals.iter_mut().for_each(|v| *v *= 0.5));
    for static_data in ["per-phase", "pooled"] {
        let config = short(static_data);
        let [fields, others] = [&dataset, &other].map(|dataset| {
            let mut trainer = start(&gpu, &config, dataset);
            run(&mut trainer, 8);
            let field = trainer.model().unwrap().gaussians.unwrap();
            [0, 1, 2].map(|phase| field.at(phase))
        });
        let same: Vec<bool> = fields.iter().zip(&others).map(|(a, b)| a == b).collect();
        let numbers = |phase: usize| fields[phase].iter().map(|g| (g.position, g.log_density)).collect::<Vec<_>>();
        if static_data == "pooled" {
            assert_eq!(same, [false; 3]);
            assert_eq!(numbers(0), numbers(2), "one field for all phases");
        } else {
            assert_eq!(same, [true, false, true]);
            assert_ne!(numbers(0), numbers(2));
        }
    }
    expect_silence(gpu);
}

#[test]
fn a_back_projection_from_all_around_is_the_object() {
    let n_views = 90;
    let angles: Vec<[f64; 2]> =
        (0..n_views).map(|i| [360.0 * f64::from(i) / f64::from(n_views) - 180.0, 0.0]).collect();
    let config = config(&["r2.half_extent_mm=20", "r2.normalise=false"]);
    // One Gaussian off centre, wide compared with the pixels.
    let (at, scale, peak) = (DVec3::new(0.03, -0.04, 0.0), 0.035, 1.7);
    let image = |_: usize, view: &View| {
        let pixel = |p: usize| {
            let (anchor, direction) = view.rays.pixel((p % 81) as f64, (p / 81) as f64);
            let along = direction.normalize();
            let across = (anchor - at) - along * (anchor - at).dot(along);
            (peak * std::f64::consts::TAU.sqrt() * scale * (-0.5 * (across.length() / scale).powi(2)).exp()) as f32
        };
        (0..81 * 61).map(pixel).collect()
    };
    let data = data_of(&dataset(&angles, [81, 61], image), &config);
    let side = 40;
    let volume = back_projection(&data, 0, side);
    let centre = |k: usize| 0.2 * ((2 * k + 1) as f64 / side as f64 - 1.0);
    let mut worst = 0f64;
    for (k, value) in volume.iter().enumerate() {
        let x = DVec3::new(centre(k % side), centre(k / side % side), centre(k / side / side));
        // The central plane is exact except for sampling, neighbouring planes nearly.
        if x.z.abs() < 0.02 && x.length() < 0.12 {
            let want = peak * (-0.5 * (x - at).length_squared() / scale.powi(2)).exp();
            worst = worst.max((f64::from(*value) - want).abs() / peak);
        }
    }
    assert!(worst < 0.03, "{worst}");
}

#[test]
fn a_start_without_candidates_is_said() {
    let dataset = small_dataset(13, 11);
    let of = |settings: &[&str]| {
        let config = config(settings);
        first_rows(&data_of(&dataset, &config), &config.r2, 1)
    };
    let (rows, notes) = of(&["r2.density_thresh=900"]);
    assert_eq!((rows.len(), notes.len()), (180, 3), "{notes:?}");
    assert!(notes[1].contains("phase 1") && notes[1].contains("at 0 voxels"), "{notes:?}");
    let (random, silent) = of(&["r2.init=random"]);
    assert!(silent.is_empty() && random == rows);
    let (from_images, silent) = of(&["r2.density_thresh=0.01"]);
    assert!(silent.is_empty() && from_images != rows && from_images.len() == 180, "{silent:?}");
}

#[test]
fn what_cannot_be_fitted_is_refused() {
    let gpu = gpu();
    let mut dataset = small_dataset(13, 11);
    let refused = |dataset: &Dataset| match Plan::new(&config(&[]).into_any(), dataset).map(|_| ()) {
        Err(Error::Config { problem, .. } | Error::Unmet { problem, .. }) => problem,
        other => panic!("{other:?}"),
    };
    dataset.frames[2].integrals[15] = f32::NAN;
    let problem = refused(&dataset);
    assert!(problem.contains("column 2, row 1"), "{problem}");
    let mut sizes = small_dataset(13, 11);
    sizes.views[0].size = [12, 11];
    assert!(refused(&sizes).contains("images of equal size"));
    // A damaged checkpoint is refused.
    let saved = start(&gpu, &config(&[]), &small_dataset(13, 11)).checkpoint().unwrap();
    let damaged = |damage: &dyn Fn(&mut R2State)| {
        let mut other = saved.clone();
        let mut state = state_of(&saved);
        damage(&mut state);
        other.fit = Arc::new(state);
        Checkpoint::from_bytes(&other.to_bytes().unwrap(), "checkpoint".as_ref()).err().map(|e| e.to_string())
    };
    assert_eq!(damaged(&|_| ()), None);
    assert!(damaged(&|state| state.rows[3].set = 3).unwrap().contains("r2.set"));
    assert!(damaged(&|state| state.second[3][5] = f32::NAN).unwrap().contains("r2.adam.v"));
    // All Gaussians are too weak.
    let config = config(&[
        "r2.density_min_threshold=1000",
        "r2.densification_interval=2",
        "r2.densify_from_iter=0",
        "r2.densify_until_iter=30",
    ]);
    let mut trainer = start(&gpu, &config, &small_dataset(13, 11));
    let error = (0..9).find_map(|_| trainer.advance(9).err()).unwrap().to_string();
    assert!(error.contains("phase 0 is left"), "{error}");
    drop(trainer);
    expect_silence(gpu);
}

#[test]
fn presets_and_notes_say_what_the_method_is() {
    let config = Config::preset(Preset::R2Gaussian);
    assert_eq!((config.gaussian_iterations(), config.train.iterations, N_PARAMS), (30_000, 30_000, 11));
    let plan = Plan::new(&config, &uneven_dataset(13, 11)).unwrap();
    let says = |part: &str| assert!(plan.notes.iter().any(|note| note.contains(part)), "{part}: {:?}", plan.notes);
    says("a static method");
    says("are used as frames of the nearest phase");
}
