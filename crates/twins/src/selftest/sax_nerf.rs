//! SAX-NeRF: an iteration of its fit, stage by stage, each on what the device made for it; and what is drawn of a
//! field.

use crate::config::sections::SaxSettings;
use crate::config::{Config, Preset};
use crate::error::Result;
use crate::fitting::sets::seed_of_set;
use crate::gpu::buffer::{Buffer, Memory};
use crate::gpu::device::Gpu;
use crate::gpu::record::Recording;
use crate::kernels::layout::{Ray, RayOut, SaxLevel, SaxSetup};
use crate::kernels::push::{self, PushConstants};
use crate::methods::sax_nerf::data::SaxData;
use crate::methods::sax_nerf::drawing::SaxDrawing;
use crate::methods::sax_nerf::field::{SaxField, SaxState};
use crate::methods::sax_nerf::setup::{EPSILON, drawing_setup, outline, schedule};
use crate::methods::sax_nerf::start::first_params;
use crate::methods::sax_nerf::trainer::SaxTrainer;
use crate::model::field::{FieldDrawing, Row};
use crate::plan::Plan;
use crate::random::{STREAM_JITTER, normal};
use crate::reference::sax_nerf::{self as reference, Lineformer};
use crate::scan::small::small_dataset;
use crate::selftest::compare::{Findings, Tolerance, told};
use crate::selftest::problems::with_values;

const BATCH: &[&str] = &[push::SaxBatch::SHADER];
const POINTS: &[&str] = &[push::SaxPoints::SHADER];
const ENCODE: &[&str] = &[push::SaxEncode::SHADER];
const LINEFORMER: &[&str] =
    &[push::SaxLinear::SHADER, push::SaxNorm::SHADER, push::SaxAttend::SHADER, push::SaxDensity::SHADER];
const LOSS: &[&str] = &[push::SaxLoss::SHADER];
const LINEFORMER_BWD: &[&str] = &[
    push::SaxLinearBack::SHADER,
    push::SaxNormBack::SHADER,
    push::SaxAttendBack::SHADER,
    push::SaxDensityBack::SHADER,
];
const PRODUCTS: &[&str] = &[push::SaxLinearGradient::SHADER];
const WEIGHT_GRADIENT: &[&str] = &[push::SaxWeightGradient::SHADER];
const ENCODE_BWD: &[&str] = &[push::SaxEncodeBwd::SHADER];
const GRID_GRADIENT: &[&str] = &[push::SaxGridGradient::SHADER];
const ADAM: &[&str] = &[push::Adam::SHADER];
const REPORT: &[&str] = &[push::SaxReport::SHADER];
const VIEW: &[&str] = &[push::SaxView::SHADER];

/// f32 coordinates and short sums.
const NUMBERS: Tolerance = Tolerance::OfLargest(2e-5);
/// Gradients, sums over all samples.
const GRADIENTS: Tolerance = Tolerance::OfLargest(1e-4);
/// Results of all stages of drawing, from sample points that are not compared themselves.
const DRAWN: Tolerance = Tolerance::OfLargest(2e-4);
/// Differences of depths, which f32 knows to 1e-7 of 100 mm.
const PATHS: Tolerance = Tolerance::OfLargest(1e-4);

/// A configuration small enough for the twin.
///
/// # Errors
/// [`crate::error::Error::Config`] for a setting that is not usable.
pub fn small_config(settings: &[&str]) -> Result<Config<SaxSettings>> {
    let small = [
        "train.iterations=40",
        "train.iterations_per_submit=4",
        "sax.num_levels=6",
        "sax.base_resolution=3",
        "sax.log2_hashmap_size=9",
        "sax.window_num=2",
        "sax.window_size=4",
        "sax.n_rays=13",
        "sax.n_samples=6",
        "sax.bound_mm=60",
        "sax.lrate_step=30",
    ];
    with_values(&Config::preset(Preset::SaxNerf), small.iter().chain(settings).copied())?.of()
}

