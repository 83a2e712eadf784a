//! f64 reference implementation (twin) of `gaussian_rays` and `gaussian_points`: plain sums over all Gaussians, and small
//! steps along rays.

use crate::gaussians::field::{GaussianField, Units};
use crate::kernels::layout::{Gaussian, GaussianSetup};
use glam::{DMat3, DQuat, DVec3};

/// Number of steps along a ray per minimum standard deviation of a Gaussian.
const STEPS: f64 = 12.0;

/// A Gaussian in world units.
#[derive(Debug, Clone, Copy)]
pub struct Gauss {
    centre: DVec3,
    density: f64,
    /// Axes in rows, divided by their standard deviations.
    whiten: DMat3,
    min: f64,
    cut: f64,
}

/// Integral and maximum of a field along a ray.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Along {
    /// Line integral.
    pub integral: f64,
    /// Maximum attenuation per world unit.
    pub maximum: f64,
}

fn gauss(g: &Gaussian, units: Units, setup: &GaussianSetup) -> Gauss {
    let deviation = |log: f32| f64::from(log).exp().clamp(setup.min_scale.into(), setup.max_scale.into()) * units.pixel;
    let scale = DVec3::from_array(g.log_scale.map(deviation));
    let [w, x, y, z] = g.rotation.map(f64::from);
    let axes = DMat3::from_quat(DQuat::from_xyzw(x, y, z, w).normalize());
    Gauss {
        centre: DVec3::from_array(g.position.map(f64::from)) * units.pixel,
        density: f64::from(g.log_density).exp() * units.attenuation(),
        whiten: DMat3::from_diagonal(1.0 / scale) * axes.transpose(),
        min: scale.min_element(),
        cut: setup.cut.into(),
    }
}

/// Returns the Gaussians of the field at a phase.
pub fn field(field: &GaussianField, phase: usize) -> Vec<Gauss> {
    let sets = field.rows();
    field.at(phase).iter().map(|g| gauss(g, sets.units, &sets.setup)).collect()
}

/// Attenuation per world unit at a point.
pub fn at(field: &[Gauss], point: DVec3) -> f64 {
    let value = |g: &Gauss| {
        let q = (g.whiten * (point - g.centre)).length_squared();
        if q < g.cut * g.cut { g.density * (-0.5 * q).exp() } else { 0.0 }
    };
    field.iter().map(value).sum()
}

/// Integrates the field along a ray (a point on it and its direction) over the Gaussians within the cut, each over its
/// whole length.
pub fn along(field: &[Gauss], (anchor, direction): (DVec3, DVec3)) -> Along {
    let mut integral = 0.0;
    let mut met: Vec<(f64, f64, f64)> = Vec::new(); // depth of the peak, deviation along the ray, height
    for g in field {
        let (o, d) = (g.whiten * (anchor - g.centre), g.whiten * direction);
        let depth = -o.dot(d) / d.length_squared();
        let q = (o + depth * d).length_squared();
        if q < g.cut * g.cut {
            let (height, deviation) = (g.density * (-0.5 * q).exp(), 1.0 / d.length());
            integral += height * deviation * std::f64::consts::TAU.sqrt() * direction.length();
            met.push((depth, deviation, height));
        }
    }
    let sum = |depth: f64| met.iter().map(|(at, s, h)| h * (-0.5 * ((depth - at) / s).powi(2)).exp()).sum::<f64>();
    let step = field.iter().map(|g| g.min).fold(f64::INFINITY, f64::min) / STEPS / direction.length();
    let (low, high) = met.iter().fold((f64::INFINITY, f64::NEG_INFINITY), |(l, h), m| (l.min(m.0), h.max(m.0)));
    let steps = if met.is_empty() { 0 } else { ((high - low) / step).ceil() as usize + 1 };
    let maximum = (0..steps).map(|k| sum(low + k as f64 * step)).fold(0.0, f64::max);
    Along { integral, maximum }
}
