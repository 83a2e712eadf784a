//! Ways into the program beside complete DICOM files: pictures, stated geometry, sources of phases for each run, objects at rest,
//! paths that are not text.

use crate::dicom::angiogram;
use crate::interfaces::{fails, ok, text};
use crate::program::program;
use crate::python::python;
use dicom_core::{DataElement, PrimitiveValue, VR};
use dicom_dictionary_std::tags;
use nertca_vk::formats::npy;
use nertca_vk::scan::dataset::{Dataset, Split};
use serde_json::{Value, json};
use std::path::{Path, PathBuf};

fn manifest(data: &Path) -> Value {
    serde_json::from_slice(&std::fs::read(data.join("dataset.json")).unwrap()).unwrap()
}

/// Makes six frames of two views and of a third one, as 8-bit PNG in a folder, 16-bit TIFF of six pages, and JPEG in colour, with
/// the line integrals that NumPy computes from what other programs read.
const PICTURES: &str = "
import sys, numpy, tifffile
from PIL import Image
out = sys.argv[1]
import os
x, y = numpy.meshgrid(numpy.arange(64), numpy.arange(48))
def frame(f, top):
    bar = (abs(x - 20 - 3 * f) < 2) & (y > 8) & (y < 40)
    return numpy.where(bar, .4 * top, .8 * top + y / 48 * .1 * top)
for folder in ('png', 'jpg'):
    os.mkdir(f'{out}/{folder}')
png, jpg = [], []
for f in range(6):
    png.append(frame(f, 255).astype(numpy.uint8))
    # Sorted as text, frame 10 would come before frame 9.
    Image.fromarray(png[-1]).save(f'{out}/png/frame{f + 8}.png')
    name = f'{out}/jpg/frame{f}.jpg'
    Image.fromarray(numpy.repeat(png[-1][..., None], 3, axis=2)).save(name, quality=95)
    jpg.append(numpy.asarray(Image.open(name).convert('L')))
open(f'{out}/png/Thumbs.db', 'w').write('x')
tif = numpy.stack([frame(f, 4095) for f in range(6)]).astype(numpy.uint16)
tifffile.imwrite(f'{out}/pages.tif', tif, photometric='minisblack')
display = lambda v: (255 - numpy.stack(v).astype(float)) / 255 * 3
numpy.save(f'{out}/png.npy', display(png).astype(numpy.float32))
numpy.save(f'{out}/jpg.npy', display(jpg).astype(numpy.float32))
numpy.save(f'{out}/tif.npy', -numpy.log(numpy.maximum(tif / 4095, 1e-4)).astype(numpy.float32))
";

/// Largest difference between the line integrals of a view's frames and an array of them.
fn off(dataset: &Dataset, view: usize, wanted: &Path) -> f32 {
    let wanted = npy::read(wanted, 1 << 20).unwrap();
    assert_eq!(wanted.shape, [6, 48, 64]);
    let frames = dataset.frames.iter().filter(|frame| frame.view == view);
    let mut differences = Vec::new();
    for frame in frames {
        let pixels = &wanted.values[frame.phase as usize * 48 * 64..][..48 * 64];
        differences.extend(frame.integrals.iter().zip(pixels).map(|(a, b)| (a - b).abs()));
    }
    assert_eq!(differences.len(), 6 * 48 * 64);
    differences.into_iter().fold(0.0, f32::max)
}

