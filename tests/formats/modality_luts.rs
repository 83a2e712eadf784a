//! Pixel values of angiograms after the modality LUT, against pydicom, and line integrals that do not depend on how they are stored.

use crate::dicom;
use crate::python::python;
use dicom_core::value::DataSetSequence;
use dicom_core::{DataElement, PrimitiveValue, VR};
use dicom_dictionary_std::tags;
use dicom_object::InMemDicomObject;
use nertca_vk::scan::dataset::Dataset;
use nertca_vk::scan::gating::BeatScaling;
use nertca_vk_import::angiograms::{Gating, ImportOptions};
use nertca_vk_import::dicom::Run;
use nertca_vk_import::intake::import_dicom;
use std::path::Path;

const FRAMES: usize = 6;
const SIDE: usize = 64;

/// Twelve-bit values of a run: a bar that moves over a background with a gradient.
fn value(frame: usize, pixel: usize) -> u16 {
    let (x, y) = (pixel % SIDE, pixel / SIDE);
    let bar = x.abs_diff(20 + 3 * frame) < 2 && (10..54).contains(&y);
    if bar { 1440 } else { 3040 + 16 * (y / 8) as u16 }
}

/// Writes the run with 16 bits per pixel, each value changed by `stored`, after further changes of the file.
fn write(path: &Path, bits: u16, signed: bool, stored: impl Fn(u16) -> i32, change: impl Fn(&mut InMemDicomObject)) {
    let pixels = (0..FRAMES).flat_map(|frame| (0..SIDE * SIDE).map(move |pixel| value(frame, pixel)));
    let pixels: Vec<u16> = pixels.map(|value| stored(value) as u16).collect();
    dicom::angiogram(path, |o| {
        for (tag, value) in [
            (tags::BITS_ALLOCATED, 16),
            (tags::BITS_STORED, bits),
            (tags::HIGH_BIT, bits - 1),
            (tags::PIXEL_REPRESENTATION, u16::from(signed)),
        ] {
            o.put(DataElement::new(tag, VR::US, PrimitiveValue::from(value)));
        }
        o.put(DataElement::new(tags::PIXEL_DATA, VR::OW, PrimitiveValue::U16(pixels.iter().copied().collect())));
        change(o);
    });
}

fn rescaled(o: &mut InMemDicomObject, slope: &str, intercept: &str) {
    o.put(DataElement::new(tags::RESCALE_SLOPE, VR::DS, PrimitiveValue::from(slope)));
    o.put(DataElement::new(tags::RESCALE_INTERCEPT, VR::DS, PrimitiveValue::from(intercept)));
    o.put(DataElement::new(tags::RESCALE_TYPE, VR::LO, PrimitiveValue::from("US")));
}

/// Adds a Modality LUT Sequence with 16 bits per entry.
fn table(o: &mut InMemDicomObject, first: i32, entries: &[u16], vr: VR) {
    let mut item = InMemDicomObject::new_empty();
    let descriptor = [entries.len() as u16, first as u16, 16];
    let numbers = |values: &[u16]| PrimitiveValue::U16(values.iter().copied().collect());
    item.put(DataElement::new(tags::LUT_DESCRIPTOR, VR::US, numbers(&descriptor)));
    item.put(DataElement::new(tags::MODALITY_LUT_TYPE, VR::LO, PrimitiveValue::from("US")));
    item.put(DataElement::new(tags::LUT_DATA, vr, numbers(entries)));
    o.put(DataElement::new(tags::MODALITY_LUT_SEQUENCE, VR::SQ, DataSetSequence::from(vec![item])));
}

/// Values of the first frame as pydicom gives them after the modality LUT.
fn as_pydicom(file: &Path) -> Vec<f64> {
    let script = "import sys, pydicom\nfrom pydicom.pixels import apply_modality_lut\n\
                  file = pydicom.dcmread(sys.argv[1])\n\
                  print(*apply_modality_lut(file.pixel_array, file)[0].ravel())";
    let outcome = python().args(["-c", script]).arg(file).output().unwrap();
    assert!(outcome.status.success(), "{}", String::from_utf8_lossy(&outcome.stderr));
    let text = String::from_utf8(outcome.stdout).unwrap();
    text.split_ascii_whitespace().map(|number| number.parse().unwrap()).collect()
}

/// Line integrals of the first frame after an import.
fn integrals(file: &Path, directory: &Path) -> Vec<f32> {
    let options = ImportOptions {
        phases: FRAMES as u32,
        gating: Gating::Phases((0..FRAMES).map(|phase| phase as f64).collect()),
        scaling: BeatScaling::Linear,
        frames: Some(1..=FRAMES),
        pixel_mm: None,
        size: None,
        all_beats: false,
        depth_half_extent_mm: 90.0,
        keep_references: false,
    };
    let out = directory.join("data");
    let _ = std::fs::remove_dir_all(&out);
    import_dicom(&[file.to_path_buf()], &options, &out).unwrap();
    Dataset::open(&out).unwrap().frames[0].integrals.to_vec()
}

