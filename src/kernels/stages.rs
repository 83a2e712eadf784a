//! The compute stages. A stage has the same name everywhere: shader file, field of [`Kernels`], CPU twin, debug label and bench
//! row. Buffers are found by their names in the shaders.

use crate::error::{Error, Result};
use crate::gpu::buffer::Operands;
use crate::gpu::capabilities::{DeviceInfo, MatrixShape};
use crate::gpu::device::Gpu;
use crate::gpu::pipeline::{BindingCode, BindingKind, KernelCode, Pipeline};
use crate::gpu::record::{Groups, MAX_GROUPS};
use crate::kernels::push::{self, PushConstants};
use crate::kernels::tuning::{Layers, Tuning};
use std::collections::BTreeSet;
use std::marker::PhantomData;
use std::sync::Arc;

include!(concat!(env!("OUT_DIR"), "/table.rs"));

/// Reason why a build has no kernels on cooperative matrices, and its remedy.
pub const NO_MATRIX_KERNELS: &str = "this build has no kernels on cooperative matrices (its shaderc does not know them: run \
                                     tools/shaderc, which makes one that does, and build again)";

/// Tells whether this build has the kernels on cooperative matrices; see [`NO_MATRIX_KERNELS`].
pub fn has_matrix_kernels() -> bool {
    KERNEL_TABLE.iter().all(|kernel| !kernel.spirv.is_empty())
}

/// Returns the shape of the cooperative matrices that kernels of this build use on a device; none where the device has none, or the
/// build has no kernels for them.
pub fn matrix_shape(info: &DeviceInfo) -> Option<MatrixShape> {
    info.matrices.first().copied().filter(|_| has_matrix_kernels())
}

/// Returns the reason why there are no matrix layers on a device for which [`matrix_shape`] returns none.
pub fn why_no_matrices() -> &'static str {
    match has_matrix_kernels() {
        true => "the device has no cooperative matrices that our kernels can use",
        false => NO_MATRIX_KERNELS,
    }
}

/// Finds a compiled kernel by its name, variants included.
///
/// # Errors
/// [`Error::Internal`] for a name that no kernel has.
pub fn kernel_code(name: &str) -> Result<&'static KernelCode> {
    KERNEL_TABLE.iter().find(|k| k.name == name).ok_or_else(|| Error::Internal(format!("there is no kernel `{name}`")))
}

/// Returns the names of all shaders; variants are not counted separately.
pub fn shaders() -> BTreeSet<&'static str> {
    KERNEL_TABLE.iter().map(|code| code.shader).collect()
}

/// Pipeline of the shader whose push constants are `P`; clones share it.
pub struct Stage<P> {
    pipeline: Arc<Pipeline>,
    push: PhantomData<P>,
}

impl<P> Clone for Stage<P> {
    fn clone(&self) -> Stage<P> {
        Stage { pipeline: self.pipeline.clone(), push: PhantomData }
    }
}

impl<P: PushConstants> Stage<P> {
    pub(super) fn pipeline(&self) -> &Arc<Pipeline> {
        &self.pipeline
    }

    /// Invocations of a workgroup.
    pub fn local_size(&self) -> u32 {
        self.pipeline.local_size
    }

    /// Returns the workgroups for `n` invocations.
    pub fn groups_for(&self, n: u32) -> Groups<'static> {
        Groups::Direct([n.div_ceil(self.local_size()).max(1), 1, 1])
    }

    /// Returns the workgroups for any number `n` of invocations of a shader that counts them by `inc/workgroup.glsl`.
    pub fn groups_over(&self, n: u32) -> Groups<'static> {
        along_two_axes(n.div_ceil(self.local_size()))
    }
}

/// Returns at least `groups` workgroups, spread over two axes where one axis does not take them all.
pub fn along_two_axes(groups: u32) -> Groups<'static> {
    let rows = groups.div_ceil(MAX_GROUPS).max(1);
    Groups::Direct([groups.div_ceil(rows).max(1), rows, 1])
}

/// Options of building a stage; the defaults are those of its shader.
#[derive(Debug, Clone, Copy, Default)]
pub struct Build<'a> {
    /// Suffix of the shader's variant in `glsl/variants.txt`.
    pub variant: &'a str,
    /// Invocations of a workgroup.
    pub lanes: Option<u32>,
    /// Values of specialisation constants.
    pub constants: &'a [(&'a str, u32)],
    /// Whether the stage needs full subgroups, for cooperative matrices.
    pub matrices: bool,
    /// Whether the shader also has a variant whose lanes exchange values within full subgroups; it is used on devices that have
    /// them.
    pub exchanges: bool,
    /// Whether the shader also has variants that add 64-bit integers to memory; they are used on devices that support it.
    pub int64: bool,
}

/// Returns the subgroup size for a workgroup of `lanes` invocations, if the subgroups can be full and exchange values.
pub fn full_subgroup(gpu: &Gpu, lanes: u32) -> Option<u32> {
    let info = gpu.info();
    let fits = |size: &u32| lanes.is_multiple_of(*size) && lanes / size <= info.max_workgroup_subgroups;
    [info.full_subgroups, info.small_subgroups].into_iter().flatten().find(fits)
}

