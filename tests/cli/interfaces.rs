//! The command line: a complete workflow on a tiny phantom, exit codes, and invalid input.

use crate::program::program;
use crate::shared;
use nertca_vk::formats::npy;
use serde_json::{Value, json};
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

fn nertca(args: &[&str]) -> Output {
    program().args(args).output().unwrap()
}

pub fn text(path: &Path) -> &str {
    path.to_str().unwrap()
}

/// Runs with the validation layers on (messages make the program fail) and returns stdout.
pub fn ok(args: &[&str]) -> String {
    let out = nertca(&[&["--validate"], args].concat());
    assert!(out.status.success(), "{args:?}: {}", String::from_utf8_lossy(&out.stderr));
    String::from_utf8(out.stdout).unwrap()
}

/// Expects exit code `code` and an error on stderr that names all `parts`, without a panic.
pub fn fails(args: &[&str], code: i32, parts: &[&str]) {
    let out = nertca(args);
    let stderr = String::from_utf8_lossy(&out.stderr);
    assert_eq!(out.status.code(), Some(code), "{args:?}: {stderr}");
    assert!(!stderr.contains("panicked"), "{args:?}: {stderr}");
    for part in parts {
        assert!(stderr.contains(part), "{args:?} does not name `{part}`: {stderr}");
    }
}

pub fn phantom(directory: &Path, extra: &[&str]) -> PathBuf {
    let out = directory.join("phantom with spaces é");
    ok(&[&["phantom", text(&out), "--size", "24", "--phases", "3", "--views", "3", "--no-volumes"], extra].concat());
    out
}

pub const SHORT: &[&str] = &[
    "--set",
    "train.iterations=30",
    "--set",
    "train.rays=64",
    "--set",
    "march.render_samples=64",
    "--set",
    "train.validate_every=15",
    "--set",
    "train.chunk_samples=16384",
];

/// Further settings of runs whose dynamic field is a network.
const SMALL_NETWORK: &[&str] = &["--set", "dynamic.width=16"];

#[test]
fn a_whole_life() {
    let directory = tempfile::tempdir().unwrap();
    let data = phantom(directory.path(), &["--photons", "1e9", "--breathing", "0.2", "--geometry-error", "0.01,0.01"]);
    let run = directory.path().join("run");
    let lines = ok(&[&["train", text(&data), "-o", text(&run), "--json", "--stop-at", "20"], SHORT].concat());
    let events: Vec<Value> = lines.lines().map(|l| serde_json::from_str(l).unwrap()).collect();
    // The memory is stated, and views are adjusted, before a run starts.
    assert!(events[0]["event"] == "memory" && events[0]["host_mib"].as_u64() > Some(100), "{}", events[0]);
    let events: Vec<Value> =
        events.into_iter().skip_while(|e| e["event"] == "memory" || e["event"] == "adjusting").collect();
    let kinds: Vec<_> = events.iter().map(|e| e["event"].as_str().unwrap()).collect();
    assert_eq!(kinds[0], "started");
    assert!(kinds.contains(&"validation") && kinds.contains(&"saved"));
    // After training the unseen images are scored one by one: twelve in the frame of the calibration, and twelve as stated.
    let finished = kinds.iter().position(|kind| *kind == "finished").unwrap();
    let scored: Vec<_> = events[finished + 1..].iter().map(|e| (&e["event"], e["images"].as_u64(), &e["of"])).collect();
    let wanted: Vec<_> = (0..=24).map(|n| (json!("evaluation"), Some(n), json!(24))).collect();
    assert!(scored.iter().zip(&wanted).all(|(a, b)| (a.0, a.1, a.2) == (&b.0, b.1, &b.2)), "{scored:?}");
    assert_eq!(scored.len(), 25);
    fails(&["train", text(&data), "-o", text(&run)], 2, &["--resume", "--force"]);
    ok(&["train", text(&data), "-o", text(&run), "--json", "--resume"]);
    assert!(run.join("checkpoint-0000030.safetensors").is_file());

    let pictures = directory.path().join("pictures");
    let scores: Value =
        serde_json::from_str(&ok(&["eval", text(&run), "--json", "--images", text(&pictures)])).unwrap();
    assert_eq!(scores["images"].as_array().unwrap().len(), 12);
    for key in ["dynamic", "total"] {
        let dice = scores["dice"][key].as_f64().unwrap();
        let best = scores["best_dice"][key]["dice"].as_f64().unwrap();
        assert!((0.0..=best).contains(&dice) && best <= 1.0, "{key}: {dice}, at best {best}");
    }
    assert!(scores["warnings"].is_array());
    assert!(scores["psnr"].as_f64().unwrap() > 0.0 && scores["ssim"].is_f64());
    assert_eq!(std::fs::read_dir(&pictures).unwrap().count(), 12 + 4 + 1, "pictures, animations and the page");
    assert!(ok(&["eval", text(&run)]).contains("mean of  12 images"));

    renders_show_the_fields(directory.path(), &run);
    assert!(ok(&["info", text(&run)]).contains("step: 30"));
    assert!(ok(&["info", text(&data)]).contains("phases: 3"));
    let hull = directory.path().join("hull.nrrd");
    ok(&["train", text(&data), "-o", text(&run), "--export-hull", text(&hull)]);
    assert!(hull.is_file());
    fails(&["render", text(&run), "--primary", "0", "--secondary", "0", "-o", "x.bmp"], 2, &["x.bmp", ".png"]);
    fails(
        &["render", text(&run), "--primary", "0", "--secondary", "0", "--phase", "3", "-o", "x.png"],
        2,
        &["--phase", "2"],
    );
}

