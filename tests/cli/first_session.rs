//! A first session: help, defaults, directories, files and streams that behave as users expect.

use crate::interfaces::{SHORT, fails, ok, phantom, text};
use crate::program::program;

#[test]
fn a_first_session_needs_no_manual() {
    let directory = tempfile::tempdir().unwrap();
    let shown = |args: &[&str]| {
        let out = program().args(args).current_dir(&directory).output().unwrap();
        let said = [out.stdout, out.stderr].map(|bytes| String::from_utf8(bytes).unwrap());
        (out.status.code(), said.concat())
    };
    let (code, help) = shown(&[]);
    assert_eq!(code, Some(2));
    assert_eq!(shown(&["--help"]), (Some(0), help.clone()));
    assert!(help.starts_with("4D reconstruction") && shown(&["--version"]).1.starts_with("nertca-vk "), "{help}");
    // The first steps are those that follow, in a smaller size.
    let steps = help.split("First steps:").nth(1).unwrap();
    for step in ["nertca-vk phantom heart ", "nertca-vk train heart ", "nertca-vk view heart-run "] {
        assert!(steps.contains(step), "{steps}");
    }
    assert_eq!(shown(&["phantom", "heart", "--size", "32", "--phases", "3"]).0, Some(0));
    let settings =
        ["--set", "train.iterations=12", "--set", "gaussians.iterations=10", "--set", "march.render_samples=24"];
    let (code, said) = shown(&[&["train", "heart"], &settings[..]].concat());
    assert_eq!(code, Some(0), "{said}");
    let last: Vec<&str> =
        said.lines().filter(|line| line.starts_with("report: ") || line.starts_with("next: ")).collect();
    assert_eq!(last.len(), 2, "{said}");
    assert!(last[0].ends_with("heart-run/report.html") && last[1].starts_with("next: nertca-vk view \"heart-run\""));
    assert!(said.contains("Dice") && directory.path().join("heart-run/report.html").is_file(), "{said}");
    // A second run does not replace the first.
    assert_eq!(shown(&["train", "heart"]).0, Some(2));
}

#[test]
#[cfg(unix)]
fn errors_of_standard_output_fail_and_closed_pipes_do_not() {
    let full = std::fs::File::options().write(true).open("/dev/full").unwrap();
    for args in [
        &["info", "--schema"][..],
        &["completions", "bash"],
        &["train", "--print-config"],
        &["--help"],
        &["next", "--help"],
        &["--version"],
    ] {
        let out = program().args(args).stdout(full.try_clone().unwrap()).output().unwrap();
        let stderr = String::from_utf8_lossy(&out.stderr);
        assert_eq!(out.status.code(), Some(1), "{args:?}: {stderr}");
        assert!(stderr.contains("standard output") && stderr.contains("No space left"), "{stderr}");
        let mut piped = program();
        piped.args(args).stdout(std::process::Stdio::piped()).stderr(std::process::Stdio::piped());
        let mut child = piped.spawn().unwrap();
        drop(child.stdout.take());
        let out = child.wait_with_output().unwrap();
        assert!(out.status.success() && out.stderr.is_empty(), "{args:?}: {}", String::from_utf8_lossy(&out.stderr));
    }
}

#[test]
#[cfg(unix)]
fn the_umask_decides_who_may_read_files() {
    use std::os::unix::fs::PermissionsExt;
    let directory = tempfile::tempdir().unwrap();
    for (umask, mode) in [("077", 0o600), ("002", 0o664), ("022", 0o644)] {
        let mut shell = std::process::Command::new("sh");
        let phantom = "umask $1; exec \"$2\" phantom $1 --size 16 --phases 3 --no-volumes";
        shell.args(["-c", phantom, "sh", umask]).arg(program().get_program()).current_dir(&directory);
        assert!(shell.output().unwrap().status.success(), "{umask}");
        let meta = std::fs::metadata(directory.path().join(umask).join("dataset.json")).unwrap();
        assert_eq!(meta.permissions().mode() & 0o777, mode, "{umask}");
    }
}

#[test]
fn two_trainings_do_not_mix_in_one_directory() {
    let directory = tempfile::tempdir().unwrap();
    let data = phantom(directory.path(), &[]);
    let run = directory.path().join("run");
    let train = ["train", text(&data), "-o", text(&run)];
    let settings = [SHORT, &["--set", "train.iterations=100000", "--set", "train.validate_every=0"]].concat();
    let mut first = program();
    first.args([&train[..], &["--json"], &settings].concat()).stdout(std::process::Stdio::piped());
    let mut first = first.spawn().unwrap();
    // It has begun when it reports something.
    let mut line = String::new();
    let mut said = std::io::BufReader::new(first.stdout.take().unwrap());
    std::io::BufRead::read_line(&mut said, &mut line).unwrap();
    for more in [&["--force"][..], &["--resume"]] {
        fails(&[&train[..], more].concat(), 75, &["another process trains", text(&run)]);
    }
    first.kill().unwrap();
    first.wait().unwrap();
    // The lock ends with its process.
    ok(&[&train[..], &["--force", "--no-eval"], SHORT].concat());
}
