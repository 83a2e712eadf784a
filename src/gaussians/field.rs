//! Gaussians as the dynamic field, plain data: a set per phase, or one moving set.

use crate::error::{Error, Result};
use crate::geometry::MM_PER_UNIT;
use crate::kernels::layout::{DeformableSetup, Gaussian, GaussianSetup};
use glam::DVec3;
use serde::Serialize;
use std::sync::{Arc, Mutex};

/// Settings with which a fit of Gaussians that diverged may succeed.
pub const SMALLER_STEPS: &str = "another seed, or a lower gaussians.count";

/// Units of Gaussians, for conversion from and to world units and line integrals.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Units {
    /// World units (100 mm) of a pixel at the isocentre.
    pub pixel: f64,
    /// Line integral that counts as 1: the views' strongest change.
    pub strongest: f64,
}

impl Units {
    /// Returns the attenuation per world unit of a density of 1.
    pub fn attenuation(&self) -> f64 {
        self.strongest / self.pixel
    }
}

/// Returns the identity quaternion.
pub fn rotation_none() -> [f32; 4] {
    [1.0, 0.0, 0.0, 0.0]
}

/// A dynamic field as a set of Gaussians per phase.
#[derive(Debug, Clone, PartialEq)]
pub struct Gaussians {
    /// Units of the Gaussians.
    pub units: Units,
    /// Cardiac phases.
    pub n_phases: usize,
    /// Bounds of the scales, and cut-off of the Gaussians.
    pub setup: GaussianSetup,
    /// Gaussians of all phases, in the order of training.
    pub rows: Vec<Gaussian>,
    /// Iterations done.
    pub step: u32,
    /// Whether the model consists of Gaussians alone, of which hundreds overlap, as with R2-Gaussian: the maximum of their sum
    /// along a ray is then searched among all of them.
    pub is_crowd: bool,
    /// Intensities of Gaussians of which nearer ones hide those behind them, as with X-Gaussian; none where line integrals add
    /// up.
    pub intensities: Option<Vec<f32>>,
    /// Agreement of the fits, where the field is the mean of several.
    pub agreement: Option<FitAgreement>,
}

/// Agreement of several fits to the same images, whose mean is a field.
#[derive(Debug, Clone, PartialEq)]
pub struct FitAgreement {
    /// Share of the attenuation of one fit that lies in vessels of another, 0 to 1.
    pub overall: f64,
    /// For each Gaussian, the share of the other fits that have a vessel at its centre, 0 to 1, as the mean over the phases; empty where
    /// it is not known, as in checkpoints that have only the share of all.
    pub of_gaussians: Vec<f32>,
}

impl Gaussians {
    /// Returns the Gaussians of a phase.
    pub fn at(&self, phase: usize) -> impl Iterator<Item = &Gaussian> {
        self.rows.iter().filter(move |g| g.phase as usize == phase)
    }

    /// Returns the Gaussians of a phase with their intensities; empty where line integrals add up.
    pub fn blended_at(&self, phase: usize) -> Vec<(Gaussian, f32)> {
        let shown = self.rows.iter().zip(self.intensities.iter().flatten());
        shown.filter(|(g, _)| g.phase as usize == phase).map(|(g, intensity)| (*g, *intensity)).collect()
    }

    /// Refuses parameters that are not finite.
    ///
    /// # Errors
    /// [`Error::Diverged`] with the first such parameter.
    pub fn check(&self) -> Result<()> {
        let numbers = |g: &Gaussian| g.position.into_iter().chain(g.log_scale).chain(g.rotation).chain([g.log_density]);
        match self.rows.iter().flat_map(numbers).find(|v| !v.is_finite()) {
            Some(bad) => {
                let step = u64::from(self.step);
                let (quantity, value) = ("a parameter of a Gaussian", f64::from(bad));
                Err(Error::Diverged { step, quantity, value, advice: SMALLER_STEPS })
            }
            None => Ok(()),
        }
    }
}