#[test]
fn pictures_become_a_dataset_by_options_alone() {
    let directory = tempfile::tempdir().unwrap();
    let to = |name: &str| directory.path().join(name);
    let made = python().args(["-c", PICTURES, text(directory.path())]).output().unwrap();
    assert!(made.status.success(), "{}", String::from_utf8_lossy(&made.stderr));
    let list = to("phases.txt");
    std::fs::write(&list, "\u{feff}# with a mark\r\n0\r\n1\r\n2\r\n3\r\n4\r\n5\r\n").unwrap();
    let (png, jpg, tif) = (to("png"), to("jpg"), to("pages.tif"));
    let timed = ["--phases", "6", "--frames", "1-6", "--phase-list", text(&list)];
    let geometry = ["--sid", "1000,1100", "--sod", "750", "--pixel", "2", "--angles", "-30,20;40,-10"];
    let out = to("display");
    ok(&[&["import", "pictures", text(&png), text(&jpg), "-o", text(&out)], &timed[..], &geometry].concat());
    let read = Dataset::open(&out).unwrap();
    assert_eq!((read.frames.len(), read.views.len(), read.n_phases), (12, 2, 6));
    let exact = off(&read, 0, &to("png.npy"));
    assert!(exact < 1e-6, "PNG: {exact}");
    // Decoders of JPEG may differ by a level or two of 255.
    let near = off(&read, 1, &to("jpg.npy"));
    assert!(near < 2.5 * 3.0 / 255.0, "JPEG: {near}");
    let stated = manifest(&out);
    for (frame, [primary, secondary, sid]) in [(0, [-30.0, 20.0, 1000.0]), (6, [40.0, -10.0, 1100.0])] {
        let geometry = &stated["frames"][frame]["geometry"];
        let wanted = json!([primary, secondary, sid, 750.0, [2.0, 2.0]]);
        let found = ["primary_deg", "secondary_deg", "sid_mm", "sod_mm", "pixel_mm"].map(|key| geometry[key].clone());
        assert_eq!(json!(found), wanted);
    }
    let out = to("linear");
    let linear = ["--intensity", "linear", "--white", "4095", "--angles", "0,0"];
    let one = ["--sid", "1000", "--sod", "750", "--pixel", "2"];
    ok(&[&["import", "pictures", text(&tif), "-o", text(&out)], &timed[..], &linear, &one].concat());
    let exact = off(&Dataset::open(&out).unwrap(), 0, &to("tif.npy"));
    assert!(exact < 1e-5, "TIFF: {exact}");

    let none = to("none");
    let import = ["import", "pictures", text(&png), text(&jpg), "-o", text(&none)];
    let refused = |more: &[&str], code: i32, parts: &[&str]| {
        fails(&[&import[..], &geometry, more].concat(), code, parts);
        assert!(!none.exists(), "{more:?} leaves something behind");
    };
    refused(&["--heart-rate", "60"], 1, &["png", "frames per second"]);
    refused(&["--fps", "15"], 1, &["png", "no ECG"]);
    refused(&["--fps", "15,15,15", "--still"], 2, &["--fps = 3", "2 runs"]);
    refused(&["--white", "0", "--still"], 2, &["white = 0"]);
    let empty = to("empty");
    std::fs::create_dir(&empty).unwrap();
    let alone = ["--angles", "0,0", "--still"];
    fails(
        &[&["import", "pictures", text(&empty), "-o", text(&none)], &one[..], &alone].concat(),
        1,
        &["empty", ".png"],
    );
    std::fs::copy(png.join("frame8.png"), empty.join("1.png")).unwrap();
    image::GrayImage::new(10, 10).save(empty.join("2.png")).unwrap();
    fails(&[&["import", "pictures", text(&empty), "-o", text(&none)], &one[..], &alone].concat(), 1, &["2.png", "10"]);
}

