//! Studies through the program: refused files, repeated and kept runs, and kills, which change no result.

use crate::program::program;
use nertca_vk::files::Lock;
use nertca_vk::random::uniform01;
use serde_json::Value;
use std::collections::{BTreeMap, BTreeSet};
use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};

const SMOKE: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../../studies/smoke.toml");

fn text(path: &Path) -> &str {
    path.to_str().unwrap()
}

fn study(args: &[&str]) -> Command {
    let mut command = program();
    command.arg("study").args(args).env_remove("NERTCA_DATA");
    command
}

fn output(args: &[&str]) -> Output {
    study(args).output().unwrap()
}

/// Expects success, and returns stdout.
#[track_caller]
fn ok(args: &[&str]) -> String {
    let out = output(args);
    assert!(out.status.success(), "{args:?}: {}", String::from_utf8_lossy(&out.stderr));
    String::from_utf8(out.stdout).unwrap()
}

/// States of the runs in a directory by `study list`, by name.
fn states(file: &Path, directory: &Path) -> BTreeMap<String, String> {
    let listed: Value = serde_json::from_str(&ok(&["list", text(file), "--json", "-o", text(directory)])).unwrap();
    let field = |run: &Value, key: &str| run[key].as_str().unwrap().to_owned();
    listed.as_array().unwrap().iter().map(|run| (field(run, "id"), field(run, "state"))).collect()
}

/// A study of two methods on one tiny phantom; a run takes seconds.
const TINY: &str = r#"title = "tiny"
seeds = [1]
[phantom]
size = 24
phases = 3
views = [3]
[[data]]
name = "a"
[[method]]
name = "m"
preset = "paper"
iterations = 12
set = ["train.rays=64", "train.chunk_samples=16384", "dynamic.width=16", "march.render_samples=32", "dynamic.half_extent_mm=25"]
[[method]]
name = "n"
preset = "paper"
iterations = 12
set = ["train.rays=32", "train.chunk_samples=16384", "dynamic.width=16", "march.render_samples=32", "dynamic.half_extent_mm=25"]
"#;

fn written(directory: &Path, content: &str) -> PathBuf {
    let file = directory.join("study.toml");
    std::fs::write(&file, content).unwrap();
    file
}

