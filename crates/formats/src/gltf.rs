//! Binary glTF (`.glb`): the meshes of a beat as one animation. The writer is our own: gltf-json is well maintained, but its
//! types require every field of the standard, which takes more code than the few kinds of object needed here.

use crate::error::{Error, Result};
use crate::mesh::Mesh;
use serde_json::{Value, json};

/// Numeric constants of the standard.
mod code {
    pub(super) const FLOAT: u32 = 5126;
    pub(super) const UNSIGNED_INT: u32 = 5125;
    pub(super) const ARRAY_BUFFER: u32 = 34962;
    pub(super) const ELEMENT_ARRAY_BUFFER: u32 = 34963;
    pub(super) const VERSION: u32 = 2;
}

/// Length of a beat in the animation, seconds.
const BEAT_S: f32 = 1.0;
const METRES_PER_MM: f32 = 1e-3;
/// Alignment of chunks and arrays, bytes.
const ALIGNMENT: usize = 4;

/// Converts LPS axes to glTF's, where y is up: x = left, y = superior, z = anterior.
fn to_gltf_axes(v: &[f32; 3]) -> [f32; 3] {
    [v[0], v[2], -v[1]]
}

/// Writes all phases as one binary glTF, in metres, whose animation shows each phase for its share of a beat.
///
/// # Errors
/// [`Error::Internal`] for values that JSON cannot hold.
pub fn to_glb(meshes: &[(u32, Mesh)]) -> Result<Vec<u8>> {
    let mut scene = Scene::default();
    meshes.iter().enumerate().for_each(|(index, (phase, mesh))| scene.add_node(*phase, mesh, index == 0));
    if meshes.len() > 1 {
        scene.animate();
    }
    scene.into_container()
}

/// A mesh that changes its shape over the beat, with the same triangles and corresponding vertices at all phases.
pub struct MovingMesh {
    /// Name of its node.
    pub name: String,
    /// Mesh at each phase; the triangles of the first mesh are used for all.
    pub phases: Vec<Mesh>,
}

/// Writes meshes that change their shapes as one binary glTF, in metres. The phases after the first are morph targets; the
/// animation interpolates linearly from each phase to the next and finally from the last to the first.
///
/// # Errors
/// [`Error::Internal`] for values that JSON cannot hold.
pub fn to_moving_glb(parts: &[MovingMesh]) -> Result<Vec<u8>> {
    let mut scene = Scene::default();
    parts.iter().for_each(|part| scene.add_moving_node(part));
    let n_phases = parts.first().map_or(0, |part| part.phases.len());
    if n_phases > 1 {
        scene.animate_shapes(n_phases);
    }
    scene.into_container()
}

/// Vertex positions in glTF axes, metres.
fn to_gltf_places(mesh: &Mesh) -> Vec<[f32; 3]> {
    mesh.vertices.iter().map(|v| to_gltf_axes(&v.map(|x| x * METRES_PER_MM))).collect()
}

fn differences(from: &[[f32; 3]], to: &[[f32; 3]]) -> Vec<[f32; 3]> {
    from.iter().zip(to).map(|(a, b)| [0, 1, 2].map(|axis| b[axis] - a[axis])).collect()
}

fn to_gltf_normals(mesh: &Mesh) -> Vec<[f32; 3]> {
    mesh.normals.iter().map(to_gltf_axes).collect()
}

/// Objects of a glTF document and the binary data they refer to.
#[derive(Default)]
struct Scene {
    data: Vec<u8>,
    buffer_views: Vec<Value>,
    accessors: Vec<Value>,
    meshes: Vec<Value>,
    nodes: Vec<Value>,
    animations: Vec<Value>,
}

