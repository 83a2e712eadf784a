//! Runs from pictures, such as exports of a viewer: a folder of frames or a file of several pages per view, with a geometry that
//! the user states.

use crate::dicom::{PixelRange, Relationship, Run};
use crate::error::{Error, Result};
use crate::formats::frames::{self, GreyFrame};
use crate::geometry::{CArm, Geometry};
use std::cmp::Ordering;
use std::path::{Path, PathBuf};

/// Largest accepted number of frames of a view.
const MAX_FRAMES: usize = 2000;

/// A view as pictures.
#[derive(Debug, Clone)]
pub struct PictureView {
    /// Folder with one picture per frame, in the order of their names, or a file with one or more frames.
    pub path: PathBuf,
    /// C-arm of all frames.
    pub c_arm: CArm,
    /// Frames per second; none where times are not known.
    pub frames_per_s: Option<f64>,
}

/// Meaning of the pixels of pictures, which no file states.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PixelMeaning {
    /// Relationship between pixel values and intensity.
    pub relationship: Relationship,
    /// Pixel value without absorption; the largest value that the files can store where none is given.
    pub white: Option<f64>,
    /// Whether vessels are brighter than their surroundings.
    pub bright_vessels: bool,
    /// Whether letters are burnt into the frames.
    pub burnt_in_text: bool,
}

/// Compares names as people count: `frame9` comes before `frame10`.
fn by_number(a: &Path, b: &Path) -> Ordering {
    let parts = |path: &Path| -> Vec<(String, u128, String)> {
        let name = path.file_name().unwrap_or_default().to_string_lossy().to_lowercase();
        let mut parts = Vec::new();
        let mut rest = name.as_str();
        while !rest.is_empty() {
            let digits = rest.find(|c: char| c.is_ascii_digit()).unwrap_or(rest.len());
            let (text, after) = rest.split_at(digits);
            let end = after.find(|c: char| !c.is_ascii_digit()).unwrap_or(after.len());
            let (number, after) = after.split_at(end);
            parts.push((text.to_owned(), number.parse().unwrap_or(u128::MAX), number.to_owned()));
            rest = after;
        }
        parts
    };
    parts(a).cmp(&parts(b)).then_with(|| a.cmp(b))
}

/// Picture files of a folder in the order of their names, and the number of other files.
fn listed(folder: &Path) -> Result<(Vec<PathBuf>, usize)> {
    let (mut pictures, mut others) = (Vec::new(), 0);
    for entry in std::fs::read_dir(folder).map_err(Error::io("list", folder))? {
        let path = entry.map_err(Error::io("list", folder))?.path();
        let is_hidden = path.file_name().is_some_and(|name| name.as_encoded_bytes().starts_with(b"."));
        if is_hidden || path.is_dir() {
            continue;
        }
        if frames::is_picture(&path) { pictures.push(path) } else { others += 1 }
    }
    pictures.sort_by(|a, b| by_number(a, b));
    Ok((pictures, others))
}

/// Numbers of frames by the names of their files; none where names differ in more than a number.
fn numbers(files: &[PathBuf]) -> Option<Vec<u64>> {
    let split = |file: &PathBuf| {
        let stem = file.file_stem()?.to_str()?;
        let end = stem.rfind(|c: char| c.is_ascii_digit())? + 1;
        let start = stem[..end].trim_end_matches(|c: char| c.is_ascii_digit()).len();
        Some((stem[..start].to_owned(), stem[start..end].parse::<u64>().ok()?, stem[end..].to_owned()))
    };
    let parts = files.iter().map(split).collect::<Option<Vec<_>>>()?;
    let alike = parts.windows(2).all(|pair| pair[0].0 == pair[1].0 && pair[0].2 == pair[1].2);
    alike.then(|| parts.into_iter().map(|(_, number, _)| number).collect())
}

/// Places of frames in their run, from 0, by their numbers: a number that is missing is a frame that is missing. Frames follow each other
/// where numbers do not tell.
fn places(numbers: &[u64]) -> Vec<usize> {
    let steps: Vec<u64> = numbers.windows(2).map(|pair| pair[1].saturating_sub(pair[0])).collect();
    let mut sorted = steps.clone();
    sorted.sort_unstable();
    let step = sorted.get(sorted.len() / 2).copied().unwrap_or(1);
    if step == 0 || steps.iter().any(|other| *other == 0 || other % step != 0) {
        return (0..numbers.len()).collect();
    }
    numbers.iter().map(|number| ((number - numbers[0]) / step) as usize).collect()
}

/// Returns the places of the frames in the files of a folder, and a warning where frames are missing.
///
/// # Errors
/// [`Error::Data`] for two files of one number.
fn placed(files: &[PathBuf]) -> Result<(Vec<usize>, Option<String>)> {
    let Some(numbers) = numbers(files) else { return Ok(((0..files.len()).collect(), None)) };
    if let Some(k) = (1..numbers.len()).find(|k| numbers[*k] == numbers[k - 1]) {
        let problem = format!("has the number of {}: each frame is needed once", files[k - 1].display());
        return Err(Error::data(&files[k], "name", problem));
    }
    let places = places(&numbers);
    let missing = places.last().map_or(0, |last| last + 1) - places.len();
    let gap = places.windows(2).position(|pair| pair[1] > pair[0] + 1);
    let warning = gap.map(|k| {
        format!(
            "warning: {missing} frames are missing by the numbers in the names, the first after {}: the others keep their times",
            files[k].file_name().unwrap_or_default().to_string_lossy()
        )
    });
    Ok((places, warning))
}

