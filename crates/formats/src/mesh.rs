//! Triangle meshes and file formats for a single mesh: binary STL, binary PLY with normals, Wavefront OBJ.

use glam::Vec3;
use std::fmt::Write as _;

/// A triangle mesh.
#[derive(Debug, Clone, Default)]
pub struct Mesh {
    /// Vertices, LPS mm.
    pub vertices: Vec<[f32; 3]>,
    /// Unit normals, pointing outwards.
    pub normals: Vec<[f32; 3]>,
    /// Triangles as vertex indices, counter-clockwise seen from outside.
    pub triangles: Vec<[u32; 3]>,
}

/// Text of the header of an STL file, padded to a fixed length.
const STL_HEADER: &str = "nertca-vk vessel surface, LPS mm";
const STL_HEADER_BYTES: usize = 80;

impl Mesh {
    /// Makes a closed mesh with normals, and orients its triangles outwards.
    pub fn closed(vertices: Vec<[f32; 3]>, triangles: Vec<[u32; 3]>) -> Mesh {
        let mut mesh = Mesh { vertices, normals: Vec::new(), triangles };
        if mesh.volume_mm3() < 0.0 {
            mesh.triangles.iter_mut().for_each(|t| t.swap(1, 2));
        }
        mesh.normals = mesh.vertex_normals();
        mesh
    }

    fn corners(&self, triangle: &[u32; 3]) -> [Vec3; 3] {
        triangle.map(|i| Vec3::from(self.vertices[i as usize]))
    }

    /// Enclosed volume, mm3.
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

    /// Returns the mesh as binary STL.
    pub fn to_stl(&self) -> Vec<u8> {
        let mut out = format!("{STL_HEADER:<STL_HEADER_BYTES$}").into_bytes();
        out.extend((self.triangles.len() as u32).to_le_bytes());
        for t in &self.triangles {
            let [a, b, c] = self.corners(t);
            let n = (b - a).cross(c - a).normalize_or(Vec3::Z);
            for v in [n, a, b, c] {
                out.extend(v.to_array().iter().flat_map(|x| x.to_le_bytes()));
            }
            let attributes = 0u16;
            out.extend(attributes.to_le_bytes());
        }
        out
    }

    /// Returns the mesh as binary PLY with normals.
    pub fn to_ply(&self) -> Vec<u8> {
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

    /// Returns the mesh as Wavefront OBJ with normals.
    pub fn to_obj(&self) -> Vec<u8> {
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
