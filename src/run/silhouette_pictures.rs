//! What training views show of vessels, and what of it the other views explain, before and after a correction.

use crate::calibrate::silhouettes;
use crate::error::Result;
use crate::files;
use crate::scan::dataset::Dataset;
use crate::score::pictures;
use std::path::{Path, PathBuf};

/// Where the picture of a view is kept, beside a run's other pictures.
pub fn file(pictures: &Path, view: usize) -> PathBuf {
    pictures.join(format!("silhouettes-view{view}.png"))
}

/// Writes one picture per training view, of the phase that shows most of the vessels.
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
