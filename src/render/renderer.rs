//! Projections of a reconstruction for any pose and phase, through the kernels that train it.

use crate::error::{Error, Result};
use crate::fields::setup::sample_capacity;
use crate::gaussians::blobs::{BlobList, Blobs};
use crate::gaussians::field::GaussianField;
use crate::gaussians::pictures::Pictures;
use crate::geometry::ViewRays;
use crate::gpu::buffer::{Buffer, Memory};
use crate::gpu::device::Gpu;
use crate::gpu::pace::{LONGEST_SLICE_S, SubmitPace};
use crate::gpu::record::{Commands, MAX_GROUPS, Recording};
use crate::kernels::layout::{DeviceState, Pose, RayOut, Schedule, Setup, View};
use crate::kernels::push;
use crate::kernels::stages::Kernels;
use crate::kernels::tuning::Tuning;
use crate::model::Model;
use crate::model::component::Component;
use crate::model::field::FieldDrawing;
use crate::model::params::ParamMap;
use crate::network::chunk::{Chunk, chunk_rays, chunk_samples, packed};
use crate::network::forward::{ForwardBuffers, PoseBuffers};
use crate::network::pass::Pass;
use crate::network::static_network::StaticNetwork;
use crate::network::{Network, Purpose, largest_chunk};
use crate::render::backgrounds::{Background, BackgroundOf, Backgrounds};
use crate::render::quantity::{Projection, Quantity, RenderedParts};
use crate::scan::gating::BeatTime;
use bytemuck::Zeroable;
use std::collections::HashMap;
use std::collections::hash_map::Entry;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Instant;

/// Pixels rendered by one submit, which has a workgroup for each.
pub(super) const RAYS_PER_SUBMIT: u32 = MAX_GROUPS;

/// Cells of a volume sampled by one submit: 16 MiB on their way to the host.
pub(super) const CELLS_PER_SUBMIT: u32 = 1 << 22;

/// Pixels rendered by the first submits, whose times tell how many the next may have.
const FIRST_RAYS: u32 = 4096;

/// Pixels of the first slices of long work, whose times tell how many the next may have.
const FIRST_SLICE_RAYS: u32 = 512;
/// Cells of a volume in the first slices of long work.
const FIRST_SLICE_CELLS: u32 = 1 << 14;

/// Function that is called between the slices of long work: it may wait, or end the work by an error.
pub type Interlude = Arc<dyn Fn() -> Result<()> + Send + Sync>;

/// Values seen by every pixel of a view; all lists are rows first, attenuation per world unit.
#[derive(Debug, Clone, Default)]
pub struct Rendering {
    /// Line integral of the static field.
    pub static_integral: Vec<f32>,
    /// Line integral of the dynamic field; for X-Gaussian its blended picture, from about 0 to 1.
    pub dynamic_integral: Vec<f32>,
    /// Largest attenuation of the static field along the ray.
    pub static_max: Vec<f32>,
    /// Largest attenuation of the dynamic field along the ray.
    pub dynamic_max: Vec<f32>,
    /// Largest sum of both along the ray.
    pub total_max: Vec<f32>,
    /// Whether the picture is X-Gaussian's blended one and no line integral.
    pub is_blended: bool,
}

impl Rendering {
    fn extend(&mut self, seen: &[RayOut]) {
        for r in seen {
            self.static_integral.push(r.static_integral);
            self.dynamic_integral.push(r.dynamic_integral);
            self.static_max.push(r.static_max);
            self.dynamic_max.push(r.dynamic_max);
            self.total_max.push(r.total_max);
        }
    }

    /// Returns the quantity that a view shows; maxima per world unit.
    pub fn show(self, quantity: Quantity) -> Vec<f32> {
        match (quantity.projection, quantity.component) {
            (Projection::Drr, Component::Total) => self.total_integral(),
            (Projection::Drr, Component::Static) => self.static_integral,
            (Projection::Drr, Component::Dynamic) => self.dynamic_integral,
            (Projection::Mip, Component::Total) => self.total_max,
            (Projection::Mip, Component::Static) => self.static_max,
            (Projection::Mip, Component::Dynamic) => self.dynamic_max,
        }
    }

    /// Sum of both integrals.
    pub fn total_integral(&self) -> Vec<f32> {
        self.static_integral.iter().zip(&self.dynamic_integral).map(|(s, d)| s + d).collect()
    }
}

