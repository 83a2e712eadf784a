//! The self-test on the driver at hand: it passes, compares every stage that the driver can run, and names the stage that a
//! fault is in.
#![allow(missing_docs, clippy::unwrap_used, clippy::expect_used)]

mod common;
#[path = "common/program.rs"]
mod program;
mod shim;

use common::{small_dataset, tuning};
use nertca_vk::config::{Config, Preset, sections::Train};
use nertca_vk::error::Result;
use nertca_vk::gpu::buffer::Operands;
use nertca_vk::gpu::device::{DeviceOptions, Gpu};
use nertca_vk::gpu::statistics::PipelineStatistics;
use nertca_vk::inventory::{self, Compiled};
use nertca_vk::kernels::stages::kernel_code;
use nertca_vk::kernels::tuning::{Layers, Tuning};
use nertca_vk::plan::Plan;
use nertca_vk::render::renderer::Renderer;
use nertca_vk::selftest::compare::Findings;
use nertca_vk::selftest::iteration::F32_CASES;
use nertca_vk::selftest::{blobs, gaussians, iteration, networks, problems, r2, sax, trees, x_gaussian};
use nertca_vk::train::trainer::Trainer;
use program::program;
use serde_json::Value;
use std::collections::BTreeSet;
use std::path::Path;

const OF_MATRICES: [&str; 4] = ["mlp_fused_bwd", "mlp_fused_bwd_first", "mlp_fused_fwd", "mlp_pack"];

fn json(arguments: &[&str]) -> Value {
    let output = program().args(arguments).output().unwrap();
    let words = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(output.status.success(), "{words}");
    serde_json::from_slice(&output.stdout).unwrap()
}

#[test]
fn the_program_compares_every_stage_and_passes() {
    let answer = json(&["selftest", "--json"]);
    let rows = answer["rows"].as_array().unwrap();
    for row in rows {
        assert!(row["deviation"].as_f64().unwrap() <= row["tolerance"].as_f64().unwrap(), "{row}");
    }
    assert_eq!((&answer["ok"], rows.len() > 40), (&Value::Bool(true), true));
    let has_matrices = !answer["device"]["matrices"].as_array().unwrap().is_empty();
    let untested: Vec<&str> = answer["untested"].as_array().unwrap().iter().map(|s| s.as_str().unwrap()).collect();
    assert_eq!(untested, if has_matrices { &[] } else { &OF_MATRICES[..] }, "a stage without a comparison");
}

const CONSTANT: u32 = 43;
const STORE: u32 = 62;
const ADD: u32 = 129;
const SUBTRACT: u32 = 131;
const MULTIPLY: u32 = 133;
const WHOLE_ADD: u32 = 128;
const WHOLE_SUBTRACT: u32 = 130;
const SHIFT_RIGHT: u32 = 194;
const SHIFT_LEFT: u32 = 196;
const LESS: u32 = 176;
const LESS_OR_EQUAL: u32 = 178;

/// Instructions of SPIR-V by position: operation and length in words.
fn instructions(words: &[u32]) -> Vec<(usize, u32, usize)> {
    const HEADER: usize = 5;
    let (mut at, mut found) = (HEADER, Vec::new());
    while at < words.len() {
        let length = (words[at] >> 16) as usize;
        found.push((at, words[at] & 0xffff, length));
        at += length;
    }
    found
}

/// Replaces an operation by another of the same shape, everywhere.
fn replace(words: &mut [u32], from: u32, to: u32) {
    for (at, ..) in instructions(words).into_iter().filter(|(_, operation, _)| *operation == from) {
        words[at] = words[at] & 0xffff_0000 | to;
    }
}

fn wrong_sign(words: &mut [u32]) {
    replace(words, SUBTRACT, ADD);
}

fn sum_for_product(words: &mut [u32]) {
    replace(words, MULTIPLY, ADD);
}

fn differences(words: &mut [u32]) {
    replace(words, WHOLE_ADD, WHOLE_SUBTRACT);
}

fn other_digits(words: &mut [u32]) {
    replace(words, SHIFT_RIGHT, SHIFT_LEFT);
}

/// Not for stages that add up a workgroup: they would read shared memory that nobody has written, at times NaN.
fn one_too_many(words: &mut [u32]) {
    replace(words, LESS, LESS_OR_EQUAL);
}

fn difference_for_sum(words: &mut [u32]) {
    replace(words, ADD, SUBTRACT);
}

/// Stores of zero are left out.
fn missing_clear(words: &mut [u32]) {
    const NOTHING: u32 = 1 << 16;
    let all = instructions(words);
    let zeros: Vec<u32> =
        all.iter().filter(|i| i.1 == CONSTANT && words[i.0 + 3] == 0).map(|i| words[i.0 + 2]).collect();
    for (at, _, length) in all.into_iter().filter(|(_, operation, _)| *operation == STORE) {
        if zeros.contains(&words[at + 2]) {
            words[at..at + length].fill(NOTHING);
        }
    }
}