#[test]
fn faults_have_their_line() {
    let directory = tempfile::tempdir().unwrap();
    std::fs::create_dir(directory.path().join("there")).unwrap();
    // Text that is replaced in the study, its replacement, and the required parts of the message.
    let cases = [
        ("preset = \"paper\"", "preset = \"papr\"", "line 11", "papr"),
        ("name = \"n\"", "name = \"m\"", "line 15", "another method"),
        ("name = \"a\"", "name = \"a.b\"", "line 8", "a.b"),
        ("name = \"a\"", "name = \"a\"\n[[data]]\nname = \"a\"", "line 10", "another data set"),
        ("\"train.rays=64\"", "\"train.rays=64\", \"train.rays = 65\"", "line 13", "set twice"),
        ("\"train.rays=64\"", "\"seed=3\"", "line 13", "`seeds`"),
        ("iterations = 12", "on = { a = [\"train.rays=65\"] }", "line 12", "set twice"),
        ("iterations = 12", "on = { b = [\"train.chunk_samples=65536\"] }", "line 12", "on.b"),
        ("iterations = 12", "on = { a = [\"train.rayz=64\"] }", "line 12", "train.rayz"),
        ("\"train.rays=64\"", "\"preset=fast\"", "line 13", "`preset`"),
        ("\"train.rays=64\"", "\"train.iterations=64\"", "line 13", "contradicts"),
        ("\"train.rays=64\"", "\"train.rayz=64\"", "line 13", "train.rayz"),
        ("\"train.rays=64\"", "\"train.rays=0\"", "line 13", "train.rays"),
        ("iterations = 12", "iterations = 0", "line 12", "train.iterations"),
        ("iterations = 12", "iteration = 12", "line 12", "iteration"),
        ("name = \"a\"", "name = \"a\"\n[[data]]\nname = \"a-3v\"\ndirectory = \"there\"", "line 10", "a-3v"),
        ("seeds = [1]", "seeds = [1, 2, 1]", "line 2", "1 is given twice"),
        ("seeds = [1]", "seeds = []", "line 2", "at least one"),
        ("name = \"a\"", "name = \"a\"\ndirectory = \"missing\"", "line 9", "missing"),
        ("name = \"a\"", "name = \"a\"\nphantom = {}\ndirectory = \"there\"", "line 9", "cannot be used together"),
        ("name = \"a\"", "name = \"a\"\nphantom = { views = [5] }", "line 9", "3, 4 or 9"),
        ("name = \"a\"", "name = \"a\"\nphantom = { tree = \"tree.json\" }", "line 9", "tree.json"),
        (
            "name = \"a\"",
            "name = \"a\"\nphantom = { photons = 1e5, detector_photons = 1e5 }",
            "line 9",
            "cannot be used together",
        ),
        ("name = \"a\"", "name = \"a\"\nphantom = { breathing = { mm = 3 } }", "line 9", "mm"),
        ("name = \"a\"", "name = \"a\"\nphantom = { collimated_share = 2 }", "line 9", "collimated_share"),
        ("name = \"a\"", "name = \"a\"\nphantom = { volumes = false, volumes_every = 2 }", "line 9", "volumes_every"),
        ("seeds = [1]", "seeds = [1]\npublished = \"values.toml\"", "line 3", "values.toml"),
        ("seeds = [1]", "seeds = [1]\ntable = { columns = [\"views\", \"views\"] }", "line 3", "each once"),
        ("seeds = [1]", "seeds = [1]\ntable = { scores = [\"dicee\"] }", "line 3", "dicee"),
        ("seeds = [1]", "seeds = 1]", "line 2", ""),
    ];
    for (from, to, line, part) in cases {
        let file = written(directory.path(), &TINY.replacen(from, to, 1));
        let out = output(&["list", text(&file)]);
        let message = String::from_utf8_lossy(&out.stderr);
        assert_eq!(out.status.code(), Some(1), "{to}: {message}");
        assert!(message.contains("study.toml") && !message.contains("panicked"), "{to}: {message}");
        assert!(message.contains(&format!("{line}:")) && message.contains(part), "{to} ({line}, {part}): {message}");
    }
    let file = written(directory.path(), TINY);
    assert_eq!(ok(&["list", text(&file)]).lines().collect::<Vec<_>>(), ["a-3v.m.s1", "a-3v.n.s1"]);
    let none = output(&["one", text(&file), "a-3v.m.s2", "-o", text(&directory.path().join("out"))]);
    assert_eq!(none.status.code(), Some(2));
    assert!(String::from_utf8_lossy(&none.stderr).contains("a-3v.m.s1"), "an example is named");
}

#[test]
fn our_studies_can_be_run() {
    let data = tempfile::tempdir().unwrap();
    std::fs::create_dir(data.path().join("anatomy")).unwrap();
    for file in ["anatomy/coronary_tree_hra.json", "anatomy/thorax_ct.nii.gz", "l3.json", "r3.json", "thorax_ct.nii.gz"]
    {
        std::fs::write(data.path().join(file), b"stands in for it").unwrap();
    }
    let studies = Path::new(SMOKE).parent().unwrap();
    let expected = [
        ("smoke", 24),
        ("table1", 198),
        ("scaled-table1", 90),
        ("table2", 30),
        ("scaled-table2", 18),
        ("ablation", 36),
        ("time", 21),
        ("degradations", 204),
        ("rules", 180),
    ];
    for (name, runs) in expected {
        let file = studies.join(name).with_extension("toml");
        let listed = ok(&["list", text(&file), "--data", text(data.path())]);
        let names: BTreeSet<&str> = listed.lines().collect();
        assert_eq!((listed.lines().count(), names.len()), (runs, runs), "{name}");
    }
    let missing = output(&["list", text(&studies.join("degradations.toml"))]);
    let message = String::from_utf8_lossy(&missing.stderr);
    assert!(message.contains("line ") && message.contains("coronary_tree_hra.json"), "{message}");
}

