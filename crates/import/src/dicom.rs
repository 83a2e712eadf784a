//! Reads an X-ray angiography run from a DICOM file: frames, geometry, times, ECG. Nothing that identifies a patient is kept.

use crate::codecs::Codec;
use crate::elements::{self, Content, numbers};
use crate::enhanced::{self, Groups};
use crate::error::{Error, Result};
use crate::fingerprint::Fingerprint;
use crate::frames::{self, Layout};
use crate::geometry::CArm;
use crate::orientation::{self, Orientation};
use crate::reader::Reader;
use crate::scan::gating::RPeaks;
use crate::scan::references::SourceImage;
use crate::stated::StatedGeometry;
use crate::{timing, traces};
use dicom_core::{Tag, VR};
use dicom_dictionary_std::tags;
use std::ops::Range;
use std::path::{Path, PathBuf};

const MAX_FILE_BYTES: u64 = 4 << 30;
const MAX_SIDE: u32 = 4096;
const MAX_FRAMES: u32 = 2000;
/// Largest accepted number of pixels of a run, which are kept as 32-bit floats.
const MAX_PIXELS: u64 = 1 << 29;

/// Meaning of pixel values, as the file states it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Relationship {
    /// Linear in intensity.
    Linear,
    /// Logarithmic in intensity.
    Log,
    /// Display grey values, treated as logarithmic with unknown scale.
    Display,
}

/// An X-ray angiography run.
#[derive(Debug, Clone)]
pub struct Run {
    /// File the run was read from.
    pub path: PathBuf,
    /// Columns.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// Frames in row-major order, with larger values for less absorption.
    pub frames: Vec<Vec<f32>>,
    /// Range of possible pixel values.
    pub range: PixelRange,
    /// Meaning of the pixel values.
    pub relationship: Relationship,
    /// C-arm of each frame; table positions are as the file states them, not relative to another run.
    pub c_arms: Vec<CArm>,
    /// Time of each frame after the first, seconds.
    pub times_s: Vec<f64>,
    /// R-peaks on the same clock, where the file has an ECG.
    pub r_peaks: Option<RPeaks>,
    /// Columns and rows inside the collimator's shutters.
    pub open: (Range<usize>, Range<usize>),
    /// Whether the file says that text is burnt into the pixels.
    pub burnt_in: bool,
    /// Hashes of patient and study, which can only be compared for equality.
    pub identity: [u64; 2],
    /// Hash of the instance, which is equal for copies of a run; none if the file does not state it.
    pub instance: Option<u64>,
    /// Identity of the file, where it has all UIDs; kept in memory only, unless an import is asked to keep references.
    pub source: Option<SourceImage>,
    /// Notes on assumptions and on unusual content.
    pub notes: Vec<String>,
}

