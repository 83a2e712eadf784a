//! What the viewer shows while runs come in: the session under way, whatever it has learned by now.

use super::view_server::{Shown, TYPICAL_SIDE, Taken};
use nertca_vk::error::{Error, Result};
use nertca_vk::geometry::ViewRays;
use nertca_vk::model::Model;
use nertca_vk::render::quantity::Quantity;
use nertca_vk::session::{Session, State};
use serde_json::{Value, json};
use std::collections::HashMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

/// What is typical is looked at again after so long: vessels grow while training goes on.
const TYPICAL_FOR: Duration = Duration::from_secs(2);

/// What is under way.
#[derive(Default)]
struct UnderWay {
    session: Option<Arc<Session>>,
    taken: Option<Taken>,
    runs: usize,
    /// Largest values of typical pictures, and when they were looked at.
    ranges: HashMap<Quantity, (Instant, f32)>,
}

/// The session that runs go to.
pub struct Live {
    phases: u32,
    iterations: u32,
    under_way: Mutex<UnderWay>,
}

impl Live {
    /// No session yet.
    pub fn new(phases: u32, iterations: u32) -> Live {
        Live { phases, iterations, under_way: Mutex::default() }
    }

    fn under_way(&self) -> MutexGuard<'_, UnderWay> {
        self.under_way.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Shows a session of so many runs from now on.
    pub fn follow(&self, session: Option<Arc<Session>>, taken: Option<Taken>, runs: usize) {
        *self.under_way() = UnderWay { session, taken, runs, ranges: HashMap::new() };
    }

    fn session(&self) -> Result<Arc<Session>> {
        self.under_way().session.clone().ok_or_else(|| Error::NotReady("no run has come yet".into()))
    }
}

/// What the page says a session is doing.
fn told(state: State) -> &'static str {
    match state {
        State::Waiting => "waiting for a run from another angle",
        State::Running => "training",
        State::Finished => "trained",
        State::Failed => "failed",
        State::Idle | State::Paused | State::Cancelled => "stopped",
    }
}

impl Shown for Live {
    fn taken(&self) -> Result<Taken> {
        self.under_way().taken.clone().ok_or_else(|| Error::NotReady("no run has come yet".into()))
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
}
