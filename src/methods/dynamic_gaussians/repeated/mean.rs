//! The mean of several dynamic fields that were fitted to the same images, and their agreement. Errors that the fits do not share
//! are fainter in the mean.

use crate::gaussians::field::{FitAgreement, GaussianField, Gaussians, MovingGaussians, scales, vessel_density};
use crate::kernels::layout::{Gaussian, GaussianSetup, MotionGridSetup};
use glam::{DMat3, DQuat, DVec3};
use rayon::prelude::*;
use std::f64::consts::TAU;

/// Attenuation, as a share of the density of the vessels, from which a place counts as vessel.
const VESSEL_SHARE: f64 = 0.2;

impl GaussianField {
    /// Returns the field whose attenuation is the mean of those of `members` times `factor`; `None` without members or where their
    /// forms differ. All were fitted to the same images. The mean of deformable sets has the grid of the first: own motion of the
    /// Gaussians takes up what theirs differs by, exactly at the phases and between them.
    pub fn mean(members: &[GaussianField], factor: f64) -> Option<GaussianField> {
        let first = members.first()?;
        let share = (factor / members.len() as f64).ln() as f32;
        let fainter = |g: &Gaussian| Gaussian { log_density: g.log_density + share, ..*g };
        let rows = members.iter().flat_map(|member| member.rows().rows.iter().map(fainter)).collect();
        let rows = Gaussians { rows, agreement: agreement(members), ..first.rows().clone() };
        if members.iter().all(|member| member.moving().is_none()) {
            return Some(GaussianField::PerPhase(rows));
        }
        let sets: Vec<&MovingGaussians> = members.iter().map(GaussianField::moving).collect::<Option<_>>()?;
        let grid = sets.first()?;
        let own = sets.iter().flat_map(|set| (0..set.rest.rows.len()).flat_map(|i| own_on_grid(set, i, grid)));
        let is_full = sets.iter().all(|set| set.filling.is_none());
        let filling = sets.iter().flat_map(|set| match &set.filling {
            Some(filling) => filling.clone(),
            None => vec![1.0; set.rest.rows.len() * set.rest.n_phases],
        });
        Some(GaussianField::Moving(MovingGaussians {
            own: own.collect(),
            filling: (!is_full).then(|| filling.collect()),
            setup: MotionGridSetup { n_basis: full_basis(rows.n_phases) as u32, ..grid.setup },
            rest: rows,
            grid: grid.grid.clone(),
        }))
    }
}

/// Number of basis functions that express any motion at the phases of a beat.
fn full_basis(n_phases: usize) -> usize {
    2 * (n_phases / 2)
}

/// Returns the own motion that a Gaussian of a set needs on another grid, as coefficients of [`full_basis`] functions.
fn own_on_grid(set: &MovingGaussians, index: usize, grid: &MovingGaussians) -> Vec<[f32; 4]> {
    let (n, rest_phase) = (set.rest.n_phases, set.setup.rest_phase as usize);
    let at_rest = DVec3::from_array(set.rest.rows[index].position.map(f64::from));
    let own = |since_rest: usize| {
        let phase = ((rest_phase + since_rest) % n) as f64;
        set.position(index, phase) - grid.carried(at_rest, phase)
    };
    let own: Vec<DVec3> = (0..n).map(own).collect();
    // The discrete Fourier transform; motion vanishes at rest, as the basis functions do.
    let coefficient = |k: usize, wave: fn(f64) -> f64| -> DVec3 {
        let of = |(t, x): (usize, &DVec3)| *x * wave(TAU * (k * t) as f64 / n as f64);
        let sum: DVec3 = own.iter().enumerate().map(of).sum();
        sum * if 2 * k == n { 1.0 } else { 2.0 } / n as f64
    };
    let harmonics = 1..=full_basis(n) / 2;
    let cosines = harmonics.clone().map(|k| coefficient(k, f64::cos));
    let sines = harmonics.map(|k| if 2 * k == n { DVec3::ZERO } else { coefficient(k, f64::sin) });
    cosines.chain(sines).map(|v| v.extend(0.0).as_vec4().to_array()).collect()
}

