//! Functional groups of Enhanced XA and XRF objects: values that all frames share, and values of each frame.

use crate::error::Result;
use crate::geometry::CArm;
use crate::reader::Reader;
use crate::scan::gating::RPeaks;
use crate::stated::StatedGeometry;
use dicom_core::Tag;
use dicom_dictionary_std::tags;

/// Time by which R-peaks that several frames state may differ, seconds.
const SAME_PEAK_S: f64 = 0.05;
const DAY_S: f64 = 86_400.0;

/// An attribute by its tag, with its name and the name of the sequence it stands in.
#[derive(Clone, Copy)]
struct Attribute {
    sequence: Tag,
    tag: Tag,
    name: &'static str,
}

const fn attribute(sequence: Tag, tag: Tag, name: &'static str) -> Attribute {
    Attribute { sequence, tag, name }
}

const POSITIONER: Tag = tags::POSITIONER_POSITION_SEQUENCE;
const ISOCENTRE: Tag = tags::ISOCENTER_REFERENCE_SYSTEM_SEQUENCE;
const GEOMETRY: Tag = tags::X_RAY_GEOMETRY_SEQUENCE;
const TABLE: Tag = tags::TABLE_POSITION_SEQUENCE;
const PRIMARY: Attribute = attribute(POSITIONER, tags::POSITIONER_PRIMARY_ANGLE, "PositionerPrimaryAngle");
const SECONDARY: Attribute = attribute(POSITIONER, tags::POSITIONER_SECONDARY_ANGLE, "PositionerSecondaryAngle");
const ISOCENTRE_PRIMARY: Attribute =
    attribute(ISOCENTRE, tags::POSITIONER_ISOCENTER_PRIMARY_ANGLE, "PositionerIsocenterPrimaryAngle");
const ISOCENTRE_SECONDARY: Attribute =
    attribute(ISOCENTRE, tags::POSITIONER_ISOCENTER_SECONDARY_ANGLE, "PositionerIsocenterSecondaryAngle");
const SID: Attribute = attribute(GEOMETRY, tags::DISTANCE_SOURCE_TO_DETECTOR, "DistanceSourceToDetector");
const SOD: Attribute = attribute(GEOMETRY, tags::DISTANCE_SOURCE_TO_ISOCENTER, "DistanceSourceToIsocenter");
const PITCH: Attribute =
    attribute(tags::FRAME_PIXEL_DATA_PROPERTIES_SEQUENCE, tags::IMAGER_PIXEL_SPACING, "ImagerPixelSpacing");
const TABLE_LEFT: Attribute = attribute(TABLE, tags::TABLE_TOP_LATERAL_POSITION, "TableTopLateralPosition");
const TABLE_DOWN: Attribute = attribute(TABLE, tags::TABLE_TOP_VERTICAL_POSITION, "TableTopVerticalPosition");
const TABLE_UP: Attribute = attribute(TABLE, tags::TABLE_TOP_LONGITUDINAL_POSITION, "TableTopLongitudinalPosition");
const TABLE_TURNED: Attribute = attribute(TABLE, tags::TABLE_HORIZONTAL_ROTATION_ANGLE, "TableHorizontalRotationAngle");
const TRIGGER: Attribute = attribute(
    tags::CARDIAC_SYNCHRONIZATION_SEQUENCE,
    tags::NOMINAL_CARDIAC_TRIGGER_DELAY_TIME,
    "NominalCardiacTriggerDelayTime",
);
const SLOPE: Attribute = attribute(tags::PIXEL_VALUE_TRANSFORMATION_SEQUENCE, tags::RESCALE_SLOPE, "RescaleSlope");
const INTERCEPT: Attribute =
    attribute(tags::PIXEL_VALUE_TRANSFORMATION_SEQUENCE, tags::RESCALE_INTERCEPT, "RescaleIntercept");

/// Functional groups of a run.
pub(super) struct Groups<'a> {
    run: Reader<'a>,
    shared: Option<Reader<'a>>,
    /// One group per frame.
    frames: Vec<Reader<'a>>,
}