/// Renders a model on a device.
pub struct Renderer {
    pub(super) gpu: Gpu,
    pub(super) kernels: Kernels,
    /// The dynamic field's network; none where Gaussians or another field are the dynamic field.
    network: Option<Network>,
    /// Static field, where it is a network as well.
    pub(super) static_network: Option<StaticNetwork>,
    pub(super) buffers: ForwardBuffers,
    pub(super) setup: Setup,
    param_map: ParamMap,
    /// Gaussians, where they are the dynamic field.
    pub(super) blobs: Option<Blobs>,
    pictures: Option<Pictures>,
    /// Field of a method of `crate::methods`, which is then the only field.
    pub(super) field: Option<Box<dyn FieldDrawing>>,
    /// Submit pace per kind of rendering, without and with the static field, of integrals and of maxima; their costs differ.
    paces: [SubmitPace; 4],
    /// Submit pace of volumes, without and with the static field; none where a submit may take all cells that have room.
    pub(super) volume_paces: Option<[SubmitPace; 2]>,
    /// Called between slices.
    interlude: Option<Interlude>,
    drawn: Mutex<Drawn>,
}

impl Renderer {
    /// Loads a model.
    ///
    /// # Errors
    /// Device errors.
    pub fn new(gpu: &Gpu, model: &Model, tuning: Tuning) -> Result<Renderer> {
        let tuning = tuning.for_network(model.config.has_network());
        let (samples, hull) = (model.config.render.render_samples, model.hull.as_ref());
        let fields = model.config.fields();
        let mut setup = match &fields {
            Some(settings) => model.scene.setup(settings, &model.param_map, hull),
            None => model.scene.placed(&model.param_map, hull),
        };
        setup.sample_capacity = sample_capacity(model.config.train.chunk_samples.max(samples));
        setup.jitter = 0;
        setup.occupancy_cells = 0;
        // Nothing is penalised, and a rendering has no batch whose last ray could decide.
        setup.occlusion_share = 0.0;
        setup.n_static_samples = samples;
        if model.gaussians.is_none() || fields.is_none() {
            setup.n_dynamic_samples = samples;
        }
        let limit = model.param_map.dynamic_network.as_ref().map_or(u32::MAX, |map| largest_chunk(gpu, &tuning, map));
        let largest = tuning.chunk_samples.min(limit);
        setup.sample_capacity = setup.sample_capacity.min(sample_capacity(largest));
        let network = model.param_map.dynamic_network.as_ref();
        let network = network.map(|map| Network::new(gpu, &tuning, &setup, map, Purpose::Render)).transpose()?;
        let kernels = Kernels::new(gpu, tuning, model.param_map.line_len() as u32, setup.n_static_samples)?;
        let schedule = gpu.buffer("schedule", size_of::<Schedule>() as u64, Memory::Upload)?;
        let (tuning, param_map, hull) = (&kernels.tuning, &model.param_map, model.hull.as_ref());
        let buffers = ForwardBuffers::new(gpu, tuning, &setup, param_map, RAYS_PER_SUBMIT, schedule, hull)?;
        let static_network = param_map.static_network.as_ref();
        let static_network =
            static_network.map(|map| StaticNetwork::new(gpu, tuning, &setup, map, &buffers, Purpose::Render));
        let static_network = static_network.transpose()?;
        // The schedule has a single row, that of the model's step.
        gpu.upload(&buffers.state, 0, &[DeviceState::default()])?;
        if network.is_none() {
            let mut recording = Recording::new(gpu, "no samples")?;
            buffers.clear_samples(&mut recording);
            gpu.wait(recording.finish()?.submit()?)?;
        }
        let blobs = model.gaussians.as_ref().map(|field| Blobs::new(gpu, tuning, field)).transpose()?;
        let pictures = model.gaussians.as_ref().map(|field| Pictures::new(gpu, field)).transpose()?;
        let field = model.field.as_ref().map(|field| field.drawing(gpu)).transpose()?;
        let param_map = model.param_map.clone();
        let gpu = gpu.clone();
        let pace = |_| SubmitPace::new(kernels.tuning.longest_submit_s, FIRST_RAYS, RAYS_PER_SUBMIT);
        let paces = std::array::from_fn(pace);
        let drawn = Mutex::default();
        let renderer = Renderer {
            gpu,
            kernels,
            network,
            static_network,
            buffers,
            setup,
            param_map,
            blobs,
            pictures,
            field,
            paces,
            volume_paces: None,
            interlude: None,
            drawn,
        };
        renderer.set_params(model)?;
        Ok(renderer)
    }

