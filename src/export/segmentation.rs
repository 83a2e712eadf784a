//! Writes the vessels of a phase as a DICOM segmentation (Segmentation Storage, PS3.3 A.51): a binary volume in patient coordinates,
//! marked as derived and not for diagnosis.
//!
//! There are no references to source runs.

use crate::error::{Error, Result};
use crate::export::dicom::{
    ANATOMY, CORONARY, Identity, LABEL, add_sequence, add_text, add_unknown, decimal, describe_image, identify, uid,
    write_object,
};
use crate::render::grid::PatientGrid;
use dicom_core::chrono::{DateTime, Utc};
use dicom_core::{DataElement, PrimitiveValue, Tag, VR};
use dicom_dictionary_std::tags;
use dicom_dictionary_std::uids::SEGMENTATION_STORAGE;
use dicom_object::InMemDicomObject;
use std::path::Path;
use std::time::SystemTime;

/// Colour that viewers may use, CIE L*a*b* as DICOM scales it (PS3.3 C.10.7.1.1): red.
const RED_LAB: [u16; 3] = [34_885, 53_485, 50_171];
/// Axes of columns and rows: left and posterior.
const ORIENTATION: &str = "1\\0\\0\\0\\1\\0";

/// Vessels of a phase.
#[derive(Debug, Clone)]
pub struct Segmentation<'a> {
    /// Grid of the voxels.
    pub grid: PatientGrid,
    /// Whether a voxel is vessel; left is the fastest axis, superior the slowest.
    pub inside: &'a [bool],
    /// Phase, from 0.
    pub phase: u32,
    /// Number of phases of the beat.
    pub n_phases: u32,
    /// Rule by which a voxel is vessel.
    pub rule: &'a str,
    /// Random numbers from which the UIDs are made.
    pub seeds: SegmentationSeeds,
}

/// Random numbers from which the UIDs of a segmentation are made. Phases of one beat share all but the last two.
#[derive(Debug, Clone, Copy)]
pub struct SegmentationSeeds {
    /// Seed of the study.
    pub study: u128,
    /// Seed of the series.
    pub series: u128,
    /// Seed of the frame of reference.
    pub frame: u128,
    /// Seed of the instance.
    pub instance: u128,
    /// Seed of its dimensions.
    pub dimensions: u128,
}

/// Writes a segmentation as a DICOM file. Slices without vessels are left out, as the standard allows.
///
/// # Errors
/// [`Error::Config`] for a phase without vessels and a grid that DICOM cannot hold; [`Error::Io`].
pub fn write(path: &Path, segmentation: &Segmentation<'_>) -> Result<()> {
    let [columns, rows, _] = segmentation.grid.size;
    let (Ok(columns), Ok(rows)) = (u16::try_from(columns), u16::try_from(rows)) else {
        return Err(Error::config(
            "size",
            format!("{columns} x {rows}"),
            "is out of range: sides of 1 to 65535 are accepted",
        ));
    };
    let per_slice = usize::from(columns) * usize::from(rows);
    let slices: Vec<(usize, &[bool])> =
        segmentation.inside.chunks(per_slice).enumerate().filter(|(_, slice)| slice.contains(&true)).collect();
    if slices.is_empty() {
        let problem = "has no vessel above the threshold";
        return Err(Error::config("phase", segmentation.phase, problem));
    }
    let mut object = InMemDicomObject::new_empty();
    describe(&mut object, segmentation);
    add_sequence(&mut object, tags::SEGMENT_SEQUENCE, vec![segment(segmentation)]);
    dimensions(&mut object, segmentation);
    add_sequence(&mut object, tags::SHARED_FUNCTIONAL_GROUPS_SEQUENCE, vec![shared_groups(&segmentation.grid)]);
    let frames = slices.iter().enumerate().map(|(index, (slice, _))| frame_groups(&segmentation.grid, index, *slice));
    add_sequence(&mut object, tags::PER_FRAME_FUNCTIONAL_GROUPS_SEQUENCE, frames.collect());
    for (tag, value) in [
        (tags::SAMPLES_PER_PIXEL, 1),
        (tags::ROWS, rows),
        (tags::COLUMNS, columns),
        (tags::BITS_ALLOCATED, 1),
        (tags::BITS_STORED, 1),
        (tags::HIGH_BIT, 0),
        (tags::PIXEL_REPRESENTATION, 0),
    ] {
        object.put(DataElement::new(tag, VR::US, PrimitiveValue::from(value)));
    }
    add_text(&mut object, tags::NUMBER_OF_FRAMES, VR::IS, &slices.len().to_string());
    let bits: Vec<bool> = slices.iter().flat_map(|(_, slice)| slice.iter().copied()).collect();
    object.put(DataElement::new(tags::PIXEL_DATA, VR::OB, PrimitiveValue::U8(packed(&bits).into())));
    write_object(path, object)
}

