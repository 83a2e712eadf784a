//! The self-test names the stage that contains a fault, and the inventory lists the pipelines that a run builds.

use crate::common::{small_dataset, tuning};
use crate::faults;
use crate::faults::{
    difference_for_sum, differences, fault, missing_clear, no_stores, one_too_many, other_digits, sum_for_product,
    wrong_sign,
};
use nertca_vk::config::{Config, Preset, sections::Train};
use nertca_vk::error::Result;
use nertca_vk::gpu::device::{DeviceOptions, Gpu};
use nertca_vk::gpu::statistics::PipelineStatistics;
use nertca_vk::kernels::tuning::{Layers, Tuning};
use nertca_vk::plan::Plan;
use nertca_vk::render::renderer::Renderer;
use nertca_vk::scan::small;
use nertca_vk::train::trainer::Trainer;
use nertca_vk_twins::inventory::{self, Compiled};
use nertca_vk_twins::selftest::compare::Findings;
use nertca_vk_twins::selftest::dynamic_gaussians as deformable;
use nertca_vk_twins::selftest::iteration::F32_CASES;
use nertca_vk_twins::selftest::problems::with_values;
use nertca_vk_twins::selftest::r2_gaussian as r2;
use nertca_vk_twins::selftest::sax_nerf as sax;
use nertca_vk_twins::selftest::x_gaussian;
use nertca_vk_twins::selftest::{blobs, gaussians, iteration, networks};
use std::collections::BTreeSet;

fn an_iteration(gpu: &Gpu, findings: &mut Findings) -> Result<()> {
    let tuning = Tuning::for_device(gpu.info()).with_layers(Layers::F32, String::new());
    iteration::compare(gpu, &small_dataset(13, 11), &F32_CASES[2], &tuning, findings)
}

fn two_networks(gpu: &Gpu, findings: &mut Findings) -> Result<()> {
    let tuning = Tuning::for_device(gpu.info()).with_layers(Layers::F32, String::new());
    networks::compare(gpu, &small_dataset(13, 11), &networks::CASES[0], &tuning, findings)
}

fn many_gaussians(gpu: &Gpu, findings: &mut Findings) -> Result<()> {
    let config = r2::small_config(&[])?.into_any();
    blobs::compare_maxima(gpu, &config, &Tuning::for_device(gpu.info()), findings)
}

/// Faults in the shader code that the driver receives: each is found in the row of its stage, and in no earlier row.
#[test]
#[ignore = "long: tools/test --all"]
fn faults_in_shaders_are_found_in_the_rows_of_their_stages() {
    faults::expect_found(&[
        fault("gaussian_moments", wrong_sign, gaussians::compare),
        fault("gaussian_update", wrong_sign, gaussians::compare),
        fault("gaussian_report", no_stores, gaussians::compare),
        fault("deformable_grid_gradient", wrong_sign, deformable::compare),
        fault("deformable_fill", sum_for_product, deformable::compare),
        fault("deformable_filling", sum_for_product, deformable::compare),
        fault("march_count", difference_for_sum, an_iteration),
        fault("march_scan", differences, an_iteration),
        fault("march_emit", difference_for_sum, an_iteration),
        fault("march_loss", sum_for_product, an_iteration),
        fault("gradient_static", wrong_sign, an_iteration),
        fault("gradient_static", missing_clear, an_iteration),
        fault("mlp_latent_bwd", difference_for_sum, an_iteration),
        fault("adam", wrong_sign, an_iteration),
        fault("march_fwd_samples", difference_for_sum, two_networks),
        fault("loss_samples", wrong_sign, two_networks),
        fault("loss_samples", sum_for_product, two_networks),
        fault("r2_project", wrong_sign, r2::compare),
        fault("ssim_rows", sum_for_product, r2::compare),
        fault("ssim_columns", wrong_sign, r2::compare),
        fault("picture_residual", wrong_sign, r2::compare),
        fault("r2_voxel_splat", wrong_sign, r2::compare),
        fault("r2_voxel_tv", sum_for_product, r2::compare),
        fault("r2_voxel_moments", wrong_sign, r2::compare),
        fault("r2_update", wrong_sign, r2::compare),
        fault("r2_chord_splat", wrong_sign, r2::compare),
        fault("r2_chord_moments", wrong_sign, r2::compare),
        fault("blend_project", wrong_sign, x_gaussian::compare),
        fault("blend_sort_count", other_digits, x_gaussian::compare),
        fault("blend_sort_scan", differences, x_gaussian::compare),
        fault("blend_sort_move", other_digits, x_gaussian::compare),
        fault("blend_lists", one_too_many, x_gaussian::compare),
        fault("blend_picture", wrong_sign, x_gaussian::compare),
        fault("x_blend_back", wrong_sign, x_gaussian::compare),
        fault("x_update", wrong_sign, x_gaussian::compare),
        fault("x_report", difference_for_sum, x_gaussian::compare),
        fault("x_report", no_stores, x_gaussian::compare),
        fault("sax_batch", one_too_many, sax::compare),
        fault("sax_points", wrong_sign, sax::compare),
        fault("sax_encode", wrong_sign, sax::compare),
        fault("sax_linear", difference_for_sum, sax::compare),
        fault("sax_norm", wrong_sign, sax::compare),
        fault("sax_attend", wrong_sign, sax::compare),
        fault("sax_density", difference_for_sum, sax::compare),
        fault("sax_loss", wrong_sign, sax::compare),
        fault("sax_linear_back", difference_for_sum, sax::compare),
        fault("sax_norm_back", wrong_sign, sax::compare),
        fault("sax_attend_back", wrong_sign, sax::compare),
        fault("sax_density_back", wrong_sign, sax::compare),
        fault("sax_linear_gradient", difference_for_sum, sax::compare),
        fault("sax_weight_gradient", difference_for_sum, sax::compare),
        fault("sax_encode_bwd", wrong_sign, sax::compare),
        fault("sax_grid_gradient", missing_clear, sax::compare),
        fault("sax_report", difference_for_sum, sax::compare),
        fault("sax_report", no_stores, sax::compare),
        fault("sax_view", difference_for_sum, sax::compare),
        fault("gaussian_maxima", wrong_sign, many_gaussians),
    ]);
}