/// Data, and fields without special values: a grid and normalisations that have an effect.
///
/// # Errors
/// As [`small_dataset`] and [`Plan::new`].
pub fn hard_case(config: &Config<SaxSettings>) -> Result<(SaxData, SaxField, SaxState)> {
    let dataset = small_dataset(33, 27, 3)?;
    let data = Plan::new(&config.clone().into_any(), &dataset)?.data::<SaxData>()?.clone();
    let outline = outline(&data, &config.sax, 0);
    let parts = outline.shape.parts();
    let params = |set: usize| {
        let mut params = first_params(outline.shape, seed_of_set(config.seed, set));
        for part in &parts {
            let spread = if part.name.starts_with("norm") { 0.2 } else { 0.0 };
            let scale = if part.name == "grid" { 5e3 } else { 1.0 };
            for (i, number) in params[part.first..][..part.len()].iter_mut().enumerate() {
                *number = scale * *number + (spread * normal(7, STREAM_JITTER, part.first as u32, i as u32)) as f32;
            }
        }
        params
    };
    let field = SaxField { params: (0..data.n_sets()).map(params).collect(), ..outline };
    let moments = vec![vec![[0.0; 2]; field.shape.n_params()]; data.n_sets()];
    Ok((data, field, SaxState { moments }))
}

/// Numbers of f32 as f64.
pub fn f64s(values: &[f32]) -> Vec<f64> {
    values.iter().map(|v| f64::from(*v)).collect()
}

/// Compares the stages of an iteration, and what is drawn.
///
/// # Errors
/// Device errors.
pub fn compare(gpu: &Gpu, findings: &mut Findings) -> Result<()> {
    for (case, settings) in [
        ("fields of 3 phases, 33 x 27 pixels, 6 levels", &[][..]),
        // Windows take whole rows, and points go beyond the box.
        (
            "one field, 4 levels, clamped",
            &["sax.static_data=pooled", "sax.num_levels=4", "sax.window_size=5", "sax.bound_mm=7"],
        ),
    ] {
        findings.begin("sax", case);
        let config = small_config(settings)?;
        let (data, field, state) = hard_case(&config)?;
        let fit = SaxTrainer::with(gpu, data.clone(), &config, &field, &state)?;
        Iteration { gpu, config, fit, field: field.clone() }.compare(findings)?;
        compare_drawing(gpu, &data, &field, findings)?;
    }
    Ok(())
}

/// A fit before its first iteration, of whose fields the last one's is left in the buffers.
struct Iteration<'a> {
    gpu: &'a Gpu,
    config: Config<SaxSettings>,
    fit: SaxTrainer,
    field: SaxField,
}

/// Results of the device for the last field's batch.
struct DeviceResults {
    rays: Vec<Ray>,
    points: Vec<[f32; 4]>,
    encoding: Vec<f32>,
    sigma: Vec<f32>,
    ray_gradient: Vec<f32>,
    encoding_gradient: Vec<f32>,
}

