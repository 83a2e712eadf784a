//! The Lineformer on a chunk of samples, layer by layer: forward to attenuation, and backward to the features' gradient.
//!
//! Vectors of 32 numbers of all samples of a chunk lie in one buffer (`inc/lineformer_layout.glsl` lists them); features stay
//! in the buffer of the grid's stages.

use crate::error::Result;
use crate::gpu::device::Gpu;
use crate::gpu::record::Groups;
use crate::kernels::constants as at;
use crate::kernels::push::{self, PushConstants, SaxLinear, SaxLinearBack};
use crate::kernels::stages::{Build, Stage, vec4_variant};
use crate::kernels::tuning::Tuning;
use crate::methods::sax_nerf::field::{SaxShape, WIDTH};

/// Length of a vec4; lengths of a vector and of a 32 x 32 matrix in vec4.
const LANES: u32 = 4;
const WIDTH4: u32 = WIDTH as u32 / LANES;
const SQUARE: u32 = WIDTH as u32 * WIDTH4;
/// Number of vectors of the feed-forward part.
const WIDE: u32 = 4;

/// Maximum number of samples of a chunk: all vectors of a backward pass take 105 MiB, less than the buffer size that every
/// device supports.
pub const MAX_SAMPLES: u32 = 16_384;
/// Number of samples that one workgroup sums for a gradient.
pub const PART_SAMPLES: u32 = 512;
/// Padding that makes strides no power of two, which avoids cache conflicts.
const PADDING: u32 = 8;

/// Returns the number of samples for which the vectors' buffer of a chunk of `n_samples` has room.
pub fn capacity(n_samples: u32) -> u32 {
    n_samples.min(MAX_SAMPLES) + PADDING
}

/// Returns the bytes of `n_vectors` vectors of a chunk.
pub fn vector_bytes(n_vectors: u32, capacity: u32) -> u64 {
    u64::from(n_vectors) * u64::from(capacity) * 4 * WIDTH as u64
}

/// Range of samples that a chunk consists of, and the place of its first sample along its ray.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Chunk {
    /// Index of the first sample among those with features.
    pub first: u32,
    /// Number of samples.
    pub n: u32,
    /// Place of the first sample along its ray.
    pub along: u32,
}

/// Returns the chunks of `n_rays` rays of `row` samples, each of at most [`MAX_SAMPLES`]: whole rays, or parts of a ray with
/// an even number of samples, so that pairs stay together.
pub fn chunks(n_rays: u32, row: u32) -> Vec<Chunk> {
    if row > MAX_SAMPLES {
        let of_ray = |ray: u32| {
            let part = move |along: u32| Chunk { first: ray * row + along, n: MAX_SAMPLES.min(row - along), along };
            (0..row).step_by(MAX_SAMPLES as usize).map(part)
        };
        return (0..n_rays).flat_map(of_ray).collect();
    }
    let rays = MAX_SAMPLES / row;
    let chunk = |ray: u32| Chunk { first: ray * row, n: rays.min(n_rays - ray) * row, along: 0 };
    (0..n_rays).step_by(rays as usize).map(chunk).collect()
}

/// Pipelines of the forward pass.
pub struct LineformerKernels {
    linear: Stage<push::SaxLinear>,
    norm: Stage<push::SaxNorm>,
    attend: Stage<push::SaxAttend>,
    density: Stage<push::SaxDensity>,
}

/// Pipelines of the backward pass.
pub struct LineformerBackKernels {
    linear: Stage<push::SaxLinearBack>,
    norm: Stage<push::SaxNormBack>,
    attend: Stage<push::SaxAttendBack>,
    density: Stage<push::SaxDensityBack>,
    gradient: Stage<push::SaxLinearGradient>,
}

/// Returns the build options for a device: of stages on samples, and of stages on parameters.
fn builds(gpu: &Gpu) -> (Build<'static>, Build<'static>) {
    let tuning = Tuning::for_device(gpu.info());
    let plain = Build { variant: vec4_variant(&tuning), ..Build::default() };
    (Build { lanes: Some(tuning.layer_lanes), ..plain }, Build { lanes: Some(tuning.weight_lanes), ..plain })
}

impl LineformerKernels {
    /// Builds the pipelines.
    ///
    /// # Errors
    /// Errors of [`Gpu::pipeline`].
    pub fn new(gpu: &Gpu) -> Result<LineformerKernels> {
        let (samples, _) = builds(gpu);
        Ok(LineformerKernels {
            linear: samples.stage(gpu)?,
            norm: samples.stage(gpu)?,
            attend: samples.stage(gpu)?,
            density: samples.stage(gpu)?,
        })
    }
}