    /// Divides its work into slices of bounded device time, also on devices without a watchdog, with `interlude` before each: other
    /// work, such as live pictures, passes between them. Results are the same, bit by bit.
    #[must_use]
    pub fn in_slices(self, interlude: Interlude) -> Renderer {
        let longest_s = self.kernels.tuning.longest_submit_s.unwrap_or(LONGEST_SLICE_S).min(LONGEST_SLICE_S);
        let pace = |first, max| SubmitPace::new(Some(longest_s), first, max).giving_way_to(self.gpu.looks());
        let paces = std::array::from_fn(|_| pace(FIRST_SLICE_RAYS, RAYS_PER_SUBMIT));
        let volume_paces = Some(std::array::from_fn(|_| pace(FIRST_SLICE_CELLS, CELLS_PER_SUBMIT)));
        Renderer { paces, volume_paces, interlude: Some(interlude), ..self }
    }

    /// Lets other work pass before a slice.
    pub(super) fn pause(&self) -> Result<()> {
        self.interlude.as_ref().map_or(Ok(()), |interlude| interlude())
    }

    /// Acquires the buffers in which rays and samples of one view or one volume have their place on the device.
    pub(super) fn alone(&self) -> MutexGuard<'_, Drawn> {
        self.drawn.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Replaces parameters, window and Gaussians by those of `model`, which must have the same parameters.
    ///
    /// # Errors
    /// [`Error::Internal`] for other parameters; device errors.
    pub fn set_model(&self, model: &Model) -> Result<()> {
        let same_method =
            model.gaussians.is_some() == self.blobs.is_some() && model.field.is_some() == self.field.is_some();
        if model.param_map != self.param_map || !same_method {
            return Err(Error::Internal(
                "the parameters of the model do not have the shape that the renderer was created for".into(),
            ));
        }
        if let Some(field) = &model.gaussians {
            self.set_gaussians(field)?;
        }
        if let (Some(field), Some(drawing)) = (&model.field, &self.field) {
            drawing.replace(field.as_ref())?;
        }
        self.set_params(model)
    }

    /// Replaces the dynamic field of a model that has Gaussians.
    ///
    /// # Errors
    /// [`Error::Internal`] where a network is the dynamic field; device errors.
    pub fn set_gaussians(&self, field: &GaussianField) -> Result<()> {
        match (&self.blobs, &self.pictures) {
            (Some(blobs), Some(pictures)) => {
                pictures.replace(field);
                blobs.replace(field);
                Ok(())
            }
            _ => Err(Error::Internal("the dynamic field of this model is a network".into())),
        }
    }

    /// Draws from parameters on the device, for a field that its method draws itself; does nothing for other fields.
    pub fn follow_fit(&self, params: &[Buffer]) {
        if let Some(drawing) = &self.field {
            drawing.follow(params.to_vec());
        }
    }

    fn set_params(&self, model: &Model) -> Result<()> {
        // Nothing is drawn between the old parameters and the new ones.
        let mut drawn = self.alone();
        drawn.backgrounds.forget();
        self.gpu.upload(&self.buffers.params, 0, &model.params)?;
        Ok(self.buffers.schedule.write(&[model.config.schedule(model.step)])?)
    }

    /// Takes the parameters in `params`, of a run in training, as they are after everything submitted so far; returns
    /// at once. `schedule` is that of the run's present iteration. Keep the result until what is rendered next is done:
    /// dropping it waits.
    ///
    /// # Errors
    /// [`Error::Internal`] when the buffer has another size; device errors.
    pub fn follow(&self, params: &Buffer, schedule: Schedule) -> Result<Commands> {
        let mut drawn = self.alone();
        drawn.backgrounds.forget();
        let mut recording = Recording::new(&self.gpu, "follow")?;
        recording.copy(params, 0, &self.buffers.params, 0, self.param_map.len as u64 * 4)?;
        self.buffers.schedule.write(&[schedule])?;
        let commands = recording.finish()?;
        commands.submit()?;
        Ok(commands)
    }

