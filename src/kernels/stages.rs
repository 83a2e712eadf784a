//! The compute stages. A stage has one name everywhere: shader file, field of [`Kernels`], CPU twin,
//! debug label and bench row. Buffers are found by the names the shaders give them.

use crate::error::{Error, Result};
use crate::gpu::device::Gpu;
use crate::gpu::memory::Operands;
use crate::gpu::pipeline::{BindingCode, BindingKind, KernelCode, Pipeline};
use crate::kernels::tuning::{Layers, Tuning};
use std::sync::Arc;

include!(concat!(env!("OUT_DIR"), "/table.rs"));

/// Inputs a lane of `mlp_layer_bwd_weight` keeps; `INPUTS` there.
pub const WEIGHT_INPUTS: u32 = 4;
/// Lanes that share the depths of a ray in `march_count` and `march_emit`.
pub const MARCH_LANES: u32 = 32;

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