#[test]
#[ignore = "long: tools/test --all"]
fn what_changed_runs_again_and_nothing_else() {
    let directory = tempfile::tempdir().unwrap();
    let (file, out) = (written(directory.path(), TINY), directory.path().join("out"));
    ok(&["--validate", "run", text(&file), "-o", text(&out)]);
    let all = |state: &str| -> Vec<String> {
        states(&file, &out).into_iter().filter(|(_, s)| s == state).map(|(id, _)| id).collect()
    };
    assert_eq!(all("scored"), ["a-3v.m.s1", "a-3v.n.s1"]);
    let result = |id: &str| std::fs::read(out.join("runs").join(id).join("result.json")).unwrap();
    let before = [result("a-3v.m.s1"), result("a-3v.n.s1")];
    let events = ok(&["run", text(&file), "-o", text(&out), "--json"]);
    assert!(events.contains("\"ended\"") && !events.contains("run_begun"), "{events}");
    let changed = TINY.replace("train.rays=32", "train.rays=48");
    written(directory.path(), &changed);
    assert_eq!(all("waiting"), ["a-3v.n.s1"]);
    // Results of the previous version of the study are no results of the current one.
    assert!(ok(&["table", text(&file), "-o", text(&out)]).contains("1 results in this directory"));
    let events = ok(&["run", text(&file), "-o", text(&out), "--json"]);
    assert_eq!(events.matches("run_begun").count(), 1);
    assert_eq!(result("a-3v.m.s1"), before[0]);
    assert_ne!(result("a-3v.n.s1"), before[1]);
    // Results of another program version count on request.
    let file_of = |id: &str| out.join("runs").join(id).join("result.json");
    let mut other: Value = serde_json::from_slice(&result("a-3v.m.s1")).unwrap();
    other["fingerprint"]["commit"] = "of another day".into();
    std::fs::write(file_of("a-3v.m.s1"), other.to_string()).unwrap();
    assert_eq!(all("waiting"), ["a-3v.m.s1"]);
    let listed = ok(&["list", text(&file), "-o", text(&out), "--any-commit"]);
    assert!(listed.lines().count() == 2 && listed.lines().all(|line| line.starts_with("scored ")), "{listed}");
    let begun = |more: &[&str]| {
        let args = [&["run", text(&file), "-o", text(&out), "--json"], more].concat();
        ok(&args).matches("run_begun").count()
    };
    assert_eq!(begun(&["--any-commit"]), 0);
    assert_eq!(begun(&[]), 1);
    // Settings for one data set only.
    let of_its_own = "iterations = 12\non = { a = [\"static.tv=0.5\"] }";
    written(directory.path(), &changed.replacen("iterations = 12", of_its_own, 1));
    assert_eq!(all("waiting"), ["a-3v.m.s1"]);
    assert_eq!(begun(&["--any-commit"]), 1, "another configuration");
    let config = std::fs::read_to_string(out.join("runs/a-3v.m.s1/config.toml")).unwrap();
    assert!(config.contains("tv = 0.5"), "{config}");
    // Another data set with the same name.
    written(directory.path(), &TINY.replace("phases = 3", "phases = 4"));
    assert_eq!(all("scored"), Vec::<String>::new());
}

