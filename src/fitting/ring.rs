//! Ring buffers of losses: the device writes one loss per iteration, the host reads those of a submit.

use crate::error::{Error, Result};
use crate::fitting::RING_LENGTH;
use crate::gpu::buffer::{Buffer, Memory};
use crate::gpu::device::Gpu;
use std::ops::Range;

/// Initial value of a loss that the device has not written: a NaN that arithmetic does not produce.
const UNTOLD: u32 = 0x7fc0_dead;

/// Creates a ring without losses.
pub(crate) fn ring(gpu: &Gpu, name: &str) -> Result<Buffer> {
    let buffer = gpu.buffer(name, 4 * u64::from(RING_LENGTH), Memory::Readback)?;
    buffer.write(&[UNTOLD; RING_LENGTH as usize])?;
    Ok(buffer)
}

/// Returns the losses of some iterations. A loss that is not finite is an error with the `advice`.
pub(crate) fn losses(gpu: &Gpu, ring: &Buffer, steps: Range<u32>, advice: &'static str) -> Result<Vec<f64>> {
    let mut told = vec![0f32; RING_LENGTH as usize];
    ring.read(&mut told)?;
    let loss = |step: u32| {
        let loss = told[(step % RING_LENGTH) as usize];
        if loss.to_bits() == UNTOLD {
            return Err(tells_nothing(gpu, step + 1));
        }
        if !loss.is_finite() {
            return Err(Error::Diverged { step: u64::from(step) + 1, quantity: "loss", value: loss.into(), advice });
        }
        Ok(f64::from(loss))
    };
    steps.map(loss).collect()
}

/// Returns the error for a device whose submit ended without having written a loss.
pub(crate) fn tells_nothing(gpu: &Gpu, step: u32) -> Error {
    counts_wrongly(gpu, &format!("was to execute iteration {step} and has written no loss for it"))
}

/// Returns the error for a device that does not execute, or does not count, the requested iterations.
pub(crate) fn counts_wrongly(gpu: &Gpu, what: &str) -> Error {
    Error::NoDevice(format!(
        "{} {what}; `nertca-vk selftest` shows which stages this device computes wrongly",
        gpu.info().name
    ))
}
