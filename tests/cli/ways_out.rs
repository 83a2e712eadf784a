//! Directories and files that commands write: what is there already, links, limits of the system, signals.

use crate::dicom::angiogram;
use crate::interfaces::{SHORT, fails, ok, phantom, text};
use crate::program::program;
use nertca_vk::formats::npy;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// All files below a directory, with their content.
fn content(directory: &Path) -> BTreeMap<PathBuf, Vec<u8>> {
    let (mut found, mut open) = (BTreeMap::new(), vec![directory.to_path_buf()]);
    while let Some(folder) = open.pop() {
        for entry in std::fs::read_dir(folder).unwrap() {
            let path = entry.unwrap().path();
            if path.is_dir() {
                open.push(path);
            } else {
                let name = path.strip_prefix(directory).unwrap().to_path_buf();
                found.insert(name, std::fs::read(&path).unwrap());
            }
        }
    }
    found
}

/// Checks that a command refuses a directory with another dataset, and replaces it on demand: nothing of the old one remains,
/// and files of the user stay.
fn replaces(out: &Path, command: &[&str]) {
    let before = content(out);
    let to = |directory: &Path, more: &[&str]| -> Vec<String> {
        let mut args: Vec<String> = command.iter().map(|arg| arg.replace("OUT", text(directory))).collect();
        args.extend(more.iter().map(|arg| (*arg).to_owned()));
        args
    };
    let refused = to(out, &[]);
    fails(&refused.iter().map(String::as_str).collect::<Vec<_>>(), 2, &["already contains a dataset", "--force"]);
    assert_eq!(content(out), before, "{command:?} has changed something");
    let fresh = tempfile::tempdir().unwrap();
    let fresh = fresh.path().join("fresh");
    for (directory, more) in [(fresh.as_path(), &[][..]), (out, &["--force"])] {
        let args = to(directory, more);
        ok(&args.iter().map(String::as_str).collect::<Vec<_>>());
    }
    let mut after = content(out);
    for mine in ["notes.txt", "images/mine.png"] {
        assert!(after.remove(Path::new(mine)).is_some(), "{command:?} has removed {mine}");
    }
    let (after, wanted) = (after.keys().collect::<Vec<_>>(), content(&fresh));
    assert_eq!(after, wanted.keys().collect::<Vec<_>>(), "{command:?}");
    assert_eq!(std::fs::read(out.join("dataset.json")).ok(), std::fs::read(fresh.join("dataset.json")).ok());
}

#[test]
fn directories_are_replaced_on_demand_alone() {
    let directory = tempfile::tempdir().unwrap();
    let to = |name: &str| directory.path().join(name);
    let (out, source, run, volume) = (to("out"), to("source"), to("run.dcm"), to("volume.npy"));
    let size = ["--size", "24", "--views", "3"];
    ok(&[&["phantom", text(&source), "--phases", "2", "--no-volumes"], &size[..]].concat());
    angiogram(&run, |_| ());
    npy::write(&volume, &[16, 16, 16], &[0.02; 4096]).unwrap();
    // An older dataset with more phases, volumes and a truth.
    ok(&[&["phantom", text(&out), "--phases", "4"], &size[..]].concat());
    std::fs::write(out.join("notes.txt"), "mine").unwrap();
    std::fs::write(out.join("images/mine.png"), "mine").unwrap();
    replaces(&out, &[&["phantom", "OUT", "--phases", "3", "--no-volumes"], &size[..]].concat());
    replaces(&out, &["import", "dicom", text(&run), "-o", "OUT", "--still"]);
    replaces(&out, &["import", "dicom", text(&run), "-o", "OUT", "--heart-rate", "100", "--phases", "6"]);
    replaces(&out, &["convert", text(&source), "--layout", "nerfca", "-o", "OUT"]);
    replaces(&out, &["convert", text(&source), "--layout", "native", "-o", "OUT"]);
    let projected = ["project", text(&volume), text(&volume), "--spacing", "4,4,4", "-o", "OUT", "--fov", "80"];
    replaces(&out, &[&projected[..], &size].concat());
    replaces(&out, &["calibrate", text(&source), "-o", "OUT", "--mode", "off"]);
    // A command that fails leaves the old dataset as it is.
    let before = content(&out);
    fails(&["import", "dicom", text(&volume), "-o", text(&out), "--still", "--force"], 1, &["volume.npy"]);
    assert_eq!(content(&out), before);
    // Lists of other origin would be read as part of the new dataset.
    std::fs::write(out.join("train-7.json"), "{}").unwrap();
    fails(&["convert", text(&source), "--layout", "nerfca", "-o", text(&out), "--force"], 2, &["train-7.json"]);
    fails(&["phantom", text(&volume), "--size", "24"], 2, &["volume.npy", "is a file"]);
}