/// Reads a view.
///
/// # Errors
/// [`Error::Data`] naming the file and what it lacks; [`Error::Config`] for an impossible geometry or frame rate; [`Error::Io`].
pub fn read(view: &PictureView, meaning: &PixelMeaning) -> Result<Run> {
    let path = &view.path;
    let mut notes = Vec::new();
    let files = if path.is_dir() {
        let (pictures, others) = listed(path)?;
        if others > 0 {
            notes.push(format!("{others} files of other kinds are ignored"));
        }
        pictures
    } else {
        vec![path.clone()]
    };
    let (mut places, gap) = placed(&files)?;
    notes.extend(gap);
    let mut frames: Vec<GreyFrame> = Vec::new();
    for file in &files {
        let more = frames::read(file)?;
        let size = |frame: &GreyFrame| [frame.image.width, frame.image.height];
        let (first, white) = frames.first().or(more.first()).map_or(([0; 2], 0.0), |frame| (size(frame), frame.white));
        if let Some(other) = more.iter().find(|frame| size(frame) != first || frame.white != white) {
            let problem = format!(
                "{:?} pixels up to {} differ from {first:?} pixels up to {white} of the frames before",
                size(other),
                other.white
            );
            return Err(Error::data(file, "size", problem));
        }
        frames.extend(more);
        if frames.len() > MAX_FRAMES {
            return Err(Error::data(path, "frames", format!("are more than {MAX_FRAMES}")));
        }
    }
    let Some(first) = frames.first() else {
        return Err(Error::data(path, "frames", "there is no picture: .png, .jpg, .jpeg, .tif or .tiff is needed"));
    };
    let (width, height, stored) = (first.image.width, first.image.height, first.white);
    let geometry = Geometry::CArm(view.c_arm.clone());
    geometry.rays(width, height).map_err(|(field, problem)| Error::config(field, "", problem))?;
    let white = meaning.white.map_or(stored, |white| white as f32);
    if !(white.is_finite() && white > 0.0) {
        return Err(Error::config("white", white, "is not a positive pixel value"));
    }
    let coloured = frames.iter().filter(|frame| frame.is_coloured).count();
    if coloured > 0 {
        notes.push(format!("{coloured} of {} frames have colours, of which only the luminance is used", frames.len()));
    }
    let turned = frames.iter().filter(|frame| frame.is_turned).count();
    if turned > 0 {
        notes.push(format!(
            "{turned} of {} frames are stored turned or mirrored by their EXIF orientation, which was undone",
            frames.len()
        ));
    }
    notes.push(format!("pixels are taken as {}; a pixel of {white} means no absorption", meaning.in_words()));
    if places.len() != frames.len() {
        // Files of several pages.
        places = (0..frames.len()).collect();
    }
    let times_s = match view.frames_per_s {
        Some(rate) if rate.is_finite() && rate > 0.0 => places.iter().map(|place| *place as f64 / rate).collect(),
        Some(rate) => return Err(Error::config("frames per second", rate, "is not a positive number")),
        None => Vec::new(),
    };
    let values = |frame: GreyFrame| {
        let mut values = frame.image.values;
        if meaning.bright_vessels {
            values.iter_mut().for_each(|value| *value = white - *value);
        }
        values
    };
    let n = frames.len();
    Ok(Run {
        path: path.clone(),
        width,
        height,
        frames: frames.into_iter().map(values).collect(),
        range: PixelRange { black: 0.0, low: 0.0, white },
        relationship: meaning.relationship,
        c_arms: vec![view.c_arm.clone(); n],
        times_s,
        r_peaks: None,
        open: (0..width, 0..height),
        burnt_in: meaning.burnt_in_text,
        identity: [0; 2],
        source: None,
        instance: None,
        notes,
    })
}

impl PixelMeaning {
    fn in_words(&self) -> &'static str {
        match self.relationship {
            Relationship::Linear => "proportional to intensity",
            Relationship::Log => "logarithmic in intensity",
            Relationship::Display => "display grey values: logarithmic in intensity, with an unknown scale",
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn files(names: &[&str]) -> Vec<PathBuf> {
        names.iter().map(PathBuf::from).collect()
    }

    #[test]
    fn frames_that_are_missing_leave_a_gap() {
        let of = |names: &[&str]| placed(&files(names)).unwrap();
        assert_eq!(of(&["f8.png", "f9.png", "f10.png"]), (vec![0, 1, 2], None));
        let (places, warning) = of(&["f01.png", "f02.png", "f04.png", "f05.png"]);
        assert_eq!(places, [0, 1, 3, 4]);
        assert!(warning.is_some_and(|text| text.contains("1 frames are missing") && text.contains("f02.png")));
        assert_eq!(of(&["f10.png", "f20.png", "f30.png", "f50.png"]).0, [0, 1, 2, 4], "numbers in steps of ten");
        assert_eq!(of(&["f10.png", "f43.png", "f77.png"]).0, [0, 1, 2], "times are no numbers of frames");
        assert_eq!(of(&["a.png", "b1.png", "c7.png"]).0, [0, 1, 2]);
        assert!(placed(&files(&["f1.jpg", "f1.png", "f2.png"])).is_err(), "one frame twice");
    }

    #[test]
    fn names_are_ordered_as_people_count() {
        let mut names = ["f10.png", "f9.png", "f2b.png", "f02.png", "f2.png", "a.png", "f2a.png"].map(PathBuf::from);
        names.sort_by(|a, b| by_number(a, b));
        let wanted = ["a.png", "f02.png", "f2.png", "f2a.png", "f2b.png", "f9.png", "f10.png"].map(PathBuf::from);
        assert_eq!(names, wanted);
    }
}