/// A Gaussian of one fit at a phase.
struct Found {
    /// Number of the Gaussian in its fit.
    index: usize,
    /// Integral of its attenuation, without a constant factor.
    mass: f64,
    /// Share of the other fits that have a vessel at its centre.
    share: f64,
}

/// Returns the agreement of fits; `None` with fewer than two, and for fields without attenuation.
fn agreement(members: &[GaussianField]) -> Option<FitAgreement> {
    let n_phases = members.first()?.rows().n_phases;
    if members.len() < 2 {
        return None;
    }
    let places: Vec<(usize, usize)> =
        (0..members.len()).flat_map(|fit| (0..n_phases).map(move |phase| (fit, phase))).collect();
    let found: Vec<Vec<Found>> = places.par_iter().map(|(fit, phase)| found(members, *fit, *phase)).collect();
    let of_all = |of: fn(&Found) -> f64| found.iter().flatten().map(of).sum::<f64>();
    let (inside, all) = (of_all(|g| g.mass * g.share), of_all(|g| g.mass));
    let firsts: Vec<usize> = members
        .iter()
        .scan(0, |first, member| Some(std::mem::replace(first, *first + member.rows().rows.len())))
        .collect();
    let mut sums = vec![[0f32; 2]; members.iter().map(|member| member.rows().rows.len()).sum()];
    for ((fit, _), of_phase) in places.iter().zip(&found) {
        for g in of_phase {
            let [sum, count] = &mut sums[firsts[*fit] + g.index];
            *sum += g.share as f32;
            *count += 1.0;
        }
    }
    let of_gaussians = sums.into_iter().map(|[sum, count]| sum / count.max(1.0)).collect();
    (all > 0.0).then(|| FitAgreement { overall: inside / all, of_gaussians })
}

/// Looks for the Gaussians of a fit at a phase in all other fits.
fn found(members: &[GaussianField], fit: usize, phase: usize) -> Vec<Found> {
    let field = &members[fit];
    let indices: Vec<usize> = match field {
        GaussianField::PerPhase(sets) => {
            (0..sets.rows.len()).filter(|i| sets.rows[*i].phase as usize == phase).collect()
        }
        GaussianField::Moving(set) => (0..set.rest.rows.len()).collect(),
    };
    let others: Vec<(Vec<Shape>, f64)> = members
        .iter()
        .enumerate()
        .filter(|(other, _)| *other != fit)
        .map(|(_, other)| {
            let (rows, setup) = (other.at(phase), &other.rows().setup);
            (rows.iter().map(|g| Shape::new(g, setup)).collect(), VESSEL_SHARE * vessel_density(&rows, setup))
        })
        .collect();
    let is_vessel = |x: DVec3, (shapes, vessel): &(Vec<Shape>, f64)| {
        !shapes.is_empty() && shapes.iter().map(|shape| shape.density(x)).sum::<f64>() >= *vessel
    };
    let look = |(index, g): (usize, Gaussian)| {
        let x = DVec3::from_array(g.position.map(f64::from));
        let n = others.iter().filter(|other| is_vessel(x, other)).count();
        let mass = f64::from(g.log_density).exp() * scales(&g, &field.rows().setup).element_product();
        Found { index, mass, share: n as f64 / others.len() as f64 }
    };
    indices.into_iter().zip(field.at(phase)).map(look).collect()
}

impl GaussianField {
    /// Returns, at points in pixels, the share of the other fits that have a vessel there: the mean over the Gaussians of a phase, each
    /// weighted by its density at the point; 0 where there is none. `None` for a single fit, and where it is not known.
    pub fn agreement_at(&self, points: &[DVec3], phase: usize) -> Option<Vec<f64>> {
        let rows = self.rows();
        let shares = rows.agreement.as_ref().map(|agreement| &agreement.of_gaussians).filter(|all| !all.is_empty())?;
        let is_shown = |i: &usize| self.moving().is_some() || rows.rows[*i].phase as usize == phase;
        let shares: Vec<f64> = (0..rows.rows.len()).filter(is_shown).map(|i| f64::from(shares[i])).collect();
        let shapes: Vec<Shape> = self.at(phase).iter().map(|g| Shape::new(g, &rows.setup)).collect();
        let at = |point: &DVec3| {
            let densities = shapes.iter().map(|shape| shape.density(*point));
            let (sum, all) = densities.zip(&shares).fold((0.0, 0.0), |(sum, all), (d, s)| (sum + d * s, all + d));
            if all > 0.0 { sum / all } else { 0.0 }
        };
        Some(points.par_iter().map(at).collect())
    }
}

