//! Renderings, samples of the fields, and baked volumes.

use crate::choice::Choice;
use crate::config::Preset;
use crate::error::Result;
use crate::fields::data::FieldData;
use crate::gpu::device::Gpu;
use crate::kernels::push::{self, PushConstants};
use crate::kernels::tuning::{Layers, Tuning};
use crate::model::Model;
use crate::model::component::Component;
use crate::network::FIRST_LOSS_SCALE;
use crate::plan::Plan;
use crate::reference::field::{self, Precision};
use crate::reference::networks::SamplePlace;
use crate::reference::{march, networks};
use crate::render::baked::Baked;
use crate::render::grid::Grid;
use crate::render::quantity::{Projection, Quantity};
use crate::render::renderer::Renderer;
use crate::scan::dataset::Dataset;
use crate::scan::gating::BeatTime;
use crate::scan::small::small_dataset;
use crate::selftest::compare::{Findings, Tolerance};
use crate::selftest::iteration::{STEADY, path_name, sine_factor};
use crate::selftest::problems::{FAST_NETWORK, TWO_NETWORKS, small_config};
use crate::train::trainer::Trainer;
use glam::DVec3;
use std::sync::Arc;

const VIEW: &[&str] = &[push::PoseRays::SHADER, push::MarchFwd::SHADER];
const VIEW_OF_TWO: &[&str] = &[push::PoseRays::SHADER, push::MarchFwdSamples::SHADER];
const STATIC_CELLS: &[&str] = &[push::PoseRays::SHADER, push::VolumeStatic::SHADER];
const DYNAMIC_CELLS: &[&str] = &[push::PoseRays::SHADER, push::VolumeDynamic::SHADER];
const BAKED: &[&str] = &[push::BakedMarch::SHADER];

/// A pixel whose ray grazes a box face may gain or lose one sample in f32.
const PIXEL: Tolerance = Tolerance::OfLargest(2e-3);
/// Cells are single points.
const CELL: Tolerance = Tolerance::OfLargest(1e-4);
/// Cells on matrices: operands are rounded to f16.
const CELL_ON_MATRICES: Tolerance = Tolerance::OfLargest(2e-3);

/// A model after a few iterations, and what its twin needs.
struct Trained {
    dataset: Dataset,
    model: Model,
    plan: FieldData,
    params: Vec<f64>,
    precision: Precision,
}

impl Trained {
    fn new(gpu: &Gpu, dataset: Dataset, preset: Preset, settings: &[&str], tuning: &Tuning) -> Result<Trained> {
        let config = small_config(preset, &[STEADY, settings].concat())?;
        let mut trainer = Trainer::new(gpu, Plan::new(&config, &dataset)?, &dataset, tuning.clone())?;
        while trainer.step() < ITERATIONS {
            trainer.advance(ITERATIONS)?;
        }
        let model = trainer.model()?;
        let plan = Plan::new(&config, &dataset)?.in_scene(model.scene.clone());
        let mut plan = plan.data::<FieldData>()?.clone();
        plan.setup.jitter = 0;
        plan.setup.n_static_samples = config.render.render_samples;
        plan.setup.n_dynamic_samples = config.render.render_samples;
        let params = model.params.iter().map(|v| f64::from(*v)).collect();
        let precision = match tuning.layers {
            Layers::F32 => Precision::Exact,
            Layers::Matrices => Precision::F16 { loss_scale: FIRST_LOSS_SCALE.into() },
        };
        Ok(Trained { dataset, model, plan, params, precision })
    }

    fn attenuation(&self, feature: f64) -> f64 {
        let s = &self.plan.setup;
        f64::from(s.dynamic_gain) * field::softplus(feature + f64::from(s.dynamic_shift))
    }
}

/// Iterations before anything is drawn.
const ITERATIONS: u32 = 5;

/// Compares views between two phases with the twin's.
///
/// # Errors
/// Device errors.
pub fn compare_views(gpu: &Gpu, preset: Preset, tuning: &Tuning, findings: &mut Findings) -> Result<()> {
    findings.begin(path_name(tuning.layers), &format!("{}, view of 12 x 10 pixels", preset.name()));
    let two_networks = preset == TWO_NETWORKS;
    let scaled = if two_networks { "networks.gain=0.5" } else { "loss.normalise=true" };
    let settings = [scaled, "train.chunk_samples=1500"];
    let trained = Trained::new(gpu, small_dataset(12, 10, 3)?, preset, &settings, tuning)?;
    let (rays, taken) = (&trained.dataset.views[2].rays, BeatTime { phase: 2, after_phase: 0.375 });
    let seen = Renderer::new(gpu, &trained.model, tuning.clone())?.render_taken(rays, 12, 10, taken)?;
    let (mut statics, mut dynamics, mut largest) = (Vec::new(), Vec::new(), Vec::new());
    for pixel in 0..120u32 {
        let (anchor, direction) = rays.pixel(f64::from(pixel % 12), f64::from(pixel / 12));
        let shown = taken.shown(trained.dataset.n_phases);
        let ray = march::Ray { anchor, direction, shown, target: 0.0, temporal: [0.0; 2], id: pixel, change: 0.0 };
        if two_networks {
            let want = networks::seen(&trained.plan, &trained.params, ITERATIONS, &ray, trained.precision);
            statics.push(want.fields[0]);
            dynamics.push(want.fields[1]);
            largest.push(want.largest[1]);
            continue;
        }
        let no_near_part = march::NearPart::Depth(f64::NEG_INFINITY);
        let want = march::fwd(&trained.plan, &trained.params, ITERATIONS, &ray, no_near_part, true, trained.precision);
        statics.push(want.static_integral);
        dynamics.push(want.dynamic_integral);
        largest.push(want.dynamics.iter().map(|x| trained.attenuation(x.trace.feature)).fold(0.0, f64::max));
    }
    let stages = if two_networks { VIEW_OF_TWO } else { VIEW };
    findings.numbers(stages, "static integrals", &seen.static_integral, &statics, PIXEL);
    findings.numbers(stages, "dynamic integrals", &seen.dynamic_integral, &dynamics, PIXEL);
    findings.numbers(stages, "maximum values", &seen.dynamic_max, &largest, PIXEL);
    Ok(())
}