impl LineformerBackKernels {
    /// Builds the pipelines.
    ///
    /// # Errors
    /// Errors of [`Gpu::pipeline`].
    pub fn new(gpu: &Gpu) -> Result<LineformerBackKernels> {
        let (samples, numbers) = builds(gpu);
        Ok(LineformerBackKernels {
            linear: samples.stage(gpu)?,
            norm: samples.stage(gpu)?,
            attend: samples.stage(gpu)?,
            density: samples.stage(gpu)?,
            gradient: numbers.stage(gpu)?,
        })
    }
}

/// Records a stage and binds its other buffers beside the vectors.
pub trait Recorder {
    /// Records a dispatch.
    ///
    /// # Errors
    /// [`crate::error::Error::Internal`] when a stage and its buffers do not fit.
    fn run<P: PushConstants>(&mut self, stage: &Stage<P>, groups: Groups<'_>, push: P) -> Result<()>;

    /// Returns the number of samples per lane of the tiled stages, as compiled for this device.
    fn lane_samples(&self) -> u32;
}

/// The Lineformer on a chunk of samples.
#[derive(Debug, Clone, Copy)]
pub struct Lineformer {
    /// Sizes.
    pub shape: SaxShape,
    /// Number of samples for which the vectors' buffer has room.
    pub capacity: u32,
    /// Number of samples with features.
    pub n_all: u32,
    /// Samples of a ray.
    pub row: u32,
    /// The chunk.
    pub chunk: Chunk,
}

/// A matrix: index of its first number and stride between rows, vec4.
#[derive(Clone, Copy)]
struct Matrix {
    first: u32,
    stride: u32,
}

impl Lineformer {
    fn features4(&self) -> u32 {
        self.shape.n_features() as u32 / LANES
    }

    /// Returns the matrices of the first layer and of the joint layer, which sees the features and the block's output.
    fn outer(&self) -> [Matrix; 2] {
        let input = self.features4();
        let joint = at::LINEFORMER_INPUT + WIDTH as u32 * input;
        [Matrix { first: at::LINEFORMER_INPUT, stride: input }, Matrix { first: joint, stride: input + WIDTH4 }]
    }

    /// Returns a product of vectors, without features, bias or activation.
    fn linear(&self, to: u32, from: u32, columns: u32, weights: u32) -> SaxLinear {
        SaxLinear {
            n_samples: self.chunk.n,
            capacity: self.capacity,
            features4: 0,
            first_feature: self.chunk.first,
            feature_stride: self.n_all,
            from,
            columns,
            weights,
            bias: 0,
            has_bias: 0,
            added: at::SAX_NONE,
            to,
            activation: at::SAX_PLAIN,
            activated: at::SAX_NONE,
        }
    }

    fn run_linear(
        &self,
        run: &mut impl Recorder,
        stage: &Stage<SaxLinear>,
        vectors: u32,
        push: SaxLinear,
    ) -> Result<()> {
        let samples = stage.local_size() * run.lane_samples();
        let rows = vectors * WIDTH as u32 / at::sax_linear::OUTPUTS;
        run.run(stage, Groups::Direct([self.chunk.n.div_ceil(samples), rows, 1]), push)
    }

    fn each<P: PushConstants>(&self, run: &mut impl Recorder, stage: &Stage<P>, push: P) -> Result<()> {
        run.run(stage, stage.groups_for(self.chunk.n), push)
    }

