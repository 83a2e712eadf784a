//! The command `render`.

use crate::args::options::{GlobalOptions, choice};
use crate::args::viewpoint::{Viewpoint, turned, viewpoint};
use crate::output::random_numbers;
use crate::viewer::frame_rates::{measure_frame_rates, print_frame_rates};
use clap::Args;
use nertca_vk::checkpoint::newest_model;
use nertca_vk::choice::Choice;
use nertca_vk::error::{Error, Result};
use nertca_vk::export::dicom::{self, DicomView};
use nertca_vk::formats::image_limits::MAX_SIDE;
use nertca_vk::formats::npy;
use nertca_vk::geometry::MM_PER_UNIT;
use nertca_vk::model::Model;
use nertca_vk::model::component::Component;
use nertca_vk::render::baked::{BAKED_CELLS, Baked};
use nertca_vk::render::quantity::{Projection, Quantity};
use nertca_vk::render::renderer::Renderer;
use nertca_vk::scan::gating::{SYSTOLE_S, SYSTOLE_SHARE};
use nertca_vk_vessels::score::pictures::{self, Window};
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// Arguments of `render`.
#[derive(Debug, Args)]
pub struct RenderArgs {
    /// Run directory or checkpoint file.
    pub run: PathBuf,
    /// Primary angle, degrees, LAO positive.
    #[arg(long, allow_negative_numbers = true, value_name = "DEG", default_value_t = 0.0)]
    pub primary: f64,
    /// Secondary angle, degrees, cranial positive.
    #[arg(long, allow_negative_numbers = true, value_name = "DEG", default_value_t = 0.0)]
    pub secondary: f64,
    /// Phase from 0, or `all`; a fraction such as 3.4 lies between two phases, which a network or one deformable set of
    /// Gaussians supports (not gaussians.form = "phase" of the preset `fast`).
    #[arg(long, default_value = "0", allow_negative_numbers = true)]
    pub phase: String,
    /// Number of pictures between neighbouring phases, for smooth animations with --phase all.
    #[arg(long, default_value_t = 0, value_name = "N", value_parser = clap::value_parser!(u32).range(0..=32))]
    pub between: u32,
    /// Field to show: both, the static background or the dynamic vessels.
    #[arg(long, value_parser = choice::<Component>(), default_value = Component::Total.name())]
    pub component: Component,
    /// Line integral (`drr`) or maximum attenuation along the ray (`mip`).
    #[arg(long, value_parser = choice::<Projection>(), default_value = Projection::Drr.name())]
    pub projection: Projection,
    /// Columns and rows; by default those of the dataset.
    #[arg(long)]
    pub size: Option<usize>,
    /// Render from volumes baked from the fields: faster, with the resolution of their cells.
    #[arg(long)]
    pub baked: bool,
    /// Measure frames per second, including the read-back to the host, of the chosen component seen from a rotating
    /// C-arm: from the fields and from baked volumes, at 200 x 200, 512 x 512 and --size.
    #[arg(long)]
    pub fps: bool,
    /// Output: .png, .npy (floats; all phases stacked), .gif (all phases) or .dcm (line integrals as an X-ray angiogram,
    /// derived and for research only, with the detector centred).
    #[arg(short, long, value_name = "FILE", required_unless_present = "fps")]
    pub out: Option<PathBuf>,
}

/// Renderer of the fields themselves, or of volumes baked from them.
pub enum Renders {
    Fields(Arc<Renderer>),
    Baked(Box<Baked>),
}

impl Renders {
    /// Renders line integrals, or maxima per mm.
    pub fn render(&self, viewpoint: &Viewpoint, phase: f64, quantity: Quantity) -> Result<Vec<f32>> {
        let (rays, width, height) = (&viewpoint.rays, viewpoint.width, viewpoint.height);
        let image = match self {
            Renders::Fields(renderer) => renderer.render_at(rays, width, height, phase)?.show(quantity),
            Renders::Baked(_) if phase.fract() != 0.0 => {
                return Err(Error::config("--baked", phase, "volumes are baked at whole phases only: omit --baked"));
            }
            Renders::Baked(baked) => baked.render(rays, width, height, phase as u32, quantity)?,
        };
        Ok(match quantity.projection {
            Projection::Drr => image,
            Projection::Mip => image.into_iter().map(|x| x / MM_PER_UNIT as f32).collect(),
        })
    }
}

/// Milliseconds between the phases of an animation, and the minimum that viewers respect.
const PHASE_MS: u32 = 90;
const MIN_MS: u32 = 20;

/// Writes frames as an angiogram of a heart of 68 beats per minute; the true heart rate is not stored.
fn write_dicom(args: &RenderArgs, out: &Path, model: &Model, viewpoint: &Viewpoint, frames: &[Vec<f32>]) -> Result<()> {
    let size = [viewpoint.width, viewpoint.height];
    let beat_frames = model.shown_phases() * (args.between + 1);
    let shown = args.component.name();
    let description = format!(
        "Rendering of a reconstruction of {} iterations: {shown} attenuation, phase {}",
        model.step, args.phase
    );
    let view = DicomView {
        c_arm: &turned(model, args.primary, args.secondary, size),
        size,
        frames,
        frame_ms: 1e3 * SYSTOLE_S / SYSTOLE_SHARE / f64::from(beat_frames),
        description: &description,
        seeds: random_numbers()?,
    };
    dicom::write(out, &view)
}