impl Iteration<'_> {
    fn floats(&self, buffer: &Buffer, n: usize) -> Result<Vec<f32>> {
        Ok(self.gpu.download(buffer, 0, n)?)
    }

    fn last_set(&self) -> usize {
        self.field.n_sets - 1
    }

    fn seed(&self) -> u32 {
        seed_of_set(self.config.seed, self.last_set())
    }

    fn params(&self) -> Vec<f64> {
        f64s(&self.field.params[self.last_set()])
    }

    fn compare(mut self, findings: &mut Findings) -> Result<()> {
        let loss = told(self.fit.advance(1))?.first().copied().unwrap_or(f64::NAN);
        let made = self.made()?;
        self.compare_batch(&made, findings);
        self.compare_samples(&made, findings);
        self.compare_loss(&made, loss, findings)?;
        self.compare_lineformer(&made, findings)?;
        self.compare_update(findings)?;
        self.compare_grid(&made, findings)
    }

    fn made(&self) -> Result<DeviceResults> {
        let (setup, (samples, fit)) = (self.fit.setup(), self.fit.buffers());
        let n_rays = setup.n_rays as usize;
        let n = n_rays * setup.n_samples as usize;
        let n_features = n * self.field.shape.n_features();
        Ok(DeviceResults {
            rays: self.gpu.download(&fit.rays, 0, n_rays)?,
            points: self.gpu.download(&samples.sax_points, 0, n)?,
            encoding: self.floats(&samples.sax_encoding, n_features)?,
            sigma: self.floats(&samples.sax_sigma, n)?,
            ray_gradient: self.floats(&fit.sax_ray_gradient, n_rays)?,
            encoding_gradient: self.floats(&fit.sax_encoding_gradient, n_features)?,
        })
    }

    fn compare_batch(&self, made: &DeviceResults, findings: &mut Findings) {
        let data = self.fit.data();
        let want = reference::batch(data, self.fit.setup(), self.last_set(), self.seed(), 0);
        let same = want.iter().zip(&made.rays).filter(|(want, ray)| **want == ray.id as usize).count();
        let differ = want.len().max(made.rays.len()) - same;
        findings.add(BATCH, &format!("pixels that differ, of {}", want.len()), differ as f64, 0.5);
        let targets: Vec<f32> = made.rays.iter().map(|ray| ray.target).collect();
        let measured: Vec<f64> = want.iter().map(|id| f64::from(data.images[*id])).collect();
        findings.numbers(BATCH, "line integrals", &targets, &measured, NUMBERS);
        let view = |id: usize| data.views[id / data.n_pixels()];
        let at = |id: usize| (id % data.n_pixels() % data.width, id % data.n_pixels() / data.width);
        let lines = want.iter().flat_map(|id| {
            let (view, (i, j)) = (view(*id), at(*id));
            [0, 1, 2].map(|k| {
                f64::from(view.direction00[k])
                    + i as f64 * f64::from(view.direction_du[k])
                    + j as f64 * f64::from(view.direction_dv[k])
            })
        });
        let directions: Vec<f32> = made.rays.iter().flat_map(|ray| ray.direction).collect();
        findings.numbers(BATCH, "directions", &directions, &lines.collect::<Vec<_>>(), NUMBERS);
    }

    fn compare_samples(&self, made: &DeviceResults, findings: &mut Findings) {
        let (setup, shape) = (self.fit.setup(), self.field.shape);
        let points = points(setup, self.seed(), &made.rays);
        let got: Vec<f32> = made.points.iter().flat_map(|p| p[..3].to_vec()).collect();
        let want: Vec<f64> = points.iter().flat_map(|(unit, _)| *unit).collect();
        findings.numbers(POINTS, "points", &got, &want, NUMBERS);
        let got: Vec<f32> = made.points.iter().map(|p| p[3]).collect();
        let want: Vec<f64> = points.iter().map(|(_, path)| *path).collect();
        findings.numbers(POINTS, "paths", &got, &want, PATHS);
        let (params, levels) = (self.params(), shape.grid());
        let grid = &params[shape.n_weights()..];
        let encode = |p: &[f32; 4]| reference::encode(&levels, grid, [p[0], p[1], p[2]]);
        let want: Vec<f64> = made.points.iter().flat_map(encode).collect();
        let got = by_sample(&made.encoding, made.points.len());
        findings.numbers(ENCODE, "features", &got, &want, NUMBERS);
        let want = densities(&Lineformer::new(shape, &params), &f64s(&got), shape.n_features());
        findings.numbers(LINEFORMER, "densities", &made.sigma, &want, NUMBERS);
    }

    fn compare_loss(&self, made: &DeviceResults, loss: f64, findings: &mut Findings) -> Result<()> {
        let setup = self.fit.setup();
        let row = setup.n_samples as usize;
        let integral = |ray: usize| -> f64 {
            (ray * row..(ray + 1) * row).map(|s| f64::from(made.sigma[s]) * f64::from(made.points[s][3])).sum()
        };
        let integrals: Vec<f64> = (0..made.rays.len()).map(integral).collect();
        let targets: Vec<f64> = made.rays.iter().map(|ray| ray.target.into()).collect();
        let (of_last, by_integral) = reference::loss(&integrals, &targets);
        findings.numbers(LOSS, "gradient by line integrals", &made.ray_gradient, &by_integral, NUMBERS);
        let (n_sets, n_rays) = (setup.n_sets as usize, setup.n_rays as usize);
        let losses = f64s(&self.floats(&self.fit.buffers().1.sax_losses, n_sets * n_rays)?);
        let got: f64 = losses[(n_sets - 1) * n_rays..].iter().sum();
        findings.add(LOSS, "loss of the last field", (got / of_last - 1.0).abs(), 1e-5);
        let mean = losses.iter().sum::<f64>() / n_sets as f64;
        findings.add(REPORT, "loss", (loss / mean - 1.0).abs(), 1e-5);
        Ok(())
    }

    fn compare_lineformer(&self, made: &DeviceResults, findings: &mut Findings) -> Result<()> {
        let (setup, shape, params) = (self.fit.setup(), self.field.shape, self.params());
        let (width, row) = (shape.n_features(), setup.n_samples as usize);
        let features = f64s(&by_sample(&made.encoding, made.points.len()));
        let lineformer = Lineformer::new(shape, &params);
        let mut gradient = vec![0.0; shape.n_weights()];
        let mut by_features = Vec::new();
        for (pair, own) in features.chunks(2 * width).enumerate() {
            let by_sigma =
                [2 * pair, 2 * pair + 1].map(|s| f64::from(made.ray_gradient[s / row]) * f64::from(made.points[s][3]));
            let trace = lineformer.fwd([&own[..width], &own[width..]]);
            by_features.extend(lineformer.bwd(&trace, by_sigma, &mut gradient).concat());
        }
        let got = by_sample(&made.encoding_gradient, made.points.len());
        findings.numbers(LINEFORMER_BWD, "gradient by features", &got, &by_features, GRADIENTS);
        let n = shape.n_weights();
        let parts = self.floats(&self.fit.buffers().1.sax_weight_parts, n * setup.n_groups as usize)?;
        let mut sums = vec![0f64; n];
        parts.chunks(n).for_each(|part| sums.iter_mut().zip(part).for_each(|(sum, v)| *sum += f64::from(*v)));
        for part in shape.parts().iter().filter(|part| part.name != "grid") {
            let range = part.first..part.first + part.len();
            let got: Vec<f32> = sums[range.clone()].iter().map(|v| *v as f32).collect();
            findings.numbers(PRODUCTS, part.name, &got, &gradient[range], GRADIENTS);
        }
        let got = self.floats(&self.fit.buffers().1.gradient, n)?;
        findings.numbers(WEIGHT_GRADIENT, "gradient by the Lineformer's parameters", &got, &sums, NUMBERS);
        Ok(())
    }

    /// Compares the first update, from the gradient that the device found.
    fn compare_update(&self, findings: &mut Findings) -> Result<()> {
        let row = schedule(&self.config)[0];
        let n = self.field.shape.n_params();
        let gradient = f64s(&self.floats(&self.fit.buffers().1.gradient, n)?);
        let after = f64s(&self.floats(&self.fit.sets()[self.last_set()].params, n)?);
        let moved: Vec<f32> = after.iter().zip(&self.params()).map(|(a, b)| (a - b) as f32).collect();
        let step = |g: &f64| -f64::from(row.static_update.rate) * g / (g.abs() + EPSILON);
        // Numbers are near 1 and steps are 0.001 of that.
        findings.numbers(
            ADAM,
            "first step",
            &moved,
            &gradient.iter().map(step).collect::<Vec<_>>(),
            Tolerance::OfLargest(1e-3),
        );
        Ok(())
    }

    /// Compares the scatter, run once more by itself, since the stage behind it clears its sums.
    fn compare_grid(&self, made: &DeviceResults, findings: &mut Findings) -> Result<()> {
        let (setup, shape) = (self.fit.setup(), self.field.shape);
        let (n_weights, n_grid) = (setup.n_weights as usize, setup.n_grid as usize);
        let (levels, width) = (shape.grid(), shape.n_features());
        let by_features = f64s(&by_sample(&made.encoding_gradient, made.points.len()));
        let mut want = vec![0.0; n_grid];
        for (point, by_features) in made.points.iter().zip(by_features.chunks(width)) {
            reference::encode_bwd(&levels, [point[0], point[1], point[2]], by_features, &mut want);
        }
        let sums = &self.fit.buffers().1.sax_grid_sums;
        let cleared: Vec<[u32; 2]> = self.gpu.download(sums, 0, n_grid)?;
        let mut recording = Recording::new(self.gpu, "scatter to the grid")?;
        self.fit.pass(&mut recording).scatter(&self.fit.sets()[self.last_set()])?;
        self.gpu.wait(recording.finish()?.submit()?)?;
        let added: Vec<[u32; 2]> = self.gpu.download(sums, 0, n_grid)?;
        let number = |[low, high]: &[u32; 2]| {
            (i64::from(*high) << 32 | i64::from(*low)) as f64 * 2f64.powi(-(setup.fixed_point_bits as i32))
        };
        let left = cleared.iter().filter(|sum| **sum != [0, 0]).count();
        findings.add(GRID_GRADIENT, "sums that were not cleared", left as f64, 0.5);
        let difference: Vec<f64> = added.iter().zip(&cleared).map(|(a, b)| number(a) - number(b)).collect();
        let got: Vec<f32> = difference.iter().map(|v| *v as f32).collect();
        findings.numbers(ENCODE_BWD, "sums of the grid's gradient", &got, &want, NUMBERS);
        let got = self.gpu.download(&self.fit.buffers().1.gradient, 4 * n_weights as u64, n_grid)?;
        findings.numbers(GRID_GRADIENT, "gradient of the grid", &got, &difference, NUMBERS);
        Ok(())
    }
}

