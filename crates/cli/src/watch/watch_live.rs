//! Source of the viewer's pictures while runs come in: the current session, with its current fields.

use crate::viewer::view_server::{AngiogramGeometry, PictureSource, TYPICAL_SIDE};
use nertca_vk::error::{Error, Result};
use nertca_vk::geometry::ViewRays;
use nertca_vk::model::Model;
use nertca_vk::render::quantity::Quantity;
use nertca_vk_runs::session::{Session, State};
use nertca_vk_vessels::trees::tree::BeatTree;
use serde_json::{Value, json};
use std::collections::HashMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

/// Time after which typical values are computed again, because vessels grow during training.
const TYPICAL_FOR: Duration = Duration::from_secs(2);

/// Current session and its runs.
#[derive(Default)]
struct UnderWay {
    session: Option<Arc<Session>>,
    taken: Option<AngiogramGeometry>,
    runs: usize,
    /// Largest values of typical pictures, and when they were computed.
    ranges: HashMap<Quantity, (Instant, f32)>,
}

/// Source of pictures that follows the current session.
pub struct Live {
    phases: u32,
    iterations: u32,
    under_way: Mutex<UnderWay>,
}

impl Live {
    /// Starts without a session.
    pub fn new(phases: u32, iterations: u32) -> Live {
        Live { phases, iterations, under_way: Mutex::default() }
    }

    fn under_way(&self) -> MutexGuard<'_, UnderWay> {
        self.under_way.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Shows a session of `runs` runs from now on.
    pub fn follow(&self, session: Option<Arc<Session>>, taken: Option<AngiogramGeometry>, runs: usize) {
        *self.under_way() = UnderWay { session, taken, runs, ranges: HashMap::new() };
    }

    fn session(&self) -> Result<Arc<Session>> {
        self.under_way().session.clone().ok_or_else(|| Error::NotReady("no run was imported yet".into()))
    }
}

/// Describes the state of a session for the page.
fn told(state: State) -> &'static str {
    match state {
        State::Waiting => "waiting for a run from another angle",
        State::Running => "training",
        State::Finished => "trained",
        State::Failed => "failed",
        State::Idle | State::Paused | State::Cancelled => "stopped",
    }
}

impl PictureSource for Live {
    fn taken(&self) -> Result<AngiogramGeometry> {
        self.under_way().taken.clone().ok_or_else(|| Error::NotReady("no run was imported yet".into()))
    }

    fn phases(&self) -> u32 {
        self.phases
    }

    fn about(&self) -> Value {
        let UnderWay { session, runs, .. } = &*self.under_way();
        json!({
            "live": true,
            "runs": runs,
            "step": session.as_ref().map_or(0, |session| session.step()),
            "iterations": self.iterations,
            "state": session.as_ref().map_or("waiting for runs", |session| told(session.state())),
        })
    }

    fn render(&self, rays: &ViewRays, side: usize, phase: u32, quantity: Quantity) -> Result<Vec<f32>> {
        self.session()?.render(rays, (side, side), phase, quantity)
    }

    fn range(&self, quantity: Quantity, phase: u32) -> Result<f32> {
        let known = self.under_way().ranges.get(&quantity).copied();
        if let Some((_, range)) = known.filter(|(since, _)| since.elapsed() < TYPICAL_FOR) {
            return Ok(range);
        }
        let taken = self.taken()?;
        let rays = taken.turned(taken.c_arm.primary_deg, taken.c_arm.secondary_deg, TYPICAL_SIDE)?;
        let values = self.render(&rays, TYPICAL_SIDE, phase, quantity)?;
        let range = values.into_iter().fold(f32::MIN_POSITIVE, f32::max);
        self.under_way().ranges.insert(quantity, (Instant::now(), range));
        Ok(range)
    }

    fn model(&self) -> Result<Model> {
        Ok(self.session()?.checkpoint()?.model)
    }

    fn compare_with_images(&self, beat: &mut BeatTree) {
        if let Ok(session) = self.session() {
            session.compare_with_images(beat);
        }
    }
}
