//! X-Gaussian (the preset `x-gaussian`): stages equal their twins, and the twins agree with PyTorch and finite differences;
//! runs fit images of Gaussians that occlude each other, repeat and resume with equal bits across density control; lists
//! that exceed their capacity are enlarged, and nothing is lost.

use crate::common::{
    expect_agreement, expect_silence, gpu, relative_error, run, small_dataset, tuning, uneven_dataset,
};
use crate::golden_file::Golden;
use crate::one_phase::dataset;
use nertca_vk::checkpoint::Checkpoint;
use nertca_vk::config::sections::XSettings;
use nertca_vk::config::{Config, Preset};
use nertca_vk::error::Error;
use nertca_vk::fitting::shown::SetsFit;
use nertca_vk::gpu::device::Gpu;
use nertca_vk::kernels::layout::{BlendGaussian, PictureTurn, XStatistics};
use nertca_vk::methods::x_gaussian::data::XData;
use nertca_vk::methods::x_gaussian::densify::densified;
use nertca_vk::methods::x_gaussian::setup::turns;
use nertca_vk::methods::x_gaussian::start::first_state;
use nertca_vk::methods::x_gaussian::state::XState;
use nertca_vk::methods::x_gaussian::trainer::XTrainer;
use nertca_vk::plan::Plan;
use nertca_vk::render::renderer::Renderer;
use nertca_vk::scan::dataset::Dataset;
use nertca_vk::train::trainer::Trainer;
use nertca_vk_twins::reference::x_gaussian::{N_PARAMS, Params, params};
use nertca_vk_twins::selftest::x_gaussian::{TENSORS, compare, hard_case, numbers, small_config, twin, with_sets};
use std::sync::Arc;

fn config(settings: &[&str]) -> Config<XSettings> {
    small_config(settings).unwrap()
}

#[test]
fn every_stage_of_an_iteration_matches() {
    let gpu = gpu();
    expect_agreement(|findings| compare(&gpu, findings));
    expect_silence(gpu);
}

#[test]
fn twin_gradient_is_the_derivative_of_the_twin_loss() {
    let gpu = gpu();
    let config = config(&["x.lambda_dssim=0.4"]);
    let (data, state) = hard_case(&config).unwrap();
    let fit = XTrainer::with(&gpu, data, &config, &state, 0).unwrap();
    let n_sets = fit.data().n_sets();
    let shown = &turns(fit.data(), &config)[..n_sets];
    let all = with_sets(&state);
    let (_, gradient) = twin(&fit, shown, &all);
    let largest = gradient.iter().flatten().fold(0f64, |m, g| m.max(g.abs()));
    let mut compared = 0;
    // Gaussians count from an opacity of 1/255: the loss jumps there, and a difference across a jump is no derivative.
    let mut across_jumps = 0;
    for i in [0, 1, 2, 3, 4, 8, 9, 10, 11, 13, 14] {
        for (k, want) in gradient[i].iter().enumerate() {
            let loss = |h: f64| {
                let mut moved = all.clone();
                moved[i].0[k] += h;
                twin(&fit, shown, &moved).0
            };
            let difference = |h: f64| n_sets as f64 * (loss(h) - loss(-h)) / (2.0 * h);
            let fits = |h: f64| (difference(h) - want).abs() <= 1e-4 * want.abs() + 1e-6 * largest;
            if !fits(1e-6) {
                across_jumps += 1;
                assert!(fits(1e-7), "Gaussian {i}, {k}: {} against {want}", difference(1e-7));
            }
            compared += usize::from(want.abs() > 1e-4 * largest);
        }
    }
    assert!(compared > 60 && across_jumps <= 2, "{compared}, {across_jumps}");
    drop(fit);
    expect_silence(gpu);
}

/// State of the fit in a checkpoint.
fn state_of(checkpoint: &Checkpoint) -> XState {
    checkpoint.state::<XState>().unwrap().clone()
}

fn data_of(dataset: &Dataset, config: &Config<XSettings>) -> XData {
    Plan::new(&config.clone().into_any(), dataset).unwrap().data::<XData>().unwrap().clone()
}