#[test]
fn a_file_states_what_options_state_of_pictures() {
    let directory = tempfile::tempdir().unwrap();
    let to = |name: &str| directory.path().join(name);
    let made = python().args(["-c", PICTURES, text(directory.path())]).output().unwrap();
    assert!(made.status.success(), "{}", String::from_utf8_lossy(&made.stderr));
    let (png, jpg, file) = (to("png"), to("jpg"), to("views.toml"));
    let write = |content: &str| std::fs::write(&file, content).unwrap();
    let contents = |out: &Path| {
        let mut files: Vec<(PathBuf, Vec<u8>)> = std::fs::read_dir(out.join("images"))
            .unwrap()
            .map(|entry| entry.unwrap().path())
            .map(|path| (path.file_name().unwrap().into(), std::fs::read(&path).unwrap()))
            .collect();
        files.sort();
        (manifest(out), files)
    };
    let peaks = to("peaks.txt");
    std::fs::write(&peaks, "0\n0.3\n0.6\n").unwrap();
    let by_options =
        ["--sid", "1000,1100", "--sod", "750", "--pixel", "2,2.5", "--angles", "-30,20;40,-10", "--fps", "10"];
    let common = ["--phases", "3", "--frames", "1-6"];
    let (options, by_file) = (to("options"), to("by-file"));
    let given = ["import", "pictures", text(&png), text(&jpg), "-o", text(&options), "--r-peaks", text(&peaks)];
    ok(&[&given[..], &by_options, &common].concat());
    write(VIEWS);
    let import = |out: &Path, more: &[&str]| {
        let words = ["import", "pictures", "--geometry", text(&file), "-o", text(out)];
        [&words[..], &common, more].concat().into_iter().map(str::to_owned).collect::<Vec<_>>()
    };
    let run = |out: &Path, more: &[&str]| ok(&import(out, more).iter().map(String::as_str).collect::<Vec<_>>());
    run(&by_file, &[]);
    assert_eq!(contents(&by_file), contents(&options));
    // An option that states phases takes precedence, and a cropped picture keeps its place on the detector.
    write(
        &VIEWS
            .replace("r_peaks_s = [0, 0.3, 0.6]\n", "")
            .replace("angles_deg = [40, -10]", "angles_deg = [40, -10]\noffset_mm = [3, -1]"),
    );
    let cropped = to("cropped");
    run(&cropped, &["--r-peaks", text(&peaks)]);
    assert_eq!(manifest(&cropped)["frames"][3]["geometry"]["offset_mm"], json!([3.0, -1.0]));
    // An object at rest.
    write(&format!("still = true\n{}", VIEWS.replace("r_peaks_s = [0, 0.3, 0.6]\n", "")));
    let (rest, rest_by_options) = (to("rest"), to("rest-by-options"));
    run(&rest, &[]);
    let given = ["import", "pictures", text(&png), text(&jpg), "-o", text(&rest_by_options), "--still"];
    ok(&[&given[..], &by_options, &common].concat());
    assert_eq!(contents(&rest), contents(&rest_by_options));
    assert_eq!(manifest(&rest)["still"], json!(true));

    let none = to("none");
    let refused = |from: &str, with: &str, parts: &[&str]| {
        assert!(VIEWS.contains(from), "{from}");
        write(&VIEWS.replacen(from, with, 1));
        let words = import(&none, &[]);
        let parts: Vec<&str> = ["views.toml"].into_iter().chain(parts.iter().copied()).collect();
        fails(&words.iter().map(String::as_str).collect::<Vec<_>>(), 1, &parts);
        assert!(!none.exists(), "{with} leaves something behind");
    };
    refused("sid_mm = 1100", "sid_mm = 0", &["view 2: sid_mm"]);
    refused("sid_mm = 1100", "sid = 1100", &["line 14", "sid"]);
    refused("sod_mm = 750", "", &["view 1: sod_mm: is missing"]);
    refused("pixel_mm = [2, 2.5]", "pixel_mm = [2]", &["line 3", "two numbers"]);
    refused("pixel_mm = [2, 2.5]", "pixel_mm = [2, 1e-300]", &["view 1: pixel_mm[1]: 1e-300"]);
    refused("fps = 10", "fps = -10", &["view 1: fps: -10"]);
    refused("[0, 0.3, 0.6]", "[0, 0.3, 0.1]", &["view 1: r_peaks_s", "0.1"]);
    refused("[all]", "still = true\n[all]", &["view 1: r_peaks_s", "still = true"]);
    refused("angles_deg = [-30, 20]", "angles_deg = [-30, 20]\nphases = [0]", &["view 1: r_peaks_s", "phases"]);
    refused("angles_deg = [-30, 20]", "", &["angles_deg"]);
    fails(&["import", "pictures", text(&png), "--geometry", text(&file), "-o", text(&none)], 2, &["--geometry"]);
    fails(&["import", "pictures", text(&png), "-o", text(&none)], 2, &["--angles", "--sid", "--sod", "--pixel"]);
}

