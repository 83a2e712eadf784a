//! Nothing is read that was not written, and nothing is written outside its buffer: every buffer of a training run and of
//! renderings is filled with a conspicuous pattern and followed by canaries.

use crate::common::{expect_silence, run, small_config, small_dataset};
use crate::shim;
use nertca_vk::fields::state::FieldsState;
use nertca_vk::gaussians::field::GaussianField;
use nertca_vk::gpu::buffer::Operands;
use nertca_vk::gpu::device::{DeviceOptions, Gpu};
use nertca_vk::kernels::layout::Gaussian;
use nertca_vk::kernels::tuning::{Layers, Tuning};
use nertca_vk::model::component::Component;
use nertca_vk::plan::Plan;
use nertca_vk::render::baked::Baked;
use nertca_vk::render::quantity::{Projection, Quantity};
use nertca_vk::render::renderer::Renderer;
use nertca_vk::train::trainer::Trainer;
use std::sync::Arc;

/// Pattern that is NaN as f32 and as either f16 half, and far out of range as an index.
const NOT_A_NUMBER: u32 = 0xffc1_ffc1;
/// Pattern that is large but finite as f32 and f16, since a maximum with NaN may hide NaN.
const LARGE: u32 = 0x7bff_7bff;

/// Opens a CPU driver, whose memory the host can access.
fn gpu() -> Gpu {
    let select = Some("llvmpipe".to_owned());
    Gpu::open(&DeviceOptions { select, validation: true, loader: Some(shim::loader()), ..DeviceOptions::default() })
        .expect("this test needs Mesa's CPU driver (Debian: mesa-vulkan-drivers) and vulkan-validationlayers")
}

/// All parameters of Gaussians and of the grid that moves them.
fn parameters(field: &GaussianField) -> Vec<f32> {
    let of = |g: &Gaussian| g.position.into_iter().chain(g.log_scale).chain(g.rotation).chain([g.log_density]);
    let moves = field.moving().map_or(Vec::new(), |tree| [&tree.grid[..], &tree.own].concat());
    field.rows().rows.iter().flat_map(of).chain(moves.into_iter().flatten()).collect()
}

/// Trains briefly and renders, in memory that is filled with `word`; returns the bits of all results.
fn everything(word: u32, preset: &str, settings: &[&str], choose: &dyn Fn(Tuning) -> Tuning) -> Vec<u32> {
    shim::begin_poison(word);
    let gpu = gpu();
    let tuning = choose(Tuning::for_device(gpu.info()));
    let config = small_config(preset, settings);
    let (width, height) = if config.gaussian_iterations() > 0 { (40, 36) } else { (13, 11) };
    let dataset = small_dataset(width, height);
    let plan = Plan::new(&config, &dataset).unwrap();
    let mut trainer = Trainer::new(&gpu, plan, &dataset, tuning.clone()).unwrap();
    let losses = run(&mut trainer, config.gaussian_iterations() + 9);
    let checkpoint = trainer.checkpoint().unwrap();
    let renderer = Renderer::new(&gpu, &checkpoint.model, tuning).unwrap();
    let rays = &dataset.views[1].rays;
    let exact = renderer.render(rays, width, height, 2).unwrap();
    let baked = Baked::for_display(Arc::new(renderer), &checkpoint.model, 4.0);
    let total = Quantity { component: Component::Total, projection: Projection::Drr };
    let quick = baked.render(rays, width, height, 2, total).unwrap();
    drop((trainer, baked));
    expect_silence(gpu);
    let (filled, unreachable, broken) = shim::end_poison();
    assert!(filled > 60 && unreachable == 0, "{filled} buffers were filled, {unreachable} could not be");
    assert_eq!(broken, Vec::<String>::new());
    let state = checkpoint.state::<FieldsState>().cloned().unwrap_or_else(|_| FieldsState::fresh(0, 0));
    let numbers = checkpoint.model.params.iter().chain(state.moments.as_flattened());
    let pictures = exact.static_integral.iter().chain(&exact.dynamic_integral).chain(&quick);
    let gaussians = checkpoint.model.gaussians.as_ref().map_or(Vec::new(), parameters);
    let numbers: Vec<f32> =
        numbers.chain(pictures).copied().chain(gaussians).chain(losses.iter().map(|l| *l as f32)).collect();
    assert!(numbers.iter().all(|v| v.is_finite()), "something that was never written was read");
    numbers.iter().map(|v| v.to_bits()).chain(state.occupancy).collect()
}

#[track_caller]
fn expect_the_same(preset: &str, settings: &[&str], choose: &dyn Fn(Tuning) -> Tuning) {
    let one = everything(NOT_A_NUMBER, preset, settings, choose);
    let other = everything(LARGE, preset, settings, choose);
    assert!(one == other, "results depend on what memory held before");
}

/// Several chunks, a hull, and empty cells that are learned.
const FULL: &[&str] = &[
    "train.chunk_samples=1024",
    "train.rays=90",
    "hull.enabled=true",
    "hull.max_share=1",
    "hull.resolution=24",
    "occupancy.start=2",
];

#[test]
fn f32_layers_mind_their_buffers() {
    for operands in [Operands::Texel, Operands::Storage, Operands::Address] {
        let choose = move |tuning| Tuning { layers: Layers::F32, operands, ..tuning };
        expect_the_same("fast-mlp", FULL, &choose);
    }
    let choose = |tuning| Tuning { layers: Layers::F32, ..tuning };
    expect_the_same("paper", &["dynamic.occlusion=1e-3"], &choose);
}

#[test]
fn matrix_layers_mind_their_buffers() {
    if gpu().info().matrices.is_empty() {
        assert!(std::env::var("NERTCA_MATRICES").is_err(), "this driver has no cooperative matrices");
        println!("skipped: this driver has no cooperative matrices");
        return;
    }
    expect_the_same("fast-mlp", FULL, &|tuning| tuning.with_layers(Layers::Matrices, String::new()));
}

#[test]
fn gaussians_mind_their_buffers() {
    let settings = |form| {
        [
            form,
            "gaussians.iterations=12",
            "gaussians.grow_at=4",
            "gaussians.clear_at=8",
            "gaussians.background_every=5",
            "gaussians.count=60",
            "deformable.warm_iterations=6",
            "deformable.track_iterations=3",
        ]
    };
    for form in ["gaussians.form=phase", "gaussians.form=tree"] {
        expect_the_same("fast", &settings(form), &|tuning| tuning);
    }
}
