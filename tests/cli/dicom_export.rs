//! Rendered views as DICOM: pydicom opens them, and the project's import reads the same line integrals and angles.

use crate::python::python;
use crate::said::{run, text};
use dicom_dictionary_std::tags;
use nertca_vk::checkpoint::newest_model;
use nertca_vk::formats::npy;
use nertca_vk::geometry::Geometry;
use nertca_vk::scan::dataset::Dataset;
use std::path::Path;
use std::process::Command;

const PHASES: usize = 4;
const ANGLES: (f64, f64) = (-31.25, 22.5);

#[test]
fn a_rendered_beat_is_an_angiogram() {
    let directory = tempfile::tempdir().unwrap();
    let at = |name: &str| directory.path().join(name);
    let (data, trained) = (at("data"), at("run"));
    run(&["phantom", text(&data), "--size", "40", "--phases", &PHASES.to_string(), "--no-volumes"], true);
    // Without calibration, which may move the table; a file does not state that.
    let few = [
        "--set",
        "train.iterations=40",
        "--set",
        "gaussians.iterations=30",
        "--set",
        "calibrate.mode=off",
        "--no-eval",
    ];
    run(&[&["train", text(&data), "-o", text(&trained)], &few[..]].concat(), true);
    let (primary, secondary) = (ANGLES.0.to_string(), ANGLES.1.to_string());
    let render = |name: &str, more: &[&str], succeeds: bool| {
        let out = at(name);
        let view = ["render", text(&trained), "--primary", &primary, "--secondary", &secondary, "-o", text(&out)];
        (run(&[&view, more].concat(), succeeds), out)
    };
    let (_, beat) = render("beat.dcm", &["--phase", "all"], true);
    let (_, numbers) = render("beat.npy", &["--phase", "all"], true);
    let (_, still) = render("still.dcm", &["--phase", "2"], true);
    let script = crate::root::root().join("tests/python/check_dicom.py");
    let outcome = python().arg(script).args([&beat, &numbers]).output().unwrap();
    print!("{}", String::from_utf8_lossy(&outcome.stdout));
    assert!(outcome.status.success(), "{}", String::from_utf8_lossy(&outcome.stderr));

    // Import by the project: a phase for each frame.
    let (list, imported) = (at("phases.txt"), at("imported"));
    std::fs::write(&list, (0..PHASES).map(|phase| format!("{phase}\n")).collect::<String>()).unwrap();
    let (phases, frames) = (PHASES.to_string(), format!("1-{PHASES}"));
    let reading = ["--phases", &phases, "--frames", &frames, "--phase-list", text(&list), "-o", text(&imported)];
    run(&[&["import", "dicom", text(&beat)], &reading[..]].concat(), true);
    let (read, written) = (Dataset::open(&imported).unwrap(), npy::read(&numbers, 1 << 24).unwrap());
    assert_eq!((read.frames.len(), written.shape.as_slice()), (PHASES, &[PHASES, 40, 40][..]));
    for (frame, integrals) in read.frames.iter().zip(written.values.chunks(40 * 40)) {
        for (got, want) in frame.integrals.iter().zip(integrals) {
            // Half a grey value, as a share of the transmitted intensity.
            let tolerance = 0.51 / 65535.0 * want.exp() + 1e-6;
            assert!((got - want).abs() < tolerance, "phase {}: {got} for {want}", frame.phase);
        }
    }
    let Geometry::CArm(c_arm) = &read.views[0].geometry else { panic!("a C-arm took it") };
    let model = newest_model(&trained).unwrap().c_arm;
    assert_eq!((c_arm.primary_deg, c_arm.secondary_deg), ANGLES);
    assert_eq!((c_arm.sid_mm, c_arm.sod_mm), (model.sid_mm, model.sod_mm));
    assert!((0..2).all(|k| (c_arm.pixel_mm[k] / model.pixel_mm[k] - 1.0).abs() < 1e-9), "{c_arm:?}");

    // Each file has unique identifiers.
    let [beat, still] = [beat, still].map(|file| dicom_object::open_file(file).unwrap());
    for tag in [tags::STUDY_INSTANCE_UID, tags::SERIES_INSTANCE_UID, tags::SOP_INSTANCE_UID] {
        let [of_beat, of_still] = [&beat, &still].map(|file| file.element(tag).unwrap().to_str().unwrap());
        assert_ne!(of_beat, of_still, "{tag}");
    }
    expect_segmentations(directory.path(), &trained);
    // A report of measurements belongs to the study and the frame of reference of the segmentations.
    run(&["tree", text(&trained), "--threshold", "3e-4", "-o", text(&at("measured.dcm"))], true);
    let [vessels, measured] =
        ["vessels_0000.dcm", "measured.dcm"].map(|file| dicom_object::open_file(at(file)).unwrap());
    let uid =
        |object: &dicom_object::DefaultDicomObject, tag| object.element(tag).unwrap().to_str().unwrap().into_owned();
    let frame = uid(&vessels, tags::FRAME_OF_REFERENCE_UID);
    assert_eq!(uid(&vessels, tags::STUDY_INSTANCE_UID), uid(&measured, tags::STUDY_INSTANCE_UID));
    assert_ne!(uid(&vessels, tags::SERIES_INSTANCE_UID), uid(&measured, tags::SERIES_INSTANCE_UID));
    let bytes = std::fs::read(at("measured.dcm")).unwrap();
    assert!(bytes.windows(frame.len()).any(|part| part == frame.as_bytes()), "centrelines are in this frame");
    for file in ["beat.dcm", "still.dcm", "vessels_0000.dcm", "vessels_0003.dcm", "measured.dcm"] {
        expect_valid(&at(file));
    }
    let (said, refused) = render("most.dcm", &["--projection", "mip"], false);
    assert!(said.contains("--projection") && said.contains("line integrals") && !refused.exists(), "{said}");
}

