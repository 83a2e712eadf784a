//! Opacities, scales and axes of Gaussians of which nearer ones hide those behind them, from the numbers that are stored.

use crate::kernels::layout::BlendGaussian;
use glam::{DMat3, DQuat, DVec3};

impl BlendGaussian {
    /// Returns the opacity at the centre.
    pub fn shown_opacity(&self) -> f64 {
        1.0 / (1.0 + (-f64::from(self.opacity)).exp())
    }

    /// Returns the logarithm of the opacity, accurate also for opacities near 1.
    pub fn log_opacity(&self) -> f64 {
        -(-f64::from(self.opacity)).exp().ln_1p()
    }

    /// Returns the centre.
    pub fn centre(&self) -> DVec3 {
        DVec3::from_array(self.position.map(f64::from))
    }

    /// Returns the standard deviations along its axes.
    pub fn scales(&self) -> DVec3 {
        DVec3::from_array(self.log_scale.map(|log| f64::from(log).exp()))
    }

    /// Returns its axes as columns.
    pub fn axes(&self) -> DMat3 {
        let [w, x, y, z] = self.rotation.map(f64::from);
        DMat3::from_quat(DQuat::from_xyzw(x, y, z, w).normalize())
    }
}

/// Returns the stored parameter of an opacity between 0 and 1 that is given by its logarithm.
pub fn stored_opacity(log_opacity: f64) -> f64 {
    log_opacity - (-log_opacity.exp_m1()).ln()
}