    /// Records all layers except the last.
    ///
    /// # Errors
    /// Errors of [`Recorder::run`].
    pub fn layers(&self, run: &mut impl Recorder, kernels: &LineformerKernels) -> Result<()> {
        let (n_samples, capacity) = (self.chunk.n, self.capacity);
        let (linear, norm) = (&kernels.linear, &kernels.norm);
        let [input, joint] = self.outer();
        let features4 = self.features4();
        let with = |bias: u32, push: SaxLinear| SaxLinear { bias, has_bias: 1, ..push };
        let push = with(at::LINEFORMER_INPUT_BIAS, self.linear(at::SAX_X1, at::SAX_NONE, 0, input.first));
        self.run_linear(run, linear, 1, SaxLinear { features4, activation: at::SAX_LEAKY, ..push })?;
        let (from, to, scales) = (at::SAX_X1, at::SAX_NORMAL1, at::LINEFORMER_NORM1);
        self.each(run, norm, push::SaxNorm { n_samples, capacity, from, to, scales })?;
        self.run_linear(run, linear, 3, self.linear(at::SAX_QUERY, at::SAX_NORMAL1, WIDTH4, at::LINEFORMER_QUERY))?;
        let push = push::SaxAttend { n_samples, capacity, first: self.chunk.along, row: self.row };
        self.each(run, &kernels.attend, push)?;
        let push = with(at::LINEFORMER_OUT + SQUARE, self.linear(at::SAX_X2, at::SAX_SEEN, WIDTH4, at::LINEFORMER_OUT));
        self.run_linear(run, linear, 1, SaxLinear { added: at::SAX_X1, ..push })?;
        let (from, to, scales) = (at::SAX_X2, at::SAX_NORMAL2, at::LINEFORMER_NORM2);
        self.each(run, norm, push::SaxNorm { n_samples, capacity, from, to, scales })?;
        let gelu = |activated: u32, push: SaxLinear| SaxLinear { activation: at::SAX_GELU, activated, ..push };
        let push = self.linear(at::SAX_BEFORE_FIRST, at::SAX_NORMAL2, WIDTH4, at::LINEFORMER_EXPAND);
        self.run_linear(run, linear, WIDE, gelu(at::SAX_FIRST, push))?;
        let push = self.linear(at::SAX_BEFORE_SECOND, at::SAX_FIRST, WIDE * WIDTH4, at::LINEFORMER_MIX);
        self.run_linear(run, linear, WIDE, gelu(at::SAX_SECOND, push))?;
        let push = self.linear(at::SAX_BLOCK, at::SAX_SECOND, WIDE * WIDTH4, at::LINEFORMER_CONTRACT);
        self.run_linear(run, linear, 1, SaxLinear { added: at::SAX_X2, activation: at::SAX_LEAKY, ..push })?;
        let push = with(at::LINEFORMER_JOINT_BIAS, self.linear(at::SAX_X3, at::SAX_BLOCK, WIDTH4, joint.first));
        self.run_linear(run, linear, 1, SaxLinear { features4, activation: at::SAX_LEAKY, ..push })
    }

    /// Records attenuation, times `scale`, from these layers' results.
    ///
    /// # Errors
    /// Errors of [`Recorder::run`].
    pub fn density(
        &self,
        run: &mut impl Recorder,
        kernels: &LineformerKernels,
        first_out: u32,
        scale: f32,
    ) -> Result<()> {
        let push = push::SaxDensity { n_samples: self.chunk.n, capacity: self.capacity, first_out, scale };
        self.each(run, &kernels.density, push)
    }

    /// Returns a product with a transposed matrix, without an activation.
    fn back(&self, to: u32, columns: u32, (from, rows4): (u32, u32), matrix: Matrix) -> SaxLinearBack {
        SaxLinearBack {
            n_samples: self.chunk.n,
            capacity: self.capacity,
            first_feature: self.chunk.first,
            feature_stride: self.n_all,
            from,
            rows4,
            weights: matrix.first,
            stride: matrix.stride,
            other: from,
            other_rows4: 0,
            other_weights: matrix.first,
            other_stride: matrix.stride,
            to,
            columns,
            activation: at::SAX_PLAIN,
            slope_of: at::SAX_NONE,
        }
    }

    fn run_back(&self, run: &mut impl Recorder, stage: &Stage<SaxLinearBack>, push: SaxLinearBack) -> Result<()> {
        let samples = stage.local_size() * run.lane_samples();
        let tiles = push.columns.div_ceil(at::sax_linear_back::GROUPS);
        run.run(stage, Groups::Direct([self.chunk.n.div_ceil(samples), tiles, 1]), push)
    }

