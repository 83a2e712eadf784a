//! Run directories that were interrupted, damaged or starved: what `train` says and leaves.

use crate::known_tree::{nertca, ok, text};
use crate::program::program;
use serde_json::Value;
use std::path::{Path, PathBuf};
use std::process::Command;

const SHORT: [&str; 6] =
    ["--no-eval", "--iterations", "30", "--set", "gaussians.iterations=10", "--set=train.checkpoint_every=10"];

fn small_phantom(directory: &Path, more: &[&str]) -> PathBuf {
    let data = directory.join("data");
    ok(&[&["phantom", text(&data), "--size", "40", "--phases", "4", "--no-volumes"], more].concat());
    data
}

fn checkpoints(run: &Path) -> Vec<PathBuf> {
    let files = std::fs::read_dir(run).unwrap().map(|entry| entry.unwrap().path());
    let mut all: Vec<PathBuf> = files.filter(|file| file.extension().is_some_and(|e| e == "safetensors")).collect();
    all.sort();
    all
}

#[test]
fn interrupted_and_damaged_runs_go_on() {
    let directory = tempfile::tempdir().unwrap();
    let (data, run) = (small_phantom(directory.path(), &[]), directory.path().join("run"));
    let train = ["train", text(&data), "-o", text(&run)];
    ok(&[&train[..], &SHORT].concat());
    let [first, second, last] = &checkpoints(&run)[..] else { panic!("three checkpoints") };
    let whole = std::fs::read(last).unwrap();

    // A broken checkpoint is refused with the name of the newest one that can be read.
    std::fs::write(last, &whole[..whole.len() / 2]).unwrap();
    std::fs::write(second, b"nothing").unwrap();
    let answer = nertca(&[&train[..], &["--resume"]].concat());
    let said = String::from_utf8_lossy(&answer.stderr).into_owned();
    assert_eq!(answer.status.code(), Some(1), "{said}");
    let names = [last, first].map(|file| file.file_name().unwrap().to_str().unwrap().to_owned());
    names.iter().for_each(|name| assert!(said.contains(name.as_str()), "{name}: {said}"));
    assert!(said.contains("intact") && said.contains("remove"), "{said}");
    // Doing what it says continues the run to the same end.
    [last, second].iter().for_each(|file| std::fs::remove_file(file).unwrap());
    ok(&["train", "-o", text(&run), "--resume", "--no-eval"]);
    assert!(std::fs::read(last).unwrap() == whole, "the resumed run ends with the same bytes");

    // Killed before its first checkpoint, a run starts over with its own configuration, and says so.
    checkpoints(&run).iter().for_each(|file| std::fs::remove_file(file).unwrap());
    let (_, said) = ok(&[&train[..], &["--resume", "--no-eval"]].concat());
    assert!(said.contains("no checkpoint yet") && said.contains("starts over"), "{said}");
    assert!(std::fs::read(last).unwrap() == whole, "the same run again");
}

#[test]
#[cfg(target_os = "linux")]
fn memory_that_cannot_be_had_may_be_had_later() {
    let directory = tempfile::tempdir().unwrap();
    let data = small_phantom(directory.path(), &[]);
    // Kilobytes of address space.
    for limit in ["450000", "600000", "700000", "900000"] {
        let run = directory.path().join(limit);
        let program = program();
        let mut limited = Command::new("sh");
        limited.envs(program.get_envs().filter_map(|(key, value)| Some((key, value?))));
        let script = format!("ulimit -v {limit}; exec \"$@\"");
        limited.args(["-c", &script, "sh"]).arg(program.get_program()).args(program.get_args());
        let answer = limited.args(["train", text(&data), "-o", text(&run)]).args(SHORT).output().unwrap();
        let said = String::from_utf8_lossy(&answer.stderr).into_owned();
        assert_eq!(answer.status.code(), Some(75), "{limit}: {said}");
        assert!(said.contains("out of memory"), "{limit}: {said}");
    }
}

