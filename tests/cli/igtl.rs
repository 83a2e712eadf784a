//! OpenIGTLink of `watch`: the reference library, which 3D Slicer uses, and pyigtl receive the overlay and the vessels.

use crate::program::program;
use crate::python::python;
use crate::watch::{PHASES, Watcher, runs, text};
use nertca_vk::geometry::CArm;
use nertca_vk::geometry::Geometry;
use nertca_vk::scan::dataset::Dataset;
use serde_json::Value;
use std::net::TcpStream;
use std::path::{Path, PathBuf};
use std::process::Command;

/// Compiles the client.
fn client(directory: &Path) -> PathBuf {
    let (source, made) = (crate::root::root().join("tests/cli/igtl_client.cpp"), directory.join("igtl_client"));
    let compiled = Command::new("c++")
        .args(["-std=c++17", "-isystem", "/usr/include/openigtlink", text(&source), "-o", text(&made)])
        .args(["-L/usr/lib", "-lOpenIGTLink", "-lpthread"])
        .output()
        .unwrap();
    let said = String::from_utf8_lossy(&compiled.stderr);
    assert!(compiled.status.success(), "libopenigtlink-dev of Debian is needed: {said}");
    made
}

/// A message as the client prints it: type, device, seconds since it was made, further numbers.
fn received(client: &Path, port: &str, count: usize) -> Vec<Vec<String>> {
    let out = Command::new(client).args([port, &count.to_string()]).output().unwrap();
    assert!(out.status.success(), "{}", String::from_utf8_lossy(&out.stderr));
    let words = |line: &str| line.split(' ').map(str::to_owned).collect();
    String::from_utf8_lossy(&out.stdout).lines().map(words).collect()
}

fn numbers(words: &[String]) -> Vec<f64> {
    words.iter().map(|word| word.parse().unwrap()).collect()
}

/// Direction from the source to the detector of a C-arm (right, anterior, superior).
fn axis(c_arm: &CArm) -> [f64; 3] {
    let (primary, secondary) = (c_arm.primary_deg.to_radians(), c_arm.secondary_deg.to_radians());
    [-secondary.cos() * primary.sin(), secondary.cos() * primary.cos(), secondary.sin()]
}

/// The module of 3D Slicer connects and shows nodes with the names that are sent; stand-ins take the place of Slicer.
#[test]
fn the_module_of_slicer_connects_and_shows() {
    let root = crate::root::root();
    let outcome = python()
        .arg(root.join("tests/python/check_slicer_module.py"))
        .arg(root.join("examples/slicer/NertcaLive/NertcaLive.py"))
        .output()
        .unwrap();
    print!("{}", String::from_utf8_lossy(&outcome.stdout));
    assert!(outcome.status.success(), "{}", String::from_utf8_lossy(&outcome.stderr));
}