/// The comparison that a fault is to be found by.
type Compare = fn(&Gpu, &mut Findings) -> Result<()>;

fn an_iteration(gpu: &Gpu, findings: &mut Findings) -> Result<()> {
    let tuning = Tuning::for_device(gpu.info()).with_layers(Layers::F32, String::new());
    iteration::compare(gpu, &small_dataset(13, 11), &F32_CASES[2], &tuning, findings)
}

fn two_networks(gpu: &Gpu, findings: &mut Findings) -> Result<()> {
    let tuning = Tuning::for_device(gpu.info()).with_layers(Layers::F32, String::new());
    networks::compare(gpu, &small_dataset(13, 11), &networks::CASES[0], &tuning, findings)
}

fn many_gaussians(gpu: &Gpu, findings: &mut Findings) -> Result<()> {
    blobs::compare_crowd(gpu, &Tuning::for_device(gpu.info()), findings)
}

/// A fault in the code of a stage.
struct Fault {
    stage: &'static str,
    plant: fn(&mut [u32]),
    compare: Compare,
}

/// The code that the device gets of a stage.
fn code(gpu: &Gpu, stage: &str) -> Vec<u32> {
    let variant = |name: &str, taken: bool| kernel_code(&format!("{stage}_{name}")).ok().filter(|_| taken);
    let texel = variant("texel", tuning(gpu).operands == Operands::Texel);
    let taken = texel.or_else(|| variant("subgroup", gpu.info().full_subgroups.is_some()));
    bytemuck::pod_collect_to_vec(taken.unwrap_or_else(|| kernel_code(stage).unwrap()).spirv)
}

/// Faults in the code of shaders as the driver gets it: each is found in the row of its stage, and in no row before.
#[test]
fn faults_in_shaders_are_found_in_the_rows_of_their_stages() {
    let fault = |stage, plant, compare| Fault { stage, plant, compare };
    for Fault { stage, plant, compare } in [
        fault("gaussian_moments", wrong_sign, gaussians::compare),
        fault("gaussian_update", wrong_sign, gaussians::compare),
        fault("tree_grid_gradient", wrong_sign, trees::compare),
        fault("march_loss", sum_for_product, an_iteration),
        fault("gradient_static", wrong_sign, an_iteration),
        fault("gradient_static", missing_clear, an_iteration),
        fault("mlp_latent_bwd", sum_for_product, an_iteration),
        fault("adam", wrong_sign, an_iteration),
        fault("march_fwd_samples", difference_for_sum, two_networks),
        fault("loss_samples", wrong_sign, two_networks),
        fault("loss_samples", sum_for_product, two_networks),
        fault("r2_project", wrong_sign, r2::compare),
        fault("ssim_rows", sum_for_product, r2::compare),
        fault("ssim_columns", wrong_sign, r2::compare),
        fault("r2_residual", wrong_sign, r2::compare),
        fault("r2_voxel_splat", wrong_sign, r2::compare),
        fault("r2_voxel_tv", sum_for_product, r2::compare),
        fault("r2_voxel_moments", wrong_sign, r2::compare),
        fault("r2_update", wrong_sign, r2::compare),
        fault("x_project", wrong_sign, x_gaussian::compare),
        fault("x_sort_count", other_digits, x_gaussian::compare),
        fault("x_sort_scan", differences, x_gaussian::compare),
        fault("x_sort_move", other_digits, x_gaussian::compare),
        fault("x_lists", one_too_many, x_gaussian::compare),
        fault("x_blend", wrong_sign, x_gaussian::compare),
        fault("x_blend_back", wrong_sign, x_gaussian::compare),
        fault("x_update", wrong_sign, x_gaussian::compare),
        fault("x_report", difference_for_sum, x_gaussian::compare),
        fault("sax_batch", one_too_many, sax::compare),
        fault("sax_points", wrong_sign, sax::compare),
        fault("sax_encode", wrong_sign, sax::compare),
        fault("sax_times", difference_for_sum, sax::compare),
        fault("sax_norm", wrong_sign, sax::compare),
        fault("sax_attend", wrong_sign, sax::compare),
        fault("sax_density", difference_for_sum, sax::compare),
        fault("sax_loss", wrong_sign, sax::compare),
        fault("sax_times_back", difference_for_sum, sax::compare),
        fault("sax_norm_back", wrong_sign, sax::compare),
        fault("sax_attend_back", wrong_sign, sax::compare),
        fault("sax_density_back", wrong_sign, sax::compare),
        fault("sax_products", difference_for_sum, sax::compare),
        fault("sax_weight_gradient", difference_for_sum, sax::compare),
        fault("sax_encode_bwd", wrong_sign, sax::compare),
        fault("sax_grid_gradient", missing_clear, sax::compare),
        fault("sax_report", difference_for_sum, sax::compare),
        fault("sax_view", difference_for_sum, sax::compare),
        fault("gaussian_crowd", wrong_sign, many_gaussians),
    ] {
        shim::begin(shim::Failing::None);
        let open = || Gpu::open(&DeviceOptions { loader: Some(shim::loader()), ..DeviceOptions::default() }).unwrap();
        let first_failure = || {
            let mut findings = Findings::default();
            compare(&open(), &mut findings).unwrap_or_else(|error| panic!("{stage}: {error}"));
            findings.rows().iter().find(|row| !row.is_ok()).map(|row| row.stages.clone())
        };
        assert_eq!(first_failure(), None, "without a fault");
        let words = code(&open(), stage);
        let mut faulty = words.clone();
        plant(&mut faulty);
        assert!(words != faulty, "{stage} has no such instruction");
        shim::plant(words, faulty);
        let found = first_failure().unwrap_or_else(|| panic!("the fault in {stage} was not seen"));
        println!("{stage}: {found:?}");
        assert!(found.contains(&stage), "the fault in {stage} was seen in {found:?}");
    }
    shim::begin(shim::Failing::None);
}

