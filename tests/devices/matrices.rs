//! Comparison of the network on cooperative matrices with the f64 twin and the f32 path, with validation. `tools/test` runs
//! this on the newest lavapipe; on a device without matrices it reports that and checks nothing, unless
//! `NERTCA_MATRICES=require`.

use crate::common::{expect_agreement, expect_silence, gpu, run, small_config, small_dataset, uneven_dataset};
use crate::faults;
use crate::faults::{fault, instructions, less_for_greater, sum_for_product};
use nertca_vk::config::Preset;
use nertca_vk::error::Result;
use nertca_vk::fields::state::FieldsState;
use nertca_vk::gpu::device::Gpu;
use nertca_vk::kernels::layout::DeviceState;
use nertca_vk::kernels::stages::{has_matrix_kernels, kernel_code, matrix_shape, why_no_matrices};
use nertca_vk::kernels::tuning::{Layers, MatrixTuning, Tuning};
use nertca_vk::plan::Plan;
use nertca_vk::train::calibrate::{self, Verdict};
use nertca_vk::train::trainer::Trainer;
use nertca_vk_twins::selftest::compare::Findings;
use nertca_vk_twins::selftest::drawing;
use nertca_vk_twins::selftest::iteration::{self, Case, MATRIX_CASES, MATRIX_CASES_BETWEEN_PHASES};

/// Says that a test checks nothing, which `NERTCA_MATRICES=require` forbids.
fn skip(why: &str) {
    assert!(std::env::var("NERTCA_MATRICES").is_err(), "{why}");
    eprintln!("SKIPPED: {why}");
}

/// A device and its matrix path, if it has one.
fn matrices() -> Option<(Gpu, Tuning)> {
    let gpu = gpu();
    if matrix_shape(gpu.info()).is_none() {
        skip(&format!("{}: {}", gpu.info().name, why_no_matrices()));
        return None;
    }
    let tuning = Tuning::for_device(gpu.info()).with_layers(Layers::Matrices, String::new());
    Some((gpu, tuning))
}

/// Tunings of GPUs, with fewer workgroups than tiles.
const NVIDIA: MatrixTuning = MatrixTuning { workgroups: 3, ..MatrixTuning::NVIDIA };
const AMD: MatrixTuning = MatrixTuning { workgroups: 3, ..MatrixTuning::AMD };
const INTEL: MatrixTuning = MatrixTuning { workgroups: 3, ..MatrixTuning::INTEL };
/// Tunings of GPUs without f16 sums: of Intel and, if there are any, of others.
const INTEL_F32_SUMS: MatrixTuning = MatrixTuning { f16_sums: false, ..INTEL };
const F32_SUMS: MatrixTuning = MatrixTuning { f16_sums: false, ..NVIDIA };
/// Backward pass layer by layer, in loops that compile faster.
const SINGLY: MatrixTuning = MatrixTuning { pairs: false, ..MatrixTuning::CPU };
const GPU_CASE: Case = Case {
    preset: Preset::FastMlp,
    settings: &["dynamic.width=32", "dynamic.layers=3", "dynamic.bands=4", "train.rays=60"],
};

#[test]
fn every_stage_of_an_iteration_matches() {
    let Some((gpu, tuning)) = matrices() else { return };
    let (even, uneven) = (small_dataset(13, 11), uneven_dataset(13, 11));
    let of_gpus = [NVIDIA, AMD, INTEL, F32_SUMS, INTEL_F32_SUMS];
    let as_gpus = of_gpus.map(|matrices| (&even, &GPU_CASE, matrices));
    let as_gpus = as_gpus.into_iter().chain([(&even, &MATRIX_CASES[0], F32_SUMS), (&even, &MATRIX_CASES[1], SINGLY)]);
    let at_phases = MATRIX_CASES.iter().map(|case| (&even, case, MatrixTuning::CPU)).chain(as_gpus);
    for (dataset, case, matrices) in
        at_phases.chain(MATRIX_CASES_BETWEEN_PHASES.iter().map(|case| (&uneven, case, MatrixTuning::CPU)))
    {
        let path = Tuning { matrices, ..tuning.clone() };
        expect_agreement(|findings| iteration::compare(&gpu, dataset, case, &path, findings));
    }
    expect_silence(gpu);
}

