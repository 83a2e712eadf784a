//! Writes output files atomically: a file is written under a temporary name beside its target, then renamed. Reads files that
//! other programs wrote.

use crate::error::{Error, Result};
use std::collections::BTreeSet;
use std::fs::{File, TryLockError};
use std::io::{BufWriter, Write};
use std::path::{Path, PathBuf};
use std::sync::{Mutex, MutexGuard, PoisonError};
use tempfile::NamedTempFile;

/// Beginning of the names of files that are still being written.
const PARTIAL: &str = ".partial-";
/// Largest number of symbolic links that lead from one to the next, as Linux limits it.
const MAX_LINKS: usize = 40;

/// Paths under which this process is writing. The lock is also held by steps that the end of the process must not divide.
static UNFINISHED: Mutex<BTreeSet<PathBuf>> = Mutex::new(BTreeSet::new());
/// Largest number of attempts to remove a directory into which another thread may still put a folder.
const REMOVALS: usize = 3;

fn unfinished() -> MutexGuard<'static, BTreeSet<PathBuf>> {
    UNFINISHED.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Registers a temporary file or directory for as long as this value lives, so that [`remove_unfinished`] can remove it.
#[derive(Debug)]
pub struct Unfinished(PathBuf);

impl Unfinished {
    /// Creates a temporary file or directory by `create` and registers its path, which `path` returns. The registration comes
    /// first in the result, so that it ends after the temporary object where both end together.
    ///
    /// # Errors
    /// Errors of `create`.
    pub fn create<T, E>(
        create: impl FnOnce() -> std::result::Result<T, E>,
        path: impl FnOnce(&T) -> &Path,
    ) -> std::result::Result<(Unfinished, T), E> {
        // Under the lock, no process can end between the two steps and leave an object that nobody removes.
        let mut paths = unfinished();
        let created = create()?;
        let path = path(&created).to_path_buf();
        paths.insert(path.clone());
        Ok((Unfinished(path), created))
    }
}

impl Drop for Unfinished {
    fn drop(&mut self) {
        unfinished().remove(&self.0);
    }
}

/// Does a short step that [`remove_unfinished`] must not divide, such as the replacement of several files. The step must not
/// write by functions of this module.
pub fn undivided<T>(step: impl FnOnce() -> T) -> T {
    let _held = unfinished();
    step()
}

/// Keeps other threads from beginning or completing files for as long as it lives.
#[derive(Debug)]
pub struct NoWriting {
    _paths: MutexGuard<'static, BTreeSet<PathBuf>>,
}

/// Removes all that this process is writing at the moment. A program that a signal ends calls it last and keeps the returned
/// value, because its other threads still work.
pub fn remove_unfinished() -> NoWriting {
    let mut paths = unfinished();
    for path in std::mem::take(&mut *paths) {
        // There is nobody left to read an error message about a file that could not be removed.
        let remove = || if path.is_dir() { std::fs::remove_dir_all(&path) } else { std::fs::remove_file(&path) };
        let _ = (0..REMOVALS).find(|_| remove().is_ok() || !path.exists());
    }
    NoWriting { _paths: paths }
}

/// Returns the path to which the symbolic links at the end of a path lead; the target may be missing.
fn behind_links(path: &Path) -> PathBuf {
    let mut path = path.to_path_buf();
    for _ in 0..MAX_LINKS {
        let Ok(target) = std::fs::read_link(&path) else { break };
        path = path.parent().map_or_else(|| target.clone(), |parent| parent.join(&target));
    }
    path
}

/// Writes `bytes` to `path` through a temporary file in the same directory; creates missing directories. A symbolic link stays,
/// and the file to which it leads is replaced. A device or a named pipe cannot be replaced and is written to.
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
    if std::fs::metadata(path).is_ok_and(|meta| !meta.is_file()) {
        return write_in_place(path, produce);
    }
    let target = behind_links(path);
    let directory = match target.parent() {
        Some(parent) if !parent.as_os_str().is_empty() => parent,
        _ => Path::new("."),
    };
    create_directory(directory)?;
    let mut builder = tempfile::Builder::new();
    builder.prefix(PARTIAL);
    // Temporary files are private by default, but outputs are ordinary files, for which the umask decides.
    #[cfg(unix)]
    builder.permissions(std::os::unix::fs::PermissionsExt::from_mode(0o666));
    let (_unfinished, temporary) = Unfinished::create(|| builder.tempfile_in(directory), NamedTempFile::path)
        .map_err(Error::io("create a temporary file in", directory))?;
    hold(temporary.as_file());
    let mut writer = BufWriter::new(temporary.as_file());
    produce(&mut writer)?;
    writer.flush().map_err(Error::io("write", path))?;
    drop(writer);
    temporary.as_file().sync_all().map_err(Error::io("flush", path))?;
    undivided(|| temporary.persist(&target)).map_err(|e| e.error).map_err(Error::io("rename into place", path))?;
    Ok(())
}

