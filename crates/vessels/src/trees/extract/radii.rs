//! Radii of vessels from the field's profile across their centrelines.

use crate::raster::percentile;
use crate::trees::refine::{STEP, tangents};
use crate::trees::sampled::SampledField;
use glam::DVec3;
use rayon::prelude::*;
use std::f64::consts::{PI, TAU};

/// Number of directions of profiles. The median over them excludes directions that meet another vessel. With the mean, errors of radii
/// are .070 instead of .058 mm (docs/tried.md).
const DIRECTIONS: u32 = 15;
/// Step of a profile, in units of the field's resolution.
const PROFILE_STEP: f64 = 0.125;
/// Maximum number of steps of a profile: vessels wider than twenty resolution lengths are not measured.
const PROFILE_STEPS: u32 = 160;
/// A profile ends below this share of its peak.
const FOOT: f64 = 0.03;
/// A profile ends in a valley: where it rises by this factor after falling below the share [`FALLEN`] of its peak.
const RISE: f64 = 1.02;
/// Share of the peak below which a profile may end in a valley.
const FALLEN: f64 = 0.8;
/// Half length of the median filter of radii along a line, in units of the field's resolution.
const MEDIAN: f64 = 0.5;

/// Result of a profile in one direction.
struct Flank {
    /// Integral of attenuation times distance over the distance, mm: the profile's share of the vessel's attenuating area.
    area: f64,
    /// Distance at which the field has fallen to half its peak, mm.
    half_mm: f64,
}

/// Measurement of vessel widths.
pub(super) struct Lumen<'a> {
    pub(super) field: &'a SampledField,
    pub(super) resolution_mm: f64,
    /// Attenuation inside vessels, where it is known.
    pub(super) vessel_per_mm: Option<f64>,
}

impl Lumen<'_> {
    /// Measures the radii along a centreline, mm.
    ///
    /// Where the vessels' attenuation is known, the area of a vessel is the field's integral across the centreline divided
    /// by that attenuation, however blurred the field is; of all methods tried on phantoms (`docs/tried.md`) this one
    /// has the smallest error. Otherwise the vessel ends at half of the local peak.
    pub(super) fn radii_mm(&self, points_mm: &[DVec3]) -> Vec<f64> {
        let radius = |(point, tangent): (&DVec3, DVec3)| self.radius_mm(*point, tangent) as f32;
        let radii: Vec<f32> = points_mm.par_iter().zip(tangents(points_mm)).map(radius).collect();
        let reach = (MEDIAN / STEP) as usize;
        let around = |i: usize| &radii[i.saturating_sub(reach)..(i + reach + 1).min(radii.len())];
        (0..radii.len()).map(|i| f64::from(percentile(around(i), 0.5))).collect()
    }

    fn radius_mm(&self, point_mm: DVec3, tangent: DVec3) -> f64 {
        let (u, v) = tangent.any_orthonormal_pair();
        let peak = self.field.at(point_mm);
        let flanks = (0..DIRECTIONS).map(|i| {
            let (sine, cosine) = (TAU * f64::from(i) / f64::from(DIRECTIONS)).sin_cos();
            self.flank(point_mm, u * cosine + v * sine, peak)
        });
        let of_flank = |flank: Flank| self.vessel_per_mm.map_or(flank.half_mm, |_| flank.area) as f32;
        let median = f64::from(percentile(&flanks.map(of_flank).collect::<Vec<_>>(), 0.5));
        match self.vessel_per_mm {
            Some(attenuation) => (TAU * median / (PI * attenuation)).sqrt(),
            None => median,
        }
    }

    fn flank(&self, point_mm: DVec3, direction: DVec3, peak: f64) -> Flank {
        let step_mm = PROFILE_STEP * self.resolution_mm;
        let (mut area, mut half_mm, mut before, mut min) = (0.0, None, peak, peak);
        for i in 1..=PROFILE_STEPS {
            let away_mm = f64::from(i) * step_mm;
            let here = self.field.at(point_mm + direction * away_mm);
            if here < 0.5 * peak && half_mm.is_none() {
                half_mm = Some(away_mm - step_mm * (0.5 * peak - here) / (before - here));
            }
            if here < FOOT * peak || (here > RISE * min && min < FALLEN * peak) {
                break;
            }
            area += here * away_mm * step_mm;
            (before, min) = (here, min.min(here));
        }
        Flank { area, half_mm: half_mm.unwrap_or(f64::from(PROFILE_STEPS) * step_mm) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::trees::sampled::tests::{RESOLUTION_MM, VESSEL_PER_MM, points, vessels};

    fn radius_mm(tubes: &[(Vec<DVec3>, f64)], vessel_per_mm: Option<f64>) -> f64 {
        let field = vessels(tubes);
        let lumen = Lumen { field: &field, resolution_mm: RESOLUTION_MM, vessel_per_mm };
        let radii = lumen.radii_mm(&points(20, |along| DVec3::new(10.0 * along - 5.0, 0.1, 0.0)));
        radii[10]
    }

    #[test]
    fn radii_are_known_to_a_tenth() {
        for radius in [0.8, 1.3, 2.5] {
            let straight = (points(400, |along| DVec3::X * (36.0 * along - 18.0)), radius);
            let tilted = (points(400, |along| DVec3::new(20.0 * along - 10.0, 5.0, 24.0 * along - 12.0)), radius);
            for vessel_per_mm in [Some(VESSEL_PER_MM), None] {
                let found = radius_mm(std::slice::from_ref(&straight), vessel_per_mm);
                assert!((found / radius - 1.0).abs() < 0.1, "{found} mm for {radius} mm, {vessel_per_mm:?}");
                // A vessel that passes nearby must not contribute.
                let beside = radius_mm(&[straight.clone(), tilted.clone()], vessel_per_mm);
                assert!((beside / found - 1.0).abs() < 0.05, "{beside} mm beside another vessel, {found} mm alone");
            }
        }
        // The profile of a vessel between four others ends in the valleys around it.
        let at = |y: f64, z: f64| points(400, |along| DVec3::new(36.0 * along - 18.0, y, z));
        let around = [(3.4, 0.0), (-3.4, 0.0), (0.0, 3.4), (0.0, -3.4)].map(|(y, z)| (at(y, z), 2.0));
        let among = [vec![(at(0.0, 0.0), 0.8)], around.to_vec()].concat();
        for vessel_per_mm in [Some(VESSEL_PER_MM), None] {
            let found = radius_mm(&among, vessel_per_mm);
            assert!((found / 0.8 - 1.0).abs() < 0.15, "{found} mm among others, {vessel_per_mm:?}");
        }
        // A wrong attenuation changes the area in proportion.
        let tube = [(points(400, |along| DVec3::X * (36.0 * along - 18.0)), 1.3)];
        let (right, half) = (radius_mm(&tube, Some(VESSEL_PER_MM)), radius_mm(&tube, Some(0.5 * VESSEL_PER_MM)));
        assert!((half / right - 2f64.sqrt()).abs() < 1e-6);
    }
}