/// Packs bits into bytes, the first into the lowest bit, with an even number of bytes (PS3.5 8.1.1).
fn packed(bits: &[bool]) -> Vec<u8> {
    let byte = |eight: &[bool]| eight.iter().enumerate().fold(0, |byte, (i, bit)| byte | (u8::from(*bit) << i));
    let mut bytes: Vec<u8> = bits.chunks(8).map(byte).collect();
    bytes.resize(bytes.len().next_multiple_of(2), 0);
    bytes
}

/// Adds the identity and the description of a segmentation.
fn describe(object: &mut InMemDicomObject, segmentation: &Segmentation<'_>) {
    let SegmentationSeeds { study, series, frame, instance, .. } = segmentation.seeds;
    let [study, series, frame, instance] = [study, series, frame, instance].map(uid);
    let Segmentation { phase, n_phases, .. } = segmentation;
    let uids = [study.as_str(), &series, &instance];
    identify(object, &Identity { class: SEGMENTATION_STORAGE, uids, modality: "SEG", number: phase + 1 });
    describe_image(object);
    add_unknown(object, tags::POSITION_REFERENCE_INDICATOR, VR::LO);
    add_unknown(object, tags::CONTENT_CREATOR_NAME, VR::PN);
    let now = DateTime::<Utc>::from(SystemTime::now());
    for (tag, vr, value) in [
        (tags::FRAME_OF_REFERENCE_UID, VR::UI, frame.as_str()),
        (tags::IMAGE_TYPE, VR::CS, "DERIVED\\PRIMARY"),
        (tags::CONTENT_DATE, VR::DA, &now.format("%Y%m%d").to_string()),
        (tags::CONTENT_TIME, VR::TM, &now.format("%H%M%S").to_string()),
        (tags::CONTENT_LABEL, VR::CS, "VESSELS"),
        (tags::CONTENT_DESCRIPTION, VR::LO, &format!("Phase {phase} of {n_phases}, not for diagnosis")),
        (tags::DEVICE_SERIAL_NUMBER, VR::LO, "0"),
        (tags::PHOTOMETRIC_INTERPRETATION, VR::CS, "MONOCHROME2"),
        (tags::SEGMENTATION_TYPE, VR::CS, "BINARY"),
        (tags::SEGMENTS_OVERLAP, VR::CS, "NO"),
    ] {
        add_text(object, tag, vr, value);
    }
}

/// Returns the description of the only segment.
fn segment(segmentation: &Segmentation<'_>) -> InMemDicomObject {
    let mut item = InMemDicomObject::new_empty();
    item.put(DataElement::new(tags::SEGMENT_NUMBER, VR::US, PrimitiveValue::from(1u16)));
    add_text(&mut item, tags::SEGMENT_LABEL, VR::LO, "Coronary arteries");
    let Segmentation { phase, n_phases, .. } = segmentation;
    let description = format!("{LABEL}. Phase {phase} of {n_phases}; {}", segmentation.rule);
    add_text(&mut item, tags::SEGMENT_DESCRIPTION, VR::ST, &description);
    add_text(&mut item, tags::SEGMENT_ALGORITHM_TYPE, VR::CS, "AUTOMATIC");
    add_text(&mut item, tags::SEGMENT_ALGORITHM_NAME, VR::LO, "nertca-vk");
    add_sequence(&mut item, tags::SEGMENTED_PROPERTY_CATEGORY_CODE_SEQUENCE, vec![ANATOMY.item()]);
    add_sequence(&mut item, tags::SEGMENTED_PROPERTY_TYPE_CODE_SEQUENCE, vec![CORONARY.item()]);
    let colour = PrimitiveValue::U16(RED_LAB.to_vec().into());
    item.put(DataElement::new(tags::RECOMMENDED_DISPLAY_CIE_LAB_VALUE, VR::US, colour));
    item
}

