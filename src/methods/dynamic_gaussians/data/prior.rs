//! Prior vessels: places of the hull near them are preferred as seeds. The views keep the last word: a place that they contradict is
//! not in the hull, and later Gaussians may lie anywhere in it.

use crate::geometry::{MM_PER_UNIT, lps_mm_from_world, world_from_lps_mm};
use crate::methods::dynamic_gaussians::targets::{PossibleVessel, Targets};
use crate::scan::prior::VesselPrior;
use glam::{DVec3, I64Vec3};
use std::collections::HashMap;

// Numbers of this file: tried on five trees with a prior that is 3 % larger, displaced by 7 mm and bent by 1.5 mm (docs/performance.md).
/// Distance from the prior's vessels up to which a place is near them, mm.
const NEAR_MM: f64 = 3.0;
/// Distance from which on a place is far from them, mm.
const FAR_MM: f64 = 7.0;
/// Largest displacement of the prior along each axis in the coarse steps of the search, mm; finer steps add 6 mm.
const REACH_MM: f64 = 20.0;
/// Steps of that search, mm: coarse ones over the whole reach, then finer ones around the best.
const STEPS_MM: [f64; 3] = [4.0, 2.0, 1.0];
/// Share of the prior's points that places of the hull must support.
const LEAST_SUPPORT: f64 = 0.5;
/// Side of the cubes by which places are found, mm.
const CUBE_MM: f64 = 2.0;

/// Places of the rest phase by the cube that they lie in, with the largest evidence of each cube.
struct Cubes {
    evidence: HashMap<I64Vec3, f64>,
    /// Largest evidence of all.
    largest: f64,
}

impl Cubes {
    fn new(places: &[PossibleVessel], mm: f64) -> Cubes {
        let mut evidence: HashMap<I64Vec3, f64> = HashMap::new();
        for place in places {
            let best = evidence.entry(cube(place.position * mm)).or_insert(f64::NEG_INFINITY);
            *best = best.max(place.evidence);
        }
        let largest = evidence.values().copied().fold(f64::NEG_INFINITY, f64::max);
        Cubes { evidence, largest }
    }

    /// Returns how well places support points: the mean over the points of their cube's evidence, as a share of the largest.
    fn support(&self, points: &[DVec3], shift: DVec3) -> f64 {
        let of = |point: &DVec3| self.evidence.get(&cube(*point + shift)).map_or(0.0, |e| (e / self.largest).max(0.0));
        points.iter().map(of).sum::<f64>() / points.len().max(1) as f64
    }

    /// Share of the points that lie in a cube with a place, or beside one.
    fn covered(&self, points: &[DVec3], shift: DVec3) -> f64 {
        let beside = |at: I64Vec3| {
            let around = (0..27).map(|i| I64Vec3::new(i % 3 - 1, i / 3 % 3 - 1, i / 9 - 1));
            around.into_iter().any(|way| self.evidence.contains_key(&(at + way)))
        };
        points.iter().filter(|point| beside(cube(**point + shift))).count() as f64 / points.len().max(1) as f64
    }
}

fn cube(position_mm: DVec3) -> I64Vec3 {
    (position_mm / CUBE_MM).round().as_i64vec3()
}

/// Returns the displacement of the points that the places support best, mm.
fn best_shift(cubes: &Cubes, points: &[DVec3]) -> DVec3 {
    let mut best = (cubes.support(points, DVec3::ZERO), DVec3::ZERO);
    let mut reach = REACH_MM;
    for step in STEPS_MM {
        let (n, centre) = ((reach / step).round() as i64, best.1);
        for i in 0..(2 * n + 1).pow(3) {
            let side = 2 * n + 1;
            let way = I64Vec3::new(i % side - n, i / side % side - n, i / (side * side) - n).as_dvec3();
            let shift = centre + way * step;
            let support = cubes.support(points, shift);
            if support > best.0 {
                best = (support, shift);
            }
        }
        reach = step;
    }
    best.1
}

/// Tells the places of the rest phase how far they are from the prior's vessels, where the views agree with the prior. Returns a note
/// for the user.
pub(super) fn apply(targets: &mut Targets, prior: &VesselPrior) -> String {
    let mm = targets.units.pixel * MM_PER_UNIT;
    let fraction = targets.rest_phase as f64 / targets.n_phases as f64;
    // Along the world's axes, in mm.
    let points: Vec<DVec3> = prior.at(fraction).into_iter().map(|p| world_from_lps_mm(p) * MM_PER_UNIT).collect();
    let places = &mut targets.places[targets.rest_phase];
    let cubes = Cubes::new(places, mm);
    let shift = best_shift(&cubes, &points);
    let covered = cubes.covered(&points, shift);
    if covered < LEAST_SUPPORT {
        return format!(
            "the views support {:.0} % of the prior's vessels, less than {:.0} %, so that the prior is not used: check its position, \
             which is that of the patient on the table with the isocentre at the origin",
            100.0 * covered,
            100.0 * LEAST_SUPPORT
        );
    }
    for place in places.iter_mut() {
        place.far_from_prior = far(distance(&points, place.position * mm - shift));
    }
    let [left, posterior, superior] = lps_mm_from_world(shift / MM_PER_UNIT).to_array();
    format!(
        "the prior's vessels, moved by {left:.0} mm to the left, {posterior:.0} to the back and {superior:.0} up, where the views support \
         {:.0} % of them best, are preferred as first places of vessels",
        100.0 * covered
    )
}

/// Distance of a position from the nearest of the points.
fn distance(points: &[DVec3], position: DVec3) -> f64 {
    points.iter().map(|p| p.distance_squared(position)).fold(f64::INFINITY, f64::min).sqrt()
}

/// Returns how far a distance is from the prior's vessels: 0 near them, 1 far from them.
fn far(distance_mm: f64) -> f64 {
    ((distance_mm - NEAR_MM) / (FAR_MM - NEAR_MM)).clamp(0.0, 1.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn place(position: DVec3) -> PossibleVessel {
        PossibleVessel { position, evidence: 10.0, far_from_prior: 0.0 }
    }

    /// Points of a bent vessel, mm.
    fn vessel() -> Vec<DVec3> {
        (0..40).map(|i| DVec3::new(f64::from(i), 0.02 * f64::from(i * i), 8.0 * (0.2 * f64::from(i)).sin())).collect()
    }

    #[test]
    fn a_displaced_prior_is_moved_onto_the_places() {
        let places: Vec<PossibleVessel> = vessel().into_iter().map(place).collect();
        let moved: Vec<DVec3> = vessel().into_iter().map(|p| p - DVec3::new(9.0, -13.0, 6.0)).collect();
        let shift = best_shift(&Cubes::new(&places, 1.0), &moved);
        assert!(shift.distance(DVec3::new(9.0, -13.0, 6.0)) < 2.0, "{shift}");
    }

    #[test]
    fn support_tells_a_vessel_from_another_place() {
        let places: Vec<PossibleVessel> = vessel().into_iter().map(place).collect();
        let cubes = Cubes::new(&places, 1.0);
        assert_eq!(cubes.covered(&vessel(), DVec3::ZERO), 1.0);
        let elsewhere: Vec<DVec3> = vessel().into_iter().map(|p| DVec3::new(p.y, p.z, p.x)).collect();
        let shift = best_shift(&cubes, &elsewhere);
        assert!(cubes.covered(&elsewhere, shift) < LEAST_SUPPORT, "{}", cubes.covered(&elsewhere, shift));
        assert_eq!([far(0.0), far(NEAR_MM), far(FAR_MM), far(50.0)], [0.0, 0.0, 1.0, 1.0]);
    }
}