#[test]
fn what_a_layout_cannot_hold_is_refused_before_anything_is_written() {
    let directory = tempfile::tempdir().unwrap();
    let to = |name: &str| directory.path().join(name);
    let volume = to("volume.npy");
    npy::write(&volume, &[16, 16, 16], &[0.02; 4096]).unwrap();
    let project = ["project", text(&volume), "--spacing", "4,4,4", "--fov", "80", "--size", "24", "--views", "3"];
    let views = ["--angles", "0,0;90,0", "--test-angles", "none", "--sod", "700,750"];
    let project: Vec<&str> = project.into_iter().filter(|arg| !["--views", "3"].contains(arg)).chain(views).collect();
    let native = to("native");
    ok(&[&project[..], &["-o", text(&native)]].concat());
    let out = to("out");
    for args in [
        &["convert", text(&native), "--layout", "nerfca", "-o", text(&out)][..],
        &[&project[..], &["--layout", "nerfca", "-o", text(&out)]].concat(),
    ] {
        fails(args, 2, &["nerfca", "the same distances"]);
        assert!(!out.exists(), "{args:?} has written something");
    }
}

#[test]
fn files_of_an_earlier_series_do_not_join_a_new_one() {
    let directory = tempfile::tempdir().unwrap();
    let to = |name: &str| directory.path().join(name);
    let data = phantom(directory.path(), &[]);
    let run = to("run");
    ok(&[&["train", text(&data), "-o", text(&run), "--no-eval"], SHORT].concat());
    let export = ["export", text(&run), "--spacing", "20", "-o"];
    let beat = to("beat.vtk");
    ok(&[&export[..], &[text(&beat)]].concat());
    let names = |begin: &str| -> Vec<String> {
        let names = std::fs::read_dir(directory.path()).unwrap().map(|e| e.unwrap().file_name().into_string().unwrap());
        let mut names: Vec<String> = names.filter(|name| name.starts_with(begin)).collect();
        names.sort();
        names
    };
    let series = ["beat_0000.vtk", "beat_0001.vtk", "beat_0002.vtk"];
    assert_eq!(names("beat"), series);
    // Those of a longer beat, of another name and of another kind.
    for other in ["beat_0007.vtk", "beat_mine.vtk", "beat_0007.stl", "beat.vtk"] {
        std::fs::write(to(other), "old").unwrap();
    }
    fails(&[&export[..], &[text(&beat)]].concat(), 2, &["beat_0000.vtk", "--force"]);
    ok(&[&export[..], &[text(&beat), "--force"]].concat());
    let wanted = ["beat.vtk", "beat_0000.vtk", "beat_0001.vtk", "beat_0002.vtk", "beat_0007.stl", "beat_mine.vtk"];
    assert_eq!(names("beat"), wanted);
    // A single file replaces its predecessor.
    ok(&[&export[..], &[text(&beat), "--phase", "1"]].concat());
    assert_ne!(std::fs::read(&beat).unwrap(), b"old");

    let pictures = to("pictures");
    let eval = ["eval", text(&run), "--images", text(&pictures)];
    ok(&eval);
    for other in ["test-view77-phase00.png", "mine.png"] {
        std::fs::write(pictures.join(other), "old").unwrap();
    }
    fails(&eval, 2, &["report.html", "--force"]);
    ok(&[&eval[..], &["--force"]].concat());
    assert!(!pictures.join("test-view77-phase00.png").exists() && pictures.join("mine.png").exists());
    links_stay(&run, directory.path());
    signals_leave_nothing(&run, directory.path());
}

