//! Sizes and variants of the kernels, chosen for a device, with the reasons.

use crate::gpu::buffer::Operands;
use crate::gpu::capabilities::{DeviceInfo, DeviceKind, Vendor};
use crate::gpu::pace::longest_submit_s;
use crate::kernels::constants;
use crate::kernels::push::{MarchLoss, PushConstants};
use crate::kernels::stages::{matrix_shape, why_no_matrices};
use serde::Serialize;
use strum::{IntoStaticStr, VariantArray};

/// Returns the register tile of three kernels that work together, from the numbers that their text defines.
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

/// Computation path of the network's layers.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, IntoStaticStr, VariantArray)]
#[serde(rename_all = "snake_case")]
#[strum(serialize_all = "kebab-case")]
pub enum Layers {
    /// f32 throughout.
    F32,
    /// Cooperative matrices: f16 operands, f32 sums.
    Matrices,
}

/// Sizes of the passes on cooperative matrices.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
pub struct MatrixTuning {
    /// Workgroups of the backward passes, which stay on the device and share out the samples.
    pub workgroups: u32,
    /// Samples of a workgroup's tile, at most; shared memory may allow fewer.
    pub largest_tile: u32,
    /// Whether the forward pass's loops over the inner dimension are unrolled: operands stay in registers, but compilation
    /// takes longer.
    pub unroll_forward: bool,
    /// Whether the backward passes' loops over the inner dimension are unrolled.
    pub unroll_backward: bool,
    /// Whether a backward pass goes through two consecutive layers at once: less memory traffic, but twice as many sums.
    pub pairs: bool,
    /// Maximum number of f32 sums of weight gradients that an invocation of the backward passes keeps. Workgroups grow before
    /// this is exceeded.
    pub backward_sums: u32,
    /// Maximum number of invocations of a backward workgroup.
    pub backward_lanes: u32,
    /// Whether the backward pass of a pair recomputes the encoding and the first layer instead of reading stored values: less
    /// memory traffic.
    pub recompute: bool,
    /// Whether numbers become f16 in registers; the device must have matrices with f16 sums.
    pub f16_sums: bool,
}

/// Distribution of the lanes of a workgroup over rays.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct RayLanes {
    /// Invocations that share a ray.
    pub(super) lanes: u32,
    /// Rays of a workgroup.
    pub(super) rays: u32,
}

impl RayLanes {
    /// Number of invocations of a workgroup, in the form that a stage is built with.
    pub(super) fn workgroup(self) -> Option<u32> {
        Some(self.lanes * self.rays)
    }

    /// Specialisation constant that tells shaders the rays of a workgroup.
    pub(super) fn constant(self) -> [(&'static str, u32); 1] {
        [("rays_of_workgroup", self.rays)]
    }
}

impl MatrixTuning {
    /// Sizes for CPUs. Drivers would compile unrolled kernels for minutes; sums are in memory, and the encoding is expensive.
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

    /// Sizes for NVIDIA's GPUs and for GPUs of unknown vendors. The deviations of the next two follow from their compilers'
    /// statistics (docs/tried.md).
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

    /// Sizes for AMD's GPUs: unrolled, the forward pass has twice as many instructions.
    pub const AMD: MatrixTuning = MatrixTuning { unroll_forward: false, ..MatrixTuning::NVIDIA };

    /// Sizes for Intel's GPUs: registers are few, and spilling costs more than memory traffic.
    pub const INTEL: MatrixTuning = MatrixTuning {
        largest_tile: 64,
        unroll_forward: false,
        pairs: false,
        backward_sums: 16,
        backward_lanes: 1024,
        recompute: false,
        ..MatrixTuning::NVIDIA
    };