/// Renders a run in every format: pictures, values and animations agree.
fn renders_show_the_fields(directory: &Path, run: &Path) {
    let render = |file: &str, extra: &[&str]| {
        let out = directory.join(file);
        ok(&[&["render", text(run), "--primary", "-20", "--secondary", "12.5", "-o", text(&out)], extra].concat());
        out
    };
    let read = |file: &str, extra: &[&str]| npy::read(&render(file, extra), 1 << 20).unwrap();
    let still = read("still.npy", &["--component", "static"]);
    assert_eq!(still.shape, [24, 24]);
    let (low, high) = still.values.iter().fold((f32::MAX, f32::MIN), |(l, h), v| (l.min(*v), h.max(*v)));
    assert!(low >= 0.0 && high > low, "{low} to {high}");
    // Dark pixels have high values: the picture shows the values, enlarged nine times.
    let picture = image::open(render("a.png", &["--component", "static"])).unwrap().to_luma8();
    assert_eq!(picture.dimensions(), (216, 216));
    for (i, value) in still.values.iter().enumerate() {
        let code = picture.get_pixel(9 * (i as u32 % 24) + 4, 9 * (i as u32 / 24) + 4).0[0];
        let wanted = 255.0 * (1.0 - (value - low) / (high - low));
        assert!((f32::from(code) - wanted).abs() <= 1.0, "pixel {i}: {code}, not {wanted}");
    }
    // All phases, and a single one.
    let every = read("every.npy", &["--phase", "all", "--projection", "mip", "--component", "dynamic"]);
    let one = read("one.npy", &["--phase", "2", "--projection", "mip", "--component", "dynamic"]);
    assert_eq!(every.shape, [3, 24, 24]);
    assert!(every.values[2 * 576..] == one.values[..] && every.values.iter().any(|v| *v > 0.0));
    let gif =
        std::io::BufReader::new(std::fs::File::open(render("a.gif", &["--phase", "all", "--size", "31"])).unwrap());
    let frames = image::codecs::gif::GifDecoder::new(gif).unwrap();
    let frames = image::AnimationDecoder::into_frames(frames).collect_frames().unwrap();
    assert_eq!(frames.len(), 3);
    for frame in &frames {
        assert_eq!(frame.buffer().dimensions(), (217, 217));
        let grey: Vec<u8> = frame.buffer().pixels().map(|p| p.0[0]).collect();
        assert!(grey.iter().max().unwrap() - grey.iter().min().unwrap() > 100, "a frame shows nothing");
    }
}

#[test]
fn degradations_that_cannot_be_are_named() {
    let directory = tempfile::tempdir().unwrap();
    let out = directory.path().join("none");
    let refused = |extra: &[&str], parts: &[&str]| {
        fails(&[&["phantom", text(&out), "--size", "24", "--views", "3"], extra].concat(), 2, parts);
        assert!(!out.exists(), "{extra:?} leaves something behind");
    };
    refused(&["--geometry-error", "0.5"], &["--geometry-error", "DEG,MM"]);
    refused(&["--geometry-error", "-0.5,1"], &["angle_deg = -0.5"]);
    refused(&["--geometry-error", "0.5,NaN"], &["position_mm = NaN"]);
    refused(&["--geometry-error", "0.5,1", "--layout", "nerfca"], &["position_mm = 1", "nerfca"]);
    refused(&["--breathing", "deep"], &["--breathing", "MM,PERIOD_S"]);
    refused(&["--breathing", "-3"], &["peak_to_peak_mm = -3"]);
    refused(&["--breathing", "3,0"], &["period_s = 0"]);
    refused(&["--breathing-background"], &["--breathing <MM"]);
    refused(&["--photons", "1e5", "--detector-photons", "1e4"], &["--photons", "--detector-photons"]);
    refused(&["--detector-photons", "0"], &["detector_photons = 0"]);
    refused(&["--contrast-variation", "-20"], &["contrast_variation = -0.2"]);
    refused(&["--inflow", "-1"], &["inflow_s = -1"]);
    refused(&["--heart-rate", "60,70"], &["heart_rate = 2", "one or 3 are needed"]);
    refused(&["--heart-rate", "6"], &["heart_rate = 6", "20 to 300"]);
    refused(&["--heart-rate", "60", "--fps", "0"], &["frames_per_s = 0"]);
    refused(&["--heart-rate", "60", "--beats", "0"], &["beats = 0"]);
    refused(&["--fps", "30"], &["--heart-rate"]);
    refused(&["--heart-rate", "60", "--gating", "cubic"], &["cubic", "two-segment"]);
    refused(&["--collimate", "0.95"], &["collimated_share = 0.95"]);
}

