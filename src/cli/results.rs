//! `eval`, `render` and `info`.

use super::args::{Cli, Component, EvalArgs, InfoArgs, Projection, RenderArgs};
use nertca_vk::data::dataset::{Dataset, Split, manifest_schema};
use nertca_vk::data::geometry::{CArm, Geometry, MM_PER_UNIT, ViewRays};
use nertca_vk::data::images;
use nertca_vk::error::{Error, Result};
use nertca_vk::model::field::Model;
use nertca_vk::output::eval::Evaluation;
use nertca_vk::output::pictures::{self, Window};
use nertca_vk::output::render::Renderer;
use nertca_vk::output::sampled::{BAKED_CELLS, Baked, Quantity};
use nertca_vk::reconstruct::RunInfo;
use nertca_vk::report::{evaluate_model, write_page};
use nertca_vk::train::checkpoint::{self, Checkpoint};
use std::path::Path;
use std::sync::Arc;

fn json(value: &impl serde::Serialize) -> Result<String> {
    serde_json::to_string_pretty(value).map_err(|e| Error::Internal(e.to_string()))
}

/// Scores a run.
pub fn eval(cli: &Cli, args: &EvalArgs) -> Result<()> {
    let data = match &args.data {
        Some(path) => path.clone(),
        None => RunInfo::read(&args.run)?.dataset,
    };
    if args.threshold.is_some_and(|t| !(t.is_finite() && t >= 0.0)) {
        return Err(Error::config("--threshold", args.threshold.unwrap_or_default(), "must not be negative"));
    }
    let dataset = Dataset::open(&data)?;
    let gpu = cli.open_device()?;
    let model = newest_model(&args.run)?;
    let tuning = cli.tuning(&gpu, &model.config);
    let evaluation = evaluate_model(&gpu, &tuning, &model, &dataset, args.threshold, args.images.as_deref())?;
    let run = if args.run.is_dir() { args.run.as_path() } else { args.run.parent().unwrap_or(Path::new("")) };
    let (pictures, page) = match &args.images {
        Some(images) => (images.as_path(), images.join("report.html")),
        None => (Path::new(""), run.join("eval.html")),
    };
    write_page(&gpu, &tuning, &model, &dataset, Some(&evaluation), (run, pictures), &page)?;
    if args.json {
        out!("{}", json(&evaluation)?);
    } else {
        print_table(&evaluation);
    }
    cli.close_device(&gpu)
}

/// Prints scores as a table with means.
pub fn print_table(evaluation: &Evaluation) {
    let dice = |d: Option<f64>| d.map_or("    -".into(), |d| format!("{d:.3}"));
    let angle = |a: Option<f64>| a.map_or("    -".into(), |a| format!("{a:5.0}"));
    out!("primary secondary phase  Dice dynamic  Dice total   PSNR dB   SSIM");
    for i in &evaluation.images {
        out!(
            "{}   {}     {:3}         {}       {}    {:6.2}  {:.3}",
            angle(i.primary_deg),
            angle(i.secondary_deg),
            i.phase,
            dice(i.dice_dynamic),
            dice(i.dice_total),
            i.psnr,
            i.ssim
        );
    }
    out!(
        "mean of {:3} images          {}       {}    {:6.2}  {:.3}",
        evaluation.images.len(),
        dice(evaluation.dice.dynamic),
        dice(evaluation.dice.total),
        evaluation.psnr,
        evaluation.ssim
    );
    out!(
        "Dice threshold {:.4e} / {:.4e} per mm (dynamic / total): {}",
        evaluation.threshold.dynamic_per_mm,
        evaluation.threshold.total_per_mm,
        evaluation.threshold.rule
    );
}

/// The fields of a run's newest checkpoint, or of a checkpoint file.
pub fn newest_model(run: &Path) -> Result<Model> {
    Ok(Checkpoint::read(&checkpoint::newest(run)?)?.model)
}

/// Where and what to render.
struct Shot {
    rays: ViewRays,
    width: usize,
    height: usize,
}

/// A view of the model's C-arm, over the same field of view on more or fewer pixels.
fn shot(model: &Model, primary_deg: f64, secondary_deg: f64, [width, height]: [usize; 2]) -> Result<Shot> {
    let c_arm = CArm {
        primary_deg,
        secondary_deg,
        pixel_mm: [
            model.c_arm.pixel_mm[0] * model.image_size[0] as f64 / width as f64,
            model.c_arm.pixel_mm[1] * model.image_size[1] as f64 / height as f64,
        ],
        ..model.c_arm.clone()
    };
    let rays =
        Geometry::CArm(c_arm).rays(width, height).map_err(|(field, problem)| Error::config(field, "", problem))?;
    Ok(Shot { rays, width, height })
}

