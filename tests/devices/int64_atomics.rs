//! Kernels that add 64-bit integers to memory, and their counterparts for devices that add pairs of 32 bits: both agree
//! with the f64 twins, and runs have equal bits.

use crate::common::{expect_agreement, expect_silence, run, small_dataset, tuning, uneven_dataset};
use crate::faults;
use crate::faults::{fault, sum_for_product, wrong_sign};
use nertca_vk::config::Preset;
use nertca_vk::error::Result;
use nertca_vk::gpu::buffer::Operands;
use nertca_vk::gpu::device::{DeviceOptions, Gpu};
use nertca_vk::kernels::tuning::{Layers, Tuning};
use nertca_vk::plan::Plan;
use nertca_vk::train::trainer::Trainer;
use nertca_vk_twins::selftest::compare::Findings;
use nertca_vk_twins::selftest::iteration::{self, F32_CASES};
use nertca_vk_twins::selftest::problems;
use nertca_vk_twins::selftest::sax_nerf as sax;

fn open(without_subgroups: bool, without_int64_atomics: bool) -> Gpu {
    let options = DeviceOptions {
        validation: true,
        statistics: true,
        without_subgroups,
        without_int64_atomics,
        ..DeviceOptions::default()
    };
    Gpu::open(&options).unwrap()
}

/// Tuning with operands whose kernels have both variants, several lanes per ray, and lines in memory or first in shared
/// memory.
fn as_on_a_gpu(gpu: &Gpu, private_line_bytes: u32) -> Tuning {
    let layers = Tuning::for_device(gpu.info()).with_layers(Layers::F32, String::new());
    Tuning { operands: Operands::Storage, march_lanes: 16, private_line_bytes, ..layers }
}

/// Bits of losses and parameters after some iterations.
fn bits_of_a_run(gpu: &Gpu, private_line_bytes: u32) -> Vec<u64> {
    let dataset = uneven_dataset(13, 11);
    let config = problems::small_config(Preset::FastMlp, &["dynamic.lr=3e-3", "train.rays=64"]).unwrap();
    let tuning = as_on_a_gpu(gpu, private_line_bytes);
    let mut trainer = Trainer::new(gpu, Plan::new(&config, &dataset).unwrap(), &dataset, tuning).unwrap();
    let losses = run(&mut trainer, 12);
    let params = trainer.model().unwrap().params;
    losses.iter().map(|l| l.to_bits()).chain(params.iter().map(|p| u64::from(p.to_bits()))).collect()
}

/// Bits of losses and parameters of SAX-NeRF, whose grid is scattered to in the same way.
fn bits_of_a_grid(gpu: &Gpu) -> Vec<u64> {
    let dataset = small_dataset(13, 11);
    let plan = Plan::new(&sax::small_config(&[]).unwrap().into_any(), &dataset).unwrap();
    let mut trainer = Trainer::new(gpu, plan, &dataset, tuning(gpu)).unwrap();
    let losses = run(&mut trainer, 6);
    let checkpoint = trainer.checkpoint().unwrap().to_bytes().unwrap();
    losses.iter().map(|l| l.to_bits()).chain(checkpoint.iter().map(|b| u64::from(*b))).collect()
}

#[test]
fn sums_have_the_same_bits_by_either_kind_of_atomics() {
    for without_subgroups in [false, true] {
        let [whole, pairs] = [false, true].map(|without| open(without_subgroups, without));
        if !whole.info().int64_atomics {
            let crashes = whole.info().subgroup_size > 8;
            assert!(!whole.info().is_llvmpipe || crashes, "lavapipe adds 64-bit integers, in subgroups of up to 8");
            println!("{} adds no 64-bit integers: nothing is compared with them", whole.info().name);
            return;
        }
        for line_bytes in [0, 16384] {
            let runs = [&whole, &pairs].map(|gpu| bits_of_a_run(gpu, line_bytes));
            assert!(runs[0][0] != runs[0][1], "losses change");
            assert!(runs[0] == runs[1], "bits of a run, {line_bytes} bytes for lines");
        }
        assert!(bits_of_a_grid(&whole) == bits_of_a_grid(&pairs), "bits of a grid");
        for (gpu, is_whole) in [(&whole, true), (&pairs, false)] {
            let built = gpu.pipeline_statistics();
            let with =
                |shader: &str| built.iter().any(|k| k.kernel.starts_with(shader) && k.kernel.ends_with("_int64"));
            assert_eq!((with("march_loss"), with("sax_encode_bwd")), (is_whole, is_whole));
        }
        [whole, pairs].into_iter().for_each(expect_silence);
    }
}

fn an_iteration(gpu: &Gpu, findings: &mut Findings) -> Result<()> {
    iteration::compare(gpu, &small_dataset(13, 11), &F32_CASES[2], &as_on_a_gpu(gpu, 0), findings)
}

#[test]
fn every_stage_matches_with_whole_integers() {
    let gpu = open(false, false);
    expect_agreement(|findings| an_iteration(&gpu, findings));
    expect_agreement(|findings| sax::compare(&gpu, findings));
    expect_silence(gpu);
}

#[test]
fn faults_are_found_in_kernels_that_add_whole_integers() {
    if !open(false, false).info().int64_atomics {
        return;
    }
    faults::expect_found(&[
        fault("march_loss", sum_for_product, an_iteration).in_variant("subgroup_int64"),
        fault("sax_encode_bwd", wrong_sign, sax::compare).in_variant("int64"),
    ]);
}