/// Returns the moments of the beat that `--phase` and `--between` name.
fn moments(args: &RenderArgs, model: &Model) -> Result<Vec<f64>> {
    let n_phases = model.shown_phases();
    if model.scene.still && args.between > 0 {
        return Err(Error::config("--between", args.between, "an object at rest has one phase only"));
    }
    let between = args.between + 1;
    if args.phase == "all" {
        return Ok((0..n_phases * between).map(|i| f64::from(i) / f64::from(between)).collect());
    }
    if args.between > 0 {
        return Err(Error::config("--between", args.between, "pictures between phases need --phase all"));
    }
    // A continuous beat is periodic: its end equals its beginning.
    let last = if model.is_continuous() && !model.scene.still { n_phases } else { n_phases - 1 };
    match args.phase.parse::<f64>() {
        Ok(phase) if (0.0..=f64::from(last)).contains(&phase) => Ok(vec![phase]),
        _ => Err(Error::config("--phase", &args.phase, format!("is neither `all` nor a phase from 0 to {last}"))),
    }
}

/// Measures frame rates and prints them.
fn print_measured(global: &GlobalOptions, args: &RenderArgs, model: &Model) -> Result<()> {
    let gpu = global.open_device()?;
    let renderer = Arc::new(Renderer::new(&gpu, model, global.tuning(&gpu, &model.config))?);
    let mut sizes = vec![200, 512];
    sizes.extend(args.size.filter(|n| ![200, 512].contains(n)));
    let rates = measure_frame_rates(&renderer, model, args.component, &sizes, 2.0)?;
    out!("{}, {:?}", gpu.info().name, args.component);
    print_frame_rates(&rates);
    drop(renderer);
    global.close_device(&gpu)
}

/// Renders a run.
pub fn render(global: &GlobalOptions, args: &RenderArgs) -> Result<()> {
    let mut model = newest_model(&args.run)?;
    let size = args.size.map_or(model.image_size, |n| [n, n]);
    if !(1..=MAX_SIDE).contains(&size[0]) {
        return Err(Error::config("--size", size[0], format!("is not in the accepted range, 1 to {}", MAX_SIDE)));
    }
    let Some(out) = &args.out else { return print_measured(global, args, &model) };
    let extension = out.extension().and_then(|e| e.to_str()).unwrap_or_default().to_lowercase();
    if !["png", "npy", "gif", "dcm"].contains(&extension.as_str()) {
        return Err(Error::config("--out", out.display(), "does not end in one of .png .npy .gif .dcm"));
    }
    if extension == "dcm" && args.projection != Projection::Drr {
        return Err(Error::config(
            "--projection",
            args.projection.name(),
            "is not supported in an angiogram (.dcm), which holds line integrals: use `drr`",
        ));
    }
    let phases = moments(args, &model)?;
    if extension == "png" && phases.len() > 1 {
        return Err(Error::config("--phase", "all", "a .png holds one phase only; use .gif or .npy"));
    }
    if extension == "dcm" {
        // The file format can state neither the offset of the detector's middle nor the position of the table.
        (model.c_arm.offset_mm, model.c_arm.table_mm) = ([0.0; 2], [0.0; 3]);
    }
    let viewpoint = viewpoint(&model, args.primary, args.secondary, size)?;
    let (width, height) = (viewpoint.width, viewpoint.height);
    let gpu = global.open_device()?;
    let renderer = Arc::new(Renderer::new(&gpu, &model, global.tuning(&gpu, &model.config))?);
    let renders = match args.baked {
        false => Renders::Fields(renderer),
        true => Renders::Baked(Box::new(Baked::new(renderer, BAKED_CELLS)?)),
    };
    let quantity = Quantity { component: args.component, projection: args.projection };
    let frames =
        phases.iter().map(|phase| renders.render(&viewpoint, *phase, quantity)).collect::<Result<Vec<Vec<f32>>>>()?;
    let window = Window::of(&frames.concat());
    match extension.as_str() {
        "npy" => {
            let shape = if args.phase == "all" { vec![frames.len(), height, width] } else { vec![height, width] };
            npy::write(out, &shape, &frames.concat())?;
        }
        "gif" => {
            let ms = (PHASE_MS / (args.between + 1)).max(MIN_MS);
            pictures::write_gif(out, &frames, width, window, ms)?;
        }
        "dcm" => write_dicom(args, out, &model, &viewpoint, &frames)?,
        _ => pictures::write_grey(out, &frames[0], width, window)?,
    }
    drop(renders);
    global.close_device(&gpu)
}