/// Compares cells of both fields with the twin's, and baked views with those through the fields.
///
/// # Errors
/// Device errors.
pub fn compare_volumes(gpu: &Gpu, tuning: &Tuning, findings: &mut Findings) -> Result<()> {
    findings.begin(path_name(tuning.layers), "43 x 9 x 11 cells");
    let settings = ["train.rays=64", "train.chunk_samples=2000", "march.render_samples=200"];
    let trained = Trained::new(gpu, small_dataset(24, 20, 3)?, FAST_NETWORK, &settings, tuning)?;
    let renderer = Arc::new(Renderer::new(gpu, &trained.model, tuning.clone())?);
    compare_cells(&trained, &renderer, sine_factor(gpu.info()), findings)?;
    findings.begin(path_name(tuning.layers), "43 x 9 x 11 cells of two networks");
    let two = Trained::new(gpu, small_dataset(24, 20, 3)?, TWO_NETWORKS, &settings, tuning)?;
    let of_two = Renderer::new(gpu, &two.model, tuning.clone())?;
    compare_cells(&two, &of_two, sine_factor(gpu.info()), findings)?;
    findings.begin(path_name(tuning.layers), "baked view of 24 x 20 pixels");
    compare_baked(&trained, renderer, findings)
}

fn compare_cells(trained: &Trained, renderer: &Renderer, sine_factor: f64, findings: &mut Findings) -> Result<()> {
    // Reaches beyond the boxes, is different along each axis, and takes several submits.
    let grid =
        Grid { origin: DVec3::new(-1.113, -0.417, -0.323), spacing: DVec3::new(0.05, 0.1, 0.07), size: [43, 9, 11] };
    let phase = 2;
    let shown = BeatTime::at_phase(phase).shown(trained.dataset.n_phases);
    let Trained { plan, params, .. } = trained;
    let s = &plan.setup;
    let window = trained.model.config.schedule(trained.model.step).window;
    let of_two = |x: DVec3| {
        let traces = networks::traces(plan, params, trained.model.step, SamplePlace { x, shown }, trained.precision);
        networks::attenuations(plan, &traces).map(|[sigma, _]| sigma)
    };
    let of_two_networks = plan.params.static_network.is_some();
    let inside = |x: DVec3| march::dynamic_inside(plan, x, phase as usize);
    let want = |field: Component, x: DVec3| match field {
        Component::Static if of_two_networks && inside(x) => of_two(x)[0],
        Component::Static if !of_two_networks && field::static_inside(s, x) => {
            field::static_attenuation(s, &plan.params, params, x)
        }
        Component::Dynamic if inside(x) => {
            let encoded = field::encode(s, window.into(), x);
            let trace = |map| field::network_fwd(map, params, &encoded, shown, trained.precision);
            let trace = plan.params.dynamic_network.as_ref().map(trace).unwrap_or_default();
            trained.attenuation(trace.feature)
        }
        _ => 0.0,
    };
    let points: Vec<DVec3> = (0..grid.len())
        .map(|i| DVec3::new((i % 43) as f64, (i / 43 % 9) as f64, (i / (43 * 9)) as f64))
        .map(|at| grid.origin + at * grid.spacing)
        .collect();
    let on_matrices = trained.precision != Precision::Exact;
    let dynamic = if on_matrices { CELL_ON_MATRICES } else { CELL }.times(sine_factor);
    let statics = if of_two_networks { (DYNAMIC_CELLS, dynamic) } else { (STATIC_CELLS, CELL) };
    for (field, stages, tolerance) in
        [(Component::Static, statics.0, statics.1), (Component::Dynamic, DYNAMIC_CELLS, dynamic)]
    {
        let got = renderer.sample(field, phase, &grid)?;
        let want: Vec<f64> = points.iter().map(|x| want(field, *x)).collect();
        findings.numbers(stages, "attenuation", &got, &want, tolerance);
        findings.require(stages, "cells outside the box", want.contains(&0.0));
    }
    Ok(())
}

/// Baked views lose what is finer than a cell.
fn compare_baked(trained: &Trained, renderer: Arc<Renderer>, findings: &mut Findings) -> Result<()> {
    let rays = &trained.dataset.views[1].rays;
    let exact = renderer.render(rays, 24, 20, 1)?;
    let baked = Baked::for_display(renderer, &trained.model, CELL_MM);
    let (drr, mip) = (Projection::Drr, Projection::Mip);
    let total = exact.total_integral();
    for (quantity, component, projection, want, max) in [
        ("static", Component::Static, drr, &exact.static_integral, 5e-2),
        ("dynamic", Component::Dynamic, drr, &exact.dynamic_integral, 5e-2),
        ("total", Component::Total, drr, &total, 5e-2),
        ("static maximum", Component::Static, mip, &exact.static_max, 5e-2),
        ("dynamic maximum", Component::Dynamic, mip, &exact.dynamic_max, 5e-2),
    ] {
        let want: Vec<f64> = want.iter().map(|v| f64::from(*v)).collect();
        let got = baked.render(rays, 24, 20, 1, Quantity { component, projection })?;
        findings.numbers(BAKED, quantity, &got, &want, Tolerance::OfNorm(max));
    }
    Ok(())
}

/// Cells of baked volumes.
const CELL_MM: f64 = 2.0;
