//! Centrelines of a tree over the frames of the source runs, as a DICOM presentation state.

use crate::error::Result;
use crate::export::presentation::{self, FrameGraphics, PresentationSeeds};
use crate::geometry::{ViewRays, world_from_lps_mm};
use crate::scan::dataset::Dataset;
use crate::scan::references::{ReferencedRun, References};
use crate::trees::tree::{BeatTree, PhaseTree};
use std::path::Path;

/// Writes the centrelines of a tree over the training frames of its phases. The dataset is that of the run, as calibrated.
///
/// # Errors
/// [`crate::error::Error::Config`] where no frame of these phases has references; [`crate::error::Error::Io`].
pub fn write(
    beat: &BeatTree,
    dataset: &Dataset,
    references: &References,
    path: &Path,
    seeds: &PresentationSeeds,
) -> Result<()> {
    let mut graphics = Vec::new();
    for frame in dataset.training() {
        let Some((run, image)) = references.of_frame(&frame.name) else { continue };
        let Some(tree) = beat.phases.iter().find(|tree| tree.phase == frame.phase) else { continue };
        let lines_px = lines_px(tree, &dataset.heart_rays(frame), run);
        graphics.push(FrameGraphics { source: &run.source, frames: &image.frames, lines_px });
    }
    let description = format!("Centrelines of {} phases", beat.phases.len());
    presentation::write(path, &graphics, &description, seeds)
}

/// Projects the branches of a tree into a source image. A branch that begins on another begins there.
fn lines_px(tree: &PhaseTree, rays: &ViewRays, run: &ReferencedRun) -> Vec<Vec<[f64; 2]>> {
    let inside = |place: &[f64; 2]| {
        let [columns, rows] = run.source.size.map(|side| side as f64);
        (0.0..=columns).contains(&place[0]) && (0.0..=rows).contains(&place[1])
    };
    let mut lines = Vec::new();
    for branch in &tree.branches {
        let mut line = Vec::new();
        for point_mm in &branch.points_mm {
            let place = rays.project(world_from_lps_mm(*point_mm)).map(|place| run.source_px(place));
            match place.filter(inside) {
                Some(place) => line.push(place),
                // Graphics lie inside the image.
                None => lines.push(std::mem::take(&mut line)),
            }
        }
        lines.push(line);
    }
    lines.retain(|line| line.len() > 1);
    lines
}