impl<'a> Groups<'a> {
    /// Returns the groups of a run of `n` frames; none where it has no groups.
    pub(super) fn of(run: &Reader<'a>, n: usize) -> Result<Option<Groups<'a>>> {
        let (tag, name) = (tags::PER_FRAME_FUNCTIONAL_GROUPS_SEQUENCE, "PerFrameFunctionalGroupsSequence");
        let frames = run.items(tag, name)?;
        let shared = run.item(tags::SHARED_FUNCTIONAL_GROUPS_SEQUENCE, "SharedFunctionalGroupsSequence")?;
        if frames.is_empty() && shared.is_none() {
            return Ok(None);
        }
        if frames.len() != n {
            return Err(run.bad(tag, name, format!("has {} items for {n} frames", frames.len())));
        }
        Ok(Some(Groups { run: *run, shared, frames }))
    }

    /// Returns the first item of a sequence for a frame: its own, or the one that all frames share.
    pub(super) fn item(&self, frame: usize, sequence: Tag) -> Result<Option<Reader<'a>>> {
        let name = "sequence of a functional group";
        match self.frames[frame].item(sequence, name)? {
            Some(own) => Ok(Some(own)),
            None => self.shared.map_or(Ok(None), |shared| shared.item(sequence, name)),
        }
    }

    fn numbers(&self, frame: usize, wanted: Attribute) -> Result<Option<Vec<f64>>> {
        let item = self.item(frame, wanted.sequence)?;
        item.map_or(Ok(None), |item| item.numbers(wanted.tag, wanted.name))
    }

    fn number(&self, frame: usize, wanted: Attribute) -> Result<Option<f64>> {
        Ok(self.numbers(frame, wanted)?.map(|numbers| numbers[0]))
    }

    fn needed(&self, frame: usize, wanted: Attribute) -> Result<f64> {
        self.number(frame, wanted)?.ok_or_else(|| {
            let problem = format!("is missing in the functional groups of frame {}", frame + 1);
            self.run.bad(wanted.tag, wanted.name, problem)
        })
    }

    /// Angle of a frame, relative to the patient or else to the isocentre.
    fn angle(&self, frame: usize, patient: Attribute, isocentre: Attribute, notes: &mut Vec<String>) -> Result<f64> {
        if let Some(degrees) = self.number(frame, patient)? {
            return Ok(degrees);
        }
        let Some(degrees) = self.number(frame, isocentre)? else { return self.needed(frame, patient) };
        if frame == 0 {
            notes.push(format!("{} is missing: {} is used", patient.name, isocentre.name));
        }
        Ok(degrees)
    }

    /// Returns the C-arm of each frame; what the user states takes precedence.
    pub(super) fn c_arms(&self, stated: &StatedGeometry, notes: &mut Vec<String>) -> Result<Vec<CArm>> {
        let arms = (0..self.frames.len()).map(|frame| -> Result<CArm> {
            let or_zero = |wanted| self.number(frame, wanted).map(|mm| mm.unwrap_or(0.0));
            let or_file = |stated: Option<f64>, wanted| stated.map_or_else(|| self.needed(frame, wanted), Ok);
            let mut angle = |axis: usize, patient, isocentre| match stated.angles_deg {
                Some(angles) => Ok(angles[axis]),
                None => self.angle(frame, patient, isocentre, notes),
            };
            let spacing = match stated.pixel_mm {
                Some(pixel_mm) => Some(pixel_mm),
                // DICOM lists the spacing of rows first.
                None => self.numbers(frame, PITCH)?.filter(|pitch| pitch.len() >= 2).map(|pitch| [pitch[1], pitch[0]]),
            };
            let missing = "is missing; give the pixel spacing at the detector, in mm";
            Ok(CArm {
                primary_deg: angle(0, PRIMARY, ISOCENTRE_PRIMARY)?,
                secondary_deg: angle(1, SECONDARY, ISOCENTRE_SECONDARY)?,
                sid_mm: or_file(stated.sid_mm, SID)?,
                sod_mm: or_file(stated.sod_mm, SOD)?,
                pixel_mm: spacing.ok_or_else(|| self.run.bad(PITCH.tag, PITCH.name, missing))?,
                offset_mm: [0.0; 2],
                // Downwards, towards the left and towards the head are positive.
                table_mm: [or_zero(TABLE_LEFT)?, or_zero(TABLE_DOWN)?, or_zero(TABLE_UP)?],
            })
        });
        let arms = arms.collect::<Result<Vec<CArm>>>()?;
        if let Some(turned) = self.number(0, TABLE_TURNED)?.filter(|degrees| *degrees != 0.0) {
            notes.push(format!("warning: the table is turned by {turned} degrees, which is not corrected"));
        }
        Ok(arms)
    }

