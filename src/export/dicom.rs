//! Writes rendered views as DICOM: X-ray angiograms (XA Image Storage), marked as derived and not for diagnosis.
//!
//! Values are those of a detector that is linear in intensity: 65535 exp(-integral). Readers that support LIN can recover the
//! line integrals. There are no references to source runs.

use crate::error::{Error, Result};
use crate::files;
use crate::geometry::CArm;
use dicom_core::value::DataSetSequence;
use dicom_core::{DataElement, PrimitiveValue, Tag, VR};
use dicom_dictionary_std::{tags, uids};
use dicom_object::{FileMetaTableBuilder, InMemDicomObject};
use std::path::Path;

/// Value of a pixel without absorption.
const WHITE: f64 = 65535.0;
const EXPLICIT_LITTLE_ENDIAN: &str = "1.2.840.10008.1.2.1";
/// Label that viewers show beside the picture, wherever they show text of the file.
pub const LABEL: &str = "RESEARCH USE ONLY - NOT FOR DIAGNOSIS";
/// Largest number of characters of a decimal string.
const DECIMAL_CHARACTERS: usize = 16;
/// Largest size of pixel data of explicit length, bytes.
const MAX_BYTES: usize = u32::MAX as usize - 1;

/// A view at some times of a beat.
#[derive(Debug, Clone)]
pub struct DicomView<'a> {
    /// C-arm of the view. The file cannot state other positions, so the detector is centred and the patient is at the
    /// isocentre.
    pub c_arm: &'a CArm,
    /// Columns and rows.
    pub size: [usize; 2],
    /// Line integrals of each frame in row-major order.
    pub frames: &'a [Vec<f32>],
    /// Time between frames, ms.
    pub frame_ms: f64,
    /// Short description of the content.
    pub description: &'a str,
    /// Random numbers from which the UIDs of study, series and image are made.
    pub seeds: [u128; 3],
}

/// Formats a number with a length that DICOM accepts, as precisely as this length allows.
pub(super) fn decimal(value: f64) -> String {
    let texts = (0..=DECIMAL_CHARACTERS).rev().map(|digits| format!("{value:.digits$}"));
    let mut fits = texts.filter(|text| text.len() <= DECIMAL_CHARACTERS).map(|text| match text.contains('.') {
        true => text.trim_end_matches('0').trim_end_matches('.').to_owned(),
        false => text,
    });
    fits.next().unwrap_or_else(|| format!("{value:.8e}"))
}

/// Writes a view as a DICOM file.
///
/// # Errors
/// [`Error::Config`] for frames that a DICOM file cannot hold; [`Error::Io`].
pub fn write(path: &Path, view: &DicomView<'_>) -> Result<()> {
    let [width, height] = view.size;
    let (columns, rows) = (u16::try_from(width), u16::try_from(height));
    let (Ok(columns), Ok(rows)) = (columns, rows) else {
        return Err(Error::config(
            "size",
            format!("{width} x {height}"),
            "is out of range: sides of 1 to 65535 pixels are accepted",
        ));
    };
    if view.frames.is_empty() || view.frames.len() * width * height * 2 > MAX_BYTES {
        return Err(Error::config(
            "frames",
            view.frames.len(),
            "is out of range: at least 1 frame and at most 4 GiB of pixels are accepted",
        ));
    }
    let secondary_deg = view.c_arm.secondary_deg;
    if secondary_deg.abs() > 90.0 {
        let problem = "is out of range: DICOM supports -90 to 90 deg here; change the primary angle by 180 deg instead";
        return Err(Error::config("secondary angle", secondary_deg, problem));
    }
    let mut object = InMemDicomObject::new_empty();
    describe(&mut object, view);
    geometry(&mut object, view);
    pixels(&mut object, view, [columns, rows]);
    write_object(path, object)
}

/// Writes an object as a DICOM file.
pub(super) fn write_object(path: &Path, object: InMemDicomObject) -> Result<()> {
    let failed = |e: &dyn std::error::Error| Error::Internal(format!("DICOM: {e}"));
    let meta = FileMetaTableBuilder::new().transfer_syntax(EXPLICIT_LITTLE_ENDIAN);
    let file = object.with_meta(meta).map_err(|e| failed(&e))?;
    let mut bytes = Vec::new();
    file.write_all(&mut bytes).map_err(|e| failed(&e))?;
    Ok(files::write_atomic(path, &bytes)?)
}

/// Adds an attribute that is a text.
pub(super) fn add_text(object: &mut InMemDicomObject, tag: Tag, vr: VR, value: &str) {
    object.put(DataElement::new(tag, vr, PrimitiveValue::from(value)));
}

/// Adds a required attribute whose value is unknown.
pub(super) fn add_unknown(object: &mut InMemDicomObject, tag: Tag, vr: VR) {
    object.put(DataElement::new(tag, vr, PrimitiveValue::Empty));
}

/// Identity of an object.
pub(super) struct Identity<'a> {
    /// UID of its class.
    pub class: &'a str,
    /// UIDs of the study, the series and the object.
    pub uids: [&'a str; 3],
    /// Its modality.
    pub modality: &'a str,
    /// Number of the object in its series, from 1.
    pub number: u32,
}

