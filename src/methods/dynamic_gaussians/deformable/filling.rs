//! Filling of the Gaussians of a deformable set where contrast comes or goes: the share of its density at rest that a Gaussian shows at
//! each phase. It belongs to the images, like their contrast; the field that is drawn is that of full vessels.

use crate::error::Result;
use crate::gaussians::field::mass;
use crate::gaussians::particles::retain_marked;
use crate::gpu::buffer::Memory;
use crate::gpu::device::Gpu;
use crate::kernels::dispatch::buffer_set;
use crate::kernels::layout::{Gaussian, GaussianSetup};
use glam::DVec3;

/// Minimum filling; it is above zero because the gradient is divided by the filling.
pub const MIN_FILLING: f32 = 0.01;
/// Adam's rate of fillings, per iteration.
pub const FILLING_RATE: f32 = 0.05;

/// Filling with Adam's moments: `[Gaussian][phase]`.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Filling {
    /// Fillings, from [`MIN_FILLING`] to 1.
    pub values: Vec<f32>,
    /// First moments.
    pub first: Vec<f32>,
    /// Second moments.
    pub second: Vec<f32>,
}

buffer_set! {
    /// Filling of Gaussians on the device.
    pub struct FillingBuffers {
        /// `[Gaussian][phase]`: fillings.
        filling,
        /// First moments of Adam, in the same layout.
        filling_first,
        /// Second moments of Adam, in the same layout.
        filling_second,
        /// Gradient, in the same layout.
        filling_gradient,
    }
}

impl Filling {
    /// Returns fillings with zero moments.
    pub fn fresh(values: Vec<f32>) -> Filling {
        let zeros = vec![0.0; values.len()];
        Filling { values, first: zeros.clone(), second: zeros }
    }

    /// Keeps the filling of Gaussians marked in `keep`, one mark per Gaussian.
    pub fn retain(&mut self, keep: &[bool]) {
        retain_marked(&mut self.values, keep);
        retain_marked(&mut self.first, keep);
        retain_marked(&mut self.second, keep);
    }

    /// Appends fillings with zero moments.
    pub fn append(&mut self, values: Vec<f32>) {
        let fresh = Filling::fresh(values);
        self.values.extend(fresh.values);
        self.first.extend(fresh.first);
        self.second.extend(fresh.second);
    }

    /// Uploads the filling to the device.
    ///
    /// # Errors
    /// [`crate::error::Error::OutOfMemory`] naming the buffer.
    pub fn upload(&self, gpu: &Gpu) -> Result<FillingBuffers> {
        Ok(FillingBuffers {
            filling: gpu.buffer_with("filling", &self.values)?,
            filling_first: gpu.buffer_with("filling_first", &self.first)?,
            filling_second: gpu.buffer_with("filling_second", &self.second)?,
            filling_gradient: gpu.buffer("filling_gradient", 4 * self.values.len() as u64, Memory::Device)?,
        })
    }
}

impl FillingBuffers {
    /// Reads the first `n` values back.
    ///
    /// # Errors
    /// Device errors.
    pub fn download(&self, gpu: &Gpu, n: usize) -> Result<Filling> {
        Ok(Filling {
            values: gpu.download(&self.filling, 0, n)?,
            first: gpu.download(&self.filling_first, 0, n)?,
            second: gpu.download(&self.filling_second, 0, n)?,
        })
    }
}

/// Estimates the filling of Gaussians at a phase, one value for each, from a set that was fitted to the images of this phase alone: the
/// ratio of the masses of both sets around the Gaussian, with a Gaussian weight of standard deviation `reach`, pixels. `moved` are the
/// Gaussians at their positions at the phase.
pub fn from_set_of_phase(moved: &[Gaussian], of_phase: &[Gaussian], setup: &GaussianSetup, reach: f64) -> Vec<f32> {
    let place = |g: &Gaussian| DVec3::from_array(g.position.map(f64::from));
    let around = |x: DVec3, rows: &[Gaussian]| -> f64 {
        let weight = |g: &Gaussian| (-0.5 * x.distance_squared(place(g)) / (reach * reach)).exp();
        rows.iter().map(|g| mass(g, setup) * weight(g)).sum()
    };
    let filling = |g: &Gaussian| {
        let (there, full) = (around(place(g), of_phase), around(place(g), moved));
        let share = if full > 0.0 { (there / full) as f32 } else { 1.0 };
        share.clamp(MIN_FILLING, 1.0)
    };
    moved.iter().map(filling).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn row(x: f32, density: f32) -> Gaussian {
        Gaussian { position: [x, 0.0, 0.0], log_density: density.ln(), ..Gaussian::default() }
    }

    #[test]
    fn filling_is_the_share_that_the_set_of_the_phase_shows() {
        let setup = GaussianSetup { min_scale: 0.4, max_scale: 6.0, ..GaussianSetup::default() };
        let vessel: Vec<Gaussian> = (0..40).map(|i| row(i as f32, 0.5)).collect();
        // The other set has half as many Gaussians, of other places; it shows all up to 20, half of the rest up to 30.
        let shown: Vec<Gaussian> = (0..15).map(|i| row(2.0 * i as f32 + 0.7, if i < 10 { 1.0 } else { 0.5 })).collect();
        let filling = from_set_of_phase(&vessel, &shown, &setup, 1.5);
        for (at, expected) in [(5, 1.0), (12, 1.0), (25, 0.5), (36, MIN_FILLING), (39, MIN_FILLING)] {
            assert!((filling[at] - expected).abs() < 0.06, "{at}: {} instead of {expected}", filling[at]);
        }
    }

    #[test]
    fn fillings_stay_with_their_gaussians() {
        let mut filling = Filling::fresh(vec![0.1, 0.2, 0.3, 0.4, 0.5, 0.6]);
        filling.first = vec![1.0, 2.0, 3.0, 4.0, 5.0, 6.0];
        filling.retain(&[true, false, true]);
        filling.append(vec![0.7, 0.8]);
        assert_eq!(filling.values, [0.1, 0.2, 0.5, 0.6, 0.7, 0.8]);
        assert_eq!(filling.first, [1.0, 2.0, 5.0, 6.0, 0.0, 0.0]);
    }
}