#[test]
#[ignore = "long: tools/test --all"]
fn a_run_that_fails_is_a_row() {
    let directory = tempfile::tempdir().unwrap();
    let out = directory.path().join("out");
    let broken = directory.path().join("broken");
    std::fs::create_dir(&broken).unwrap();
    std::fs::write(broken.join("dataset.json"), "{ no dataset }").unwrap();
    let with = "[[data]]\nname = \"b\"\ndirectory = \"broken\"\n[[data]]\nname = \"a\"\n";
    let file = written(directory.path(), &TINY.replace("[[data]]\nname = \"a\"\n", with));
    let ran = output(&["run", text(&file), "-o", text(&out)]);
    let message = String::from_utf8_lossy(&ran.stderr);
    assert_eq!(ran.status.code(), Some(0), "{message}");
    assert!(message.contains("2 of 4 runs failed"), "{message}");
    let table = ok(&["table", text(&file), "-o", text(&out)]);
    let rows: Vec<&str> = table.lines().filter(|line| line.starts_with("| a ") || line.starts_with("| b ")).collect();
    assert_eq!(rows.len(), 4, "{table}");
    assert!(rows.iter().all(|row| row.starts_with("| b ") == row.contains("failed")), "{table}");
    assert!(table.contains("b.m.s1 failed: ") && table.contains("dataset.json"), "{table}");
    let csv = std::fs::read_to_string(out.join("table.csv")).unwrap();
    assert!(csv.lines().filter(|line| line.starts_with("b,")).all(|line| line.ends_with(",failed")), "{csv}");
    let begun = |more: &[&str]| {
        let args = [&["run", text(&file), "-o", text(&out), "--json"], more].concat();
        ok(&args).matches("run_begun").count()
    };
    assert_eq!(begun(&[]), 0, "a failure is a result");
    assert_eq!(begun(&["--retry-failed"]), 2);
    // As a single run, the failure is recorded, and a scheduler may continue.
    let one = output(&["one", text(&file), "b.m.s1", "-o", text(&out), "--retry-failed"]);
    assert_eq!(one.status.code(), Some(0));
    assert!(String::from_utf8_lossy(&one.stderr).contains("b.m.s1 failed"));
    assert!(ok(&["report", text(&file), "-o", text(&out)]).contains("report.html"));
    let page = std::fs::read_to_string(out.join("report.html")).unwrap();
    assert!(page.contains("data:image/png;base64,") && page.contains("b.m.s1 failed"));
}

const TABLES: [&str; 3] = ["table.md", "table.csv", "table.tex"];

/// Makes the tables of a study in a directory, and returns their texts.
fn tables(file: &Path, directory: &Path) -> [String; 3] {
    ok(&["table", text(file), "-o", text(directory)]);
    TABLES.map(|table| std::fs::read_to_string(directory.join(table)).unwrap())
}

/// Measured results in the repository remain results of their studies: they make the tables beside them, to the bit, and a page with
/// one plot for each data set. A changed number changes the tables.
#[test]
fn measured_results_make_their_tables_and_plots() {
    let studies = Path::new(SMOKE).parent().unwrap();
    for (name, plots, runs) in [("scaled-table1", 6, 90), ("scaled-table2", 2, 18), ("ablation", 2, 36)] {
        let directory = tempfile::tempdir().unwrap();
        let (file, out) = (studies.join(format!("{name}.toml")), directory.path());
        let (measured, results) = (studies.join("measured").join(name), out.join("results.jsonl"));
        let lines = std::fs::read_to_string(measured.join("results.jsonl")).unwrap();
        assert_eq!(lines.lines().count(), runs, "{name}");
        std::fs::write(&results, &lines).unwrap();
        let expected = TABLES.map(|table| std::fs::read_to_string(measured.join(table)).unwrap());
        assert!(tables(&file, out) == expected, "{name}: the tables are not those of its results");
        ok(&["collect", text(&file), "-o", text(out)]);
        assert!(std::fs::read_to_string(&results).unwrap() == lines, "{name}: collecting changes the results");
        let printed = ok(&["report", text(&file), "-o", text(out)]);
        let pictures: Vec<&str> = printed.lines().filter(|line| line.ends_with(".svg")).collect();
        assert_eq!(pictures.len(), plots, "{printed}");
        let plot = std::fs::read_to_string(pictures[0]).unwrap();
        assert!(plot.contains("XCAT-like, ") && plot.contains(", NVIDIA H100"), "data and devices have names");
        std::fs::write(&results, lines.replacen("\"psnr\":1", "\"psnr\":2", 1)).unwrap();
        let changed = tables(&file, out);
        assert!((0..3).all(|table| changed[table] != expected[table]), "{name}: a changed number is not seen");
    }
}

