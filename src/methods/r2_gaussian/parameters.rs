//! Conversion of R2-Gaussian's stored parameters to the values they stand for and back, in f64: densities through a softplus,
//! scales between bounds through a sigmoid. Lengths are half sides of the volume, which is the cube from -1 to 1.

use crate::config::sections::R2;
use crate::kernels::layout::R2Gaussian;
use glam::{DMat3, DQuat, DVec3};

/// Share of their range by which stored scales keep away from its ends.
const MIN_SHARE: f64 = 1e-6;

/// ln(1 + e^x) without loss of small values.
pub fn softplus(x: f64) -> f64 {
    x.max(0.0) + (-x.abs()).exp().ln_1p()
}

/// Inverse of [`softplus`] at `density`, which is positive.
pub fn softplus_inverse(density: f64) -> f64 {
    density + (-(-density).exp_m1()).ln()
}

/// Standard deviations that a Gaussian may have.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ScaleBounds {
    /// Minimum.
    pub min: f64,
    /// Maximum.
    pub max: f64,
}

impl ScaleBounds {
    /// Bounds from the settings, which are shares of the volume's side.
    pub fn of(settings: &R2) -> ScaleBounds {
        ScaleBounds { min: 2.0 * settings.min_scale, max: 2.0 * settings.max_scale }
    }

    /// Stored form of a scale; one beyond the bounds counts as the bound.
    pub fn stored(self, scale: f64) -> f64 {
        let share = ((scale - self.min) / (self.max - self.min)).clamp(MIN_SHARE, 1.0 - MIN_SHARE);
        (share / (1.0 - share)).ln()
    }

    /// Scale of a stored value.
    pub fn scale(self, stored: f64) -> f64 {
        self.min + (self.max - self.min) / (1.0 + (-stored).exp())
    }
}

/// Stored form of a round Gaussian.
pub fn round(position: DVec3, density: f64, scale: f64, bounds: ScaleBounds, set: u32) -> R2Gaussian {
    R2Gaussian {
        position: position.as_vec3().to_array(),
        density: softplus_inverse(density) as f32,
        scale: [bounds.stored(scale) as f32; 3],
        set,
        rotation: [1.0, 0.0, 0.0, 0.0],
    }
}

impl R2Gaussian {
    /// Attenuation at the centre.
    pub fn attenuation(&self) -> f64 {
        softplus(self.density.into())
    }

    /// Centre.
    pub fn centre(&self) -> DVec3 {
        DVec3::from_array(self.position.map(f64::from))
    }

    /// Standard deviations along its axes.
    pub fn scales(&self, bounds: ScaleBounds) -> DVec3 {
        DVec3::from_array(self.scale.map(|stored| bounds.scale(stored.into())))
    }

    /// Axes, as columns.
    pub fn axes(&self) -> DMat3 {
        let [w, x, y, z] = self.rotation.map(f64::from);
        DMat3::from_quat(DQuat::from_xyzw(x, y, z, w).normalize())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_stored_stands_for_what_it_was_made_of() {
        for density in [1e-9, 1e-5, 0.15, 1.0, 40.0] {
            assert!((softplus(softplus_inverse(density)) / density - 1.0).abs() < 1e-12, "{density}");
        }
        let bounds = ScaleBounds { min: 0.001, max: 1.0 };
        for scale in [0.002, 0.02, 0.5, 0.99] {
            assert!((bounds.scale(bounds.stored(scale)) / scale - 1.0).abs() < 1e-12);
        }
        assert!((bounds.scale(bounds.stored(0.0)) - 0.001).abs() < 2e-6);
        assert!((bounds.scale(bounds.stored(7.0)) - 1.0).abs() < 2e-6);
    }
}
