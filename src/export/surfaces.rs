//! Exports surfaces of the vessels at each phase as STL, PLY, OBJ or animated glTF. LPS mm; glTF has its own axes and metres.

use crate::error::{Error, Result};
use crate::files;
use crate::formats::gltf;
use crate::formats::mesh::Mesh;
use crate::model::component::Component;
use crate::render::grid::PatientGrid;
use crate::render::renderer::Renderer;
use fast_surface_nets::{SurfaceNetsBuffer, surface_nets};
use glam::Vec3;
use ndshape::{RuntimeShape, Shape};
use std::path::{Path, PathBuf};

/// File format of meshes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum MeshFormat {
    /// Binary STL, one file per phase.
    Stl,
    /// Binary PLY with normals, one file per phase.
    Ply,
    /// Wavefront OBJ, one file per phase.
    Obj,
    /// Binary glTF with all phases in one animated file.
    Glb,
}

impl MeshFormat {
    /// Returns the format for the end of a file name.
    pub fn of(path: &Path) -> Option<MeshFormat> {
        Some(match path.extension()?.to_str()?.to_lowercase().as_str() {
            "stl" => MeshFormat::Stl,
            "ply" => MeshFormat::Ply,
            "obj" => MeshFormat::Obj,
            "glb" => MeshFormat::Glb,
            _ => return None,
        })
    }
}

/// Returns the surface on which a field on a grid has the value `iso`; it is closed even where it reaches the edge of the grid.
/// Naive surface nets: like marching cubes, but with one vertex per cell and more uniform triangles.
pub fn surface(values: &[f32], grid: &PatientGrid, iso: f32) -> Mesh {
    let size = grid.size;
    // A border of points outside the surface closes it.
    let padded: [u32; 3] = size.map(|n| n + 2);
    let shape = RuntimeShape::<u32, 3>::new(padded);
    let mut distance = vec![iso.max(f32::MIN_POSITIVE); shape.usize()];
    for (i, v) in values.iter().enumerate() {
        let (x, y, z) =
            (i % size[0] as usize, i / size[0] as usize % size[1] as usize, i / (size[0] * size[1]) as usize);
        distance[shape.linearize([x as u32 + 1, y as u32 + 1, z as u32 + 1]) as usize] = iso - v;
    }
    let mut nets = SurfaceNetsBuffer::default();
    surface_nets(&distance, &shape, [0; 3], padded.map(|n| n - 1), &mut nets);
    let spacing = grid.spacing_mm.as_vec3();
    let place = |p: &[f32; 3]| ((Vec3::from(*p) - 1.0) * spacing + grid.origin_mm.as_vec3()).to_array();
    let vertices = nets.positions.iter().map(place).collect();
    Mesh::closed(vertices, nets.indices.chunks_exact(3).map(|t| [t[0], t[1], t[2]]).collect())
}

/// Writes the surfaces of the dynamic field at attenuation `iso_per_mm` for each phase; returns the files that were written.
///
/// # Errors
/// [`Error::Config`] when the field does not reach `iso_per_mm` at any phase; [`Error::Io`]; device errors.
pub fn write_meshes(
    renderer: &Renderer,
    grid: &PatientGrid,
    phases: &[u32],
    iso_per_mm: f64,
    format: MeshFormat,
    path: &Path,
    mut progress: impl FnMut(u64, u64),
) -> Result<Vec<PathBuf>> {
    if !(iso_per_mm.is_finite() && iso_per_mm > 0.0) {
        return Err(Error::config("iso_per_mm", iso_per_mm, "is not a positive attenuation per mm"));
    }
    let mut meshes = Vec::new();
    for phase in phases {
        let values = renderer.sample_patient(Component::Dynamic, *phase, grid)?;
        meshes.push((*phase, surface(&values, grid, iso_per_mm as f32)));
        progress(meshes.len() as u64, phases.len() as u64);
    }
    if meshes.iter().all(|(_, mesh)| mesh.triangles.is_empty()) {
        return Err(Error::config(
            "iso_per_mm",
            iso_per_mm,
            "is too high: no vessel has this attenuation at any phase",
        ));
    }
    if format == MeshFormat::Glb {
        files::write_atomic(path, &gltf::to_glb(&meshes)?)?;
        return Ok(vec![path.to_path_buf()]);
    }
    meshes
        .iter()
        .map(|(phase, mesh)| {
            let file = match meshes.len() {
                1 => path.to_path_buf(),
                _ => files::of_phase(path, *phase),
            };
            let bytes = match format {
                MeshFormat::Stl => mesh.to_stl(),
                MeshFormat::Ply => mesh.to_ply(),
                _ => mesh.to_obj(),
            };
            files::write_atomic(&file, &bytes)?;
            Ok(file)
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::DVec3;

    #[test]
    fn a_ball_has_its_volume_and_place() {
        let grid =
            PatientGrid { origin_mm: DVec3::new(-20.0, 0.0, 5.0), spacing_mm: DVec3::splat(0.5), size: [81, 81, 81] };
        let centre = DVec3::new(0.0, 20.0, 25.0);
        let values: Vec<f32> = (0..81usize.pow(3))
            .map(|i| {
                let p = DVec3::new((i % 81) as f64, (i / 81 % 81) as f64, (i / 6561) as f64);
                (10.0 - (grid.origin_mm + 0.5 * p - centre).length()) as f32
            })
            .collect();
        let mesh = surface(&values, &grid, 2.0);
        let wanted = 4.0 / 3.0 * std::f64::consts::PI * 8f64.powi(3);
        assert!((mesh.volume_mm3() / wanted - 1.0).abs() < 0.01, "{} mm3, not {wanted}", mesh.volume_mm3());
        for (v, n) in mesh.vertices.iter().zip(&mesh.normals) {
            let outwards = Vec3::from(*v) - centre.as_vec3();
            assert!((outwards.length() - 8.0).abs() < 0.2);
            assert!(outwards.normalize().dot(Vec3::from(*n)) > 0.9, "normals point outwards");
        }
        // On a closed surface every edge belongs to two triangles, once in each direction.
        let edges: std::collections::HashSet<(u32, u32)> =
            mesh.triangles.iter().flat_map(|t| [(t[0], t[1]), (t[1], t[2]), (t[2], t[0])]).collect();
        assert_eq!(edges.len(), 3 * mesh.triangles.len());
        assert!(edges.iter().all(|(a, b)| edges.contains(&(*b, *a))));
    }
}