/// Writes to something that is no regular file, such as a device or a named pipe.
fn write_in_place<E: From<Error>>(
    path: &Path,
    produce: impl FnOnce(&mut BufWriter<&File>) -> std::result::Result<(), E>,
) -> std::result::Result<(), E> {
    if path.is_dir() {
        return Err(Error::data(path, "file", "is a folder; the name of a file is needed").into());
    }
    let file = File::options().write(true).open(path).map_err(Error::io("write", path))?;
    let mut writer = BufWriter::new(&file);
    produce(&mut writer)?;
    Ok(writer.flush().map_err(Error::io("write", path))?)
}

/// Locks a file that is being written, for as long as it is open, so that [`remove_partial`] does not remove it.
#[cfg(unix)]
fn hold(file: &File) {
    // A file system without locks gives no protection against a second process in the same directory.
    let _ = file.lock();
}

#[cfg(not(unix))]
fn hold(_: &File) {}

/// Tells whether some process still writes a file. Without locks this is unknown, and only Unix removes files that are open.
fn is_held(file: &File) -> bool {
    cfg!(unix) && file.try_lock().is_err()
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
/// process is killed. On a file system without locks, a second file names the process instead.
#[derive(Debug)]
pub struct Lock {
    _file: File,
    /// File that names this process, where there are no locks.
    record: Option<PathBuf>,
}

impl Lock {
    /// Takes the lock; creates the file and its directory where they are missing. Returns none while another process holds it.
    ///
    /// # Errors
    /// [`Error::Io`].
    pub fn take(path: &Path) -> Result<Option<Lock>> {
        create_directory(path.parent().unwrap_or(Path::new(".")))?;
        let file = File::create(path).map_err(Error::io("create", path))?;
        match file.try_lock() {
            Ok(()) => Ok(Some(Lock { _file: file, record: None })),
            Err(TryLockError::WouldBlock) => Ok(None),
            // NFS and Lustre may have no locks, and fail with ENOLCK or ENOSYS.
            Err(TryLockError::Error(_)) => Lock::by_record(path, file),
        }
    }

    /// Takes the lock by a file that names this process, `NAME.process` for a lock file `NAME`. It stays behind where a process is killed,
    /// and counts no longer when that process has ended; of a process on another computer this is unknown.
    fn by_record(path: &Path, file: File) -> Result<Option<Lock>> {
        let mut name = path.as_os_str().to_owned();
        name.push(".process");
        let record = PathBuf::from(name);
        let process = Process::this();
        loop {
            match File::options().write(true).create_new(true).open(&record) {
                Ok(mut file) => {
                    file.write_all(process.to_text().as_bytes()).map_err(Error::io("write", &record))?;
                    break;
                }
                Err(e) if e.kind() == std::io::ErrorKind::AlreadyExists => {
                    let text = read_text(&record, MAX_RECORD_BYTES)?;
                    if Process::of_text(&text).is_none_or(|holder| holder.may_run()) {
                        return Ok(None);
                    }
                    std::fs::remove_file(&record).map_err(Error::io("remove", &record))?;
                }
                Err(e) => return Err(Error::io("create", &record)(e)),
            }
        }
        Ok(Some(Lock { _file: file, record: Some(record) }))
    }

    /// Returns the file that names this process, where the file system has no locks.
    pub fn record(&self) -> Option<&Path> {
        self.record.as_deref()
    }
}

impl Drop for Lock {
    fn drop(&mut self) {
        // A file that cannot be removed names a process that has ended.
        self.record.iter().for_each(|record| drop(std::fs::remove_file(record)));
    }
}

/// Largest accepted size of the file that names a process.
const MAX_RECORD_BYTES: u64 = 4096;

/// Process that holds a lock without the help of the file system.
#[derive(Debug, PartialEq)]
struct Process {
    host: String,
    id: u32,
}

impl Process {
    fn this() -> Process {
        let host = std::fs::read_to_string("/proc/sys/kernel/hostname").unwrap_or_default();
        Process { host: host.trim().to_owned(), id: std::process::id() }
    }

    fn to_text(&self) -> String {
        format!("{} {}\n", self.id, self.host)
    }

    fn of_text(text: &str) -> Option<Process> {
        let (id, host) = text.trim_end_matches('\n').split_once(' ')?;
        Some(Process { id: id.parse().ok()?, host: host.to_owned() })
    }

    /// Tells whether the process still runs, as far as this computer knows.
    fn may_run(&self) -> bool {
        let processes = Path::new("/proc");
        let is_known = self.host == Process::this().host && processes.join("self").exists();
        !is_known || processes.join(self.id.to_string()).exists()
    }
}

/// Formats a value as indented JSON.
///
/// # Errors
/// [`Error::Internal`] for a value JSON cannot hold.
pub fn pretty_json(value: &impl serde::Serialize) -> Result<String> {
    serde_json::to_string_pretty(value).map_err(|e| Error::Internal(e.to_string()))
}

/// Returns the path of one file of a series with one file per phase: `NAME_0003.EXT` for `NAME.EXT`.
pub fn of_phase(path: &Path, phase: u32) -> PathBuf {
    let mut name = path.file_stem().unwrap_or_default().to_owned();
    name.push(format!("_{phase:04}"));
    if let Some(extension) = path.extension() {
        name.push(".");
        name.push(extension);
    }
    path.with_file_name(name)
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
    if meta.is_dir() {
        return Err(Error::data(path, "file", "is a folder; a file is needed"));
    }
    if !meta.is_file() {
        return Err(Error::data(path, "file", "is not a regular file"));
    }
    if meta.len() > limit {
        return Err(Error::data(path, "size", format!("{} bytes exceed the maximum, {limit}", meta.len())));
    }
    std::fs::read(path).map_err(Error::io("read", path))
}

/// Byte order mark with which some editors begin a text, in UTF-8.
const MARK: &[u8] = &[0xef, 0xbb, 0xbf];

/// Reads a text in UTF-8 of at most `limit` bytes, without its byte order mark if it has one.
///
/// # Errors
/// Errors of [`read_limited`]; [`Error::Data`] for another encoding.
pub fn read_text(path: &Path, limit: u64) -> Result<String> {
    let mut bytes = read_limited(path, limit)?;
    if bytes.starts_with(MARK) {
        bytes.drain(..MARK.len());
    }
    if bytes.starts_with(&[0xff, 0xfe]) || bytes.starts_with(&[0xfe, 0xff]) {
        return Err(Error::data(path, "text", "is encoded in UTF-16; save it in UTF-8"));
    }
    String::from_utf8(bytes).map_err(|e| {
        let at = e.utf8_error().valid_up_to();
        Error::data(path, "text", format!("is not in UTF-8 from byte {at} on; save it in UTF-8"))
    })
}

/// Reads a JSON file of at most `limit` bytes.
///
/// # Errors
/// Errors of [`read_text`]; [`Error::Data`] naming the line of what does not fit.
pub fn read_json<T: serde::de::DeserializeOwned>(path: &Path, limit: u64) -> Result<T> {
    let text = read_text(path, limit)?;
    serde_json::from_str(&text).map_err(|e| Error::data(path, format!("line {}", e.line()), e.to_string()))
}

/// Represents a path in JSON: a string, or where it is not text in UTF-8, an object with its bytes. For `#[serde(with = ...)]`.
pub mod path_in_json {
    use serde::{Deserialize, Deserializer, Serialize, Serializer};
    use std::path::{Path, PathBuf};

    #[derive(Serialize, Deserialize)]
    #[serde(untagged)]
    enum Stored {
        Text(String),
        Bytes { bytes: Vec<u8> },
    }

    /// Writes a path.
    ///
    /// # Errors
    /// Errors of the serialiser.
    pub fn serialize<S: Serializer>(path: &Path, to: S) -> Result<S::Ok, S::Error> {
        let stored = match path.to_str() {
            Some(text) => Stored::Text(text.to_owned()),
            None => Stored::Bytes { bytes: path.as_os_str().as_encoded_bytes().to_vec() },
        };
        stored.serialize(to)
    }

    /// Reads a path.
    ///
    /// # Errors
    /// Errors of the deserialiser.
    pub fn deserialize<'a, D: Deserializer<'a>>(from: D) -> Result<PathBuf, D::Error> {
        Ok(match Stored::deserialize(from)? {
            Stored::Text(text) => PathBuf::from(text),
            Stored::Bytes { bytes } => of_bytes(bytes),
        })
    }

    #[cfg(unix)]
    fn of_bytes(bytes: Vec<u8>) -> PathBuf {
        PathBuf::from(<std::ffi::OsString as std::os::unix::ffi::OsStringExt>::from_vec(bytes))
    }

    #[cfg(not(unix))]
    fn of_bytes(bytes: Vec<u8>) -> PathBuf {
        PathBuf::from(String::from_utf8_lossy(&bytes).into_owned())
    }
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

    #[test]
    fn one_at_a_time_has_a_lock_where_the_file_system_has_none() {
        let directory = tempfile::tempdir().unwrap();
        let (path, record) = (directory.path().join("one"), directory.path().join("one.process"));
        let take = || Lock::by_record(&path, File::create(&path).unwrap()).unwrap();
        let held = take().unwrap();
        assert_eq!(held.record(), Some(&*record));
        assert!(take().is_none());
        drop(held);
        assert!(!record.exists());
        // A process that was killed leaves its file, and one on another computer may run.
        let Process { host, .. } = Process::this();
        std::fs::write(&record, Process { host: host.clone(), id: u32::MAX }.to_text()).unwrap();
        assert_eq!(take().is_some(), cfg!(target_os = "linux"));
        for text in [Process { host: format!("{host}-2"), id: u32::MAX }.to_text(), "of somebody else".into()] {
            std::fs::write(&record, text).unwrap();
            assert!(take().is_none());
        }
    }

    #[cfg(unix)]
    #[test]
    fn links_stay_and_devices_are_written_to() {
        let directory = tempfile::tempdir().unwrap();
        let at = |name: &str| directory.path().join(name);
        std::fs::create_dir(at("elsewhere")).unwrap();
        std::fs::write(at("elsewhere/file"), b"old").unwrap();
        for (link, target) in [("one", "two"), ("two", "elsewhere/file"), ("dangling", "elsewhere/new")] {
            std::os::unix::fs::symlink(target, at(link)).unwrap();
        }
        write_atomic(&at("one"), b"new").unwrap();
        write_atomic(&at("dangling"), b"made").unwrap();
        assert_eq!(std::fs::read(at("elsewhere/file")).unwrap(), b"new");
        assert_eq!(std::fs::read(at("elsewhere/new")).unwrap(), b"made");
        assert!(["one", "two", "dangling"].iter().all(|link| at(link).is_symlink()));
        write_atomic(Path::new("/dev/null"), b"lost").unwrap();
        assert!(!std::fs::metadata("/dev/null").unwrap().is_file());
        let refused = write_atomic(directory.path(), b"x").unwrap_err().to_string();
        assert!(refused.contains("is a folder"), "{refused}");
    }

    #[test]
    fn texts_are_read_with_and_without_a_mark() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("text.json");
        let read = |bytes: &[u8]| {
            std::fs::write(&path, bytes).unwrap();
            read_json::<Vec<u32>>(&path, 100).map_err(|e| e.to_string())
        };
        assert_eq!(read(b"[1, 2]"), Ok(vec![1, 2]));
        assert_eq!(read(b"\xef\xbb\xbf[1, 2]"), Ok(vec![1, 2]));
        assert!(read(b"\xff\xfe[\0").unwrap_err().contains("UTF-16"));
        assert!(read(b"[1, \xe9]").unwrap_err().contains("byte 4"));
        assert!(read(b"[1,\n x]").unwrap_err().contains("line 2"));
        assert!(read_json::<u32>(directory.path(), 9).unwrap_err().to_string().contains("is a folder"));
    }

    #[cfg(unix)]
    #[test]
    fn paths_of_any_bytes_return_from_json() {
        #[derive(serde::Serialize, serde::Deserialize)]
        struct Record {
            #[serde(with = "path_in_json")]
            path: PathBuf,
        }
        for (bytes, text) in [(&b"a/\xe9"[..], r#"{"path":{"bytes":[97,47,233]}}"#), (b"a/b", r#"{"path":"a/b"}"#)] {
            let path = PathBuf::from(<std::ffi::OsStr as std::os::unix::ffi::OsStrExt>::from_bytes(bytes));
            assert_eq!(serde_json::to_string(&Record { path: path.clone() }).unwrap(), text);
            assert_eq!(serde_json::from_str::<Record>(text).unwrap().path, path);
        }
    }
}
