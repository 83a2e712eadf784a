//! Watches a folder for files that are complete and new.

use crate::error::{Error, Result};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::time::SystemTime;

/// Properties that show whether a file has changed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Version {
    bytes: u64,
    modified: Option<SystemTime>,
}

/// A file found by an earlier scan.
struct ScannedFile {
    version: Version,
    /// Whether this version was already returned.
    told: bool,
}

/// A folder that is scanned repeatedly. Subfolders and hidden files are ignored.
pub struct Folder {
    path: PathBuf,
    seen: BTreeMap<PathBuf, ScannedFile>,
}

impl Folder {
    /// Makes a folder without earlier scans.
    pub fn new(path: &Path) -> Folder {
        Folder { path: path.to_path_buf(), seen: BTreeMap::new() }
    }

    /// Returns the files that have not changed since the previous scan, sorted by name, each version once. A file that changes
    /// later is returned again.
    ///
    /// # Errors
    /// [`Error::Io`] for a folder that cannot be read.
    pub fn look(&mut self) -> Result<Vec<PathBuf>> {
        let unreadable = || Error::io("read", &self.path);
        let mut now = BTreeMap::new();
        for entry in std::fs::read_dir(&self.path).map_err(unreadable())? {
            let entry = entry.map_err(unreadable())?;
            let hidden = entry.file_name().to_string_lossy().starts_with('.');
            // A file that is already gone is found again if it returns.
            let Some(meta) = std::fs::metadata(entry.path()).ok().filter(|meta| meta.is_file() && !hidden) else {
                continue;
            };
            now.insert(entry.path(), Version { bytes: meta.len(), modified: meta.modified().ok() });
        }
        self.seen.retain(|path, _| now.contains_key(path));
        let mut whole = Vec::new();
        for (path, version) in now {
            let seen = self
                .seen
                .entry(path.clone())
                .or_insert(ScannedFile { version: Version { bytes: u64::MAX, modified: None }, told: false });
            if seen.version != version {
                *seen = ScannedFile { version, told: false };
            } else if !seen.told {
                seen.told = true;
                whole.push(path);
            }
        }
        Ok(whole)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn files_are_handed_out_once_they_rest() {
        let directory = tempfile::tempdir().unwrap();
        let (file, mut folder) = (directory.path().join("a.dcm"), Folder::new(directory.path()));
        std::fs::create_dir(directory.path().join("inner")).unwrap();
        std::fs::write(directory.path().join(".hidden"), "x").unwrap();
        let none: [PathBuf; 0] = [];
        assert_eq!(folder.look().unwrap(), none);
        std::fs::write(&file, "x").unwrap();
        assert_eq!(folder.look().unwrap(), none, "it may grow still");
        std::fs::write(&file, "xyz").unwrap();
        assert_eq!(folder.look().unwrap(), none, "it has grown");
        assert_eq!(folder.look().unwrap(), std::slice::from_ref(&file));
        assert_eq!(folder.look().unwrap(), none, "it was handed out");
        std::fs::write(&file, "longer").unwrap();
        assert_eq!((folder.look().unwrap(), folder.look().unwrap()), (none.to_vec(), vec![file.clone()]));
        std::fs::remove_file(&file).unwrap();
        assert_eq!(folder.look().unwrap(), none);
        std::fs::write(&file, "longer").unwrap();
        assert_eq!((folder.look().unwrap(), folder.look().unwrap()), (none.to_vec(), vec![file]));
        assert!(matches!(Folder::new(&directory.path().join("gone")).look(), Err(Error::Io { .. })));
    }
}