#[track_caller]
fn expect(file: &Path, directory: &Path, integral: impl Fn(f64) -> f64) {
    let (read, wanted) = (Run::read(file, None).unwrap(), as_pydicom(file));
    let off = read.frames[0].iter().zip(&wanted).map(|(a, b)| (f64::from(*a) - b).abs()).fold(0.0, f64::max);
    assert!(wanted.len() == SIDE * SIDE && off < 1e-3, "{off} from pydicom's values");
    let found = integrals(file, directory);
    let wanted = (0..SIDE * SIDE).map(|pixel| integral(f64::from(value(0, pixel))));
    let off = found.iter().zip(wanted).map(|(found, wanted)| (f64::from(*found) - wanted).abs()).fold(0.0, f64::max);
    assert!(found.len() == SIDE * SIDE && off < 2e-3, "{off} from the expected integrals");
}

#[test]
fn a_storage_form_does_not_change_logarithmic_integrals() {
    let directory = tempfile::tempdir().unwrap();
    let file = directory.path().join("run.dcm");
    // The full range of grey values is 3.
    let log = |v: f64| (4095.0 - v) / 4095.0 * 3.0;
    let plain = |v: u16| i32::from(v);
    let shifted = |v: u16| i32::from(v) - 2048;
    write(&file, 12, false, plain, |_| {});
    expect(&file, directory.path(), log);
    write(&file, 12, true, shifted, |_| {});
    expect(&file, directory.path(), log);
    write(&file, 12, true, shifted, |o| rescaled(o, "1", "2048"));
    expect(&file, directory.path(), log);
    write(&file, 12, false, plain, |o| rescaled(o, "0.5", "-100"));
    expect(&file, directory.path(), log);
    // All values are multiples of 16, of which 8 bits are enough; their largest is then 4080.
    write(&file, 8, false, |v| i32::from(v / 16), |o| rescaled(o, "16", "0"));
    expect(&file, directory.path(), |v| (4080.0 - v) / 4080.0 * 3.0);
}

#[test]
fn a_storage_form_does_not_change_linear_integrals() {
    let directory = tempfile::tempdir().unwrap();
    let file = directory.path().join("run.dcm");
    let linear = |v: f64| -(v / 4095.0).ln();
    let is_linear = |o: &mut InMemDicomObject| {
        o.put(DataElement::new(tags::PIXEL_INTENSITY_RELATIONSHIP, VR::CS, PrimitiveValue::from("LIN")));
    };
    write(&file, 12, false, i32::from, is_linear);
    expect(&file, directory.path(), linear);
    write(&file, 12, true, |v| i32::from(v) - 2048, is_linear);
    expect(&file, directory.path(), linear);
    write(
        &file,
        12,
        true,
        |v| i32::from(v) - 2048,
        |o| {
            is_linear(o);
            rescaled(o, "1", "2048");
        },
    );
    expect(&file, directory.path(), linear);
}

#[test]
fn the_table_of_a_modality_lut_leads_to_linear_intensity() {
    let directory = tempfile::tempdir().unwrap();
    let file = directory.path().join("run.dcm");
    let entries = |of: &dyn Fn(f64) -> f64| (0..4096).map(|v| of(f64::from(v)).round() as u16).collect::<Vec<u16>>();
    let (identity, square) = (entries(&|v| v), entries(&|v| 65535.0 * (v / 4095.0).powi(2)));
    for vr in [VR::US, VR::OW] {
        write(&file, 12, false, i32::from, |o| table(o, 0, &identity, vr));
        expect(&file, directory.path(), |v| -(v / 4095.0).ln());
        write(&file, 12, false, i32::from, |o| table(o, 0, &square, vr));
        expect(&file, directory.path(), |v| -2.0 * (v / 4095.0).ln());
    }
    // Values below the first entry have its value, and those beyond the last one the last value.
    let part: Vec<u16> = (0..1600).map(|i| 1500 + i).collect();
    write(&file, 12, false, i32::from, |o| table(o, 1500, &part, VR::US));
    expect(&file, directory.path(), |v| -(v.clamp(1500.0, 3099.0) / 3099.0).ln());
    // A table that is shorter than it states is refused.
    write(&file, 12, false, i32::from, |o| {
        table(o, 0, &identity, VR::US);
        let mut item = InMemDicomObject::new_empty();
        let numbers = |values: &[u16]| PrimitiveValue::U16(values.iter().copied().collect());
        item.put(DataElement::new(tags::LUT_DESCRIPTOR, VR::US, numbers(&[4096, 0, 16])));
        item.put(DataElement::new(tags::LUT_DATA, VR::US, numbers(&[1, 2, 3])));
        o.put(DataElement::new(tags::MODALITY_LUT_SEQUENCE, VR::SQ, DataSetSequence::from(vec![item])));
    });
    let error = Run::read(&file, None).err().unwrap().to_string();
    assert!(error.contains("ModalityLUTSequence") && error.contains("3 values"), "{error}");
}
