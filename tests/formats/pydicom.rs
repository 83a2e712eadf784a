//! DICOM files that pydicom writes, and the pixel values that it or NumPy says they have.

use crate::dicom;
use crate::python::python;
use dicom_object::InMemDicomObject;
use nertca_vk_import::dicom::Run;
use std::path::{Path, PathBuf};

/// Names for the scripts: `base` is a run of six frames of 64 x 64 pixels, of 8 bits, with explicit types.
const BEGIN: &str = "
import io, struct, sys, numpy as np, pydicom
from pathlib import Path
base, out = Path(sys.argv[1]), Path(sys.argv[2])
DATA = base.read_bytes()
def element(group, number, kind, value):
    head = struct.pack('<HH2s', group, number, kind)
    if kind in (b'OB', b'OW', b'SQ', b'UN'):
        length = 0xffffffff if value.endswith(END) else len(value)
        return head + struct.pack('<HI', 0, length) + value
    return head + struct.pack('<H', len(value)) + value
def implicit(group, number, value):
    return struct.pack('<HHI', group, number, 0xffffffff if value.endswith(END) else len(value)) + value
END = bytes.fromhex('feffdde000000000')
def item(content):
    return bytes.fromhex('feff00e0ffffffff') + content + bytes.fromhex('feff0de000000000')
def known_item(content):
    return bytes.fromhex('feff00e0') + struct.pack('<I', len(content)) + content
# Inserts bytes before the pixel description.
def before_pixels(content, data=DATA):
    at = data.index(bytes.fromhex('28000200') + b'US')
    return data[:at] + content + data[at:]
def keep(name, values):
    np.asarray(values, dtype='<f4').tofile(out / f'{name}.values')
# Writes bytes, and the pixels that pydicom reads from them.
def write(name, data):
    (out / f'{name}.dcm').write_bytes(data)
    dataset = pydicom.dcmread(io.BytesIO(data), force=True)
    if 'TransferSyntaxUID' in dataset.file_meta:
        keep(name, dataset.pixel_array)
    else:
        keep(name, np.frombuffer(dataset.PixelData, 'u1'))
# Writes a data set, and the pixels that it has.
def save(name, dataset, values, **options):
    dataset.save_as(out / f'{name}.dcm', **options)
    keep(name, values)
def read():
    return pydicom.dcmread(base)
";

/// Files that a script has written.
pub struct Files {
    directory: tempfile::TempDir,
}

impl Files {
    /// Runs a script that calls `write` or `save` for each file.
    pub fn by(script: &str) -> Files {
        Files::of(script, |_| ())
    }

    /// Runs a script on a run that `change` has changed.
    pub fn of(script: &str, change: impl Fn(&mut InMemDicomObject)) -> Files {
        let directory = tempfile::tempdir().unwrap();
        let base = directory.path().join("base.dcm");
        dicom::angiogram(&base, change);
        let outcome = python()
            .args(["-W", "ignore", "-c", &format!("{BEGIN}{script}")])
            .arg(&base)
            .arg(directory.path())
            .output()
            .unwrap();
        assert!(outcome.status.success(), "{}", String::from_utf8_lossy(&outcome.stderr));
        Files { directory }
    }

    pub fn path(&self, name: &str) -> PathBuf {
        self.directory.path().join(format!("{name}.dcm"))
    }

    /// Names of all files, sorted.
    pub fn names(&self) -> Vec<String> {
        let stem = |path: &Path| path.file_stem().unwrap().to_str().unwrap().to_owned();
        let paths = self.directory.path().read_dir().unwrap().map(|entry| entry.unwrap().path());
        let mut names: Vec<String> =
            paths.filter(|path| path.extension().is_some_and(|e| e == "values")).map(|path| stem(&path)).collect();
        names.sort();
        names
    }

    /// Reads a file, and checks that its pixels are those that were kept for it.
    #[track_caller]
    pub fn read(&self, name: &str) -> Run {
        let run = self.run(name);
        let off = self.apart(name, &run);
        assert_eq!(off, 0.0, "{name}");
        run
    }

    /// Returns how far the pixels of a file are from those that were kept for it.
    #[track_caller]
    pub fn off(&self, name: &str) -> f32 {
        self.apart(name, &self.run(name))
    }

    #[track_caller]
    fn run(&self, name: &str) -> Run {
        Run::read(&self.path(name), None).unwrap_or_else(|error| panic!("{name}: {error}"))
    }

    #[track_caller]
    fn apart(&self, name: &str, run: &Run) -> f32 {
        let wanted = std::fs::read(self.directory.path().join(format!("{name}.values"))).unwrap();
        let wanted: Vec<f32> = wanted.as_chunks().0.iter().map(|b| f32::from_le_bytes(*b)).collect();
        let found = run.frames.concat();
        assert_eq!(found.len(), wanted.len(), "{name}");
        found.iter().zip(&wanted).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max)
    }

    /// Refuses a file, and returns the message.
    #[track_caller]
    pub fn refusal(&self, name: &str) -> String {
        Run::read(&self.path(name), None).err().unwrap_or_else(|| panic!("{name} was read")).to_string()
    }
}
