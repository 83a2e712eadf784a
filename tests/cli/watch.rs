//! `watch`, through the program: runs are copied into the folder one by one during training, among files that are not runs.

use crate::dicom;
use crate::program::program;
use dicom_core::{DataElement, PrimitiveValue, VR};
use dicom_dictionary_std::tags;
use nertca_vk::geometry::Geometry;
use nertca_vk::scan::dataset::Dataset;
use serde_json::Value;
use std::io::{BufRead, BufReader, Read, Write};
use std::net::TcpStream;
use std::path::{Path, PathBuf};
use std::process::{Child, Stdio};
use std::sync::{Arc, Mutex};
use std::thread::JoinHandle;
use std::time::Duration;

pub const PHASES: usize = 6;
/// Range of the integrals that grey values represent, as the import assumes for logarithmic ones.
const SPAN: f32 = 3.0;

pub fn text(path: &Path) -> &str {
    path.to_str().unwrap()
}

#[track_caller]
fn ok(args: &[&str]) -> String {
    let out = program().args(args).output().unwrap();
    assert!(out.status.success(), "{args:?}: {}", String::from_utf8_lossy(&out.stderr));
    String::from_utf8(out.stdout).unwrap()
}

/// Angiograms of a phantom as DICOM runs, one per training view.
pub fn runs(directory: &Path) -> Vec<PathBuf> {
    let data = directory.join("phantom");
    ok(&["phantom", text(&data), "--size", "48", "--phases", &PHASES.to_string(), "--views", "3", "--no-volumes"]);
    let dataset = Dataset::open(&data).unwrap();
    let max = dataset.training().iter().flat_map(|f| &f.integrals).copied().fold(0.0, f32::max);
    let write = |view: usize| {
        let file = directory.join(format!("view{view}.dcm"));
        let Geometry::CArm(c_arm) = &dataset.views[view].geometry else { panic!("phantoms have C-arms") };
        let frames = dataset.training().iter().filter(|f| f.view == view);
        let grey = |v: &f32| (65535.0 * (1.0 - 0.8 * v / max / SPAN)).round() as u16;
        let pixels: Vec<u16> = frames.flat_map(|f| f.integrals.iter().map(grey)).collect();
        assert_eq!(pixels.len(), PHASES * 48 * 48);
        dicom::angiogram(&file, |o| {
            let mut put = |tag, vr, value: String| o.put(DataElement::new(tag, vr, PrimitiveValue::from(value)));
            put(tags::SOP_INSTANCE_UID, VR::UI, format!("1.2.3.{view}"));
            put(tags::NUMBER_OF_FRAMES, VR::IS, PHASES.to_string());
            put(tags::POSITIONER_PRIMARY_ANGLE, VR::DS, c_arm.primary_deg.to_string());
            put(tags::POSITIONER_SECONDARY_ANGLE, VR::DS, c_arm.secondary_deg.to_string());
            put(tags::DISTANCE_SOURCE_TO_DETECTOR, VR::DS, c_arm.sid_mm.to_string());
            put(tags::DISTANCE_SOURCE_TO_PATIENT, VR::DS, c_arm.sod_mm.to_string());
            put(tags::IMAGER_PIXEL_SPACING, VR::DS, format!("{:.6}\\{:.6}", c_arm.pixel_mm[1], c_arm.pixel_mm[0]));
            for (tag, value) in [
                (tags::ROWS, 48u16),
                (tags::COLUMNS, 48),
                (tags::BITS_ALLOCATED, 16),
                (tags::BITS_STORED, 16),
                (tags::HIGH_BIT, 15),
            ] {
                o.put(DataElement::new(tag, VR::US, PrimitiveValue::from(value)));
            }
            o.put(DataElement::new(tags::PIXEL_DATA, VR::OW, PrimitiveValue::U16(pixels.iter().copied().collect())));
        });
        file
    };
    dataset.training_views().into_iter().map(write).collect()
}

/// The running program, until it is dropped.
pub struct Watcher {
    process: Child,
    url: String,
    said: Arc<Mutex<String>>,
    reader: Option<JoinHandle<()>>,
}