#[test]
fn clients_get_the_overlay_its_place_and_the_vessels() {
    let directory = tempfile::tempdir().unwrap();
    let at = |name: &str| directory.path().join(name);
    let (runs, client) = (runs(directory.path()), client(directory.path()));
    std::fs::create_dir(at("inbox")).unwrap();
    let list: String = (0..PHASES).map(|phase| format!("{phase}\n")).collect();
    std::fs::write(at("phases.txt"), list).unwrap();
    let (inbox, run, phase_list) = (at("inbox"), at("run"), at("phases.txt"));
    let (frames, phases) = (format!("1-{PHASES}"), PHASES.to_string());
    let reading = ["--phases", &phases, "--frames", &frames, "--phase-list", text(&phase_list)];
    let settings = ["--set", "calibrate.mode=off", "--set", "train.iterations=130"];
    let mut watcher =
        Watcher::new(&[&[text(&inbox), "-o", text(&run), "--igtl", "0"], &reading[..], &settings[..]].concat());
    watcher.hear("OpenIGTLink: 127.0.0.1:");
    let port = watcher.heard().split("OpenIGTLink: 127.0.0.1:").nth(1).unwrap().lines().next().unwrap().to_owned();
    // It never reads what it gets.
    let stalled = TcpStream::connect(format!("127.0.0.1:{port}")).unwrap();
    let taken = program().args(["watch", text(&inbox), "-o", text(&at("other")), "--igtl", &port]).output().unwrap();
    let told = String::from_utf8_lossy(&taken.stderr);
    assert!(
        taken.status.code() == Some(2) && told.contains("--igtl") && told.contains("choose another port"),
        "{told}"
    );

    for (view, file) in runs.iter().enumerate() {
        std::fs::copy(file, inbox.join(format!("view{view}.dcm"))).unwrap();
        watcher.hear(&format!("imported: view{view} ("));
    }
    watcher.reach(|about| about["state"] == "trained");
    let messages = loop {
        let messages = received(&client, &port, 60);
        if messages.iter().any(|words| words[0] == "POLYDATA") {
            break messages;
        }
    };
    let of = |kind: &str| messages.iter().filter(|words| words[0] == kind).cloned().collect::<Vec<_>>();
    let (places, pictures, vessels) = (of("TRANSFORM"), of("IMAGE"), of("POLYDATA"));
    let apart = places.len().abs_diff(pictures.len());
    assert!(places.len() > 10 && apart <= 1, "{} places, {} pictures", places.len(), pictures.len());
    assert!(places.iter().all(|words| words[1] == "CArm") && pictures.iter().all(|words| words[1] == "Overlay"));

    let data = Dataset::open(&at("phantom")).unwrap();
    let Geometry::CArm(c_arm) = &data.views[0].geometry else { panic!("phantoms have C-arms") };
    let matrix = numbers(&places[0][3..]);
    let column = |k: usize| [matrix[k], matrix[4 + k], matrix[8 + k]];
    assert!((0..3).all(|k| (column(2)[k] - axis(c_arm)[k]).abs() < 1e-3), "{matrix:?}, {:?}", axis(c_arm));
    assert!(column(3).iter().all(|v| v.abs() < 1e-3), "the isocentre: {matrix:?}");
    let picture = numbers(&pictures[0][3..]);
    assert_eq!(picture[..5], [256.0, 256.0, 1.0, 10.0, 1.0], "size, floats, big-endian");
    let pixel_mm = 48.0 * c_arm.pixel_mm[0] * c_arm.sod_mm / c_arm.sid_mm / 256.0;
    assert!((picture[5] - pixel_mm).abs() < 1e-4 && (picture[6] - pixel_mm).abs() < 1e-4, "{picture:?}");

    let script = crate::root::root().join("tests/python/check_igtl.py");
    let outcome = python().arg(script).arg(&port).output().unwrap();
    print!("{}", String::from_utf8_lossy(&outcome.stdout));
    assert!(outcome.status.success(), "{}", String::from_utf8_lossy(&outcome.stderr));

    watcher.interrupt();
    let (said, well) = watcher.end();
    assert!(well, "{said}");
    assert_eq!(said.matches("third column is no direction").count(), 1, "a client is warned of once: {said}");
    drop(stalled);
    // The vessels are those of the run at some phase.
    let tree = at("tree.json");
    let out = program().args(["tree", text(&run), "-o", text(&tree)]).output().unwrap();
    assert!(out.status.success(), "{}", String::from_utf8_lossy(&out.stderr));
    let tree: Value = serde_json::from_slice(&std::fs::read(&tree).unwrap()).unwrap();
    let words = &vessels[0];
    assert_eq!((words[1].as_str(), words[7].as_str()), ("Vessels", "Radius"));
    let counts = [&words[3..7], &words[8..9]].concat();
    let [points, lines, in_lines, highest, radii] = numbers(&counts)[..] else { panic!("{words:?}") };
    let branches = |phase: &Value| phase["branches"].as_array().unwrap().clone();
    let all: Vec<Value> = tree["phases"].as_array().unwrap().clone();
    let of_tree = branches(&all[0]);
    let n_points: usize = of_tree.iter().map(|branch| branch["points_mm"].as_array().unwrap().len()).sum();
    assert_eq!((points, lines, in_lines), (n_points as f64, of_tree.len() as f64, n_points as f64), "{words:?}");
    assert_eq!((highest, radii), (points - 1.0, points));
    let first = numbers(&words[9..12]);
    let is_it = |phase: &Value| {
        let point: [f64; 3] = serde_json::from_value(branches(phase)[0]["points_mm"][0].clone()).unwrap();
        // RAS of LPS.
        [-point[0], -point[1], point[2]].iter().zip(&first).all(|(a, b)| (a - b).abs() < 2e-3)
    };
    assert!(all.iter().any(is_it), "{first:?}");
    let radius = of_tree[0]["radius_mm"][0].as_f64().unwrap();
    assert!((numbers(&words[12..])[0] - radius).abs() < 2e-3, "{words:?}, {radius}");
}
