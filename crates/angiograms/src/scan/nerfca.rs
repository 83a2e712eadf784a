//! Reads and writes the layout of the NeRF-CA / NerT-CA authors.
//!
//! It consists of `general.json` plus `train-*.json` / `test-*.json`. Images are `.npy` arrays normalised to [0, 1] by
//! `img_min_max`, indexed as ordinary pictures: [row = v][column = u] (method, section 6); pixel = I0 - line integral. Masks
//! hold image values inside vessels and I0 elsewhere. Paths may be absolute and out of date.

use crate::error::{Error, Result};
use crate::files;
use crate::formats::image_limits::{MAX_FILE_BYTES, MAX_SIDE};
use crate::formats::npy;
use crate::geometry::{CArm, Geometry};
use crate::raster::Image;
use crate::scan::builder::{Builder, MAX_PHASES, NewFrame, list_of};
use crate::scan::dataset::{Dataset, Layout, Split};
use serde::{Deserialize, Serialize};
use std::collections::HashMap;
use std::path::{Path, PathBuf};

/// Name of the geometry file.
pub const GENERAL: &str = "general.json";
/// Name of the list of training frames that this program writes.
pub const TRAINING_LIST: &str = "train-0.json";
/// Name of the list of validation frames that this program writes.
pub const VALIDATION_LIST: &str = "test-0.json";
const MAX_JSON_BYTES: u64 = 256 << 20;

/// Content of `general.json`: lengths in mm before the authors' 1e-2 scale, or already scaled, as `far_thresh` shows.
#[derive(Debug, Serialize, Deserialize)]
#[allow(non_snake_case, reason = "the authors' spelling")]
pub(crate) struct General {
    pub DSD: f64,
    pub DSO: f64,
    pub nDetector: Vec<f64>,
    pub dDetector: Vec<f64>,
    pub nVoxel: Vec<f64>,
    pub dVoxel: Vec<f64>,
    #[serde(default)]
    pub offOrigin: Vec<f64>,
    #[serde(default)]
    pub offDetector: Vec<f64>,
    pub near_thresh: f64,
    pub far_thresh: f64,
    pub max_pixel_value: f64,
}

#[derive(Debug, Serialize, Deserialize)]
pub(crate) struct FrameList {
    pub frames: Vec<FrameEntry>,
}

#[derive(Debug, Serialize, Deserialize)]
pub(crate) struct FrameEntry {
    pub file_path: String,
    pub img_min_max: [f64; 2],
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub mask_file_path: Option<String>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub weighted_file_path: Option<String>,
    pub heart_phase: f64,
    pub theta: f64,
    pub phi: f64,
    #[serde(default)]
    pub larm: f64,
}

/// A frame with its list file and its index in it.
struct Entry {
    file: PathBuf,
    index: usize,
    split: Split,
    frame: FrameEntry,
}

impl Entry {
    fn bad(&self, field: &str, problem: String) -> Error {
        Error::data(&self.file, format!("frames[{}].{field}", self.index), problem)
    }
}

fn read_json<T: serde::de::DeserializeOwned>(file: &Path) -> Result<T> {
    Ok(files::read_json(file, MAX_JSON_BYTES)?)
}

/// Reads a dataset in the authors' layout.
///
/// # Errors
/// [`Error::Data`] or [`Error::Io`] naming file and field.
pub fn open(path: &Path) -> Result<Dataset> {
    let general_file = path.join(GENERAL);
    let general: General = read_json(&general_file)?;
    let pair = |field: &str, v: &[f64]| -> Result<[f64; 2]> {
        match v {
            [a, b, ..] if a.is_finite() && b.is_finite() => Ok([*a, *b]),
            _ => Err(Error::data(&general_file, field, "needs two finite numbers")),
        }
    };
    let [columns, rows] = pair("nDetector", &general.nDetector)?;
    if !(columns >= 1.0 && rows >= 1.0 && columns <= MAX_SIDE as f64 && rows <= MAX_SIDE as f64) {
        return Err(Error::data(&general_file, "nDetector", format!("{columns} x {rows} is not an image size")));
    }
    let (width, height) = (columns as usize, rows as usize);
    let pixel = pair("dDetector", &general.dDetector)?;
    let offset = if general.offDetector.is_empty() { [0.0; 2] } else { pair("offDetector", &general.offDetector)? };
    let i0 = general.max_pixel_value;
    if !i0.is_finite() {
        return Err(Error::data(&general_file, "max_pixel_value", "is not finite"));
    }
    if general.near_thresh.partial_cmp(&general.far_thresh) != Some(std::cmp::Ordering::Less) {
        return Err(Error::data(&general_file, "near_thresh", "is not below far_thresh"));
    }
    // Depth thresholds are in world units (100 mm); distances may be in mm or already in world units.
    let to_mm = if general.DSO > general.far_thresh * 2.0 { 1.0 } else { 100.0 };
    let sod = general.DSO * to_mm / 100.0;
    let depth_range = (general.near_thresh - sod, general.far_thresh - sod);
    let lists = frame_lists(path)?;
    let by_name = files_by_name(path)?;
    let mut entries = Vec::new();
    for (file, split) in lists {
        let list: FrameList = read_json(&file)?;
        let numbered = list.frames.into_iter().enumerate();
        entries.extend(numbered.map(|(index, frame)| Entry { file: file.clone(), index, split, frame }));
    }
    let phases = heart_phases(&entries)?;
    let (numbered, note) = number_phases(&phases);
    let mut builder = Builder::new(&general_file, numbered.len().max(1) as u32, depth_range, None)?;
    builder.notes.extend(note);
    for (entry, phase) in entries.iter().zip(&phases) {
        let frame = &entry.frame;
        let read = |field: &str, name: &str| -> Result<(PathBuf, Image)> {
            let found = resolve(path, &by_name, name)
                .ok_or_else(|| entry.bad(field, format!("{name} was not found in {}", path.display())))?;
            let image = read_picture(&found, width, height)?;
            Ok((found, image))
        };
        let (source, image) = read("file_path", &frame.file_path)?;
        let [low, high] = frame.img_min_max;
        if !(low.is_finite() && high.is_finite() && high > low) {
            return Err(entry.bad("img_min_max", format!("[{low}, {high}] is not a valid range")));
        }
        let mask = match &frame.mask_file_path {
            None => None,
            Some(name) => {
                let (_, mask) = read("mask_file_path", name)?;
                let top = mask.values.iter().copied().fold(f32::MIN, f32::max);
                Some(mask.values.iter().map(|v| *v < top).collect())
            }
        };
        builder.add(NewFrame {
            index: entry.index,
            source: &source,
            geometry: Geometry::CArm(CArm {
                primary_deg: frame.theta,
                secondary_deg: frame.phi,
                sid_mm: general.DSD * to_mm,
                sod_mm: general.DSO * to_mm,
                pixel_mm: pixel.map(|p| p * to_mm),
                offset_mm: offset.map(|p| p * to_mm),
                table_mm: [0.0; 3],
            }),
            time_phases: numbered.partition_point(|p| p < phase) as f64,
            split: entry.split,
            image,
            to_integral: |v| (i0 - (f64::from(v) * (high - low) + low)) as f32,
            mask,
            heart_shift_mm: [0.0; 3],
        })?;
    }
    builder.finish(path, Layout::Nerfca)
}

