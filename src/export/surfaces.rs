//! Surfaces of the vessels at each phase, as STL, PLY, OBJ or animated glTF. LPS mm; glTF in its own metres and axes.

use crate::error::{Error, Result};
use crate::files;
use crate::model::component::Component;
use crate::render::grid::PatientGrid;
use crate::render::renderer::Renderer;
use fast_surface_nets::{SurfaceNetsBuffer, surface_nets};
use glam::Vec3;
use ndshape::{RuntimeShape, Shape};
use serde_json::json;
use std::fmt::Write as _;
use std::path::{Path, PathBuf};

/// A triangle mesh.
#[derive(Debug, Clone, Default)]
pub struct Mesh {
    /// Vertices, LPS mm.
    pub vertices: Vec<[f32; 3]>,
    /// Unit normals, outwards.
    pub normals: Vec<[f32; 3]>,
    /// Triangles, counter-clockwise from outside.
    pub triangles: Vec<[u32; 3]>,
}

/// File format of meshes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum MeshFormat {
    /// Binary STL, a file per phase.
    Stl,
    /// Binary PLY with normals, a file per phase.
    Ply,
    /// Wavefront OBJ, a file per phase.
    Obj,
    /// glTF binary: all phases in one animated file.
    Glb,
}

impl MeshFormat {
    /// Format by the end of a file name.
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

/// Length of a beat in the animation, seconds.
const BEAT_S: f32 = 1.0;

impl Mesh {
    /// The surface on which a field on a grid has the value `iso`; closed, also where it leaves the grid. Naive surface
    /// nets: like marching cubes, with one vertex per cell and evener triangles.
    pub fn of(values: &[f32], grid: &PatientGrid, iso: f32) -> Mesh {
        let size = grid.size;
        // A border outside closes the surface.
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
        let mut mesh = Mesh {
            vertices: nets.positions.iter().map(place).collect(),
            normals: Vec::new(),
            triangles: nets.indices.chunks_exact(3).map(|t| [t[0], t[1], t[2]]).collect(),
        };
        if mesh.volume_mm3() < 0.0 {
            mesh.triangles.iter_mut().for_each(|t| t.swap(1, 2));
        }
        mesh.normals = mesh.vertex_normals();
        mesh
    }

    fn corners(&self, triangle: &[u32; 3]) -> [Vec3; 3] {
        triangle.map(|i| Vec3::from(self.vertices[i as usize]))
    }

    /// Volume inside, mm3.
    pub fn volume_mm3(&self) -> f64 {
        let six_fold = |t: &[u32; 3]| {
            let [a, b, c] = self.corners(t).map(|v| v.as_dvec3());
            a.dot(b.cross(c))
        };
        self.triangles.iter().map(six_fold).sum::<f64>() / 6.0
    }

    fn vertex_normals(&self) -> Vec<[f32; 3]> {
        let mut sums = vec![Vec3::ZERO; self.vertices.len()];
        for t in &self.triangles {
            let [a, b, c] = self.corners(t);
            let n = (b - a).cross(c - a);
            t.iter().for_each(|i| sums[*i as usize] += n);
        }
        sums.into_iter().map(|n| n.normalize_or(Vec3::Z).to_array()).collect()
    }

    fn to_stl(&self) -> Vec<u8> {
        let mut out = format!("{:<80}", "nertca-vk vessel surface, LPS mm").into_bytes();
        out.extend((self.triangles.len() as u32).to_le_bytes());
        for t in &self.triangles {
            let [a, b, c] = self.corners(t);
            let n = (b - a).cross(c - a).normalize_or(Vec3::Z);
            for v in [n, a, b, c] {
                out.extend(v.to_array().iter().flat_map(|x| x.to_le_bytes()));
            }
            out.extend([0; 2]);
        }
        out
    }

    fn to_ply(&self) -> Vec<u8> {
        let mut out = format!(
            "ply\nformat binary_little_endian 1.0\ncomment vessel surface, LPS mm\nelement vertex {}\n\
             property float x\nproperty float y\nproperty float z\n\
             property float nx\nproperty float ny\nproperty float nz\n\
             element face {}\nproperty list uchar uint vertex_indices\nend_header\n",
            self.vertices.len(),
            self.triangles.len()
        )
        .into_bytes();
        for (v, n) in self.vertices.iter().zip(&self.normals) {
            out.extend(v.iter().chain(n).flat_map(|x| x.to_le_bytes()));
        }
        for t in &self.triangles {
            out.push(3);
            out.extend(t.iter().flat_map(|i| i.to_le_bytes()));
        }
        out
    }