#[test]
fn both_layouts_hold_the_same_data() {
    let directory = tempfile::tempdir().unwrap();
    let native = directory.path().join("native");
    let authors = directory.path().join("authors");
    let size = ["--size", "20", "--phases", "2", "--views", "3", "--no-volumes"];
    ok(&[&["phantom", text(&native)], &size[..]].concat());
    ok(&[&["phantom", text(&authors), "--layout", "nerfca"], &size[..]].concat());
    // Copied datasets have outdated absolute paths.
    let list = authors.join("train-0.json");
    let moved = std::fs::read_to_string(&list).unwrap().replace("\"train-view", "\"/gone/elsewhere/train-view");
    std::fs::write(&list, moved).unwrap();
    let a = nertca_vk::scan::dataset::Dataset::open(&native).unwrap();
    let b = nertca_vk::scan::dataset::Dataset::open(&authors).unwrap();
    assert_eq!((a.frames.len(), a.width, a.n_phases), (b.frames.len(), b.width, b.n_phases));
    for (x, y) in a.frames.iter().zip(&b.frames) {
        assert_eq!((x.phase, x.split, &x.mask), (y.phase, y.split, &y.mask));
        assert_eq!(a.views[x.view].geometry, b.views[y.view].geometry);
        for (v, w) in x.integrals.iter().zip(&y.integrals) {
            assert!((v - w).abs() < 1e-6, "{v} {w}");
        }
    }
    assert!((a.depth_range.1 - b.depth_range.1).abs() < 1e-9);
}

#[test]
fn volumes_are_of_the_phases_asked_for() {
    let directory = tempfile::tempdir().unwrap();
    let phantom = ["--size", "20", "--phases", "5", "--views", "3"];
    for (asked, expected) in [(&[][..], vec![0, 1, 2, 3, 4]), (&["--volumes-every", "2"], vec![0, 2, 4])] {
        let out = directory.path().join(expected.len().to_string());
        ok(&[&["phantom", text(&out)], &phantom[..], asked].concat());
        let there = |kind: &str| -> Vec<u32> {
            (0..5).filter(|phase| out.join(format!("volumes/{kind}-{phase:02}.nrrd")).is_file()).collect()
        };
        assert_eq!((there("vessels"), there("background")), (expected.clone(), expected));
        // The tree has all phases.
        let tree: Value = serde_json::from_slice(&std::fs::read(out.join("volumes/tree.json")).unwrap()).unwrap();
        assert!(tree.to_string().len() > 100, "{tree}");
    }
    let out = directory.path().join("none");
    for (contrary, part) in
        [(&["--volumes-every", "0"][..], "0"), (&["--no-volumes", "--volumes-every", "2"], "--no-volumes")]
    {
        fails(&[&["phantom", text(&out)], &phantom[..], contrary].concat(), 2, &[part]);
    }
}

#[test]
fn real_anatomy_makes_a_dataset() {
    let Some(anatomy) = shared::shared("anatomy") else { return };
    let directory = tempfile::tempdir().unwrap();
    let out = directory.path().join("real");
    let (tree, ct) = (anatomy.join("coronary_tree_hra.json"), anatomy.join("thorax_ct.nii.gz"));
    ok(&[
        "phantom",
        text(&out),
        "--tree",
        text(&tree),
        "--background",
        text(&ct),
        "--size",
        "32",
        "--phases",
        "2",
        "--views",
        "3",
        "--no-volumes",
    ]);
    let dataset = nertca_vk::scan::dataset::Dataset::open(&out).unwrap();
    let deepest = dataset.frames[0].integrals.iter().copied().fold(0f32, f32::max);
    assert!((2.0..12.0).contains(&deepest), "a chest attenuates e^-2 to e^-12, not e^-{deepest}");
    assert!(dataset.frames.iter().all(|f| f.mask.as_ref().unwrap().iter().any(|m| *m)));
}