/// Lists `train-*.json` and `test-*.json` of the directory, sorted.
fn frame_lists(path: &Path) -> Result<Vec<(PathBuf, Split)>> {
    let mut lists = Vec::new();
    for entry in std::fs::read_dir(path).map_err(Error::io("list", path))? {
        let file = entry.map_err(Error::io("list", path))?.path();
        let Some(name) = file.file_name().and_then(|n| n.to_str()) else {
            continue;
        };
        if !name.ends_with(".json") {
            continue;
        }
        if name.starts_with("train") {
            lists.push((file, Split::Train));
        } else if name.starts_with("test") {
            lists.push((file, Split::Validation));
        }
    }
    lists.sort();
    Ok(lists)
}

/// All `.npy` files below the directory (three levels), by file name, to resolve absolute paths that are out of date.
fn files_by_name(path: &Path) -> Result<HashMap<String, PathBuf>> {
    let mut found = HashMap::new();
    let mut open = vec![(path.to_path_buf(), 0)];
    while let Some((directory, depth)) = open.pop() {
        for entry in std::fs::read_dir(&directory).map_err(Error::io("list", &directory))? {
            let file = entry.map_err(Error::io("list", &directory))?.path();
            if file.is_dir() && depth < 3 {
                open.push((file, depth + 1));
            } else if file.extension().is_some_and(|e| e == "npy")
                && let Some(name) = file.file_name().and_then(|n| n.to_str())
            {
                found.entry(name.to_owned()).or_insert(file);
            }
        }
    }
    Ok(found)
}

fn resolve(root: &Path, by_name: &HashMap<String, PathBuf>, stated: &str) -> Option<PathBuf> {
    let stated_path = Path::new(stated);
    let direct = root.join(stated_path);
    if stated_path.is_relative() && direct.is_file() {
        return Some(direct);
    }
    // A path written on another system may use another separator.
    by_name.get(stated.rsplit(['/', '\\']).next()?).cloned()
}

/// Checks the `heart_phase` of each entry. It selects a row of the authors' table of latents, so it is an integer from 0.
fn heart_phases(entries: &[Entry]) -> Result<Vec<u32>> {
    let check = |entry: &Entry| {
        let phase = entry.frame.heart_phase;
        if phase.fract() == 0.0 && (0.0..f64::from(MAX_PHASES)).contains(&phase) {
            return Ok(phase as u32);
        }
        let problem = format!("{phase} is not a whole number from 0 to {}", MAX_PHASES - 1);
        Err(entry.bad("heart_phase", problem))
    };
    entries.iter().map(check).collect()
}

/// Phases that occur, in order, and a note on missing phases between them.
fn number_phases(phases: &[u32]) -> (Vec<u32>, Option<String>) {
    let mut found = phases.to_vec();
    found.sort_unstable();
    found.dedup();
    let last = found.last().copied().unwrap_or(0);
    let missing: Vec<u32> = (0..last).filter(|p| found.binary_search(p).is_err()).collect();
    let note = (!missing.is_empty()).then(|| {
        format!(
            "no frame has heart_phase {}: the phases that occur, {}, are renumbered as 0-{}",
            list_of(&missing),
            list_of(&found),
            found.len() - 1
        )
    });
    (found, note)
}

/// Reads a picture in row-major order; axes of length one, as in stacks of a single projection, are ignored.
fn read_picture(path: &Path, width: usize, height: usize) -> Result<Image> {
    let npy::Array { shape, values } = npy::read(path, MAX_FILE_BYTES)?;
    let long: Vec<usize> = shape.iter().copied().filter(|n| *n != 1).collect();
    let wanted: Vec<usize> = [height, width].into_iter().filter(|n| *n != 1).collect();
    // A flat list of pixels is in row-major order.
    if long != wanted && shape[..] != [height * width] {
        let problem =
            format!("is {shape:?}, but a picture of {height} rows and {width} columns needs [{height}, {width}]");
        return Err(Error::data(path, "shape", problem));
    }
    Ok(Image { width, height, values })
}