/// The fields themselves, or volumes baked from them.
enum Renders {
    Fields(Arc<Renderer>),
    Baked(Box<Baked>),
}

impl Renders {
    /// Line integrals, or maxima per mm.
    fn render(&self, shot: &Shot, phase: u32, component: Component, projection: Projection) -> Result<Vec<f32>> {
        let image = match self {
            Renders::Fields(renderer) => {
                let seen = renderer.render(&shot.rays, shot.width, shot.height, phase)?;
                match (projection, component) {
                    (Projection::Drr, Component::Total) => seen.total_integral(),
                    (Projection::Drr, Component::Static) => seen.static_integral,
                    (Projection::Drr, Component::Dynamic) => seen.dynamic_integral,
                    (Projection::Mip, Component::Total) => seen.total_max,
                    (Projection::Mip, Component::Static) => seen.static_max,
                    (Projection::Mip, Component::Dynamic) => seen.dynamic_max,
                }
            }
            Renders::Baked(baked) => {
                let quantity = Quantity {
                    with_static: component != Component::Dynamic,
                    with_dynamic: component != Component::Static,
                    maximum: projection == Projection::Mip,
                };
                baked.render(&shot.rays, shot.width, shot.height, phase, quantity)?
            }
        };
        Ok(match projection {
            Projection::Drr => image,
            Projection::Mip => image.into_iter().map(|x| x / MM_PER_UNIT as f32).collect(),
        })
    }
}

/// Renders a run.
pub fn render(cli: &Cli, args: &RenderArgs) -> Result<()> {
    let model = newest_model(&args.run)?;
    let size = args.size.map_or(model.image_size, |n| [n, n]);
    if !(1..=images::MAX_SIDE).contains(&size[0]) {
        return Err(Error::config("--size", size[0], format!("1 to {} is accepted", images::MAX_SIDE)));
    }
    let Some(out) = &args.out else { return frame_rates(cli, args, &model) };
    let extension = out.extension().and_then(|e| e.to_str()).unwrap_or_default().to_lowercase();
    if !["png", "npy", "gif"].contains(&extension.as_str()) {
        return Err(Error::config("--out", out.display(), "ends in none of .png .npy .gif"));
    }
    let (phases, _) = super::export::phases(&args.phase, model.layout.phases as u32)?;
    if extension == "png" && phases.len() > 1 {
        return Err(Error::config("--phase", "all", "a .png holds one phase; use .gif or .npy"));
    }
    let shot = shot(&model, args.primary, args.secondary, size)?;
    let (width, height) = (shot.width, shot.height);
    let gpu = cli.open_device()?;
    let renderer = Arc::new(Renderer::new(&gpu, &model, cli.tuning(&gpu, &model.config))?);
    let renders = match args.baked {
        false => Renders::Fields(renderer),
        true => Renders::Baked(Box::new(Baked::new(renderer, BAKED_CELLS)?)),
    };
    let frames = phases
        .iter()
        .map(|phase| renders.render(&shot, *phase, args.component, args.projection))
        .collect::<Result<Vec<Vec<f32>>>>()?;
    let window = Window::of(&frames.concat());
    match extension.as_str() {
        "npy" => {
            let shape = if args.phase == "all" { vec![frames.len(), height, width] } else { vec![height, width] };
            images::write_npy(out, &shape, &frames.concat())?;
        }
        "gif" => pictures::write_gif(out, &frames, width, window, 90)?,
        _ => pictures::write_grey(out, &frames[0], width, window)?,
    }
    drop(renders);
    cli.close_device(&gpu)
}

/// Frames per second of a model turning about the patient, every phase in turn.
#[derive(Debug, Clone, serde::Serialize, serde::Deserialize)]
pub struct FrameRate {
    /// `fields` or `baked`.
    pub way: String,
    /// Columns and rows.
    pub size: usize,
    /// Frames rendered.
    pub frames: u32,
    /// Per second of wall time, read back to the host.
    pub fps: f64,
}