    fn to_obj(&self) -> Vec<u8> {
        let mut out = String::from("# vessel surface, LPS mm\n");
        // Writing to a string cannot fail.
        for v in &self.vertices {
            let _ = writeln!(out, "v {} {} {}", v[0], v[1], v[2]);
        }
        for n in &self.normals {
            let _ = writeln!(out, "vn {} {} {}", n[0], n[1], n[2]);
        }
        for t in &self.triangles {
            let [a, b, c] = t.map(|i| i + 1);
            let _ = writeln!(out, "f {a}//{a} {b}//{b} {c}//{c}");
        }
        out.into_bytes()
    }
}

/// glTF looks along its axes in metres, y up: x = left, y = superior, z = anterior.
fn to_gltf_axes(v: &[f32; 3], scale: f32) -> [f32; 3] {
    [v[0] * scale, v[2] * scale, -v[1] * scale]
}

/// All phases as one binary glTF whose animation shows each for its share of a beat.
fn to_glb(meshes: &[(u32, Mesh)]) -> Result<Vec<u8>> {
    let (mut bin, mut views, mut accessors) = (Vec::<u8>::new(), Vec::new(), Vec::new());
    let mut add = |bytes: Vec<u8>, accessor: serde_json::Value, target: Option<u32>| {
        let mut view = json!({ "buffer": 0, "byteOffset": bin.len(), "byteLength": bytes.len() });
        if let Some(target) = target {
            view["target"] = json!(target);
        }
        bin.extend(&bytes);
        bin.resize(bin.len().next_multiple_of(4), 0);
        let mut accessor = accessor;
        accessor["bufferView"] = json!(views.len());
        views.push(view);
        accessors.push(accessor);
        accessors.len() - 1
    };
    let floats = |values: &mut dyn Iterator<Item = f32>| values.flat_map(f32::to_le_bytes).collect::<Vec<u8>>();
    let (mut gltf_meshes, mut nodes, mut samplers, mut channels) = (Vec::new(), Vec::new(), Vec::new(), Vec::new());
    let n = meshes.len();
    let times: Vec<f32> = (0..=n).map(|i| BEAT_S * i as f32 / n as f32).collect();
    let time = add(
        floats(&mut times.iter().copied()),
        json!({ "componentType": 5126, "count": n + 1, "type": "SCALAR", "min": [0.0], "max": [BEAT_S] }),
        None,
    );
    for (index, (phase, mesh)) in meshes.iter().enumerate() {
        let scale = f32::from(u8::from(index == 0));
        let mut node = json!({ "name": format!("phase {phase}"), "scale": [scale, scale, scale] });
        if !mesh.triangles.is_empty() {
            let points: Vec<[f32; 3]> = mesh.vertices.iter().map(|v| to_gltf_axes(v, 1e-3)).collect();
            let bound = |pick: fn(f32, f32) -> f32| {
                (0..3).map(|a| points.iter().map(|p| p[a]).fold(points[0][a], pick)).collect::<Vec<_>>()
            };
            let position = add(
                floats(&mut points.iter().flatten().copied()),
                json!({ "componentType": 5126, "count": points.len(), "type": "VEC3", "min": bound(f32::min), "max": bound(f32::max) }),
                Some(34962),
            );
            let normal = add(
                floats(&mut mesh.normals.iter().flat_map(|v| to_gltf_axes(v, 1.0))),
                json!({ "componentType": 5126, "count": points.len(), "type": "VEC3" }),
                Some(34962),
            );
            let indices = add(
                mesh.triangles.iter().flatten().flat_map(|i| i.to_le_bytes()).collect(),
                json!({ "componentType": 5125, "count": 3 * mesh.triangles.len(), "type": "SCALAR" }),
                Some(34963),
            );
            node["mesh"] = json!(gltf_meshes.len());
            gltf_meshes.push(json!({ "primitives": [{
                "attributes": { "POSITION": position, "NORMAL": normal }, "indices": indices, "material": 0 }] }));
        }
        nodes.push(node);
        // Shown while its phase lasts: steps of the scale between 0 and 1.
        let scales = (0..=n).map(|i| f32::from(u8::from(i % n == index))).flat_map(|s| [s; 3]);
        let scale = add(
            floats(&mut scales.into_iter()),
            json!({ "componentType": 5126, "count": n + 1, "type": "VEC3" }),
            None,
        );
        channels.push(json!({ "sampler": samplers.len(), "target": { "node": index, "path": "scale" } }));
        samplers.push(json!({ "input": time, "output": scale, "interpolation": "STEP" }));
    }
    let mut document = json!({
        "asset": { "version": "2.0", "generator": concat!("nertca-vk ", env!("CARGO_PKG_VERSION")) },
        "scene": 0,
        "scenes": [{ "nodes": (0..n).collect::<Vec<_>>() }],
        "nodes": nodes,
        "materials": [{ "name": "vessel", "pbrMetallicRoughness": {
            "baseColorFactor": [0.75, 0.1, 0.08, 1.0], "metallicFactor": 0.0, "roughnessFactor": 0.5 } }],
        "buffers": [{ "byteLength": bin.len() }],
        "bufferViews": views,
        "accessors": accessors,
    });
    if n > 1 {
        document["animations"] = json!([{ "name": "beat", "samplers": samplers, "channels": channels }]);
    }
    if !gltf_meshes.is_empty() {
        document["meshes"] = json!(gltf_meshes);
    }
    let mut text = serde_json::to_vec(&document).map_err(|e| Error::Internal(e.to_string()))?;
    text.resize(text.len().next_multiple_of(4), b' ');
    let mut out = b"glTF".to_vec();
    let total = 12 + 8 + text.len() + 8 + bin.len();
    for word in [2, total as u32, text.len() as u32] {
        out.extend(word.to_le_bytes());
    }
    out.extend(b"JSON");
    out.extend(text);
    out.extend((bin.len() as u32).to_le_bytes());
    out.extend(b"BIN\0");
    out.extend(bin);
    Ok(out)
}

/// Surfaces of the moving vessels where their attenuation is `iso_per_mm`, at each phase; returns the files made.
///
/// # Errors
/// [`Error::Config`] when nothing reaches `iso_per_mm`; [`Error::Io`]; device errors.
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
        meshes.push((*phase, Mesh::of(&values, grid, iso_per_mm as f32)));
        progress(meshes.len() as u64, phases.len() as u64);
    }
    if meshes.iter().all(|(_, mesh)| mesh.triangles.is_empty()) {
        return Err(Error::config("iso_per_mm", iso_per_mm, "no vessel attenuates as much at any phase"));
    }
    if format == MeshFormat::Glb {
        files::write_atomic(path, &to_glb(&meshes)?)?;
        return Ok(vec![path.to_path_buf()]);
    }
    let stem = path.file_stem().unwrap_or_default().to_string_lossy().into_owned();
    let extension = path.extension().unwrap_or_default().to_string_lossy().into_owned();
    meshes
        .iter()
        .map(|(phase, mesh)| {
            let file = match meshes.len() {
                1 => path.to_path_buf(),
                _ => path.with_file_name(format!("{stem}_{phase:04}.{extension}")),
            };
            let bytes = match format {
                MeshFormat::Stl => mesh.to_stl(),
                MeshFormat::Ply => mesh.to_ply(),
                _ => mesh.to_obj(),
            };
            files::write_atomic(&file, &bytes).map(|()| file)
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
        let mesh = Mesh::of(&values, &grid, 2.0);
        let wanted = 4.0 / 3.0 * std::f64::consts::PI * 8f64.powi(3);
        assert!((mesh.volume_mm3() / wanted - 1.0).abs() < 0.01, "{} mm3, not {wanted}", mesh.volume_mm3());
        for (v, n) in mesh.vertices.iter().zip(&mesh.normals) {
            let outwards = Vec3::from(*v) - centre.as_vec3();
            assert!((outwards.length() - 8.0).abs() < 0.2);
            assert!(outwards.normalize().dot(Vec3::from(*n)) > 0.9, "normals point outwards");
        }
        // Closed: every edge has two triangles, one in each direction.
        let edges: std::collections::HashSet<(u32, u32)> =
            mesh.triangles.iter().flat_map(|t| [(t[0], t[1]), (t[1], t[2]), (t[2], t[0])]).collect();
        assert_eq!(edges.len(), 3 * mesh.triangles.len());
        assert!(edges.iter().all(|(a, b)| edges.contains(&(*b, *a))));
    }
}
