//! Pictures of Gaussians at display rates: line integrals by the kernels of the fit. The projection is linearised around each
//! centre; its error is smaller than that of cutting Gaussians off.

use crate::error::Result;
use crate::gaussians::blending::picture::{self, BlendedPicture};
use crate::gaussians::blending::stages::BlendKernels;
use crate::gaussians::field::{GaussianField, Units};
use crate::gaussians::stages::{FIXED_POINT_BITS, SplatStage};
use crate::gaussians::view::SplatView;
use crate::geometry::ViewRays;
use crate::gpu::buffer::{Buffer, Memory};
use crate::gpu::device::Gpu;
use crate::gpu::record::{Commands, Groups, Recording};
use crate::kernels::dispatch::{Binding, BufferSet, buffer_set, dispatch, dispatch_finding};
use crate::kernels::layout::{Gaussian, GaussianSetup, GaussianView, Splat};
use crate::kernels::push;
use crate::kernels::stages::{Build, Stage};
use std::collections::HashMap;
use std::sync::{Arc, Mutex, PoisonError};

/// Maximum number of recorded pictures that are kept; a display needs far fewer.
const MAX_RECORDED: usize = 256;
/// Pixels of recorded pictures beyond which they are discarded: 64 MiB on the device.
const MAX_RECORDED_PIXELS: usize = 1 << 24;

/// Builds the stage that writes a picture into a buffer; the other stages are those of fits.
///
/// # Errors
/// Errors of [`Gpu::pipeline`].
pub fn into_buffers(gpu: &Gpu) -> Result<Stage<push::GaussianPicture>> {
    Build::default().stage(gpu)
}

/// Line integral of one unit of the fixed-point sums.
fn line_integral(units: Units) -> f32 {
    (units.strongest / 2f64.powi(FIXED_POINT_BITS)) as f32
}

/// Key of a recorded picture: its size and time.
#[derive(Clone, Copy, PartialEq, Eq, Hash)]
struct Key {
    columns: usize,
    rows: usize,
    /// Bits of the time in phases.
    time: u64,
}

/// Contrast in the vessels of a picture.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Fill {
    /// All vessels are full.
    Full,
    /// Vessels are filled as in the images of the fit.
    Imaged,
}

/// Draws line integrals of a dynamic field that consists of Gaussians, or the blended intensities where nearer Gaussians hide
/// those behind them.
pub struct Pictures {
    gpu: Gpu,
    project: Stage<push::GaussianProject>,
    splat: SplatStage<push::GaussianSplat>,
    show: Stage<push::GaussianPicture>,
    /// Stages for Gaussians of which nearer ones hide those behind them; none where line integrals add up.
    blend: Option<BlendKernels>,
    fill: Fill,
    state: Mutex<State>,
}

/// The field, and pictures recorded of it.
struct State {
    field: GaussianField,
    recorded: HashMap<Key, Arc<Picture>>,
    blended: HashMap<Key, Arc<Mutex<BlendedPicture>>>,
}

impl State {
    fn new(field: &GaussianField) -> State {
        State { field: field.clone(), recorded: HashMap::new(), blended: HashMap::new() }
    }
}

buffer_set! {
    /// Buffers that the stages bind.
    struct PictureBuffers {
        /// [`GaussianSetup`].
        gaussian_setup,
        /// One [`GaussianView`].
        gaussian_views,
        /// The picture is image 0 at every phase.
        image_of_view,
        /// Gaussians of the phase.
        gaussians,
        /// [`Splat`]s.
        splats,
        /// Image that each splat belongs to.
        image_of_splat,
        /// The picture in fixed point.
        splat_images,
    }
}

struct Picture {
    commands: Commands,
    buffers: PictureBuffers,
    /// Lock held while the picture is drawn.
    in_use: Mutex<()>,
}

impl Pictures {
    /// Prepares to draw a field.
    ///
    /// # Errors
    /// Errors of [`Gpu::pipeline`].
    pub fn new(gpu: &Gpu, field: &GaussianField) -> Result<Pictures> {
        Pictures::filled(gpu, field, Fill::Full)
    }

    /// Prepares to draw a field as the images of its fit show it, with vessels that are filled as far as contrast had come.
    ///
    /// # Errors
    /// Errors of [`Gpu::pipeline`].
    pub fn as_imaged(gpu: &Gpu, field: &GaussianField) -> Result<Pictures> {
        Pictures::filled(gpu, field, Fill::Imaged)
    }