/// A Gaussian, prepared for its density at many points.
struct Shape {
    position: DVec3,
    density: f64,
    /// From pixels to standard deviations.
    to_deviations: DMat3,
    /// Distance, pixels, from which on its density is zero.
    reach: f64,
    cut: f64,
}

impl Shape {
    fn new(g: &Gaussian, setup: &GaussianSetup) -> Shape {
        let [w, x, y, z] = g.rotation.map(f64::from);
        let scales = scales(g, setup);
        let axes = DMat3::from_quat(DQuat::from_xyzw(x, y, z, w).normalize());
        Shape {
            position: DVec3::from_array(g.position.map(f64::from)),
            density: f64::from(g.log_density).exp(),
            to_deviations: DMat3::from_diagonal(scales.recip()) * axes.transpose(),
            reach: f64::from(setup.cut) * scales.max_element(),
            cut: f64::from(setup.cut),
        }
    }

    fn density(&self, point: DVec3) -> f64 {
        let from_centre = point - self.position;
        if from_centre.length_squared() > self.reach.powi(2) {
            return 0.0;
        }
        let squared = (self.to_deviations * from_centre).length_squared();
        if squared > self.cut.powi(2) { 0.0 } else { self.density * (-0.5 * squared).exp() }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gaussians::field::{Units, basis, inverse_step, rotation_none};
    use crate::random::uniform01;

    const NODES: u32 = 3;

    /// A deformable set whose grid and own motion are drawn from a seed.
    fn set(seed: u32, n_phases: usize, n_basis: u32, rest_phase: u32) -> GaussianField {
        let number = |round: usize, i: usize| (uniform01(seed, 7, round as u32, i as u32) - 0.5) as f32;
        let rows: Vec<Gaussian> = (0..4)
            .map(|i| Gaussian {
                position: [0, 1, 2].map(|k| 20.0 * number(1, 3 * i + k)),
                rotation: rotation_none(),
                ..Gaussian::default()
            })
            .collect();
        let setup = MotionGridSetup {
            n_nodes: NODES,
            half_side: 12.0,
            inverse_step: inverse_step(NODES, 12.0),
            n_basis,
            rest_phase,
            ..MotionGridSetup::default()
        };
        let vectors = |round: usize, n: usize| -> Vec<[f32; 4]> {
            (0..n).map(|i| [number(round, 3 * i), number(round, 3 * i + 1), number(round, 3 * i + 2), 0.0]).collect()
        };
        let mut grid = vectors(2, n_phases * setup.nodes());
        grid[rest_phase as usize * setup.nodes()..][..setup.nodes()].fill([0.0; 4]);
        let own = vectors(3, rows.len() * n_basis as usize);
        let limits = GaussianSetup { min_scale: 0.5, max_scale: 3.0, cut: 3.2, ..GaussianSetup::default() };
        let rest = Gaussians {
            units: Units { pixel: 0.01, strongest: 0.2 },
            n_phases,
            setup: limits,
            rows,
            step: 5,
            is_crowd: false,
            intensities: None,
            agreement: None,
        };
        GaussianField::Moving(MovingGaussians { rest, setup, grid, own, filling: None })
    }

    #[test]
    fn gaussians_of_the_mean_move_as_in_their_own_fit() {
        for (n_phases, rest_phase) in [(10, 3), (7, 0), (4, 1)] {
            let basis = 2 * ((n_phases as u32 - 1) / 2);
            let members = [set(1, n_phases, basis, rest_phase), set(2, n_phases, basis, rest_phase)];
            let mean = GaussianField::mean(&members, 1.5).unwrap();
            for phase in [0.0, 1.0, 2.4, n_phases as f64 - 0.3] {
                let want: Vec<Gaussian> = members.iter().flat_map(|member| member.at_time(phase)).collect();
                let got = mean.at_time(phase);
                assert_eq!(got.len(), want.len());
                for (got, want) in got.iter().zip(&want) {
                    let apart = (0..3).map(|k| (got.position[k] - want.position[k]).abs()).fold(0.0, f32::max);
                    assert!(apart < 1e-4, "{n_phases} phases, phase {phase}: {apart} pixels");
                    assert!((got.log_density - want.log_density - 0.75f32.ln()).abs() < 1e-6);
                }
            }
        }
    }

    #[test]
    fn gaussians_of_the_mean_keep_their_filling() {
        let members = [set(1, 4, 2, 0), set(2, 4, 2, 0)].map(|field| {
            let GaussianField::Moving(set) = field else { unreachable!() };
            set
        });
        let [full, mut filled] = members;
        filled.filling = Some((1..=16).map(|i| i as f32 / 16.0).collect());
        let fields = [full, filled.clone()].map(GaussianField::Moving);
        let mean = GaussianField::mean(&fields, 1.0).unwrap();
        let filling = mean.moving().unwrap().filling.clone().unwrap();
        assert!(filling[..16].iter().all(|f| *f == 1.0));
        assert_eq!(Some(&filling[16..]), filled.filling.as_deref());
    }

    #[test]
    fn fields_agree_where_both_have_vessels() {
        let one = set(1, 4, 2, 0);
        let twice = GaussianField::mean(&[one.clone(), one.clone()], 1.0).unwrap();
        let overall = |field: &GaussianField| field.rows().agreement.as_ref().map(|agreement| agreement.overall);
        assert_eq!(overall(&twice), Some(1.0));
        let away = |field: &GaussianField, n: usize| {
            let GaussianField::Moving(mut set) = field.clone() else { unreachable!() };
            set.rest.rows.iter_mut().take(n).for_each(|g| g.position[0] += 200.0);
            GaussianField::Moving(set)
        };
        let mean = |n: usize| GaussianField::mean(&[one.clone(), away(&one, n)], 1.0).unwrap();
        assert_eq!((overall(&mean(4)), overall(&mean(1))), (Some(0.0), Some(0.75)));
        assert_eq!(overall(&GaussianField::mean(&[one], 1.0).unwrap()), None);
    }

    #[test]
    fn a_place_has_the_share_of_the_other_fits_that_have_a_vessel_there() {
        let one = set(1, 4, 2, 0);
        let GaussianField::Moving(mut elsewhere) = one.clone() else { unreachable!() };
        // The first Gaussian of the third fit lies where no other fit has a vessel.
        elsewhere.rest.rows[0].position[0] += 200.0;
        let members = [one.clone(), one.clone(), GaussianField::Moving(elsewhere)];
        let mean = GaussianField::mean(&members, 1.0).unwrap();
        let of_gaussians = &mean.rows().agreement.as_ref().unwrap().of_gaussians;
        assert_eq!(of_gaussians[..], [0.5, 1.0, 1.0, 1.0, 0.5, 1.0, 1.0, 1.0, 0.0, 1.0, 1.0, 1.0]);
        let centre = |i: usize| DVec3::from_array(mean.at(2)[i].position.map(f64::from));
        let at = mean.agreement_at(&[centre(0), centre(1), centre(8), DVec3::splat(1e3)], 2).unwrap();
        let wanted = [0.5, 1.0, 0.0, 0.0];
        assert!(at.iter().zip(wanted).all(|(got, want)| (got - want).abs() < 1e-6), "{at:?}");
        assert_eq!(one.agreement_at(&[DVec3::ZERO], 0), None, "a single fit");
    }

    #[test]
    fn a_full_basis_reaches_every_phase() {
        assert_eq!([1, 2, 3, 10, 11].map(full_basis), [0, 2, 2, 10, 10]);
        // With an even number of phases, the last sine vanishes at all phases.
        assert!((0..10).all(|t| basis(10, f64::from(t) / 10.0)[9].abs() < 1e-12));
    }
}