#[test]
fn golden_values_of_pytorch() {
    let gpu = gpu();
    let golden = Golden::open("x", "tools/reference_x.py");
    let number = |key: &str| golden.case[key].as_f64().unwrap();
    let f32s = |name: &str| golden.get(name).iter().map(|v| *v as f32).collect::<Vec<f32>>();
    let angles = [0, 1].map(|v| [0, 1].map(|k| golden.case["angles"][v][k].as_f64().unwrap()));
    let size = [number("width_px") as usize, number("height_px") as usize];
    let dataset = dataset(&angles, size, |v, _| f32s(&format!("image/{v}")));
    let settings = [
        format!("train.iterations={}", number("iterations")),
        format!("x.half_extent_mm={}", number("half_mm")),
        format!("x.extent_mm={}", number("extent_mm")),
        format!("x.degree_every={}", number("degree_every")),
    ];
    let config = config(&settings.iter().map(String::as_str).collect::<Vec<_>>());
    let get = |name: &str| f32s(&format!("start/{name}"));
    let (position, scale, rotation) = (get("position"), get("scale"), get("rotation"));
    let (opacity, intensity) = (get("opacity"), get("intensity"));
    let row = |i: usize| BlendGaussian {
        position: position[3 * i..][..3].try_into().unwrap(),
        opacity: opacity[i],
        log_scale: scale[3 * i..][..3].try_into().unwrap(),
        intensity: intensity[i],
        rotation: rotation[4 * i..][..4].try_into().unwrap(),
    };
    let n = opacity.len();
    let state = XState::fresh((0..n).map(row).collect(), vec![0; n]);
    let data = data_of(&dataset, &config);
    assert_eq!(data.images[..data.n_pixels()], f32s("image/0"), "images that go from 0 to 1 stay");
    let mut fit = XTrainer::with(&gpu, data, &config, &state, 0).unwrap();
    let shown = golden.case["shown"].as_array().unwrap().iter();
    let turns: Vec<PictureTurn> =
        shown.map(|image| PictureTurn { image: image.as_u64().unwrap() as u32, ..PictureTurn::default() }).collect();
    gpu.upload(&fit.buffers().0.picture_turns, 0, &turns).unwrap();
    let (loss, gradient) = twin(&fit, &turns[..1], &with_sets(&state));
    let want_loss: f64 = golden.get("terms").iter().sum();
    assert!((loss / want_loss - 1.0).abs() < 1e-6, "{loss} against {want_loss}");
    let got = fit.advance(1).unwrap()[0];
    assert!((got / want_loss - 1.0).abs() < 1e-4, "{got} against {want_loss}");
    let pixels: Vec<i32> = gpu.download(&fit.buffers().0.splat_images, 0, dataset.n_pixels()).unwrap();
    let picture: Vec<f32> = pixels.iter().map(|v| *v as f32 / fit.setups().0.fixed_point).collect();
    let (error, at) = relative_error(&picture, &golden.get("picture"));
    assert!(error < 1e-4, "picture[{at}]: {error:.1e}");
    let on_device: Vec<[f32; N_PARAMS]> = gpu.download(&fit.particles().1.gaussian_gradient, 0, n).unwrap();
    let on_device: Vec<Params> = on_device.iter().map(|row| row.map(f64::from)).collect();
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

fn start(gpu: &Gpu, config: &Config<XSettings>, dataset: &Dataset) -> Trainer {
    Trainer::new(gpu, Plan::new(&config.clone().into_any(), dataset).unwrap(), dataset, tuning(gpu)).unwrap()
}

const SIDES: &[[f64; 2]] = &[[-30.0, 25.0], [60.0, -20.0], [5.0, 8.0]];

/// A bright disc in front of a faint one, as far as each view shows them.
fn discs() -> Dataset {
    dataset(SIDES, [33, 27], |_, view| {
        let near = |p: usize, place: [f64; 3], reach: f64| {
            let (column, row) = view.rays.project(glam::DVec3::from_array(place)).unwrap();
            ((p % 33) as f64 - column).hypot((p / 33) as f64 - row) < reach
        };
        let value = |p: usize| {
            let (bright, faint) = (near(p, [0.03, 0.0, 0.02], 5.0), near(p, [-0.04, 0.02, -0.03], 7.0));
            if bright { 0.9 } else { f32::from(u8::from(faint)) * 0.4 }
        };
        (0..33 * 27).map(value).collect()
    })
}

#[test]
fn a_fit_shows_discs_that_hide_each_other_and_models_draw_what_fits_see() {
    let gpu = gpu();
    let dataset = discs();
    let config = config(&[
        "train.iterations=300",
        "x.half_extent_mm=15",
        "x.voxels=24",
        "x.interval=2",
        "x.position_lr_init=5e-4",
        "x.position_lr_final=5e-4",
        "x.opacity_lr=0.05",
        "x.scaling_lr=0.02",
        "x.feature_lr=0.05",
    ]);
    let mut trainer = start(&gpu, &config, &dataset);
    let losses = run(&mut trainer, 300);
    let mean = |l: &[f64]| l.iter().sum::<f64>() / l.len() as f64;
    let (first, last) = (mean(&losses[..9]), mean(&losses[291..]));
    assert!(last < 0.25 * first, "{first} to {last}");
    let saved = trainer.checkpoint().unwrap();
    let renderer = Renderer::new(&gpu, &saved.model, tuning(&gpu)).unwrap();
    assert!(renderer.is_blended());
    let x = &state_of(&saved);
    let mut fit = XTrainer::with(&gpu, data_of(&dataset, &config), &config, x, 299).unwrap();
    fit.advance(300).unwrap();
    let image = turns(fit.data(), &config)[299].image as usize;
    let pixels: Vec<i32> = gpu.download(&fit.buffers().0.splat_images, 0, dataset.n_pixels()).unwrap();
    let want: Vec<f64> = pixels.iter().map(|v| f64::from(*v) / f64::from(fit.setups().0.fixed_point)).collect();
    let drawn = renderer.render(&dataset.views[image].rays, 33, 27, 0).unwrap();
    // A pixel may gain or lose a faint Gaussian by rounding.
    let off = drawn.dynamic_integral.iter().zip(&want).map(|(a, b)| (f64::from(*a) - b).abs()).fold(0.0, f64::max);
    assert!(off < 5e-3, "{off}");
    let close = drawn.dynamic_integral.iter().zip(&want).filter(|(a, b)| (f64::from(**a) - **b).abs() < 1e-4).count();
    assert!(close * 100 > 98 * want.len(), "{close} of {}", want.len());
    assert!(drawn.static_integral.iter().all(|v| *v == 0.0));
    // The attenuation is the sum of opacities, per 100 mm.
    for pixel in [16 * 33 + 16, 5 * 33 + 20] {
        let (anchor, direction) = dataset.views[image].rays.pixel((pixel % 33) as f64, (pixel / 33) as f64);
        let sum = |depth: f64| -> f64 {
            let at = 100.0 * (anchor + depth * direction);
            let of = |g: &BlendGaussian| {
                let away = g.axes().transpose() * (at - g.centre()) / g.scales();
                g.shown_opacity() * (-0.5 * away.length_squared()).exp()
            };
            x.rows.iter().map(of).sum()
        };
        let want = (-1000..=1000).map(|k| sum(5e-4 * f64::from(k))).fold(0.0, f64::max);
        let got = f64::from(drawn.total_max[pixel]);
        assert!(want > 0.01 && (got / want - 1.0).abs() < 0.03, "{got} against {want}");
    }
    drop((trainer, renderer, fit));
    expect_silence(gpu);
}

/// A short configuration with strong effects of density control and with a reset.
fn short(static_data: &str) -> Config<XSettings> {
    let data = format!("x.static_data={static_data}");
    config(&[
        &data,
        "train.iterations=60",
        "x.densification_interval=10",
        "x.densify_from_iter=5",
        "x.densify_until_iter=45",
        "x.densify_grad_threshold=1e-7",
        "x.opacity_reset_interval=25",
        "x.degree_every=7",
    ])
}

#[test]
fn runs_repeat_and_resume_bit_by_bit_across_density_control() {
    let gpu = gpu();
    let dataset = uneven_dataset(21, 18);
    for static_data in ["per-phase", "pooled"] {
        let config = short(static_data);
        let mut whole = start(&gpu, &config, &dataset);
        let losses = run(&mut whole, 60);
        // The stops are: not at the end of a submit, just after a reset of opacities, and just after density control.
        for stop in [13, 25, 30] {
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
        let first = first_state(&data_of(&dataset, &config), &config.x).rows.len();
        assert!(state.rows.len() > first, "{} after {first}", state.rows.len());
    }
    expect_silence(gpu);
}

#[test]
fn lists_that_outgrow_their_room_get_more_and_nothing_is_lost() {
    let gpu = gpu();
    let config = config(&["train.iterations_per_submit=5"]);
    let (data, state) = hard_case(&config).unwrap();
    let losses = |capacity: Option<u32>| {
        let mut fit = XTrainer::with(&gpu, data.clone(), &config, &state, 0).unwrap();
        capacity.map_or(Ok(()), |capacity| fit.set_capacity(capacity)).unwrap();
        let mut losses = Vec::new();
        while fit.step() < 15 {
            let more = fit.advance(15).unwrap();
            assert!(!more.is_empty());
            losses.extend(more);
            assert_eq!(losses.len(), fit.step() as usize);
        }
        (losses, fit.state().unwrap(), fit.setups().1.capacity)
    };
    let want = losses(None);
    assert_eq!(want.0.len(), 15);
    for capacity in [1, 150] {
        let got = losses(Some(capacity));
        assert!(got.0 == want.0 && got.1 == want.1, "room for {capacity} at first");
        assert!(got.2 > capacity, "{}", got.2);
    }
    // The device has no buffer of this size.
    let error = nertca_vk::gaussians::blending::picture::more_capacity(
        1001,
        1000,
        ("x.max_gaussians", 7),
        "a larger x.interval",
    )
    .unwrap_err()
    .to_string();
    assert!(error.contains("1001") && error.contains("x.interval"), "{error}");
    expect_silence(gpu);
}

#[test]
fn each_phase_sees_its_own_images_alone_unless_all_are_pooled() {
    let gpu = gpu();
    let dataset = small_dataset(21, 18);
    let mut other = dataset.clone();
    let changed = other.frames.iter_mut().filter(|f| f.phase == 1);
    changed.for_each(|f| f.integrals.reverse());
    for static_data in ["per-phase", "pooled"] {
        let config = short(static_data);
        let [fields, others] = [&dataset, &other].map(|dataset| {
            let mut trainer = start(&gpu, &config, dataset);
            run(&mut trainer, 8);
            let field = trainer.model().unwrap().gaussians.unwrap();
            [0, 1, 2].map(|phase| field.rows().blended_at(phase))
        });
        let same: Vec<bool> = fields.iter().zip(&others).map(|(a, b)| a == b).collect();
        let numbers = |phase: usize| {
            fields[phase].iter().map(|(g, shown)| (g.position, g.log_density, *shown)).collect::<Vec<_>>()
        };
        assert!(!numbers(0).is_empty());
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
fn clones_and_children_show_more() {
    let gpu = gpu();
    let config = config(&[]);
    let (data, mut state) = hard_case(&config).unwrap();
    state.statistics = vec![XStatistics { pull: 1.0, seen: 1.0, radius: 0.0 }; state.rows.len()];
    let extent = data.extent_mm;
    let after = |limit: f64| {
        let x = nertca_vk::config::sections::X { size_limit: limit, min_opacity: 0.0, ..config.x.clone() };
        densified(&state, data.n_sets(), &x, extent, (1, 600))
    };
    // The opacity doubles where a clone lies on its original.
    let shown = |state: &XState| {
        let mut fit = XTrainer::with(&gpu, data.clone(), &config, state, 0).unwrap();
        fit.advance(1).unwrap();
        let pixels: Vec<i32> = gpu.download(&fit.buffers().0.splat_images, 0, data.n_pixels()).unwrap();
        pixels.iter().map(|v| i64::from(*v)).sum::<i64>()
    };
    let (before, cloned, split) = (shown(&state), shown(&after(10.0)), shown(&after(0.0)));
    assert_eq!((after(10.0).rows.len(), after(0.0).rows.len()), (2 * state.rows.len(), 2 * state.rows.len()));
    assert!(cloned > before + before / 20 && split != before && split != cloned, "{before} {cloned} {split}");
    expect_silence(gpu);
}

#[test]
fn what_cannot_be_fitted_is_refused() {
    let gpu = gpu();
    let mut dataset = small_dataset(21, 18);
    let refused = |dataset: &Dataset| match Plan::new(&config(&[]).into_any(), dataset).map(|_| ()) {
        Err(Error::Config { problem, .. } | Error::Unmet { problem, .. }) => problem,
        other => panic!("{other:?}"),
    };
    dataset.frames[2].integrals[24] = f32::NAN;
    let problem = refused(&dataset);
    assert!(problem.contains("column 3, row 1"), "{problem}");
    let mut sizes = small_dataset(21, 18);
    sizes.views[0].size = [20, 18];
    assert!(refused(&sizes).contains("images of equal size"));
    let one = of_one_view(&small_dataset(21, 18));
    assert!(refused(&one).contains("the same source position"), "{}", refused(&one));
    assert!(Plan::new(&config(&["x.extent_mm=400"]).into_any(), &one).is_ok());
    // A damaged checkpoint is refused.
    let saved = start(&gpu, &config(&[]), &small_dataset(21, 18)).checkpoint().unwrap();
    let damaged = |damage: &dyn Fn(&mut XState)| {
        let mut other = saved.clone();
        let mut state = state_of(&saved);
        damage(&mut state);
        other.fit = Arc::new(state);
        Checkpoint::from_bytes(&other.to_bytes().unwrap(), "checkpoint".as_ref()).err().map(|e| e.to_string())
    };
    assert_eq!(damaged(&|_| ()), None);
    assert!(damaged(&|state| state.sets[3] = 3).unwrap().contains("x.set"));
    assert!(damaged(&|state| state.second[3][5] = f32::NAN).unwrap().contains("x.adam.v"));
    // All are too faint: opacities are reset below the pruning threshold.
    let config = config(&[
        "x.opacity_reset_interval=2",
        "x.reset_opacity=0.001",
        "x.densification_interval=3",
        "x.densify_from_iter=0",
    ]);
    let mut trainer = start(&gpu, &config, &small_dataset(21, 18));
    let error = (0..9).find_map(|_| trainer.advance(9).err()).unwrap().to_string();
    assert!(error.contains("phase 0 is left"), "{error}");
    drop(trainer);
    expect_silence(gpu);
}

/// Returns the dataset with all images assigned to one view.
fn of_one_view(dataset: &Dataset) -> Dataset {
    let mut one = dataset.clone();
    one.frames.iter_mut().for_each(|frame| frame.view = 0);
    one
}

#[test]
fn presets_and_notes_say_what_the_method_is() {
    let config = Config::preset(Preset::XGaussian);
    assert_eq!((config.gaussian_iterations(), config.train.iterations), (20_000, 20_000));
    let mut dataset = uneven_dataset(21, 18);
    dataset.vessel_attenuation = None;
    dataset.frames[0].integrals[0] = 7.0;
    let plan = Plan::new(&config, &dataset).unwrap();
    let says = |part: &str| assert!(plan.notes.iter().any(|note| note.contains(part)), "{part}: {:?}", plan.notes);
    says("a static method");
    says("are used as frames of the nearest phase");
    says("exceed x.clamp = 1");
    let data = data_of(&dataset, &config.of().unwrap());
    assert!(data.images.iter().all(|v| (0.0..=1.0).contains(v)) && data.images.contains(&1.0));
}