    fn filled(gpu: &Gpu, field: &GaussianField, fill: Fill) -> Result<Pictures> {
        let state = Mutex::new(State::new(field));
        let project = Build::default().stage(gpu)?;
        let blend = field.rows().intensities.as_ref().map(|_| BlendKernels::new(gpu)).transpose()?;
        let (splat, show) = (SplatStage::new(gpu)?, into_buffers(gpu)?);
        Ok(Pictures { gpu: gpu.clone(), project, splat, show, blend, fill, state })
    }

    /// Replaces the field to be drawn.
    pub fn replace(&self, field: &GaussianField) {
        let mut state = self.state.lock().unwrap_or_else(PoisonError::into_inner);
        *state = State::new(field);
    }

    /// Returns line integrals of a `width` x `height` view at a phase, row by row.
    ///
    /// # Errors
    /// Device errors.
    pub fn draw(&self, rays: &ViewRays, size: (usize, usize), phase: u32) -> Result<Vec<f32>> {
        self.draw_at(rays, size, f64::from(phase))
    }

    /// Returns the picture of [`Pictures::draw`] at a time counted in phases; at the nearest phase where each phase has its own
    /// set.
    ///
    /// # Errors
    /// Device errors.
    pub fn draw_at(&self, rays: &ViewRays, (width, height): (usize, usize), phases: f64) -> Result<Vec<f32>> {
        let key = Key { columns: width, rows: height, time: phases.to_bits() };
        let mut sums = vec![0i32; width * height];
        if self.blended(key, rays, |picture| Ok(picture.read(&mut sums)?))?.is_some() {
            return Ok(sums.iter().map(|v| *v as f32 * picture::unit()).collect());
        }
        let (units, picture) = self.picture(key)?;
        let _alone = picture.in_use.lock().unwrap_or_else(PoisonError::into_inner);
        picture.buffers.gaussian_views.write(&[SplatView::new(rays, units).to_device()])?;
        self.gpu.wait(picture.commands.submit()?)?;
        picture.buffers.splat_images.read(&mut sums)?;
        Ok(sums.iter().map(|v| *v as f32 * line_integral(units)).collect())
    }

    /// Draws a view as [`Pictures::draw`] does, into a buffer of `width` x `height` floats on the device. The picture is added
    /// to the line integrals in the buffer if `in_front`, otherwise it replaces them.
    ///
    /// # Errors
    /// Device errors.
    pub fn draw_into(
        &self,
        target: &Buffer,
        rays: &ViewRays,
        (width, height): (usize, usize),
        phase: u32,
        in_front: bool,
    ) -> Result<()> {
        let key = Key { columns: width, rows: height, time: f64::from(phase).to_bits() };
        let n_pixels = (width * height) as u32;
        let into = |sums: &Buffer, unit: f32| -> Result<Commands> {
            let push = push::GaussianPicture { n_pixels, unit, in_front: u32::from(in_front) };
            let bound = [(Binding::splat_images, sums.into()), (Binding::image, target.into())];
            let mut recording = Recording::new(&self.gpu, "picture of Gaussians into a buffer")?;
            dispatch(&mut recording, &self.show, self.show.groups_over(n_pixels), &bound, push)?;
            Ok(recording.finish()?)
        };
        let show_blended = |sums: &Buffer| Ok(self.gpu.wait(into(sums, picture::unit())?.submit()?)?);
        if self.blended(key, rays, show_blended)?.is_some() {
            return Ok(());
        }
        let (units, picture) = self.picture(key)?;
        let _alone = picture.in_use.lock().unwrap_or_else(PoisonError::into_inner);
        picture.buffers.gaussian_views.write(&[SplatView::new(rays, units).to_device()])?;
        let shown = into(&picture.buffers.splat_images, line_integral(units))?;
        self.gpu.wait(picture.commands.submit()?)?;
        Ok(self.gpu.wait(shown.submit()?)?)
    }