#[test]
fn volumes_are_projected_in_every_format() {
    let directory = tempfile::tempdir().unwrap();
    let values: Vec<f32> = (0..16 * 16 * 16).map(|i| if (i % 16) > 8 { 0.02 } else { 0.001 }).collect();
    let npy = directory.path().join("v.npy");
    npy::write(&npy, &[16, 16, 16], &values).unwrap();
    let raw = directory.path().join("v.bin");
    std::fs::write(&raw, values.iter().flat_map(|v| v.to_le_bytes()).collect::<Vec<_>>()).unwrap();
    let nrrd = directory.path().join("v.nrrd");
    let volume = nertca_vk::formats::volume::Volume::centred([16; 3], 4.0, glam::DVec3::ZERO, values);
    nertca_vk::formats::nrrd::write(&nrrd, &volume, "attenuation per mm").unwrap();
    let common = ["--size", "16", "--views", "3", "--fov", "80", "--vessel", "0.015"];
    let mut images = Vec::new();
    for (name, file, extra) in [
        ("npy", &npy, &["--spacing", "4,4,4"][..]),
        ("raw", &raw, &["--spacing", "4,4,4", "--raw-size", "16,16,16", "--raw-type", "f32"]),
        ("nrrd", &nrrd, &[]),
    ] {
        let out = directory.path().join(name);
        ok(&[&["project", text(file), text(file), "--out", text(&out)], &common[..], extra].concat());
        images.push(nertca_vk::scan::dataset::Dataset::open(&out).unwrap().frames[0].integrals.to_vec());
    }
    assert_eq!(images[0], images[1]);
    assert_eq!(images[0], images[2]);
    fails(&["project", text(&npy), "--out", "nowhere"], 1, &["v.npy", "spacing", "must be given"]);
    fails(
        &["project", text(&raw), "--out", "nowhere", "--raw-size", "99,99,99", "--spacing", "1,1,1"],
        1,
        &["v.bin", "truncated"],
    );
}

/// Writes a valid two-frame dataset, changed by `spoil` before the program opens it.
fn spoiled(directory: &Path, name: &str, spoil: impl FnOnce(&Path, &mut Value)) -> PathBuf {
    let data = directory.join(name);
    let frame = |phase: u32| {
        json!({
            "image": format!("{phase}.npy"), "phase": phase, "split": "train",
            "geometry": {"primary_deg": 0.0, "secondary_deg": 0.0, "sid_mm": 1000.0, "sod_mm": 600.0, "pixel_mm": [1.0, 1.0]},
            "intensity": {"kind": "integral"},
        })
    };
    for phase in 0..2 {
        npy::write(&data.join(format!("{phase}.npy")), &[4, 5], &[0.5; 20]).unwrap();
    }
    let mut manifest = json!({
        "format": "nertca-dataset", "version": 1, "phases": 2, "depth_half_extent_mm": 100.0, "frames": [frame(0), frame(1)],
    });
    spoil(&data, &mut manifest);
    std::fs::write(data.join("dataset.json"), manifest.to_string()).unwrap();
    data
}

type Spoil = fn(&Path, &mut Value);

#[test]
fn malformed_datasets_are_named_file_and_field() {
    let directory = tempfile::tempdir().unwrap();
    let cases: &[(&str, Spoil, &[&str])] = &[
        ("missing image", |d, _| std::fs::remove_file(d.join("1.npy")).unwrap(), &["1.npy"]),
        (
            "truncated image",
            |d, _| std::fs::write(d.join("1.npy"), &std::fs::read(d.join("0.npy")).unwrap()[..150]).unwrap(),
            &["1.npy", "truncated"],
        ),
        ("empty image", |d, _| std::fs::write(d.join("1.npy"), b"").unwrap(), &["1.npy"]),
        (
            "too large together",
            |d, m| {
                npy::write(&d.join("0.npy"), &[1, 8192], &[0.5; 8192]).unwrap();
                npy::write(&d.join("1.npy"), &[8192, 1], &[0.5; 8192]).unwrap();
                let frame = m["frames"][1].clone();
                m["frames"].as_array_mut().unwrap().extend(vec![frame; 16]);
            },
            &["dataset.json", "8192 columns and 8192 rows", "reduce the large images"],
        ),
        ("three axes", |d, _| npy::write(&d.join("1.npy"), &[1, 4, 5], &[0.5; 20]).unwrap(), &["1.npy", "two axes"]),
        ("not a number", |d, _| npy::write(&d.join("1.npy"), &[4, 5], &[f32::NAN; 20]).unwrap(), &["1.npy", "row 0"]),
        ("phase", |_, m| m["frames"][1]["phase"] = json!(2), &["dataset.json", "frames[1].phase"]),
        ("negative phase", |_, m| m["frames"][1]["phase"] = json!(-1), &["dataset.json", "frames[1].phase"]),
        ("no frames", |_, m| m["frames"] = json!([]), &["dataset.json", "frames"]),
        (
            "no training",
            |_, m| {
                m["frames"][0]["split"] = json!("validation");
                m["frames"][1]["split"] = json!("validation")
            },
            &["training"],
        ),
        ("zero SID", |_, m| m["frames"][0]["geometry"]["sid_mm"] = json!(0.0), &["frames[0].geometry.sid_mm"]),
        ("SOD beyond SID", |_, m| m["frames"][0]["geometry"]["sod_mm"] = json!(1200.0), &["geometry.sod_mm"]),
        ("source inside", |_, m| m["depth_half_extent_mm"] = json!(700.0), &["depth range"]),
        (
            "singular matrix",
            |_, m| m["frames"][0]["geometry"] = json!({"matrix": [[1, 0, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0]]}),
            &["geometry.matrix", "inverted"],
        ),
        ("unknown key", |_, m| m["frames"][0]["phaze"] = json!(1), &["dataset.json", "phaze"]),
        ("zero phases", |_, m| m["phases"] = json!(0), &["phases"]),
        (
            "bad scale",
            |_, m| m["frames"][0]["intensity"] = json!({"kind": "linear", "i0": -1}),
            &["frames[0].intensity.i0"],
        ),
        (
            "mask size",
            |d, m| {
                npy::write(&d.join("m.npy"), &[2, 2], &[1.0; 4]).unwrap();
                m["frames"][0]["mask"] = json!("m.npy")
            },
            &["m.npy", "shape"],
        ),
        (
            "absurd header",
            |d, _| {
                let header = "{'descr': '<f4', 'fortran_order': False, 'shape': (99999999999, 99999999999), }";
                let mut bytes = b"\x93NUMPY\x01\x00".to_vec();
                bytes.extend(118u16.to_le_bytes());
                bytes.extend(format!("{header:<117}\n").bytes());
                std::fs::write(d.join("1.npy"), bytes).unwrap();
            },
            &["1.npy"],
        ),
    ];
    for (name, spoil, parts) in cases {
        let data = spoiled(directory.path(), name, spoil);
        fails(&["info", text(&data)], 1, parts);
    }
    // The unspoiled dataset is valid, so each case fails for its own reason.
    ok(&["info", text(&spoiled(directory.path(), "fine", |_, _| {}))]);
    fails(&["info", text(&directory.path().join("absent"))], 1, &["absent"]);
    fails(&["info", text(directory.path())], 1, &["dataset.json", "general.json"]);
}