    /// Records the backward pass to the features, from the vectors that [`Lineformer::layers`] left.
    ///
    /// # Errors
    /// Errors of [`Recorder::run`].
    pub fn backward(&self, run: &mut impl Recorder, kernels: &LineformerBackKernels) -> Result<()> {
        let (n_samples, capacity) = (self.chunk.n, self.capacity);
        let (linear, wide) = (&kernels.linear, WIDE * WIDTH4);
        let [input, joint] = self.outer();
        let matrix = |first: u32, stride: u32| Matrix { first, stride };
        let through =
            |activation: u32, slope_of: u32, push: SaxLinearBack| SaxLinearBack { activation, slope_of, ..push };
        let push = push::SaxDensityBack { n_samples, capacity, first: self.chunk.first };
        self.each(run, &kernels.density, push)?;
        let of_block = matrix(joint.first + self.features4(), joint.stride);
        let push = self.back(at::SAX_BY_BLOCK, WIDTH4, (at::SAX_BY_JOINT, WIDTH4), of_block);
        self.run_back(run, linear, through(at::SAX_LEAKY, at::SAX_BLOCK, push))?;
        let contract = matrix(at::LINEFORMER_CONTRACT, wide);
        let push = self.back(at::SAX_BY_SECOND, wide, (at::SAX_BY_BLOCK, WIDTH4), contract);
        self.run_back(run, linear, through(at::SAX_GELU, at::SAX_BEFORE_SECOND, push))?;
        let push = self.back(at::SAX_BY_FIRST, wide, (at::SAX_BY_SECOND, wide), matrix(at::LINEFORMER_MIX, wide));
        self.run_back(run, linear, through(at::SAX_GELU, at::SAX_BEFORE_FIRST, push))?;
        let expand = matrix(at::LINEFORMER_EXPAND, WIDTH4);
        self.run_back(run, linear, self.back(at::SAX_BY_NORMAL, WIDTH4, (at::SAX_BY_FIRST, wide), expand))?;
        let push = push::SaxNormBack {
            n_samples,
            capacity,
            from: at::SAX_X2,
            added: at::SAX_BY_BLOCK,
            to: at::SAX_BY_OUT,
            scales: at::LINEFORMER_NORM2,
            left: at::SAX_NORM2,
            activation: at::SAX_PLAIN,
        };
        self.each(run, &kernels.norm, push)?;
        let out = matrix(at::LINEFORMER_OUT, WIDTH4);
        self.run_back(run, linear, self.back(at::SAX_BY_SEEN, WIDTH4, (at::SAX_BY_OUT, WIDTH4), out))?;
        let push = push::SaxAttendBack { n_samples, capacity, first: self.chunk.along, row: self.row };
        self.each(run, &kernels.attend, push)?;
        let query_key_value = (at::SAX_BY_QUERY, 3 * WIDTH4);
        let push = self.back(at::SAX_BY_NORMAL, WIDTH4, query_key_value, matrix(at::LINEFORMER_QUERY, WIDTH4));
        self.run_back(run, linear, push)?;
        let push = push::SaxNormBack {
            n_samples,
            capacity,
            from: at::SAX_X1,
            added: at::SAX_BY_OUT,
            to: at::SAX_BY_INPUT,
            scales: at::LINEFORMER_NORM1,
            left: at::SAX_NORM1,
            activation: at::SAX_LEAKY,
        };
        self.each(run, &kernels.norm, push)?;
        let push = self.back(at::SAX_FEATURES, self.features4(), (at::SAX_BY_JOINT, WIDTH4), joint);
        let push = SaxLinearBack {
            other: at::SAX_BY_INPUT,
            other_rows4: WIDTH4,
            other_weights: input.first,
            other_stride: input.stride,
            ..push
        };
        self.run_back(run, linear, push)
    }

    /// Records the chunk's gradients of the Lineformer's parameters, in `n_parts` parts: added to those of earlier chunks if
    /// `adds`, otherwise replacing them.
    ///
    /// # Errors
    /// Errors of [`Recorder::run`].
    pub fn gradient(
        &self,
        run: &mut impl Recorder,
        kernels: &LineformerBackKernels,
        n_parts: u32,
        adds: bool,
    ) -> Result<()> {
        let push = push::SaxLinearGradient {
            n_samples: self.chunk.n,
            capacity: self.capacity,
            first_feature: self.chunk.first,
            feature_stride: self.n_all,
            part_samples: PART_SAMPLES,
            adds: u32::from(adds),
        };
        run.run(&kernels.gradient, Groups::Direct([n_parts, at::SAX_PRODUCTS, 1]), push)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn chunks_hold_all_samples_once_and_no_pair_apart() {
        for (n_rays, row) in [(3, 7), (5000, 33), (2, 40_001), (1, MAX_SAMPLES), (400, 256)] {
            let all = chunks(n_rays, row);
            let mut next = 0;
            for chunk in &all {
                assert_eq!((chunk.first, chunk.along), (next, next % row));
                assert!(chunk.n > 0 && chunk.n <= MAX_SAMPLES && chunk.along % 2 == 0);
                next += chunk.n;
            }
            assert_eq!(next, n_rays * row);
        }
    }

    #[test]
    fn vectors_of_a_chunk_fit_a_buffer_of_every_device() {
        assert!(vector_bytes(at::SAX_VECTORS, capacity(u32::MAX)) < 128 << 20);
    }
}