/// Views as a file states them.
const VIEWS: &str = "[all]
sod_mm = 750
pixel_mm = [2, 2.5]
fps = 10

[[view]]
path = \"png\"
angles_deg = [-30, 20]
sid_mm = 1000
r_peaks_s = [0, 0.3, 0.6]

[[view]]
path = \"jpg\"
sid_mm = 1100
angles_deg = [40, -10]
r_peaks_s = [0, 0.3, 0.6]
";

/// Writes two runs from different angles; the second has no geometry.
fn two_runs(directory: &Path) -> [PathBuf; 2] {
    ["whole.dcm", "bare.dcm"].map(|name| {
        let file = directory.join(name);
        angiogram(&file, |o| {
            o.put(DataElement::new(
                tags::SOP_INSTANCE_UID,
                VR::UI,
                PrimitiveValue::from(format!("1.2.{}", name.len())),
            ));
            if name == "bare.dcm" {
                for tag in [
                    tags::POSITIONER_PRIMARY_ANGLE,
                    tags::POSITIONER_SECONDARY_ANGLE,
                    tags::DISTANCE_SOURCE_TO_DETECTOR,
                    tags::DISTANCE_SOURCE_TO_PATIENT,
                ] {
                    o.remove_element(tag);
                }
            }
        });
        file
    })
}

#[test]
fn missing_tags_are_stated_by_options_of_all_runs_or_of_each() {
    let directory = tempfile::tempdir().unwrap();
    let [whole, bare] = two_runs(directory.path());
    let out = directory.path().join("data");
    let import = |file: &Path, more: &[&str]| -> Vec<String> {
        let args = ["import", "dicom", text(file), "-o", text(&out), "--still", "--force"];
        args.iter().chain(more).map(|s| (*s).to_owned()).collect()
    };
    let refused = |more: &[&str], part: &str| {
        let args = import(&bare, more);
        fails(&args.iter().map(String::as_str).collect::<Vec<_>>(), 1, &["bare.dcm", part]);
    };
    refused(&[], "--angles");
    refused(&["--angles", "-30,15"], "--sid");
    refused(&["--angles", "-30,15", "--sid", "1050"], "--sod");
    let geometry = |file: &Path, more: &[&str]| {
        let args = import(file, more);
        ok(&args.iter().map(String::as_str).collect::<Vec<_>>());
        let geometry = manifest(&out)["frames"][0]["geometry"].clone();
        ["primary_deg", "secondary_deg", "sid_mm", "sod_mm"].map(|key| geometry[key].as_f64().unwrap())
    };
    let stated = ["--angles", "-30,15", "--sid", "1050", "--sod", "720"];
    assert_eq!(geometry(&bare, &stated), [-30.0, 15.0, 1050.0, 720.0]);
    assert_eq!(geometry(&whole, &[]), [30.0, -20.0, 1000.0, 700.0], "as the file states it");
    assert_eq!(geometry(&whole, &stated), [-30.0, 15.0, 1050.0, 720.0], "what is stated takes precedence");
    let each = ["--angles", "5,6;-30,15", "--sid", "1000,1050", "--sod", "720"];
    ok(&[&["import", "dicom", text(&whole), text(&bare), "-o", text(&out), "--still", "-f"], &each[..]].concat());
    let views: Vec<Value> =
        manifest(&out)["frames"].as_array().unwrap().iter().map(|f| f["geometry"]["sid_mm"].clone()).collect();
    assert_eq!(views, [1000.0, 1000.0, 1050.0, 1050.0].map(Value::from));
    let three = ["import", "dicom", text(&whole), text(&bare), "-o", "none", "--still", "--sid", "1,2,3"];
    fails(&three, 2, &["--sid = 3", "2 runs"]);
}