/// Compares an iteration whose backward passes recompute the first layer or, on a CPU, keep it.
fn an_iteration(gpu: &Gpu, matrices: MatrixTuning, findings: &mut Findings) -> Result<()> {
    let tuning = Tuning::for_device(gpu.info()).with_layers(Layers::Matrices, String::new());
    let path = Tuning { matrices, ..tuning };
    iteration::compare(gpu, &small_dataset(13, 11), &MATRIX_CASES[0], &path, findings)
}

#[test]
fn faults_in_shaders_are_found_in_the_rows_of_their_stages() {
    if matrices().is_none() {
        return;
    }
    let kept: faults::Compare = |gpu, findings| an_iteration(gpu, MatrixTuning::CPU, findings);
    let again: faults::Compare =
        |gpu, findings| an_iteration(gpu, MatrixTuning { recompute: true, ..MatrixTuning::CPU }, findings);
    let kept_in_f32: faults::Compare =
        |gpu, findings| an_iteration(gpu, MatrixTuning { f16_sums: false, ..MatrixTuning::CPU }, findings);
    let again_in_f32: faults::Compare = |gpu, findings| {
        an_iteration(gpu, MatrixTuning { f16_sums: false, recompute: true, ..MatrixTuning::CPU }, findings)
    };
    faults::expect_found(&[
        fault("mlp_pack", sum_for_product, kept),
        fault("mlp_fused_fwd", sum_for_product, kept),
        fault("mlp_fused_bwd", sum_for_product, kept),
        fault("mlp_fused_bwd_first", sum_for_product, again),
        fault("mlp_fused_fwd", sum_for_product, kept_in_f32).in_variant("f32_sums"),
        fault("mlp_fused_bwd", less_for_greater, kept_in_f32).in_variant("f32_sums"),
        fault("mlp_fused_bwd_first", less_for_greater, again_in_f32).in_variant("f32_sums"),
        fault("gradient_network", faults::difference_for_sum, kept),
    ]);
}

#[test]
fn an_iteration_waits_where_it_must() {
    let Some((gpu, tuning)) = matrices() else { return };
    let dataset = small_dataset(13, 11);
    let barriers =
        [("fast-mlp", true), ("fast-mlp", false), ("public-code", false), ("nerf-ca", true)].map(|(preset, again)| {
            let tuning = Tuning { matrices: MatrixTuning { recompute: again, ..MatrixTuning::CPU }, ..tuning.clone() };
            let plan = Plan::new(&small_config(preset, &[]), &dataset).unwrap();
            Trainer::new(&gpu, plan, &dataset, tuning).unwrap().measured().unwrap().barriers().unwrap()
        });
    assert_eq!(barriers, [12, 12, 16, 17]);
    expect_silence(gpu);
}

#[test]
fn shaders_for_devices_without_f16_sums_have_none() {
    if !has_matrix_kernels() {
        return skip(why_no_matrices());
    }
    const FLOAT_TYPE: u32 = 22;
    const CONSTANT: u32 = 43;
    const MATRIX_TYPE: u32 = 4456;
    const ACCUMULATOR: u32 = 2;
    let of_f16 = |name: &str| {
        let words: Vec<u32> = bytemuck::pod_collect_to_vec(kernel_code(name).unwrap().spirv);
        let all = instructions(&words);
        let are = |kind| all.iter().filter(move |i| i.1 == kind).map(|i| &words[i.0 + 1..i.0 + i.2]);
        let half: Vec<u32> = are(FLOAT_TYPE).filter(|float| float[1] == 16).map(|float| float[0]).collect();
        let uses: Vec<u32> = are(CONSTANT).filter(|c| c[2] == ACCUMULATOR).map(|c| c[1]).collect();
        let matrices: Vec<_> = are(MATRIX_TYPE).filter(|matrix| half.contains(&matrix[1])).collect();
        (matrices.len(), matrices.iter().filter(|matrix| uses.contains(&matrix[5])).count())
    };
    for shader in ["mlp_fused_fwd", "mlp_fused_bwd", "mlp_fused_bwd_first"] {
        assert_eq!(of_f16(&format!("{shader}_unrolled")), (3, 1), "{shader}: left, right, sums");
        assert_eq!(of_f16(&format!("{shader}_f32_sums")), (2, 0), "{shader}: left, right");
    }
}

