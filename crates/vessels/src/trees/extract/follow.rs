//! Positions of material points of a moving set of Gaussians at any phase.

use crate::gaussians::field::{MovingGaussians, scales};
use crate::geometry::{lps_mm_from_world, world_from_lps_mm};
use crate::kernels::layout::Gaussian;
use glam::{DMat3, DQuat, DVec3};

/// A set of Gaussians that moves points through the beat.
pub(super) struct Carrier<'a> {
    tree: &'a MovingGaussians,
    /// Shape of each Gaussian at rest.
    shapes: Vec<Shape>,
}

/// A Gaussian's density at a point x is exp(log_density - |inverse (x - centre)|^2 / 2), with lengths in its pixels.
struct Shape {
    centre: DVec3,
    inverse: DMat3,
    log_density: f64,
}

impl Shape {
    fn density(&self, x: DVec3) -> f64 {
        (self.log_density - 0.5 * (self.inverse * (x - self.centre)).length_squared()).exp()
    }
}

impl Carrier<'_> {
    pub(super) fn new(tree: &MovingGaussians) -> Carrier<'_> {
        let shape = |g: Gaussian| {
            let Gaussian { position, rotation, log_density, .. } = g;
            let [w, x, y, z] = rotation.map(f64::from);
            let axes = DMat3::from_quat(DQuat::from_xyzw(x, y, z, w).normalize());
            Shape {
                centre: DVec3::from_array(position.map(f64::from)),
                inverse: DMat3::from_diagonal(1.0 / scales(&g, &tree.rest.setup)) * axes.transpose(),
                log_density: f64::from(log_density),
            }
        };
        Carrier { tree, shapes: tree.rest.rows.iter().copied().map(shape).collect() }
    }

    /// Moves points of the phase of rest to a phase, LPS mm. The grid moves them; the Gaussians' own motion is added as the
    /// mean over the Gaussians, each weighted by its density at the point.
    pub(super) fn carried_mm(&self, points_mm: &[DVec3], phase: u32) -> Vec<DVec3> {
        let (tree, phase) = (self.tree, f64::from(phase));
        let own = |(i, shape): (usize, &Shape)| tree.position(i, phase) - tree.carried(shape.centre, phase);
        let own: Vec<DVec3> = self.shapes.iter().enumerate().map(own).collect();
        let pixel = tree.rest.units.pixel;
        let carried = |point: &DVec3| {
            let x = world_from_lps_mm(*point) / pixel;
            let (mut density, mut moved) = (0.0, DVec3::ZERO);
            for (shape, own) in self.shapes.iter().zip(&own) {
                let here = shape.density(x);
                density += here;
                moved += here * *own;
            }
            let own = if density > 0.0 { moved / density } else { DVec3::ZERO };
            lps_mm_from_world((tree.carried(x, phase) + own) * pixel)
        };
        points_mm.iter().map(carried).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gaussians::field::{Gaussians, Units};
    use crate::kernels::layout::{GaussianSetup, MotionGridSetup};

    const PIXEL: f64 = 0.01;

    /// Two distant Gaussians, of which the second has an own motion, in a grid that moves everything by (1, 2, 3) pixels.
    fn tree() -> MovingGaussians {
        let gaussian = |x: f32| Gaussian {
            position: [x, 0.0, 0.0],
            log_density: 0.0,
            log_scale: [0.0; 3],
            phase: 0,
            rotation: [1.0, 0.0, 0.0, 0.0],
        };
        let step = 20.0;
        MovingGaussians {
            rest: Gaussians {
                units: Units { pixel: PIXEL, strongest: 1.0 },
                n_phases: 2,
                setup: GaussianSetup { cut: 3.2, min_scale: 0.4, max_scale: 3.0, ..GaussianSetup::default() },
                rows: vec![gaussian(-15.0), gaussian(15.0)],
                step: 1,
                is_crowd: false,
                agreement: None,
                intensities: None,
            },
            setup: MotionGridSetup {
                n_nodes: 4,
                half_side: 30.0,
                inverse_step: 1.0 / step,
                n_basis: 2,
                ..MotionGridSetup::default()
            },
            grid: (0..2).flat_map(|t| vec![[1.0, 2.0, 3.0, 0.0].map(|v: f32| v * t as f32); 64]).collect(),
            own: vec![[0.0; 4], [0.0; 4], [0.0, 0.0, -2.0, 0.0], [0.0; 4]],
            filling: None,
        }
    }

    #[test]
    fn points_move_with_the_grid_and_the_gaussians_around() {
        let tree = tree();
        let carrier = Carrier::new(&tree);
        // World axes are (posterior, left, superior); half a beat moves the second Gaussian by 4 pixels.
        let lps_mm = |x: f64, y: f64, z: f64| DVec3::new(y, x, z) * PIXEL * 100.0;
        let from = [lps_mm(-15.0, 0.5, 0.0), lps_mm(15.0, 0.5, 0.0), lps_mm(0.0, 0.0, 0.0)];
        let to = [lps_mm(-14.0, 2.5, 3.0), lps_mm(16.0, 2.5, 7.0), lps_mm(1.0, 2.0, 5.0)];
        for (found, wanted) in carrier.carried_mm(&from, 1).iter().zip(to) {
            assert!(found.distance(wanted) < 1e-5, "{found} for {wanted}");
        }
        for (found, wanted) in carrier.carried_mm(&from, 0).iter().zip(from) {
            assert!(found.distance(wanted) < 1e-9, "phase 0 is where points are");
        }
    }
}