#[test]
fn usage_errors_have_their_exit_codes() {
    fails(&["train"], 2, &["DATA", "nertca-vk phantom heart", "import dicom"]);
    fails(&["train", "x", "-o", "y", "--set", "train.rayz=1"], 2, &["train.rayz"]);
    fails(&["train", "x", "-o", "y", "--config", "absent.toml"], 1, &["absent.toml"]);
    fails(&["--device", "no such device", "phantom", "never-made"], 3, &["no such device"]);
    fails(&["phantom", "never-made", "--views", "5"], 2, &["views = 5", "angles"]);
    fails(&["phantom", "never-made", "--size", "1"], 2, &["size = 1"]);
    assert!(!Path::new("never-made").exists(), "a refused command must leave nothing behind");
    assert!(ok(&["train", "--print-config", "--preset", "paper"]).contains("iterations = 30000"));
    assert!(ok(&["completions", "bash"]).contains("nertca-vk"));
    let devices: Value = serde_json::from_str(&ok(&["devices", "--json"])).unwrap();
    assert!(devices[0]["paths"]["reasons"].is_array() && devices[0]["uuid"].is_string());
    // Further details for the report of a fault.
    let details = &devices[0]["details"];
    assert_eq!(details["subgroups"]["default_size"], devices[0]["subgroup_size"]);
    assert_eq!(details["max_workgroup_count"][0], devices[0]["max_workgroup_count"]);
    let names = |key: &str| details[key].as_array().unwrap().iter().map(Value::to_string).collect::<String>();
    assert!(details["subgroups"]["operations"].as_str().unwrap().contains("basic"), "{details}");
    assert!(details["int64"].is_boolean() && details["buffer_int64_atomics"].is_boolean(), "{details}");
    assert!(names("queues").contains("compute") && names("queues").contains("timestamp_bits"), "{details}");
    assert!(names("extensions").contains("VK_KHR_") && names("heaps").contains("device_local"), "{details}");
}

#[test]
fn the_committed_schema_is_current() {
    let committed = include_str!("../../docs/dataset.schema.json");
    assert_eq!(ok(&["info", "--schema"]), committed, "run: tools/bless");
}

#[test]
#[cfg(unix)]
fn ctrl_c_saves_and_exits_130() {
    let directory = tempfile::tempdir().unwrap();
    let data = phantom(directory.path(), &[]);
    let run = directory.path().join("run");
    let settings = [SHORT, &["--set", "train.iterations=100000", "--set", "train.validate_every=0"]].concat();
    let mut child = program()
        .args([&["train", text(&data), "-o", text(&run), "--json"][..], &settings].concat())
        .stdout(std::process::Stdio::piped())
        .spawn()
        .unwrap();
    // Training has begun once the first progress line is there.
    let mut lines = std::io::BufRead::lines(std::io::BufReader::new(child.stdout.take().unwrap()));
    assert!(lines.by_ref().any(|l| l.unwrap().contains("progress")));
    Command::new("kill").args(["-INT", &child.id().to_string()]).status().unwrap();
    lines.for_each(drop);
    assert_eq!(child.wait().unwrap().code(), Some(130));
    let saved = nertca_vk::checkpoint::newest(&run).unwrap();
    assert!(nertca_vk::checkpoint::Checkpoint::read(&saved).unwrap().model.step > 0);
}

