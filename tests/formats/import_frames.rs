//! Selection of the frames of a clinical run: the longest stretch in which vessels are filled with contrast.

use crate::dicom;
use dicom_core::{DataElement, PrimitiveValue, VR};
use dicom_dictionary_std::tags;
use nertca_vk::scan::dataset::Dataset;
use nertca_vk::scan::gating::BeatScaling;
use nertca_vk_import::angiograms::{Gating, ImportOptions};
use nertca_vk_import::intake::import_dicom;
use std::ops::RangeInclusive;
use std::path::Path;

/// Writes a run with a frame for each share of full contrast: a bar, darker than its surroundings in proportion.
fn run(path: &Path, contrast: &[f64]) {
    let pixels: Vec<u8> = contrast
        .iter()
        .flat_map(|share| {
            (0..64u32 * 64).map(move |p| {
                let (x, y) = (p % 64, p / 64);
                let bar = (30..33).contains(&x) && (10..54).contains(&y);
                190 + (y / 8) as u8 - if bar { (100.0 * share) as u8 } else { 0 }
            })
        })
        .collect();
    dicom::angiogram(path, |o| {
        let frames = contrast.len().to_string();
        o.put(DataElement::new(tags::NUMBER_OF_FRAMES, VR::IS, PrimitiveValue::from(frames.as_str())));
        o.put(DataElement::new(tags::PIXEL_DATA, VR::OB, PrimitiveValue::from(pixels.clone())));
    });
}

/// Options with minimum values for everything else.
fn options(gating: Gating, phases: u32) -> ImportOptions {
    ImportOptions {
        phases,
        gating,
        scaling: BeatScaling::Linear,
        frames: None,
        pixel_mm: None,
        size: None,
        all_beats: false,
        depth_half_extent_mm: 90.0,
        keep_references: false,
    }
}

/// Imports frames, each as a phase of its own; returns the messages and the number of frames.
fn import(contrast: &[f64], phases: u32, frames: Option<RangeInclusive<usize>>) -> (String, usize) {
    let directory = tempfile::tempdir().unwrap();
    let (file, out) = (directory.path().join("run.dcm"), directory.path().join("data"));
    run(&file, contrast);
    let options = ImportOptions { frames, ..options(Gating::Phases((0..phases).map(f64::from).collect()), phases) };
    let notes = import_dicom(&[file], &options, &out).unwrap();
    (notes.join("\n"), Dataset::open(&out).unwrap().frames.len())
}

#[test]
fn the_longest_filled_stretch_is_taken() {
    // Contrast flows in and out, returns briefly, and vanishes.
    let (told, frames) = import(&[0.0, 0.3, 0.8, 1.0, 1.0, 0.9, 0.3, 1.0, 0.0], 4, None);
    assert!(told.contains("frames 3 to 6 of 9 are filled with contrast"), "{told}");
    assert_eq!(frames, 4);
}

#[test]
fn a_stretch_may_begin_with_the_run_and_last_to_its_end() {
    let (told, frames) = import(&[0.0, 0.1, 1.0, 0.9, 1.0], 3, None);
    assert!(told.contains("frames 3 to 5 of 5"), "{told}");
    assert_eq!(frames, 3);
    let (told, frames) = import(&[1.0, 0.9, 0.2, 0.0, 0.1], 2, None);
    assert!(told.contains("frames 1 to 2 of 5"), "{told}");
    assert_eq!(frames, 2);
}

#[test]
fn frames_that_are_asked_for_are_taken_as_they_are() {
    let (told, frames) = import(&[0.0, 0.1, 1.0, 0.9, 1.0], 3, Some(1..=3));
    assert!(!told.contains("filled"), "{told}");
    assert_eq!(frames, 3);
}