/// Adds the dimensions: segment and position of the slice.
fn dimensions(object: &mut InMemDicomObject, segmentation: &Segmentation<'_>) {
    let organization = uid(segmentation.seeds.dimensions);
    let mut named = InMemDicomObject::new_empty();
    add_text(&mut named, tags::DIMENSION_ORGANIZATION_UID, VR::UI, &organization);
    add_sequence(object, tags::DIMENSION_ORGANIZATION_SEQUENCE, vec![named]);
    let index = |pointer: Tag, group: Tag| {
        let mut item = InMemDicomObject::new_empty();
        add_text(&mut item, tags::DIMENSION_ORGANIZATION_UID, VR::UI, &organization);
        item.put(DataElement::new(tags::DIMENSION_INDEX_POINTER, VR::AT, PrimitiveValue::from(pointer)));
        item.put(DataElement::new(tags::FUNCTIONAL_GROUP_POINTER, VR::AT, PrimitiveValue::from(group)));
        item
    };
    let indices = vec![
        index(tags::REFERENCED_SEGMENT_NUMBER, tags::SEGMENT_IDENTIFICATION_SEQUENCE),
        index(tags::IMAGE_POSITION_PATIENT, tags::PLANE_POSITION_SEQUENCE),
    ];
    add_sequence(object, tags::DIMENSION_INDEX_SEQUENCE, indices);
}

/// Returns the groups that all slices share: orientation, spacing and segment.
fn shared_groups(grid: &PatientGrid) -> InMemDicomObject {
    let [across, down, between] = grid.spacing_mm.to_array().map(decimal);
    let mut orientation = InMemDicomObject::new_empty();
    add_text(&mut orientation, tags::IMAGE_ORIENTATION_PATIENT, VR::DS, ORIENTATION);
    let mut measures = InMemDicomObject::new_empty();
    // DICOM lists the spacing of rows first.
    add_text(&mut measures, tags::PIXEL_SPACING, VR::DS, &format!("{down}\\{across}"));
    add_text(&mut measures, tags::SLICE_THICKNESS, VR::DS, &between);
    add_text(&mut measures, tags::SPACING_BETWEEN_SLICES, VR::DS, &between);
    let mut segment = InMemDicomObject::new_empty();
    segment.put(DataElement::new(tags::REFERENCED_SEGMENT_NUMBER, VR::US, PrimitiveValue::from(1u16)));
    let mut shared = InMemDicomObject::new_empty();
    add_sequence(&mut shared, tags::PLANE_ORIENTATION_SEQUENCE, vec![orientation]);
    add_sequence(&mut shared, tags::PIXEL_MEASURES_SEQUENCE, vec![measures]);
    add_sequence(&mut shared, tags::SEGMENT_IDENTIFICATION_SEQUENCE, vec![segment]);
    shared
}

/// Returns the groups of a frame, from 0, that holds a slice of the grid.
fn frame_groups(grid: &PatientGrid, frame: usize, slice: usize) -> InMemDicomObject {
    let mut content = InMemDicomObject::new_empty();
    let values = PrimitiveValue::U32(vec![1, frame as u32 + 1].into());
    content.put(DataElement::new(tags::DIMENSION_INDEX_VALUES, VR::UL, values));
    let [left, posterior, superior] = grid.origin_mm.to_array();
    let place = [left, posterior, superior + slice as f64 * grid.spacing_mm.z].map(decimal).join("\\");
    let mut position = InMemDicomObject::new_empty();
    add_text(&mut position, tags::IMAGE_POSITION_PATIENT, VR::DS, &place);
    let mut groups = InMemDicomObject::new_empty();
    add_sequence(&mut groups, tags::FRAME_CONTENT_SEQUENCE, vec![content]);
    add_sequence(&mut groups, tags::PLANE_POSITION_SEQUENCE, vec![position]);
    groups
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bits_are_packed_from_the_lowest_and_bytes_are_even() {
        let bits: Vec<bool> = (0..10).map(|i| i == 0 || i == 3 || i == 9).collect();
        assert_eq!(packed(&bits), [0b0000_1001, 0b0000_0010]);
        assert_eq!(packed(&[true; 8]), [255, 0]);
    }

    #[test]
    fn a_phase_without_vessels_is_refused() {
        let grid = PatientGrid { origin_mm: glam::DVec3::ZERO, spacing_mm: glam::DVec3::ONE, size: [2, 2, 2] };
        let seeds = SegmentationSeeds { study: 1, series: 2, frame: 3, instance: 4, dimensions: 5 };
        let nothing = Segmentation { grid, inside: &[false; 8], phase: 3, n_phases: 10, rule: "above 1", seeds };
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("x.dcm");
        assert!(write(&path, &nothing).unwrap_err().to_string().contains("phase = 3: has no vessel"));
        assert!(!path.exists());
    }
}
