//! Pictures of the vessel pixels of training views, and the part that the other views explain, before and after a
//! correction.

use crate::calibrate::silhouettes;
use crate::error::Result;
use crate::files;
use crate::scan::dataset::Dataset;
use crate::score::pictures;
use std::path::{Path, PathBuf};

/// Path of a view's picture, in the directory of a run's pictures.
pub fn file(pictures: &Path, view: usize) -> PathBuf {
    pictures.join(format!("silhouettes-view{view}.png"))
}

/// Writes one picture per training view, at the phase that shows the most vessel pixels.
///
/// # Errors
/// [`crate::error::Error::Io`].
pub fn write(directory: &Path, stated: &Dataset, corrected: &Dataset) -> Result<()> {
    files::create_directory(directory)?;
    for s in silhouettes(stated, corrected) {
        let [before, after] = &s.explained;
        pictures::write_silhouettes(&file(directory, s.view), &s.seen, &s.shown, [before, after], s.width)?;
    }
    Ok(())
}
