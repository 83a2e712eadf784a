//! Sizes and variants of the kernels, chosen for a device, with the reasons.

use crate::choice::Choice;
use crate::gpu::buffer::Operands;
use crate::gpu::capabilities::{DeviceInfo, DeviceKind, Vendor};
use crate::gpu::pace::longest_submit_s;
use crate::kernels::constants;
use crate::kernels::push::{MarchLoss, PushConstants};
use serde::Serialize;

/// The register tile of three kernels that work together, from what their text defines.
macro_rules! lane_tile {
    ($forward:ident, $input:ident, $weight:ident) => {{
        const { assert!(constants::$forward::SAMPLES == constants::$input::SAMPLES) };
        LaneTile {
            samples: constants::$forward::SAMPLES,
            fwd_neurons: constants::$forward::OUTPUTS,
            bwd_inputs: 4 * constants::$input::GROUPS,
            weight_neurons: 4 * constants::$weight::NEURONS4,
            weight_inputs: constants::$weight::INPUTS,
        }
    }};
}

/// How the network's layers are computed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Layers {
    /// f32 throughout.
    F32,
    /// Cooperative matrices: f16 operands, f32 sums.
    Matrices,
}

impl Choice for Layers {
    const ALL: &'static [Layers] = &[Layers::F32, Layers::Matrices];

    fn name(self) -> &'static str {
        match self {
            Layers::F32 => "f32",
            Layers::Matrices => "matrices",
        }
    }
}

/// Sizes of the passes on cooperative matrices.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
pub struct MatrixTuning {
    /// Workgroups of the backward passes, which stay on the device and share out the samples.
    pub workgroups: u32,
    /// Samples of a workgroup's tile, at most; shared memory may allow fewer.
    pub largest_tile: u32,
    /// Unroll the forward pass's loops over the inner dimension: operands stay in registers, compilation takes longer.
    pub unroll_forward: bool,
    /// The same of the backward passes.
    pub unroll_backward: bool,
    /// Go backward through two layers at once where two follow each other: less memory moves, with twice the sums.
    pub pairs: bool,
    /// f32 sums of weight gradients that an invocation of the backward passes keeps, at most; workgroups become larger
    /// before there are more.
    pub backward_sums: u32,
    /// Invocations of a backward workgroup, at most.
    pub backward_lanes: u32,
    /// Compute the encoding and the first layer again in the backward pass of a pair instead of keeping them: less memory moves.
    pub recompute: bool,
    /// Make numbers f16 in registers, for which a device must have matrices of f16 sums.
    pub f16_sums: bool,
}

/// Rays of a workgroup.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct RayLanes {
    /// Invocations that share a ray.
    pub(super) lanes: u32,
    /// How many.
    pub(super) rays: u32,
}

impl RayLanes {
    /// Invocations of a workgroup, as a stage is built with them.
    pub(super) fn workgroup(self) -> Option<u32> {
        Some(self.lanes * self.rays)
    }

    /// The constant by which shaders know the rays of a workgroup.
    pub(super) fn constant(self) -> [(&'static str, u32); 1] {
        [("rays_of_workgroup", self.rays)]
    }
}

impl MatrixTuning {
    /// As a CPU takes them. Unrolled, a driver compiles these kernels for minutes; sums are in memory, and the encoding is dear.
    pub const CPU: MatrixTuning = MatrixTuning {
        workgroups: 4,
        largest_tile: 32,
        unroll_forward: false,
        unroll_backward: false,
        pairs: true,
        backward_sums: u32::MAX,
        backward_lanes: 512,
        recompute: false,
        f16_sums: true,
    };

    /// As NVIDIA's GPUs take them, and others of which nothing is known. What differs for the next two is by their compilers'
    /// numbers (docs/performance.md).
    pub const NVIDIA: MatrixTuning = MatrixTuning {
        workgroups: 264,
        largest_tile: 128,
        unroll_forward: true,
        unroll_backward: true,
        pairs: true,
        backward_sums: 64,
        backward_lanes: 512,
        recompute: true,
        f16_sums: true,
    };

    /// As AMD's GPUs take them: unrolled, the forward pass has twice the instructions.
    pub const AMD: MatrixTuning = MatrixTuning { unroll_forward: false, ..MatrixTuning::NVIDIA };

    /// As Intel's GPUs take them: registers are few, and spilling costs more than memory that moves.
    pub const INTEL: MatrixTuning = MatrixTuning {
        largest_tile: 64,
        unroll_forward: false,
        pairs: false,
        backward_sums: 16,
        backward_lanes: 1024,
        recompute: false,
        ..MatrixTuning::NVIDIA
    };

