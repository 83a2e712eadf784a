//! f64 reference implementations (twins) of the stages of SAX-NeRF, as plain loops without the device.

use crate::kernels::layout::{SaxLevel, SaxSetup};
use crate::methods::sax_nerf::data::SaxData;
use crate::methods::sax_nerf::field::{FEATURES, SaxShape, WIDTH};
use crate::random::{STREAM_DEPTH, STREAM_RAY, STREAM_WINDOW, permute, uniform01};
use std::collections::HashSet;
use std::ops::Range;

/// Number of samples that attend to each other.
const PAIR: usize = 2;
/// Values per attention head.
const HEAD: usize = 4;
const HEADS: usize = WIDTH / HEAD;
const WIDE: usize = 4 * WIDTH;
const LEAK: f64 = 0.01;
const MIN_VARIANCE: f64 = 1e-5;
/// Primes of the hash, along each axis.
const PRIMES: [u64; 3] = [1, 19_349_663, 83_492_791];
/// Minimum distance of points from the faces of the unit box, in box sides.
const INSIDE: f64 = 1.7e-6;
/// Path length of the last sample of a ray whose direction has length 1.
const LAST_PATH: f64 = 1e-10;

/// Rays of iteration `step` of a set, as image * pixels + pixel (twin of `sax_batch`).
pub fn batch(data: &SaxData, setup: &SaxSetup, set: usize, seed: u32, step: u32) -> Vec<usize> {
    let images = data.sets.images(set);
    let image = images[step as usize % images.len()];
    let side = setup.window as usize;
    let columns = data.width / side;
    let n_tiles = (columns * (data.height / side)) as u32;
    let mut rays = Vec::new();
    for k in 0..setup.n_windows {
        let tile = permute(k, n_tiles, seed, step, STREAM_WINDOW) as usize;
        let (column, row) = (tile % columns * side, tile / columns * side);
        rays.extend((0..side * side).map(|at| (row + at / side) * data.width + column + at % side));
    }
    let of_windows: HashSet<usize> = rays.iter().copied().collect();
    let (list, n_single) = (data.lists[image], setup.n_rays - rays.len() as u32);
    let listed = &data.listed[list.first as usize..][..list.n as usize];
    for ray in 0..n_single {
        let shuffled = |at: u32| listed[permute(at, list.n, seed, step, STREAM_RAY) as usize] as usize;
        let own: Vec<usize> = (ray % list.n..list.n).step_by(n_single as usize).map(shuffled).collect();
        let outside = own.iter().find(|pixel| !of_windows.contains(pixel));
        rays.extend(outside.or(own.last()));
    }
    rays.iter().map(|pixel| image * data.n_pixels() + pixel).collect()
}

/// Depths of a ray, and the path lengths they represent per length of its direction (twin of part of `sax_points`).
pub fn depths(setup: &SaxSetup, seed: u32, step: u32, ray: u32) -> Vec<(f64, f64)> {
    let n = setup.n_samples;
    let (near, far) = (f64::from(setup.near), f64::from(setup.far));
    let regular = |k: u32| near + (far - near) * f64::from(k) / f64::from(n - 1);
    let depth = |k: u32| {
        if setup.jitter == 0 {
            return regular(k);
        }
        let lower = if k == 0 { near } else { 0.5 * (regular(k - 1) + regular(k)) };
        let upper = if k == n - 1 { far } else { 0.5 * (regular(k) + regular(k + 1)) };
        lower + (upper - lower) * uniform01(seed, STREAM_DEPTH + ((ray + 1) << 4), step, k)
    };
    let path = |k: u32| if k == n - 1 { LAST_PATH } else { depth(k + 1) - depth(k) };
    (0..n).map(|k| (depth(k), path(k))).collect()
}

/// Maps a point of the world to the unit cube of the grid's box (twin of part of `sax_points`).
pub fn unit(setup: &SaxSetup, x: [f64; 3]) -> [f64; 3] {
    x.map(|x| (x / (2.0 * f64::from(setup.bound)) + 0.5).clamp(INSIDE, 1.0 - INSIDE))
}

/// Index of the entry of a corner of a level's cells.
pub fn entry(level: &SaxLevel, corner: [u32; 3]) -> usize {
    let corner = corner.map(u64::from);
    let index = if level.dense != 0 {
        let side = u64::from(level.cells) + 1;
        corner[0] + corner[1] * side + corner[2] * side * side
    } else {
        // Words of 32 bits wrap around.
        let word = |axis: usize| corner[axis] * PRIMES[axis] % (1 << 32);
        word(0) ^ word(1) ^ word(2)
    };
    level.first as usize + (index % u64::from(level.entries)) as usize
}