    /// Draws a view of Gaussians that hide each other and passes the fixed-point image to `take`; none where line integrals add
    /// up.
    fn blended<T>(&self, key: Key, rays: &ViewRays, take: impl FnOnce(&Buffer) -> Result<T>) -> Result<Option<T>> {
        let Some(kernels) = &self.blend else { return Ok(None) };
        let picture = {
            let mut state = self.state.lock().unwrap_or_else(PoisonError::into_inner);
            if state.blended.len() >= MAX_RECORDED {
                state.blended.clear();
            }
            match state.blended.get(&key) {
                Some(picture) => picture.clone(),
                None => {
                    let (sets, size) = (state.field.rows(), [key.columns, key.rows]);
                    let phase = f64::from_bits(key.time).round() as usize % sets.n_phases;
                    let picture = Arc::new(Mutex::new(BlendedPicture::new(&self.gpu, sets, phase, size)?));
                    state.blended.insert(key, picture.clone());
                    picture
                }
            }
        };
        let mut picture = picture.lock().unwrap_or_else(PoisonError::into_inner);
        take(picture.draw(&self.gpu, kernels, rays)?).map(Some)
    }

    /// Tells whether nearer Gaussians hide those behind them, so that pictures are not line integrals.
    pub fn are_blended(&self) -> bool {
        self.blend.is_some()
    }

    fn picture(&self, key: Key) -> Result<(Units, Arc<Picture>)> {
        let mut state = self.state.lock().unwrap_or_else(PoisonError::into_inner);
        let units = state.field.rows().units;
        if let Some(picture) = state.recorded.get(&key) {
            return Ok((units, picture.clone()));
        }
        let pixels = state.recorded.keys().map(|key| key.columns * key.rows).sum::<usize>();
        if state.recorded.len() >= MAX_RECORDED || pixels + key.columns * key.rows > MAX_RECORDED_PIXELS {
            state.recorded.clear();
        }
        let picture = Arc::new(self.record(&state.field, key)?);
        state.recorded.insert(key, picture.clone());
        Ok((units, picture))
    }

    fn record(&self, field: &GaussianField, key: Key) -> Result<Picture> {
        let (gpu, sets) = (&self.gpu, field.rows());
        let (width, height) = (key.columns, key.rows);
        let time = f64::from_bits(key.time);
        let rows = match self.fill {
            Fill::Full => field.at_time(time),
            Fill::Imaged => field.imaged_at_time(time),
        };
        let n = rows.len() as u32;
        let pixels = (width * height) as u32;
        let setup = GaussianSetup {
            n_views: 1,
            n_phases: sets.n_phases as u32,
            width: width as u32,
            height: height as u32,
            fixed_point: 2f32.powi(FIXED_POINT_BITS),
            n_images: 1,
            image_stride: pixels,
            blur: 0.0,
            ..sets.setup
        };
        // Buffers are never empty.
        let min = u64::from(n.max(1));
        let rows = if rows.is_empty() { vec![Gaussian::default()] } else { rows };
        let buffers = PictureBuffers {
            gaussian_setup: gpu.buffer_with("gaussian_setup of a picture", &[setup])?,
            gaussian_views: gpu.buffer(
                "gaussian_views of a picture",
                size_of::<GaussianView>() as u64,
                Memory::Upload,
            )?,
            image_of_view: gpu.buffer_with("image_of_view of a picture", &vec![0i32; sets.n_phases])?,
            gaussians: gpu.buffer_with("gaussians of a picture", &rows)?,
            splats: gpu.buffer("splats of a picture", size_of::<Splat>() as u64 * min, Memory::Device)?,
            image_of_splat: gpu.buffer("image_of_splat of a picture", 4 * min, Memory::Device)?,
            splat_images: gpu.buffer("splat_images of a picture", 4 * u64::from(pixels), Memory::Readback)?,
        };
        let mut recording = Recording::new(gpu, "picture of Gaussians")?;
        recording.fill(&buffers.splat_images, 0);
        if n > 0 {
            let find = |name| buffers.find(name);
            let push = push::GaussianProject { n_gaussians: n };
            let groups = Groups::Direct([n.div_ceil(self.project.local_size()), 1, 1]);
            dispatch_finding(&mut recording, &self.project, groups, &[], find, push)?;
            let push = push::GaussianSplat { n_splats: n };
            dispatch_finding(&mut recording, &self.splat.stage, self.splat.groups_for(n), &[], find, push)?;
        }
        Ok(Picture { commands: recording.finish()?, buffers, in_use: Mutex::default() })
    }
}
