//! Conversion of lines through voxels to smooth centrelines on the field's ridge.

use crate::trees::sampled::SampledField;
use crate::trees::tree::length_mm;
use glam::DVec3;
use rayon::prelude::*;

/// Approximate step of a centreline's points, in units of the field's resolution.
pub(super) const STEP: f64 = 0.5;
/// Radius of the disc in which the ridge is searched, in units of the field's resolution.
const DISC: f64 = 1.5;
/// Step of the disc's points, in units of the field's resolution.
const DISC_STEP: f64 = 0.25;
/// Number of times that a point is moved to the centroid of its disc. With more, points drift to neighbouring vessels: with
/// 20, the error of radii in the default phantom grows by a sixth.
const SHIFTS: usize = 6;
/// Maximum displacement of a point from its position by the voxels, in units of the field's resolution.
const FARTHEST: f64 = 1.5;
/// Standard deviation of the smoothing of lines through voxels, in units of the field's resolution.
const SMOOTH: f64 = 1.0;

/// Search for the ridge of a field.
pub(super) struct Centring<'a> {
    pub(super) field: &'a SampledField,
    pub(super) resolution_mm: f64,
}

impl Centring<'_> {
    /// Maximum distance of the samples used for a point, in units of the field's resolution: a disc around its farthest
    /// possible position, and the neighbours for interpolation.
    pub(super) const REACH: f64 = DISC + FARTHEST + 1.0;

    /// Position on the ridge beside a point, within the plane across a direction.
    pub(super) fn on_ridge(&self, point_mm: DVec3, tangent: DVec3) -> DVec3 {
        let (u, v) = tangent.any_orthonormal_pair();
        let (radius, step) = (DISC * self.resolution_mm, DISC_STEP * self.resolution_mm);
        let n = (DISC / DISC_STEP) as i32;
        let mut at = point_mm;
        for _ in 0..SHIFTS {
            let (mut sum, mut middle) = (0.0, DVec3::ZERO);
            for (i, j) in (-n..=n).flat_map(|i| (-n..=n).map(move |j| (i, j))) {
                let away = (u * f64::from(i) + v * f64::from(j)) * step;
                let weight = 1.0 - away.length_squared() / radius.powi(2);
                if weight > 0.0 {
                    let here = weight * self.field.at(at + away);
                    sum += here;
                    middle += here * away;
                }
            }
            if sum <= 0.0 {
                return point_mm;
            }
            at += middle / sum;
        }
        point_mm + (at - point_mm).clamp_length_max(FARTHEST * self.resolution_mm)
    }

    /// Moves a line's points to the ridge, with displacements smoothed along the line. The first point stays fixed if
    /// `hold_first`.
    pub(super) fn line(&self, points_mm: &[DVec3], hold_first: bool) -> Vec<DVec3> {
        let tangents = tangents(points_mm);
        let moved = |i: usize| match i {
            0 if hold_first => DVec3::ZERO,
            _ => self.on_ridge(points_mm[i], tangents[i]) - points_mm[i],
        };
        let moved: Vec<DVec3> = (0..points_mm.len()).into_par_iter().map(moved).collect();
        let smoothed = smoothed(&moved, 0.5 * SMOOTH / STEP, Ends::Free);
        let along = |i: usize| smoothed[i] - tangents[i] * smoothed[i].dot(tangents[i]);
        let at = |i: usize| if i == 0 && hold_first { points_mm[0] } else { points_mm[i] + along(i) };
        (0..points_mm.len()).map(at).collect()
    }
}

/// Directions of a line at its points.
pub(super) fn tangents(points_mm: &[DVec3]) -> Vec<DVec3> {
    let last = points_mm.len() - 1;
    let between = |a: usize, b: usize| (points_mm[b] - points_mm[a]).try_normalize();
    let tangent = |i: usize| {
        let wide = between(i.saturating_sub(2), (i + 2).min(last));
        wide.or_else(|| between(i.saturating_sub(1), (i + 1).min(last))).unwrap_or(DVec3::X)
    };
    (0..=last).map(tangent).collect()
}

/// Treatment of the ends of a line in smoothing.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Ends {
    /// Ends stay fixed.
    Held,
    /// Ends are smoothed like all other points.
    Free,
}

