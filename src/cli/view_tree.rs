//! The tree of vessels of the viewer: found once, when the page first asks for it, beside the pictures.

use nertca_vk::error::{Error, Result};
use nertca_vk::gpu::device::Gpu;
use nertca_vk::kernels::tuning::Tuning;
use nertca_vk::model::Model;
use nertca_vk::render::renderer::Renderer;
use nertca_vk::trees::extract::{TreeOptions, vessel_trees};
use nertca_vk::trees::files::to_json;
use serde_json::json;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Mutex, MutexGuard, PoisonError};

/// How far the tree has come.
enum TreeState {
    /// Phases that are done, and all of them.
    Working { done: u64, of: u64 },
    /// Why there is none.
    Failed(String),
    /// The tree of all phases, as `tree -o FILE.json` writes it.
    Ready(String),
}

impl TreeState {
    /// What the page is answered, JSON.
    fn answer(&self) -> String {
        match self {
            TreeState::Working { done, of } => json!({ "state": "working", "done": done, "of": of }).to_string(),
            TreeState::Failed(problem) => json!({ "state": "failed", "problem": problem }).to_string(),
            TreeState::Ready(tree) => format!(r#"{{"state":"ready","tree":{tree}}}"#),
        }
    }
}

/// The tree of vessels as they are by now.
#[derive(Default)]
struct Current {
    /// Rises whenever a tree is forgotten: what is found of an older one is dropped.
    generation: u64,
    /// None before anybody has asked, and once a failure has been told.
    state: Option<TreeState>,
}

/// Finds the tree of a run on the device that draws it.
pub struct TreeWork {
    gpu: Gpu,
    tuning: Tuning,
    current: Mutex<Current>,
    stop: AtomicBool,
}

impl TreeWork {
    /// Work that begins when it is asked for.
    pub fn new(gpu: &Gpu, tuning: Tuning) -> TreeWork {
        TreeWork { gpu: gpu.clone(), tuning, current: Mutex::default(), stop: AtomicBool::new(false) }
    }

    fn current(&self) -> MutexGuard<'_, Current> {
        self.current.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// How far the tree has come, as JSON; and its generation where the caller is the first to ask, who then calls
    /// [`TreeWork::find`]. A failure is told once; who asks after that is the first again.
    pub fn ask(&self) -> (String, Option<u64>) {
        let mut current = self.current();
        let first = current.state.is_none().then_some(current.generation);
        let answer = current.state.get_or_insert(TreeState::Working { done: 0, of: 0 }).answer();
        if matches!(current.state, Some(TreeState::Failed(_))) {
            current.state = None;
        }
        (answer, first)
    }

    /// Finds the tree of a model, if there is one. Takes seconds.
    pub fn find(&self, generation: u64, model: Result<Model>) {
        let found = match model.and_then(|model| self.tree(generation, &model)) {
            Ok(json) => TreeState::Ready(json),
            Err(error) => TreeState::Failed(error.to_string()),
        };
        self.tell(generation, found);
    }

    /// Tells how far a tree has come; whether it is still wanted.
    fn tell(&self, generation: u64, state: TreeState) -> bool {
        let mut current = self.current();
        let wanted = current.generation == generation;
        if wanted {
            current.state = Some(state);
        }
        wanted
    }

    /// Forgets the tree, also one that is being found: it is of vessels as they were.
    pub fn forget(&self) {
        let mut current = self.current();
        *current = Current { generation: current.generation + 1, state: None };
    }

    /// Rises whenever the tree is forgotten.
    pub fn generation(&self) -> u64 {
        self.current().generation
    }

    /// Ends the work under way before its next phase.
    pub fn stop(&self) {
        self.stop.store(true, Ordering::Relaxed);
    }

    fn tree(&self, generation: u64, model: &Model) -> Result<String> {
        // One of its own: pictures go on through the viewer's.
        let renderer = Renderer::new(&self.gpu, model, self.tuning.clone())?;
        let phases = (0..model.param_map.phases as u32).collect();
        let options = TreeOptions { phases, threshold_per_mm: None, least_branch_mm: None };
        let beat = vessel_trees(&renderer, model, &options, |done, of| {
            let wanted = self.tell(generation, TreeState::Working { done, of });
            if wanted && !self.stop.load(Ordering::Relaxed) { Ok(()) } else { Err(Error::Interrupted) }
        })?;
        to_json(&beat)
    }
}