impl Scene {
    /// Appends an array and returns the index of its accessor.
    fn add_array(&mut self, bytes: impl Iterator<Item = u8>, target: Option<u32>, mut accessor: Value) -> usize {
        let start = self.data.len();
        self.data.extend(bytes);
        let mut view = json!({ "buffer": 0, "byteOffset": start, "byteLength": self.data.len() - start });
        if let Some(target) = target {
            view["target"] = json!(target);
        }
        self.data.resize(self.data.len().next_multiple_of(ALIGNMENT), 0);
        accessor["bufferView"] = json!(self.buffer_views.len());
        self.buffer_views.push(view);
        self.accessors.push(accessor);
        self.accessors.len() - 1
    }

    fn add_floats(&mut self, values: &[f32], target: Option<u32>, accessor: Value) -> usize {
        self.add_array(values.iter().flat_map(|v| v.to_le_bytes()), target, accessor)
    }

    /// Appends vectors, one per vertex, and returns the index of their accessor.
    fn add_vectors(&mut self, vectors: &[[f32; 3]], bounds: Option<[[f32; 3]; 2]>) -> usize {
        let mut accessor = json!({ "componentType": code::FLOAT, "count": vectors.len(), "type": "VEC3" });
        if let Some([low, high]) = bounds {
            (accessor["min"], accessor["max"]) = (json!(low), json!(high));
        }
        self.add_floats(vectors.as_flattened(), Some(code::ARRAY_BUFFER), accessor)
    }

    /// Adds a node for a phase; it has no mesh if the phase has no triangles.
    fn add_node(&mut self, phase: u32, mesh: &Mesh, shown: bool) {
        let scale = f32::from(u8::from(shown));
        let mut node = json!({ "name": format!("phase {phase}"), "scale": [scale, scale, scale] });
        if !mesh.triangles.is_empty() {
            node["mesh"] = json!(self.add_mesh(mesh));
        }
        self.nodes.push(node);
    }

    /// Adds a node that shows a mesh, with the displacements of its vertices and normals at each further phase as morph
    /// targets.
    fn add_moving_node(&mut self, part: &MovingMesh) {
        let Some((rest, moved)) = part.phases.split_first() else { return };
        let mesh = self.add_mesh(rest);
        let (places, normals) = (to_gltf_places(rest), to_gltf_normals(rest));
        let target = |mesh: &Mesh| {
            let position = self.add_places(&differences(&places, &to_gltf_places(mesh)));
            let normal = self.add_vectors(&differences(&normals, &to_gltf_normals(mesh)), None);
            json!({ "POSITION": position, "NORMAL": normal })
        };
        let targets: Vec<Value> = moved.iter().map(target).collect();
        if !targets.is_empty() {
            self.meshes[mesh]["weights"] = json!(vec![0.0; targets.len()]);
            self.meshes[mesh]["primitives"][0]["targets"] = json!(targets);
        }
        self.nodes.push(json!({ "name": part.name, "mesh": mesh }));
    }

    /// Appends positions with their bounds, which the standard requires.
    fn add_places(&mut self, places: &[[f32; 3]]) -> usize {
        let bound = |pick: fn(f32, f32) -> f32| {
            std::array::from_fn(|axis| places.iter().map(|p| p[axis]).fold(places[0][axis], pick))
        };
        self.add_vectors(places, Some([bound(f32::min), bound(f32::max)]))
    }

    fn add_mesh(&mut self, mesh: &Mesh) -> usize {
        let position = self.add_places(&to_gltf_places(mesh));
        let normal = self.add_vectors(&to_gltf_normals(mesh), None);
        let corners = mesh.triangles.as_flattened();
        let indices = self.add_array(
            corners.iter().flat_map(|i| i.to_le_bytes()),
            Some(code::ELEMENT_ARRAY_BUFFER),
            json!({ "componentType": code::UNSIGNED_INT, "count": corners.len(), "type": "SCALAR" }),
        );
        self.meshes.push(json!({ "primitives": [{
            "attributes": { "POSITION": position, "NORMAL": normal }, "indices": indices, "material": 0 }] }));
        self.meshes.len() - 1
    }