    /// Chooses for a device.
    fn for_device(info: &DeviceInfo) -> MatrixTuning {
        if info.is_cpu() {
            return MatrixTuning::CPU;
        }
        let sizes = match info.vendor {
            Vendor::Amd => MatrixTuning::AMD,
            Vendor::Intel => MatrixTuning::INTEL,
            Vendor::Nvidia | Vendor::Other => MatrixTuning::NVIDIA,
        };
        let workgroups = match info.multiprocessors {
            0 => workgroups_untold(info),
            // Two workgroups per multiprocessor.
            n => 2 * n,
        };
        MatrixTuning { workgroups, ..sizes }
    }
}

/// Sizes and variants chosen for a device, with the reasons.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Tuning {
    /// How the network's layers are computed.
    pub layers: Layers,
    /// How kernels read weights and activations in f32.
    pub operands: Operands,
    /// Invocations of a workgroup of the layer kernels.
    pub layer_lanes: u32,
    /// Invocations of a workgroup of the weight-gradient kernels.
    pub weight_lanes: u32,
    /// Parts the samples are split into for weight gradients.
    pub splits: u32,
    /// Sizes of the passes on matrices.
    pub matrices: MatrixTuning,
    /// Invocations of a workgroup of the kernels that march along rays: all share a ray where each gets one of its samples at least;
    /// else a ray has `ray_lanes`, and a workgroup as many rays as that makes.
    pub march_lanes: u32,
    /// Invocations that share a ray of few samples, and in any case the depths among which live samples are sought.
    pub ray_lanes: u32,
    /// Shared memory in which a workgroup may sum the static field's lines before they go to memory, bytes.
    pub private_line_bytes: u32,
    /// Samples handled at once, at most; the configuration may ask for fewer.
    pub chunk_samples: u32,
    /// Iterations handed to the device at once, at most, instead of what the configuration says.
    pub iterations_per_submit: Option<u32>,
    /// Longest submit, seconds; none where nothing watches over the device.
    pub longest_submit_s: Option<f64>,
    /// Validate and save beside training instead of between iterations.
    pub overlap: bool,
    /// One sentence per choice.
    pub reasons: Vec<String>,
}

/// Workgroups that keep a device busy whose number of multiprocessors the driver does not tell: too many write and add up sums of
/// their own for nothing.
fn workgroups_untold(info: &DeviceInfo) -> u32 {
    match (info.kind, info.vendor) {
        (DeviceKind::Integrated, _) => 32,
        // Two for each of 32 cores, which the largest have.
        (_, Vendor::Intel) => 64,
        _ => 264,
    }
}

/// Partial sums that are too many for one invocation to add up.
const MANY_SPLITS: u32 = 64;

impl Tuning {
    /// Chooses for a device.
    pub fn for_device(info: &DeviceInfo) -> Tuning {
        let old_lavapipe = info.is_llvmpipe && info.mesa_major.is_some_and(|v| v < 24);
        let mut reasons = Vec::new();
        let (operands, why) = if old_lavapipe {
            (Operands::Texel, "operands through texel buffers: this llvmpipe reads storage buffers lane by lane")
        } else if info.is_llvmpipe && info.buffer_device_address {
            (Operands::Address, "operands through addresses: spares this llvmpipe bounds checks")
        } else {
            (Operands::Storage, "operands through storage buffers")
        };
        reasons.push(why.to_owned());
        let (layer_lanes, weight_lanes, splits) = if info.is_llvmpipe {
            reasons.push("one subgroup per workgroup and few splits: a CPU has few workgroups in flight".into());
            (info.subgroup_size.clamp(4, 16), info.subgroup_size.clamp(4, 16), 4)
        } else {
            (64, 32, 16)
        };
        let (layers, why) = match info.matrices.first() {
            None => (Layers::F32, "f32 layers: the device has no cooperative matrices our kernels can use".to_owned()),
            Some(_) if info.is_cpu() => {
                (Layers::F32, "f32 layers: a CPU emulates cooperative matrices, several times slower".to_owned())
            }
            Some(s) if !s.f16_sums => {
                (Layers::F32, "f32 layers: cooperative matrices without f16 sums go by way of shared memory".to_owned())
            }
            Some(s) => (Layers::Matrices, format!("matrix layers, {}x{}x{}: f16 operands, f32 sums", s.m, s.n, s.k)),
        };
        reasons.push(why);
        let f16_sums = info.matrices.first().is_some_and(|s| s.f16_sums);
        let matrices = MatrixTuning { f16_sums, ..MatrixTuning::for_device(info) };
        // Some kilobytes per sample must fit beside all else. By what there is, not by what is free now: sums of a batch in other
        // chunks are rounded otherwise, and runs on one device repeat bit by bit.
        let chunk_samples = match info.kind {
            DeviceKind::Cpu => 1 << 17,
            _ => (info.device_memory >> 14).clamp(1 << 16, 1 << 19) as u32,
        };
        let overlap = !info.is_cpu();
        // Workgroups on a multiprocessor are few, so that one subgroup in each leaves it two thirds empty.
        let ray_lanes = MarchLoss::LOCAL_SIZE;
        let march_lanes = if info.is_cpu() { ray_lanes } else { 2 * ray_lanes };
        // Shared memory is no faster on a CPU.
        let private_line_bytes = if info.is_cpu() { 0 } else { info.max_shared_memory / 2 };
        // Kernels that read through texel buffers have no variants.
        let bits = if info.int64_atomics && operands != Operands::Texel { 64 } else { 32 };
        let lines = if private_line_bytes == 0 { "" } else { ", lines in shared memory first" };
        reasons.push(format!("static gradients through {bits}-bit integer atomics{lines}: exact sums"));
        Tuning {
            layers,
            operands,
            layer_lanes,
            weight_lanes,
            splits,
            matrices,
            march_lanes,
            ray_lanes,
            private_line_bytes,
            chunk_samples,
            iterations_per_submit: None,
            longest_submit_s: longest_submit_s(info),
            overlap,
            reasons,
        }
    }