/// Returns the standard deviations of a Gaussian along its own axes, clamped to the bounds, pixels.
pub fn scales(g: &Gaussian, setup: &GaussianSetup) -> DVec3 {
    DVec3::from_array(g.log_scale.map(|log| f64::from(log.exp().clamp(setup.min_scale, setup.max_scale))))
}

/// Returns an approximate maximum of the line integrals through a Gaussian, from the scale of its thinnest axis.
pub fn amplitude(g: &Gaussian, setup: &GaussianSetup) -> f64 {
    let thinnest = g.log_scale.iter().copied().fold(f32::INFINITY, f32::min).exp();
    let scale = f64::from(thinnest.clamp(setup.min_scale, setup.max_scale));
    f64::from(g.log_density).exp() * std::f64::consts::TAU.sqrt() * scale
}

/// Share of the total attenuation in Gaussians that are less dense than the vessels.
const BELOW_VESSELS: f64 = 0.75;

/// Returns the density of the vessels: three quarters of the attenuation are in less dense Gaussians, such as the ends, the
/// walls and the thin branches of vessels, and other moving structures.
pub fn vessel_density(rows: &[Gaussian], setup: &GaussianSetup) -> f64 {
    let mut by_density: Vec<(f64, f64)> = rows.iter().map(|g| (density(g), mass(g, setup))).collect();
    by_density.sort_by(|a, b| a.0.total_cmp(&b.0));
    let all: f64 = by_density.iter().map(|(_, mass)| mass).sum();
    let mut below = 0.0;
    for (density, mass) in &by_density {
        below += mass;
        if below >= BELOW_VESSELS * all {
            return *density;
        }
    }
    0.0
}

/// Returns the attenuation at a Gaussian's centre, in the units of the set.
pub fn density(g: &Gaussian) -> f64 {
    f64::from(g.log_density).exp()
}

/// Returns the total attenuation of a Gaussian, up to a common factor.
pub(crate) fn mass(g: &Gaussian, setup: &GaussianSetup) -> f64 {
    density(g) * scales(g, setup).element_product()
}

/// Tells for each Gaussian whether its density is at least a `share` of the vessels' density.
pub fn dense(rows: &[Gaussian], setup: &GaussianSetup, share: f64) -> Vec<bool> {
    let min = share * vessel_density(rows, setup);
    rows.iter().map(|g| density(g) >= min).collect()
}

/// Returns the nodes per pixel of a deformable set's grid of `n_nodes` nodes along each axis, which reaches `half_side` pixels to either
/// side. It is computed from values that checkpoints keep exactly, so that a loaded field draws the same pictures as the saved
/// one.
pub fn inverse_step(n_nodes: u32, half_side: f32) -> f32 {
    (f64::from(n_nodes - 1) / (2.0 * f64::from(half_side))) as f32
}

/// One set of Gaussians for the whole beat.
#[derive(Debug, Clone, PartialEq)]
pub struct DeformableGaussians {
    /// Gaussians at the rest phase.
    pub rest: Gaussians,
    /// The grid.
    pub setup: DeformableSetup,
    /// `[phase][node]`: displacement (x, y, z, 0), pixels at the isocentre; zero at the rest phase.
    pub grid: Vec<[f32; 4]>,
    /// `[Gaussian][basis function]`: own motion (x, y, z, 0), pixels at the isocentre.
    pub own: Vec<[f32; 4]>,
    /// `[Gaussian][phase]`: filling, above 0 and at most 1, by which images at that phase show less than the density at rest, where contrast comes or
    /// goes; none where vessels are full all the time. Drawn vessels are full.
    pub filling: Option<Vec<f32>>,
}

/// Gaussians as the dynamic field of a model.
#[derive(Debug, Clone, PartialEq)]
pub enum DynamicGaussians {
    /// A separate set per phase; the sets share nothing.
    PerPhase(Gaussians),
    /// One moving set for the whole beat.
    Deformable(DeformableGaussians),
}

/// Current Gaussians of a run in training, and the number of their changes so far.
pub type GaussianFeed = Arc<Mutex<(u64, DynamicGaussians)>>;