    /// Chooses sizes for a device.
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
    /// Computation path of the network's layers.
    pub layers: Layers,
    /// Access of the kernels to weights and activations in f32.
    pub operands: Operands,
    /// Invocations of a workgroup of the layer kernels.
    pub layer_lanes: u32,
    /// Invocations of a workgroup of the weight-gradient kernels.
    pub weight_lanes: u32,
    /// Number of parts that the samples are split into for weight gradients.
    pub splits: u32,
    /// Sizes of the passes on matrices.
    pub matrices: MatrixTuning,
    /// Invocations of a workgroup of the kernels that march along rays. All of them share one ray if each gets at least one of
    /// its samples; otherwise each ray has `ray_lanes`, and the workgroup has as many rays as fit.
    pub march_lanes: u32,
    /// Invocations that share a ray of few samples. The search for live samples always uses this number.
    pub ray_lanes: u32,
    /// Shared memory in which a workgroup may sum the static field's lines before they go to memory, bytes.
    pub private_line_bytes: u32,
    /// Maximum number of samples handled at once; the configuration may ask for fewer.
    pub chunk_samples: u32,
    /// Maximum number of iterations handed to the device at once, in place of the configuration's number.
    pub iterations_per_submit: Option<u32>,
    /// Longest submit, seconds; none where no watchdog limits it.
    pub longest_submit_s: Option<f64>,
    /// Whether validation and saving run concurrently with training instead of between iterations.
    pub overlap: bool,
    /// One sentence per choice.
    pub reasons: Vec<String>,
}

/// Returns the workgroups that keep a device busy when the driver does not report its number of multiprocessors. Too many
/// workgroups would write and add up partial sums for nothing.
fn workgroups_untold(info: &DeviceInfo) -> u32 {
    match (info.kind, info.vendor) {
        (DeviceKind::Integrated, _) => 32,
        // Two workgroups for each of the 32 cores of the largest devices.
        (_, Vendor::Intel) => 64,
        _ => 264,
    }
}

/// Number of partial sums from which on several invocations add them up.
const MANY_SPLITS: u32 = 64;

impl Tuning {
    /// Chooses sizes and variants for a device.
    pub fn for_device(info: &DeviceInfo) -> Tuning {
        let old_lavapipe = info.is_llvmpipe && info.mesa_major.is_some_and(|v| v < 24);
        let mut reasons = Vec::new();
        let (operands, why) = if old_lavapipe {
            (
                Operands::Texel,
                "operands through texel buffers, because this llvmpipe reads storage buffers lane by lane",
            )
        } else if info.is_llvmpipe && info.buffer_device_address {
            (Operands::Address, "operands through addresses, which avoids bounds checks of this llvmpipe")
        } else {
            (Operands::Storage, "operands through storage buffers")
        };
        reasons.push(why.to_owned());
        let (layer_lanes, weight_lanes, splits) = if info.is_llvmpipe {
            reasons.push(
                "one subgroup per workgroup and few splits, because a CPU executes few workgroups at a time".into(),
            );
            (info.subgroup_size.clamp(4, 16), info.subgroup_size.clamp(4, 16), 4)
        } else {
            (64, 32, 16)
        };
        let shape = matrix_shape(info);
        let (layers, why) = match shape {
            None => (Layers::F32, format!("f32 layers, because {}", why_no_matrices())),
            Some(_) if info.is_cpu() => (
                Layers::F32,
                "f32 layers, because a CPU emulates cooperative matrices, which is several times slower".to_owned(),
            ),
            Some(s) if !s.f16_sums => (
                Layers::F32,
                "f32 layers, because cooperative matrices without f16 sums need copies through shared memory"
                    .to_owned(),
            ),
            Some(s) => (Layers::Matrices, format!("matrix layers, {}x{}x{}: f16 operands, f32 sums", s.m, s.n, s.k)),
        };
        reasons.push(why);
        let f16_sums = shape.is_some_and(|s| s.f16_sums);
        let matrices = MatrixTuning { f16_sums, ..MatrixTuning::for_device(info) };
        // Some kilobytes per sample must fit beside everything else. The limit depends on total memory, not on free memory:
        // other chunks round a batch's sums differently, and runs on one device must repeat bit by bit.
        let chunk_samples = match info.kind {
            DeviceKind::Cpu => 1 << 17,
            _ => (info.device_memory >> 14).clamp(1 << 16, 1 << 19) as u32,
        };
        let overlap = !info.is_cpu();
        // A multiprocessor holds few workgroups, so that workgroups of one subgroup would leave it two thirds empty.
        let ray_lanes = MarchLoss::LOCAL_SIZE;
        let march_lanes = if info.is_cpu() { ray_lanes } else { 2 * ray_lanes };
        // Shared memory is no faster on a CPU.
        let private_line_bytes = if info.is_cpu() { 0 } else { info.max_shared_memory / 2 };
        // Kernels that read through texel buffers have no variants with 64-bit integers.
        let bits = if info.int64_atomics && operands != Operands::Texel { 64 } else { 32 };
        let lines = if private_line_bytes == 0 { "" } else { ", with lines summed in shared memory first" };
        reasons.push(format!("static gradients by {bits}-bit integer atomics{lines}, so sums are exact"));
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

    /// Tells whether matrices may be faster on a device, so that timing both paths is worthwhile.
    pub fn has_choice(info: &DeviceInfo) -> bool {
        !info.is_cpu() && matrix_shape(info).is_some()
    }

    /// Returns `line_params` if that many sums fit the shared memory reserved for them, else 0; this is `private_lines` of
    /// `march_loss`.
    pub(super) fn private_lines(&self, line_params: u32) -> u32 {
        if 8 * line_params <= self.private_line_bytes { line_params } else { 0 }
    }

    /// Returns how `march_loss` and `march_fwd` distribute rays with `n_samples` samples of the static field.
    pub(super) fn rays_with(&self, n_samples: u32) -> RayLanes {
        self.rays_of(if n_samples < self.march_lanes { self.ray_lanes } else { self.march_lanes })
    }

    /// Returns how kernels that give `lanes` invocations to a ray distribute rays.
    pub(super) fn rays_of(&self, lanes: u32) -> RayLanes {
        RayLanes { lanes, rays: (self.march_lanes / lanes).max(1) }
    }

    /// Number of invocations that add up the partial sums of one number of the network's gradient.
    pub(crate) fn gradient_parts(&self) -> u32 {
        let splits = match self.layers {
            Layers::F32 => self.splits,
            Layers::Matrices => self.matrices.workgroups,
        };
        if splits < MANY_SPLITS { 1 } else { 8 }
    }

    /// Returns this tuning with another path of the layers, for the reason given.
    pub fn with_layers(mut self, layers: Layers, reason: String) -> Tuning {
        self.layers = layers;
        self.reasons.retain(|r| !r.contains("layers"));
        self.reasons.push(reason);
        self
    }

    /// Returns this tuning, with the simplest path of the layers where the network is never evaluated.
    pub fn for_network(self, asked: bool) -> Tuning {
        if asked {
            self
        } else {
            self.with_layers(Layers::F32, "no layers, because the network is not evaluated".into())
        }
    }

    /// Number of samples that one workgroup of the layer kernels covers.
    pub fn tile_samples(&self) -> u32 {
        self.layer_lanes * self.tile().samples
    }

    /// Returns the register tile of a lane of the layer kernels.
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
    /// Samples that a lane of `mlp_layer_fwd` and `mlp_layer_bwd_input` keeps.
    pub samples: u32,
    /// Neurons that a lane of `mlp_layer_fwd` keeps.
    pub fwd_neurons: u32,
    /// Inputs that a lane of `mlp_layer_bwd_input` keeps.
    pub bwd_inputs: u32,
    /// Neurons that a lane of `mlp_layer_bwd_weight` keeps.
    pub weight_neurons: u32,
    /// Inputs that a lane of `mlp_layer_bwd_weight` keeps.
    pub weight_inputs: u32,
}