#[test]
fn training_repeats_bit_by_bit_resumes_and_follows_f32() {
    let Some((gpu, tuning)) = matrices() else { return };
    let dataset = uneven_dataset(13, 11);
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
    let scale = |trainer: &mut Trainer| trainer.checkpoint().unwrap().state::<FieldsState>().unwrap().loss_scale;
    assert_eq!(scale(&mut whole), scale(&mut resumed));
    let f32_losses = run(&mut start(Layers::F32), 120);
    let mean = |l: &[f64]| l.iter().sum::<f64>() / l.len() as f64;
    let (end, f32_end) = (mean(&losses[100..]), mean(&f32_losses[100..]));
    assert!(end < 0.3 * mean(&losses[..5]), "{end}");
    assert!((end - f32_end).abs() < 0.15 * f32_end, "{end} against {f32_end} in f32");
    drop((whole, parts, resumed));
    expect_silence(gpu);
}

#[test]
fn an_overflow_skips_the_update_and_lowers_the_scale_for_a_while() {
    let Some((gpu, tuning)) = matrices() else { return };
    let dataset = small_dataset(13, 11);
    let plan = Plan::new(&small_config("fast-mlp", &["train.iterations=100"]), &dataset).unwrap();
    let (before, first) = (plan.params.initial(plan.config.seed), plan.params.static_len);
    let mut trainer = Trainer::new(&gpu, plan, &dataset, tuning).unwrap();
    let huge = DeviceState { loss_scale: 2f32.powi(60), good_updates: 7, ..DeviceState::default() };
    gpu.upload(&trainer.fields().unwrap().forward().state, 0, &[huge]).unwrap();
    trainer.advance(1).unwrap();
    let after = trainer.model().unwrap().params;
    assert_eq!(before[first..], after[first..], "the network moved");
    assert_ne!(before[..first], after[..first], "the static field needs no scale");
    let state = |trainer: &Trainer| -> DeviceState {
        gpu.download(&trainer.fields().unwrap().forward().state, 0, 1).unwrap()[0]
    };
    assert_eq!(
        state(&trainer),
        DeviceState { step: 1, loss_scale: 2f32.powi(56), return_scale: 2f32.powi(59), ..DeviceState::default() }
    );
    // The scale is reduced until gradients fit; then the network changes again, and the scale to return to is kept.
    let mut last = state(&trainer);
    while last.good_updates == 0 {
        let until = trainer.step() + 1;
        run(&mut trainer, until);
        assert!(until < 20, "{:?}", state(&trainer));
        last = state(&trainer);
    }
    assert_eq!(last.return_scale, 2f32.powi(59), "overflows in a row are one");
    assert_ne!(before[first..], trainer.model().unwrap().params[first..]);

    // A scale below the one to return to grows after 20 good updates, one above it after 500.
    let set = DeviceState { loss_scale: 2f32.powi(6), good_updates: 1, return_scale: 2f32.powi(10), ..last };
    gpu.upload(&trainer.fields().unwrap().forward().state, 0, &[set]).unwrap();
    let until = last.step + 20;
    run(&mut trainer, until);
    assert_eq!((state(&trainer).loss_scale, state(&trainer).good_updates), (2f32.powi(7), 1));
    let set = DeviceState { loss_scale: 2f32.powi(10), good_updates: 1, ..state(&trainer) };
    gpu.upload(&trainer.fields().unwrap().forward().state, 0, &[set]).unwrap();
    run(&mut trainer, until + 20);
    assert_eq!((state(&trainer).loss_scale, state(&trainer).good_updates), (2f32.powi(10), 21));
    drop(trainer);
    expect_silence(gpu);
}

#[test]
fn views_and_volumes_equal_the_twin() {
    let Some((gpu, tuning)) = matrices() else { return };
    expect_agreement(|findings| {
        drawing::compare_views(&gpu, Preset::PublicCode, &tuning, findings)?;
        drawing::compare_volumes(&gpu, &tuning, findings)
    });
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
        let told = format!("{f32_ms:.3} ms in f32 and {matrices_ms:.3} ms on matrices");
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
