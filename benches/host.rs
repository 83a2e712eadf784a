//! Measures the host's work before and after training, and one training step: `cargo bench --bench host`.
#![allow(clippy::unwrap_used, missing_docs, reason = "a measurement")]

#[path = "../tests/common/mod.rs"]
mod common;

use common::small_dataset;
use criterion::{Criterion, criterion_group, criterion_main};
use glam::DVec3;
use nertca_vk::config::{Config, Preset};
use nertca_vk::export::surfaces::surface as surface_of;
use nertca_vk::fields::{carve::carve, motion};
use nertca_vk::gpu::device::{DeviceOptions, Gpu};
use nertca_vk::kernels::tuning::Tuning;
use nertca_vk::plan::Plan;
use nertca_vk::render::grid::PatientGrid;
use nertca_vk::scan::dataset::{Dataset, Layout};
use nertca_vk::scan::writer::convert;
use nertca_vk::train::trainer::Trainer;

/// Side of the images, pixels.
const SIDE: usize = 100;

fn hull(c: &mut Criterion) {
    let dataset = small_dataset(SIDE, SIDE);
    c.bench_function("motion_analysis", |b| b.iter(|| motion::analyse(&dataset, motion::Thresholds::default())));
    let moving = motion::analyse(&dataset, motion::Thresholds::default());
    c.bench_function("hull_carving", |b| b.iter(|| carve(&dataset, &moving, 0.6, 128, true)));
}

fn reading(c: &mut Criterion) {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("data");
    convert(&small_dataset(SIDE, SIDE), Layout::Native, &path).unwrap();
    c.bench_function("dataset_reading", |b| b.iter(|| Dataset::open(&path).unwrap()));
}

fn surface(c: &mut Criterion) {
    let size = [96u32; 3];
    let grid = PatientGrid { origin_mm: DVec3::ZERO, spacing_mm: DVec3::ONE, size };
    let centre = DVec3::splat(48.0);
    let ball: Vec<f32> = (0..96usize.pow(3))
        .map(|i| DVec3::new((i % 96) as f64, (i / 96 % 96) as f64, (i / (96 * 96)) as f64))
        .map(|p| (40.0 - p.distance(centre)) as f32)
        .collect();
    c.bench_function("surface_nets", |b| b.iter(|| surface_of(&ball, &grid, 5.0)));
}

fn step(c: &mut Criterion) {
    let gpu = Gpu::open(&DeviceOptions::default()).unwrap();
    let dataset = small_dataset(SIDE, SIDE);
    let mut config = Config::preset(Preset::FastMlp);
    config.train.iterations = 1_000_000;
    config.train.iterations_per_submit = 1;
    let plan = Plan::new(&config, &dataset).unwrap();
    let mut trainer = Trainer::new(&gpu, plan, &dataset, Tuning::for_device(gpu.info())).unwrap();
    c.bench_function("training_step", |b| b.iter(|| trainer.advance(trainer.submitted() + 1).unwrap()));
}

criterion_group! { name = host; config = Criterion::default().sample_size(20); targets = hull, reading, surface, step }
criterion_main!(host);