#[test]
fn each_run_may_have_r_peaks_of_its_own() {
    let directory = tempfile::tempdir().unwrap();
    let to = |name: &str| directory.path().join(name);
    let [file, _] = two_runs(directory.path());
    let peaks = [("a.txt", "-0.05\n0.55\n1.15\n"), ("b.txt", "0.15\n0.75\n")];
    let lists = peaks.map(|(name, times)| {
        std::fs::write(to(name), times).unwrap();
        to(name)
    });
    let other = to("other.dcm");
    angiogram(&other, |o| {
        o.put(DataElement::new(tags::POSITIONER_PRIMARY_ANGLE, VR::DS, PrimitiveValue::from("-30")));
    });
    let options = ["--phases", "6", "--frames", "1-6", "--beat-scaling", "linear"];
    let phases = |files: &[&Path], lists: &[&Path]| -> Vec<(f64, u64)> {
        let out = tempfile::tempdir().unwrap();
        let mut args = vec!["import", "dicom", "-o", text(out.path())];
        args.extend(files.iter().map(|file| text(file)));
        args.extend(lists.iter().flat_map(|list| ["--r-peaks", text(list)]));
        args.extend(options);
        ok(&args);
        let frames = manifest(out.path())["frames"].clone();
        let of = |frame: &Value| (frame["geometry"]["primary_deg"].as_f64().unwrap(), frame["phase"].as_f64().unwrap());
        frames.as_array().unwrap().iter().map(of).map(|(angle, phase)| (angle, (1e6 * phase).round() as u64)).collect()
    };
    // A frame every 0.1 s, and a beat of 0.6 s: the frame at 0 s is half a phase after the first list's R-peak.
    let each = phases(&[&file, &other], &[&lists[0], &lists[1]]);
    let of = |angle: f64| each.iter().filter(|(at, _)| *at == angle).map(|(_, phase)| *phase).collect::<Vec<_>>();
    assert_eq!(of(30.0), [0, 1, 2, 3, 4, 5].map(|phase| phase * 1_000_000));
    // Its R-peaks come 0.2 s later, so that its first frame is four phases after the one before.
    let mut later = of(-30.0);
    later.sort_unstable();
    assert_eq!(later, [0, 1, 2, 3, 4, 5].map(|phase| phase * 1_000_000));
    assert_eq!(phases(&[&other], &[&lists[1]]), each[6..]);
    let three = ["--r-peaks", text(&lists[0]), "--r-peaks", text(&lists[1]), "--r-peaks", text(&lists[0])];
    fails(
        &[&["import", "dicom", text(&file), text(&other), "-o", text(&to("none"))], &three[..]].concat(),
        2,
        &["--r-peaks = 3", "2 runs"],
    );
}

/// Writes a volume of a tube of 3 mm radius along x, 40 mm long, in water of 60 mm.
fn tube(path: &Path) {
    let value = |i: usize| {
        let [x, y, z] = [i % 60, i / 60 % 60, i / 3600].map(|n| n as f64 - 29.5);
        if x.abs() < 20.0 && y.hypot(z) < 2.0 { 0.1 } else { 0.005 }
    };
    npy::write(path, &[60, 60, 60], &(0..216_000).map(|i| value(i) as f32).collect::<Vec<_>>()).unwrap();
}

