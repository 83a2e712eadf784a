//! Every training kernel against its f64 twin, through whole iterations on the device, with validation on.
#![allow(missing_docs, clippy::unwrap_used, clippy::expect_used)]

mod common;

use common::{expect_silence, gpu, relative_error, small_config, small_dataset, tuning};
use nertca_vk::gpu::buffer::Operands;
use nertca_vk::kernels::constants::{CELLS_PER_WORD, NEAR_SAMPLE, OCCUPIED, SEEN};
use nertca_vk::kernels::layout::Ray;
use nertca_vk::kernels::tuning::{Layers, MatrixTuning, Tuning};
use nertca_vk::plan::Plan;
use nertca_vk::reference::field::Precision;
use nertca_vk::reference::{march, occupancy, step};
use nertca_vk::train::trainer::Trainer;

/// Presets and variations whose gradients are checked. Each covers a branch the others do not.
const CASES: &[(&str, &[&str])] = &[
    ("paper", &["dynamic.occlusion=1e-3"]),
    ("public-code", &["dynamic.occlusion=1e-3"]),
    ("fast-mlp", &[]),
    // odd bands, five ranks (two vec4), no power of two anywhere, batch of one ray
    ("fast-mlp", &["dynamic.bands=5", "static.ranks=5", "static.grid=7", "train.rays=4", "march.dynamic_samples=33"]),
    // more than 32 depths a lane
    ("fast-mlp", &["march.dynamic_samples=1100", "train.rays=3", "train.chunk_samples=3500"]),
    // a field asleep, that rays call back
    ("fast-mlp", &["dynamic.best_start=false", "dynamic.normalised_shift=-9", "dynamic.least_slope=0.05"]),
    // a single hidden layer, skip in a deep net, wide layers
    ("paper", &["dynamic.layers=1", "dynamic.width=16", "loss.normalise=true"]),
    ("public-code", &["dynamic.layers=6", "dynamic.skip_layer=3", "dynamic.width=48", "dynamic.latent=12"]),
];

#[test]
fn rays_and_depths_match() {
    let gpu = gpu();
    let dataset = small_dataset(13, 11);
    let plan = Plan::new(
        &small_config("fast-mlp", &["hull.enabled=true", "hull.max_share=1", "hull.resolution=24"]),
        &dataset,
    )
    .unwrap();
    assert!(plan.hull.is_some(), "this case is about the hull");
    let mut trainer = Trainer::new(&gpu, plan, &dataset, tuning(&gpu)).unwrap();
    let losses = trainer.advance(1).unwrap();
    let plan = trainer.plan();
    let got: Vec<Ray> = gpu.download(&trainer.forward().rays, 0, plan.setup.n_rays as usize).unwrap();
    let want = march::batch(plan, losses.last().unwrap().step - 1);
    let params: Vec<f64> = plan.params.initial(&plan.config).iter().map(|v| f64::from(*v)).collect();
    let mut live = 0;
    for (g, w) in got.iter().zip(&want) {
        assert_eq!((g.id, g.phase as usize), (w.id, w.phase));
        for axis in 0..3 {
            assert!((f64::from(g.anchor[axis]) - w.anchor[axis]).abs() < 1e-6);
            assert!((f64::from(g.direction[axis]) - w.direction[axis]).abs() < 1e-6);
        }
        assert!((f64::from(g.temporal_low) - w.temporal[0]).abs() < 1e-6);
        assert!((f64::from(g.temporal_high) - w.temporal[1]).abs() < 1e-6);
        live += march::fwd(plan, &params, 0, w, false, Precision::Exact).dynamics.len();
    }
    assert!(live > 20, "the case must have live samples, has {live}");
    // A sample on a cell face may fall either way in f32.
    assert!((losses[0].live_samples as i64 - live as i64).abs() <= 2, "{} live, twin {live}", losses[0].live_samples);
    drop(trainer);
    expect_silence(gpu);
}

