//! Writes output files atomically: a file is written under a temporary name beside its target, then renamed.

use crate::error::{Error, Result};
use std::fs::File;
use std::io::{BufWriter, Write};
use std::path::Path;

/// Beginning of the names of files that are still being written.
const PARTIAL: &str = ".partial-";

/// Writes `bytes` to `path` through a temporary file in the same directory; creates missing directories.
///
/// # Errors
/// [`Error::Io`] naming the path.
pub fn write_atomic(path: &Path, bytes: &[u8]) -> Result<()> {
    write_atomic_with(path, |file| file.write_all(bytes))
}

/// Like [`write_atomic`], for content produced piece by piece.
///
/// # Errors
/// Errors of [`write_atomic`].
pub fn write_atomic_with(
    path: &Path,
    produce: impl FnOnce(&mut BufWriter<&File>) -> std::io::Result<()>,
) -> Result<()> {
    write_atomic_by(path, |file| produce(file).map_err(Error::io("write", path)))
}

/// Like [`write_atomic`], for content whose production may fail with an error of its own.
///
/// # Errors
/// Errors of [`write_atomic`] and of `produce`.
pub fn write_atomic_by<E: From<Error>>(
    path: &Path,
    produce: impl FnOnce(&mut BufWriter<&File>) -> std::result::Result<(), E>,
) -> std::result::Result<(), E> {
    let directory = match path.parent() {
        Some(parent) if !parent.as_os_str().is_empty() => parent,
        _ => Path::new("."),
    };
    create_directory(directory)?;
    let mut builder = tempfile::Builder::new();
    builder.prefix(PARTIAL);
    // Temporary files are private by default, but outputs are ordinary files, for which the umask decides.
    #[cfg(unix)]
    builder.permissions(std::os::unix::fs::PermissionsExt::from_mode(0o666));
    let temporary = builder.tempfile_in(directory).map_err(Error::io("create a temporary file in", directory))?;
    hold(temporary.as_file());
    let mut writer = BufWriter::new(temporary.as_file());
    produce(&mut writer)?;
    writer.flush().map_err(Error::io("write", path))?;
    drop(writer);
    temporary.as_file().sync_all().map_err(Error::io("flush", path))?;
    temporary.persist(path).map_err(|e| e.error).map_err(Error::io("rename into place", path))?;
    Ok(())
}

/// Locks a file that is being written, for as long as it is open, so that [`remove_partial`] does not remove it.
#[cfg(unix)]
fn hold(file: &File) {
    // A file system without locks gives no protection against a second process in the same directory.
    let _ = rustix::fs::flock(file, rustix::fs::FlockOperation::LockExclusive);
}

#[cfg(not(unix))]
fn hold(_: &File) {}

/// Tries to lock an open file and tells whether that worked; none where the file system has no locks.
#[cfg(unix)]
fn try_hold(file: &File) -> Option<bool> {
    use rustix::fs::{FlockOperation, flock};
    match flock(file, FlockOperation::NonBlockingLockExclusive) {
        Ok(()) => Some(true),
        Err(rustix::io::Errno::WOULDBLOCK) => Some(false),
        Err(_) => None,
    }
}

#[cfg(not(unix))]
fn try_hold(_: &File) -> Option<bool> {
    None
}

/// Tells whether some process still writes a file. Without locks this is unknown, and only Unix removes files that are open.
fn is_held(file: &File) -> bool {
    cfg!(unix) && try_hold(file) != Some(true)
}

/// Removes the partial files that killed processes have left in a directory, and returns their number. Files that other
/// processes are writing stay; a directory that cannot be listed is left as it is.
pub fn remove_partial(directory: &Path) -> usize {
    let entries = std::fs::read_dir(directory).into_iter().flatten().flatten();
    let ours = entries.filter(|entry| {
        let regular = entry.file_type().is_ok_and(|kind| kind.is_file());
        regular && entry.file_name().to_str().is_some_and(|name| name.starts_with(PARTIAL))
    });
    let left_over = ours.filter(|entry| File::open(entry.path()).is_ok_and(|file| !is_held(&file)));
    left_over.filter(|entry| std::fs::remove_file(entry.path()).is_ok()).count()
}

/// A lock file that one process at a time holds for as long as this value lives; the operating system releases it when a
/// process is killed. Systems and file systems without such locks keep nobody out.
#[derive(Debug)]
pub struct Lock {
    _file: File,
}

impl Lock {
    /// Takes the lock; creates the file and its directory where they are missing. Returns none while another process holds it.
    ///
    /// # Errors
    /// [`Error::Io`].
    pub fn take(path: &Path) -> Result<Option<Lock>> {
        create_directory(path.parent().unwrap_or(Path::new(".")))?;
        let file = File::create(path).map_err(Error::io("create", path))?;
        Ok(if try_hold(&file) == Some(false) { None } else { Some(Lock { _file: file }) })
    }
}

/// Formats a value as indented JSON.
///
/// # Errors
/// [`Error::Internal`] for a value JSON cannot hold.
pub fn pretty_json(value: &impl serde::Serialize) -> Result<String> {
    serde_json::to_string_pretty(value).map_err(|e| Error::Internal(e.to_string()))
}

/// Creates a directory and its parents.
///
/// # Errors
/// [`Error::Io`] naming the path.
pub fn create_directory(path: &Path) -> Result<()> {
    std::fs::create_dir_all(path).map_err(Error::io("create the directory", path))
}

/// Reads a whole file, refusing one larger than `limit` bytes.
///
/// # Errors
/// [`Error::Io`] when it cannot be read, [`Error::Data`] when it is too large.
pub fn read_limited(path: &Path, limit: u64) -> Result<Vec<u8>> {
    let meta = std::fs::metadata(path).map_err(Error::io("read", path))?;
    if !meta.is_file() {
        return Err(Error::data(path, "file", "is not a regular file"));
    }
    if meta.len() > limit {
        return Err(Error::data(path, "size", format!("{} bytes exceed the maximum, {limit}", meta.len())));
    }
    std::fs::read(path).map_err(Error::io("read", path))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_what_nobody_writes_any_more_is_removed() {
        let dir = tempfile::tempdir().unwrap();
        let at = |name: &str| dir.path().join(name);
        for name in [".partial-left", "checkpoint", ".other"] {
            std::fs::write(at(name), b"x").unwrap();
        }
        std::fs::create_dir(at(".partial-directory")).unwrap();
        #[cfg(unix)]
        std::os::unix::fs::symlink(at("checkpoint"), at(".partial-link")).unwrap();
        write_atomic_by(&at("written"), |file| {
            assert_eq!(remove_partial(dir.path()), if cfg!(unix) { 1 } else { 2 });
            file.write_all(b"whole").map_err(Error::io("write", dir.path()))
        })
        .unwrap();
        assert_eq!(std::fs::read(at("written")).unwrap(), b"whole");
        assert!(!at(".partial-left").exists() && at("checkpoint").exists() && at(".other").exists());
        assert!(at(".partial-directory").is_dir());
        assert_eq!(remove_partial(&at("absent")), 0);
    }

    #[cfg(unix)]
    #[test]
    fn one_at_a_time_has_a_lock() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("locks/one");
        let held = Lock::take(&path).unwrap().unwrap();
        assert!(Lock::take(&path).unwrap().is_none());
        drop(held);
        assert!(Lock::take(&path).unwrap().is_some());
    }
}
