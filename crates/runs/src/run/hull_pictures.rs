//! Pictures of the motion hull over the images from which it was carved.

use crate::error::Result;
use crate::files;
use crate::model::hull::Hull;
use crate::scan::dataset::{Dataset, View};
use crate::score::pictures;
use std::path::{Path, PathBuf};

/// Path of a view's picture, in the directory of a run's pictures.
pub fn file(pictures: &Path, view: usize) -> PathBuf {
    pictures.join(format!("hull-view{view}.png"))
}

/// Writes one picture per training view, at its first phase.
///
/// # Errors
/// [`crate::error::Error::Io`].
pub fn write(directory: &Path, dataset: &Dataset, hull: &Hull) -> Result<()> {
    files::create_directory(directory)?;
    let training = dataset.training();
    for view in dataset.training_views() {
        let frames = training.iter().filter(|frame| frame.view == view);
        let Some(frame) = frames.min_by_key(|frame| frame.phase) else { continue };
        let View { rays, size: [width, height], .. } = &dataset.views[view];
        let covered = hull.silhouette(rays, (*width, *height), frame.phase as usize);
        pictures::write_hull(&file(directory, view), &dataset.own(view, &frame.integrals), &covered, *width)?;
    }
    Ok(())
}
