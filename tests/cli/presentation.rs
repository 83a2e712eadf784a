//! Centrelines over the frames of source runs: an import that keeps references, and a DICOM presentation state that pydicom and dciodvfy
//! read.

use crate::dicom_export::expect_valid;
use crate::python::python;
use crate::said::{run, text};
use dicom_core::{DataElement, PrimitiveValue, VR};
use dicom_dictionary_std::tags;
use std::path::{Path, PathBuf};

const PHASES: usize = 4;
const ANGLES: [(f64, f64); 4] = [(-30.0, 0.0), (60.0, 0.0), (0.0, 35.0), (-10.0, -30.0)];
const FEW: [&str; 5] = ["--set", "gaussians.iterations=40", "--set", "train.iterations=45", "--no-eval"];

/// Changes texts of a file.
fn set(file: &Path, texts: &[(dicom_core::Tag, VR, &[u8])]) {
    let mut object = dicom_object::open_file(file).unwrap();
    for (tag, vr, bytes) in texts {
        object.put(DataElement::new(*tag, *vr, PrimitiveValue::U8((*bytes).into())));
    }
    object.write_to_file(file).unwrap();
}

/// Makes runs of one study of a patient, one for each of the angles.
fn runs(directory: &Path) -> Vec<PathBuf> {
    let at = |name: &str| directory.join(name);
    run(&["phantom", text(&at("heart")), "--size", "64", "--phases", &PHASES.to_string(), "--no-volumes"], true);
    let off = ["--set", "calibrate.mode=off", "--set", "calibrate.adjust=off"];
    run(&[&["train", text(&at("heart")), "-o", text(&at("first"))], &FEW[..], &off[..]].concat(), true);
    let render = |(number, (primary, secondary)): (usize, &(f64, f64))| {
        let file = at(&format!("run{number}.dcm"));
        let [primary, secondary] = [primary, secondary].map(f64::to_string);
        let view = ["--primary", &primary, "--secondary", &secondary, "--phase", "all", "--size", "256"];
        run(&[&["render", text(&at("first")), "-o", text(&file)], &view[..]].concat(), true);
        let study: [(dicom_core::Tag, VR, &[u8]); 10] = [
            (tags::SPECIFIC_CHARACTER_SET, VR::CS, b"ISO_IR 100"),
            (tags::PATIENT_NAME, VR::PN, b"M\xfcller^J\xf6rg "),
            (tags::PATIENT_ID, VR::LO, b"4711"),
            (tags::PATIENT_BIRTH_DATE, VR::DA, b"19520229"),
            (tags::PATIENT_SEX, VR::CS, b"M "),
            (tags::STUDY_INSTANCE_UID, VR::UI, b"1.2.3.4.5\0"),
            (tags::STUDY_DATE, VR::DA, b"20261127"),
            (tags::STUDY_TIME, VR::TM, b"101500"),
            (tags::STUDY_ID, VR::SH, b"17"),
            (tags::ACCESSION_NUMBER, VR::SH, b"A-9 "),
        ];
        set(&file, &study);
        file
    };
    ANGLES.iter().enumerate().map(render).collect()
}

/// Reads the references of a dataset: file and source frames of each image.
fn images(dataset: &Path) -> Vec<(PathBuf, serde_json::Value)> {
    let text = std::fs::read_to_string(dataset.join("references.json")).unwrap();
    let references: serde_json::Value = serde_json::from_str(&text).unwrap();
    let image = |image: &serde_json::Value| {
        (dataset.join(image["image"].as_str().unwrap()), serde_json::json!([image["run"], image["frames"]]))
    };
    references["images"].as_array().unwrap().iter().map(image).collect()
}

/// Expects that other layouts and corrected geometry keep the references of a dataset where they are asked to.
fn expect_kept_in_copies(data: &Path, copy: &Path) {
    let convert = ["convert", text(data), "--layout", "nerfca", "-o", text(copy)];
    let calibrate = ["calibrate", text(data), "--force", "-o", text(copy)];
    for command in [&convert[..], &calibrate[..]] {
        let said = run(&[command, &["--keep-references"]].concat(), true);
        assert!(!said.contains("is not kept"), "{said}");
        let (here, there) = (images(data), images(copy));
        assert_eq!(here.len(), ANGLES.len() * PHASES);
        assert!(there.iter().all(|(file, _)| file.is_file()), "{there:?}");
        let sources = |images: &[(PathBuf, serde_json::Value)]| -> Vec<_> {
            images.iter().map(|(_, source)| source.clone()).collect()
        };
        assert_eq!(sources(&here), sources(&there));
    }
    let said = run(&calibrate, true);
    assert!(said.contains("references.json is not kept") && !copy.join("references.json").exists(), "{said}");
}