impl Reader<'_> {
    /// Returns one value per frame from a base and increments: one for each frame, or a single increment that is repeated.
    fn per_frame(&self, base: f64, tag: Tag, name: &str, frames: usize, notes: &mut Vec<String>) -> Result<Vec<f64>> {
        let Some(steps) = self.numbers(tag, name)? else { return Ok(vec![base; frames]) };
        if let [step] = steps[..]
            && frames > 1
        {
            if step != 0.0 {
                notes.push(format!(
                    "{name} has one value for {frames} frames: {step} is added from each frame to the next"
                ));
            }
            return Ok((0..frames).map(|i| base + i as f64 * step).collect());
        }
        if steps.len() != frames {
            return Err(self.bad(tag, name, format!("has {} values for {frames} frames", steps.len())));
        }
        if steps.iter().any(|step| *step != 0.0) {
            let (low, high) = steps.iter().fold((f64::MAX, f64::MIN), |(low, high), s| (low.min(*s), high.max(*s)));
            notes.push(format!(
                "{name}: its values, {low} to {high}, are taken as differences from the first position, as DICOM says, not from \
                 the frame before"
            ));
            let repeated = frames > 2 && steps[1] != 0.0 && steps[1..].iter().all(|step| *step == steps[1]);
            if repeated {
                notes.push(format!(
                    "warning: {name} is {} for every frame after the first: if the motion goes on from frame to frame, the file \
                     states it wrongly, and a single value of {} would be read as that",
                    steps[1], steps[1]
                ));
            }
        }
        Ok(steps.iter().map(|step| base + step).collect())
    }

    /// Distances from the source to the detector and to the patient, mm: those that the user states before those of the file.
    fn distances(&self, stated: &StatedGeometry, notes: &mut Vec<String>) -> Result<[f64; 2]> {
        let positive = |tag, name| -> Result<Option<f64>> { Ok(self.number(tag, name)?.filter(|value| *value > 0.0)) };
        let or_file = |stated: Option<f64>, tag, name| stated.map_or_else(|| positive(tag, name), |mm| Ok(Some(mm)));
        let sid_mm = or_file(stated.sid_mm, tags::DISTANCE_SOURCE_TO_DETECTOR, "DistanceSourceToDetector")?;
        let sod_mm = or_file(stated.sod_mm, tags::DISTANCE_SOURCE_TO_PATIENT, "DistanceSourceToPatient")?;
        let factor =
            positive(tags::ESTIMATED_RADIOGRAPHIC_MAGNIFICATION_FACTOR, "EstimatedRadiographicMagnificationFactor")?;
        match (sid_mm, sod_mm, factor.filter(|factor| *factor > 1.0)) {
            (Some(sid_mm), None, Some(factor)) => {
                notes.push(format!(
                    "DistanceSourceToPatient is missing: {:.1} mm are used, which is DistanceSourceToDetector over \
                     EstimatedRadiographicMagnificationFactor ({factor})",
                    sid_mm / factor
                ));
                Ok([sid_mm, sid_mm / factor])
            }
            (None, Some(sod_mm), Some(factor)) => {
                notes.push(format!(
                    "DistanceSourceToDetector is missing: {:.1} mm are used, which is DistanceSourceToPatient times \
                     EstimatedRadiographicMagnificationFactor ({factor})",
                    sod_mm * factor
                ));
                Ok([sod_mm * factor, sod_mm])
            }
            (sid_mm, sod_mm, _) => Ok([
                match sid_mm {
                    Some(mm) => mm,
                    None => self.needed_or(tags::DISTANCE_SOURCE_TO_DETECTOR, "DistanceSourceToDetector", "--sid")?,
                },
                match sod_mm {
                    Some(mm) => mm,
                    None => self.needed_or(tags::DISTANCE_SOURCE_TO_PATIENT, "DistanceSourceToPatient", "--sod")?,
                },
            ]),
        }
    }
}

impl Run {
    /// Reads a run. `pixel_mm` overrides the pixel pitch on the detector and is needed where the file does not state it.
    ///
    /// # Errors
    /// [`Error::Data`] naming file and tag; [`Error::Io`].
    pub fn read(path: &Path, pixel_mm: Option<[f64; 2]>) -> Result<Run> {
        Run::read_as_stated(path, &StatedGeometry { pixel_mm, ..StatedGeometry::default() })
    }

