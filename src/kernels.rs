//! The compute stages. A stage has one name everywhere: shader file, field of [`Kernels`], CPU twin,
//! debug label and bench row. Buffers are found by the names the shaders give them.

use crate::error::{Error, Result};
use crate::gpu::capabilities::DeviceInfo;
use crate::gpu::device::Gpu;
use crate::gpu::memory::{Buffer, Operands};
use crate::gpu::pipeline::{BindingCode, BindingKind, KernelCode, Pipeline};
use crate::gpu::record::{Bound, Groups, Recording};
use crate::gpu::volume::Volume;
use bytemuck::Pod;
use serde::Serialize;
use std::collections::HashMap;
use std::sync::Arc;

include!(concat!(env!("OUT_DIR"), "/kernel_table.rs"));

/// Inputs a lane of `mlp_layer_bwd_weight` keeps; `INPUTS` there.
pub const WEIGHT_INPUTS: u32 = 4;
/// Lanes that share the depths of a ray in `march_count` and `march_emit`.
pub const MARCH_LANES: u32 = 32;

/// How the network's layers are computed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, clap::ValueEnum)]
#[serde(rename_all = "snake_case")]
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
    /// Unroll the loops over the inner dimension: operands stay in registers, compilation takes longer.
    pub unroll: bool,
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
    /// Shared memory in which a workgroup may sum the static field's lines before they go to memory, bytes.
    pub private_line_bytes: u32,
    /// Samples handled at once, at most; the configuration may ask for fewer.
    pub chunk_samples: u32,
    /// Validate and save beside training instead of between iterations.
    pub overlap: bool,
    /// One sentence per choice.
    pub reasons: Vec<String>,
}

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
            Some(_) if info.kind == "cpu" => {
                (Layers::F32, "f32 layers: a CPU emulates cooperative matrices, several times slower".to_owned())
            }
            Some(s) => (Layers::Matrices, format!("matrix layers, {}x{}x{}: f16 operands, f32 sums", s.m, s.n, s.k)),
        };
        reasons.push(why);
        let matrices = match info.multiprocessors {
            // Unrolled, a CPU driver compiles these kernels for minutes.
            _ if info.kind == "cpu" => MatrixTuning { workgroups: 4, largest_tile: 32, unroll: false },
            // Two workgroups per multiprocessor; 132 of them where the driver does not tell their number.
            n => MatrixTuning { workgroups: if n == 0 { 264 } else { 2 * n }, largest_tile: 128, unroll: true },
        };
        // Some kilobytes per sample must fit beside all else.
        let chunk_samples = match info.kind {
            "cpu" => 1 << 17,
            _ => (info.device_memory >> 14).clamp(1 << 16, 1 << 19) as u32,
        };
        let overlap = info.kind != "cpu";
        // Shared memory is no faster on a CPU.
        let private_line_bytes = if info.kind == "cpu" { 0 } else { info.max_shared_memory / 2 };
        reasons.push(match private_line_bytes {
            0 => "static gradients through 32-bit integer atomics: exact sums, no float atomics needed".into(),
            _ => "static gradients through 32-bit integer atomics, lines in shared memory first: exact sums".into(),
        });
        Tuning {
            layers,
            operands,
            layer_lanes,
            weight_lanes,
            splits,
            matrices,
            private_line_bytes,
            chunk_samples,
            overlap,
            reasons,
        }
    }

    /// `line_params` if that many sums fit the shared memory set aside for them, else 0; `private_lines` of `march_bwd`.
    fn private_lines(&self, line_params: u32) -> u32 {
        if 8 * line_params <= self.private_line_bytes { line_params } else { 0 }
    }

    /// With the layers on another path, for the reason given.
    pub fn with_layers(mut self, layers: Layers, reason: String) -> Tuning {
        self.layers = layers;
        self.reasons.retain(|r| !r.contains("layers"));
        self.reasons.push(reason);
        self
    }

    /// Samples one workgroup of the layer kernels covers.
    pub fn tile_samples(&self) -> u32 {
        self.layer_lanes * self.tile().samples
    }

    /// What a lane of the layer kernels keeps in registers; the defines of `glsl/variants.txt`.
    pub fn tile(&self) -> LaneTile {
        match self.operands {
            Operands::Storage => LaneTile { samples: 4, fwd_neurons: 16, bwd_inputs: 16, weight_neurons: 16 },
            Operands::Texel => LaneTile { samples: 8, fwd_neurons: 16, bwd_inputs: 16, weight_neurons: 32 },
            Operands::Address => LaneTile { samples: 4, fwd_neurons: 32, bwd_inputs: 32, weight_neurons: 32 },
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
}

/// Buffers under the names the shaders use.
#[derive(Clone, Default)]
pub struct Buffers {
    by_name: HashMap<&'static str, Buffer>,
    volumes: HashMap<&'static str, Volume>,
}

impl Buffers {
    /// Adds or replaces a buffer.
    pub fn set(&mut self, name: &'static str, buffer: Buffer) {
        self.by_name.insert(name, buffer);
    }

    /// Adds or replaces a volume.
    pub fn set_volume(&mut self, name: &'static str, volume: Volume) {
        self.volumes.insert(name, volume);
    }

    fn volume(&self, name: &str) -> Result<&Volume> {
        self.volumes.get(name).ok_or_else(|| Error::Internal(format!("no volume is called `{name}`")))
    }

    /// A buffer by name.
    ///
    /// # Errors
    /// [`Error::Internal`] when it was never set.
    pub fn get(&self, name: &str) -> Result<&Buffer> {
        self.by_name.get(name).ok_or_else(|| Error::Internal(format!("no buffer is called `{name}`")))
    }
}

/// Finds a compiled kernel by its name.
///
/// # Errors
/// [`Error::Internal`] for an unknown name.
pub fn kernel_code(name: &str) -> Result<&'static KernelCode> {
    KERNEL_TABLE.iter().find(|k| k.name == name).ok_or_else(|| Error::Internal(format!("no kernel is called `{name}`")))
}