#[test]
fn an_object_at_rest_comes_out_with_one_phase() {
    let directory = tempfile::tempdir().unwrap();
    let to = |name: &str| directory.path().join(name);
    tube(&to("tube.npy"));
    let data = to("data");
    let project =
        ["project", text(&to("tube.npy")), "--spacing", "1,1,1", "--centre", "--size", "64", "--vessel", "0.05"]
            .map(str::to_owned);
    let project: Vec<&str> = project.iter().map(String::as_str).collect();
    ok(&[&project[..], &["--still", "-o", text(&data), "--fov", "90"]].concat());
    let stated = manifest(&data);
    assert_eq!((&stated["still"], &stated["phases"]), (&json!(true), &json!(1)));
    let read = Dataset::open(&data).unwrap();
    assert!(read.still && read.n_phases == 2 && read.shown_phases() == 1);
    // The appearance without vessels is the water alone: at most a tenth of the vessel's own line integral remains.
    let of = |view: usize, phase: u32| {
        let frame = read.training().iter().find(|f| (f.view, f.phase) == (view, phase)).unwrap();
        (frame.integrals.to_vec(), frame.mask.clone())
    };
    for view in read.training_views() {
        let ((shown, mask), (without, _)) = (of(view, 0), of(view, 1));
        let inside: Vec<f32> = shown.iter().zip(&without).map(|(a, b)| a - b).collect();
        let vessel = inside.iter().copied().fold(0.0, f32::max);
        assert!((0.2..0.8).contains(&vessel), "a tube of 4 mm and 0.095 per mm has 0.38 across: {vessel}");
        let missed = mask.unwrap().iter().zip(&inside).filter(|(m, d)| !**m && d.abs() > 0.15 * vessel).count();
        assert!(missed < 64, "{missed} pixels beside the vessel changed");
    }
    assert!(read.frames.iter().filter(|f| f.split == Split::Validation).all(|f| f.phase == 0));

    let run = to("run");
    ok(&["train", text(&data), "-o", text(&run), "--iterations", "150", "--no-eval", "--tree"]);
    assert!(run.join("tree.json").is_file(), "with its tree");
    ok(&["tree", text(&run), "-o", text(&to("tree.json"))]);
    let tree: Value = serde_json::from_slice(&std::fs::read(to("tree.json")).unwrap()).unwrap();
    assert_eq!(tree["phases"].as_array().unwrap().len(), 1);
    let length = tree["phases"][0]["length_mm"].as_f64().unwrap();
    assert!((25.0..60.0).contains(&length), "a tube of 40 mm, not {length}");
    ok(&["tree", text(&run), "-o", text(&to("tree.vtp"))]);
    ok(&["export", text(&run), "--spacing", "4", "-o", text(&to("volume.npy"))]);
    assert_eq!(npy::read(&to("volume.npy"), 1 << 24).unwrap().shape.len(), 3, "no axis of phases");
    ok(&["export", text(&run), "--spacing", "2", "--mesh", "-o", text(&to("surface.stl"))]);
    assert!(to("tree.vtp").is_file() && to("surface.stl").is_file());
    ok(&["render", text(&run), "--phase", "all", "--component", "dynamic", "-o", text(&to("all.npy"))]);
    assert_eq!(npy::read(&to("all.npy"), 1 << 24).unwrap().shape, [1, 64, 64]);
    fails(&["export", text(&run), "--phase", "1", "-o", text(&to("x.npy"))], 2, &["--phase = 1", "0 to 0"]);
    fails(&["render", text(&run), "--phase", "0.5", "-o", text(&to("x.png"))], 2, &["--phase = 0.5"]);
    fails(&["render", text(&run), "--phase", "all", "--between", "1", "-o", text(&to("x.gif"))], 2, &["at rest"]);
    let about = ok(&["info", text(&run)]);
    assert!(about.contains("phases: 1") && about.contains("still: true"), "{about}");
    fails(
        &[&project[..], &[text(&to("tube.npy")), "--still", "-o", text(&to("two"))]].concat(),
        2,
        &["still = 2", "at rest"],
    );
}