    /// Reads a run whose geometry the user states, in whole or in part.
    ///
    /// # Errors
    /// Errors of [`Run::read`].
    pub fn read_as_stated(path: &Path, stated: &StatedGeometry) -> Result<Run> {
        let meta = std::fs::metadata(path).map_err(Error::io("read", path))?;
        if meta.is_dir() {
            return Err(Error::data(path, "file", "is a folder; give the files with runs in it"));
        }
        if meta.len() > MAX_FILE_BYTES {
            let problem = format!("{} bytes are more than the accepted 4 GiB", meta.len());
            return Err(Error::data(path, "size", problem));
        }
        let Content { syntax, data, mut notes } = elements::read(path)?;
        let r = Reader { data: &data, path };
        r.check_modality()?;
        enhanced::check_class(&r)?;
        let codec =
            Codec::of(&syntax).map_err(|problem| r.bad(tags::TRANSFER_SYNTAX_UID, "TransferSyntaxUID", problem))?;
        let side = |tag, name| -> Result<usize> {
            let n = r.needed(tag, name)?;
            if n.fract() == 0.0 && (1.0..=f64::from(MAX_SIDE)).contains(&n) {
                Ok(n as usize)
            } else {
                Err(r.bad(tag, name, format!("{n} is not in the accepted range, 1 to {MAX_SIDE}")))
            }
        };
        let (width, height) = (side(tags::COLUMNS, "Columns")?, side(tags::ROWS, "Rows")?);
        let n = r.number(tags::NUMBER_OF_FRAMES, "NumberOfFrames")?.unwrap_or(1.0);
        if n.fract() != 0.0 || !(1.0..=f64::from(MAX_FRAMES)).contains(&n) {
            let problem = format!("{n} is not in the accepted range, 1 to {MAX_FRAMES}");
            return Err(r.bad(tags::NUMBER_OF_FRAMES, "NumberOfFrames", problem));
        }
        let n = n as usize;
        if (width * height * n) as u64 > MAX_PIXELS {
            return Err(r.bad(
                tags::NUMBER_OF_FRAMES,
                "NumberOfFrames",
                "all frames together have more pixels than the accepted maximum",
            ));
        }
        let groups = Groups::of(&r, n)?;
        let c_arms = match &groups {
            Some(groups) => r.possible(groups.c_arms(stated, &mut notes)?, [width, height])?,
            None => r.c_arms(n, [width, height], stated, &mut notes)?,
        };
        let orientation = Orientation::of(&r, groups.as_ref(), n)?;
        notes.extend(orientation.note());
        notes.extend(orientation::warnings(&r, &c_arms[0]));
        let times_s = match groups.as_ref().and_then(Groups::times_s) {
            Some(times_s) => times_s,
            None => timing::times(&r, n, &mut notes)?,
        };
        let table = r.modality_table()?;
        let relationship = match table {
            // Part 3, C.8.7.1.1.2: the table of an angiogram leads from stored values to values linear in intensity.
            Some(_) => Relationship::Linear,
            None => r.relationship(groups.as_ref(), &mut notes),
        };
        let (frames, range) = r.frames(codec, n, [width, height], table.as_ref(), groups.as_ref(), &mut notes)?;
        let stated = groups.as_ref().and_then(|groups| groups.r_peaks(&times_s, &mut notes));
        let r_peaks = stated.or_else(|| r.r_peaks(&times_s, &mut notes));
        let hashed = |tag| Fingerprint::of(r.text(tag).unwrap_or_default().as_bytes()).value();
        let identity = [tags::PATIENT_ID, tags::STUDY_INSTANCE_UID].map(hashed);
        let instance = r.text(tags::SOP_INSTANCE_UID).map(|uid| Fingerprint::of(uid.as_bytes()).value());
        let stored = [width, height];
        let open = match &groups {
            Some(groups) => shared_area(groups.shutters()?.iter().map(|shutter| shutter.open_area(width, height)))?
                .map_or_else(|| r.open_area(width, height), Ok)?,
            None => r.open_area(width, height)?,
        };
        let [width, height] = orientation.sides(stored);
        Ok(Run {
            path: path.to_path_buf(),
            width,
            height,
            frames: if orientation.is_upright() {
                frames
            } else {
                frames.iter().map(|frame| orientation.image(frame, stored)).collect()
            },
            range,
            relationship,
            c_arms: c_arms.into_iter().map(|c_arm| orientation.c_arm(c_arm)).collect(),
            times_s,
            r_peaks,
            open: orientation.area(open, stored),
            burnt_in: r.text(tags::BURNED_IN_ANNOTATION).is_some_and(|t| t.eq_ignore_ascii_case("YES")),
            identity,
            instance,
            // References count pixels as they are stored.
            source: r.source(stored).filter(|_| orientation.is_upright()),
            notes,
        })
    }

    /// Name for messages and files: the file's name without its extension.
    pub fn name(&self) -> String {
        self.path.file_stem().unwrap_or_default().to_string_lossy().into_owned()
    }
}