#[test]
fn a_run_without_ecg_is_gated_by_its_images() {
    let directory = tempfile::tempdir().unwrap();
    let (file, out) = (directory.path().join("run.dcm"), directory.path().join("data"));
    // Contrast agent arrives in a bar that swings once in 12 frames of 0.1 s.
    let frames = 40u32;
    let swing = |frame: u32| 8.0 * (std::f64::consts::TAU * f64::from(frame) / 12.0).sin();
    let pixel = |frame: u32, p: u32| {
        let bar = (f64::from(p % 64) - 32.0 - swing(frame)).abs() < 1.5 && (10..54).contains(&(p / 64));
        let (x, y) = (f64::from(p % 64), f64::from(p / 64));
        let chest = 185.0 + 9.0 * (0.55 * x + 0.35 * y).sin() + 7.0 * (0.8 * y - 0.3 * x).sin();
        if bar && frame > 5 { 90u8 } else { chest as u8 }
    };
    let pixels: Vec<u8> = (0..frames).flat_map(|f| (0..64 * 64).map(move |p| pixel(f, p))).collect();
    dicom::angiogram(&file, |o| {
        o.put(DataElement::new(tags::NUMBER_OF_FRAMES, VR::IS, PrimitiveValue::from(frames.to_string())));
        o.put(DataElement::new(tags::PIXEL_DATA, VR::OB, PrimitiveValue::from(pixels.clone())));
    });
    let import = |gating: Gating, frames: Option<RangeInclusive<usize>>| {
        import_dicom(std::slice::from_ref(&file), &ImportOptions { frames, ..options(gating, 6) }, &out)
    };
    let refused =
        |gating: Gating, frames: Option<RangeInclusive<usize>>| import(gating, frames).unwrap_err().to_string();
    assert!(refused(Gating::Ecg, None).contains("find the beat in the images"));
    let outside = refused(Gating::Images, Some(30..=41));
    assert!(outside.contains("has frames 1 to 40"), "{outside}");
    let told = import(Gating::Images, Some(15..=40)).unwrap().join("\n");
    assert!(told.contains("50 beats per minute, found in the images"), "{told}");
    let (first, _) = told.split_once("the beat of frames ").unwrap().1.split_once(" to ").unwrap();
    assert!(first.parse::<usize>().unwrap() >= 15, "{told}");
    let dataset = Dataset::open(&out).unwrap();
    assert_eq!(dataset.frames.len(), 6, "{told}");
    // The images are the vessels alone.
    for frame in &dataset.frames {
        let seen = frame.integrals.iter().filter(|v| **v > 0.0).count();
        assert!((60..500).contains(&seen), "{seen} pixels");
    }
}

#[test]
fn frames_of_a_run_keep_their_own_time() {
    let directory = tempfile::tempdir().unwrap();
    let file = directory.path().join("run.dcm");
    run(&file, &[1.0; 7]);
    let import = |gating: Gating, phases: u32| {
        let out = tempfile::tempdir().unwrap();
        import_dicom(std::slice::from_ref(&file), &options(gating, phases), out.path())?;
        Dataset::open(out.path()).map(|d| d.frames.iter().map(|f| (f.phase, f.after_phase)).collect::<Vec<_>>())
    };
    let same = |found: &[(u32, f64)], wanted: &[(u32, f64)]| {
        let near = |(a, b): (&(u32, f64), &(u32, f64))| a.0 == b.0 && (a.1 - b.1).abs() < 1e-6;
        assert!(found.len() == wanted.len() && found.iter().zip(wanted).all(near), "{found:?}");
    };
    // At 60 beats per minute and one frame per 0.1 s, phases are 0.25 s long, with middles at 0.125 s, 0.375 s and 0.625 s.
    let steady = import(Gating::HeartRate(60.0), 4).unwrap();
    same(&steady, &[(0, -0.1), (1, -0.1), (2, -0.3)]);
    let listed = import(Gating::Phases(vec![0.0, 0.4, 1.25, 2.0, 2.25, 3.5, 3.75]), 4).unwrap();
    same(&listed, &[(0, (0.0 + 0.4 - 0.5 - 0.25) / 4.0), (1, 0.25), (2, 0.125)]);
    let refused = import(Gating::Phases(vec![0.0, 1.0, 2.0, 3.0, 4.0, 0.0, 1.0]), 4).unwrap_err().to_string();
    assert!(refused.contains("phase 4 is given, but phases go from 0 to 3"), "{refused}");
}