#[test]
fn a_manifest_of_an_object_at_rest_may_hold_its_own_background() {
    let directory = tempfile::tempdir().unwrap();
    let data = directory.path();
    let frame = |name: &str, phase: u32| {
        npy::write(&data.join(format!("{name}.npy")), &[4, 5], &[0.5 + phase as f32; 20]).unwrap();
        json!({
            "image": format!("{name}.npy"), "phase": phase, "split": "train", "intensity": {"kind": "integral"},
            "geometry": {"primary_deg": 0, "secondary_deg": 0, "sid_mm": 1000, "sod_mm": 600, "pixel_mm": [1, 1]},
        })
    };
    let write = |phases: u32, frames: &[Value]| {
        let manifest = json!({
            "format": "nertca-dataset", "version": 1, "phases": phases, "depth_half_extent_mm": 100, "still": true,
            "frames": frames,
        });
        std::fs::write(data.join("dataset.json"), manifest.to_string()).unwrap();
    };
    write(2, &[frame("shown", 0), frame("background", 1)]);
    let read = Dataset::open(data).unwrap();
    let levels: Vec<(u32, f32)> = read.frames.iter().map(|frame| (frame.phase, frame.integrals[0])).collect();
    assert_eq!(levels, [(0, 0.5), (1, 1.5)], "nothing is made up where the background is given");
    write(3, &[frame("shown", 0)]);
    fails(&["info", text(data)], 1, &["dataset.json", "phases", "at rest"]);
}

#[cfg(unix)]
#[test]
fn paths_that_are_not_text_work() {
    use std::os::unix::ffi::OsStrExt;
    let directory = tempfile::tempdir().unwrap();
    let name = |bytes: &[u8]| directory.path().join(std::ffi::OsStr::from_bytes(bytes));
    let (data, run) = (name(b"lat\xe9ral"), name(b"lat\xe9ral run"));
    let run_of = |args: &[&std::ffi::OsStr]| {
        let out = program().args(args).output().unwrap();
        let said = String::from_utf8_lossy(&out.stderr).into_owned();
        assert!(out.status.success(), "{args:?}: {said}");
        String::from_utf8_lossy(&out.stdout).into_owned()
    };
    let arg = |text: &'static str| std::ffi::OsStr::new(text);
    let small = ["--size", "24", "--phases", "3", "--views", "3", "--no-volumes"].map(arg);
    run_of(&[&[arg("phantom"), data.as_os_str()], &small[..]].concat());
    let short =
        ["--set", "train.iterations=12", "--set", "gaussians.iterations=10", "--set", "march.render_samples=24"];
    let train = [arg("train"), data.as_os_str(), arg("-o"), run.as_os_str(), arg("--json")];
    let lines = run_of(&[&train[..], &short.map(arg)].concat());
    let saved = lines.lines().map(|line| serde_json::from_str::<Value>(line).unwrap()).find(|l| l["event"] == "saved");
    let bytes: Vec<u8> = serde_json::from_value(saved.unwrap()["path"]["bytes"].clone()).unwrap();
    assert!(bytes.starts_with(run.as_os_str().as_bytes()));
    assert!(run_of(&[arg("eval"), run.as_os_str()]).contains("mean of"), "it finds the dataset again");
    run_of(&[arg("info"), arg("--json"), run.as_os_str()]);
    let series = name(b"b\xe9at.vtk");
    let export = [arg("export"), run.as_os_str(), arg("--spacing"), arg("20"), arg("-o"), series.as_os_str()];
    assert_eq!(run_of(&export).lines().count(), 3);
    assert!(name(b"b\xe9at_0002.vtk").is_file(), "the name is kept as it is");
}