/// Suffix of variants whose lanes exchange values.
const EXCHANGING: &str = "_subgroup";
/// Suffix of variants that add 64-bit integers to memory; it follows [`EXCHANGING`].
const INT64: &str = "_int64";

impl Build<'_> {
    /// Builds the stage.
    ///
    /// # Errors
    /// Errors of [`Gpu::pipeline`].
    pub fn stage<P: PushConstants>(self, gpu: &Gpu) -> Result<Stage<P>> {
        // Some devices do not take workgroups as large as some shaders' default; these shaders work with any power of two.
        let lanes = self.lanes.unwrap_or(P::LOCAL_SIZE.min(power_of_two_below(gpu.info().max_workgroup_invocations)));
        // Variants with texel buffers are for old drivers, which do not exchange values or add 64-bit integers efficiently.
        let is_plain = self.variant.is_empty();
        let subgroup = full_subgroup(gpu, lanes).filter(|_| self.exchanges && is_plain);
        let variant = if subgroup.is_some() { EXCHANGING } else { self.variant };
        let integers = if self.int64 && is_plain && gpu.info().int64_atomics { INT64 } else { "" };
        let code = kernel_code(&format!("{}{variant}{integers}", P::SHADER))?;
        if code.spirv.is_empty() {
            return Err(Error::config("layers", "matrices", NO_MATRIX_KERNELS));
        }
        let pipeline = if self.matrices {
            gpu.matrix_pipeline(code, lanes, self.constants)?
        } else if let Some(size) = subgroup {
            gpu.subgroup_pipeline(code, lanes, size, self.constants)?
        } else {
            gpu.pipeline(code, lanes, self.constants)?
        };
        Ok(Stage { pipeline, push: PhantomData })
    }
}

/// Returns the largest power of two that is not larger than `n`.
fn power_of_two_below(n: u32) -> u32 {
    1 << n.max(1).ilog2()
}

/// Pipelines of every path.
pub struct Kernels {
    /// Tuning that the pipelines were built with.
    pub tuning: Tuning,
    /// Rays per workgroup of `march_count` and `march_emit`.
    pub rays_counted: u32,
    /// Rays per workgroup of `march_loss` and `march_fwd`.
    pub rays_marched: u32,
    /// Draws the rays of an iteration.
    pub batch: Stage<push::Batch>,
    /// Sets up the rays of a pose, for rendering.
    pub pose_rays: Stage<push::PoseRays>,
    /// Counts live dynamic samples.
    pub march_count: Stage<push::MarchCount>,
    /// Computes sample offsets and indirect arguments.
    pub march_scan: Stage<push::MarchScan>,
    /// Writes live samples.
    pub march_emit: Stage<push::MarchEmit>,
    /// Computes line integrals, residuals and their gradients, and scatters the gradients to planes and lines.
    pub march_loss: Stage<push::MarchLoss>,
    /// Computes line integrals and maxima, for rendering.
    pub march_fwd: Stage<push::MarchFwd>,
    /// Writes cells of the dynamic field.
    pub volume_dynamic: Stage<push::VolumeDynamic>,
    /// Writes cells of the static field.
    pub volume_static: Stage<push::VolumeStatic>,
    /// Computes line integrals and maxima of baked volumes.
    pub baked_march: Stage<push::BakedMarch>,
    /// Computes the gradients of biases, latent weights and latents.
    pub mlp_latent_bwd: Stage<push::MlpLatentBwd>,
    /// Computes the gradient of the static field, with its total variation.
    pub gradient_static: Stage<push::GradientStatic>,
    /// Computes the gradient of the network.
    pub gradient_network: Stage<push::GradientNetwork>,
    /// Updates the parameters (optimiser).
    pub adam: Stage<push::Adam>,
    /// Reports losses; updates loss scale and step count.
    pub report: Stage<push::Report>,
}

impl Kernels {
    /// Builds the pipelines for a static field with `line_params` numbers on its lines, which is evaluated at `static_samples`
    /// samples of each ray.
    ///
    /// # Errors
    /// Errors of [`Gpu::pipeline`].
    pub fn new(gpu: &Gpu, tuning: Tuning, line_params: u32, static_samples: u32) -> Result<Kernels> {
        let plain = Build::default();
        let vec4 = Build { variant: vec4_variant(&tuning), ..plain };
        let sums = Build { exchanges: true, ..plain };
        let (counted, marched) = (tuning.rays_of(tuning.ray_lanes), tuning.rays_with(static_samples));
        let (count_rays, march_rays) = (counted.constant(), marched.constant());
        let counting = Build { lanes: counted.workgroup(), constants: &count_rays, ..plain };
        let marching = Build { lanes: marched.workgroup(), constants: &march_rays, exchanges: true, ..vec4 };
        let loss = [march_rays[0], ("private_lines", tuning.private_lines(line_params))];
        let parts = [("parts", tuning.gradient_parts())];
        let loss_scaling = [("loss_scaling", u32::from(tuning.layers == Layers::Matrices))];
        Ok(Kernels {
            batch: plain.stage(gpu)?,
            pose_rays: plain.stage(gpu)?,
            march_count: Build { exchanges: true, ..counting }.stage(gpu)?,
            march_scan: sums.stage(gpu)?,
            march_emit: counting.stage(gpu)?,
            march_loss: Build { constants: &loss, int64: true, ..marching }.stage(gpu)?,
            march_fwd: marching.stage(gpu)?,
            volume_dynamic: plain.stage(gpu)?,
            volume_static: vec4.stage(gpu)?,
            baked_march: plain.stage(gpu)?,
            mlp_latent_bwd: plain.stage(gpu)?,
            gradient_static: sums.stage(gpu)?,
            gradient_network: Build { constants: &parts, ..plain }.stage(gpu)?,
            adam: plain.stage(gpu)?,
            report: Build { constants: &loss_scaling, ..sums }.stage(gpu)?,
            rays_counted: counted.rays,
            rays_marched: marched.rays,
            tuning,
        })
    }
}