impl Watcher {
    pub fn new(args: &[&str]) -> Watcher {
        let mut process =
            program().arg("watch").args(args).stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
        let (said, stderr) = (Arc::new(Mutex::new(String::new())), process.stderr.take().unwrap());
        let told = said.clone();
        let reader = std::thread::spawn(move || {
            for line in BufReader::new(stderr).lines() {
                let line = line.unwrap() + "\n";
                print!("{line}");
                *told.lock().unwrap() += &line;
            }
        });
        let mut url = String::new();
        BufReader::new(process.stdout.take().unwrap()).read_line(&mut url).unwrap();
        Watcher { process, url: url.trim().to_owned(), said, reader: Some(reader) }
    }

    /// Waits for a message of the program.
    #[track_caller]
    pub fn hear(&mut self, what: &str) {
        while !self.said.lock().unwrap().contains(what) {
            assert!(self.process.try_wait().unwrap().is_none(), "it ended without saying `{what}`");
            std::thread::sleep(Duration::from_millis(50));
        }
    }

    /// All messages so far.
    pub fn heard(&self) -> String {
        self.said.lock().unwrap().clone()
    }

    /// Status and body of a response.
    fn ask(&self, path: &str) -> (String, Vec<u8>) {
        let (host, token) = self.url.strip_prefix("http://").unwrap().split_once("/?token=").unwrap();
        let mut stream = TcpStream::connect(host).unwrap();
        write!(stream, "GET {path}token={token} HTTP/1.1\r\nHost: {host}\r\nConnection: close\r\n\r\n").unwrap();
        let mut answer = Vec::new();
        stream.read_to_end(&mut answer).unwrap();
        let split = answer.windows(4).position(|w| w == b"\r\n\r\n").unwrap();
        let status = String::from_utf8_lossy(&answer[..split]).lines().next().unwrap().to_owned();
        (status, answer[split + 4..].to_vec())
    }

    fn about(&self) -> Value {
        serde_json::from_slice(&self.ask("/info?").1).unwrap()
    }

    /// Waits until the page reports the expected progress.
    #[track_caller]
    pub fn reach(&self, done: impl Fn(&Value) -> bool) {
        while !done(&self.about()) {
            std::thread::sleep(Duration::from_millis(50));
        }
    }

    pub fn interrupt(&self) {
        let sent = std::process::Command::new("kill").args(["-INT", &self.process.id().to_string()]).status();
        assert!(sent.unwrap().success());
    }

    /// All messages, and whether the program ended successfully.
    pub fn end(mut self) -> (String, bool) {
        let status = self.process.wait().unwrap();
        self.reader.take().unwrap().join().unwrap();
        (self.said.lock().unwrap().clone(), status.success())
    }
}

impl Drop for Watcher {
    fn drop(&mut self) {
        // The process may already have ended.
        let _ = self.process.kill();
        let _ = self.process.wait();
    }
}

/// All files below a directory, by their paths in it.
fn files(directory: &Path) -> Vec<(PathBuf, Vec<u8>)> {
    let mut found = Vec::new();
    let mut to_do = vec![directory.to_path_buf()];
    while let Some(next) = to_do.pop() {
        for entry in std::fs::read_dir(next).unwrap() {
            let path = entry.unwrap().path();
            if path.is_dir() {
                to_do.push(path);
            } else {
                found.push((path.strip_prefix(directory).unwrap().to_owned(), std::fs::read(path).unwrap()));
            }
        }
    }
    found.sort();
    found
}

