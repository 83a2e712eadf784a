//! Directories and series of files that commands write. What an earlier command left in the same place stays unless `--force` is
//! given; then all of it makes way, so that no old file is mistaken for a part of the new result.

use nertca_vk::calibrate::correction;
use nertca_vk::checkpoint::newest;
use nertca_vk::error::{Error, Result};
use nertca_vk::files;
use nertca_vk::fingerprint::Fingerprint;
use nertca_vk::scan::dataset::{Dataset, MANIFEST};
use nertca_vk::scan::nerfca;
use nertca_vk::scan::references::{REFERENCES, References};
use nertca_vk::scan::truth::{TRUTH, VOLUMES};
use nertca_vk_phantom::tree_file::TREE;
use std::ffi::OsStr;
use std::path::{Path, PathBuf};

/// Beginning of the name of a directory in which a new dataset is written before it replaces an earlier one.
const PARTIAL: &str = ".partial-";
/// Minimum number of digits of a phase in the name of a file of a series.
const PHASE_DIGITS: usize = 4;

/// Files of a dataset other than its images, with their folders.
const ALWAYS_NAMED: &[(&str, &str)] = &[
    ("", MANIFEST),
    ("", nerfca::GENERAL),
    ("", nerfca::TRAINING_LIST),
    ("", nerfca::VALIDATION_LIST),
    ("", TRUTH),
    ("", REFERENCES),
    (VOLUMES, TREE),
    (CALIBRATION, correction::FILE),
];
/// Files of a dataset that are named by view and phase: their folder, the beginning and the end of their names.
const NUMBERED: &[(&str, &str, &str)] = &[
    ("", "train-view", ".npy"),
    ("", "test-view", ".npy"),
    ("images", "train-view", ".npy"),
    ("images", "test-view", ".npy"),
    ("masks", "train-view", ".png"),
    ("masks", "test-view", ".png"),
    (VOLUMES, "vessels-", ".nrrd"),
    (VOLUMES, "background-", ".nrrd"),
    (CALIBRATION, "silhouettes-view", ".png"),
];
/// Folder in a dataset for the description and pictures of a correction.
pub const CALIBRATION: &str = "calibration";

/// Files in a directory whose names fit; none where there is no such directory.
fn files_in(directory: &Path, fits: impl Fn(&OsStr) -> bool) -> Result<Vec<PathBuf>> {
    let listed = match std::fs::read_dir(directory) {
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => return Ok(Vec::new()),
        listed => listed.map_err(Error::io("list", directory))?,
    };
    let mut found = Vec::new();
    for entry in listed {
        let entry = entry.map_err(Error::io("list", directory))?;
        if fits(&entry.file_name()) && entry.file_type().is_ok_and(|kind| !kind.is_dir()) {
            found.push(entry.path());
        }
    }
    found.sort();
    Ok(found)
}

/// Tells whether a name is `begin`, digits and other characters, and `end`.
fn is_numbered(name: &OsStr, begin: &str, end: &str) -> bool {
    let middle = name.to_str().and_then(|name| name.strip_prefix(begin)?.strip_suffix(end));
    middle.is_some_and(|middle| middle.starts_with(|c: char| c.is_ascii_digit()))
}

/// Files in a directory that have the names of a dataset's files, the manifests first.
fn files_of_dataset(directory: &Path) -> Result<Vec<PathBuf>> {
    let always = ALWAYS_NAMED.iter().map(|(folder, name)| directory.join(folder).join(name));
    let mut found: Vec<PathBuf> = always.filter(|path| path.symlink_metadata().is_ok()).collect();
    for (folder, begin, end) in NUMBERED {
        found.extend(files_in(&directory.join(folder), |name| is_numbered(name, begin, end))?);
    }
    Ok(found)
}

/// References of a dataset to its runs, for a copy of it.
pub struct KeptReferences<'a> {
    dataset: &'a Dataset,
    /// References to keep; none where they are not to be kept.
    references: Option<References>,
}