/// Gaussian mean of the values along a line; the Gaussian narrows towards held ends.
pub(super) fn smoothed(values: &[DVec3], deviation: f64, ends: Ends) -> Vec<DVec3> {
    let last = values.len() as isize - 1;
    let at = |i: isize| {
        let room = if ends == Ends::Held { i.min(last - i) } else { last };
        let reach = ((3.0 * deviation) as isize).min(room);
        let weights = (-reach..=reach).filter(|step| (0..=last).contains(&(i + step)));
        let weights = weights.map(|step| (step, (-0.5 * (step as f64 / deviation).powi(2)).exp()));
        let (sum, all) = weights.fold((DVec3::ZERO, 0.0), |(sum, all), (step, weight)| {
            (sum + weight * values[(i + step) as usize], all + weight)
        });
        sum / all
    };
    (0..=last).map(at).collect()
}

/// Points at equal distances of about `step_mm` along a line, including its ends.
pub(super) fn evenly(points_mm: &[DVec3], step_mm: f64) -> Vec<DVec3> {
    let length = length_mm(points_mm);
    let n = (length / step_mm).round().max(1.0) as usize;
    let mut even = vec![points_mm[0]];
    let (mut segment, mut passed) = (0, 0.0);
    for i in 1..n {
        let wanted = length * i as f64 / n as f64;
        let mut here = points_mm[segment].distance(points_mm[segment + 1]);
        while passed + here < wanted && segment + 2 < points_mm.len() {
            passed += here;
            segment += 1;
            here = points_mm[segment].distance(points_mm[segment + 1]);
        }
        even.push(points_mm[segment].lerp(points_mm[segment + 1], ((wanted - passed) / here.max(1e-12)).min(1.0)));
    }
    even.push(points_mm[points_mm.len() - 1]);
    even
}

/// Converts a line through voxels to a smooth line of points at equal distances with fixed ends.
pub(super) fn from_voxels(points_mm: &[DVec3], resolution_mm: f64) -> Vec<DVec3> {
    let step_mm = STEP * resolution_mm;
    evenly(&smoothed(&evenly(points_mm, step_mm), SMOOTH / STEP, Ends::Held), step_mm)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::trees::sampled::tests::{RESOLUTION_MM, distance_mm, points, vessels};

    #[test]
    fn points_are_even_and_keep_the_ends() {
        let bent = [DVec3::ZERO, DVec3::X * 3.0, DVec3::new(3.0, 4.0, 0.0)];
        let even = evenly(&bent, 0.4);
        assert_eq!((even[0], even[even.len() - 1], even.len()), (bent[0], bent[2], 19));
        // The straight connection across the corner is shorter.
        let steps: Vec<f64> = even.windows(2).map(|pair| pair[0].distance(pair[1])).collect();
        assert_eq!(steps.iter().filter(|step| (**step - 7.0 / 18.0).abs() > 1e-9).count(), 1, "{steps:?}");
    }

    #[test]
    fn smoothing_leaves_straight_lines_and_held_ends_alone() {
        let line = points(10, |along| DVec3::new(along, -2.0 * along, 5.0));
        for (a, b) in line.iter().zip(smoothed(&line, 1.5, Ends::Held)) {
            assert!(a.distance(b) < 1e-12);
        }
        let jagged = points(10, |along| DVec3::new(along, (along * 10.0).round() % 2.0, 0.0));
        let smooth = smoothed(&jagged, 1.5, Ends::Held);
        assert_eq!((smooth[0], smooth[10]), (jagged[0], jagged[10]));
        assert!((3..8).all(|i| (smooth[i].y - 0.5).abs() < 0.1), "{smooth:?}");
    }

    #[test]
    fn points_beside_a_ridge_come_to_it() {
        let middle = points(400, |along| DVec3::X * (36.0 * along - 18.0));
        let field = vessels(&[(middle.clone(), 0.8)]);
        let centring = Centring { field: &field, resolution_mm: RESOLUTION_MM };
        for (away, along) in [(0.7, 0.13), (1.2, 3.31), (0.3, -5.2)] {
            let beside = DVec3::new(along, away, -0.4 * away);
            let found = centring.on_ridge(beside, DVec3::X);
            assert!(distance_mm(&middle, found) < 0.1, "{found} from {beside}");
            assert!((found.x - along).abs() < 1e-9, "only across the vessel");
        }
        let nowhere = DVec3::new(0.0, 15.0, 0.0);
        assert_eq!(centring.on_ridge(nowhere, DVec3::X), nowhere);
    }
}