/// A result in a run's directory counts before the line of the run. Collected, it makes the same tables without the directory.
#[test]
fn results_are_collected() {
    let studies = Path::new(SMOKE).parent().unwrap();
    let (file, directory) = (studies.join("ablation.toml"), tempfile::tempdir().unwrap());
    let (out, results) = (directory.path(), directory.path().join("results.jsonl"));
    std::fs::copy(studies.join("measured/ablation/results.jsonl"), &results).unwrap();
    let (before, run) = (tables(&file, out), "xcat-4v.fast.s2");
    // A scheduler gets the file of a run whose result is a line.
    ok(&["one", text(&file), run, "-o", text(out), "--any-commit"]);
    let result = out.join("runs").join(run).join("result.json");
    let mut outcome: Value = serde_json::from_slice(&std::fs::read(&result).unwrap()).unwrap();
    assert!(tables(&file, out) == before);
    outcome["scores"]["dice"] = 0.125.into();
    std::fs::write(&result, outcome.to_string()).unwrap();
    let with_directory = tables(&file, out);
    assert!(with_directory != before);
    let printed = ok(&["collect", text(&file), "-o", text(out)]);
    assert!(printed.contains("36 results"), "{printed}");
    std::fs::remove_dir_all(out.join("runs")).unwrap();
    assert!(tables(&file, out) == with_directory);
    std::fs::write(&results, "{}\n").unwrap();
    let message = output(&["table", text(&file), "-o", text(out)]).stderr;
    assert!(String::from_utf8_lossy(&message).contains("results.jsonl"), "a damaged line is named");
}

#[cfg(unix)]
#[test]
#[ignore = "long: tools/test --all"]
fn two_processes_share_a_study() {
    let directory = tempfile::tempdir().unwrap();
    let (file, out) = (written(directory.path(), TINY), directory.path().join("out"));
    let held = Lock::take(&out.join("locks/run-a-3v.m.s1")).unwrap().unwrap();
    let one = output(&["one", text(&file), "a-3v.m.s1", "-o", text(&out)]);
    assert_eq!(one.status.code(), Some(75), "{}", String::from_utf8_lossy(&one.stderr));
    // The queue does the rest, and reports that it is incomplete.
    let all = output(&["run", text(&file), "-o", text(&out)]);
    assert_eq!(all.status.code(), Some(75), "{}", String::from_utf8_lossy(&all.stderr));
    let waiting = || states(&file, &out).into_values().filter(|state| state == "waiting").count();
    assert_eq!(waiting(), 1);
    drop(held);
    ok(&["run", text(&file), "-o", text(&out)]);
    assert_eq!(waiting(), 0);
}

/// Runs a study until its events are sufficient, then sends a signal; returns all events and the exit code.
fn run_until(file: &str, out: &Path, enough: impl Fn(&[Value]) -> bool, signal: &str) -> (Vec<Value>, Option<i32>) {
    let mut child = study(&["run", file, "-o", text(out), "--json"]).stdout(Stdio::piped()).spawn().unwrap();
    let (mut events, mut sent) = (Vec::new(), false);
    for line in BufReader::new(child.stdout.take().unwrap()).lines() {
        // The last line may be cut off.
        events.extend(serde_json::from_str::<Value>(&line.unwrap()));
        if !sent && enough(&events) {
            sent = true;
            assert!(Command::new("kill").args([signal, &child.id().to_string()]).status().unwrap().success());
        }
    }
    (events, child.wait().unwrap().code())
}

/// Results of a study, by run.
fn results(out: &Path) -> BTreeMap<String, Vec<u8>> {
    let runs = std::fs::read_dir(out.join("runs")).into_iter().flatten();
    let files = runs.map(|run| run.unwrap().path());
    let read = files.filter_map(|run| Some((run.clone(), std::fs::read(run.join("result.json")).ok()?)));
    read.map(|(run, bytes)| (run.file_name().unwrap().to_str().unwrap().to_owned(), bytes)).collect()
}

