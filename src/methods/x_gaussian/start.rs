//! Start of a fit: voxel centres all over the volume ("angle-pose cuboid uniform initialisation").

use crate::config::sections::{FIRST_OPACITY, X};
use crate::gaussians::blending::opacity::stored_opacity;
use crate::gaussians::field::rotation_none;
use crate::gaussians::spacing::spacings;
use crate::kernels::layout::BlendGaussian;
use crate::methods::x_gaussian::data::XData;
use crate::methods::x_gaussian::state::XState;
use glam::DVec3;

/// Intensity of all Gaussians at the start: the reference code has random colours of at most 1/255, which leave this much.
const FIRST_INTENSITY: f32 = 0.5;

/// Centres of one voxel in each interval, of the cube from -1 to 1, x first.
fn voxel_centres(settings: &X) -> Vec<DVec3> {
    let along: Vec<f64> = (0..settings.voxels)
        .step_by(settings.interval as usize)
        .map(|k| f64::from(2 * k + 1) / f64::from(settings.voxels) - 1.0)
        .collect();
    let at = |z: f64, y: f64, x: f64| DVec3::new(x, y, z);
    along.iter().flat_map(|z| along.iter().flat_map(|y| along.iter().map(|x| at(*z, *y, *x)))).collect()
}

/// First Gaussians of all sets, which are the same in each: round, and as wide as their three nearest neighbours are
/// away.
pub fn first_state(data: &XData, settings: &X) -> XState {
    let centres = voxel_centres(settings);
    let opacity = stored_opacity(FIRST_OPACITY.ln()) as f32;
    let row = |(x, spacing): (&DVec3, f64)| BlendGaussian {
        position: (*x * data.half_mm).as_vec3().to_array(),
        opacity,
        log_scale: [(spacing * data.half_mm).ln() as f32; 3],
        intensity: FIRST_INTENSITY,
        rotation: rotation_none(),
    };
    let rows: Vec<BlendGaussian> = centres.iter().zip(spacings(&centres)).map(row).collect();
    let n_sets = data.n_sets();
    let sets = (0..n_sets as u32).flat_map(|set| std::iter::repeat_n(set, rows.len())).collect();
    XState::fresh(rows.repeat(n_sets), sets)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::{Config, Preset};

    #[test]
    fn a_fit_begins_at_every_eighth_voxel() {
        let settings = Config::preset(Preset::XGaussian).of::<crate::config::sections::XSettings>().unwrap().method.x;
        let centres = voxel_centres(&settings);
        assert_eq!(centres.len(), 32 * 32 * 32);
        assert!((centres[0] - DVec3::splat(0.5 / 128.0 - 1.0)).length() < 1e-12);
        assert!((centres[1] - centres[0] - DVec3::new(8.0 / 128.0, 0.0, 0.0)).length() < 1e-12);
        // Not a multiple of the interval: the last one begins a share of it.
        let uneven = voxel_centres(&X { voxels: 10, interval: 4, ..settings });
        assert_eq!(uneven.len(), 27);
    }
}