/// Entries around a point of the unit cube, and its interpolation weights. The cell is computed in f32 as on the device,
/// because in fine levels the rounding matters.
pub fn taps(level: &SaxLevel, unit: [f32; 3]) -> Vec<(usize, f64)> {
    let position = unit.map(|x| x * (level.cells - 1) as f32 + 0.5);
    let (corner, share) = (position.map(|x| x as u32), position.map(|x| f64::from(x - x.floor())));
    let tap = |k: u32| {
        let upper = [k & 1, k >> 1 & 1, k >> 2];
        let of_axis = |axis: usize| if upper[axis] == 1 { share[axis] } else { 1.0 - share[axis] };
        (entry(level, [0, 1, 2].map(|a| corner[a] + upper[a])), of_axis(0) * of_axis(1) * of_axis(2))
    };
    (0..8).map(tap).collect()
}

/// Features of a point (twin of `sax_encode`).
pub fn encode(levels: &[SaxLevel], grid: &[f64], unit: [f32; 3]) -> Vec<f64> {
    let feature = |level: &SaxLevel, k: usize| -> f64 {
        taps(level, unit).iter().map(|(entry, share)| share * grid[FEATURES * entry + k]).sum()
    };
    levels.iter().flat_map(|level| [0, 1].map(|k| feature(level, k))).collect()
}

/// Adds the gradient by the grid from that by a point's features (twin of `sax_encode_bwd`).
pub fn encode_bwd(levels: &[SaxLevel], unit: [f32; 3], by_features: &[f64], gradient: &mut [f64]) {
    for (level, by_level) in levels.iter().zip(by_features.chunks(FEATURES)) {
        for (entry, share) in taps(level, unit) {
            (0..FEATURES).for_each(|k| gradient[FEATURES * entry + k] += share * by_level[k]);
        }
    }
}

/// Cumulative distribution of a standard normal at x, by a series without cancellation.
fn normal_share(x: f64) -> f64 {
    if x.abs() > 9.0 {
        return if x > 0.0 { 1.0 } else { 0.0 };
    }
    let (mut term, mut sum, mut k) = (x, x, 1.0);
    while f64::abs(term) > 1e-18 * sum.abs() && k < 400.0 {
        term *= x * x / (2.0 * k + 1.0);
        sum += term;
        k += 1.0;
    }
    0.5 + sum * (-0.5 * x * x).exp() / std::f64::consts::TAU.sqrt()
}

fn gelu(x: f64) -> f64 {
    x * normal_share(x)
}

fn gelu_slope(x: f64) -> f64 {
    normal_share(x) + x * (-0.5 * x * x).exp() / std::f64::consts::TAU.sqrt()
}

fn leaky(x: f64) -> f64 {
    if x > 0.0 { x } else { LEAK * x }
}

fn leaky_slope(x: f64) -> f64 {
    if x > 0.0 { 1.0 } else { LEAK }
}

fn map(x: &[f64], f: impl Fn(f64) -> f64) -> Vec<f64> {
    x.iter().map(|x| f(*x)).collect()
}

fn product(x: &[f64], y: &[f64]) -> Vec<f64> {
    x.iter().zip(y).map(|(x, y)| x * y).collect()
}

fn sum(x: &[f64], y: &[f64]) -> Vec<f64> {
    x.iter().zip(y).map(|(x, y)| x + y).collect()
}

fn dot(x: &[f64], y: &[f64]) -> f64 {
    x.iter().zip(y).map(|(x, y)| x * y).sum()
}

/// Normalises a sample by its mean and standard deviation, and returns the inverse of the latter as well.
fn normalised(x: &[f64]) -> (Vec<f64>, f64) {
    let n = x.len() as f64;
    let mean = x.iter().sum::<f64>() / n;
    let inverse = 1.0 / (x.iter().map(|x| (x - mean).powi(2)).sum::<f64>() / n + MIN_VARIANCE).sqrt();
    (map(x, |x| (x - mean) * inverse), inverse)
}

/// Gradient by the input of a normalisation whose output is `hat`.
fn normalised_bwd(d: &[f64], hat: &[f64], inverse: f64) -> Vec<f64> {
    let n = d.len() as f64;
    let (mean, along) = (d.iter().sum::<f64>() / n, dot(d, hat) / n);
    d.iter().zip(hat).map(|(d, hat)| inverse * (d - mean - along * hat)).collect()
}

