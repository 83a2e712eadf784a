//! Information that views give about the place of a point of a vessel: each view shows where the vessel is across its image.

use glam::DVec3;

/// Least information of a direction across a vessel, in units of a view that is perpendicular to it. Rays that nearly coincide tell no
/// depth, and the smoothness of the vessel limits the error then.
const MIN_INFORMATION: f64 = 0.01;

/// Information about the place of a point across the vessel: a symmetric matrix over two directions.
#[derive(Debug, Clone, Copy)]
pub(super) struct Information {
    tangent: DVec3,
    /// Two directions that are perpendicular to the vessel and to each other.
    axes: [DVec3; 2],
    /// Entries of the matrix: first axis, both, second axis.
    entries: [f64; 3],
}

impl Information {
    /// Returns no information about a point of a vessel with this unit direction.
    pub fn none(tangent: DVec3) -> Information {
        let (u, v) = tangent.any_orthonormal_pair();
        Information { tangent, axes: [u, v], entries: [0.0; 3] }
    }

    /// Returns the information with that of a ray through the point, a unit direction: it informs about the direction that is
    /// perpendicular to itself and to the vessel.
    pub fn with(self, ray: DVec3) -> Information {
        let seen = ray.cross(self.tangent);
        let [a, b] = self.axes.map(|axis| seen.dot(axis));
        let [uu, uv, vv] = self.entries;
        Information { entries: [uu + a * a, uv + a * b, vv + b * b], ..self }
    }

    /// Returns the least certain direction, and the error of the point along it in units of the error of one image.
    pub fn least_certain(&self) -> (DVec3, f64) {
        let ([u, v], [uu, uv, vv]) = (self.axes, self.entries);
        let (mean, spread) = (0.5 * (uu + vv), (0.5 * (uu - vv)).hypot(uv));
        let least = (mean - spread).max(MIN_INFORMATION);
        // Angle of the largest information; the least one is perpendicular.
        let most = 0.5 * (2.0 * uv).atan2(uu - vv);
        (v * most.cos() - u * most.sin(), least.sqrt().recip())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn along(degrees: f64) -> DVec3 {
        DVec3::new(degrees.to_radians().cos(), degrees.to_radians().sin(), 0.0)
    }

    fn least_certain(rays: &[DVec3], tangent: DVec3) -> (DVec3, f64) {
        rays.iter().fold(Information::none(tangent), |sum, ray| sum.with(*ray)).least_certain()
    }

    #[test]
    fn the_least_certain_direction_is_the_depth_of_rays_that_nearly_coincide() {
        // Two rays 20 degrees apart about the x axis, and a vessel along z: each shows its perpendicular in the plane.
        let (direction, dilution) = least_certain(&[along(-10.0), along(10.0)], DVec3::Z);
        assert!(direction.dot(DVec3::X).abs() > 0.999, "{direction}");
        let expected = (2.0 * 10f64.to_radians().sin().powi(2)).sqrt().recip();
        assert!((dilution / expected - 1.0).abs() < 1e-9, "{dilution} instead of {expected}");
        // Rays at right angles are equally good in all directions.
        let (_, dilution) = least_certain(&[along(0.0), along(90.0)], DVec3::Z);
        assert!((dilution - 1.0).abs() < 1e-9);
        // A vessel along the plane of both rays: its place in the plane is not shown.
        let (direction, dilution) = least_certain(&[along(0.0), along(90.0)], DVec3::X);
        assert!(direction.dot(DVec3::Y).abs() > 0.999 && dilution > 0.99, "{direction} {dilution}");
        let (_, limited) = least_certain(&[], DVec3::Z);
        assert!(
            (limited - MIN_INFORMATION.sqrt().recip()).abs() < 1e-9,
            "a point that no view shows has a finite interval"
        );
    }
}
