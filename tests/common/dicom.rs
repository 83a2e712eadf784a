//! A small angiography run, for tests that damage it.
#![allow(missing_docs, clippy::unwrap_used, clippy::expect_used, reason = "shared by tests")]

use dicom_core::{DataElement, PrimitiveValue, VR};
use dicom_dictionary_std::tags;
use dicom_object::{FileMetaTableBuilder, InMemDicomObject};
use std::path::Path;

/// Writes a small angiography run whose frames show a moving bar, after `change` has been applied.
pub fn angiogram(path: &Path, change: impl Fn(&mut InMemDicomObject)) {
    let (n, frames) = (64u16, 6u16);
    let mut o = InMemDicomObject::new_empty();
    let mut text = |tag, vr, value: &str| o.put(DataElement::new(tag, vr, PrimitiveValue::from(value)));
    text(tags::SOP_CLASS_UID, VR::UI, "1.2.840.10008.5.1.4.1.1.12.1");
    text(tags::SOP_INSTANCE_UID, VR::UI, "1.2.3.4");
    text(tags::MODALITY, VR::CS, "XA");
    text(tags::PATIENT_NAME, VR::PN, "SECRET^NAME");
    text(tags::PATIENT_ID, VR::LO, "SECRET-ID");
    text(tags::PHOTOMETRIC_INTERPRETATION, VR::CS, "MONOCHROME2");
    text(tags::NUMBER_OF_FRAMES, VR::IS, &frames.to_string());
    text(tags::FRAME_TIME, VR::DS, "100");
    text(tags::POSITIONER_PRIMARY_ANGLE, VR::DS, "30");
    text(tags::POSITIONER_SECONDARY_ANGLE, VR::DS, "-20");
    text(tags::DISTANCE_SOURCE_TO_DETECTOR, VR::DS, "1000");
    text(tags::DISTANCE_SOURCE_TO_PATIENT, VR::DS, "700");
    text(tags::IMAGER_PIXEL_SPACING, VR::DS, "2.0\\2.0");
    text(tags::PIXEL_INTENSITY_RELATIONSHIP, VR::CS, "LOG");
    for (tag, value) in [
        (tags::ROWS, n),
        (tags::COLUMNS, n),
        (tags::SAMPLES_PER_PIXEL, 1),
        (tags::BITS_ALLOCATED, 8),
        (tags::BITS_STORED, 8),
        (tags::HIGH_BIT, 7),
        (tags::PIXEL_REPRESENTATION, 0),
    ] {
        o.put(DataElement::new(tag, VR::US, PrimitiveValue::from(value)));
    }
    let pixels: Vec<u8> = (0..u32::from(frames) * 64 * 64)
        .map(|i| {
            let (f, y, x) = (i / 4096, i / 64 % 64, i % 64);
            if (x as i32 - 20 - 3 * f as i32).abs() < 2 && (10..54).contains(&y) { 90 } else { 190 + (y / 8) as u8 }
        })
        .collect();
    o.put(DataElement::new(tags::PIXEL_DATA, VR::OB, PrimitiveValue::from(pixels)));
    change(&mut o);
    let meta = FileMetaTableBuilder::new().transfer_syntax("1.2.840.10008.1.2.1");
    o.with_meta(meta).unwrap().write_to_file(path).unwrap();
}
