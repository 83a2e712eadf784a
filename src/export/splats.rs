//! Exports the Gaussians of a model for splat viewers, LPS mm.

use crate::error::{Error, Result};
use crate::files;
use crate::formats::splats::{Splat, to_ply};
use crate::gaussians::field::{GaussianField, density, scales, vessel_density};
use crate::geometry::MM_PER_UNIT;
use crate::kernels::layout::Gaussian;
use crate::model::Model;
use glam::{DMat3, DQuat, DVec3};
use std::path::{Path, PathBuf};

/// Colour of vessels (red, green, blue).
const VESSEL: [f32; 3] = [0.85, 0.16, 0.12];
/// Greatest opacity that a file can hold: a sigmoid does not reach 1.
const MAX_OPACITY: f64 = 0.99;
/// Opacity below which viewers draw nothing.
const MIN_OPACITY: f64 = 1.0 / 255.0;

/// Returns the Gaussians of a field at a phase. Attenuation has no opacity: a Gaussian as dense as the vessels is opaque, and others are so in
/// proportion to their density. Gaussians that blend, as with X-Gaussian, keep their opacity and have their intensity as a grey.
pub fn splats(field: &GaussianField, phase: usize) -> Vec<Splat> {
    let rows = field.rows();
    let mm = rows.units.pixel * MM_PER_UNIT;
    let blended = rows.blended_at(phase);
    let shown: Vec<(Gaussian, f64, [f32; 3])> = if rows.intensities.is_some() {
        let opacity = |g: &Gaussian| 1.0 / (1.0 + (-f64::from(g.log_density)).exp());
        blended.into_iter().map(|(g, intensity)| (g, opacity(&g), [intensity.clamp(0.0, 1.0); 3])).collect()
    } else {
        let vessel = vessel_density(&rows.rows, &rows.setup);
        field.at(phase).into_iter().map(|g| (g, density(&g) / vessel, VESSEL)).collect()
    };
    let splat = |(g, opacity, colour): (Gaussian, f64, [f32; 3])| {
        let deviations = scales(&g, &rows.setup) * mm;
        Splat {
            position_mm: lps(DVec3::from_array(g.position.map(f64::from)) * mm).as_vec3().to_array(),
            deviations_mm: lps(deviations).as_vec3().to_array(),
            rotation: lps_rotation(g.rotation),
            opacity: opacity.min(MAX_OPACITY) as f32,
            colour,
        }
    };
    shown.into_iter().filter(|(_, opacity, _)| *opacity >= MIN_OPACITY).map(splat).collect()
}

/// Exchanges the world's axes (posterior, left, superior) for the patient's (left, posterior, superior).
fn lps(v: DVec3) -> DVec3 {
    DVec3::new(v.y, v.x, v.z)
}

/// Returns a Gaussian's rotation between axes that are exchanged on both sides, as a unit quaternion (w, x, y, z).
fn lps_rotation(rotation: [f32; 4]) -> [f32; 4] {
    let [w, x, y, z] = rotation.map(f64::from);
    let turn = DMat3::from_quat(DQuat::from_xyzw(x, y, z, w).normalize());
    let exchange = DMat3::from_cols(DVec3::Y, DVec3::X, DVec3::Z);
    let quaternion = DQuat::from_mat3(&(exchange * turn * exchange));
    [quaternion.w, quaternion.x, quaternion.y, quaternion.z].map(|v| v as f32)
}

/// Writes the Gaussians of a model at each phase, one file per phase, or one file of the name of `path` for a single phase. Returns the files
/// that were written.
///
/// # Errors
/// [`Error::Config`] where the dynamic field is a network; [`Error::Io`].
pub fn write_splats(model: &Model, phases: &[u32], path: &Path) -> Result<Vec<PathBuf>> {
    let Some(field) = &model.gaussians else {
        let problem = "is a network, which has no Gaussians: use --mesh, or train with --preset fast";
        return Err(Error::config("gaussians.form", "none", problem));
    };
    let write = |phase: &u32| {
        let file = if phases.len() == 1 { path.to_path_buf() } else { files::of_phase(path, *phase) };
        let phase_of = format!("phase {phase} of {}", model.shown_phases());
        let comments = ["dynamic field of nertca-vk, LPS mm", phase_of.as_str()];
        files::write_atomic(&file, &to_ply(&splats(field, *phase as usize), &comments))?;
        Ok(file)
    };
    phases.iter().map(write).collect()
}