/// The Lineformer with its parameters, which precede the grid's among those of a field.
pub struct Lineformer<'a> {
    shape: SaxShape,
    params: &'a [f64],
}

/// Intermediate values of one sample of a pair.
struct SampleTrace {
    features: Vec<f64>,
    first: Vec<f64>,
    hat1: Vec<f64>,
    inverse1: f64,
    normal1: Vec<f64>,
    query: Vec<f64>,
    key: Vec<f64>,
    value: Vec<f64>,
    seen: Vec<f64>,
    hat2: Vec<f64>,
    inverse2: f64,
    normal2: Vec<f64>,
    expanded: Vec<f64>,
    mixed: Vec<f64>,
    block: Vec<f64>,
    joint: Vec<f64>,
    sigma: f64,
}

/// Intermediate values of a pair of samples.
pub struct Trace {
    samples: Vec<SampleTrace>,
    /// Attention weights, `[head][attending sample][attended sample]`.
    shares: Vec<[[f64; PAIR]; PAIR]>,
}

impl Trace {
    /// Densities of both samples.
    pub fn sigma(&self) -> [f64; PAIR] {
        [0, 1].map(|s| self.samples[s].sigma)
    }

    /// Output of the attention for each sample, before its last matrix.
    pub fn seen(&self) -> [&[f64]; PAIR] {
        [0, 1].map(|s| &self.samples[s].seen[..])
    }

    /// The samples' values.
    pub fn values(&self) -> [&[f64]; PAIR] {
        [0, 1].map(|s| &self.samples[s].value[..])
    }
}

