//! The viewer's vessel tree: found once, when the page first requests it, while pictures are still drawn.

use crate::command::next::{Plan, SUGGESTIONS};
use nertca_vk::error::{Error, Result};
use nertca_vk::geometry::CArm;
use nertca_vk::gpu::device::Gpu;
use nertca_vk::kernels::tuning::Tuning;
use nertca_vk::model::Model;
use nertca_vk::render::renderer::Renderer;
use nertca_vk_vessels::trees::extract::{TreeOptions, vessel_trees};
use nertca_vk_vessels::trees::files::to_json;
use nertca_vk_vessels::trees::next_view::ArmLimits;
use nertca_vk_vessels::trees::tree::BeatTree;
use serde_json::json;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

/// State of the search for the tree.
enum TreeState {
    /// Number of phases that are done, and of all phases.
    Working { done: u64, of: u64 },
    /// Reason why there is no tree.
    Failed(String),
    /// Tree of all phases.
    Ready(Arc<Found>),
}

/// A tree that was found.
struct Found {
    beat: BeatTree,
    /// The tree in the format that `tree -o FILE.json` writes.
    json: String,
}

impl TreeState {
    /// Returns the answer to the page, as JSON.
    fn answer(&self) -> String {
        match self {
            TreeState::Working { done, of } => json!({ "state": "working", "done": done, "of": of }).to_string(),
            TreeState::Failed(problem) => json!({ "state": "failed", "problem": problem }).to_string(),
            TreeState::Ready(found) => format!(r#"{{"state":"ready","tree":{}}}"#, found.json),
        }
    }
}

/// Vessel tree of the current fields.
#[derive(Default)]
struct Current {
    /// Incremented whenever a tree is forgotten; results of an older generation are discarded.
    generation: u64,
    /// State of the search; none before the first request, and after a failure has been reported.
    state: Option<TreeState>,
}

/// Search for the tree of a run, on the device that draws it.
pub struct TreeWork {
    gpu: Gpu,
    tuning: Tuning,
    current: Mutex<Current>,
    stop: Arc<AtomicBool>,
}

impl TreeWork {
    /// Prepares the search, which starts with the first request.
    pub fn new(gpu: &Gpu, tuning: Tuning) -> TreeWork {
        TreeWork { gpu: gpu.clone(), tuning, current: Mutex::default(), stop: Arc::default() }
    }

    fn current(&self) -> MutexGuard<'_, Current> {
        self.current.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Returns the state of the search as JSON, and the generation if this is the first request. The first caller must
    /// then call [`TreeWork::find`]. A failure is reported once; the next caller after that is a first one again.
    pub fn ask(&self) -> (String, Option<u64>) {
        let mut current = self.current();
        let first = current.state.is_none().then_some(current.generation);
        let answer = current.state.get_or_insert(TreeState::Working { done: 0, of: 0 }).answer();
        if matches!(current.state, Some(TreeState::Failed(_))) {
            current.state = None;
        }
        (answer, first)
    }

    /// Finds the tree of a model, if the model exists, and completes it by `compare`, which knows the images. Takes seconds.
    pub fn find(&self, generation: u64, model: Result<Model>, compare: impl FnOnce(&mut BeatTree)) {
        let found = match model.and_then(|model| self.tree(generation, &model, compare)) {
            Ok(found) => TreeState::Ready(Arc::new(found)),
            Err(error) => TreeState::Failed(error.to_string()),
        };
        self.tell(generation, found);
    }

    /// Plans the next view of the tree, with a C-arm whose images have so many columns and rows.
    ///
    /// # Errors
    /// [`Error::NotReady`] before the tree was found; [`Error::Config`] for a branch that the tree does not have.
    pub fn next_view(&self, arm: (&CArm, [usize; 2]), branch: Option<usize>) -> Result<Plan> {
        let found = match &self.current().state {
            Some(TreeState::Ready(found)) => found.clone(),
            _ => return Err(Error::NotReady("the vessels have not been found yet".into())),
        };
        Plan::new(&found.beat, arm, branch, &ArmLimits::default(), SUGGESTIONS)
    }

    /// Stores the state of a tree's search; returns whether the tree is still wanted.
    fn tell(&self, generation: u64, state: TreeState) -> bool {
        let mut current = self.current();
        let wanted = current.generation == generation;
        if wanted {
            current.state = Some(state);
        }
        wanted
    }

    /// Forgets the tree, also one that is being found, because the vessels have changed.
    pub fn forget(&self) {
        let mut current = self.current();
        *current = Current { generation: current.generation + 1, state: None };
    }

    /// Returns the generation, which rises whenever the tree is forgotten.
    pub fn generation(&self) -> u64 {
        self.current().generation
    }

    /// Stops the current search before its next slice.
    pub fn stop(&self) {
        self.stop.store(true, Ordering::Relaxed);
    }

    fn tree(&self, generation: u64, model: &Model, compare: impl FnOnce(&mut BeatTree)) -> Result<Found> {
        // The search has its own renderer, because the viewer's renderer goes on drawing pictures, which pass between the slices of
        // the search.
        let (looks, stop) = (self.gpu.looks().clone(), self.stop.clone());
        let interlude = move || {
            looks.give_way();
            if stop.load(Ordering::Relaxed) { Err(Error::Interrupted) } else { Ok(()) }
        };
        let renderer = Renderer::new(&self.gpu, model, self.tuning.clone())?.in_slices(Arc::new(interlude));
        let phases = (0..model.shown_phases()).collect();
        let options = TreeOptions { phases, threshold_per_mm: None, least_branch_mm: None };
        let mut beat = vessel_trees(&renderer, model, &options, |done, of| {
            let wanted = self.tell(generation, TreeState::Working { done, of });
            if wanted && !self.stop.load(Ordering::Relaxed) { Ok(()) } else { Err(Error::Interrupted) }
        })?;
        compare(&mut beat);
        Ok(Found { json: to_json(&beat)?, beat })
    }
}