#[test]
#[ignore = "long: tools/test --all"]
fn measurements_and_baked_views() {
    let directory = tempfile::tempdir().unwrap();
    let data = phantom(directory.path(), &[]);
    let run = directory.path().join("run");
    ok(&[&["train", text(&data), "-o", text(&run), "--no-eval"], SHORT].concat());
    let file = directory.path().join("bench.json");
    let quick = ["--preset", "fast-mlp", "--warm-up", "0", "--iterations", "2", "--repeats", "3"];
    let full = [
        &["bench", text(&data), "--full", "--json", text(&file), "--set", "dynamic.delay=5"],
        SHORT,
        SMALL_NETWORK,
        &quick,
    ];
    let said = ok(&full.concat());
    for part in
        ["before the network starts", "peaks: f32", "37:00", "whole run, measured", "network passes only", "dry run: "]
    {
        assert!(said.contains(part), "`{part}` is missing: {said}");
    }
    let report: Value = serde_json::from_slice(&std::fs::read(&file).unwrap()).unwrap();
    assert_eq!(report["after"]["ms"].as_array().unwrap().len(), 3);
    assert!(report["peaks"]["f32_tflops"].as_f64().unwrap() > 0.0);
    assert_eq!(report["config"]["train"]["rays"], 64);
    assert_eq!((&report["tuning"]["layers"], &report["after"]["iterations"]), (&"f32".into(), &2.into()));
    let stages: Vec<&str> =
        report["full"]["stages"].as_array().unwrap().iter().map(|time| time["stage"].as_str().unwrap()).collect();
    assert_eq!(stages, ["calibrate", "plan", "prepare", "iterate"]);
    assert!(report["full"]["calls"]["submits"].as_u64().unwrap() > 0);
    // Four iterations at the start, and one that measures their duration.
    assert_eq!(report["after"]["learned"], 5);
    assert!(
        said.contains("not included: ") && said.contains("repeats of 2 iterations, after 5 iterations of training"),
        "{said}"
    );
    assert!(report["host"]["threads"].as_u64().unwrap() > 0);
    // 5 iterations without the network and 25 with it.
    let median = |part: &str| {
        let mut ms: Vec<f64> = report[part]["ms"].as_array().unwrap().iter().map(|v| v.as_f64().unwrap()).collect();
        ms.sort_by(f64::total_cmp);
        ms[1]
    };
    let whole = (5.0 * median("before") + 25.0 * median("after")) * 1e-3;
    assert!((report["whole_run_s"].as_f64().unwrap() - whole).abs() < 1e-9);
    // Counted operations: 16 neurons, 4 layers, 8 bands: 51 inputs.
    let forward = 2 * (51 * 16 + 3 * 16 * 16 + 16);
    assert_eq!(report["network_cost"]["forward"], forward);
    assert_eq!(report["network_cost"]["weights"], forward);
    assert_eq!(report["network_cost"]["inputs"], 2 * (3 * 16 * 16 + 16));
    // A value that is not a number is written as null, which can be read again.
    let mut unscored = report.clone();
    unscored["full"]["psnr"] = Value::Null;
    std::fs::write(&file, unscored.to_string()).unwrap();
    let compared = [&["bench", text(&data), "--kernels", "--compare", text(&file)], SHORT, SMALL_NETWORK, &quick];
    let said = ok(&compared.concat());
    assert!(said.contains("with the network, ms") && said.contains("the configurations differ"), "{said}");
    fails(&["bench", text(&data), "--compare", text(&data.join("dataset.json"))], 1, &["dataset.json", "bench --json"]);

    let picture = directory.path().join("baked.npy");
    let pose = ["render", text(&run), "--primary", "10", "--component", "dynamic", "--phase", "1"];
    ok(&[&pose[..], &["--baked", "--out", text(&picture)]].concat());
    let fields = directory.path().join("fields.npy");
    ok(&[&pose[..], &["--out", text(&fields)]].concat());
    let [baked, fields] = [&picture, &fields].map(|file| npy::read(file, 1 << 20).unwrap());
    assert_eq!((&baked.shape[..], &fields.shape[..]), (&[24, 24][..], &[24, 24][..]));
    let largest = fields.values.iter().copied().fold(0.0, f32::max);
    let apart = baked.values.iter().zip(&fields.values).map(|(a, b)| (a - b).abs()).sum::<f32>() / 576.0;
    assert!(largest > 0.0 && apart < 0.05 * largest, "{apart} apart on average, of {largest}");
    let said = ok(&["render", text(&run), "--fps", "--size", "16"]);
    assert_eq!(said.lines().filter(|l| l.contains("frames/s")).count(), 6, "{said}");
}