#[test]
fn runs_are_taken_in_as_they_come() {
    let directory = tempfile::tempdir().unwrap();
    let at = |name: &str| directory.path().join(name);
    let runs = runs(directory.path());
    std::fs::create_dir(at("inbox")).unwrap();
    let list: String = (0..PHASES).map(|phase| format!("{phase}\n")).collect();
    std::fs::write(at("phases.txt"), list).unwrap();
    let (frames, phases, phase_list) = (format!("1-{PHASES}"), PHASES.to_string(), at("phases.txt"));
    let reading = ["--phases", &phases, "--frames", &frames, "--phase-list", text(&phase_list)];
    // The result is to be that of `train` with one fit to views as they are calibrated.
    let short = ["train.iterations=40", "gaussians.iterations=30", "calibrate.adjust=off", "gaussians.fits=1"]
        .map(|setting| ["--set", setting])
        .concat();
    let (inbox, run) = (at("inbox"), at("run"));
    let mut watcher =
        Watcher::new(&[&[text(&inbox), "-o", text(&run), "--until-idle", "4"], &reading[..], &short[..]].concat());
    assert_eq!((watcher.about()["live"].as_bool(), watcher.about()["runs"].as_u64()), (Some(true), Some(0)));
    let early =
        watcher.ask("/frame?primary=0&secondary=0&phase=0&component=dynamic&projection=drr&size=64&low=0&high=1&");
    assert!(early.0.contains(" 503 "), "{}", early.0);

    // An incomplete file is named, and imported once it is complete.
    let whole = std::fs::read(&runs[0]).unwrap();
    std::fs::write(inbox.join("view0.dcm"), &whole[..whole.len() / 2]).unwrap();
    watcher.hear("not imported: ");
    std::fs::write(inbox.join("view0.dcm"), &whole).unwrap();
    watcher.hear("imported: view0 (");
    std::fs::write(inbox.join("broken.dcm"), [7u8; 400]).unwrap();
    dicom::angiogram(&inbox.join("scan.dcm"), |o| {
        o.put(DataElement::new(tags::MODALITY, VR::CS, PrimitiveValue::from("CT")));
    });
    std::fs::copy(&runs[1], inbox.join("view1.dcm")).unwrap();
    watcher.hear("imported: view1 (");
    std::fs::copy(&runs[1], inbox.join("again.dcm")).unwrap();
    watcher.hear("again.dcm");
    // Two views are enough to start.
    let picture = loop {
        let query = "primary=10&secondary=5&phase=1&component=dynamic&projection=drr&size=64&low=0&high=1";
        let (status, body) = watcher.ask(&format!("/frame?{query}&"));
        if status.contains(" 200 ") {
            break body;
        }
        assert!(status.contains(" 503 "), "{status}: {}", String::from_utf8_lossy(&body));
        std::thread::sleep(Duration::from_millis(100));
    };
    assert_eq!(image::load_from_memory(&picture).unwrap().width(), 64);
    std::fs::copy(&runs[2], inbox.join("view2.dcm")).unwrap();
    watcher.hear("imported: view2 (");
    assert_eq!(watcher.about()["runs"].as_u64(), Some(3));
    let (said, well) = watcher.end();
    assert!(well, "{said}");
    for (part, times) in [
        ("not imported: ", 4),
        ("broken.dcm", 1),
        ("scan.dcm", 1),
        ("Modality", 1),
        ("again.dcm: SOPInstanceUID: is the same as that of view1", 1),
        ("), 6 frames, phases 0 1 2 3 4 5\n", 3),
    ] {
        assert_eq!(said.matches(part).count(), times, "`{part}` in {said}");
    }

    // The remaining files equal those of import and training.
    let imported = at("imported");
    let taken: Vec<&str> = runs.iter().map(|run| text(run)).collect();
    ok(&[&["import", "dicom"], &taken[..], &["-o", text(&imported)], &reading[..]].concat());
    assert_eq!(files(&run.join("data")), files(&imported));
    let trained = at("trained");
    ok(&[&["train", text(&imported), "-o", text(&trained)], &short[..]].concat());
    for name in ["config.toml", "calibration.json", "checkpoint-0000040.safetensors", "report.html"] {
        assert!(run.join(name).is_file() && trained.join(name).is_file(), "{name}");
    }
    let same = |name: &str| std::fs::read(run.join(name)).unwrap() == std::fs::read(trained.join(name)).unwrap();
    assert!(same("config.toml") && same("calibration.json"));
    ok(&["info", text(&run)]);
    ok(&["render", text(&run), "-o", text(&at("view.png"))]);
}

#[test]
fn a_folder_without_runs_leaves_nothing() {
    let directory = tempfile::tempdir().unwrap();
    let (inbox, run) = (directory.path().join("inbox"), directory.path().join("run"));
    let refused = program().args(["watch", text(&inbox), "-o", text(&run)]).output().unwrap();
    assert_eq!(refused.status.code(), Some(1));
    assert!(String::from_utf8_lossy(&refused.stderr).contains("inbox"));
    std::fs::create_dir(&inbox).unwrap();
    let mut watcher = Watcher::new(&[text(&inbox), "-o", text(&run)]);
    watcher.hear("watching ");
    watcher.interrupt();
    let (said, well) = watcher.end();
    assert!(!well && said.contains("nothing was reconstructed"), "{said}");
    assert!(!run.exists());
}

