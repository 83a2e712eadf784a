//! `tools/gpu-campaign` as far as it can be tested without a GPU: its first part, in the smallest size.

use crate::selftest::of_all_stages;
use serde_json::Value;
use std::os::unix::fs::PermissionsExt;
use std::path::Path;
use std::process::{Command, Output};

fn campaign(program: &str, out: &Path, more: &[&str]) -> Output {
    let script = crate::root::root().join("tools/gpu-campaign");
    let mut command = Command::new("python3");
    command.arg(script).arg(program).arg("-o").arg(out).args(["--rehearse", "--part", "1"]).args(more);
    command.output().unwrap()
}

fn write_program(file: &Path, text: &str) {
    std::fs::write(file, text).unwrap();
    std::fs::set_permissions(file, std::fs::Permissions::from_mode(0o755)).unwrap();
}

fn part(out: &Path) -> Value {
    serde_json::from_slice(&std::fs::read(out.join("part1.json")).unwrap()).unwrap()
}

#[test]
#[ignore = "long: tools/test --all"]
fn a_campaign_keeps_each_step_and_goes_on() {
    let dir = tempfile::tempdir().unwrap();
    // This program has the output of the self-test, so that it is not run again, and does everything else as ours.
    let (program, printed, out) =
        (dir.path().join("program"), dir.path().join("selftest.json"), dir.path().join("campaign"));
    std::fs::write(&printed, of_all_stages()).unwrap();
    let text = format!(
        "#!/bin/sh\ncase $1 in selftest) exec cat '{}';; *) exec '{}' \"$@\";; esac\n",
        printed.display(),
        env!("CARGO_BIN_EXE_nertca-vk")
    );
    write_program(&program, &text);
    let program = program.to_str().unwrap();
    // With no time, nothing is started, and the program reports that parts remain.
    let none = campaign(program, &out, &["--minutes", "0"]);
    assert_eq!(none.status.code(), Some(75), "{}", String::from_utf8_lossy(&none.stderr));
    assert!(!out.join("part1.json").exists());

    let done = campaign(program, &out, &[]);
    assert_eq!(done.status.code(), Some(0), "{}", String::from_utf8_lossy(&done.stderr));
    let steps = part(&out);
    assert_eq!(steps["selftest"]["result"]["ok"], true);
    for name in ["paper repeats", "paper repeats in f32", "fast repeats"] {
        assert_eq!(steps[name]["result"]["same"], true, "{name}");
        assert_eq!(steps[name]["result"]["iterations"], 4, "{name}");
    }
    for preset in ["paper", "public-code", "fast-mlp", "fast", "nerf-ca"] {
        let done = &steps[format!("schedule of {preset}")]["result"];
        assert!(!done["events"].as_array().unwrap().is_empty(), "{preset}: {done}");
    }
    let page = std::fs::read_to_string(out.join("campaign.md")).unwrap();
    assert!(page.contains("| fast repeats, bit by bit | yes, 4 iterations |") && page.contains("rehearsal"), "{page}");
    assert!(page.contains("| `paper` | not run |"), "other parts were not asked for: {page}");

    // Existing results are kept, missing ones are computed.
    let mut fewer = steps.clone();
    fewer.as_object_mut().unwrap().remove("devices");
    std::fs::write(out.join("part1.json"), fewer.to_string()).unwrap();
    let again = String::from_utf8(campaign(program, &out, &[]).stdout).unwrap();
    assert!(again.contains("part 1: devices") && !again.contains("part 1: selftest"), "{again}");
    // Results of a different program are not continued.
    let mut of: Value = serde_json::from_slice(&std::fs::read(out.join("of.json")).unwrap()).unwrap();
    of["rehearsal"] = false.into();
    std::fs::write(out.join("of.json"), of.to_string()).unwrap();
    let refused = campaign(program, &out, &[]);
    assert_eq!(refused.status.code(), Some(1));
    assert!(String::from_utf8_lossy(&refused.stderr).contains("choose another directory"));
    let files = std::fs::read_dir(&out).unwrap().count();
    assert!(files <= 8, "{files} files come back");
}

#[test]
fn steps_that_fail_are_rows_that_say_why() {
    let dir = tempfile::tempdir().unwrap();
    // The program lists devices and prints its version, and fails at everything else.
    let program = dir.path().join("program");
    let text =
        "#!/bin/sh\ncase $1 in devices) echo '[]';; --version) echo 1;; *) echo no such stage >&2; exit 3;; esac\n";
    write_program(&program, text);
    let failed = campaign(program.to_str().unwrap(), dir.path(), &[]);
    assert_eq!(failed.status.code(), Some(1));
    assert_eq!(part(dir.path())["selftest"]["failure"], "exit code 3: no such stage");
    assert!(String::from_utf8_lossy(&failed.stdout).contains("| `selftest` | exit code 3: no such stage |"));
}