/// Both families of kernels: operands through texel buffers with small workgroups, as an old lavapipe gets
/// them, and through storage buffers with large ones, as GPUs do.
fn paths() -> [Tuning; 3] {
    let f32_layers = |operands, layer_lanes, weight_lanes, splits, private_line_bytes| Tuning {
        layers: Layers::F32,
        operands,
        layer_lanes,
        weight_lanes,
        splits,
        matrices: MatrixTuning { workgroups: 1, largest_tile: 16, unroll: false },
        private_line_bytes,
        chunk_samples: 1 << 16,
        iterations_per_submit: None,
        overlap: false,
        reasons: Vec::new(),
    };
    [
        f32_layers(Operands::Texel, 8, 8, 4, 0),
        f32_layers(Operands::Storage, 64, 32, 16, 16384),
        f32_layers(Operands::Address, 8, 4, 3, 0),
    ]
}

#[test]
fn losses_and_gradients_match() {
    for path in paths() {
        check_losses_and_gradients(&path);
    }
}

fn check_losses_and_gradients(path: &Tuning) {
    let gpu = gpu();
    let dataset = small_dataset(13, 11);
    for (preset, settings) in CASES {
        let mut plan = Plan::new(&small_config(preset, settings), &dataset).unwrap();
        if settings.iter().any(|setting| setting.starts_with("dynamic.least_slope")) {
            // Every ray asks for more.
            plan.images.iter_mut().for_each(|value| *value += 1.0);
        }
        // Larger planes and lines than the default start, so that static gradients are not tiny products.
        let mut params = plan.params.initial(&plan.config);
        for p in &mut params[..plan.params.static_len] {
            *p *= 30.0;
        }
        let twin: Vec<f64> = params.iter().map(|v| f64::from(*v)).collect();
        let mut trainer = Trainer::new(&gpu, plan, &dataset, path.clone()).unwrap();
        gpu.upload(&trainer.forward().params, 0, &params).unwrap();
        let got = trainer.advance(1).unwrap()[0];
        let plan = trainer.plan();
        let (want, gradient) = step::loss_and_gradient(plan, &twin, 0, &march::batch(plan, 0), Precision::Exact);
        for (name, g, w) in [
            ("data", got.data, want.data),
            ("dynamic", got.dynamic, want.dynamic),
            ("tv", got.tv, want.tv),
            ("occlusion", got.occlusion, want.occlusion),
        ] {
            assert!((g - w).abs() <= 2e-5 * w.abs() + 1e-12, "{preset} {settings:?} {name}: {g} against {w}");
        }
        let on_device: Vec<f32> = gpu.download(&trainer.training().gradient, 0, plan.params.len).unwrap();
        // Tensor by tensor, so that a missing small gradient cannot hide behind a large one.
        for tensor in plan.params.tensors() {
            let pick = |v: &dyn Fn(usize) -> f64| tensor.positions.iter().map(|p| v(*p as usize)).collect::<Vec<_>>();
            let want = pick(&|i| gradient[i]);
            let got: Vec<f32> = tensor.positions.iter().map(|p| on_device[*p as usize]).collect();
            let (error, at) = relative_error(&got, &want);
            // f32 sums of a few thousand terms; ReLU kinks are not crossed by rounding in these cases.
            assert!(
                error < 1e-4,
                "{preset} {settings:?} {}[{at}]: {} against {} ({error:.1e})",
                tensor.name,
                got[at],
                want[at]
            );
            assert!(want.iter().any(|v| *v != 0.0), "{preset} {settings:?} {} has no gradient at all", tensor.name);
        }
    }
    expect_silence(gpu);
}