#[test]
fn centrelines_lie_over_the_frames_of_the_runs() {
    let directory = tempfile::tempdir().unwrap();
    let at = |name: &str| directory.path().join(name);
    let files = runs(directory.path());
    let paths: Vec<&str> = files.iter().map(|file| text(file)).collect();
    let (phases, list, data, trained) = (PHASES.to_string(), at("phases.txt"), at("data"), at("run"));
    std::fs::write(&list, (0..PHASES).map(|phase| format!("{phase}\n")).collect::<String>()).unwrap();
    let reading =
        ["--phases", &phases, "--frames", "1-4", "--phase-list", text(&list), "--size", "64", "-o", text(&data)];
    let import = |more: &[&str]| run(&[&["import", "dicom"], &paths[..], &reading[..], more].concat(), true);

    let said = import(&["--keep-references"]);
    assert!(said.contains("references.json keeps") && said.contains("Delete it"), "{said}");
    assert!(std::fs::read_to_string(data.join("references.json")).unwrap().contains("Müller^Jörg"));
    let off = ["--set", "calibrate.mode=off", "--set", "calibrate.adjust=off"];
    run(&[&["train", text(&data), "-o", text(&trained)], &FEW[..], &off[..]].concat(), true);
    let (state, tree) = (at("state.dcm"), at("tree.json"));
    run(&["tree", text(&trained), "-o", text(&tree)], true);
    let present = ["tree", text(&trained), "--presentation", "-o"];
    run(&[&present[..], &[text(&state)]].concat(), true);
    let script = crate::root::root().join("tests/python/check_presentation.py");
    let outcome = python().arg(script).args([&state, &tree]).args(&files).output().unwrap();
    print!("{}", String::from_utf8_lossy(&outcome.stdout));
    assert!(outcome.status.success(), "{}", String::from_utf8_lossy(&outcome.stderr));
    expect_valid(&state);

    expect_kept_in_copies(&data, &at("copy"));

    // The name of another file, and runs of two studies.
    let said = run(&[&present[..], &[text(&at("state.json"))]].concat(), false);
    assert!(said.contains("--out") && said.contains(".dcm"), "{said}");
    let kept = std::fs::read_to_string(data.join("references.json")).unwrap();
    std::fs::write(data.join("references.json"), kept.replacen("1.2.3.4.5", "1.2.3.4.6", 1)).unwrap();
    let said = run(&[&present[..], &[text(&at("two.dcm"))]].concat(), false);
    assert!(said.contains("belongs to one study") && !at("two.dcm").exists(), "{said}");

    // Without the option nothing of the patient is kept, also where an earlier import kept it.
    let said = import(&["--force"]);
    assert!(!said.contains("references.json") && !data.join("references.json").exists(), "{said}");
    for entry in std::fs::read_dir(&data).unwrap().map(|entry| entry.unwrap().path()).filter(|path| path.is_file()) {
        let bytes = std::fs::read(&entry).unwrap();
        let has = |secret: &str| bytes.windows(secret.len()).any(|part| part == secret.as_bytes());
        assert!(!has("ller^J") && !has("1.2.3.4.5") && !has("4711"), "{}", entry.display());
    }
    let convert = ["convert", text(&data), "--layout", "native", "--keep-references", "-o"];
    let said = run(&[&convert[..], &[text(&at("nothing"))]].concat(), false);
    assert!(said.contains("nothing to keep") && !at("nothing").exists(), "{said}");
    let said = run(&[&present[..], &[text(&at("none.dcm"))]].concat(), false);
    assert!(said.contains("references.json") && said.contains("--keep-references"), "{said}");

    // A file without identity has nothing to which a result could refer.
    set(&files[0], &[(tags::SERIES_INSTANCE_UID, VR::UI, b"")]);
    let said =
        run(&[&["import", "dicom"], &paths[..], &reading[..], &["--keep-references", "--force"]].concat(), false);
    assert!(said.contains("run0.dcm") && said.contains("series"), "{said}");
    assert!(Path::new(&data).join("dataset.json").exists(), "the earlier dataset stays");
}