impl Reader<'_> {
    fn check_modality(&self) -> Result<()> {
        let modality = self.text(tags::MODALITY).unwrap_or_default();
        if !["XA", "RF"].contains(&modality.as_str()) {
            let problem = format!("`{modality}` is neither X-ray angiography (XA) nor fluoroscopy (RF)");
            return Err(self.bad(tags::MODALITY, "Modality", problem));
        }
        let samples = self.number(tags::SAMPLES_PER_PIXEL, "SamplesPerPixel")?.unwrap_or(1.0);
        let colour = self.text(tags::PHOTOMETRIC_INTERPRETATION).unwrap_or_default();
        if samples != 1.0 || !["MONOCHROME1", "MONOCHROME2"].contains(&colour.as_str()) {
            let problem =
                format!("`{colour}` with {samples} samples per pixel is not supported; grey values are needed");
            return Err(self.bad(tags::PHOTOMETRIC_INTERPRETATION, "PhotometricInterpretation", problem));
        }
        Ok(())
    }

    fn c_arms(
        &self,
        n: usize,
        size: [usize; 2],
        stated: &StatedGeometry,
        notes: &mut Vec<String>,
    ) -> Result<Vec<CArm>> {
        // Stated angles are those of all frames: the file's increments belong to the file's angles.
        let mut angles = |stated: Option<f64>, [tag, turn]: [Tag; 2], [name, turn_name]: [&str; 2]| match stated {
            Some(angle) => Ok(vec![angle; n]),
            None => self.per_frame(self.needed_or(tag, name, "--angles")?, turn, turn_name, n, notes),
        };
        let primary = angles(
            stated.angles_deg.map(|angles| angles[0]),
            [tags::POSITIONER_PRIMARY_ANGLE, tags::POSITIONER_PRIMARY_ANGLE_INCREMENT],
            ["PositionerPrimaryAngle", "PositionerPrimaryAngleIncrement"],
        )?;
        let secondary = angles(
            stated.angles_deg.map(|angles| angles[1]),
            [tags::POSITIONER_SECONDARY_ANGLE, tags::POSITIONER_SECONDARY_ANGLE_INCREMENT],
            ["PositionerSecondaryAngle", "PositionerSecondaryAngleIncrement"],
        )?;
        let [sid_mm, sod_mm] = self.distances(stated, notes)?;
        let spacing = self.numbers(tags::IMAGER_PIXEL_SPACING, "ImagerPixelSpacing")?;
        let pixel_mm =
            match (stated.pixel_mm, spacing, self.numbers(tags::FIELD_OF_VIEW_DIMENSIONS, "FieldOfViewDimensions")?) {
                (Some(pixel_mm), ..) => pixel_mm,
                // DICOM lists the spacing of rows first.
                (None, Some(spacing), _) if spacing.len() >= 2 => [spacing[1], spacing[0]],
                (None, _, Some(field)) if field[0] > 0.0 => {
                    let pitch = field[0] / size[0].max(size[1]) as f64;
                    notes.push(format!(
                    "ImagerPixelSpacing is missing: {pitch:.6} mm from FieldOfViewDimensions are used; --pixel-spacing \
                     overrides this value"
                ));
                    [pitch; 2]
                }
                _ => {
                    let problem = "is missing; give the pixel spacing at the detector, in mm, by --pixel-spacing";
                    return Err(self.bad(tags::IMAGER_PIXEL_SPACING, "ImagerPixelSpacing", problem));
                }
            };
        // DICOM's table height is positive below the isocentre, so a larger height moves the patient towards posterior.
        let height = self.number(tags::TABLE_HEIGHT, "TableHeight")?.unwrap_or(0.0);
        let lateral = self.number(tags::TABLE_TRAVERSE, "TableTraverse")?.unwrap_or(0.0);
        let down = self.per_frame(height, tags::TABLE_VERTICAL_INCREMENT, "TableVerticalIncrement", n, notes)?;
        let left = self.per_frame(lateral, tags::TABLE_LATERAL_INCREMENT, "TableLateralIncrement", n, notes)?;
        let along = self.per_frame(0.0, tags::TABLE_LONGITUDINAL_INCREMENT, "TableLongitudinalIncrement", n, notes)?;
        let position = self.text(tags::PATIENT_POSITION).unwrap_or_default();
        if !["HFS", ""].contains(&position.as_str()) {
            notes.push(format!(
                "the patient position is {position}, but axes are named as for a supine patient, head first (HFS)"
            ));
        }
        let arms: Vec<CArm> = (0..n)
            .map(|i| CArm {
                primary_deg: primary[i],
                secondary_deg: secondary[i],
                sid_mm,
                sod_mm,
                pixel_mm,
                offset_mm: [0.0; 2],
                table_mm: [left[i], down[i], along[i]],
            })
            .collect();
        self.possible(arms, size)
    }

    /// Checks that a C-arm as that of the first frame can exist.
    fn possible(&self, arms: Vec<CArm>, size: [usize; 2]) -> Result<Vec<CArm>> {
        let first = CArm { table_mm: [0.0; 3], ..arms[0].clone() };
        let rays = crate::geometry::Geometry::CArm(first).rays(size[0], size[1]);
        rays.map(|_| arms).map_err(|(field, problem)| Error::data(self.path, tag_of(&field), problem))
    }

    fn relationship(&self, groups: Option<&Groups<'_>>, notes: &mut Vec<String>) -> Relationship {
        let stated = self.text(tags::PIXEL_INTENSITY_RELATIONSHIP).or_else(|| groups?.relationship());
        match stated.as_deref() {
            Some("LIN") => Relationship::Linear,
            Some("LOG") => Relationship::Log,
            other => {
                let said = other.unwrap_or("missing");
                notes.push(format!(
                    "PixelIntensityRelationship is {said}: pixels are assumed to be logarithmic with an unknown scale, \
                     so attenuation is relative"
                ));
                Relationship::Display
            }
        }
    }

    /// Reads the table of the Modality LUT Sequence.
    fn modality_table(&self) -> Result<Option<ModalityTable>> {
        let tag = tags::MODALITY_LUT_SEQUENCE;
        if self.get(tag).is_none() {
            return Ok(None);
        }
        let bad = |problem: &str| self.bad(tag, "ModalityLUTSequence", problem);
        let item = self.item(tag, "ModalityLUTSequence")?.ok_or_else(|| bad("has no item"))?;
        let descriptor = item.numbers(tags::LUT_DESCRIPTOR, "LUTDescriptor")?;
        let Some(&[entries, first, _]) = descriptor.as_deref() else {
            return Err(bad("its LUTDescriptor does not have three numbers"));
        };
        // Numbers of entries are stored in 16 bits, in which 65536 is 0; the first value has the sign of the pixels.
        let entries = if entries == 0.0 { 1 << 16 } else { entries as usize };
        let first = if self.is_signed()? && first > f64::from(i16::MAX) { first - 65536.0 } else { first };
        let data = item.get(tags::LUT_DATA).ok_or_else(|| bad("has no LUTData"))?;
        let values: Vec<f32> = match (data.vr, data.bytes()) {
            (VR::OB, Some((bytes, big_endian))) => {
                numbers(bytes, big_endian, |b| f32::from(u16::from_le_bytes(b))).map_err(|problem| bad(&problem))?
            }
            _ => data.numbers().map_err(|problem| bad(&problem))?.into_iter().map(|value| value as f32).collect(),
        };
        if values.len() < entries || entries < 2 {
            return Err(bad(&format!("has {} values where its LUTDescriptor states {entries}", values.len())));
        }
        Ok(Some(ModalityTable { first, values: values[..entries].to_vec() }))
    }

    fn is_signed(&self) -> Result<bool> {
        Ok(self.number(tags::PIXEL_REPRESENTATION, "PixelRepresentation")?.unwrap_or(0.0) != 0.0)
    }

    /// Decodes all frames, applies the modality LUT (a table, or slope and intercept), and returns them with the range of possible
    /// values, which follows from the bits stored and from the LUT, not from the values of this run.
    fn frames(
        &self,
        codec: Codec,
        n: usize,
        size: [usize; 2],
        table: Option<&ModalityTable>,
        groups: Option<&Groups<'_>>,
        notes: &mut Vec<String>,
    ) -> Result<(Vec<Vec<f32>>, PixelRange)> {
        let bits = self.number(tags::BITS_STORED, "BitsStored")?.unwrap_or(8.0);
        if bits.fract() != 0.0 || !(1.0..=16.0).contains(&bits) {
            return Err(self.bad(
                tags::BITS_STORED,
                "BitsStored",
                format!("{bits} is not in the accepted range, 1 to 16"),
            ));
        }
        let allocated =
            self.number(tags::BITS_ALLOCATED, "BitsAllocated")?.unwrap_or(if bits > 8.0 { 16.0 } else { 8.0 });
        if ![8.0, 16.0, 32.0].contains(&allocated) || allocated < bits {
            let problem = format!("{allocated} is not accepted for {bits} bits stored; 8, 16 and 32 are read");
            return Err(self.bad(tags::BITS_ALLOCATED, "BitsAllocated", problem));
        }
        let high_bit = self.number(tags::HIGH_BIT, "HighBit")?.unwrap_or(bits - 1.0);
        if !(bits - 1.0..allocated).contains(&high_bit) {
            let problem = format!("{high_bit} does not fit {bits} bits stored of {allocated}");
            return Err(self.bad(tags::HIGH_BIT, "HighBit", problem));
        }
        let signed = self.is_signed()?;
        let layout = Layout {
            frames: n,
            size,
            bytes_per_value: allocated as usize / 8,
            bits: bits as u32,
            high_bit: high_bit as u32,
            signed,
        };
        let mut frames = frames::decode(self.data, codec, &layout, notes)
            .map_err(|problem| self.bad(tags::PIXEL_DATA, "PixelData", problem))?;
        let [slope, intercept] = match groups.map_or(Ok(None), Groups::rescale)? {
            Some(rescale) => rescale,
            None => [
                self.number(tags::RESCALE_SLOPE, "RescaleSlope")?.unwrap_or(1.0),
                self.number(tags::RESCALE_INTERCEPT, "RescaleIntercept")?.unwrap_or(0.0),
            ],
        };
        let is_rescaled = slope != 1.0 || intercept != 0.0;
        match table {
            Some(_) => notes.push(
                "the table of the modality LUT was applied, after which pixels are linear in intensity; the VOI LUT and the \
                 window were not"
                    .into(),
            ),
            None if is_rescaled => notes.push("the modality LUT was applied, but not the VOI LUT and the window".into()),
            None => {}
        }
        let span = 2f64.powf(bits) - 1.0;
        let stored = if signed { [-(span + 1.0) / 2.0, (span - 1.0) / 2.0] } else { [0.0, span] };
        let range = match table {
            Some(table) => {
                frames.iter_mut().flatten().for_each(|value| *value = table.value(*value));
                PixelRange { black: 0.0, low: table.low(), white: table.high() }
            }
            None => {
                let rescaled = |value: f64| (slope * value + intercept) as f32;
                if is_rescaled {
                    frames.iter_mut().flatten().for_each(|value| *value = rescaled(f64::from(*value)));
                }
                let [a, b] = stored.map(rescaled);
                // Rescaled values are intensities themselves; others may be stored with an offset, as signed numbers.
                let (low, white) = (a.min(b), a.max(b));
                PixelRange { black: if is_rescaled { 0.0 } else { low }, low, white }
            }
        };
        if range.white <= range.low || range.white <= range.black {
            let problem = format!("gives values from {} to {}, which are no intensities", range.low, range.white);
            return Err(self.bad(tags::RESCALE_SLOPE, "the modality LUT", problem));
        }
        let photometric = self.text(tags::PHOTOMETRIC_INTERPRETATION).filter(|text| text == "MONOCHROME1");
        // A value that is larger where less radiation arrives: a negative image, whichever of the two attributes states it.
        let sign = self.number(tags::PIXEL_INTENSITY_RELATIONSHIP_SIGN, "PixelIntensityRelationshipSign")?;
        let sign = sign.or(groups.and_then(Groups::relationship_sign)).filter(|sign| *sign < 0.0);
        let sign = sign.map(|sign| format!("PixelIntensityRelationshipSign is {sign}"));
        let negative: Vec<String> = photometric.into_iter().chain(sign).collect();
        if !negative.is_empty() {
            notes.push(format!(
                "{}: the images were inverted, so that brighter pixels mean less absorption",
                negative.join(", ")
            ));
            frames.iter_mut().flatten().for_each(|v| *v = range.low + range.white - *v);
        }
        Ok((frames, range))
    }

    /// Columns and rows inside the collimator's shutters.
    fn open_area(&self, width: usize, height: usize) -> Result<(Range<usize>, Range<usize>)> {
        let edge = |tag, name, otherwise: usize, max: usize| -> Result<usize> {
            // Edges are counted from 1, and the edge itself belongs to the shutter.
            Ok(self.number(tag, name)?.map_or(otherwise, |e| e.clamp(0.0, max as f64 + 1.0) as usize))
        };
        let left = edge(tags::SHUTTER_LEFT_VERTICAL_EDGE, "ShutterLeftVerticalEdge", 0, width)?;
        let right = edge(tags::SHUTTER_RIGHT_VERTICAL_EDGE, "ShutterRightVerticalEdge", width + 1, width)?;
        let top = edge(tags::SHUTTER_UPPER_HORIZONTAL_EDGE, "ShutterUpperHorizontalEdge", 0, height)?;
        let bottom = edge(tags::SHUTTER_LOWER_HORIZONTAL_EDGE, "ShutterLowerHorizontalEdge", height + 1, height)?;
        if right < left + 2 || bottom < top + 2 {
            let problem = format!("columns {left} to {right} and rows {top} to {bottom} leave no open area");
            return Err(self.bad(tags::SHUTTER_LEFT_VERTICAL_EDGE, "ShutterLeftVerticalEdge", problem));
        }
        Ok((left..right - 1, top..bottom - 1))
    }

    /// R-peaks that the file lists, or else those found in its ECG.
    fn r_peaks(&self, times_s: &[f64], notes: &mut Vec<String>) -> Option<RPeaks> {
        let (tag, name) = (tags::R_WAVE_TIME_VECTOR, "RWaveTimeVector");
        let listed = self.numbers(tag, name).and_then(|ms| {
            let seconds = ms.map(|ms| ms.iter().map(|t| t / 1e3).collect::<Vec<_>>());
            seconds.map(|seconds| RPeaks::new(&seconds)).transpose()
        });
        match listed {
            Ok(Some(peaks)) => {
                notes.push("R-peaks from RWaveTimeVector".into());
                return Some(peaks);
            }
            Ok(None) => {}
            Err(error) => notes.push(format!("RWaveTimeVector was not used: {error}")),
        }
        traces::r_peaks(self, length_s(times_s), notes)
    }
}