impl<'a> KeptReferences<'a> {
    /// Reads the references of a dataset if they are to be kept, and notes where they are not.
    ///
    /// # Errors
    /// [`Error::Data`] where they are to be kept and the dataset has none; [`Error::Io`].
    pub fn of(dataset: &'a Dataset, keep: bool) -> Result<KeptReferences<'a>> {
        let references = match (References::read(&dataset.path)?, keep) {
            (None, true) => {
                let problem =
                    "is missing, so that --keep-references has nothing to keep: import the runs with this option";
                return Err(Error::data(dataset.path.join(REFERENCES), "file", problem));
            }
            (Some(_), false) => {
                eprintln!("{REFERENCES} is not kept, because it names the patient; --keep-references keeps it");
                None
            }
            (references, _) => references,
        };
        Ok(KeptReferences { dataset, references })
    }

    /// Writes the references into a copy of the dataset whose frames have these image files.
    ///
    /// # Errors
    /// [`Error::Io`].
    pub fn write(&self, image_files: &[PathBuf], out: &Path) -> Result<()> {
        let Some(references) = &self.references else { return Ok(()) };
        let names = self.dataset.frames.iter().map(|frame| frame.name.as_str());
        references.of_other_files(names.zip(image_files.iter().map(PathBuf::as_path))).write(out)
    }
}

/// Writes a dataset into a directory by a function that gets the directory to write to. An earlier dataset there is refused, or
/// with `force` replaced once the new one is complete.
///
/// # Errors
/// [`Error::Config`] for a directory with a dataset, without `force`; errors of `write`; [`Error::Io`].
pub fn write_dataset<T>(out: &Path, force: bool, write: impl FnOnce(&Path) -> Result<T>) -> Result<T> {
    if out.exists() && !out.is_dir() {
        return Err(Error::config("--out", shown(out), "is a file; a directory is needed"));
    }
    let old = files_of_dataset(out)?;
    let Some(first) = old.first() else { return write(out) };
    let name = shown(first.strip_prefix(out).unwrap_or(first));
    if !force {
        let problem =
            format!("already contains a dataset (`{name}`): choose another directory, or replace it with --force");
        return Err(Error::config("--out", shown(out), problem));
    }
    // The authors' layout takes every such list as part of the dataset, so one of another origin would join the new dataset.
    let list = |name: &OsStr| {
        let name = name.to_string_lossy();
        name.ends_with(".json") && (name.starts_with("train") || name.starts_with("test"))
    };
    if let Some(foreign) = files_in(out, list)?.into_iter().find(|path| !old.contains(path)) {
        let problem =
            format!("contains `{}`, which this program did not write: choose another directory", shown(&foreign));
        return Err(Error::config("--out", shown(out), problem));
    }
    let create = || tempfile::Builder::new().prefix(PARTIAL).tempdir_in(out);
    let (_unfinished, fresh) = files::Unfinished::create(create, tempfile::TempDir::path)
        .map_err(Error::io("create a temporary directory in", out))?;
    let written = write(fresh.path())?;
    // A process that ended in the middle would leave neither the old dataset nor the new one.
    files::undivided(|| replace(&old, fresh.path(), out))?;
    Ok(written)
}

/// Removes the files of an earlier dataset and moves those of the new one to their place.
fn replace(old: &[PathBuf], fresh: &Path, out: &Path) -> Result<()> {
    for path in old {
        std::fs::remove_file(path).map_err(Error::io("remove", path))?;
    }
    move_into(fresh, out)
}

/// Moves all files of a directory into another one, those in folders first: a manifest must not be there before its images.
fn move_into(from: &Path, to: &Path) -> Result<()> {
    files::create_directory(to)?;
    let entries = std::fs::read_dir(from).map_err(Error::io("list", from))?;
    let mut entries = entries.collect::<std::io::Result<Vec<_>>>().map_err(Error::io("list", from))?;
    let name_is = |entry: &std::fs::DirEntry, names: [&str; 2]| names.iter().any(|name| entry.file_name() == *name);
    entries
        .sort_by_key(|entry| (name_is(entry, [MANIFEST, nerfca::GENERAL]), entry.path().is_file(), entry.file_name()));
    for entry in entries {
        let target = to.join(entry.file_name());
        if entry.path().is_dir() {
            move_into(&entry.path(), &target)?;
        } else {
            std::fs::rename(entry.path(), &target).map_err(Error::io("rename into place", &target))?;
        }
    }
    Ok(())
}

/// Text of a path for a message.
fn shown(path: &Path) -> String {
    path.display().to_string()
}

/// Files that an earlier command left, which the new result replaces.
pub struct Earlier(Vec<PathBuf>);

impl Earlier {
    /// Makes a record of no files, for a command that replaces a single one.
    pub fn none() -> Earlier {
        Earlier(Vec::new())
    }