#[test]
fn occupancy_is_learned_and_heeded() {
    let gpu = gpu();
    let dataset = small_dataset(13, 11);
    // A field that stays as it starts, and a threshold that most of its values are below, so that both kinds of cells occur.
    let settings =
        ["occupancy.start=100", "occupancy.cells=9", "dynamic.lr=0", "dynamic.lr_end=0", "train.iterations=200"];
    let mut plan = Plan::new(&small_config("fast-mlp", &settings), &dataset).unwrap();
    let mut first = Trainer::new(&gpu, Plan::new(&plan.config, &dataset).unwrap(), &dataset, tuning(&gpu)).unwrap();
    let live = first.advance(1).unwrap()[0].live_samples as usize;
    let mut sigma: Vec<[f32; 2]> = gpu.download(&first.forward().sample_sigma, 0, live).unwrap();
    sigma.sort_by(|a, b| a[0].total_cmp(&b[0]));
    plan.setup.occupancy_threshold = sigma[live * 9 / 10][0];
    drop(first);
    let mut trainer = Trainer::new(&gpu, plan, &dataset, tuning(&gpu)).unwrap();
    let words = 3 * trainer.plan().setup.occupancy_words();
    let notes = |trainer: &Trainer| -> Vec<u32> { gpu.download(&trainer.forward().occupancy, 0, words).unwrap() };
    let advance = |trainer: &mut Trainer, until: u32| {
        let mut last = None;
        while trainer.step() < until {
            last = trainer.advance(until).unwrap().last().copied().or(last);
        }
        last.unwrap()
    };
    // What one iteration notes: step 64 starts the second epoch.
    advance(&mut trainer, 64);
    let before = notes(&trainer);
    let live = advance(&mut trainer, 65).live_samples as usize;
    let after = notes(&trainer);
    let setup = trainer.plan().setup;
    let points: Vec<[f32; 4]> = gpu.download(&trainer.forward().sample_points, 0, live).unwrap();
    let rays: Vec<u32> = gpu.download(&trainer.forward().sample_rays, 0, live).unwrap();
    let sigma: Vec<[f32; 2]> = gpu.download(&trainer.forward().sample_sigma, 0, live).unwrap();
    let batch: Vec<Ray> = gpu.download(&trainer.forward().rays, 0, setup.n_rays as usize).unwrap();
    let mut want = before[words / 3..2 * words / 3].to_vec();
    let mut kinds = [0; 2];
    for ((point, ray), sigma) in points.iter().zip(&rays).zip(&sigma) {
        let x = glam::DVec3::new(point[0].into(), point[1].into(), point[2].into());
        let entry = occupancy::entry(&setup, x, batch[(ray & !NEAR_SAMPLE) as usize].phase);
        let full = sigma[0] > setup.occupancy_threshold;
        kinds[usize::from(full)] += 1;
        let bits = SEEN | if full { OCCUPIED } else { 0 };
        want[(entry / CELLS_PER_WORD) as usize] |= bits << (2 * (entry % CELLS_PER_WORD));
    }
    assert!(kinds.iter().all(|n| *n > 10), "the case must have both kinds, has {kinds:?}");
    assert_eq!(after[words / 3..2 * words / 3], want);
    assert_eq!(after[..words / 3], before[..words / 3], "the epoch before is left alone");
    // Heeded: the samples of a later iteration are those the twin lets live.
    advance(&mut trainer, 150);
    let noted = notes(&trainer);
    let live = advance(&mut trainer, 151).live_samples as i64;
    let plan = trainer.plan();
    let (mut all, mut kept) = (0, 0i64);
    for ray in march::batch(plan, 150) {
        let s = &plan.setup;
        for (t, _) in march::depths(s, s.n_dynamic_samples, s.dynamic_near, s.dynamic_far, 150, &ray) {
            let x = ray.anchor + t * ray.direction;
            if march::dynamic_inside(plan, x, ray.phase) {
                all += 1;
                kept += i64::from(occupancy::occupied(s, &noted, x, ray.phase as u32, 150));
            }
        }
    }
    assert!(kept * 10 < all * 9, "{kept} of {all}: the case must leave samples out");
    // A sample on a cell face may fall either way in f32.
    assert!((live - kept).abs() <= 1 + kept / 50, "{live} live, twin {kept} of {all}");
    drop(trainer);
    expect_silence(gpu);
}

