//! Backgrounds of drawn views: a static field is the same behind the Gaussians of all phases, so that its rays are marched once per view.

use crate::kernels::layout::{RayOut, View};
use crate::render::quantity::RenderedParts;
use bytemuck::Zeroable;
use std::sync::Arc;

/// Image that a background belongs to.
#[derive(PartialEq)]
pub(super) struct BackgroundOf {
    pub(super) view: View,
    /// Columns and rows.
    pub(super) size: (usize, usize),
    pub(super) parts: RenderedParts,
}

/// Static field as a view shows it, behind the Gaussians of any phase.
pub(super) struct Background {
    of: BackgroundOf,
    /// Integral and maximum of the static field at each pixel; other values are zero.
    pub(super) seen: Vec<RayOut>,
}

impl Background {
    /// Takes integrals and maxima of the static field, by pixel.
    pub(super) fn new(of: BackgroundOf, integrals: &[f32], maxima: &[f32]) -> Background {
        let ray =
            |(integral, max): (&f32, &f32)| RayOut { static_integral: *integral, static_max: *max, ..RayOut::zeroed() };
        Background { of, seen: integrals.iter().zip(maxima).map(ray).collect() }
    }
}

/// Backgrounds of the views that were drawn last.
#[derive(Default)]
pub(super) struct Backgrounds {
    kept: Vec<Arc<Background>>,
    /// Number of the model that they show.
    model: u64,
}

impl Backgrounds {
    /// Maximum number of pixels of all of them: twelve views of 512 x 512, which take 75 MB.
    const MAX_PIXELS: usize = 12 * 512 * 512;

    /// Drops all of them, because the model changes.
    pub(super) fn forget(&mut self) {
        self.kept.clear();
        self.model += 1;
    }

    /// Returns the background of an image, where it was drawn, and the number of the model.
    pub(super) fn find(&self, of: &BackgroundOf) -> (Option<Arc<Background>>, u64) {
        (self.kept.iter().find(|background| background.of == *of).cloned(), self.model)
    }

    /// Keeps a background of a model, and drops the oldest ones that have no room beside it.
    pub(super) fn keep(&mut self, background: Background, model: u64) {
        if model != self.model || background.seen.len() > Self::MAX_PIXELS {
            return;
        }
        self.kept.push(Arc::new(background));
        while self.kept.iter().map(|background| background.seen.len()).sum::<usize>() > Self::MAX_PIXELS {
            self.kept.remove(0);
        }
    }
}