/// Pipelines of a static field that is a network.
pub struct StaticNetworkKernels {
    /// Computes line integrals of two networks, and maxima.
    pub march_fwd_samples: Stage<push::MarchFwdSamples>,
    /// Computes the losses of two networks and their gradient at each sample.
    pub loss_samples: Stage<push::LossSamples>,
}

impl StaticNetworkKernels {
    /// Builds the pipelines.
    ///
    /// # Errors
    /// Errors of [`Gpu::pipeline`].
    pub fn new(gpu: &Gpu) -> Result<StaticNetworkKernels> {
        let sums = Build { exchanges: true, ..Build::default() };
        Ok(StaticNetworkKernels { march_fwd_samples: sums.stage(gpu)?, loss_samples: sums.stage(gpu)? })
    }
}

/// Pipelines of the f32 network.
pub struct LayerKernels {
    /// Tuning that the pipelines were built with.
    pub tuning: Tuning,
    /// Computes bias plus latent contribution, one row per phase.
    pub mlp_latent_fwd: Stage<push::MlpLatentFwd>,
    /// Computes the positional encoding.
    pub encode: Stage<push::Encode>,
    /// Computes one hidden layer.
    pub mlp_layer_fwd: Stage<push::MlpLayerFwd>,
    /// Computes output neuron and activation.
    pub mlp_out_fwd: Stage<push::MlpOutFwd>,
    /// Computes the gradient at the output neuron.
    pub mlp_out_bwd: Stage<push::MlpOutBwd>,
    /// Computes the weight gradient of the output neuron.
    pub mlp_out_bwd_weight: Stage<push::MlpOutBwdWeight>,
    /// Computes the gradient to a layer's hidden input.
    pub mlp_layer_bwd_input: Stage<push::MlpLayerBwdInput>,
    /// Computes the weight gradient of a hidden layer.
    pub mlp_layer_bwd_weight: Stage<push::MlpLayerBwdWeight>,
    /// Sums over each ray's samples.
    pub mlp_ray_sum: Stage<push::MlpRaySum>,
    /// Sums over each phase's rays.
    pub mlp_phase_sum: Stage<push::MlpPhaseSum>,
}

impl LayerKernels {
    /// Builds the pipelines.
    ///
    /// # Errors
    /// Errors of [`Gpu::pipeline`].
    pub fn new(gpu: &Gpu, tuning: Tuning) -> Result<LayerKernels> {
        let plain = Build::default();
        let vec4 = Build { variant: vec4_variant(&tuning), ..plain };
        let layer = Build { variant: layer_variant(&tuning), lanes: Some(tuning.layer_lanes), ..plain };
        let weight_lanes = Some(tuning.weight_lanes);
        Ok(LayerKernels {
            mlp_latent_fwd: plain.stage(gpu)?,
            encode: plain.stage(gpu)?,
            mlp_layer_fwd: layer.stage(gpu)?,
            mlp_out_fwd: vec4.stage(gpu)?,
            mlp_out_bwd: vec4.stage(gpu)?,
            mlp_out_bwd_weight: Build { lanes: weight_lanes, exchanges: true, ..vec4 }.stage(gpu)?,
            mlp_layer_bwd_input: layer.stage(gpu)?,
            mlp_layer_bwd_weight: Build { lanes: weight_lanes, ..layer }.stage(gpu)?,
            mlp_ray_sum: vec4.stage(gpu)?,
            mlp_phase_sum: Build { lanes: weight_lanes, exchanges: true, ..plain }.stage(gpu)?,
            tuning,
        })
    }
}

/// Returns the variant of the shaders that read arrays of vec4. Reading through addresses only matters for the layers' time.
pub(crate) fn vec4_variant(tuning: &Tuning) -> &'static str {
    if tuning.operands == Operands::Texel { "_texel" } else { "" }
}

/// Returns the variant of the layers' shaders.
fn layer_variant(tuning: &Tuning) -> &'static str {
    match tuning.operands {
        Operands::Storage => "",
        Operands::Texel => "_texel",
        Operands::Address => "_address",
    }
}
