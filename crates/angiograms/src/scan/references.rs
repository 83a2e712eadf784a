//! Links from the images of a dataset to the DICOM files from which they were made: `references.json`, beside the manifest. Only an import
//! that is asked to keep them writes them, because they name the patient.

use crate::error::{Error, Result};
use crate::files;
use serde::{Deserialize, Serialize};
use std::io::ErrorKind;
use std::path::{Path, PathBuf};

/// Name of the file inside a dataset.
pub const REFERENCES: &str = "references.json";
/// Value of [`References::format`].
const FORMAT: &str = "nertca-references";
/// Value of [`References::version`].
const VERSION: u32 = 1;

/// Patient and study of a run, as its file states them; DICOM objects of one study must agree in them. Empty where the file states nothing.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct SourceStudy {
    /// UID of the study (0020,000D).
    pub study_uid: String,
    /// Name of the patient (0010,0010).
    pub patient_name: String,
    /// Identifier of the patient (0010,0020).
    pub patient_id: String,
    /// Date of birth (0010,0030).
    pub patient_birth_date: String,
    /// Sex (0010,0040).
    pub patient_sex: String,
    /// Date of the study (0008,0020).
    pub study_date: String,
    /// Time of the study (0008,0030).
    pub study_time: String,
    /// Identifier of the study (0020,0010).
    pub study_id: String,
    /// Accession number (0008,0050).
    pub accession_number: String,
    /// Name of the referring physician (0008,0090).
    pub referring_physician: String,
}

/// DICOM image with the frames of a run.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SourceImage {
    /// Its patient and study.
    pub study: SourceStudy,
    /// UID of its series (0020,000E).
    pub series_uid: String,
    /// UID of its class (0008,0016).
    pub class_uid: String,
    /// UID of the image (0008,0018).
    pub instance_uid: String,
    /// Columns and rows.
    pub size: [usize; 2],
    /// Centre and width of the first window (0028,1050 and 0028,1051) by which it is shown, where it is stated.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub window: Option<[f64; 2]>,
}

/// Run of a dataset, and where its images lie in the source image.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ReferencedRun {
    /// Image from which the run was made.
    pub source: SourceImage,
    /// Column and row of the source at which the images begin, pixels from 0.
    pub first_px: [usize; 2],
    /// Columns, and rows, of the source that one pixel of the images covers.
    pub pixels_per_pixel: usize,
}

impl ReferencedRun {
    /// Converts a place in an image of the dataset, counted from the centre of its first pixel, to a place in the source, counted from the
    /// outer corner of its first pixel as DICOM does (PS3.3 C.10.5.1.2).
    pub fn source_px(&self, (column, row): (f64, f64)) -> [f64; 2] {
        let along = |first: usize, at: f64| first as f64 + self.pixels_per_pixel as f64 * (at + 0.5);
        [along(self.first_px[0], column), along(self.first_px[1], row)]
    }
}

/// Image of a dataset.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ReferencedImage {
    /// Image file, as in the manifest.
    pub image: PathBuf,
    /// Its run, as index into [`References::runs`].
    pub run: usize,
    /// Frames of the source whose mean the image is, from 1.
    pub frames: Vec<u32>,
}

/// Content of `references.json`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct References {
    /// Always `nertca-references`.
    format: String,
    /// Version of this layout: 1.
    version: u32,
    /// Runs.
    pub runs: Vec<ReferencedRun>,
    /// Images.
    pub images: Vec<ReferencedImage>,
}

impl References {
    /// Makes the references of images of runs.
    pub fn new(runs: Vec<ReferencedRun>, images: Vec<ReferencedImage>) -> References {
        References { format: FORMAT.into(), version: VERSION, runs, images }
    }

    /// Writes the file into a dataset.
    ///
    /// # Errors
    /// [`Error::Io`].
    pub fn write(&self, dataset: &Path) -> Result<()> {
        Ok(files::write_atomic(&dataset.join(REFERENCES), files::pretty_json(self)?.as_bytes())?)
    }

    /// Reads the file of a dataset; `None` where its import was not asked to keep references.
    ///
    /// # Errors
    /// [`Error::Data`] naming the field; [`Error::Io`].
    pub fn read(dataset: &Path) -> Result<Option<References>> {
        let path = dataset.join(REFERENCES);
        let text = match std::fs::read_to_string(&path) {
            Err(error) if error.kind() == ErrorKind::NotFound => return Ok(None),
            read => read.map_err(Error::io("read", &path))?,
        };
        let read: References =
            serde_json::from_str(&text).map_err(|error| Error::data(&path, "file", error.to_string()))?;
        read.check(&path)?;
        Ok(Some(read))
    }