/// A code of a coding scheme (PS3.3 8.8).
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Code {
    /// Value of the code, at most 16 characters.
    pub value: &'static str,
    /// Designator of its scheme.
    pub scheme: &'static str,
    /// Text for people, at most 64 characters.
    pub meaning: &'static str,
}

impl Code {
    /// Returns the item of a code sequence.
    pub fn item(&self) -> InMemDicomObject {
        let mut item = InMemDicomObject::new_empty();
        add_text(&mut item, tags::CODE_VALUE, VR::SH, self.value);
        add_text(&mut item, tags::CODING_SCHEME_DESIGNATOR, VR::SH, self.scheme);
        add_text(&mut item, tags::CODE_MEANING, VR::LO, self.meaning);
        item
    }
}

/// Category of what is segmented and measured.
pub const ANATOMY: Code = Code { value: "123037004", scheme: "SCT", meaning: "Anatomical Structure" };
/// Vessels that are segmented and measured.
pub const CORONARY: Code = Code { value: "41801008", scheme: "SCT", meaning: "Coronary artery" };

/// Adds a sequence.
pub(super) fn add_sequence(object: &mut InMemDicomObject, tag: Tag, items: Vec<InMemDicomObject>) {
    object.put(DataElement::new(tag, VR::SQ, DataSetSequence::from(items)));
}

/// Adds what all our objects share: the identity of the object, the patient and the manufacturer.
pub(super) fn identify(object: &mut InMemDicomObject, identity: &Identity<'_>) {
    for (tag, vr) in [
        (tags::PATIENT_BIRTH_DATE, VR::DA),
        (tags::PATIENT_SEX, VR::CS),
        (tags::STUDY_DATE, VR::DA),
        (tags::STUDY_TIME, VR::TM),
        (tags::REFERRING_PHYSICIAN_NAME, VR::PN),
        (tags::STUDY_ID, VR::SH),
        (tags::ACCESSION_NUMBER, VR::SH),
    ] {
        add_unknown(object, tag, vr);
    }
    let [study, series, own] = identity.uids;
    for (tag, vr, value) in [
        (tags::SPECIFIC_CHARACTER_SET, VR::CS, "ISO_IR 192"),
        (tags::SOP_CLASS_UID, VR::UI, identity.class),
        (tags::SOP_INSTANCE_UID, VR::UI, own),
        (tags::STUDY_INSTANCE_UID, VR::UI, study),
        (tags::SERIES_INSTANCE_UID, VR::UI, series),
        (tags::MODALITY, VR::CS, identity.modality),
        (tags::PATIENT_NAME, VR::PN, "RESEARCH^RECONSTRUCTION"),
        (tags::PATIENT_ID, VR::LO, "RESEARCH"),
        (tags::STUDY_DESCRIPTION, VR::LO, LABEL),
        (tags::SERIES_DESCRIPTION, VR::LO, LABEL),
        (tags::SERIES_NUMBER, VR::IS, "1"),
        (tags::INSTANCE_NUMBER, VR::IS, &identity.number.to_string()),
        (tags::MANUFACTURER, VR::LO, "nertca-vk"),
        (tags::MANUFACTURER_MODEL_NAME, VR::LO, "nertca-vk"),
        (tags::SOFTWARE_VERSIONS, VR::LO, env!("CARGO_PKG_VERSION")),
    ] {
        add_text(object, tag, vr, value);
    }
}

/// Adds what our images share beyond [`identify`].
pub(super) fn describe_image(object: &mut InMemDicomObject) {
    for (tag, value) in
        [(tags::BODY_PART_EXAMINED, "HEART"), (tags::BURNED_IN_ANNOTATION, "NO"), (tags::LOSSY_IMAGE_COMPRESSION, "00")]
    {
        add_text(object, tag, VR::CS, value);
    }
}

/// Adds the identity and the description of a view.
fn describe(object: &mut InMemDicomObject, view: &DicomView<'_>) {
    let [study, series, image] = view.seeds.map(uid);
    let class = uids::X_RAY_ANGIOGRAPHIC_IMAGE_STORAGE;
    identify(object, &Identity { class, uids: [&study, &series, &image], modality: "XA", number: 1 });
    describe_image(object);
    for (tag, vr) in [
        (tags::PATIENT_ORIENTATION, VR::CS),
        (tags::KVP, VR::DS),
        (tags::X_RAY_TUBE_CURRENT, VR::IS),
        (tags::EXPOSURE_TIME, VR::IS),
    ] {
        add_unknown(object, tag, vr);
    }
    for (tag, vr, value) in [
        (tags::IMAGE_TYPE, VR::CS, "DERIVED\\SECONDARY\\SINGLE PLANE"),
        (tags::IMAGE_COMMENTS, VR::LT, LABEL),
        (tags::DERIVATION_DESCRIPTION, VR::ST, &format!("{LABEL}. {}", view.description)),
        (tags::RADIATION_SETTING, VR::CS, "GR"),
        (tags::PATIENT_POSITION, VR::CS, "HFS"),
    ] {
        add_text(object, tag, vr, value);
    }
}