    /// Refuses a phase the model does not have.
    ///
    /// # Errors
    /// [`Error::Config`] naming the phase.
    pub fn check_phase(&self, phase: u32) -> Result<()> {
        if phase < self.setup.n_phases {
            return Ok(());
        }
        Err(Error::config("phase", phase, format!("is out of range: phases go from 0 to {}", self.setup.n_phases - 1)))
    }

    /// Gaussians interpolated between two phases.
    fn between(&self, phase: f64) -> Result<BlobList> {
        match self.blobs.as_ref().map(|blobs| blobs.between(phase)).transpose()?.flatten() {
            Some(list) => Ok(list),
            None => Err(Error::config(
                "phase",
                phase,
                "lies between two phases, and the dynamic field of this model has whole phases only: choose a whole \
                 phase, or train one deformable set of Gaussians (preset fast with gaussians.form = \"deformable\") or a \
                 network",
            )),
        }
    }

    /// Maximum number of samples of a ray.
    pub(super) fn largest_row(&self) -> u32 {
        self.setup.sample_capacity / 128 * 128
    }

    /// Inputs of the forward stages; `buffers` and `setup` may differ from the renderer's own in the points they sample.
    pub(super) fn pass<'a>(
        &'a self,
        recording: &'a mut Recording,
        buffers: &'a ForwardBuffers,
        setup: &'a Setup,
    ) -> Pass<'a> {
        let (kernels, network, params) = (&self.kernels, self.network.as_ref(), &self.param_map);
        Pass {
            recording,
            kernels,
            network,
            static_network: self.static_network.as_ref(),
            buffers,
            training: None,
            params,
            setup,
        }
    }

    /// Renders a `width` x `height` view at a phase.
    ///
    /// # Errors
    /// [`Error::Config`] for a phase the model does not have; device errors.
    pub fn render(&self, rays: &ViewRays, width: usize, height: usize, phase: u32) -> Result<Rendering> {
        self.render_parts(rays, (width, height), phase, RenderedParts { static_field: true, maxima: true })
    }

    /// Renders the quantity that a `width` x `height` view shows at a phase, rows first; maxima per world unit. Where Gaussians
    /// are the dynamic field, only their line integrals are drawn at display rates, exact up to the share of a Gaussian's peak
    /// that its cut leaves out (0.6 %).
    ///
    /// # Errors
    /// As [`Renderer::render`].
    pub fn show(
        &self,
        rays: &ViewRays,
        (width, height): (usize, usize),
        phase: u32,
        quantity: Quantity,
    ) -> Result<Vec<f32>> {
        if let (Some(pictures), Component::Dynamic, Projection::Drr) =
            (&self.pictures, quantity.component, quantity.projection)
        {
            self.check_phase(phase)?;
            return pictures.draw(rays, (width, height), phase);
        }
        let static_field = self.blobs.is_none() || quantity.component.has_static();
        let parts = RenderedParts { static_field, maxima: quantity.projection == Projection::Mip };
        Ok(self.render_parts(rays, (width, height), phase, parts)?.show(quantity))
    }

    /// Renders what [`Renderer::show`] does at a time counted in phases, which may lie between two; none unless it shows line
    /// integrals of one set of Gaussians that moves.
    ///
    /// # Errors
    /// Device errors.
    pub fn show_between(
        &self,
        rays: &ViewRays,
        size: (usize, usize),
        phase: f64,
        quantity: Quantity,
    ) -> Result<Option<Vec<f32>>> {
        let moves = self.blobs.as_ref().is_some_and(Blobs::move_between_phases);
        match (&self.pictures, quantity.component, quantity.projection) {
            (Some(pictures), Component::Dynamic, Projection::Drr) if moves => {
                pictures.draw_at(rays, size, phase).map(Some)
            }
            _ => Ok(None),
        }
    }

    /// Draws line integrals of Gaussians as [`Renderer::show`] does, into a buffer on the device, either in front of its
    /// content (`in_front`) or in place of it.
    ///
    /// # Errors
    /// As [`Renderer::render`]; [`Error::Internal`] where a network is the dynamic field.
    pub fn show_gaussians_into(
        &self,
        target: &Buffer,
        rays: &ViewRays,
        size: (usize, usize),
        phase: u32,
        in_front: bool,
    ) -> Result<()> {
        self.check_phase(phase)?;
        let pictures =
            self.pictures.as_ref().ok_or_else(|| Error::Internal("there are no Gaussians to draw".into()))?;
        pictures.draw_into(target, rays, size, phase, in_front)
    }

    /// Tells whether nearer Gaussians hide those behind them, as in X-Gaussian: blended pictures, from about 0 to 1, then take
    /// the place of line integrals, and attenuation is a sum of opacities.
    pub fn is_blended(&self) -> bool {
        self.pictures.as_ref().is_some_and(Pictures::are_blended)
    }

    /// Tells whether Gaussians are the dynamic field, not a network.
    pub fn gaussians_move(&self) -> bool {
        self.blobs.is_some()
    }

    /// Tells whether a motion hull bounds the dynamic field.
    pub fn has_hull(&self) -> bool {
        self.setup.hull_enabled != 0
    }

    /// Tells whether the network on encoded coordinates is the dynamic field.
    pub fn network_moves(&self) -> bool {
        self.network.is_some()
    }

    /// Tells whether a view of the dynamic field is drawn from the Gaussians themselves, at display rates. The maximum of their
    /// sum with the static field is not the sum of the maxima: it takes the rays' samples, or volumes.
    pub fn draws_gaussians(&self, quantity: Quantity) -> bool {
        let summed = quantity.projection == Projection::Drr || quantity.component == Component::Dynamic;
        self.blobs.is_some() && quantity.component.has_dynamic() && summed
    }

    fn render_parts(
        &self,
        rays: &ViewRays,
        (width, height): (usize, usize),
        phase: u32,
        parts: RenderedParts,
    ) -> Result<Rendering> {
        self.check_phase(phase)?;
        let blobs = self.blobs.as_ref().map(|blobs| blobs.at(phase)).transpose()?;
        self.draw(rays, (width, height), BeatTime::at_phase(phase), blobs.as_ref(), parts)
    }

    /// Renders a `width` x `height` view as it was when an image was taken; at the nearest phase where the dynamic field knows
    /// whole phases only.
    ///
    /// # Errors
    /// As [`Renderer::render`].
    pub fn render_taken(&self, rays: &ViewRays, width: usize, height: usize, taken: BeatTime) -> Result<Rendering> {
        let n_phases = self.setup.n_phases;
        let continuous = self.last_moment() == n_phases;
        if continuous {
            self.render_at(rays, width, height, taken.phases(n_phases))
        } else {
            self.render(rays, width, height, taken.phase)
        }
    }

    /// Renders a `width` x `height` view at a phase that may lie between two, such as 3.4. The dynamic field must be one set of
    /// Gaussians that moves, or a network, whose latents are interpolated between two phases; its beat closes, so that the
    /// number of phases is phase 0 again. Whole phases are those of [`Renderer::render`].
    ///
    /// # Errors
    /// [`Error::Config`] for a phase below 0 or beyond the beat, and for one between two where the dynamic field is a set
    /// of Gaussians per phase; device errors.
    pub fn render_at(&self, rays: &ViewRays, width: usize, height: usize, phase: f64) -> Result<Rendering> {
        let last = self.last_moment();
        if !(0.0..=f64::from(self.setup.n_phases)).contains(&phase) {
            return Err(Error::config("phase", phase, format!("is out of range: phases go from 0 to {last}")));
        }
        if phase.fract() != 0.0 {
            let all = RenderedParts { static_field: true, maxima: true };
            let taken = BeatTime::of(phase, self.setup.n_phases);
            let whole_phases = self.blobs.is_some() || self.field.is_some();
            let blobs = whole_phases.then(|| self.between(phase)).transpose()?;
            return self.draw(rays, (width, height), taken, blobs.as_ref(), all);
        }
        let closes = last == self.setup.n_phases && phase == f64::from(last);
        self.render(rays, width, height, if closes { 0 } else { phase as u32 })
    }

    /// Last phase that can be rendered: for a field that is continuous in time, the first phase of the next beat.
    fn last_moment(&self) -> u32 {
        let continuous = self.field.is_none() && self.blobs.as_ref().is_none_or(Blobs::move_between_phases);
        if continuous { self.setup.n_phases } else { self.setup.n_phases - 1 }
    }

    /// Renders a view at a time, with `blobs` of that time where Gaussians are the dynamic field.
    fn draw(
        &self,
        rays: &ViewRays,
        (width, height): (usize, usize),
        taken: BeatTime,
        blobs: Option<&BlobList>,
        parts: RenderedParts,
    ) -> Result<Rendering> {
        let (pixels, image_width) = ((width * height) as u32, width as u32);
        let of = BackgroundOf { view: View::of(rays), size: (width, height), parts };
        let stays = self.background_stays(parts);
        let (background, model) = self.alone().backgrounds.find(&of);
        let background = background.filter(|_| stays);
        // A background that was drawn already is not drawn again.
        let parts = RenderedParts { static_field: parts.static_field && background.is_none(), ..parts };
        let pace = &self.paces[usize::from(parts.static_field) + 2 * usize::from(parts.maxima)];
        let (mut out, mut first_pixel) = (Rendering::default(), 0);
        while first_pixel < pixels {
            self.pause()?;
            let mut drawn = self.alone();
            let n_rays = rays_at_once(pace, image_width).min(pixels - first_pixel);
            let begin = Instant::now();
            if let Some(background) = &background {
                let pixels = first_pixel as usize..(first_pixel + n_rays) as usize;
                self.gpu.upload(&self.buffers.ray_out, 0, &background.seen[pixels])?;
            }
            let strip = drawn.strip(self, Strip { n_rays, image_width, parts }, taken, blobs)?;
            strip.of.views.write(&[View::of(rays)])?;
            strip.of.pose.write(&[pose(taken, &self.setup, first_pixel)])?;
            self.gpu.wait(strip.commands.submit()?)?;
            if let Some(counts) = &strip.counts {
                let mut live = vec![0; n_rays as usize];
                counts.read(&mut live)?;
                let commands =
                    self.record_counted(&packed(&live, chunk_samples(&self.setup))?, n_rays, parts, &strip.seen)?;
                self.gpu.wait(commands.submit()?)?;
            }
            let mut seen = vec![RayOut::zeroed(); n_rays as usize];
            strip.seen.read(&mut seen)?;
            pace.note(n_rays, begin.elapsed().as_secs_f64());
            out.extend(&seen);
            first_pixel += n_rays;
        }
        if stays && background.is_none() {
            self.alone().backgrounds.keep(Background::new(of, &out.static_integral, &out.static_max), model);
        }
        if let Some(pictures) = self.pictures.as_ref().filter(|pictures| pictures.are_blended()) {
            out.dynamic_integral = pictures.draw(rays, (width, height), taken.phase)?;
            out.is_blended = true;
        }
        Ok(out)
    }

    /// Tells whether the static field is drawn by itself, with Gaussians in front of it: then it is the same at all times.
    fn background_stays(&self, parts: RenderedParts) -> bool {
        parts.static_field && self.blobs.is_some() && self.field.is_none()
    }

    /// Tells whether the live samples of `n_rays` rays are counted before they are drawn. A hull leaves out most of them, so a
    /// chunk then takes many more rays than if all might be live. Without a hull, the host is not involved on the way.
    fn counts_first(&self, n_rays: u32) -> bool {
        self.network_moves() && self.has_hull() && chunk_rays(&self.setup) < n_rays
    }

    /// Records the commands that draw a strip whose samples were counted, in chunks that have room for them.
    fn record_counted(&self, chunks: &[Chunk], n_rays: u32, parts: RenderedParts, seen: &Buffer) -> Result<Commands> {
        let mut recording = Recording::new(&self.gpu, "render counted")?;
        self.pass(&mut recording, &self.buffers, &self.setup).render_counted(chunks, parts.maxima)?;
        recording.copy(&self.buffers.ray_out, 0, seen, 0, u64::from(n_rays) * size_of::<RayOut>() as u64)?;
        Ok(recording.finish()?)
    }

    /// Records the commands that draw a strip, or count its samples.
    fn record_strip(&self, strip: Strip, taken: BeatTime, blobs: Option<&BlobList>) -> Result<RecordedStrip> {
        let Strip { n_rays, image_width, parts } = strip;
        let bytes = u64::from(n_rays) * size_of::<RayOut>() as u64;
        let of = PoseBuffers {
            views: self.gpu.buffer("view", size_of::<View>() as u64, Memory::Upload)?,
            pose: self.gpu.buffer("pose", size_of::<Pose>() as u64, Memory::Upload)?,
        };
        let seen = self.gpu.buffer("ray_out read-back", bytes, Memory::Readback)?;
        let mut recording = Recording::new(&self.gpu, "render")?;
        let push = push::PoseRays { n_rays, image_width, along_axis: self.setup.along_axis };
        self.buffers.record_pose(&mut recording, &self.kernels, &of, push)?;
        if self.counts_first(n_rays) {
            let bytes = u64::from(n_rays) * size_of::<u32>() as u64;
            let counts = self.gpu.buffer("ray_counts read-back", bytes, Memory::Readback)?;
            self.pass(&mut recording, &self.buffers, &self.setup).count(Chunk { first_ray: 0, n_rays })?;
            recording.copy(&self.buffers.ray_counts, 0, &counts, 0, bytes)?;
            return Ok(RecordedStrip { commands: recording.finish()?, of, counts: Some(counts), seen });
        }
        if let Some(field) = &self.field {
            let (rays, out) = (&self.buffers.rays, &self.buffers.ray_out);
            field.record_rays(&mut recording, rays, out, taken.phase, n_rays)?;
        } else if parts.static_field {
            self.pass(&mut recording, &self.buffers, &self.setup).render(n_rays, parts.maxima)?;
        }
        if let (Some(kernels), Some(list)) = (&self.blobs, blobs) {
            let row = image_width.min(n_rays);
            kernels.record_rays(&mut recording, &self.buffers, list, n_rays, row, parts.maxima)?;
        }
        recording.copy(&self.buffers.ray_out, 0, &seen, 0, bytes)?;
        Ok(RecordedStrip { commands: recording.finish()?, of, counts: None, seen })
    }
}