#[test]
fn backslashes_of_other_systems_separate_folders() {
    let directory = tempfile::tempdir().unwrap();
    let data = directory.path().join("data");
    ok(&["phantom", text(&data), "--size", "24", "--phases", "2", "--views", "3", "--no-volumes"]);
    let file = data.join("dataset.json");
    let written = std::fs::read_to_string(&file).unwrap();
    let before = Dataset::open(&data).unwrap();
    std::fs::write(
        &file,
        format!("\u{feff}{}", written.replace("images/", "images\\\\").replace("masks/", "masks\\\\")),
    )
    .unwrap();
    let after = Dataset::open(&data).unwrap();
    assert_eq!(before.frames.len(), after.frames.len());
    assert!(before.frames.iter().zip(&after.frames).all(|(a, b)| (&a.integrals, &a.mask) == (&b.integrals, &b.mask)));
}

#[test]
fn names_of_files_do_not_command_the_terminal() {
    let directory = tempfile::tempdir().unwrap();
    let file = directory.path().join("a\u{1b}[31mb.dcm");
    std::fs::write(&file, "x").unwrap();
    let out = program().args(["import", "dicom", text(&file), "-o", "none", "--still"]).output().unwrap();
    let said = String::from_utf8(out.stderr).unwrap();
    assert_eq!(out.status.code(), Some(1));
    assert!(!said.contains('\u{1b}') && said.contains("a\\u{1b}[31mb.dcm"), "{said}");
}

#[test]
fn variables_that_hide_drivers_are_named() {
    let nowhere = [("VK_ICD_FILENAMES", "/nowhere/icd.json"), ("VK_DRIVER_FILES", "/nowhere/driver.json")];
    for (variable, value) in nowhere.into_iter().chain([("VK_ICD_FILENAMES", ""), ("VK_DRIVER_FILES", "")]) {
        let mut devices = program();
        devices.env_remove("VK_ICD_FILENAMES").env_remove("VK_DRIVER_FILES").env(variable, value);
        let out = devices.args(["phantom", "never made"]).output().unwrap();
        let said = String::from_utf8(out.stderr).unwrap();
        assert_eq!(out.status.code(), Some(3), "{said}");
        assert!(said.contains(&format!("{variable}={value}")) && said.contains("hides"), "{said}");
    }
}

#[test]
fn projections_of_rtk_are_imported() {
    let directory = tempfile::tempdir().unwrap();
    let at = |name: &str| directory.path().join(name);
    let [geometry, stack] =
        ["geometry.xml", "projections.mha"].map(|name| crate::root::root().join("tests/formats/rtk").join(name));
    std::fs::write(at("phases.txt"), "0\n0.5 # between two phases\n1\n2\n").unwrap();
    let import = ["import", "rtk", text(&geometry), text(&stack), "--phases", "3", "-o"];
    let (data, still) = (at("data"), at("still"));
    ok(&[&import[..], &[text(&data), "--phase-list", text(&at("phases.txt"))]].concat());
    let written = manifest(&data);
    assert_eq!(written["phases"], 3);
    let phases: Vec<&Value> = written["frames"].as_array().unwrap().iter().map(|frame| &frame["phase"]).collect();
    assert_eq!(phases, [&json!(0), &json!(0.5), &json!(1), &json!(2)]);
    assert!(written["frames"][3]["geometry"]["matrix"].is_array());
    ok(&[&import[..], &[text(&still), "--still"]].concat());
    assert_eq!((Dataset::open(&still).unwrap().still, Dataset::open(&still).unwrap().views.len()), (true, 4));
    fails(&[&import[..], &[text(&at("none"))]].concat(), 2, &["--phase-list", "--still"]);
    fails(&[&import[..], &[text(&still), "--still"]].concat(), 2, &["already contains a dataset", "--force"]);
    let none = at("none");
    let swapped = ["import", "rtk", text(&stack), text(&geometry), "--still", "-o", text(&none)];
    fails(&swapped, 2, &["PROJECTIONS", ".mha"]);
}