/// Columns and rows inside all shutters; none without shutters.
type Area = (Range<usize>, Range<usize>);

fn shared_area(mut areas: impl Iterator<Item = Result<Area>>) -> Result<Option<Area>> {
    let within = |a: &Range<usize>, b: &Range<usize>| a.start.max(b.start)..a.end.min(b.end);
    areas.try_fold(None, |sum: Option<Area>, area| {
        let area = area?;
        Ok(Some(sum.map_or(area.clone(), |sum| (within(&sum.0, &area.0), within(&sum.1, &area.1)))))
    })
}

/// Length of a run, seconds: its last frame lasts as long as the one before.
fn length_s(times_s: &[f64]) -> f64 {
    match times_s {
        [.., before, last] => last + (last - before),
        _ => 0.0,
    }
}

/// Range of possible pixel values of a run, after its modality LUT.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PixelRange {
    /// Value of no intensity, for pixels that are linear in intensity.
    pub black: f32,
    /// Smallest value.
    pub low: f32,
    /// Largest value: no absorption.
    pub white: f32,
}

/// Table of a modality LUT (Part 3, C.11.1).
struct ModalityTable {
    /// Stored value of the first entry.
    first: f64,
    /// Entries; the first and the last also stand for the stored values beyond them.
    values: Vec<f32>,
}

impl ModalityTable {
    fn value(&self, stored: f32) -> f32 {
        let index = (f64::from(stored) - self.first).clamp(0.0, (self.values.len() - 1) as f64);
        self.values[index as usize]
    }

    fn low(&self) -> f32 {
        self.values.iter().copied().fold(f32::MAX, f32::min)
    }

    fn high(&self) -> f32 {
        self.values.iter().copied().fold(f32::MIN, f32::max)
    }
}

/// Name of the tag (or the option) from which a field of the geometry was read.
fn tag_of(field: &str) -> String {
    let name = match field {
        "sid_mm" => "(0018,1110) DistanceSourceToDetector",
        "sod_mm" => "(0018,1111) DistanceSourceToPatient",
        "primary_deg" => "(0018,1510) PositionerPrimaryAngle",
        "secondary_deg" => "(0018,1511) PositionerSecondaryAngle",
        field if field.starts_with("pixel_mm") => "(0018,1164) ImagerPixelSpacing",
        other => other,
    };
    name.to_owned()
}