impl DynamicGaussians {
    /// Returns the Gaussians; for a deformable set, those at its rest phase.
    pub fn rows(&self) -> &Gaussians {
        match self {
            DynamicGaussians::PerPhase(sets) => sets,
            DynamicGaussians::Deformable(deformable) => &deformable.rest,
        }
    }

    /// Returns the deformable set, if the field is one.
    pub fn deformable(&self) -> Option<&DeformableGaussians> {
        match self {
            DynamicGaussians::PerPhase(_) => None,
            DynamicGaussians::Deformable(deformable) => Some(deformable),
        }
    }

    /// Returns the name of the field's form: sets per phase that hide each other (`x`), that are crowded (`r2`) or neither (`phase`), or one
    /// moving set (`deformable`).
    pub fn form(&self) -> &'static str {
        match self {
            DynamicGaussians::PerPhase(sets) if sets.intensities.is_some() => "x",
            DynamicGaussians::PerPhase(sets) if sets.is_crowd => "r2",
            DynamicGaussians::PerPhase(_) => "phase",
            DynamicGaussians::Deformable(_) => "deformable",
        }
    }

    /// Returns the Gaussians at a phase, from 0.
    pub fn at(&self, phase: usize) -> Vec<Gaussian> {
        self.at_time(phase as f64)
    }

    /// Returns the Gaussians at a time counted in phases; those of the nearest phase where each phase has its own set.
    pub fn at_time(&self, phases: f64) -> Vec<Gaussian> {
        match self {
            DynamicGaussians::PerPhase(sets) => sets.at(phases.round() as usize % sets.n_phases).copied().collect(),
            DynamicGaussians::Deformable(deformable) => deformable.at(phases),
        }
    }

    /// Returns the Gaussians as images show them at a time counted in phases: filled with contrast as far as it had come. Those of
    /// [`DynamicGaussians::at_time`] are full.
    pub fn imaged_at_time(&self, phases: f64) -> Vec<Gaussian> {
        match self {
            DynamicGaussians::PerPhase(_) => self.at_time(phases),
            DynamicGaussians::Deformable(deformable) => deformable.imaged_at(phases),
        }
    }

    /// Returns the lower and upper corner of a box around the centres at all phases, world units; `None` without Gaussians.
    pub fn bounds(&self) -> Option<(DVec3, DVec3)> {
        let phases = 0..self.rows().n_phases;
        let centres = phases.flat_map(|phase| self.at(phase)).map(|g| DVec3::from_array(g.position.map(f64::from)));
        let pixel = self.rows().units.pixel;
        centres.map(|x| (x * pixel, x * pixel)).reduce(|a, b| (a.0.min(b.0), a.1.max(b.1)))
    }
}

/// Returns the values of the basis functions of own motion at a fraction of the beat, counted from the rest phase: harmonics
/// that vanish there.
pub fn basis(n_basis: usize, fraction: f64) -> Vec<f64> {
    let angle = |k: usize| std::f64::consts::TAU * fraction * k as f64;
    let harmonics = n_basis / 2;
    (1..=harmonics).map(|k| angle(k).cos() - 1.0).chain((1..=harmonics).map(|k| angle(k).sin())).collect()
}

/// Returns the nodes around a point with their interpolation weights.
pub fn shares(setup: &DeformableSetup, x: DVec3) -> [(usize, f64); 8] {
    let n = setup.n_nodes as usize;
    let last = DVec3::splat(f64::from(setup.n_nodes) - 1.001);
    let place = (x + f64::from(setup.half_side)) * f64::from(setup.inverse_step);
    let place = place.clamp(DVec3::ZERO, last);
    let first = place.floor();
    let part = place - first;
    std::array::from_fn(|corner| {
        let [dx, dy, dz] = [corner & 1, corner >> 1 & 1, corner >> 2];
        let along = |d: usize, part: f64| if d == 1 { part } else { 1.0 - part };
        let node = ((first.z as usize + dz) * n + first.y as usize + dy) * n + first.x as usize + dx;
        (node, along(dx, part.x) * along(dy, part.y) * along(dz, part.z))
    })
}

