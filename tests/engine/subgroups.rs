//! Kernels whose lanes exchange values within subgroups, and their counterparts for devices without that ability: both
//! agree with the f64 twins, and each repeats with equal bits.

use crate::common::{expect_agreement, expect_silence, tuning, uneven_dataset};
use nertca_vk::gpu::buffer::Operands;
use nertca_vk::gpu::device::{DeviceOptions, Gpu};
use nertca_vk::kernels::tuning::Tuning;
use nertca_vk_twins::selftest::dynamic_gaussians as deformable;
use nertca_vk_twins::selftest::iteration::{self, F32_CASES};
use nertca_vk_twins::selftest::{gaussians, repeats};

fn open(without_subgroups: bool) -> Gpu {
    Gpu::open(&DeviceOptions { validation: true, statistics: true, without_subgroups, ..DeviceOptions::default() })
        .unwrap()
}

/// Tuning with workgroups for the layers' sums and for several rays as on a GPU, with full subgroups and operands whose
/// kernels have both variants. A ray has `ray_lanes`.
fn as_on_a_gpu(gpu: &Gpu, ray_lanes: u32) -> Tuning {
    // More than the number of samples of the static field in the cases.
    let march_lanes = 32.max(4 * ray_lanes);
    let sums = Tuning { layer_lanes: 64, weight_lanes: 64, splits: 3, ..tuning(gpu) };
    Tuning { operands: Operands::Storage, march_lanes, ray_lanes, ..sums }
}

/// Invocations per ray: several subgroups, and half a subgroup, as rays of 32 share AMD's subgroups of 64.
fn ray_lanes(gpu: &Gpu) -> [u32; 2] {
    [32, gpu.info().subgroup_size.min(32) / 2]
}

#[test]
#[ignore = "long: tools/test --all"]
fn every_stage_matches_with_and_without_subgroups() {
    for without in [false, true] {
        let gpu = open(without);
        if gpu.info().full_subgroups.is_none() && !without {
            assert!(!gpu.info().is_llvmpipe, "lavapipe has shuffles in full subgroups");
            println!("{} has no shuffles in full subgroups: nothing is compared with them", gpu.info().name);
            continue;
        }
        let dataset = uneven_dataset(13, 11);
        let paths = ray_lanes(&gpu).map(|lanes| as_on_a_gpu(&gpu, lanes));
        for path in &paths {
            expect_agreement(|findings| {
                F32_CASES.iter().try_for_each(|case| iteration::compare(&gpu, &dataset, case, path, findings))
            });
        }
        expect_agreement(|findings| gaussians::compare(&gpu, findings));
        expect_agreement(|findings| deformable::compare(&gpu, findings));
        expect_agreement(|findings| deformable::compare_equal_runs(&gpu, findings));
        expect_agreement(|findings| repeats::compare_network(&gpu, &dataset, &paths[0], findings));
        let built = gpu.pipeline_statistics();
        assert!(built.iter().any(|kernel| kernel.kernel.starts_with("gaussian_moments")));
        assert_eq!(built.iter().any(|kernel| kernel.kernel.ends_with("_subgroup")), !without);
        expect_silence(gpu);
    }
}
