//! Shared by the integration tests: a device with validation layers, a small dataset, comparisons.
#![allow(dead_code, missing_docs, clippy::unwrap_used, clippy::expect_used, reason = "each test file uses its part")]

use nertca_vk::config::Config;
use nertca_vk::geometry::{CArm, Geometry};
use nertca_vk::gpu::device::{DeviceOptions, Gpu};
use nertca_vk::kernels::tuning::Tuning;
use nertca_vk::phantom::dataset::{PhantomOptions, Setting, make};
use nertca_vk::phantom::degradations::Degradations;
use nertca_vk::phantom::views::ViewAngles;
use nertca_vk::random::{STREAM_PHOTON, normal};
use nertca_vk::scan::dataset::{Dataset, Frame, Layout, Split, View};
use nertca_vk::train::trainer::Trainer;
use std::path::{Path, PathBuf};

/// A device with validation on. A missing driver or layer fails the test: it is never skipped.
pub fn gpu() -> Gpu {
    Gpu::open(&DeviceOptions { validation: true, ..DeviceOptions::default() })
        .expect("tests need a Vulkan driver (Debian: mesa-vulkan-drivers) and vulkan-validationlayers")
}

/// The paths a device gets by default.
pub fn tuning(gpu: &Gpu) -> Tuning {
    Tuning::for_device(gpu.info())
}

/// Trains up to an iteration; the objective of each on the way.
pub fn run(trainer: &mut Trainer, until: u32) -> Vec<f64> {
    let mut losses = Vec::new();
    while trainer.step() < until {
        losses.extend(trainer.advance(until).unwrap().iter().map(|l| l.total()));
    }
    losses
}

/// Fails when the validation layers had anything to say, or when device objects leaked.
pub fn expect_silence(gpu: Gpu) {
    assert_eq!(gpu.validation_messages(), Vec::<String>::new());
    assert_eq!(gpu.live_objects(), 0, "device objects leaked");
}

/// A smooth blob that moves over three phases in front of a still gradient, seen from three sides.
pub fn small_dataset(width: usize, height: usize) -> Dataset {
    let phases = 3u32;
    let mut views = Vec::new();
    let mut frames = Vec::new();
    for (v, (primary_deg, secondary_deg)) in [(-30.0, 20.0), (40.0, -10.0), (85.0, 15.0)].into_iter().enumerate() {
        let geometry = Geometry::CArm(CArm {
            primary_deg,
            secondary_deg,
            sid_mm: 1000.0,
            sod_mm: 600.0,
            pixel_mm: [120.0 / width as f64, 120.0 / height as f64],
            offset_mm: [1.0, -2.0],
            table_mm: [0.0; 3],
        });
        views.push(View { rays: geometry.rays(width, height).unwrap(), geometry });
        for phase in 0..phases {
            let centre = (0.4 + 0.1 * f64::from(phase), 0.5 - 0.05 * v as f64);
            let integrals = (0..width * height)
                .map(|p| {
                    let (x, y) = ((p % width) as f64 / width as f64, (p / width) as f64 / height as f64);
                    let d2 = (x - centre.0).powi(2) + (y - centre.1).powi(2);
                    (0.8 + 0.3 * x - 0.2 * y + 0.5 * (-d2 / 0.005).exp()) as f32
                })
                .collect();
            let split = if v == 2 && phase == 2 { Split::Validation } else { Split::Train };
            frames.push(Frame {
                name: format!("v{v}p{phase}"),
                view: v,
                phase,
                split,
                integrals,
                mask: None,
                heart_shift_mm: [0.0; 3],
            });
        }
    }
    frames.sort_by_key(|f| f.split);
    Dataset {
        path: PathBuf::from("test"),
        layout: Layout::Native,
        views,
        frames,
        width,
        height,
        n_phases: phases,
        depth_range: (-0.9, 0.9),
        hidden: Default::default(),
        vessel_attenuation: Some(1.0),
        notes: Vec::new(),
    }
}

/// A configuration small enough for f64 twins, on top of a preset.
pub fn small_config(preset: &str, settings: &[&str]) -> Config {
    let mut all: Vec<String> = [
        "train.rays=21",
        "train.chunk_samples=1024",
        "train.iterations=40",
        "train.iterations_per_submit=4",
        "march.static_samples=24",
        "march.dynamic_samples=40",
        "march.render_samples=32",
        "static.grid=9",
        "dynamic.width=32",
        "dynamic.delay=0",
        "dynamic.window_iterations=20",
        "hull.enabled=false",
    ]
    .map(String::from)
    .to_vec();
    all.extend(settings.iter().map(|s| (*s).to_owned()));
    let preset = nertca_vk::choice::Choice::named(preset).unwrap();
    Config::load(Some(preset), None, &all).unwrap()
}

/// Largest error relative to the largest reference value, and where. NaN counts as infinite.
pub fn relative_error(got: &[f32], want: &[f64]) -> (f64, usize) {
    assert_eq!(got.len(), want.len());
    let scale = want.iter().fold(0f64, |m, v| m.max(v.abs())).max(1e-300);
    let mut worst = (0.0, 0);
    for (i, (g, w)) in got.iter().zip(want).enumerate() {
        let error = (f64::from(*g) - w).abs() / scale;
        let error = if error.is_nan() { f64::INFINITY } else { error };
        if error > worst.0 {
            worst = (error, i);
        }
    }
    worst
}

/// The default phantom, procedural, without photon noise, with its vessel volumes beside it.
pub fn phantom(gpu: &Gpu, directory: &Path, size: usize, views: u32) -> Dataset {
    let options = PhantomOptions {
        setting: Setting::Xcat,
        size,
        phases: 10,
        views: ViewAngles::published(views).unwrap(),
        seed: 1,
        degradations: Degradations::default(),
        layout: Layout::Native,
        anatomy: None,
        volumes: true,
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

/// Leaves the first training view's images to validation alone.
pub fn drop_first_view(dataset: &mut Dataset) {
    let first = dataset.training_views()[0];
    dataset.frames.retain(|f| f.split == Split::Validation || f.view != first);
}
