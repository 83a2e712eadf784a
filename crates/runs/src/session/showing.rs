//! Pictures of a session: the source that is drawn, its renderer, and long work beside it.

use crate::error::Result;
use crate::render::live::{Live, Refresh, Source};
use crate::render::quantity::Quantity;
use crate::render::renderer::Interlude;
use crate::session::long_work::{LongViewer, LongWork};
use crate::session::state::{Drawn, Shared, Viewer, lock, nothing_yet};
use std::sync::atomic::Ordering;
use std::sync::{Arc, Mutex};

impl Shared {
    /// Shows another source from now on, whose field was fitted to `frames` frames; none for as many as that shown so far.
    /// Returns the generation of the source.
    pub(super) fn publish(&self, source: Source, frames: Option<u32>) -> u64 {
        let generation = {
            let mut published = lock(&self.published);
            published.generation += 1;
            published.source = Some(source);
            published.frames = frames.unwrap_or(published.frames);
            published.generation
        };
        self.free_fields();
        generation
    }

    /// Prepares to draw the first source before it is published, where pictures are requested already: the first picture then does
    /// not take much longer than others.
    pub(super) fn first_viewer(&self, source: &Source, step: u32) -> Result<Option<Arc<Live>>> {
        let (gpu, _) = self.device()?;
        if !gpu.looks().are_recent() || lock(&self.published).source.is_some() {
            return Ok(None);
        }
        let live = self.live(source)?;
        live.bake_static_field(step)?;
        Ok(Some(Arc::new(live)))
    }

    /// Frees the memory of the renderer of long work, unless it is in use.
    pub(super) fn free_fields(&self) {
        if let Ok(mut fields) = self.fields.try_lock() {
            *fields = None;
        }
    }

    fn source(&self) -> (u64, u32, Option<Source>) {
        let published = lock(&self.published);
        (published.generation, published.frames, published.source.clone())
    }

    /// Draws a live picture. It waits for earlier pictures and for submits under way, and for nothing else.
    pub(super) fn with_viewer<T>(
        &self,
        phase: f64,
        quantity: Quantity,
        draw: impl FnOnce(&Live, (u32, Refresh)) -> Result<T>,
    ) -> Result<T> {
        let (gpu, _) = self.device()?;
        let _drawn = gpu.looks().begin();
        let step = self.step.load(Ordering::Acquire);
        let refresh = if self.renews.load(Ordering::Acquire) { Refresh::Beside } else { Refresh::Now };
        let Viewer { live, frames, .. } = self.viewer(refresh)?;
        let picture = draw(&live, (step, refresh))?;
        *lock(&self.drawn) = Some(Drawn { frames, step: live.shown_step(step, phase, quantity) });
        Ok(picture)
    }

    /// Returns what draws live pictures. A new source is prepared here, unless the training thread does so.
    fn viewer(&self, refresh: Refresh) -> Result<Viewer> {
        let mut viewer = lock(&self.viewer);
        let (generation, frames, source) = self.source();
        if let Some(viewer) = &mut *viewer {
            if viewer.generation == generation {
                viewer.frames = frames;
                return Ok(viewer.clone());
            }
            if refresh == Refresh::Beside {
                return Ok(viewer.clone());
            }
        }
        // The memory of the old viewer must be free first.
        *viewer = None;
        let live = Arc::new(self.live(&source.ok_or_else(nothing_yet)?)?);
        Ok(viewer.insert(Viewer { generation, frames, live }).clone())
    }

    fn live(&self, source: &Source) -> Result<Live> {
        let (gpu, tuning) = self.device()?;
        let looks = gpu.looks().clone();
        let interlude: Interlude = Arc::new(move || {
            looks.give_way();
            Ok(())
        });
        Live::new(gpu, source, tuning.clone(), Some(interlude))
    }

    /// Keeps up to date what live pictures show, beside them, in the thread that trains. The earlier source is drawn
    /// until all that pictures needed lately has been prepared from the new one.
    pub(super) fn renew_viewer(&self) {
        let Some(viewer) = lock(&self.viewer).clone() else { return };
        if self.try_renew(&viewer).is_err() {
            // The next picture prepares anew, with the memory of the old viewer, and tells its error.
            *lock(&self.viewer) = None;
        }
    }

    /// Brings what live pictures show up to the present iteration; pictures do so themselves from now on.
    pub(super) fn stop_renewing(&self) {
        if self.renews.load(Ordering::Acquire) {
            self.renew_viewer();
            let viewer = lock(&self.viewer).clone();
            // The next picture repeats what fails here, and tells its error.
            let _ = viewer.map(|viewer| viewer.live.refresh_all_beside(self.step.load(Ordering::Acquire)));
        }
        self.renews.store(false, Ordering::Release);
    }

    fn try_renew(&self, viewer: &Viewer) -> Result<()> {
        let (gpu, _) = self.device()?;
        let step = self.step.load(Ordering::Acquire);
        let (generation, frames, source) = self.source();
        if viewer.generation == generation {
            return viewer.live.refresh_beside(step);
        }
        let prepared = match source.filter(|_| gpu.looks().are_recent()) {
            Some(source) => {
                let live = Arc::new(self.live(&source)?);
                live.bake_like(&viewer.live, step)?;
                Some(Viewer { generation, frames, live })
            }
            // Nobody looks: the memory is free for training.
            None => None,
        };
        *lock(&self.viewer) = prepared;
        Ok(())
    }

    /// Does long work on the fields as they are at its beginning, in slices that live pictures pass. Long work is done one after
    /// the other.
    pub(super) fn with_fields<T>(&self, work: impl FnOnce(&Live, u32) -> Result<T>) -> Result<T> {
        let (gpu, tuning) = self.device()?;
        let begun = self.long_work.begin();
        let mut fields = lock(&self.fields);
        let step = self.step.load(Ordering::Acquire);
        let (generation, _, source) = self.source();
        let source = source.ok_or_else(nothing_yet)?;
        let viewer = match fields.take() {
            Some(viewer) if viewer.generation == generation => viewer,
            earlier => {
                // The memory of the earlier one must be free first.
                drop(earlier);
                let call = Arc::new(Mutex::new(begun.clone()));
                let live = Live::new(gpu, &source, tuning.clone(), Some(LongWork::interlude(gpu, &call)))?;
                LongViewer { generation, live, call }
            }
        };
        *lock(&viewer.call) = begun;
        work(&fields.insert(viewer).live, step)
    }
}