/// Distances of Gaussians at a phase from their positions at phase 0.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Displacement {
    /// Mean over the Gaussians, mm; 0 without any.
    pub mean_mm: f64,
    /// Maximum over the Gaussians, mm.
    pub largest_mm: f64,
}

/// Returns the first three of four numbers.
pub(crate) fn vector(v: &[f32; 4]) -> DVec3 {
    DVec3::new(v[0].into(), v[1].into(), v[2].into())
}

impl DeformableGaussians {
    /// Returns the position at a phase to which the grid moves a point of the rest phase. The phase may be fractional; the
    /// motion is periodic.
    pub fn carried(&self, x: DVec3, phase: f64) -> DVec3 {
        let n_phases = self.rest.n_phases;
        let phase = phase.rem_euclid(n_phases as f64);
        let (before, share) = (phase.floor() as usize % n_phases, phase.fract());
        let all = shares(&self.setup, x);
        let at = |t: usize| -> DVec3 {
            let nodes = &self.grid[t * self.setup.nodes()..][..self.setup.nodes()];
            all.iter().map(|(node, share)| *share * vector(&nodes[*node])).sum()
        };
        x + at(before).lerp(at((before + 1) % n_phases), share)
    }

    /// Returns the position of Gaussian `index` at a phase, which may be fractional: positions are interpolated linearly
    /// between phases, as in the fit of images taken there. The motion is periodic.
    pub fn position(&self, index: usize, phase: f64) -> DVec3 {
        let n_phases = self.rest.n_phases;
        let phase = phase.rem_euclid(n_phases as f64);
        let before = phase.floor() as usize % n_phases;
        let own = self.own_way(index, before).lerp(self.own_way(index, (before + 1) % n_phases), phase.fract());
        self.carried(self.at_rest(index), phase) + own
    }

    /// Returns the displacement of Gaussian `index` by its own motion, relative to the position given by the grid, at a phase.
    fn own_way(&self, index: usize, phase: usize) -> DVec3 {
        let n_basis = self.setup.n_basis as usize;
        let own = &self.own[index * n_basis..][..n_basis];
        let since_rest = phase as f64 - f64::from(self.setup.rest_phase);
        let basis = basis(n_basis, since_rest / self.rest.n_phases as f64);
        own.iter().zip(basis).map(|(a, b)| b * vector(a)).sum()
    }

    fn at_rest(&self, index: usize) -> DVec3 {
        DVec3::from_array(self.rest.rows[index].position.map(f64::from))
    }

    /// Returns the distances of Gaussians at a phase from their positions at phase 0, own motion included.
    pub fn displacement(&self, phase: f64) -> Displacement {
        let mm = self.rest.units.pixel * MM_PER_UNIT;
        let n = self.rest.rows.len();
        let lengths: Vec<f64> = (0..n).map(|i| mm * self.position(i, phase).distance(self.position(i, 0.0))).collect();
        Displacement {
            mean_mm: lengths.iter().sum::<f64>() / n.max(1) as f64,
            largest_mm: lengths.into_iter().fold(0.0, f64::max),
        }
    }

    /// Returns the index of the Gaussian nearest to a point of the rest phase.
    pub fn nearest(&self, x: DVec3) -> usize {
        let distance = |i: usize| self.at_rest(i).distance_squared(x);
        (0..self.rest.rows.len()).min_by(|a, b| distance(*a).total_cmp(&distance(*b))).unwrap_or(0)
    }

    /// Returns the Gaussians at a phase, which may be fractional.
    pub fn at(&self, phase: f64) -> Vec<Gaussian> {
        let moved = |(i, g): (usize, &Gaussian)| Gaussian {
            position: self.position(i, phase).as_vec3().to_array(),
            phase: phase as u32,
            ..*g
        };
        self.rest.rows.iter().enumerate().map(moved).collect()
    }