    /// Returns the times of the frames after the first by their date and time, seconds; none where these do not rise.
    pub(super) fn times_s(&self) -> Option<Vec<f64>> {
        let time_of = |frame: usize| {
            let content = self.item(frame, tags::FRAME_CONTENT_SEQUENCE).ok().flatten()?;
            let named = [tags::FRAME_REFERENCE_DATE_TIME, tags::FRAME_ACQUISITION_DATE_TIME];
            named.into_iter().find_map(|tag| second_of_day(&content.text(tag)?))
        };
        let seconds = (0..self.frames.len()).map(time_of).collect::<Option<Vec<f64>>>()?;
        let since_first =
            |second: &f64| if *second < seconds[0] { second + DAY_S - seconds[0] } else { second - seconds[0] };
        let times: Vec<f64> = seconds.iter().map(since_first).collect();
        times.windows(2).all(|pair| pair[0] < pair[1]).then_some(times)
    }

    /// Returns the R-peaks that follow from the delay of each frame; none where they are not stated.
    pub(super) fn r_peaks(&self, times_s: &[f64], notes: &mut Vec<String>) -> Option<RPeaks> {
        let peak = |frame: usize| Some(times_s[frame] - self.number(frame, TRIGGER).ok().flatten()? / 1e3);
        let mut peaks_s = (0..self.frames.len()).map(peak).collect::<Option<Vec<f64>>>()?;
        peaks_s.sort_by(f64::total_cmp);
        peaks_s.dedup_by(|later, earlier| *later - *earlier < SAME_PEAK_S);
        let peaks = RPeaks::new(&peaks_s).ok()?;
        let rate = 60.0 / peaks.beat_s();
        notes.push(format!("R-peaks from {} of each frame: {rate:.0} beats per minute", TRIGGER.name));
        Some(peaks)
    }

    /// Returns slope and intercept of the modality LUT, which all frames must share; none where they are not stated.
    pub(super) fn rescale(&self) -> Result<Option<[f64; 2]>> {
        let of = |frame| -> Result<[f64; 2]> {
            Ok([self.number(frame, SLOPE)?.unwrap_or(1.0), self.number(frame, INTERCEPT)?.unwrap_or(0.0)])
        };
        let first = of(0)?;
        for frame in 1..self.frames.len() {
            if of(frame)? != first {
                return Err(self.run.bad(SLOPE.tag, SLOPE.name, "differs between frames, which is not supported"));
            }
        }
        Ok(Some(first).filter(|rescale| *rescale != [1.0, 0.0]))
    }

    /// Returns the shutters of all frames.
    pub(super) fn shutters(&self) -> Result<Vec<Reader<'a>>> {
        let frames = (0..self.frames.len()).map(|frame| self.item(frame, tags::FRAME_DISPLAY_SHUTTER_SEQUENCE));
        frames.filter_map(Result::transpose).collect()
    }

    /// Returns the relationship of pixel values and intensity, where it stands in the functional groups.
    pub(super) fn relationship(&self) -> Option<String> {
        let properties = self.item(0, tags::FRAME_PIXEL_DATA_PROPERTIES_SEQUENCE).ok().flatten()?;
        properties.text(tags::PIXEL_INTENSITY_RELATIONSHIP)
    }

    /// Returns the sign of that relationship, where it stands in the functional groups.
    pub(super) fn relationship_sign(&self) -> Option<f64> {
        let properties = self.item(0, tags::FRAME_PIXEL_DATA_PROPERTIES_SEQUENCE).ok().flatten()?;
        properties.number(tags::PIXEL_INTENSITY_RELATIONSHIP_SIGN, "PixelIntensityRelationshipSign").ok()?
    }
}

/// Second of the day of a date and time of DICOM, such as 20261126081500.250000+0100.
fn second_of_day(text: &str) -> Option<f64> {
    let time = text.get(8..)?.split(['+', '-']).next()?;
    let [hours, minutes, seconds] = [time.get(..2)?, time.get(2..4)?, time.get(4..)?];
    Some(3600.0 * hours.parse::<f64>().ok()? + 60.0 * minutes.parse::<f64>().ok()? + seconds.parse::<f64>().ok()?)
}

/// UID of the class of reconstructed volumes, which have the modality XA, too.
const VOLUME_CLASS: &str = "1.2.840.10008.5.1.4.1.1.13.1.1";

/// Refuses objects of the modality XA that hold no run of projections.
pub(super) fn check_class(run: &Reader<'_>) -> Result<()> {
    if run.text(tags::SOP_CLASS_UID).as_deref() == Some(VOLUME_CLASS) {
        let problem =
            "the file is an X-Ray 3D Angiographic Image, which holds a reconstructed volume; give the run itself";
        return Err(run.bad(tags::SOP_CLASS_UID, "SOPClassUID", problem));
    }
    Ok(())
}