impl<'a> Lineformer<'a> {
    /// Creates the Lineformer from the parameters of a field.
    pub fn new(shape: SaxShape, params: &'a [f64]) -> Lineformer<'a> {
        Lineformer { shape, params }
    }

    fn range(&self, name: &str) -> Range<usize> {
        let parts = self.shape.parts();
        let part = parts.iter().find(|part| part.name == name);
        part.map_or(0..0, |part| part.first..part.first + part.len())
    }

    fn part(&self, name: &str) -> &[f64] {
        &self.params[self.range(name)]
    }

    /// Computes W x for the matrix `name`.
    fn times(&self, name: &str, x: &[f64]) -> Vec<f64> {
        self.part(name).chunks(x.len()).map(|row| dot(row, x)).collect()
    }

    /// Computes W^T d for the matrix `name`, which was multiplied with x, and adds the matrix's gradient.
    fn times_bwd(&self, name: &str, x: &[f64], d: &[f64], gradient: &mut [f64]) -> Vec<f64> {
        let (range, mut back) = (self.range(name), vec![0.0; x.len()]);
        for ((row, by_row), d) in
            self.params[range.clone()].chunks(x.len()).zip(gradient[range].chunks_mut(x.len())).zip(d)
        {
            for i in 0..x.len() {
                by_row[i] += d * x[i];
                back[i] += d * row[i];
            }
        }
        back
    }

    fn add_gradient(&self, name: &str, d: &[f64], gradient: &mut [f64]) {
        gradient[self.range(name)].iter_mut().zip(d).for_each(|(sum, d)| *sum += d);
    }

    /// Evaluates a pair of samples from their features (twin of `sax_lineformer`).
    pub fn fwd(&self, features: [&[f64]; PAIR]) -> Trace {
        let mut samples: Vec<SampleTrace> = features.iter().map(|features| self.before_attention(features)).collect();
        let shares: Vec<[[f64; PAIR]; PAIR]> = (0..HEADS).map(|head| self.shares(head, &samples)).collect();
        for s in 0..PAIR {
            let seen = |i: usize| (0..PAIR).map(|t| shares[i / HEAD][s][t] * samples[t].value[i]).sum();
            samples[s].seen = (0..WIDTH).map(seen).collect();
        }
        samples.iter_mut().for_each(|sample| self.after_attention(sample));
        Trace { samples, shares }
    }

    fn before_attention(&self, features: &[f64]) -> SampleTrace {
        let first = sum(&self.times("input.weight", features), self.part("input.bias"));
        let (hat1, inverse1) = normalised(&map(&first, leaky));
        let normal1 = sum(&product(&hat1, self.part("norm1.weight")), self.part("norm1.bias"));
        let query = map(&self.times("attention.query", &normal1), |q| q / (HEAD as f64).sqrt());
        let key_value = self.times("attention.key_value", &normal1);
        SampleTrace {
            features: features.to_vec(),
            first,
            hat1,
            inverse1,
            normal1,
            query,
            key: key_value[..WIDTH].to_vec(),
            value: key_value[WIDTH..].to_vec(),
            seen: Vec::new(),
            hat2: Vec::new(),
            inverse2: 0.0,
            normal2: Vec::new(),
            expanded: Vec::new(),
            mixed: Vec::new(),
            block: Vec::new(),
            joint: Vec::new(),
            sigma: 0.0,
        }
    }

    fn shares(&self, head: usize, samples: &[SampleTrace]) -> [[f64; PAIR]; PAIR] {
        let own = head * HEAD..(head + 1) * HEAD;
        [0, 1].map(|s| {
            let position = |t: usize| self.part("attention.position")[(head * PAIR + s) * PAIR + t];
            let like = |t: usize| dot(&samples[s].query[own.clone()], &samples[t].key[own.clone()]) + position(t);
            let powers = [like(0).exp(), like(1).exp()];
            powers.map(|power| power / (powers[0] + powers[1]))
        })
    }

    fn after_attention(&self, t: &mut SampleTrace) {
        let seen = sum(&self.times("attention.out.weight", &t.seen), self.part("attention.out.bias"));
        let y = sum(&map(&t.first, leaky), &seen);
        (t.hat2, t.inverse2) = normalised(&y);
        t.normal2 = sum(&product(&t.hat2, self.part("norm2.weight")), self.part("norm2.bias"));
        t.expanded = self.times("feed_forward.expand", &t.normal2);
        t.mixed = self.times("feed_forward.mix", &map(&t.expanded, gelu));
        t.block = sum(&y, &self.times("feed_forward.contract", &map(&t.mixed, gelu)));
        let beside = [&t.features[..], &map(&t.block, leaky)].concat();
        t.joint = sum(&self.times("joint.weight", &beside), self.part("joint.bias"));
        let density = dot(self.part("density.weight"), &map(&t.joint, leaky)) + self.part("density.bias")[0];
        t.sigma = 1.0 / (1.0 + (-density).exp());
    }

    /// Gradient by the features of a pair, from that by its densities; adds the gradient by the parameters (twin of
    /// `sax_lineformer_bwd`).
    pub fn bwd(&self, trace: &Trace, by_sigma: [f64; PAIR], gradient: &mut [f64]) -> [Vec<f64>; PAIR] {
        // Gradients so far by the features, by the block's first layer, and by the output of the attention.
        let back: Vec<_> =
            trace.samples.iter().zip(by_sigma).map(|(t, d)| self.after_attention_bwd(t, d, gradient)).collect();
        let mut by_query = vec![vec![0.0; WIDTH]; PAIR];
        let mut by_key_value = vec![vec![0.0; 2 * WIDTH]; PAIR];
        for (head, shares) in trace.shares.iter().enumerate() {
            let own = head * HEAD..(head + 1) * HEAD;
            for (s, shares) in shares.iter().enumerate() {
                let d = &back[s].2[own.clone()];
                let by_share = [0, 1].map(|t| dot(d, &trace.samples[t].value[own.clone()]));
                let mean = dot(&by_share, shares);
                for t in 0..PAIR {
                    let by_like = shares[t] * (by_share[t] - mean);
                    gradient[self.range("attention.position").start + (head * PAIR + s) * PAIR + t] += by_like;
                    for i in own.clone() {
                        by_query[s][i] += by_like * trace.samples[t].key[i] / (HEAD as f64).sqrt();
                        by_key_value[t][i] += by_like * trace.samples[s].query[i];
                        by_key_value[t][WIDTH + i] += shares[t] * back[s].2[i];
                    }
                }
            }
        }
        [0, 1].map(|s| {
            let (by_features, by_first, _) = &back[s];
            let t = &trace.samples[s];
            let by_normal = sum(
                &self.times_bwd("attention.query", &t.normal1, &by_query[s], gradient),
                &self.times_bwd("attention.key_value", &t.normal1, &by_key_value[s], gradient),
            );
            self.add_gradient("norm1.weight", &product(&by_normal, &t.hat1), gradient);
            self.add_gradient("norm1.bias", &by_normal, gradient);
            let by_hat = product(&by_normal, self.part("norm1.weight"));
            let by_first = sum(by_first, &normalised_bwd(&by_hat, &t.hat1, t.inverse1));
            let by_first = product(&by_first, &map(&t.first, leaky_slope));
            self.add_gradient("input.bias", &by_first, gradient);
            sum(by_features, &self.times_bwd("input.weight", &t.features, &by_first, gradient))
        })
    }

    fn after_attention_bwd(
        &self,
        t: &SampleTrace,
        by_sigma: f64,
        gradient: &mut [f64],
    ) -> (Vec<f64>, Vec<f64>, Vec<f64>) {
        let d = by_sigma * t.sigma * (1.0 - t.sigma);
        self.add_gradient("density.bias", &[d], gradient);
        self.add_gradient("density.weight", &map(&t.joint, |x| d * leaky(x)), gradient);
        let by_joint = product(&map(self.part("density.weight"), |w| d * w), &map(&t.joint, leaky_slope));
        self.add_gradient("joint.bias", &by_joint, gradient);
        let beside = [&t.features[..], &map(&t.block, leaky)].concat();
        let by_beside = self.times_bwd("joint.weight", &beside, &by_joint, gradient);
        let (by_features, by_block) = by_beside.split_at(t.features.len());
        let by_block = product(by_block, &map(&t.block, leaky_slope));
        let by_wide = self.times_bwd("feed_forward.contract", &map(&t.mixed, gelu), &by_block, gradient);
        let by_mixed = product(&by_wide, &map(&t.mixed, gelu_slope));
        let by_wide = self.times_bwd("feed_forward.mix", &map(&t.expanded, gelu), &by_mixed, gradient);
        debug_assert_eq!(by_wide.len(), WIDE);
        let by_expanded = product(&by_wide, &map(&t.expanded, gelu_slope));
        let by_normal = self.times_bwd("feed_forward.expand", &t.normal2, &by_expanded, gradient);
        self.add_gradient("norm2.weight", &product(&by_normal, &t.hat2), gradient);
        self.add_gradient("norm2.bias", &by_normal, gradient);
        let by_hat = product(&by_normal, self.part("norm2.weight"));
        let by_y = sum(&by_block, &normalised_bwd(&by_hat, &t.hat2, t.inverse2));
        self.add_gradient("attention.out.bias", &by_y, gradient);
        let by_seen = self.times_bwd("attention.out.weight", &t.seen, &by_y, gradient);
        (by_features.to_vec(), by_y, by_seen)
    }
}

/// Mean squared residual of rays and its gradient by each line integral (twin of `sax_loss`).
pub fn loss(integrals: &[f64], targets: &[f64]) -> (f64, Vec<f64>) {
    let n = integrals.len() as f64;
    let residuals: Vec<f64> = integrals.iter().zip(targets).map(|(x, y)| x - y).collect();
    (residuals.iter().map(|r| r * r).sum::<f64>() / n, map(&residuals, |r| 2.0 * r / n))
}

/// A ray with given samples: points of the unit cube, the path lengths they represent, and the measured line integral.
#[derive(Debug, Clone)]
pub struct SampledRay {
    /// Point and path length of each sample.
    pub points: Vec<([f32; 3], f64)>,
    /// Measured line integral, in units of the density.
    pub target: f64,
}

/// Loss of a batch, and its gradient by the field's parameters.
pub fn objective(shape: SaxShape, params: &[f64], rays: &[SampledRay]) -> (f64, Vec<f64>) {
    let (levels, n_weights) = (shape.grid(), shape.n_weights());
    let (lineformer, grid) = (Lineformer::new(shape, params), &params[n_weights..]);
    let traced: Vec<Vec<Trace>> = rays
        .iter()
        .map(|ray| {
            let features: Vec<_> = ray.points.iter().map(|(unit, _)| encode(&levels, grid, *unit)).collect();
            features.chunks(PAIR).map(|pair| lineformer.fwd([&pair[0], &pair[1]])).collect()
        })
        .collect();
    let integral = |(ray, traces): (&SampledRay, &Vec<Trace>)| -> f64 {
        let sigma = traces.iter().flat_map(Trace::sigma);
        ray.points.iter().zip(sigma).map(|((_, path), sigma)| path * sigma).sum()
    };
    let integrals: Vec<f64> = rays.iter().zip(&traced).map(integral).collect();
    let targets: Vec<f64> = rays.iter().map(|ray| ray.target).collect();
    let (loss, by_integral) = loss(&integrals, &targets);
    let mut gradient = vec![0.0; params.len()];
    for ((ray, traces), d) in rays.iter().zip(&traced).zip(by_integral) {
        for (points, trace) in ray.points.chunks(PAIR).zip(traces) {
            let by_features = lineformer.bwd(trace, [d * points[0].1, d * points[1].1], &mut gradient);
            for ((unit, _), by_features) in points.iter().zip(by_features) {
                encode_bwd(&levels, *unit, &by_features, &mut gradient[n_weights..]);
            }
        }
    }
    (loss, gradient)
}
