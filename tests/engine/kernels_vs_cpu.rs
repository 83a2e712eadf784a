//! Comparison of every training kernel with its f64 twin, through whole iterations on the device, with validation.

use crate::common::{expect_agreement, expect_silence, gpu, small_config, small_dataset, tuning, uneven_dataset};
use nertca_vk::fields::data::FieldData;
use nertca_vk::gpu::buffer::{Memory, Operands};
use nertca_vk::gpu::record::Recording;
use nertca_vk::kernels::layout::Ray;
use nertca_vk::kernels::tuning::{Layers, MatrixTuning, Tuning};
use nertca_vk::plan::Plan;
use nertca_vk::train::trainer::Trainer;
use nertca_vk_twins::reference::field::Precision;
use nertca_vk_twins::reference::{march, step};
use nertca_vk_twins::selftest::iteration::{self, F32_CASES};
use nertca_vk_twins::selftest::occupancy;

#[test]
fn barriers_follow_from_what_commands_touch() {
    let gpu = gpu();
    let buffer = |name| gpu.buffer(name, 64, Memory::Device).unwrap();
    let (a, b, c) = (buffer("a"), buffer("b"), buffer("c"));
    let waits = |commands: &dyn Fn(&mut Recording)| {
        let mut recording = Recording::new(&gpu, "commands").unwrap();
        commands(&mut recording);
        recording.finish().unwrap().barriers()
    };
    assert_eq!(waits(&|_| ()), 1, "for what was submitted before");
    let [from_a_to_b, from_a_to_c, from_b_to_c] =
        [(&a, &b), (&a, &c), (&b, &c)].map(|(from, to)| move |r: &mut Recording| r.copy(from, 0, to, 0, 64).unwrap());
    let fill = |r: &mut Recording| r.fill(&a, 1);
    let both = |first: &dyn Fn(&mut Recording), second: &dyn Fn(&mut Recording)| {
        waits(&|r| {
            first(r);
            second(r);
        })
    };
    assert_eq!(both(&from_a_to_b, &from_a_to_c), 1, "reads do not wait for reads");
    assert_eq!(both(&fill, &from_b_to_c), 1, "nor for what they do not touch");
    assert_eq!(both(&fill, &from_a_to_b), 2, "reads wait for writes");
    assert_eq!(both(&from_a_to_b, &fill), 2, "writes for reads");
    assert_eq!(both(&from_a_to_c, &from_b_to_c), 2, "and for writes");
    drop((a, b, c));
    expect_silence(gpu);
}

#[test]
fn an_iteration_waits_where_it_must() {
    let gpu = gpu();
    let tuning = tuning(&gpu).with_layers(Layers::F32, String::new());
    let dataset = small_dataset(13, 11);
    let barriers = ["fast-mlp", "public-code", "nerf-ca"].map(|preset| {
        let plan = Plan::new(&small_config(preset, &[]), &dataset).unwrap();
        Trainer::new(&gpu, plan, &dataset, tuning.clone()).unwrap().measured().unwrap().barriers().unwrap()
    });
    assert_eq!(barriers, [21, 25, 36]);
    expect_silence(gpu);
}

#[test]
fn rays_and_depths_match() {
    let gpu = gpu();
    let dataset = uneven_dataset(13, 11);
    let plan = Plan::new(
        &small_config("fast-mlp", &["hull.enabled=true", "hull.max_share=1", "hull.resolution=24"]),
        &dataset,
    )
    .unwrap();
    assert!(plan.hull.is_some(), "this case is about the hull");
    let mut trainer = Trainer::new(&gpu, plan, &dataset, tuning(&gpu)).unwrap();
    let losses = trainer.advance(1).unwrap();
    let plan = trainer.fields().unwrap().data();
    let got: Vec<Ray> = gpu.download(&trainer.fields().unwrap().forward().rays, 0, plan.setup.n_rays as usize).unwrap();
    let want = march::batch(plan, losses.last().unwrap().step - 1);
    let params: Vec<f64> = plan.params.initial(plan.settings.seed).iter().map(|v| f64::from(*v)).collect();
    let mut live = 0;
    for (g, w) in got.iter().zip(&want) {
        let [(nearest, _), (beyond, share)] = w.shown;
        assert_eq!((g.id, g.phase as usize, g.beyond as usize), (w.id, nearest, beyond));
        assert!((f64::from(g.beyond_share) - share).abs() < 1e-7);
        for axis in 0..3 {
            assert!((f64::from(g.anchor[axis]) - w.anchor[axis]).abs() < 1e-6);
            assert!((f64::from(g.direction[axis]) - w.direction[axis]).abs() < 1e-6);
        }
        assert!((f64::from(g.temporal_low) - w.temporal[0]).abs() < 1e-6);
        assert!((f64::from(g.temporal_high) - w.temporal[1]).abs() < 1e-6);
        let near = march::NearPart::of(plan, 0, &want);
        live += march::fwd(plan, &params, 0, w, near, false, Precision::Exact).dynamics.len();
    }
    assert!(live > 20, "the case must have live samples, has {live}");
    // A sample on a cell face may belong to either cell in f32.
    assert!((losses[0].live_samples as i64 - live as i64).abs() <= 2, "{} live, twin {live}", losses[0].live_samples);
    drop(trainer);
    expect_silence(gpu);
}