    /// Appends the start times of `n` phases and the end of the beat.
    fn add_times(&mut self, n: usize) -> usize {
        let times: Vec<f32> = (0..=n).map(|i| BEAT_S * i as f32 / n as f32).collect();
        self.add_floats(
            &times,
            None,
            json!({ "componentType": code::FLOAT, "count": n + 1, "type": "SCALAR", "min": [0.0], "max": [BEAT_S] }),
        )
    }

    /// Animates every node through the shapes of all phases and back to the first.
    fn animate_shapes(&mut self, n_phases: usize) {
        let time = self.add_times(n_phases);
        let weight = |i: usize, target: usize| f32::from(u8::from(i % n_phases == target));
        let weights: Vec<f32> =
            (0..=n_phases).flat_map(|i| (1..n_phases).map(move |target| weight(i, target))).collect();
        let accessor = json!({ "componentType": code::FLOAT, "count": weights.len(), "type": "SCALAR" });
        let output = self.add_floats(&weights, None, accessor);
        let channel = |node: usize| json!({ "sampler": 0, "target": { "node": node, "path": "weights" } });
        let channels: Vec<Value> = (0..self.nodes.len()).map(channel).collect();
        let sampler = json!({ "input": time, "output": output, "interpolation": "LINEAR" });
        self.animations.push(json!({ "name": "beat", "samplers": [sampler], "channels": channels }));
    }

    /// Animates each node to be visible during its phase, by steps of its scale between 0 and 1.
    fn animate(&mut self) {
        let n = self.nodes.len();
        let time = self.add_times(n);
        let (mut samplers, mut channels) = (Vec::new(), Vec::new());
        for node in 0..n {
            let scales: Vec<f32> = (0..=n).flat_map(|i| [f32::from(u8::from(i % n == node)); 3]).collect();
            let accessor = json!({ "componentType": code::FLOAT, "count": n + 1, "type": "VEC3" });
            let scale = self.add_floats(&scales, None, accessor);
            channels.push(json!({ "sampler": samplers.len(), "target": { "node": node, "path": "scale" } }));
            samplers.push(json!({ "input": time, "output": scale, "interpolation": "STEP" }));
        }
        self.animations.push(json!({ "name": "beat", "samplers": samplers, "channels": channels }));
    }

    /// Returns the JSON of the document. Empty lists are left out, because the standard forbids them.
    fn document(&self) -> Value {
        let mut document = json!({
            "asset": { "version": "2.0", "generator": concat!("nertca-vk ", env!("CARGO_PKG_VERSION")) },
            "scene": 0,
            "scenes": [{ "nodes": (0..self.nodes.len()).collect::<Vec<_>>() }],
            "nodes": self.nodes,
            "materials": [{ "name": "vessel", "pbrMetallicRoughness": {
                "baseColorFactor": [0.75, 0.1, 0.08, 1.0], "metallicFactor": 0.0, "roughnessFactor": 0.5 } }],
            "buffers": [{ "byteLength": self.data.len() }],
        });
        let lists = [
            ("bufferViews", &self.buffer_views),
            ("accessors", &self.accessors),
            ("animations", &self.animations),
            ("meshes", &self.meshes),
        ];
        for (name, list) in lists.into_iter().filter(|(_, list)| !list.is_empty()) {
            document[name] = json!(list);
        }
        document
    }

    /// Returns the file: a header, the document and the data.
    fn into_container(self) -> Result<Vec<u8>> {
        let mut text = serde_json::to_vec(&self.document()).map_err(|e| Error::Internal(e.to_string()))?;
        text.resize(text.len().next_multiple_of(ALIGNMENT), b' ');
        let chunk =
            |kind: &[u8; 4], bytes: Vec<u8>| [&(bytes.len() as u32).to_le_bytes()[..], &kind[..], &bytes[..]].concat();
        let chunks = [chunk(b"JSON", text), chunk(b"BIN\0", self.data)].concat();
        let (magic, length) = (b"glTF", 12 + chunks.len() as u32);
        Ok([&magic[..], &code::VERSION.to_le_bytes(), &length.to_le_bytes(), &chunks].concat())
    }
}