    fn check(&self, path: &Path) -> Result<()> {
        let bad = |field: String, problem: &str| Err(Error::data(path, field, problem));
        if self.format != FORMAT || self.version != VERSION {
            return bad("format".into(), "is not `nertca-references` of version 1");
        }
        for (i, run) in self.runs.iter().enumerate() {
            if run.pixels_per_pixel == 0 {
                return bad(format!("runs[{i}].pixels_per_pixel"), "is 0");
            }
            let source = &run.source;
            let uids = [&source.study.study_uid, &source.series_uid, &source.class_uid, &source.instance_uid];
            if !uids.iter().all(|uid| is_uid(uid)) {
                return bad(format!("runs[{i}].source"), "has a UID that is missing or no UID");
            }
            if source.size.iter().any(|side| *side == 0 || *side > usize::from(u16::MAX)) {
                return bad(format!("runs[{i}].source.size"), "is not in the accepted range, 1 to 65535");
            }
            if source.window.is_some_and(|[centre, width]| !(centre.is_finite() && width.is_finite())) {
                return bad(format!("runs[{i}].source.window"), "is not finite");
            }
        }
        for (i, image) in self.images.iter().enumerate() {
            if image.run >= self.runs.len() {
                return bad(format!("images[{i}].run"), "is not the index of a run");
            }
            if image.frames.is_empty() || image.frames.contains(&0) {
                return bad(format!("images[{i}].frames"), "are not frames of the source, from 1");
            }
        }
        Ok(())
    }

    /// Returns the references of a dataset with the same frames in other files: `frames` are their names here, and their files there.
    pub fn of_other_files<'a>(&self, frames: impl Iterator<Item = (&'a str, &'a Path)>) -> References {
        let image = |(name, file): (&str, &Path)| {
            let (_, image) = self.of_frame(name)?;
            Some(ReferencedImage { image: file.to_owned(), ..image.clone() })
        };
        References { images: frames.filter_map(image).collect(), ..self.clone() }
    }

    /// Returns the references of a frame of the dataset by its name, which is that of its image file.
    pub fn of_frame(&self, name: &str) -> Option<(&ReferencedRun, &ReferencedImage)> {
        let image = self.images.iter().find(|image| image.image.file_stem().is_some_and(|stem| stem == name))?;
        Some((&self.runs[image.run], image))
    }
}

/// Tells whether a text is a UID (PS3.5 9.1).
pub fn is_uid(text: &str) -> bool {
    let part = |part: &str| !part.is_empty() && part.bytes().all(|b| b.is_ascii_digit());
    text.len() <= 64 && text.split('.').all(part) && !text.is_empty()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn references() -> References {
        let source = SourceImage {
            study: SourceStudy { study_uid: "1.2.3".into(), ..SourceStudy::default() },
            series_uid: "1.2.3.4".into(),
            class_uid: "1.2.840.10008.5.1.4.1.1.12.1".into(),
            instance_uid: "1.2.3.4.5".into(),
            size: [512, 512],
            window: Some([128.0, 256.0]),
        };
        let run = ReferencedRun { source, first_px: [10, 20], pixels_per_pixel: 4 };
        let image = ReferencedImage { image: "images/train-view0-phase03.npy".into(), run: 0, frames: vec![7, 19] };
        References::new(vec![run], vec![image])
    }

    #[test]
    fn places_in_the_source_are_those_of_the_pixels() {
        let run = &references().runs[0];
        // The first pixel of the image covers columns 10 to 13: its centre lies 12 columns from the corner.
        assert_eq!(run.source_px((0.0, 0.0)), [12.0, 22.0]);
        assert_eq!(run.source_px((-0.5, 9.5)), [10.0, 60.0]);
    }

    #[test]
    fn references_are_read_as_written_and_faults_are_named() {
        let directory = tempfile::tempdir().unwrap();
        assert_eq!(References::read(directory.path()).unwrap(), None);
        let good = references();
        good.write(directory.path()).unwrap();
        let read = References::read(directory.path()).unwrap().unwrap();
        assert_eq!(read, good);
        assert_eq!(read.of_frame("train-view0-phase03").unwrap().1.frames, [7, 19]);
        assert!(read.of_frame("train-view1-phase03").is_none());
        let files = [("train-view0-phase03", "train/a.png"), ("train-view1-phase03", "train/b.png")];
        let other = read.of_other_files(files.into_iter().map(|(name, file)| (name, Path::new(file))));
        assert_eq!((other.images.len(), &other.runs), (1, &read.runs), "a frame without references has none elsewhere");
        assert_eq!(other.of_frame("a").unwrap().1.frames, [7, 19]);
        type Change = fn(&mut References);
        let changes: [(Change, &str); 7] = [
            (|r| r.version = 2, "format"),
            (|r| r.runs[0].pixels_per_pixel = 0, "runs[0].pixels_per_pixel"),
            (|r| r.runs[0].source.series_uid = "1.2.x".into(), "runs[0].source"),
            (|r| r.runs[0].source.size = [0, 4], "runs[0].source.size"),
            (|r| r.images[0].run = 1, "images[0].run"),
            (|r| r.images[0].frames.clear(), "images[0].frames"),
            (|r| r.images[0].frames = vec![0], "images[0].frames"),
        ];
        for (change, field) in changes {
            let mut bad = good.clone();
            change(&mut bad);
            bad.write(directory.path()).unwrap();
            let message = References::read(directory.path()).unwrap_err().to_string();
            assert!(message.contains(field) && message.contains(REFERENCES), "{message}");
        }
        std::fs::write(directory.path().join(REFERENCES), "{").unwrap();
        assert!(References::read(directory.path()).is_err());
    }
}