/// Both families of kernels: operands through texel buffers with small workgroups, as for an old lavapipe, and through
/// storage buffers with large ones, as for GPUs.
fn paths() -> [Tuning; 3] {
    let f32_layers = |operands, layer_lanes, weight_lanes, splits, march_lanes, private_line_bytes| Tuning {
        layers: Layers::F32,
        operands,
        layer_lanes,
        weight_lanes,
        splits,
        matrices: MatrixTuning::CPU,
        march_lanes,
        ray_lanes: 32,
        private_line_bytes,
        chunk_samples: 1 << 16,
        iterations_per_submit: None,
        longest_submit_s: None,
        overlap: false,
        reasons: Vec::new(),
    };
    [
        f32_layers(Operands::Texel, 8, 8, 4, 32, 0),
        f32_layers(Operands::Storage, 64, 32, 16, 64, 16384),
        f32_layers(Operands::Address, 8, 4, 3, 32, 0),
    ]
}

#[test]
fn every_stage_of_an_iteration_matches() {
    let gpu = gpu();
    let dataset = uneven_dataset(13, 11);
    for path in paths() {
        expect_agreement(|findings| {
            F32_CASES.iter().try_for_each(|case| iteration::compare(&gpu, &dataset, case, &path, findings))
        });
    }
    expect_silence(gpu);
}

#[test]
fn occupancy_is_learned_and_heeded() {
    let gpu = gpu();
    expect_agreement(|findings| occupancy::compare(&gpu, &uneven_dataset(13, 11), &tuning(&gpu), findings));
    expect_silence(gpu);
}

#[test]
fn ten_updates_across_the_delay_match() {
    let gpu = gpu();
    let dataset = uneven_dataset(9, 8);
    for preset in ["paper", "public-code", "fast-mlp"] {
        // The dynamic field starts at the sixth iteration, where the optimiser is re-created. A softer shift than -10 lets
        // the network change, so that the comparison is sensitive to it.
        let settings =
            ["dynamic.delay=5", "dynamic.lr=1e-3", "dynamic.lr_end=1e-4", "adam.epsilon=1e-6", "loss.normalise=true"];
        let plan = Plan::new(&small_config(preset, &settings), &dataset).unwrap();
        let mut params: Vec<f64> = plan.params.initial(plan.config.seed).iter().map(|v| f64::from(*v)).collect();
        let start = params.clone();
        let mut moments = vec![[0.0; 2]; params.len()];
        let mut trainer = Trainer::new(&gpu, plan, &dataset, tuning(&gpu)).unwrap();
        while trainer.step() < 10 {
            trainer.advance(10).unwrap();
        }
        let plan = trainer.fields().unwrap().data();
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
            // Adam divides by the gradient's size, so rounding errors of tiny gradients appear in full; only few may.
            far += usize::from((f64::from(*g) - w).abs() > 1e-4 * w.abs().max(1e-2));
        }
        assert!(far * 200 <= got.len(), "{preset}: {far} of {} parameters differ", got.len());
    }
    expect_silence(gpu);
}

/// Behind a blade no rays are drawn: the device draws the twin's rays, none of them hidden, whether they meet the hull or
/// not.
#[test]
fn hidden_pixels_are_never_drawn() {
    let gpu = gpu();
    let mut dataset = small_dataset(13, 11);
    let blade: Vec<bool> = (0..dataset.n_pixels()).map(|p| p % 13 < 7).collect();
    dataset.hidden.insert(0, blade.clone());
    let settings = ["hull.enabled=true", "hull.max_share=1", "hull.resolution=24", "train.rays=400"];
    let plan = Plan::new(&small_config("fast-mlp", &settings), &dataset).unwrap();
    let setup = plan.data::<FieldData>().unwrap().setup;
    assert!(setup.n_motion_list > 0 && setup.n_shown_list > 0, "the case is about both lists");
    let mut trainer = Trainer::new(&gpu, plan, &dataset, tuning(&gpu)).unwrap();
    let step = trainer.advance(1).unwrap().last().unwrap().step - 1;
    let plan = trainer.fields().unwrap().data();
    let got: Vec<Ray> = gpu.download(&trainer.fields().unwrap().forward().rays, 0, plan.setup.n_rays as usize).unwrap();
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
