//! Gaussians as they are drawn: along rays, in volumes, and in pictures at display rates.

use crate::config::{Config, Preset};
use crate::error::{Error, Result};
use crate::gaussians::field::GaussianField;
use crate::gpu::device::Gpu;
use crate::kernels::push::{self, PushConstants};
use crate::kernels::tuning::Tuning;
use crate::model::Model;
use crate::model::component::Component;
use crate::model::params::ParamMap;
use crate::plan::Plan;
use crate::reference::blobs;
use crate::render::grid::Grid;
use crate::render::quantity::{Projection, Quantity};
use crate::render::renderer::Renderer;
use crate::scan::dataset::Dataset;
use crate::scan::small::small_dataset;
use crate::selftest::compare::{Findings, Tolerance};
use crate::selftest::problems::{FAST_NETWORK, drawn_fields, random_gaussians};
use crate::train::trainer::Trainer;
use glam::DVec3;

const RAYS: &[&str] = &[push::GaussianRays::SHADER];
const MAXIMA: &[&str] = &[push::GaussianMaxima::SHADER];
const POINTS: &[&str] = &[push::GaussianPoints::SHADER];
const PICTURES: &[&str] = &["pictures at display rates"];

const INTO_BUFFERS: &[&str] = &[push::GaussianPicture::SHADER];

/// A product and a sum in f32, which devices may round either way.
const SAME: Tolerance = Tolerance::OfLargest(3e-7);
/// Closed forms in f32.
const INTEGRAL: Tolerance = Tolerance::OfLargest(1e-4);
/// The twin steps along the ray, so it may miss a peak by the square of its step; the device may end a climb early.
const MAXIMUM: Tolerance = Tolerance::OfLargest(3e-3);
/// A cell near the cut may fall either way in f32.
const CELL: Tolerance = Tolerance::OfLargest(1e-3);
/// Affine, and cut in the image instead of in space.
const PICTURE: Tolerance = Tolerance::OfLargest(0.01);
/// Every so many cells are compared.
const CELL_STRIDE: usize = 17;

/// A model of a dataset whose dynamic field is `field`; its static field is untrained.
///
/// # Errors
/// Device errors.
pub fn model(gpu: &Gpu, dataset: &Dataset, field: GaussianField, tuning: &Tuning) -> Result<Model> {
    let config = Config::load(Some(FAST_NETWORK), None, &["hull.enabled=false".into()])?;
    let mut trainer = Trainer::new(gpu, Plan::new(&config, dataset)?, dataset, tuning.clone())?;
    let of_network = trainer.model()?;
    let config = Config::preset(Preset::default());
    let param_map = ParamMap::new(&config, dataset.n_phases as usize);
    Ok(Model {
        params: param_map.initial(config.seed),
        param_map,
        config,
        gaussians: Some(field),
        hull: None,
        ..of_network
    })
}

fn form(field: &GaussianField) -> &'static str {
    if field.moving().is_some() { "deformable" } else { "phase" }
}

/// Compares integrals and maximum values along rays, and pictures.
///
/// # Errors
/// Device errors.
pub fn compare_rays(gpu: &Gpu, tuning: &Tuning, findings: &mut Findings) -> Result<()> {
    let (width, height, phase) = (37, 29, 2);
    let dataset = small_dataset(width, height, 3)?;
    for field in drawn_fields() {
        findings.begin(form(&field), "231 Gaussians, view of 37 x 29 pixels");
        let renderer = Renderer::new(gpu, &model(gpu, &dataset, field.clone(), tuning)?, tuning.clone())?;
        let rays = &dataset.views[1].rays;
        let seen = renderer.render(rays, width, height, phase)?;
        let set = blobs::field(&field, phase as usize);
        let ray = |pixel: usize| rays.pixel((pixel % width) as f64, (pixel / width) as f64);
        let want: Vec<blobs::Along> = (0..width * height).map(|pixel| blobs::along(&set, ray(pixel))).collect();
        let integrals: Vec<f64> = want.iter().map(|w| w.integral).collect();
        let maxima: Vec<f64> = want.iter().map(|w| w.maximum).collect();
        findings.numbers(RAYS, "integrals", &seen.dynamic_integral, &integrals, INTEGRAL);
        findings.numbers(RAYS, "maximum values", &seen.dynamic_max, &maxima, MAXIMUM);
        let line = Quantity { component: Component::Dynamic, projection: Projection::Drr };
        let quick = renderer.show(rays, (width, height), phase, line)?;
        findings.numbers(PICTURES, "integrals", &quick, &integrals, PICTURE);
        // In front of what a buffer holds, and instead of it.
        let held: Vec<f32> = (0..quick.len()).map(|pixel| 0.1 + 0.01 * (pixel % 7) as f32).collect();
        let buffer = gpu.buffer_with("image", &held)?;
        for in_front in [true, false] {
            renderer.show_gaussians_into(&buffer, rays, (width, height), phase, in_front)?;
            let shown: Vec<f32> = gpu.download(&buffer, 0, quick.len())?;
            let wanted: Vec<f64> = if in_front {
                quick.iter().zip(&held).map(|(a, b)| f64::from(a + b)).collect()
            } else {
                quick.iter().copied().map(f64::from).collect()
            };
            findings.numbers(INTO_BUFFERS, "integrals", &shown, &wanted, SAME);
        }
    }
    Ok(())
}