#[test]
fn ten_updates_across_the_delay_match() {
    let gpu = gpu();
    let dataset = small_dataset(9, 8);
    for preset in ["paper", "public-code", "fast-mlp"] {
        // Starts at the sixth iteration; the optimiser is re-created there. A softer shift than -10 lets
        // the network move, so that the comparison sees it.
        let settings =
            ["dynamic.delay=5", "dynamic.lr=1e-3", "dynamic.lr_end=1e-4", "adam.epsilon=1e-6", "loss.normalise=true"];
        let plan = Plan::new(&small_config(preset, &settings), &dataset).unwrap();
        let mut params: Vec<f64> = plan.params.initial(&plan.config).iter().map(|v| f64::from(*v)).collect();
        let start = params.clone();
        let mut moments = vec![[0.0; 2]; params.len()];
        let mut trainer = Trainer::new(&gpu, plan, &dataset, tuning(&gpu)).unwrap();
        while trainer.step() < 10 {
            trainer.advance(10).unwrap();
        }
        let plan = trainer.plan();
        for step in 0..10 {
            let (_, gradient) =
                step::loss_and_gradient(plan, &params, step, &march::batch(plan, step), Precision::Exact);
            step::adam(plan, step, &gradient, &mut params, &mut moments);
        }
        let got = trainer.model().unwrap().params;
        let moved = |range: std::ops::Range<usize>| range.map(|i| (params[i] - start[i]).abs()).fold(0.0, f64::max);
        let split = trainer.plan().params.static_len;
        assert!(moved(0..split) > 1e-3 && moved(split..params.len()) > 1e-3, "{preset}: both fields must move");
        let mut far = 0;
        for (g, w) in got.iter().zip(&params) {
            // Adam divides by the gradient's size, so a tiny gradient's rounding shows in full; few may.
            far += usize::from((f64::from(*g) - w).abs() > 1e-4 * w.abs().max(1e-2));
        }
        assert!(far * 200 <= got.len(), "{preset}: {far} of {} parameters differ", got.len());
    }
    expect_silence(gpu);
}

/// Behind a blade nothing is drawn: the twin's rays, and none of them hidden, whether they meet the hull or not.
#[test]
fn hidden_pixels_are_never_drawn() {
    let gpu = gpu();
    let mut dataset = small_dataset(13, 11);
    let blade: Vec<bool> = (0..dataset.n_pixels()).map(|p| p % 13 < 7).collect();
    dataset.hidden.insert(0, blade.clone());
    let settings = ["hull.enabled=true", "hull.max_share=1", "hull.resolution=24", "train.rays=400"];
    let plan = Plan::new(&small_config("fast-mlp", &settings), &dataset).unwrap();
    assert!(plan.setup.n_motion_list > 0 && plan.setup.n_shown_list > 0, "the case is about both lists");
    let mut trainer = Trainer::new(&gpu, plan, &dataset, tuning(&gpu)).unwrap();
    let step = trainer.advance(1).unwrap().last().unwrap().step - 1;
    let plan = trainer.plan();
    let got: Vec<Ray> = gpu.download(&trainer.forward().rays, 0, plan.setup.n_rays as usize).unwrap();
    let want = march::batch(plan, step);
    let mut of_view = [0, 0];
    for (got, want) in got.iter().zip(&want) {
        assert_eq!(got.id, want.id);
        let (frame, pixel) = (got.id / plan.setup.n_pixels, got.id % plan.setup.n_pixels);
        let view = dataset.training()[frame as usize].view;
        assert!(view != 0 || !blade[pixel as usize], "ray {} is hidden", got.id);
        of_view[usize::from(view != 0)] += 1;
    }
    assert!(of_view.iter().all(|n| *n > 20), "rays of the view behind the blade, and of others: {of_view:?}");
    drop(trainer);
    expect_silence(gpu);
}