/// Turns all training images of the view by which frames after the first view are taken.
fn turn_other_views(data: &Path) {
    let manifest: Value = serde_json::from_slice(&std::fs::read(data.join("dataset.json")).unwrap()).unwrap();
    let frames = manifest["frames"].as_array().unwrap().iter().filter(|frame| frame["split"] == "train");
    let first = &manifest["frames"][0]["geometry"];
    for frame in frames.filter(|frame| &frame["geometry"] != first) {
        let file = data.join(frame["image"].as_str().unwrap());
        let mut bytes = std::fs::read(&file).unwrap();
        // Pixels of four bytes follow the header: their order is reversed, and the halves of the rows are exchanged.
        let start = bytes.len() - 4 * 40 * 40;
        let pixels: Vec<[u8; 4]> = bytes[start..].as_chunks::<4>().0.to_vec();
        for (place, pixel) in bytes[start..].chunks_mut(4).zip((0..40 * 40).map(|p| {
            let (row, column) = (p / 40, p % 40);
            pixels[(39 - column) * 40 + (row + 20) % 40]
        })) {
            place.copy_from_slice(&pixel);
        }
        std::fs::write(&file, bytes).unwrap();
    }
}

#[test]
fn train_says_whether_the_views_agree() {
    for (turned, verdict, conclusion) in [
        (false, "agree", "the views show the same object"),
        (true, "disagree", "the views do not show the same object"),
    ] {
        let directory = tempfile::tempdir().unwrap();
        let data = small_phantom(directory.path(), &["--angles", "-30,30;60,-30", "--test-angles", "none"]);
        if turned {
            turn_other_views(&data);
        }
        let run = directory.path().join("run");
        // What is told of the views is found before they are adjusted, and before any fit.
        let one_fit = ["--set", "calibrate.adjust=off", "--set", "gaussians.fits=1"];
        let train = [&["train", text(&data), "-o", text(&run)], &SHORT[..], &one_fit].concat();
        let (stdout, _) = ok(&[&train[..], &["--json"]].concat());
        let events: Vec<Value> = stdout.lines().map(|line| serde_json::from_str(line).unwrap()).collect();
        let checked = events.iter().find(|event| event["event"] == "checked").expect("an event");
        assert_eq!((&checked["verdict"], &checked["conclusion"]), (&verdict.into(), &conclusion.into()), "{checked}");
        assert!(checked["agreement"]["coarse"].is_number() && checked["explained"][1].is_number(), "{checked}");
        let page = std::fs::read_to_string(run.join("report.html")).unwrap();
        assert!(page.contains(conclusion) && page.contains("by chance") && page.contains("degrees apart"));
        assert_eq!(page.contains("Check the data"), turned);
        let (_, said) = ok(&[&train[..], &["--force"]].concat());
        let line = if turned { format!("warning: {conclusion}") } else { format!("- {conclusion}") };
        assert!(said.lines().any(|said| said == line), "{said}");
        assert!(said.contains("warning: only two views show what moves, 0 and 1, "), "{said}");
    }
}

#[test]
fn a_refused_command_leaves_what_it_was_given_as_it_was() {
    let directory = tempfile::tempdir().unwrap();
    let (data, run) = (small_phantom(directory.path(), &[]), directory.path().join("run"));
    ok(&[&["train", text(&data), "-o", text(&run)], &SHORT[..]].concat());
    let other = small_phantom(&directory.path().join("other"), &["--seed", "2"]);
    let files = |of: &Path| -> Vec<(PathBuf, Vec<u8>)> {
        let mut all: Vec<PathBuf> = std::fs::read_dir(of).unwrap().map(|entry| entry.unwrap().path()).collect();
        all.retain(|file| file.is_file());
        all.sort();
        all.into_iter().map(|file| (file.clone(), std::fs::read(&file).unwrap())).collect()
    };
    let refused = |args: &[&str], of: &Path, reason: &str| {
        let before = files(of);
        let answer = nertca(args);
        let said = String::from_utf8_lossy(&answer.stderr).into_owned();
        assert!(!answer.status.success() && said.contains(reason), "{args:?}: {said}");
        assert!(files(of) == before, "{args:?} changed {}", of.display());
    };
    refused(&["train", text(&other), "-o", text(&run), "--resume"], &run, "dataset");
    refused(&["train", text(&data), "-o", text(&data)], &data, "is the directory of a dataset");
    refused(&["train", text(&data), "-o", text(&run), "--force", "--stop-at", "0"], &run, "--stop-at");
}

#[test]
fn iterations_without_effect_on_the_vessels_are_told() {
    let directory = tempfile::tempdir().unwrap();
    let (data, run) = (small_phantom(directory.path(), &[]), directory.path().join("run"));
    let (_, said) = ok(&["train", text(&data), "-o", text(&run), "--no-eval", "--iterations", "301", "--stop-at", "1"]);
    assert!(said.contains("first 120 of the 301 iterations") && said.contains("gaussians.iterations"), "{said}");
}
