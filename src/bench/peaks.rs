//! Measures the peak rates of a device with kernels that do nothing else.

use crate::error::Result;
use crate::gpu::buffer::{Buffer, Memory};
use crate::gpu::capabilities::MatrixShape;
use crate::gpu::device::Gpu;
use crate::gpu::record::{Groups, Recording};
use crate::kernels::dispatch::{Binding, dispatch};
use crate::kernels::push::{self, PushConstants};
use crate::kernels::stages::{Build, Stage, matrix_shape};
use serde::{Deserialize, Serialize};
use std::time::Instant;

/// Peak rates of a device, measured with micro-benchmarks.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct Peaks {
    /// f32 multiply-adds, TFLOP/s.
    pub f32_tflops: f64,
    /// Products of f16 matrices with f32 sums, TFLOP/s; none without cooperative matrices.
    pub matrix_tflops: Option<f64>,
    /// Bytes read and written by a large copy, GB/s.
    pub copy_gb_per_s: f64,
    /// Whether the device's own clock timed the kernels; reports of older versions were timed by the host's clock.
    #[serde(default)]
    pub by_timestamps: bool,
}

/// Number of times a dispatch is run to find its shortest time.
const TRIES: u32 = 16;

/// Returns the shortest time of a dispatch, seconds, by the device's own clock. Where the queue has no timestamps, the host's
/// clock times the submit and the wait for it.
fn best_seconds<P: PushConstants>(
    gpu: &Gpu,
    stage: &Stage<P>,
    groups: [u32; 3],
    buffers: &[(Binding, &Buffer)],
    push: P,
) -> Result<f64> {
    let bound: Vec<_> = buffers.iter().map(|(name, buffer)| (*name, (*buffer).into())).collect();
    let mut recording = Recording::timed(gpu, "peak", 1)?;
    dispatch(&mut recording, stage, Groups::Direct(groups), &bound, push)?;
    let commands = recording.finish()?;
    let mut best = f64::INFINITY;
    for _ in 0..TRIES {
        let begin = Instant::now();
        gpu.wait(commands.submit()?)?;
        let by_host = begin.elapsed().as_secs_f64();
        best = best.min(commands.pass_times()?.first().map_or(by_host, |pass| 1e-3 * pass.ms));
    }
    Ok(best)
}

/// Measures the device's peak rates.
///
/// # Errors
/// Device errors.
pub fn peaks(gpu: &Gpu) -> Result<Peaks> {
    let info = gpu.info();
    let is_cpu = info.is_cpu();
    // These sizes take a few milliseconds on either kind of device.
    let (lanes, steps): (u32, u32) = if is_cpu { (256, 8000) } else { (1 << 19, 1024) };
    let stage: Stage<push::PeakF32> = Build::default().stage(gpu)?;
    let sink = gpu.buffer("sink", u64::from(lanes) * 16, Memory::Device)?;
    let push = push::PeakF32 { steps, a: 0.999, b: 0.001 };
    let seconds = best_seconds(gpu, &stage, [lanes / stage.local_size(), 1, 1], &[(Binding::sink, &sink)], push)?;
    let f32_tflops = f64::from(lanes) * f64::from(steps) * 32.0 * 12.0 * 2.0 / seconds * 1e-12;

    let matrix_tflops = match matrix_shape(info) {
        Some(shape) => Some(matrix_peak(gpu, shape)?),
        None => None,
    };

    let bytes = u64::from(info.max_storage_buffer_range).min(if is_cpu { 64 << 20 } else { 1 << 30 }) / 4096 * 4096;
    let stage: Stage<push::PeakCopy> = Build::default().stage(gpu)?;
    let (from, to) = (gpu.buffer("from", bytes, Memory::Device)?, gpu.buffer("to", bytes, Memory::Device)?);
    let count = (bytes / 16) as u32;
    let per_row = 16_384;
    let groups = [per_row, count.div_ceil(stage.local_size() * per_row), 1];
    let buffers = [(Binding::from, &from), (Binding::to, &to)];
    let seconds = best_seconds(gpu, &stage, groups, &buffers, push::PeakCopy { count })?;
    let copy_gb_per_s = 2.0 * bytes as f64 / seconds * 1e-9;
    Ok(Peaks { f32_tflops, matrix_tflops, copy_gb_per_s, by_timestamps: info.timestamp_period_ns > 0.0 })
}

fn matrix_peak(gpu: &Gpu, MatrixShape { m, n, k, .. }: MatrixShape) -> Result<f64> {
    let info = gpu.info();
    let subgroups = 8;
    let (groups, steps): (u32, u32) = if info.is_cpu() { (4, 2000) } else { (4096, 2048) };
    let constants = [("m", m), ("n", n), ("k", k), ("subgroups", subgroups)];
    let lanes = Some(subgroups * info.matrix_subgroup);
    let stage: Stage<push::PeakMatrix> =
        Build { lanes, constants: &constants, matrices: true, ..Build::default() }.stage(gpu)?;
    let random: Vec<half::f16> =
        (0..2 * (m * k).max(k * n)).map(|i| half::f16::from_f64(crate::random::uniform01(1, 0, i, 0) - 0.5)).collect();
    let operands = gpu.buffer_with("operands16", &random)?;
    let sink = gpu.buffer("sink", u64::from(groups * subgroups * m * n) * 4, Memory::Device)?;
    let buffers = [(Binding::operands16, &operands), (Binding::sink, &sink)];
    let seconds = best_seconds(gpu, &stage, [groups, 1, 1], &buffers, push::PeakMatrix { steps })?;
    Ok(f64::from(groups * subgroups) * f64::from(steps) * 4.0 * f64::from(2 * m * n * k) / seconds * 1e-12)
}