macro_rules! stages {
    ($(#[$about:meta])* $name:ident { $($(#[$doc:meta])* $stage:ident($local:expr, $variant:ident $(, $spec:expr)?);)* }) => {
        $(#[$about])*
        pub struct $name {
            /// Choices they were built with.
            pub tuning: Tuning,
            $($(#[$doc])* pub $stage: Arc<Pipeline>,)*
        }

        impl $name {
            /// Builds the pipelines; `line_params` are the numbers on the lines of the static field.
            ///
            /// # Errors
            /// Errors of [`Gpu::pipeline`].
            pub fn new(gpu: &Gpu, tuning: Tuning, line_params: u32) -> Result<$name> {
                let t = &tuning;
                let make = |name: &str, variant: &str, local: u32, spec: &[(&str, u32)]| {
                    let code = kernel_code(&format!("{name}{variant}"))?;
                    gpu.pipeline(code, local, spec).map(Arc::new)
                };
                Ok($name {
                    $($stage: {
                        let local: fn(&Tuning) -> u32 = $local;
                        #[allow(unused_mut, unused_assignments, reason = "only some stages have constants")]
                        let mut spec: fn(&Tuning, u32) -> Vec<(&'static str, u32)> = |_, _| Vec::new();
                        $(spec = $spec;)?
                        make(stages!(@name $stage), stages!(@$variant t), local(t), &spec(t, line_params))?
                    },)*
                    tuning,
                })
            }
        }
    };
    (@name march_fwd_maxima) => { "march_fwd" };
    (@name $stage:ident) => { stringify!($stage) };
    (@plain $t:ident) => { "" };
    // Reads vec4 arrays; only the layers' time depends on doing so through addresses.
    (@operands $t:ident) => { if $t.operands == Operands::Texel { "_texel" } else { "" } };
    (@layers $t:ident) => {
        match $t.operands {
            Operands::Storage => "",
            Operands::Texel => "_texel",
            Operands::Address => "_address",
        }
    };
}

stages! {
    /// Pipelines of every path.
    Kernels {
        /// Draws the rays of an iteration.
        batch(|_| 64, plain);
        /// Rays of a pose, for rendering.
        pose_rays(|_| 64, plain);
        /// Counts live dynamic samples.
        march_count(|_| MARCH_LANES, plain);
        /// Offsets and indirect arguments.
        march_scan(|_| 256, plain);
        /// Writes live samples.
        march_emit(|_| MARCH_LANES, plain);
        /// Notes which cells are empty.
        occupancy_mark(|_| 64, plain);
        /// Prepares the next epoch's notes.
        occupancy_clear(|_| 64, plain);
        /// Line integrals.
        march_fwd(|_| 32, operands);
        /// Line integrals and maxima, for rendering.
        march_fwd_maxima(|_| 32, operands, |_, _| vec![("with_maxima", 1)]);
        /// Cells of the dynamic field.
        volume_dynamic(|_| 64, plain);
        /// Cells of the static field.
        volume_static(|_| 64, operands);
        /// Line integrals and maxima of baked volumes.
        baked_march(|_| 64, plain);
        /// Residuals and their gradients.
        loss(|_| 64, plain);
        /// Scatter to planes and lines.
        march_bwd(|_| 32, operands, |t, line_params| vec![("private_lines", t.private_lines(line_params))]);
        /// Bias and latent, one row per phase.
        mlp_latent_fwd(|_| 64, plain);
        /// Gradients of biases, latent weights and latents.
        mlp_latent_bwd(|_| 64, plain);
        /// Gradient of the static field.
        gradient_static(|_| 64, plain);
        /// Gradient of the network.
        gradient_network(|_| 64, plain);
        /// Total variation.
        reg_tv(|_| 64, plain);
        /// The optimiser.
        adam(|_| 64, plain);
        /// Losses, loss scale and step count.
        report(|_| 256, plain, |t, _| vec![("loss_scaling", u32::from(t.layers == Layers::Matrices))]);
    }
}

stages! {
    /// Pipelines of the f32 network.
    LayerKernels {
        /// Positional encoding.
        encode(|_| 64, plain);
        /// One hidden layer.
        mlp_layer_fwd(|t| t.layer_lanes, layers);
        /// Output neuron and activation.
        mlp_out_fwd(|_| 64, operands);
        /// Gradient at the output neuron.
        mlp_out_bwd(|_| 64, operands);
        /// Weight gradient of the output neuron.
        mlp_out_bwd_weight(|t| t.weight_lanes, operands);
        /// Gradient to a layer's hidden input.
        mlp_layer_bwd_input(|t| t.layer_lanes, layers);
        /// Weight gradient of a hidden layer.
        mlp_layer_bwd_weight(|t| t.weight_lanes, layers);
        /// Sums over each ray's samples.
        mlp_ray_sum(|_| 64, operands);
        /// Sums over each phase's rays.
        mlp_phase_sum(|t| t.weight_lanes, plain);
    }
}

/// Records `stage`, binding each buffer its shader names from `buffers`; `renamed` takes precedence.
///
/// # Errors
/// Errors of [`Recording::dispatch`].
pub fn dispatch<P: Pod>(
    recording: &mut Recording,
    stage: &Arc<Pipeline>,
    groups: Groups<'_>,
    buffers: &Buffers,
    renamed: &[(&str, &str)],
    push: P,
) -> Result<()> {
    let bound = stage
        .bindings()
        .iter()
        .map(|b| {
            let source = renamed.iter().find(|(shader, _)| *shader == b.name).map_or(b.name, |(_, name)| name);
            Ok((
                b.name,
                match b.kind {
                    BindingKind::Volume => Bound::Volume(buffers.volume(source)?),
                    _ => Bound::Buffer(buffers.get(source)?),
                },
            ))
        })
        .collect::<Result<Vec<_>>>()?;
    recording.dispatch(stage, groups, &bound, &push)
}

/// `n` invocations in workgroups of `pipeline`'s size.
pub fn groups_for(pipeline: &Pipeline, n: u32) -> Groups<'static> {
    Groups::Direct([n.div_ceil(pipeline.local_size).max(1), 1, 1])
}