    /// Whether matrices may be faster on a device, so that timing both paths is worth its time.
    pub fn has_choice(info: &DeviceInfo) -> bool {
        !info.is_cpu() && !info.matrices.is_empty()
    }

    /// `line_params` if that many sums fit the shared memory set aside for them, else 0; `private_lines` of `march_loss`.
    pub(super) fn private_lines(&self, line_params: u32) -> u32 {
        if 8 * line_params <= self.private_line_bytes { line_params } else { 0 }
    }

    /// How `march_loss` and `march_fwd` share out rays of so many samples of the static field.
    pub(super) fn rays_with(&self, n_samples: u32) -> RayLanes {
        self.rays_of(if n_samples < self.march_lanes { self.ray_lanes } else { self.march_lanes })
    }

    /// How kernels that give so many lanes to a ray share out rays.
    pub(super) fn rays_of(&self, lanes: u32) -> RayLanes {
        RayLanes { lanes, rays: (self.march_lanes / lanes).max(1) }
    }

    /// Invocations that share out the partial sums of a number of the network's gradient.
    pub(crate) fn gradient_parts(&self) -> u32 {
        let splits = match self.layers {
            Layers::F32 => self.splits,
            Layers::Matrices => self.matrices.workgroups,
        };
        if splits < MANY_SPLITS { 1 } else { 8 }
    }

    /// This tuning with the layers on another path, for the reason given.
    pub fn with_layers(mut self, layers: Layers, reason: String) -> Tuning {
        self.layers = layers;
        self.reasons.retain(|r| !r.contains("layers"));
        self.reasons.push(reason);
        self
    }

    /// The plainest path where the network is never asked.
    pub fn for_network(self, asked: bool) -> Tuning {
        if asked { self } else { self.with_layers(Layers::F32, "no layers: the network is not asked".into()) }
    }

    /// Samples one workgroup of the layer kernels covers.
    pub fn tile_samples(&self) -> u32 {
        self.layer_lanes * self.tile().samples
    }

    /// What a lane of the layer kernels keeps in registers.
    pub fn tile(&self) -> LaneTile {
        match self.operands {
            Operands::Storage => lane_tile!(mlp_layer_fwd, mlp_layer_bwd_input, mlp_layer_bwd_weight),
            Operands::Texel => lane_tile!(mlp_layer_fwd_texel, mlp_layer_bwd_input_texel, mlp_layer_bwd_weight_texel),
            Operands::Address => {
                lane_tile!(mlp_layer_fwd_address, mlp_layer_bwd_input_address, mlp_layer_bwd_weight_address)
            }
        }
    }
}

/// Register tiles of the layer kernels.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct LaneTile {
    /// Samples a lane of `mlp_layer_fwd` and `mlp_layer_bwd_input` keeps.
    pub samples: u32,
    /// Neurons of `mlp_layer_fwd`.
    pub fwd_neurons: u32,
    /// Inputs of `mlp_layer_bwd_input`.
    pub bwd_inputs: u32,
    /// Neurons of `mlp_layer_bwd_weight`.
    pub weight_neurons: u32,
    /// Inputs of `mlp_layer_bwd_weight`.
    pub weight_inputs: u32,
}