/// Maps an angle to the range from -180 to below 180 deg.
fn half_turn_deg(angle_deg: f64) -> f64 {
    (angle_deg + 180.0).rem_euclid(360.0) - 180.0
}

/// Makes a new UID: a random UUID (version 4, RFC 9562) as a decimal number, PS3.5 B.2.
pub(super) fn uid(random: u128) -> String {
    let version = 0xf_u128 << 76;
    let variant = 0b11_u128 << 62;
    format!("2.25.{}", random & !version & !variant | 4 << 76 | 0b10 << 62)
}

/// Adds the geometry of the view.
fn geometry(object: &mut InMemDicomObject, view: &DicomView<'_>) {
    let c_arm = view.c_arm;
    add_text(object, tags::POSITIONER_MOTION, VR::CS, "STATIC");
    for (tag, value) in [
        (tags::POSITIONER_PRIMARY_ANGLE, half_turn_deg(c_arm.primary_deg)),
        (tags::POSITIONER_SECONDARY_ANGLE, c_arm.secondary_deg),
        (tags::DISTANCE_SOURCE_TO_DETECTOR, c_arm.sid_mm),
        (tags::DISTANCE_SOURCE_TO_PATIENT, c_arm.sod_mm),
        (tags::ESTIMATED_RADIOGRAPHIC_MAGNIFICATION_FACTOR, c_arm.sid_mm / c_arm.sod_mm),
    ] {
        add_text(object, tag, VR::DS, &decimal(value));
    }
    // DICOM lists the spacing of rows first.
    let [across, down] = c_arm.pixel_mm.map(decimal);
    add_text(object, tags::IMAGER_PIXEL_SPACING, VR::DS, &format!("{down}\\{across}"));
}

fn pixels(object: &mut InMemDicomObject, view: &DicomView<'_>, [columns, rows]: [u16; 2]) {
    for (tag, value) in [
        (tags::SAMPLES_PER_PIXEL, 1),
        (tags::ROWS, rows),
        (tags::COLUMNS, columns),
        (tags::BITS_ALLOCATED, 16),
        (tags::BITS_STORED, 16),
        (tags::HIGH_BIT, 15),
        (tags::PIXEL_REPRESENTATION, 0),
    ] {
        object.put(DataElement::new(tag, VR::US, PrimitiveValue::from(value)));
    }
    let codes: Vec<u16> =
        view.frames.iter().flatten().map(|v| (WHITE * (-f64::from(*v)).exp()).round() as u16).collect();
    let (min, max) = codes.iter().fold((u16::MAX, 0), |(min, max), code| (min.min(*code), max.max(*code)));
    let (min, max) = (f64::from(min), f64::from(max));
    for (tag, vr, value) in [
        (tags::PHOTOMETRIC_INTERPRETATION, VR::CS, "MONOCHROME2"),
        (tags::PIXEL_INTENSITY_RELATIONSHIP, VR::CS, "LIN"),
        (tags::NUMBER_OF_FRAMES, VR::IS, &view.frames.len().to_string()),
        (tags::FRAME_TIME, VR::DS, &decimal(view.frame_ms)),
        (tags::WINDOW_CENTER, VR::DS, &decimal(0.5 * (min + max))),
        (tags::WINDOW_WIDTH, VR::DS, &decimal((max - min).max(1.0))),
    ] {
        add_text(object, tag, vr, value);
    }
    object.put(DataElement::new(tags::FRAME_INCREMENT_POINTER, VR::AT, PrimitiveValue::from(tags::FRAME_TIME)));
    object.put(DataElement::new(tags::PIXEL_DATA, VR::OW, PrimitiveValue::U16(codes.into())));
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_fit_what_dicom_accepts() {
        for value in [0.0, -12.5, 1.0 / 3.0, -1_234.567_890_123, 2500.0, 1e-9] {
            let text = decimal(value);
            assert!(text.len() <= DECIMAL_CHARACTERS, "{text}");
            assert!((text.parse::<f64>().unwrap() - value).abs() < 1e-9 * value.abs().max(1.0), "{text}");
        }
        assert_eq!([0.0, 30.0, -12.5].map(decimal), ["0", "30", "-12.5"]);
    }

    #[test]
    fn angles_are_those_that_dicom_has() {
        assert_eq!([0.0, -90.0, 180.0, 270.0, -200.0].map(half_turn_deg), [0.0, -90.0, -180.0, -90.0, 160.0]);
    }

    #[test]
    fn a_uid_is_a_uuid() {
        for random in [0, u128::MAX, 0x0123_4567_89ab_cdef_0123_4567_89ab_cdef] {
            let text = uid(random);
            let hex = format!("{:032x}", text.strip_prefix("2.25.").unwrap().parse::<u128>().unwrap());
            assert!(text.len() <= 64 && hex.as_bytes()[12] == b'4' && b"89ab".contains(&hex.as_bytes()[16]), "{hex}");
        }
    }
}
