//! Text of files that people write, and search for the files they name.

use nertca_vk::error::{Error, Result};
use std::ops::Range;
use std::path::{Path, PathBuf};

/// A text with the name of its file, to report problems with line numbers.
pub(super) struct Text<'a> {
    pub(super) file: &'a Path,
    pub(super) text: &'a str,
}

impl Text<'_> {
    /// Makes an error about the text in a range, naming its line.
    pub(super) fn fault(&self, at: &Range<usize>, problem: impl Into<String>) -> Error {
        let before = &self.text.as_bytes()[..at.start.min(self.text.len())];
        let line = 1 + before.iter().filter(|byte| **byte == b'\n').count();
        Error::data(self.file, format!("line {line}"), problem)
    }

    /// Parses the text as TOML.
    pub(super) fn parse<T: serde::de::DeserializeOwned>(&self) -> Result<T> {
        toml::from_str(self.text).map_err(|e| self.fault(&e.span().unwrap_or(0..0), e.message().trim().to_owned()))
    }
}

/// Directories in which a study searches, in order, for the files it names by relative paths.
pub(super) struct Places<'a>(Vec<&'a Path>);

impl<'a> Places<'a> {
    /// Makes a search list of directories, searched in this order.
    pub(super) fn new(places: impl IntoIterator<Item = &'a Path>) -> Places<'a> {
        Places(places.into_iter().collect())
    }

    /// Returns the first existing path.
    pub(super) fn find(&self, path: &Path) -> std::result::Result<PathBuf, String> {
        let found = self.0.iter().map(|place| place.join(path)).find(|path| path.exists());
        found.ok_or_else(|| {
            let places: Vec<String> = self.0.iter().map(|place| place.display().to_string()).collect();
            format!("`{}` was not found in {}", path.display(), places.join(" and "))
        })
    }
}