#[test]
fn matrices_are_refused_where_there_are_none() {
    let directory = tempfile::tempdir().unwrap();
    let devices: Value = serde_json::from_str(&ok(&["devices", "--json"])).unwrap();
    if !devices[0]["matrices"].as_array().unwrap().is_empty() {
        eprintln!("SKIPPED: this device has matrices");
        return;
    }
    let data = phantom(directory.path(), &[]);
    let run = directory.path().join("run");
    let asked = [
        &["--layers", "matrices", "train", "--preset", "fast-mlp", text(&data), "-o", text(&run)],
        SHORT,
        SMALL_NETWORK,
    ];
    fails(&asked.concat(), 2, &["cooperative matrices", "f32"]);
}

/// Starts a training, and returns its lines of JSON as they arrive.
#[cfg(unix)]
fn training(data: &Path, run: &Path, extra: &[&str]) -> (std::process::Child, impl Iterator<Item = Value> + use<>) {
    let mut child = program()
        .args([&["train", text(data), "-o", text(run), "--json"], extra].concat())
        .stdout(std::process::Stdio::piped())
        .stderr(std::process::Stdio::null())
        .spawn()
        .unwrap();
    let lines = std::io::BufRead::lines(std::io::BufReader::new(child.stdout.take().unwrap()));
    (child, lines.map_while(|line| serde_json::from_str(&line.ok()?).ok()))
}

#[cfg(unix)]
fn signal(child: &std::process::Child, name: &str) {
    assert!(Command::new("kill").args([name, &child.id().to_string()]).status().unwrap().success());
}

#[test]
#[ignore = "long: tools/test --all"]
#[cfg(unix)]
fn scoring_stops_when_told_and_can_be_left_for_later() {
    let directory = tempfile::tempdir().unwrap();
    let data = directory.path().join("forty images");
    ok(&["phantom", text(&data), "--size", "64", "--phases", "10", "--views", "3", "--no-volumes"]);
    let run = directory.path().join("run");
    // Forty images that take long to render, after a fit that does not.
    let slow = [SHORT, &["--set", "train.validate_every=0", "--set", "march.render_samples=1024"]].concat();
    let slow = [&slow[..], &["--set", "calibrate.adjust=off", "--set", "gaussians.form=phase"]].concat();
    for name in ["-TERM", "-INT"] {
        let (mut child, mut lines) = training(&data, &run, &[&slow[..], &["--force"]].concat());
        assert!(lines.any(|line| line["event"] == "evaluation" && line["images"] == 1), "no image was scored");
        signal(&child, name);
        lines.for_each(drop);
        assert_eq!(child.wait().unwrap().code(), Some(130), "{name}");
        let saved = nertca_vk::checkpoint::newest(&run).unwrap();
        assert_eq!(nertca_vk::checkpoint::Checkpoint::read(&saved).unwrap().model.step, 30);
        assert!(!run.join("report/evaluation.json").exists(), "what was not scored has no scores");
    }
    let unscored = directory.path().join("unscored");
    let said = ok(&[&["train", text(&data), "-o", text(&unscored), "--json", "--no-eval"], &slow[..]].concat());
    assert!(said.lines().last().unwrap().contains("\"finished\"") && !unscored.join("report/evaluation.json").exists());
    assert!(std::fs::read_to_string(unscored.join("report.html")).unwrap().contains("The run is not scored yet"));
    let mut eval = program()
        .args(["eval", text(&unscored)])
        .stderr(std::process::Stdio::piped())
        .stdout(std::process::Stdio::null())
        .spawn()
        .unwrap();
    let mut said = std::io::BufRead::lines(std::io::BufReader::new(eval.stderr.take().unwrap()));
    assert!(said.any(|line| line.unwrap().contains("4 of 40")), "every tenth is told");
    signal(&eval, "-TERM");
    said.for_each(drop);
    assert_eq!(eval.wait().unwrap().code(), Some(130));
}

#[test]
#[cfg(unix)]
fn a_run_killed_at_random_ends_in_the_same_file() {
    let directory = tempfile::tempdir().unwrap();
    let data = phantom(directory.path(), &[]);
    let settings = [SHORT, &["--set", "train.checkpoint_every=3", "--set", "train.validate_every=0"]].concat();
    let settings = [&settings[..], &["--set", "train.iterations_per_submit=1", "--no-eval"]].concat();
    let (whole, killed) = (directory.path().join("whole"), directory.path().join("killed"));
    ok(&[&["train", text(&data), "-o", text(&whole)], &settings[..]].concat());
    // The run is killed repeatedly after a random number of lines until it completes; the numbers come from a fixed seed.
    let mut random = 0x2545_f491_4f6c_dd1du64;
    let mut kills = 0;
    let last = killed.join("checkpoint-0000030.safetensors");
    for _ in 0..40 {
        let saved = nertca_vk::checkpoint::list(&killed).is_ok_and(|found| !found.is_empty());
        let begin = if saved { vec!["--resume", "--no-eval"] } else { [&settings[..], &["--force"]].concat() };
        let (mut child, mut lines) = training(&data, &killed, &begin);
        random = random.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        let through = lines.nth(1 + (random >> 33) as usize % 5).is_none();
        if !through {
            child.kill().unwrap();
            kills += 1;
        }
        lines.for_each(drop);
        let _ = child.wait().unwrap();
        if last.is_file() {
            break;
        }
        // A kill during the writing of a checkpoint leaves such a file.
        std::fs::write(killed.join(".partial-abcdef"), b"half").unwrap();
    }
    ok(&["train", text(&data), "-o", text(&killed), "--resume", "--no-eval"]);
    // On a busy machine the run may end before it is killed.
    if kills < 3 {
        eprintln!("only {kills} kills came in time: little was tested");
    }
    let [a, b] = [&whole, &killed].map(|run| std::fs::read(run.join("checkpoint-0000030.safetensors")).unwrap());
    assert!(a == b, "the files differ after {kills} kills");
    let hidden = |entry: &std::fs::DirEntry| entry.file_name().to_string_lossy().starts_with(".partial");
    assert!(!std::fs::read_dir(&killed).unwrap().any(|entry| hidden(&entry.unwrap())), "half a file is left");
}

