//! Gaussians of a static method as they are drawn while their fit runs.

use crate::gaussians::field::{DynamicGaussians, GaussianFeed, Gaussians};
use std::sync::{Arc, Mutex, PoisonError};

/// Iterations between updates of the Gaussians that are drawn: with half a million Gaussians per phase an update takes as long as
/// some iterations.
const SHOWN_EVERY: u32 = 100;

/// Gaussians that are drawn.
pub struct ShownGaussians {
    feed: GaussianFeed,
}

impl ShownGaussians {
    /// Shows a first field.
    pub fn new(field: Gaussians) -> ShownGaussians {
        ShownGaussians { feed: Arc::new(Mutex::new((0, DynamicGaussians::PerPhase(field)))) }
    }

    /// Returns the feed for those who draw the field.
    pub fn feed(&self) -> GaussianFeed {
        self.feed.clone()
    }

    /// Returns the field that is drawn now.
    pub fn field(&self) -> DynamicGaussians {
        self.feed.lock().unwrap_or_else(PoisonError::into_inner).1.clone()
    }

    /// Tells whether the field after iteration `now` is to be drawn, when the last submit began after iteration `before` and the
    /// run stops at `until`.
    pub fn is_due(before: u32, now: u32, until: u32) -> bool {
        now >= until || now / SHOWN_EVERY > before / SHOWN_EVERY
    }

    /// Shows another field from now on.
    pub fn show(&self, field: Gaussians) {
        let mut feed = self.feed.lock().unwrap_or_else(PoisonError::into_inner);
        *feed = (feed.0 + 1, DynamicGaussians::PerPhase(field));
    }
}