/// An export onto a symbolic link replaces the file behind it.
#[cfg(unix)]
fn links_stay(run: &Path, directory: &Path) {
    let (link, target) = (directory.join("link.npy"), directory.join("target.npy"));
    std::fs::write(&target, "old").unwrap();
    std::os::unix::fs::symlink("target.npy", &link).unwrap();
    ok(&["export", text(run), "--spacing", "20", "-o", text(&link)]);
    assert!(link.is_symlink() && npy::read(&target, 1 << 20).is_ok());
}

#[cfg(not(unix))]
fn links_stay(_: &Path, _: &Path) {}

/// A signal ends an export and removes what it was writing, also while threads of a driver work. Several attempts are made, because
/// such a thread uses what exit handlers free only sometimes.
#[cfg(unix)]
fn signals_leave_nothing(run: &Path, directory: &Path) {
    const ATTEMPTS: usize = 8;
    (0..ATTEMPTS).for_each(|_| a_signal_leaves_nothing(run, directory));
}

#[cfg(unix)]
fn a_signal_leaves_nothing(run: &Path, directory: &Path) {
    let out = directory.join("large");
    let partial = || {
        let listed = std::fs::read_dir(&out).into_iter().flatten().flatten();
        listed.filter(|entry| entry.file_name().to_string_lossy().starts_with(".partial-")).count()
    };
    let mut export = program();
    export.args(["export", text(run), "--spacing", "0.25", "--component", "total", "-o", text(&out.join("beat.nrrd"))]);
    let mut export = export.stderr(std::process::Stdio::null()).spawn().unwrap();
    while partial() == 0 {
        assert!(export.try_wait().unwrap().is_none(), "the export has ended before it could be interrupted");
        std::thread::sleep(std::time::Duration::from_millis(5));
    }
    // SAFETY: the process is a child of this one that has not been waited for, so its number is its own.
    unsafe { libc::kill(export.id() as i32, libc::SIGINT) };
    assert_eq!(export.wait().unwrap().code(), Some(130));
    assert_eq!(partial(), 0, "the partial file is left");
}

#[cfg(not(unix))]
fn signals_leave_nothing(_: &Path, _: &Path) {}

#[cfg(unix)]
#[test]
fn a_limit_of_file_sizes_is_told_and_leaves_nothing() {
    let directory = tempfile::tempdir().unwrap();
    let (source, out) = (directory.path().join("source"), directory.path().join("out"));
    ok(&["phantom", text(&source), "--size", "64", "--phases", "2", "--views", "3", "--no-volumes"]);
    let mut shell = std::process::Command::new("sh");
    // 4 KiB are fewer than an image of 64 x 64 floats needs.
    shell.args(["-c", "ulimit -f 8; exec \"$0\" \"$@\""]).arg(program().get_program());
    let out_of = shell.args(["convert", text(&source), "--layout", "native", "-o", text(&out)]).output().unwrap();
    let said = String::from_utf8_lossy(&out_of.stderr).into_owned();
    assert_eq!(out_of.status.code(), Some(1), "{said}");
    assert!(said.contains("File too large") && said.contains(".npy"), "{said}");
    assert!(
        content(&out).keys().all(|name| !name.to_string_lossy().contains(".partial-")),
        "{:?}",
        content(&out).keys()
    );
}
