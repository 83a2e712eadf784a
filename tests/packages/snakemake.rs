//! Studies as jobs of Snakemake: the table is the same, also after Snakemake and its jobs were killed.

use crate::program::program;
use crate::python::python;
use std::collections::BTreeMap;
use std::os::unix::process::CommandExt;
use std::path::Path;
use std::process::Command;
use std::time::Duration;

const STUDIES: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../../studies");

/// Command that runs Snakemake on the smoke study, with its files in a directory.
fn snakemake(directory: &Path, more: &[&str]) -> Command {
    let mut command = python();
    command.args(["-m", "snakemake", "--snakefile"]).arg(format!("{STUDIES}/Snakefile")).args(more);
    command.args(["--config", &format!("study={STUDIES}/smoke.toml"), "out=out"]);
    command.arg(concat!("program=", env!("CARGO_BIN_EXE_nertca-vk")));
    // The directory also holds Snakemake's own notes and the program's caches.
    command.current_dir(directory).env("XDG_CACHE_HOME", directory.join("cache")).env_remove("NERTCA_DATA");
    command
}

const HERE: [&str; 4] = ["--cores", "2", "--resources", "gpu=1"];

fn results(out: &Path) -> BTreeMap<String, Vec<u8>> {
    let runs = std::fs::read_dir(out.join("runs")).into_iter().flatten().map(|run| run.unwrap());
    let read = runs.filter_map(|run| Some((run.file_name(), std::fs::read(run.path().join("result.json")).ok()?)));
    read.map(|(name, bytes)| (name.into_string().unwrap(), bytes)).collect()
}

/// Table rows without seconds and values derived from them.
fn timeless(out: &Path) -> Vec<String> {
    let csv = std::fs::read_to_string(out.join("table.csv")).unwrap();
    let timed = |line: &str| line.contains(",minutes,") || line.contains(",fps,");
    csv.lines().filter(|line| !timed(line)).map(str::to_owned).collect()
}

#[track_caller]
fn ok(command: &mut Command) -> String {
    let out = command.output().unwrap();
    assert!(out.status.success(), "{command:?}: {}", String::from_utf8_lossy(&out.stderr));
    // Snakemake reports its actions on stderr.
    String::from_utf8_lossy(&[out.stdout, out.stderr].concat()).into_owned()
}

#[test]
#[ignore = "minutes beside what tools/test may take: tools/test --packages"]
fn a_killed_study_comes_to_the_same_table() {
    let directory = tempfile::tempdir().unwrap();
    let (alone, out) = (directory.path().join("alone"), directory.path().join("out"));
    for what in ["run", "table"] {
        ok(program().args(["study", what]).arg(format!("{STUDIES}/smoke.toml")).arg("--out").arg(&alone));
    }
    // The process group is separate, so that jobs are killed together with Snakemake.
    let mut killed = snakemake(directory.path(), &HERE).process_group(0).spawn().unwrap();
    let done = loop {
        let done = results(&out);
        assert!(
            killed.try_wait().unwrap().is_none(),
            "it ended before it could be killed, with {} results",
            done.len()
        );
        if done.len() >= 2 {
            break done;
        }
        std::thread::sleep(Duration::from_millis(20));
    };
    assert!(Command::new("kill").args(["-KILL", "--", &format!("-{}", killed.id())]).status().unwrap().success());
    killed.wait().unwrap();
    assert!(!out.join("table.csv").exists());
    ok(&mut snakemake(directory.path(), &["--unlock"]));
    ok(&mut snakemake(directory.path(), &[&HERE[..], &["--rerun-incomplete"]].concat()));
    let again = done.iter().filter(|(run, bytes)| results(&out)[*run] != **bytes).count();
    assert!(again <= 1, "{again} runs were done again; one may have had its result and not been noted yet");
    assert_eq!(timeless(&out), timeless(&alone));
    assert!(out.join("report.html").is_file());
    assert!(ok(&mut snakemake(directory.path(), &HERE)).contains("Nothing to be done"));
}

#[test]
#[ignore = "minutes beside what tools/test may take: tools/test --packages"]
fn a_cluster_would_get_the_jobs() {
    let directory = tempfile::tempdir().unwrap();
    let profile = format!("{STUDIES}/slurm");
    let told = ok(&mut snakemake(directory.path(), &["--profile", &profile, "--dry-run", "--printshellcmds"]));
    for run in ["xcat-3v.paper.s1", "xcat-4v.fast.s2"] {
        assert!(told.contains(&format!("study one {STUDIES}/smoke.toml {run} -o out")), "{run}: {told}");
    }
    assert_eq!(told.matches("rule run:").count(), 24, "{told}");
    assert_eq!(told.matches("Group job runs").count(), 6, "four runs make a job: {told}");
    assert!(told.contains("gpu=1") && told.contains("runtime=240"), "{told}");
}