/// Table rows without seconds and values derived from them.
fn timeless(file: &str, out: &Path) -> Vec<String> {
    ok(&["table", file, "-o", text(out)]);
    let csv = std::fs::read_to_string(out.join("table.csv")).unwrap();
    let timed = |line: &str| line.contains(",minutes,") || line.contains(",fps,");
    csv.lines().filter(|line| !timed(line)).map(str::to_owned).collect()
}

/// Writes the smoke study with one seed and its first two methods, whose runs take a second.
fn first_methods_of_smoke(directory: &Path) -> PathBuf {
    let smoke = std::fs::read_to_string(SMOKE).unwrap().replace("seeds = [1, 2]", "seeds = [1]");
    let methods: Vec<&str> = smoke.split_inclusive("[[method]]").collect();
    let table = &smoke[smoke.find("[table]").unwrap()..];
    let [data, first, second] = methods[..3] else { panic!("three parts") };
    let published = "published-table1.toml";
    std::fs::copy(Path::new(SMOKE).with_file_name(published), directory.join(published)).unwrap();
    written(directory, &[data, first, second.trim_end_matches("[[method]]"), table].concat())
}

#[cfg(unix)]
#[test]
#[ignore = "long: tools/test --all"]
fn kills_change_nothing() {
    let directory = tempfile::tempdir().unwrap();
    let [whole, killed] = ["whole", "killed"].map(|name| directory.path().join(name));
    let file = first_methods_of_smoke(directory.path());
    let file = text(&file);
    ok(&["run", file, "-o", text(&whole)]);
    let (mut kills, mut began_anew) = (0, 0);
    // Results at their first appearance.
    let mut seen: BTreeMap<String, Vec<u8>> = BTreeMap::new();
    loop {
        // The last round is not killed.
        let lines = if kills < 6 { 2 + (30.0 * uniform01(kills, 0, 0, 0)) as usize } else { usize::MAX };
        let (events, code) = run_until(file, &killed, |events| events.len() >= lines, "-KILL");
        let begun: Vec<&str> =
            events.iter().filter(|e| e["study"] == "run_begun").map(|e| e["run"].as_str().unwrap()).collect();
        assert!(begun.iter().all(|run| !seen.contains_key(*run)), "{begun:?} was done: {:?}", seen.keys());
        began_anew += events.iter().filter(|e| e["event"] == "started" && e["step"] != 0).count();
        for (run, bytes) in results(&killed) {
            assert_eq!(*seen.entry(run.clone()).or_insert(bytes.clone()), bytes, "{run} was written again");
        }
        if code == Some(0) {
            break;
        }
        kills += 1;
    }
    println!("{kills} kills, {began_anew} times a run went on from a checkpoint");
    assert!(kills > 3 && began_anew > 0);
    assert_eq!(timeless(file, &whole), timeless(file, &killed));
    let parts = seen.values().map(|bytes| serde_json::from_slice::<Value>(bytes).unwrap());
    assert!(parts.map(|result| result["seconds"]["parts"].as_u64().unwrap()).max().unwrap() > 1);
}

#[cfg(unix)]
#[test]
#[ignore = "long: tools/test --all"]
fn ctrl_c_saves() {
    let directory = tempfile::tempdir().unwrap();
    let out = directory.path().join("out");
    let trains = |events: &[Value]| events.last().is_some_and(|event| event["event"] == "progress");
    let (events, code) = run_until(SMOKE, &out, trains, "-INT");
    assert_eq!(code, Some(130), "{events:?}");
    let interrupted = events.iter().rev().find_map(|e| e["run"].as_str()).unwrap();
    let checkpoints = std::fs::read_dir(out.join("runs").join(interrupted)).unwrap();
    let saved =
        checkpoints.filter(|file| file.as_ref().unwrap().path().extension().is_some_and(|e| e == "safetensors"));
    assert!(saved.count() > 0, "{interrupted} has no checkpoint");
    let ended = ok(&["one", SMOKE, interrupted, "-o", text(&out), "--json"]);
    let first: Value = serde_json::from_str(ended.lines().next().unwrap()).unwrap();
    assert_eq!(first["event"], "started");
    assert!(first["step"].as_u64().unwrap() > 0, "it goes on: {first}");
}