/// Number of rays of a strip: whole rows, of which tiles of pixels are made, and a power of two of them, so that recorded
/// strips can be used again.
fn rays_at_once(pace: &SubmitPace, image_width: u32) -> u32 {
    let rows = (pace.items() / image_width).max(1);
    (1 << rows.ilog2()) * image_width.min(RAYS_PER_SUBMIT)
}

/// A part of a view that is drawn by one submit.
#[derive(Clone, Copy, PartialEq, Eq, Hash)]
struct Strip {
    n_rays: u32,
    image_width: u32,
    parts: RenderedParts,
}

/// Commands that draw a strip of any view, and the buffers that select view and pose.
struct RecordedStrip {
    commands: Commands,
    of: PoseBuffers,
    /// Live samples of its rays, where the commands only count them.
    counts: Option<Buffer>,
    /// Values that its rays saw.
    seen: Buffer,
}

/// Maximum number of strips kept recorded; a display in use has far fewer.
const MAX_RECORDED: usize = 16;

/// Strips drawn so far.
#[derive(Default)]
pub(super) struct Drawn {
    backgrounds: Backgrounds,
    /// Strips of fields that are networks, whose commands are the same at all times.
    recorded: HashMap<Strip, RecordedStrip>,
    /// Last strip of any other field.
    once: Option<RecordedStrip>,
}

impl Drawn {
    /// Returns the commands that draw a strip at a time, recorded before or now.
    fn strip(
        &mut self,
        renderer: &Renderer,
        strip: Strip,
        taken: BeatTime,
        blobs: Option<&BlobList>,
    ) -> Result<&RecordedStrip> {
        if !renderer.network_moves() {
            return Ok(self.once.insert(renderer.record_strip(strip, taken, blobs)?));
        }
        if self.recorded.len() >= MAX_RECORDED && !self.recorded.contains_key(&strip) {
            self.recorded.clear();
        }
        match self.recorded.entry(strip) {
            Entry::Occupied(there) => Ok(there.into_mut()),
            Entry::Vacant(free) => Ok(free.insert(renderer.record_strip(strip, taken, blobs)?)),
        }
    }
}

/// Returns the pose of the rays from `first_pixel` on at a time.
pub(super) fn pose(taken: BeatTime, setup: &Setup, first_pixel: u32) -> Pose {
    let (beyond, beyond_share) = (taken.beyond(setup.n_phases), taken.after_phase.abs() as f32);
    Pose { first_pixel, phase: taken.phase, beyond, beyond_share }
}