#[test]
fn views_and_detectors_are_the_user_s() {
    let directory = tempfile::tempdir().unwrap();
    let file = directory.path().join("v.npy");
    npy::write(&file, &[16, 16, 16], &[0.01; 4096]).unwrap();
    let out = directory.path().join("data");
    let project = ["project", text(&file), "--spacing", "4,4,4", "--size", "16", "--out", text(&out)];
    ok(&[
        &project[..],
        &["--angles", "-30,25.5;60,-20", "--test-angles", "0,0", "--sod", "700,710,720", "--sid", "1100"],
        &["--pixel", "6,7", "--offset", "1,2;-3,4;0,0"],
    ]
    .concat());
    let dataset = nertca_vk::scan::dataset::Dataset::open(&out).unwrap();
    let arms: Vec<_> = dataset
        .views
        .iter()
        .map(|view| match &view.geometry {
            nertca_vk::geometry::Geometry::CArm(c) => {
                (c.primary_deg, c.secondary_deg, c.sod_mm, c.pixel_mm, c.offset_mm)
            }
            other => panic!("{other:?}"),
        })
        .collect();
    let pixel = [6.0, 7.0];
    assert_eq!(
        arms,
        [
            (-30.0, 25.5, 700.0, pixel, [1.0, 2.0]),
            (60.0, -20.0, 710.0, pixel, [-3.0, 4.0]),
            (0.0, 0.0, 720.0, pixel, [0.0, 0.0]),
        ]
    );
    assert_eq!((dataset.training().len(), dataset.validation().len()), (2, 1));
    // The cube is 64 mm wide: on a detector shifted by two pixels it appears two pixels further to the other side.
    let centre = |frame: &nertca_vk::scan::dataset::Frame| {
        let mass: f32 = frame.integrals.iter().sum();
        frame.integrals.iter().enumerate().map(|(i, v)| (i % 16) as f32 * v).sum::<f32>() / mass
    };
    let shifted = directory.path().join("shifted");
    let project = ["project", text(&file), "--spacing", "4,4,4", "--size", "16", "--out", text(&shifted)];
    ok(&[&project[..], &["--angles", "0,0;30,0", "--test-angles", "none", "--pixel", "20", "--offset", "40,0;0,0"]]
        .concat());
    let dataset = nertca_vk::scan::dataset::Dataset::open(&shifted).unwrap();
    assert!(dataset.validation().is_empty());
    let [moved, middle] = [0, 1].map(|i| centre(&dataset.frames[i]));
    assert!((middle - 7.5).abs() < 0.05 && (moved - 5.5).abs() < 0.05, "{moved} and {middle}");
    // Refused before any file is written.
    let nowhere = directory.path().join("nowhere");
    let refuse = |extra: &[&str], part: &str| {
        let project = ["project", text(&file), "--spacing", "4,4,4", "--out", text(&nowhere)];
        fails(&[&project[..], extra].concat(), 2, &[part]);
        assert!(!nowhere.exists());
    };
    refuse(&["--angles", "30"], "P,S");
    refuse(&["--angles", "0,0", "--views", "3"], "--views");
    refuse(&["--angles", "0,0;1000,0"], "1000");
    refuse(&["--angles", "0,0", "--test-angles", "none", "--sod", "700,800"], "one or 1");
    refuse(&["--sod", "1200"], "sod_mm");
    refuse(&["--pixel=-1"], "--pixel");
    refuse(&["--pixel", "1", "--fov", "100"], "--fov");
    fails(&["phantom", text(&nowhere), "--sod", "700"], 2, &["--tree"]);
    let own = directory.path().join("own");
    ok(&["phantom", text(&own), "--size", "16", "--phases", "1", "--no-volumes", "--angles", "88,3;0,0"]);
    let dataset = nertca_vk::scan::dataset::Dataset::open(&own).unwrap();
    assert_eq!((dataset.training().len(), dataset.validation().len()), (2, 3), "the paper's view at 90, 0 is too near");
}