/// Names of kernels with their constants.
fn builds<'a>(all: impl IntoIterator<Item = &'a PipelineStatistics>) -> BTreeSet<String> {
    all.into_iter().map(|pipeline| Compiled::of(pipeline).name()).collect()
}

#[test]
fn the_inventory_is_what_a_run_builds() {
    let open = || Gpu::open(&DeviceOptions { statistics: true, ..DeviceOptions::default() }).unwrap();
    for (preset, size, form) in [
        (Preset::Paper, 13, None),
        (Preset::NerfCa, 13, None),
        (Preset::Fast, 32, Some("deformable")),
        (Preset::Fast, 32, Some("phase")),
        (Preset::R2Gaussian, 13, None),
        (Preset::XGaussian, 13, None),
        (Preset::SaxNerf, 13, None),
    ] {
        let short = match preset {
            Preset::Fast => &[
                "gaussians.iterations=2",
                "gaussians.count=20",
                "deformable.warm_iterations=2",
                "deformable.track_iterations=1",
            ][..],
            Preset::R2Gaussian => &["train.iterations=2", "r2.n_points=20", "r2.voxels=16", "r2.tv_vol_size=8"],
            Preset::XGaussian => &["train.iterations=2", "x.voxels=8", "x.interval=2"],
            Preset::SaxNerf => {
                &["train.iterations=2", "sax.log2_hashmap_size=8", "sax.window_num=2", "sax.window_size=4"]
            }
            _ => &[],
        };
        let form = form.map(|form| format!("gaussians.form={form}"));
        let settings: Vec<&str> = short.iter().copied().chain(form.as_deref()).collect();
        let config = with_values(&Config::preset(preset), settings.iter().copied()).unwrap();
        let listed = open();
        let inventory = inventory::compile(&listed, &config, 3, &tuning(&listed)).unwrap();
        let names: BTreeSet<String> = inventory.iter().map(Compiled::name).collect();
        let used = open();
        let dataset = small::small_dataset(size, size, 5).unwrap();
        let config = Config { train: Train { chunk_samples: 1 << 14, ..config.train.clone() }, ..config };
        let mut trainer = Trainer::new(&used, Plan::new(&config, &dataset).unwrap(), &dataset, tuning(&used)).unwrap();
        while trainer.step() < config.gaussian_iterations() {
            trainer.advance(config.gaussian_iterations()).unwrap();
        }
        let _renderer = Renderer::new(&used, &trainer.model().unwrap(), tuning(&used)).unwrap();
        assert_eq!(names, builds(&used.pipeline_statistics()), "{preset:?} {settings:?}");
        assert!(inventory.iter().all(|c| c.lanes > 0));
    }
}
