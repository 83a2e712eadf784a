//! Trees that `phantom --tree` reads: VTK files in each encoding, the project's own files, and damaged ones.

use crate::known_tree::{PHASES, Trained, nertca, ok, text, trained};
use crate::python::python;
use nertca_vk::random::{STREAM_SHAPE, uniform01};
use nertca_vk_phantom::tree_file::TreeFile;
use serde_json::Value;
use std::path::{Path, PathBuf};
use std::sync::OnceLock;

/// Tolerance of single precision.
const NEAR_MM: f64 = 1e-5;

type Lines = Vec<Vec<[f64; 3]>>;

/// Files written by VTK, and their content, created once.
fn written() -> &'static (tempfile::TempDir, Value) {
    static FILES: OnceLock<(tempfile::TempDir, Value)> = OnceLock::new();
    FILES.get_or_init(|| {
        let directory = tempfile::tempdir().unwrap();
        let script = crate::root::root().join("tests/python/write_lines.py");
        let outcome = python().arg(script).arg(directory.path()).output().unwrap();
        assert!(outcome.status.success(), "{}", String::from_utf8_lossy(&outcome.stderr));
        let expected = std::fs::read(directory.path().join("expected.json")).unwrap();
        (directory, serde_json::from_slice(&expected).unwrap())
    })
}

/// Compares a tree at a fraction of its beat with lines in LPS mm.
#[track_caller]
fn same(file: &Path, fraction: f64, lines: &Lines, radii: &[Vec<f64>]) {
    let tree = TreeFile::read(file).unwrap_or_else(|e| panic!("{e}")).at(fraction);
    assert_eq!(tree.branches.len(), lines.len(), "{}", file.display());
    for ((branch, line), radii) in tree.branches.iter().zip(lines).zip(radii) {
        assert_eq!(branch.points.len(), line.len(), "{}", file.display());
        let away = branch.points.iter().zip(line).map(|(a, b)| a.distance((*b).into())).fold(0.0, f64::max);
        assert!(away < NEAR_MM, "{}: {away} mm off", file.display());
        let wider = branch.radius_mm.iter().zip(radii).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
        assert!(wider < NEAR_MM, "{}: radii are {wider} mm off", file.display());
    }
}

#[test]
fn lines_of_vtk_are_read_in_each_encoding() {
    let (directory, expected) = written();
    let lines: Vec<Lines> = serde_json::from_value(expected["lines"].clone()).unwrap();
    let radii: Vec<Vec<f64>> = serde_json::from_value(expected["radius_mm"].clone()).unwrap();
    let files: Vec<PathBuf> = serde_json::from_value(expected["files"].clone()).unwrap();
    assert_eq!(files.len(), 72);
    files.iter().for_each(|file| same(&directory.path().join(file), 0.0, &lines[0], &radii));
    // The order of a collection defines its times.
    let beat = directory.path().join("beat.pvd");
    (0..3).for_each(|phase| same(&beat, phase as f64 / 3.0, &lines[phase], &radii));
}

#[test]
fn what_cannot_be_read_is_named() {
    let (directory, _) = written();
    let out = directory.path().join("never made");
    // A reader that recurses at every element would crash the program.
    let deep = "<a>".repeat(100_000);
    for (name, content, parts) in [
        ("deep.vtp", Some(deep.as_str()), &["XML"][..]),
        ("lz4.vtp", None, &["compressor", "LZ4", "vtkZLibDataCompressor"]),
        ("nameless.vtp", None, &["PointData", "MaximumInscribedSphereRadius", "Width"]),
        ("unlike.pvd", None, &["shorter.vtp", "Lines", "phase0.vtp"]),
        ("grid.vtp", Some("<VTKFile type=\"ImageData\"/>"), &["ImageData", "PolyData"]),
        ("other.vtp", Some("<html/>"), &["html", "VTKFile"]),
        ("words.vtp", Some("no XML"), &["XML"]),
        ("none.vtp", Some("<VTKFile type=\"PolyData\"><PolyData/></VTKFile>"), &["Piece"]),
        ("none.pvd", Some("<VTKFile type=\"Collection\"><Collection/></VTKFile>"), &["Collection", "no file"]),
        (
            "absent.pvd",
            Some(
                "<VTKFile type=\"Collection\"><Collection><DataSet timestep=\"0\" file=\"gone.vtp\"/></Collection></VTKFile>",
            ),
            &["gone.vtp"],
        ),
    ] {
        let file = directory.path().join(name);
        if let Some(content) = content {
            std::fs::write(&file, content).unwrap();
        }
        let answer = nertca(&["phantom", text(&out), "--tree", text(&file)]);
        let said = String::from_utf8_lossy(&answer.stderr);
        assert_eq!(answer.status.code(), Some(1), "{name}: {said}");
        parts.iter().for_each(|part| assert!(said.contains(part), "{name} does not name `{part}`: {said}"));
        assert!(!out.exists(), "{name}");
    }
}

#[test]
fn damaged_lines_are_errors() {
    let (directory, expected) = written();
    let files: Vec<PathBuf> = serde_json::from_value(expected["files"].clone()).unwrap();
    let damaged = directory.path().join("damaged.vtp");
    let draw = |counter: u32| uniform01(7, STREAM_SHAPE, counter, 0);
    let mut refused = 0;
    for (index, file) in files.iter().enumerate() {
        let whole = std::fs::read(directory.path().join(file)).unwrap();
        for try_ in 0..20 {
            let counter = (index * 1000 + try_ * 10) as u32;
            let mut bytes = whole.clone();
            let place = (draw(counter) * whole.len() as f64) as usize;
            if try_ % 2 == 0 {
                bytes.truncate(place)
            } else {
                bytes[place] ^= 1 << (try_ % 8)
            }
            std::fs::write(&damaged, bytes).unwrap();
            // A wrong value may be read; any other damage is an error, and nothing panics.
            refused += usize::from(TreeFile::read(&damaged).is_err());
        }
    }
    assert!(refused > files.len() * 10, "{refused}");
}

#[test]
fn our_own_lines_come_back() {
    let (directory, Trained { run, .. }) = (tempfile::tempdir().unwrap(), trained());
    let to = |name: &str| directory.path().join(name);
    ok(&["tree", text(run), "-o", text(&to("again.json"))]);
    ok(&["tree", text(run), "-o", text(&to("again.vtp"))]);
    let tree: Value = serde_json::from_slice(&std::fs::read(to("again.json")).unwrap()).unwrap();
    let of = |phase: usize, field: &str| -> Vec<Value> {
        tree["phases"][phase]["branches"].as_array().unwrap().iter().map(|b| b[field].clone()).collect()
    };
    let radii: Vec<Vec<f64>> = serde_json::from_value(of(0, "radius_mm").into()).unwrap();
    for phase in 0..PHASES {
        let lines: Lines = serde_json::from_value(of(phase, "points_mm").into()).unwrap();
        same(&to("again.pvd"), phase as f64 / PHASES as f64, &lines, &radii);
        same(&to(&format!("again_{phase:04}.vtp")), 0.0, &lines, &radii);
    }
    // A phantom made from it has the same vessels.
    let (phases, out) = (PHASES.to_string(), to("phantom"));
    ok(&["phantom", text(&out), "--tree", text(&to("again.pvd")), "--size", "32", "--phases", &phases]);
    let lines: Lines = serde_json::from_value(of(2, "points_mm").into()).unwrap();
    same(&out.join("volumes/tree.json"), 0.5, &lines, &radii);
}