/// Features by sample, as the device has them by pairs of levels.
fn by_sample(values: &[f32], n_samples: usize) -> Vec<f32> {
    let pairs = values.len() / n_samples / 4;
    let of_sample = |s: usize| (0..pairs).flat_map(move |pair| values[4 * (pair * n_samples + s)..][..4].to_vec());
    (0..n_samples).flat_map(of_sample).collect()
}

/// Points of the unit cube along rays, and the paths they stand for.
fn points(setup: &SaxSetup, seed: u32, rays: &[Ray]) -> Vec<([f64; 3], f64)> {
    let of_ray = |(r, ray): (usize, &Ray)| {
        let at = |k: usize, depth: f64| f64::from(ray.anchor[k]) + depth * f64::from(ray.direction[k]);
        let norm = f64::from(ray.norm);
        let depths = reference::depths(setup, seed, 0, r as u32);
        let point = |(depth, path)| (reference::unit(setup, [0, 1, 2].map(|k| at(k, depth))), path * norm);
        depths.into_iter().map(point).collect::<Vec<_>>()
    };
    rays.iter().enumerate().flat_map(of_ray).collect()
}

/// Densities of pairs of samples from their features.
fn densities(lineformer: &Lineformer<'_>, features: &[f64], width: usize) -> Vec<f64> {
    let pair = |own: &[f64]| lineformer.fwd([&own[..width], &own[width..]]).sigma();
    features.chunks(2 * width).flat_map(pair).collect()
}

