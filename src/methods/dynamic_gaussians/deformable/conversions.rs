//! Conversion of Gaussians to other units and of a deformable set to another grid, needed when data are added to a fitted field.

use crate::gaussians::field::{Gaussians, MovingGaussians, Units, vector};
use crate::kernels::layout::{Gaussian, MotionGridSetup};
use glam::DVec3;

impl Gaussians {
    /// Returns this field in other units.
    pub fn in_units(&self, units: Units) -> Gaussians {
        let pixels = self.units.pixel / units.pixel;
        let (scale, density) = (pixels.ln() as f32, (self.units.attenuation() / units.attenuation()).ln() as f32);
        let convert = |g: &Gaussian| Gaussian {
            position: g.position.map(|x| (f64::from(x) * pixels) as f32),
            log_scale: g.log_scale.map(|log| log + scale),
            log_density: g.log_density + density,
            ..*g
        };
        Gaussians { units, rows: self.rows.iter().map(convert).collect(), ..self.clone() }
    }
}

impl MovingGaussians {
    /// Returns this deformable set in the units of `rest` on another grid with the same number of basis functions of own motion.
    /// Displacements are evaluated at the new nodes; outside the old grid they have the values on its faces.
    pub fn on_grid(&self, rest: Gaussians, setup: MotionGridSetup) -> MovingGaussians {
        let pixels = self.rest.units.pixel / rest.units.pixel;
        let pack = |v: DVec3| {
            let [x, y, z] = (v * pixels).as_vec3().to_array();
            [x, y, z, 0.0]
        };
        let n = setup.n_nodes as usize;
        let node = |i: usize| {
            let index = DVec3::new((i % n) as f64, (i / n % n) as f64, (i / (n * n)) as f64);
            (index / f64::from(setup.inverse_step) - f64::from(setup.half_side)) / pixels
        };
        let at = |phase: usize, i: usize| pack(self.carried(node(i), phase as f64) - node(i));
        let grid = (0..rest.n_phases).flat_map(|phase| (0..setup.nodes()).map(move |i| (phase, i)));
        MovingGaussians {
            grid: grid.map(|(phase, i)| at(phase, i)).collect(),
            own: self.own.iter().map(|v| pack(vector(v))).collect(),
            filling: self.filling.clone(),
            rest,
            setup,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gaussians::field::{inverse_step, scales};
    use crate::kernels::layout::GaussianSetup;

    const N_PHASES: usize = 3;

    fn grid(n_nodes: u32, half_side: f32) -> MotionGridSetup {
        MotionGridSetup {
            n_nodes,
            half_side,
            inverse_step: inverse_step(n_nodes, half_side),
            n_basis: 2,
            rest_phase: 1,
            ..MotionGridSetup::default()
        }
    }

    /// Returns a deformable set whose displacements are linear in position, so that any grid represents them exactly.
    fn deformable() -> MovingGaussians {
        let setup = grid(5, 40.0);
        let node = |i: usize| DVec3::new((i % 5) as f64, (i / 5 % 5) as f64, (i / 25) as f64) * 20.0 - 40.0;
        let displacement = |phase: usize, x: DVec3| {
            (phase as f64 - 1.0) * (0.1 * DVec3::new(x.y, x.z, x.x) + DVec3::new(1.0, -2.0, 0.5))
        };
        let pack = |v: DVec3| [v.x as f32, v.y as f32, v.z as f32, 0.0];
        let row = |i: usize| Gaussian {
            position: [3.0 * i as f32, -5.0, 11.0 - 4.0 * i as f32],
            log_scale: [0.1, 0.3, -0.2],
            log_density: -1.5 + 0.1 * i as f32,
            phase: 1,
            rotation: [1.0, 0.1, 0.2, 0.3],
        };
        MovingGaussians {
            rest: Gaussians {
                units: Units { pixel: 0.01, strongest: 0.5 },
                n_phases: N_PHASES,
                setup: GaussianSetup { min_scale: 0.1, max_scale: 9.0, ..GaussianSetup::default() },
                rows: (0..4).map(row).collect(),
                step: 9,
                is_crowd: false,
                agreement: None,
                intensities: None,
            },
            setup,
            grid: (0..N_PHASES).flat_map(|t| (0..125).map(move |i| pack(displacement(t, node(i))))).collect(),
            own: (0..8).map(|i| [0.1 * i as f32, -0.3, 0.2, 0.0]).collect(),
            filling: Some((0..4 * N_PHASES).map(|i| 0.05 * i as f32).collect()),
        }
    }

    #[test]
    fn a_tree_is_the_same_in_other_units_on_another_grid() {
        let deformable = deformable();
        let units = Units { pixel: 0.016, strongest: 0.7 };
        let other = deformable.on_grid(deformable.rest.in_units(units), grid(7, 31.0));
        for phase in [0.0, 0.4, 1.0, 2.0, 2.5] {
            for i in 0..4 {
                let [was, is] = [(&deformable, 0.01), (&other, 0.016)]
                    .map(|(deformable, pixel)| deformable.position(i, phase) * pixel);
                assert!(was.distance(is) < 1e-6, "Gaussian {i} at phase {phase}: {is}, not {was}");
            }
        }
        assert_eq!(other.filling, deformable.filling);
        for (was, is) in deformable.rest.rows.iter().zip(&other.rest.rows) {
            let width = |g, of: &MovingGaussians| scales(g, &of.rest.setup) * of.rest.units.pixel;
            let density =
                |g: &Gaussian, of: &MovingGaussians| f64::from(g.log_density).exp() * of.rest.units.attenuation();
            assert!(width(was, &deformable).distance(width(is, &other)) < 1e-8);
            assert!((density(was, &deformable) / density(is, &other) - 1.0).abs() < 1e-6);
        }
    }
}
