//! Measures the cost of training through the C ABI relative to training directly. Repeats are paired, on the dataset
//! given as argument: `cargo bench --bench abi -- DATASET [ITERATIONS] [REPEATS]`.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::undocumented_unsafe_blocks, reason = "a measurement")]

use nertca_vk::config::{Config, Preset};
use nertca_vk::geometry::{Geometry, MM_PER_UNIT};
use nertca_vk::gpu::device::{DeviceOptions, Gpu};
use nertca_vk::kernels::tuning::Tuning;
use nertca_vk::plan::Plan;
use nertca_vk::scan::dataset::Dataset;
use nertca_vk::train::trainer::Trainer;
use nertca_vk_abi::context::*;
use nertca_vk_abi::reconstruction::*;
use nertca_vk_abi::training::*;
use nertca_vk_abi::types::*;
use std::ffi::CString;
use std::ptr::{null, null_mut};
use std::time::Instant;

fn frame_of(dataset: &Dataset, index: usize) -> nertca_frame {
    let frame = &dataset.training()[index];
    let Geometry::CArm(arm) = &dataset.views[frame.view].geometry else { panic!("a dataset of C-arm views is needed") };
    let zero: nertca_frame = unsafe { std::mem::zeroed() };
    nertca_frame {
        size: size_of::<nertca_frame>(),
        geometry: nertca_geometry {
            size: size_of::<nertca_geometry>(),
            primary_deg: arm.primary_deg,
            secondary_deg: arm.secondary_deg,
            sid_mm: arm.sid_mm,
            sod_mm: arm.sod_mm,
            pixel_mm: arm.pixel_mm,
            offset_mm: arm.offset_mm,
            table_mm: arm.table_mm,
            matrix: null(),
        },
        pixels: frame.integrals.as_ptr().cast(),
        pixels_bytes: 4 * frame.integrals.len(),
        width: dataset.width as u32,
        height: dataset.height as u32,
        format: NERTCA_PIXELS_F32,
        intensity: NERTCA_INTENSITY_INTEGRAL,
        phase: frame.phase as i32,
        ..zero
    }
}

fn main() {
    let arguments: Vec<String> = std::env::args().skip(1).filter(|a| a != "--bench").collect();
    let Some(path) = arguments.first() else {
        println!("usage: cargo bench --bench abi -- DATASET [ITERATIONS] [REPEATS]");
        return;
    };
    let number = |i: usize, default| arguments.get(i).map_or(default, |a| a.parse::<u32>().expect("a number"));
    let (iterations, repeats) = (number(1, 64), number(2, 7));
    let dataset = Dataset::open(path.as_ref()).expect("a dataset");
    let gpu = Gpu::open(&DeviceOptions::default()).expect("a device");
    let config = Config::preset(Preset::Fast);
    let tuning = Tuning::for_device(gpu.info());
    let mut direct = Trainer::new(&gpu, Plan::new(&config, &dataset).unwrap(), &dataset, tuning).unwrap();

    let (mut context, mut through) = (null_mut(), null_mut());
    let depth = dataset.depth_range.1 * MM_PER_UNIT;
    let options = CString::new(format!("phases = {}\ndepth_half_extent_mm = {depth}", dataset.n_phases)).unwrap();
    unsafe {
        assert_eq!(nertca_context_create(null(), null(), &mut context), 0);
        assert_eq!(nertca_reconstruction_create(context, options.as_ptr(), &mut through), 0);
        for index in 0..dataset.training().len() {
            assert_eq!(nertca_reconstruction_add_frame(through, &frame_of(&dataset, index)), 0);
        }
    }
    let mut run_direct = |n: u32| {
        let (begin, end) = (Instant::now(), direct.submitted() + n);
        while direct.step() < end {
            direct.advance(end).unwrap();
        }
        begin.elapsed().as_secs_f64()
    };
    let run_through = |n: u32| {
        let begin = Instant::now();
        assert_eq!(unsafe { nertca_reconstruction_train(through, n, None, null_mut(), null_mut()) }, 0);
        begin.elapsed().as_secs_f64()
    };
    run_direct(8);
    run_through(8);
    let mut ratios: Vec<f64> = (0..repeats)
        .map(|i| {
            // The order alternates, so that neither path always runs on the warmer machine.
            let first = if i % 2 == 0 { run_direct(iterations) } else { run_through(iterations) };
            let second = if i % 2 == 0 { run_through(iterations) } else { run_direct(iterations) };
            let (d, t) = if i % 2 == 0 { (first, second) } else { (second, first) };
            println!("{iterations} iterations: {d:.3} s directly, {t:.3} s through the ABI");
            t / d
        })
        .collect();
    ratios.sort_by(f64::total_cmp);
    println!(
        "through the ABI / directly: median {:.4} ({:.4} to {:.4})",
        ratios[ratios.len() / 2],
        ratios[0],
        ratios[ratios.len() - 1]
    );
    unsafe {
        assert_eq!(nertca_reconstruction_destroy(through), 0);
        assert_eq!(nertca_context_destroy(context), 0);
    }
}