/// Kernels with their constants.
fn builds<'a>(all: impl IntoIterator<Item = &'a PipelineStatistics>) -> BTreeSet<String> {
    all.into_iter().map(|pipeline| Compiled::of(pipeline).name()).collect()
}

#[test]
fn the_inventory_is_what_a_run_builds() {
    let open = || Gpu::open(&DeviceOptions { statistics: true, ..DeviceOptions::default() }).unwrap();
    for (preset, size, form) in [
        (Preset::Paper, 13, "none"),
        (Preset::NerfCa, 13, "none"),
        (Preset::Fast, 32, "tree"),
        (Preset::Fast, 32, "phase"),
        (Preset::R2Gaussian, 13, "r2"),
        (Preset::XGaussian, 13, "x"),
        (Preset::SaxNerf, 13, "none"),
    ] {
        let settings =
            ["gaussians.iterations=2", "gaussians.count=20", "tree.warm_iterations=2", "tree.track_iterations=1"];
        let short = match preset {
            Preset::R2Gaussian => &["train.iterations=2", "r2.count=20", "r2.voxels=16", "r2.tv_box=8"][..],
            Preset::XGaussian => &["train.iterations=2", "x.voxels=8", "x.interval=2"],
            Preset::SaxNerf => &["train.iterations=2", "sax.log2_table=8", "sax.windows=2", "sax.window=4"],
            _ => &[],
        };
        let form = format!("gaussians.form={form}");
        let settings: Vec<String> = settings.iter().chain(short).map(|s| (*s).to_owned()).chain([form]).collect();
        let config = Config::load(Some(preset), None, &settings).unwrap();
        let listed = open();
        let inventory = inventory::compile(&listed, &config, 3, &tuning(&listed)).unwrap();
        let names: BTreeSet<String> = inventory.iter().map(Compiled::name).collect();
        let used = open();
        let dataset = problems::small_dataset(size, size, 5).unwrap();
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

#[test]
fn kernels_are_listed_and_compared() {
    let listed = json(&["kernels", "--preset", "fast-mlp", "--json"]);
    let kernels = listed["kernels"].as_array().unwrap();
    let named = |name: &str| kernels.iter().any(|k| k["kernel"].as_str().unwrap().starts_with(name));
    assert!(named("march_loss") && named("adam") && !named("gaussian_splat"), "{listed}");
    let directory = tempfile::tempdir().unwrap();
    let file = directory.path().join("before.json");
    let compare = |before: &Value, file: &Path| {
        std::fs::write(file, before.to_string()).unwrap();
        program().args(["kernels", "--preset", "fast-mlp", "--compare", file.to_str().unwrap()]).output().unwrap()
    };
    let same = compare(&listed, &file);
    assert!(same.status.success() && same.stderr.is_empty(), "{}", String::from_utf8_lossy(&same.stderr));
    // A constant that has changed is another build.
    let mut other = listed.clone();
    other["kernels"][0]["lanes"] = 7.into();
    let words = String::from_utf8(compare(&other, &file).stderr).unwrap();
    assert!(words.contains(": new") && words.contains(": gone"), "{words}");
    let broken = compare(&Value::from(3), &file);
    assert_eq!(broken.status.code(), Some(1));
    assert!(String::from_utf8_lossy(&broken.stderr).contains("kernels --json"));
}