/// Renders for at least `seconds` at each size, both ways.
pub fn measure_frame_rates(
    renderer: &Arc<Renderer>,
    model: &Model,
    component: Component,
    sizes: &[usize],
    seconds: f64,
) -> Result<Vec<FrameRate>> {
    let baked = Renders::Baked(Box::new(Baked::new(renderer.clone(), BAKED_CELLS)?));
    let mut rates = Vec::new();
    for (way, renders) in [("fields", &Renders::Fields(renderer.clone())), ("baked", &baked)] {
        for &size in sizes {
            let frame = |i: u32| {
                let shot = shot(model, f64::from(i * 7 % 180) - 90.0, 10.0, [size, size])?;
                renders.render(&shot, i % model.layout.phases as u32, component, Projection::Drr)
            };
            frame(0)?;
            let (begin, mut frames) = (std::time::Instant::now(), 0);
            while frames < 2 || begin.elapsed().as_secs_f64() < seconds {
                frames += 1;
                frame(frames)?;
            }
            rates.push(FrameRate {
                way: way.into(),
                size,
                frames,
                fps: f64::from(frames) / begin.elapsed().as_secs_f64(),
            });
        }
    }
    Ok(rates)
}

/// Prints frame rates as a table.
pub fn print_frame_rates(rates: &[FrameRate]) {
    for r in rates {
        out!("{:6} {:4} x {:<4} {:9.1} frames/s ({} frames)", r.way, r.size, r.size, r.fps, r.frames);
    }
}

fn frame_rates(cli: &Cli, args: &RenderArgs, model: &Model) -> Result<()> {
    let gpu = cli.open_device()?;
    let renderer = Arc::new(Renderer::new(&gpu, model, cli.tuning(&gpu, &model.config))?);
    let mut sizes = vec![200, 512];
    sizes.extend(args.size.filter(|n| ![200, 512].contains(n)));
    let rates = measure_frame_rates(&renderer, model, args.component, &sizes, 2.0)?;
    out!("{}, {:?}", gpu.info().name, args.component);
    print_frame_rates(&rates);
    drop(renderer);
    cli.close_device(&gpu)
}

/// Describes a dataset or a run.
pub fn info(args: &InfoArgs) -> Result<()> {
    if args.schema {
        out!("{}", manifest_schema().trim_end());
        return Ok(());
    }
    let path = args.path.as_deref().unwrap_or(Path::new("."));
    let is_run = path.is_file() || checkpoint::list(path).is_ok_and(|found| !found.is_empty());
    let described = if is_run { describe_run(path)? } else { describe_dataset(path)? };
    if args.json {
        out!("{}", json(&described)?);
    } else {
        print_tree(&described, 0);
    }
    Ok(())
}

fn describe_run(path: &Path) -> Result<serde_json::Value> {
    let file = checkpoint::newest(path)?;
    let model = Checkpoint::read(&file)?.model;
    Ok(serde_json::json!({
        "kind": "run",
        "checkpoint": file,
        "step": model.step,
        "iterations": model.config.train.iterations,
        "parameters": model.layout.len,
        "phases": model.layout.phases,
        "hull_share": model.hull.as_ref().map(|h| h.share()),
        "scene": model.scene,
        "config": model.config,
    }))
}

fn describe_dataset(path: &Path) -> Result<serde_json::Value> {
    let dataset = Dataset::open(path)?;
    let views: Vec<_> = dataset
        .views
        .iter()
        .enumerate()
        .map(|(index, view)| {
            let of = |split| dataset.frames.iter().filter(|f| f.view == index && f.split == split).count();
            serde_json::json!({
                "geometry": view.geometry,
                "training_frames": of(Split::Train),
                "validation_frames": of(Split::Validation),
            })
        })
        .collect();
    let range = Window::of(&dataset.training().iter().flat_map(|f| f.integrals.iter().copied()).collect::<Vec<_>>());
    Ok(serde_json::json!({
        "kind": "dataset",
        "layout": dataset.layout,
        "image": [dataset.width, dataset.height],
        "phases": dataset.n_phases,
        "depth_range_mm": [dataset.depth_range.0 * MM_PER_UNIT, dataset.depth_range.1 * MM_PER_UNIT],
        "line_integrals": [range.low, range.high],
        "vessel_attenuation_per_mm": dataset.vessel_attenuation.map(|a| a / MM_PER_UNIT),
        "masks": dataset.frames.iter().filter(|f| f.mask.is_some()).count(),
        "views": views,
    }))
}

fn print_tree(value: &serde_json::Value, depth: usize) {
    let Some(map) = value.as_object() else { return };
    for (key, value) in map {
        match value {
            serde_json::Value::Object(_) => {
                out!("{:indent$}{key}:", "", indent = 2 * depth);
                print_tree(value, depth + 1);
            }
            serde_json::Value::Array(items) if items.iter().any(serde_json::Value::is_object) => {
                for (index, item) in items.iter().enumerate() {
                    out!("{:indent$}{key}[{index}]:", "", indent = 2 * depth);
                    print_tree(item, depth + 1);
                }
            }
            other => out!("{:indent$}{key}: {other}", "", indent = 2 * depth),
        }
    }
}
