//! The text of a file that people write, and where files are that it names.

use crate::error::{Error, Result};
use std::ops::Range;
use std::path::{Path, PathBuf};

/// A text with its name, to say on which line something stands.
pub(super) struct Text<'a> {
    pub(super) file: &'a Path,
    pub(super) text: &'a str,
}

impl Text<'_> {
    /// A fault of what stands at a place of the text.
    pub(super) fn fault(&self, at: &Range<usize>, problem: impl Into<String>) -> Error {
        let before = &self.text.as_bytes()[..at.start.min(self.text.len())];
        let line = 1 + before.iter().filter(|byte| **byte == b'\n').count();
        Error::data(self.file, format!("line {line}"), problem)
    }

    /// Reads it as TOML.
    pub(super) fn parse<T: serde::de::DeserializeOwned>(&self) -> Result<T> {
        toml::from_str(self.text).map_err(|e| self.fault(&e.span().unwrap_or(0..0), e.message().trim().to_owned()))
    }
}

/// Where a study looks for the files it names by relative paths: in each directory in turn.
pub(super) struct Places<'a>(Vec<&'a Path>);

impl<'a> Places<'a> {
    /// Directories, in the order they are looked at.
    pub(super) fn new(places: impl IntoIterator<Item = &'a Path>) -> Places<'a> {
        Places(places.into_iter().collect())
    }

    /// The first that exists.
    pub(super) fn find(&self, path: &Path) -> std::result::Result<PathBuf, String> {
        let found = self.0.iter().map(|place| place.join(path)).find(|path| path.exists());
        found.ok_or_else(|| {
            let places: Vec<String> = self.0.iter().map(|place| place.display().to_string()).collect();
            format!("`{}` is missing; looked for in {}", path.display(), places.join(" and "))
        })
    }
}