/// Validates a DICOM file with dciodvfy.
#[track_caller]
pub(crate) fn expect_valid(file: &Path) {
    let outcome = Command::new("dciodvfy").arg(file).output().expect("dciodvfy, of the Debian package dicom3tools");
    let said = String::from_utf8_lossy(&outcome.stderr);
    let (warnings, faults): (Vec<&str>, Vec<&str>) = said
        .lines()
        .filter(|line| {
            !["XAImage", "Segmentation", "Comprehensive3DSR", "GrayscaleSoftcopyPresentationState"].contains(line)
        })
        .partition(|l| l.starts_with("Warning"));
    assert!(faults.is_empty(), "{}: {said}", file.display());
    // Dates and names of the study are not known, and no standard has the codes of the scheme 99NERTCA.
    let expected = |line: &&str| line.contains("DICOMDIR") || line.contains("<99NERTCA>");
    assert!(warnings.iter().all(expected), "{}: {said}", file.display());
}

/// Exports the vessels as segmentations, which highdicom and dcmqi read back, voxel by voxel.
fn expect_segmentations(directory: &Path, trained: &Path) {
    let at = |name: &str| directory.join(name);
    let export = |name: &str, more: &[&str], succeeds: bool| {
        let out = at(name);
        (run(&[&["export", text(trained), "-o", text(&out)], more].concat(), succeeds), out)
    };
    // A low threshold, because the field is hardly trained.
    let rule = ["--spacing", "0.8", "--iso", "3e-4"];
    export("beat.nrrd", &rule[..2], true);
    export("vessels.dcm", &[&["--segmentation"], &rule[..]].concat(), true);
    let script = crate::root::root().join("tests/python/check_segmentation.py");
    let outcome = python().arg(script).args([directory, Path::new("3e-4")]).output().unwrap();
    print!("{}", String::from_utf8_lossy(&outcome.stdout));
    assert!(outcome.status.success(), "{}", String::from_utf8_lossy(&outcome.stderr));
    for (name, more, part) in [
        ("vessels.dcm", &["--segmentation"][..], "--force"),
        ("vessels.nrrd", &["--segmentation"], ".dcm"),
        ("one.dcm", &["--segmentation", "--component", "total"], "dynamic field only"),
        ("one.dcm", &["--segmentation", "--phase", "0", "--iso", "1e3"], "no vessel has this"),
        ("one.nrrd", &["--iso", "1e-3"], "--segmentation"),
    ] {
        let (said, _) = export(name, more, false);
        assert!(said.contains(part), "{more:?}: {said}");
    }
    assert!(!at("one.dcm").exists());
}