/// Compares the maximum values along rays where more Gaussians overlap than peaks are kept of; `config` is that of many Gaussians.
///
/// # Errors
/// Device errors.
pub fn compare_maxima(gpu: &Gpu, config: &Config, tuning: &Tuning, findings: &mut Findings) -> Result<()> {
    findings.begin("r2", "600 Gaussians that overlap, view of 37 x 29 pixels");
    let (width, height) = (37, 29);
    let dataset = small_dataset(width, height, 3)?;
    let mut trainer = Trainer::new(gpu, Plan::new(config, &dataset)?, &dataset, tuning.clone())?;
    let mut model = trainer.model()?;
    let overlapping = overlapping(&model)?;
    model.gaussians = Some(overlapping.clone());
    let rays = &dataset.views[1].rays;
    let seen = Renderer::new(gpu, &model, tuning.clone())?.render(rays, width, height, 0)?;
    let set = blobs::field(&overlapping, 0);
    let ray = |pixel: usize| rays.pixel((pixel % width) as f64, (pixel / width) as f64);
    let want: Vec<blobs::Along> = (0..width * height).map(|pixel| blobs::along(&set, ray(pixel))).collect();
    let maxima: Vec<f64> = want.iter().map(|w| w.maximum).collect();
    findings.numbers(MAXIMA, "maximum values", &seen.dynamic_max, &maxima, MAXIMUM.times(SEARCH_MARGIN));
    Ok(())
}

/// Factor on the tolerance of the search where many Gaussians overlap: peaks between others may be missed, which costs 2 % on one ray of a
/// thousand here.
const SEARCH_MARGIN: f64 = 4.0;
/// Widths of the overlapping Gaussians, from narrowest to widest, shares of the volume's half side: the narrowest lie between
/// the depths that the kernel looks at.
const WIDTHS: [f64; 2] = [0.004, 0.1];

/// Gaussians of phase 0, narrow and wide ones, in a model of many Gaussians.
fn overlapping(model: &Model) -> Result<GaussianField> {
    let Some(GaussianField::PerPhase(mut field)) = model.gaussians.clone() else {
        return Err(Error::Internal("the model has no Gaussians".into()));
    };
    let pixels = model.scene.static_max[0] / field.units.pixel;
    let mut rows = random_gaussians(600, 1, 0.5 * pixels, 6);
    let [narrowest, widest] = WIDTHS.map(|share| (share * pixels).ln());
    let n = rows.len() as f64;
    for (i, g) in rows.iter_mut().enumerate() {
        let width = narrowest + (widest - narrowest) * i as f64 / n;
        g.log_scale = g.log_scale.map(|log| log + width as f32);
    }
    field.rows = rows;
    Ok(GaussianField::PerPhase(field))
}

/// Compares cells of volumes.
///
/// # Errors
/// Device errors.
pub fn compare_cells(gpu: &Gpu, tuning: &Tuning, findings: &mut Findings) -> Result<()> {
    let dataset = small_dataset(13, 11, 3)?;
    let grid = Grid::over(DVec3::new(-0.17, -0.15, -0.16), DVec3::new(0.15, 0.16, 0.12), 75);
    for field in drawn_fields() {
        findings.begin(form(&field), "231 Gaussians, 75 cells along a side");
        let renderer = Renderer::new(gpu, &model(gpu, &dataset, field.clone(), tuning)?, tuning.clone())?;
        let cells = renderer.sample(Component::Dynamic, 1, &grid)?;
        let set = blobs::field(&field, 1);
        let [nx, ny, _] = grid.size.map(|n| n as usize);
        let point = |i: usize| {
            grid.origin + grid.spacing * DVec3::new((i % nx) as f64, (i / nx % ny) as f64, (i / (nx * ny)) as f64)
        };
        let some: Vec<usize> = (0..grid.len()).step_by(CELL_STRIDE).collect();
        let want: Vec<f64> = some.iter().map(|i| blobs::at(&set, point(*i))).collect();
        let got: Vec<f32> = some.iter().map(|i| cells[*i]).collect();
        findings.numbers(POINTS, "attenuation", &got, &want, CELL);
    }
    Ok(())
}
