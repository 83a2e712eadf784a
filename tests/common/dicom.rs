//! A small angiography run, for tests that damage it.
#![allow(dead_code, missing_docs, clippy::unwrap_used, clippy::expect_used, reason = "each test binary uses its part")]

use dicom_core::value::PixelFragmentSequence;
use dicom_core::{DataElement, PrimitiveValue, VR};
use dicom_dictionary_std::tags;
use dicom_object::{FileMetaTableBuilder, InMemDicomObject};
use std::path::Path;

/// Writes a small angiography run whose frames show a moving bar, after `change` has been applied.
pub fn angiogram(path: &Path, change: impl Fn(&mut InMemDicomObject)) {
    angiogram_in(path, "1.2.840.10008.1.2.1", change);
}

/// Size of the frame in `tests/common/frames`: columns and rows.
const COMPRESSED: [u16; 2] = [32, 24];

/// Returns the frame in `tests/common/frames` as JPEG baseline.
pub fn baseline() -> Vec<u8> {
    let [width, height] = COMPRESSED.map(u32::from);
    let pixel = |x: u32, y: u32| image::Luma([if (11..14).contains(&x) { 90 } else { 190 + (y / 4) as u8 }]);
    let mut jpeg = Vec::new();
    image::GrayImage::from_fn(width, height, pixel)
        .write_with_encoder(image::codecs::jpeg::JpegEncoder::new_with_quality(&mut jpeg, 90))
        .unwrap();
    jpeg
}

/// Returns a frame of `COMPRESSED` size as RLE: a segment of runs of one value in a row.
fn run_lengths() -> Vec<u8> {
    let rows = (0..COMPRESSED[1]).flat_map(|y| [(257 - COMPRESSED[0]) as u8, 190 + (y / 4) as u8]);
    let header = [1u32, 64].into_iter().chain([0; 14]).flat_map(u32::to_le_bytes);
    header.chain(rows).collect()
}

/// Returns small runs of two frames in each compression that is read. GDCM and CharLS have made the files in
/// `frames`.
pub fn compressed(directory: &Path) -> Vec<Vec<u8>> {
    let frames = [
        ("1.2.840.10008.1.2.5", run_lengths()),
        ("1.2.840.10008.1.2.4.50", baseline()),
        ("1.2.840.10008.1.2.4.70", include_bytes!("frames/lossless.jpg").to_vec()),
        ("1.2.840.10008.1.2.4.80", include_bytes!("frames/lossless.jls").to_vec()),
        ("1.2.840.10008.1.2.4.90", include_bytes!("frames/lossless.j2k").to_vec()),
    ];
    let path = directory.join("compressed.dcm");
    let written = |(syntax, frame): (&str, Vec<u8>)| {
        compressed_run(&path, syntax, &frame, 8);
        std::fs::read(&path).unwrap()
    };
    frames.into_iter().map(written).collect()
}

/// Writes a run of two frames of `COMPRESSED` size, both of which are `frame`, of some bits.
pub fn compressed_run(path: &Path, syntax: &str, frame: &[u8], bits: u16) {
    angiogram_in(path, syntax, |o| {
        for (tag, value) in [
            (tags::COLUMNS, COMPRESSED[0]),
            (tags::ROWS, COMPRESSED[1]),
            (tags::BITS_ALLOCATED, bits.next_multiple_of(8)),
            (tags::BITS_STORED, bits),
            (tags::HIGH_BIT, bits - 1),
        ] {
            o.put(DataElement::new(tag, VR::US, PrimitiveValue::from(value)));
        }
        o.put(DataElement::new(tags::NUMBER_OF_FRAMES, VR::IS, PrimitiveValue::from("2")));
        let mut padded = frame.to_vec();
        padded.resize(frame.len().next_multiple_of(2), 0);
        let fragments = PixelFragmentSequence::new_fragments(vec![padded; 2]);
        o.put(DataElement::new(tags::PIXEL_DATA, VR::OB, fragments));
    });
}

fn angiogram_in(path: &Path, syntax: &str, change: impl Fn(&mut InMemDicomObject)) {
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
    let meta = FileMetaTableBuilder::new().transfer_syntax(syntax);
    o.with_meta(meta).unwrap().write_to_file(path).unwrap();
}