    /// Returns the filling of Gaussian `index` at a phase, above 0 and at most 1; 1 where vessels are full all the time.
    pub fn filling_at(&self, index: usize, phase: usize) -> f64 {
        let n_phases = self.rest.n_phases;
        self.filling.as_ref().map_or(1.0, |filling| filling[index * n_phases + phase % n_phases].into())
    }

    /// Returns the share of the set's attenuation that contrast fills at a phase, above 0 and at most 1.
    pub fn filled_share(&self, phase: usize) -> f64 {
        let (mut filled, mut all) = (0.0, 0.0);
        for (i, g) in self.rest.rows.iter().enumerate() {
            let mass = mass(g, &self.rest.setup);
            filled += mass * self.filling_at(i, phase);
            all += mass;
        }
        if all > 0.0 { filled / all } else { 1.0 }
    }

    /// Returns the Gaussians as images show them at a phase, which may be fractional: with the density to which contrast fills them,
    /// interpolated linearly between phases.
    pub fn imaged_at(&self, phase: f64) -> Vec<Gaussian> {
        let mut rows = self.at(phase);
        if self.filling.is_none() {
            return rows;
        }
        let phase = phase.rem_euclid(self.rest.n_phases as f64);
        for (i, g) in rows.iter_mut().enumerate() {
            let [here, beyond] = [0, 1].map(|more| self.filling_at(i, phase as usize + more));
            g.log_density += (here + (beyond - here) * phase.fract()).ln() as f32;
        }
        rows
    }

    /// Returns the Gaussians at all phases as a set per phase, for scoring.
    pub fn expand(&self) -> Gaussians {
        let rows = (0..self.rest.n_phases).flat_map(|phase| self.at(phase as f64)).collect();
        Gaussians { rows, ..self.rest.clone() }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn shares_are_trilinear() {
        let setup = DeformableSetup { n_nodes: 4, half_side: 30.0, inverse_step: 0.05, ..DeformableSetup::default() };
        let x = DVec3::new(-17.0, 3.0, 22.0);
        let all = shares(&setup, x);
        assert!((all.iter().map(|s| s.1).sum::<f64>() - 1.0).abs() < 1e-12);
        let node = |i: usize| DVec3::new((i % 4) as f64, (i / 4 % 4) as f64, (i / 16) as f64) * 20.0 - 30.0;
        let mean: DVec3 = all.iter().map(|(i, share)| *share * node(*i)).sum();
        assert!((mean - x).length() < 1e-6, "a linear field is reproduced: {mean}");
    }

    #[test]
    fn broad_and_faint_is_no_vessel() {
        let setup = GaussianSetup { min_scale: 0.5, max_scale: 4.0, ..GaussianSetup::default() };
        let gaussian = |density: f32, scale: f32| Gaussian {
            log_density: density.ln(),
            log_scale: [scale.ln(); 3],
            ..Gaussian::default()
        };
        // A quarter of the attenuation is in the broad Gaussian, hardly any in the small dense one.
        let mut rows = vec![gaussian(0.01, 4.0)];
        rows.extend(vec![gaussian(0.2, 1.0); 10]);
        rows.push(gaussian(0.6, 0.5));
        assert!((vessel_density(&rows, &setup) - 0.2).abs() < 1e-6);
        // Scales beyond the bounds are clamped to them, as in images.
        rows[0].log_scale = [100f32.ln(); 3];
        assert!((vessel_density(&rows, &setup) - 0.2).abs() < 1e-6);
        let kept = |share: f64| dense(&rows, &setup, share).iter().filter(|kept| **kept).count();
        assert_eq!((kept(0.04), kept(0.06), kept(1.1)), (12, 11, 1));
        assert_eq!(dense(&[], &setup, 0.5), [false; 0]);
    }

    #[test]
    fn own_motion_begins_and_ends_at_rest() {
        assert!(basis(8, 0.0).iter().chain(&basis(8, 1.0)).all(|v| v.abs() < 1e-12));
        assert!(basis(8, 0.3).iter().any(|v| v.abs() > 0.5));
    }
}