    /// Finds the files `NAME_0000.EXT` and so on beside `out`, which is `NAME.EXT`, of an earlier series with one file per phase.
    ///
    /// # Errors
    /// [`Error::Config`] where there are such files, without `force`.
    pub fn series(out: &Path, force: bool) -> Result<Earlier> {
        let (stem, extension) = (out.file_stem().unwrap_or_default(), out.extension());
        let beside = match out.parent() {
            Some(parent) if !parent.as_os_str().is_empty() => parent,
            _ => Path::new("."),
        };
        let of_series = |name: &OsStr| {
            let path = Path::new(name);
            let own = path.file_stem().unwrap_or_default().as_encoded_bytes();
            let number = own.strip_prefix(stem.as_encoded_bytes()).and_then(|rest| rest.strip_prefix(b"_"));
            let digits = number.is_some_and(|n| n.len() >= PHASE_DIGITS && n.iter().all(u8::is_ascii_digit));
            digits && path.extension() == extension
        };
        Earlier::allowed(files_in(beside, of_series)?, force, "belongs to an earlier series")
    }

    /// Finds the page and the pictures of an earlier evaluation in a directory.
    ///
    /// # Errors
    /// [`Error::Config`] where there is such a page, without `force`.
    pub fn pictures(directory: &Path, force: bool) -> Result<Earlier> {
        let page = files_in(directory, |name| name == "report.html")?;
        if page.is_empty() {
            return Ok(Earlier::none());
        }
        let ours = |name: &OsStr| {
            let named = [("test-view", ".png"), ("beat-view", ".gif")];
            named.iter().any(|(begin, end)| is_numbered(name, begin, end))
        };
        let pictures = files_in(directory, ours)?;
        Earlier::allowed(page.into_iter().chain(pictures).collect(), force, "belongs to an earlier evaluation")
    }

    fn allowed(found: Vec<PathBuf>, force: bool, problem: &str) -> Result<Earlier> {
        match found.first() {
            Some(first) if !force => {
                let problem = format!("{problem}: choose another name, or replace it with --force");
                Err(Error::config("--out", shown(first), problem))
            }
            _ => Ok(Earlier(found)),
        }
    }

    /// Removes those files that are not among the new ones.
    ///
    /// # Errors
    /// [`Error::Io`].
    pub fn make_way(self, made: &[PathBuf]) -> Result<()> {
        let names: Vec<_> = made.iter().filter_map(|path| path.file_name()).collect();
        let mut old = self.0.iter().filter(|path| !path.file_name().is_some_and(|name| names.contains(&name)));
        old.try_for_each(|path| std::fs::remove_file(path).map_err(Error::io("remove", path)))
    }
}

/// Returns random numbers of the system, from which new UIDs are made.
pub fn random_numbers<const N: usize>() -> Result<[u128; N]> {
    let mut bytes = [[0u8; 16]; N];
    for number in &mut bytes {
        getrandom::fill(number).map_err(|e| Error::Internal(format!("random numbers could not be obtained: {e}")))?;
    }
    Ok(bytes.map(u128::from_le_bytes))
}

/// Returns numbers that a model's checkpoint alone determines, so that files which are made of it at different times have the study and
/// the frame of reference in common. `run` is a run directory or a checkpoint file.
///
/// # Errors
/// [`Error::Io`].
pub fn numbers_of_checkpoint<const N: usize>(run: &Path) -> Result<[u128; N]> {
    let file = newest(run)?;
    let bytes = std::fs::read(&file).map_err(Error::io("read", &file))?;
    let half = |number: usize, half: u32| {
        let mut fingerprint = Fingerprint::default();
        fingerprint.word(2 * number as u32 + half);
        bytes
            .chunks(4)
            .for_each(|four| fingerprint.word(four.iter().fold(0, |word, byte| word << 8 | u32::from(*byte))));
        u128::from(fingerprint.value())
    };
    Ok(std::array::from_fn(|number| half(number, 0) << 64 | half(number, 1)))
}