/// Compares what rays of a view see, and rows of cells, an odd number of them.
fn compare_drawing(gpu: &Gpu, data: &SaxData, field: &SaxField, findings: &mut Findings) -> Result<()> {
    const PHASE: u32 = 2;
    let view = &data.views[1];
    let ray = |p: usize| {
        let (i, j) = ((p % data.width) as f32, (p / data.width) as f32);
        let at = |from: [[f32; 4]; 3]| [0, 1, 2].map(|k| from[0][k] + i * from[1][k] + j * from[2][k]);
        let direction = at([view.direction00, view.direction_du, view.direction_dv]);
        let norm = direction.iter().map(|d| d * d).sum::<f32>().sqrt();
        Ray { anchor: at([view.anchor00, view.anchor_du, view.anchor_dv]), direction, norm, ..Ray::default() }
    };
    let rays: Vec<Ray> = (100..131).map(ray).collect();
    let drawing = SaxDrawing::new(gpu, field)?;
    let on_device = gpu.buffer_with("rays", &rays)?;
    let (n, row) = (rays.len(), 5);
    let out = gpu.buffer("ray_out", (n * size_of::<RayOut>()) as u64, Memory::Device)?;
    let cells = gpu.buffer("volume", 4 * (n * row) as u64, Memory::Device)?;
    let mut recording = Recording::new(gpu, "views of SAX-NeRF")?;
    drawing.record_rays(&mut recording, &on_device, &out, PHASE, n as u32)?;
    let cells_of_row = Row { near: -0.04, far: 0.05, cells: row as u32 };
    drawing.record_cells(&mut recording, &on_device, cells_of_row, PHASE, n as u32, &cells)?;
    gpu.wait(recording.finish()?.submit()?)?;
    let seen: Vec<RayOut> = gpu.download(&out, 0, n)?;
    let want = drawn(field, &drawing_setup(field), &rays, PHASE);
    let samples = field.samples as usize;
    let sum = |ray: &[(f64, f64)]| ray.iter().map(|(sigma, path)| sigma * path).sum();
    let largest = |ray: &[(f64, f64)]| ray.iter().fold(0f64, |m, (sigma, _)| m.max(*sigma));
    let rows = || want.chunks(samples);
    let got: Vec<f32> = seen.iter().map(|ray| ray.dynamic_integral).collect();
    findings.numbers(VIEW, "line integrals", &got, &rows().map(sum).collect::<Vec<f64>>(), DRAWN);
    let largest: Vec<f64> = rows().map(largest).collect();
    for (what, of) in [("maximum values", 0), ("maximum of all values", 1)] {
        let got: Vec<f32> = seen.iter().map(|ray| [ray.dynamic_max, ray.total_max][of]).collect();
        findings.numbers(VIEW, what, &got, &largest, DRAWN);
    }
    let setup = SaxSetup { near: -0.04, far: 0.05, n_samples: row as u32, ..drawing_setup(field) };
    let want: Vec<f64> = drawn(field, &setup, &rays, PHASE).iter().map(|(sigma, _)| *sigma).collect();
    let got: Vec<f32> = gpu.download(&cells, 0, n * row)?;
    findings.numbers(LINEFORMER, "cells of rows", &got, &want, DRAWN);
    Ok(())
}

/// Attenuation at the samples of rays, and their paths.
fn drawn(field: &SaxField, setup: &SaxSetup, rays: &[Ray], phase: u32) -> Vec<(f64, f64)> {
    let params = f64s(&field.params[field.set_of(phase)]);
    let (levels, shape): (Vec<SaxLevel>, _) = (field.shape.grid(), field.shape);
    let (lineformer, grid) = (Lineformer::new(shape, &params), &params[shape.n_weights()..]);
    let points = points(setup, 0, rays);
    let of_row = |row: &[([f64; 3], f64)]| {
        let features: Vec<Vec<f64>> =
            row.iter().map(|(unit, _)| reference::encode(&levels, grid, unit.map(|x| x as f32))).collect();
        let density = |k: usize| {
            let other = if k % 2 == 1 { k - 1 } else { (k + 1).min(row.len() - 1) };
            let [first, second] = [k.min(other), k.max(other)];
            lineformer.fwd([&features[first], &features[second]]).sigma()[k - first]
        };
        (0..row.len()).map(|k| (field.attenuation * density(k), row[k].1)).collect::<Vec<_>>()
    };
    points.chunks(setup.n_samples as usize).flat_map(of_row).collect()
}
