//! Helpers shared by the integration tests: a device with validation layers, a small dataset, comparisons.
#![allow(
    dead_code,
    unused_imports,
    missing_docs,
    clippy::unwrap_used,
    clippy::expect_used,
    reason = "each test file uses its part"
)]

use nertca_vk::choice::Choice;
use nertca_vk::config::{Config, Preset};
use nertca_vk::error::Result;
use nertca_vk::gpu::device::{DeviceOptions, Gpu};
use nertca_vk::kernels::tuning::Tuning;
use nertca_vk::random::{STREAM_PHOTON, normal};
use nertca_vk::scan::dataset::{Dataset, Layout, Split};
use nertca_vk::scan::small;
use nertca_vk::train::trainer::Trainer;
use nertca_vk_phantom::dataset::{PhantomOptions, Setting, make};
use nertca_vk_phantom::degradations::Degradations;
use nertca_vk_phantom::views::ViewAngles;
use nertca_vk_runs::session::{FrameTime, NewFrame, Session};
pub use nertca_vk_twins::selftest::compare::relative_error;
use nertca_vk_twins::selftest::compare::{Findings, Row};
use nertca_vk_twins::selftest::problems;
use std::num::NonZeroU32;
use std::path::Path;

/// Opens a device with validation. A missing driver or layer fails the test, which is never skipped.
pub fn gpu() -> Gpu {
    Gpu::open(&DeviceOptions { validation: true, ..DeviceOptions::default() })
        .expect("tests need a Vulkan driver (Debian: mesa-vulkan-drivers) and vulkan-validationlayers")
}

/// The default paths of a device.
pub fn tuning(gpu: &Gpu) -> Tuning {
    Tuning::for_device(gpu.info())
}

/// Trains up to an iteration, and returns the objective of each iteration.
pub fn run(trainer: &mut Trainer, until: u32) -> Vec<f64> {
    let mut losses = Vec::new();
    while trainer.step() < until {
        losses.extend(trainer.advance(until).unwrap().iter().map(|l| l.total()));
    }
    losses
}

/// Fails if the validation layers reported messages, or if device objects leaked.
pub fn expect_silence(gpu: Gpu) {
    assert_eq!(gpu.validation_messages(), Vec::<String>::new());
    assert_eq!(gpu.live_objects(), 0, "device objects leaked");
}

/// A smooth blob that moves over three phases in front of a static gradient, in three views.
pub fn small_dataset(width: usize, height: usize) -> Dataset {
    small::small_dataset(width, height, 3).unwrap()
}

/// A dataset like [`small_dataset`], with some images taken between two phases.
pub fn uneven_dataset(width: usize, height: usize) -> Dataset {
    small::uneven_dataset(width, height).unwrap()
}

/// A configuration small enough for f64 twins, on top of a preset.
pub fn small_config(preset: &str, settings: &[&str]) -> Config {
    problems::small_config(Preset::named(preset).unwrap(), settings).unwrap()
}

/// Runs comparisons, prints their findings, and fails where one exceeds its tolerance.
#[track_caller]
pub fn expect_agreement(compare: impl FnOnce(&mut Findings) -> Result<()>) {
    let mut findings = Findings::default();
    compare(&mut findings).unwrap();
    let line = |row: &Row| {
        let Row { path, cases, deviation, tolerance, seen_in, .. } = row;
        format!("{path}, {}: {deviation:.1e} of {tolerance:.1e}, {cases} cases, {seen_in}", row.name())
    };
    findings.rows().iter().for_each(|row| println!("{}", line(row)));
    let failed: Vec<String> = findings.rows().iter().filter(|row| !row.is_ok()).map(line).collect();
    assert!(!findings.rows().is_empty() && failed.is_empty(), "{}", failed.join("\n"));
}

/// The default procedural phantom without photon noise.
pub fn phantom(gpu: &Gpu, directory: &Path, size: usize, views: u32) -> Dataset {
    phantom_with(gpu, directory, size, views, None)
}

/// The phantom of [`phantom`], with its vessel volumes.
pub fn phantom_with_volumes(gpu: &Gpu, directory: &Path, size: usize, views: u32) -> Dataset {
    phantom_with(gpu, directory, size, views, Some(NonZeroU32::MIN))
}

fn phantom_with(gpu: &Gpu, directory: &Path, size: usize, views: u32, volumes_every: Option<NonZeroU32>) -> Dataset {
    let options = PhantomOptions {
        setting: Setting::SmallXcat,
        size,
        phases: 10,
        views: ViewAngles::published(views).unwrap(),
        seed: 1,
        stenoses: Vec::new(),
        degradations: Degradations::default(),
        layout: Layout::Native,
        anatomy: None,
        volumes_every,
    };
    make(gpu, &options, directory, |_, _, _| ()).unwrap();
    Dataset::open(directory).unwrap()
}

/// Adds white noise of a standard deviation to the training images.
pub fn whiten(dataset: &mut Dataset, deviation: f64) {
    for (index, frame) in dataset.frames.iter_mut().enumerate().filter(|(_, f)| f.split == Split::Train) {
        for (pixel, value) in frame.integrals.iter_mut().enumerate() {
            *value += (deviation * normal(7, STREAM_PHOTON, index as u32, pixel as u32)) as f32;
        }
    }
}

/// Assigns the first training view's images to validation only.
pub fn drop_first_view(dataset: &mut Dataset) {
    let first = dataset.training_views()[0];
    dataset.frames.retain(|f| f.split == Split::Validation || f.view != first);
}

/// Adds the training frames of a dataset to a session, at their phases.
pub fn add_training_frames(session: &Session, dataset: &Dataset) {
    for frame in dataset.training() {
        let new = NewFrame {
            geometry: dataset.views[frame.view].geometry.clone(),
            moment: FrameTime::Phase(frame.phase),
            split: frame.split,
            width: dataset.width,
            height: dataset.height,
            integrals: frame.integrals.to_vec(),
            mask: None,
        };
        session.add_frame(new).unwrap();
    }
}