#[test]
fn a_run_directory_that_another_process_trains_into_is_refused() {
    let directory = tempfile::tempdir().unwrap();
    let (inbox, run) = (directory.path().join("inbox"), directory.path().join("run"));
    std::fs::create_dir(&inbox).unwrap();
    let mut first = Watcher::new(&[text(&inbox), "-o", text(&run)]);
    first.hear("watching ");
    let second = program().args(["watch", text(&inbox), "-o", text(&run)]).output().unwrap();
    let told = String::from_utf8_lossy(&second.stderr);
    assert_eq!(second.status.code(), Some(75), "{told}");
    assert!(told.contains("another process trains into this run directory"), "{told}");
    first.interrupt();
    assert!(!first.end().1);
    assert!(!run.exists(), "nothing was reconstructed");
}

/// Starts with two runs, adds a third once training satisfies `far`, and sends Ctrl-C. The result continues with `train
/// --resume`. Returns the messages, and the number of remaining runs.
fn interrupted_after_a_third_run(iterations: u32, far: impl Fn(&Value) -> bool) -> (String, usize) {
    let directory = tempfile::tempdir().unwrap();
    let at = |name: &str| directory.path().join(name);
    let (runs, inbox, run) = (runs(directory.path()), at("inbox"), at("run"));
    std::fs::create_dir(&inbox).unwrap();
    let list: String = (0..PHASES).map(|phase| format!("{phase}\n")).collect();
    std::fs::write(at("phases.txt"), list).unwrap();
    let (frames, phases, phase_list) = (format!("1-{PHASES}"), PHASES.to_string(), at("phases.txt"));
    let (whole, fit) =
        (format!("train.iterations={iterations}"), format!("gaussians.iterations={}", iterations / 4 * 3));
    let mut watcher = Watcher::new(&[
        text(&inbox),
        "-o",
        text(&run),
        "--phases",
        &phases,
        "--frames",
        &frames,
        "--phase-list",
        text(&phase_list),
        "--set",
        &whole,
        "--set",
        &fit,
    ]);
    for (view, file) in runs.iter().take(2).enumerate() {
        std::fs::copy(file, inbox.join(format!("view{view}.dcm"))).unwrap();
        watcher.hear(&format!("imported: view{view} ("));
    }
    watcher.reach(far);
    std::fs::copy(&runs[2], inbox.join("view2.dcm")).unwrap();
    watcher.hear("imported: view2 (");
    watcher.interrupt();
    let (said, well) = watcher.end();
    assert!(well, "{said}");
    let (saved, data) = (nertca_vk::checkpoint::list(&run).unwrap(), run.join("data"));
    let (next, left) = ((saved[0].0 + 1).to_string(), Dataset::open(&data).unwrap().training_views().len());
    ok(&["train", text(&data), "-o", text(&run), "--resume", "--stop-at", &next, "--no-eval"]);
    let refused = program().args(["watch", text(&inbox), "-o", text(&run)]).output().unwrap();
    let why = String::from_utf8_lossy(&refused.stderr).into_owned();
    assert!(!refused.status.success() && why.contains("--out") && why.contains("checkpoint-"), "{why}");
    (said, left)
}

#[test]
#[ignore = "long: tools/test --all"]
fn what_was_trained_stays_until_training_with_a_later_run_has_come_as_far() {
    let (said, left) = interrupted_after_a_third_run(400, |about| about["state"] == "trained");
    assert_eq!(left, 2, "{said}");
    assert!(said.contains("made from the first 2 of 3 runs"), "{said}");
}

#[test]
fn what_is_left_is_of_the_runs_that_were_trained_on() {
    let (said, left) = interrupted_after_a_third_run(4000, |about| about["runs"] == 2);
    assert_eq!(said.contains("made from the first 2 of 3 runs"), left == 2, "{said}");
}
