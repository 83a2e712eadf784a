//! Interoperability with other tools: exports opened by them, datasets converted, invalid DICOM files, the page and the
//! viewer.

use crate::dicom::angiogram;
use crate::program::program;
use crate::python::python;
use dicom_core::{DataElement, PrimitiveValue, VR};
use dicom_dictionary_std::tags;
use dicom_object::InMemDicomObject;
use std::io::{BufRead, BufReader, Read, Write};
use std::net::TcpStream;
use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};
use std::sync::OnceLock;

fn nertca(args: &[&str]) -> Output {
    program().args(args).output().unwrap()
}

fn text(path: &Path) -> &str {
    path.to_str().unwrap()
}

#[track_caller]
fn ok(args: &[&str]) -> String {
    let out = nertca(args);
    assert!(out.status.success(), "{args:?}: {}", String::from_utf8_lossy(&out.stderr));
    String::from_utf8(out.stdout).unwrap()
}

#[track_caller]
fn fails(args: &[&str], code: i32, parts: &[&str]) {
    let out = nertca(args);
    let stderr = String::from_utf8_lossy(&out.stderr);
    assert_eq!(out.status.code(), Some(code), "{args:?}: {stderr}");
    assert!(!stderr.contains("panicked"), "{args:?}: {stderr}");
    parts.iter().for_each(|part| assert!(stderr.contains(part), "{args:?} does not name `{part}`: {stderr}"));
}

/// A small run, created once: data and run directory.
fn trained() -> &'static (tempfile::TempDir, PathBuf, PathBuf) {
    static RUN: OnceLock<(tempfile::TempDir, PathBuf, PathBuf)> = OnceLock::new();
    RUN.get_or_init(|| {
        let dir = tempfile::tempdir().unwrap();
        let (data, run) = (dir.path().join("data é"), dir.path().join("a run"));
        ok(&["phantom", text(&data), "--size", "40", "--phases", "3", "--no-volumes"]);
        let short = ["train.iterations=150", "train.rays=256", "train.validate_every=50"];
        let set: Vec<&str> = short.iter().flat_map(|s| ["--set", s]).collect();
        ok(&[&["train", text(&data), "-o", text(&run)], &set[..]].concat());
        (dir, data, run)
    })
}

#[test]
fn exports_open_in_the_tools_people_use() {
    let (dir, _, run) = trained();
    let out = dir.path().join("exports");
    let to = |name: &str| out.join(name);
    let spacing = "1.5";
    for name in ["all.seq.nrrd", "all.nii", "all.mha", "all.npy", "all.vtk"] {
        ok(&["export", text(run), "--spacing", spacing, "-o", text(&to(name))]);
    }
    for name in ["one.nrrd", "one.nii", "one.mha", "one.npy", "one.vtk"] {
        ok(&["export", text(run), "--spacing", spacing, "--phase", "1", "-o", text(&to(name))]);
    }
    let iso = 0.0005;
    let mesh = ["export", text(run), "--mesh", "--spacing", spacing, "--iso", "0.0005"];
    for name in ["one.stl", "one.ply", "one.obj"] {
        ok(&[&mesh[..], &["--phase", "1", "-o", text(&to(name))]].concat());
    }
    ok(&[&mesh[..], &["-o", text(&to("beat.glb"))]].concat());
    std::fs::copy(run.join("checkpoint-0000150.safetensors"), to("checkpoint.safetensors")).unwrap();
    std::fs::copy(run.join("report/evaluation.json"), to("evaluation.json")).unwrap();
    // The expected content of the files is computed by the library itself.
    let model = nertca_vk::checkpoint::Checkpoint::read(&to("checkpoint.safetensors")).unwrap().model;
    let grid =
        nertca_vk::export::volumes::grid_over(&model.scene, nertca_vk::model::component::Component::Dynamic, 1.5)
            .unwrap();
    let expected = serde_json::json!({
        "origin_mm": grid.origin_mm.to_array(), "spacing_mm": grid.spacing_mm.to_array(), "size": grid.size,
        "phases": 3, "iso_per_mm": iso,
    });
    std::fs::write(to("expected.json"), expected.to_string()).unwrap();
    let root = crate::root::root();
    let outcome = python().arg(root.join("tests/python/check_exports.py")).arg(&out).output().unwrap();
    assert!(outcome.status.success(), "{}", String::from_utf8_lossy(&outcome.stderr));
}

#[test]
fn compressed_exports_hold_the_same() {
    let (dir, _, run) = trained();
    let out = dir.path().join("compressed");
    let export = |name: &str, extra: &[&str]| {
        ok(&[&["export", text(run), "--spacing", "1.5", "-o", text(&out.join(name))], extra].concat());
    };
    for name in ["all.nii", "all.nii.gz", "all.seq.nrrd"] {
        export(name, &[]);
    }
    export("one.nrrd", &["--phase", "1"]);
    export("named.nii.gz", &["--format", "nifti"]);
    export("zipped.seq.nrrd", &["--compress"]);
    export("zipped.nrrd", &["--compress", "--phase", "1"]);
    // Files that others read are also read by the library.
    let volume = |name: &str| {
        let hints = nertca_vk::formats::volume::VolumeHints::default();
        nertca_vk::formats::volume_files::read(&out.join(name), &hints).unwrap()
    };
    assert_eq!(volume("one.nrrd").values, volume("zipped.nrrd").values);
    for (name, extra) in [
        ("x.nii", &["--compress"][..]),
        ("x.mha", &["--compress"]),
        ("x.nrrd.gz", &["--format", "nrrd"]),
        ("x.nrrd.gz", &[]),
    ] {
        fails(&[&["export", text(run), "-o", text(&out.join(name))], extra].concat(), 2, &[name]);
        assert!(!out.join(name).exists(), "{name}");
    }
    let root = crate::root::root();
    let outcome = python().arg(root.join("tests/python/check_compressed.py")).arg(&out).output().unwrap();
    assert!(outcome.status.success(), "{}", String::from_utf8_lossy(&outcome.stderr));
}

#[test]
fn exports_refuse_what_makes_no_sense() {
    let (dir, _, run) = trained();
    let out = dir.path().join("x.nrrd");
    let refuse = |extra: &[&str], parts: &[&str]| fails(&[&["export", text(run)], extra].concat(), 2, parts);
    refuse(&["--spacing", "0", "-o", text(&out)], &["spacing_mm", "positive"]);
    refuse(&["--spacing", "1e-9", "-o", text(&out)], &["spacing_mm", "too many"]);
    refuse(&["--spacing", "nan", "-o", text(&out)], &["spacing_mm"]);
    refuse(&["--phase", "3", "-o", text(&out)], &["--phase", "0 to 2"]);
    refuse(&["-o", "volume.tiff"], &["--out", ".nrrd"]);
    refuse(&["--mesh", "-o", text(&out)], &[".stl"]);
    refuse(&["--mesh", "--iso=-1", "-o", "x.stl"], &["iso_per_mm"]);
    refuse(&["--mesh", "--iso", "1e6", "-o", "x.stl"], &["iso_per_mm", "no vessel"]);
    refuse(&["--mesh", "--component", "total", "-o", "x.stl"], &["--component"]);
    fails(&["export", text(run), "-o", "/dev/null/x.nrrd"], 1, &["/dev/null"]);
    assert!(!out.exists(), "nothing is left half written");
}

#[test]
fn datasets_convert_both_ways() {
    let (dir, data, _) = trained();
    let (theirs, ours) = (dir.path().join("theirs"), dir.path().join("ours"));
    ok(&["convert", text(data), "--layout", "nerfca", "-o", text(&theirs)]);
    ok(&["convert", text(&theirs), "--layout", "native", "-o", text(&ours)]);
    let [first, last] = [data, &ours].map(|p| nertca_vk::scan::dataset::Dataset::open(p).unwrap());
    assert_eq!((first.frames.len(), first.n_phases, first.width), (last.frames.len(), last.n_phases, last.width));
    for frame in &first.frames {
        let angles = first.views[frame.view].geometry.angles_deg();
        let same = |f: &&nertca_vk::scan::dataset::Frame| {
            f.phase == frame.phase && f.split == frame.split && last.views[f.view].geometry.angles_deg() == angles
        };
        let other = last.frames.iter().find(same).expect("the same view at the same phase");
        let far = frame.integrals.iter().zip(&other.integrals).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
        assert!(far < 1e-5, "{}: {far}", frame.name);
        assert_eq!(frame.mask, other.mask);
    }
}

#[test]
fn the_report_needs_nothing_but_itself() {
    let (_, _, run) = trained();
    let page = std::fs::read_to_string(run.join("report.html")).unwrap();
    for part in
        ["<svg", "37 minutes", "Dice", "data:image/png;base64,", "march_loss", "type=\"radio\"", "Configuration"]
    {
        assert!(page.contains(part), "{part}");
    }
    for outside in ["<script", "http://", "https://", "<link", "@import"] {
        // SVG is identified by an address that is never requested.
        let rest = page.replace("http://www.w3.org/2000/svg", "");
        assert!(!rest.contains(outside), "{outside}");
    }
    ok(&["eval", text(run)]);
    assert!(run.join("eval.html").is_file());
}

/// Status and body of the response to a request.
fn ask(port: u16, path: &str, headers: &str) -> (u16, Vec<u8>) {
    let mut stream = TcpStream::connect(("127.0.0.1", port)).unwrap();
    write!(stream, "GET {path} HTTP/1.1\r\n{headers}Connection: close\r\n\r\n").unwrap();
    let mut answer = Vec::new();
    stream.read_to_end(&mut answer).unwrap();
    let split = answer.windows(4).position(|w| w == b"\r\n\r\n").unwrap();
    let status = String::from_utf8_lossy(&answer[9..12]).parse().unwrap();
    (status, answer[split + 4..].to_vec())
}

#[test]
fn the_viewer_answers_its_own_page_alone() {
    let (dir, _, run) = trained();
    let mut server = program().args(["view", text(run)]).stdout(Stdio::piped()).stderr(Stdio::null()).spawn().unwrap();
    let mut url = String::new();
    BufReader::new(server.stdout.take().unwrap()).read_line(&mut url).unwrap();
    let url = url.trim();
    let rest = url.strip_prefix("http://127.0.0.1:").unwrap();
    let (port, token) = rest.split_once("/?token=").unwrap();
    let port: u16 = port.parse().unwrap();
    assert_eq!(token.len(), 32);
    let host = format!("Host: 127.0.0.1:{port}\r\n");
    let frame = |query: &str| format!("/frame?token={token}&{query}");
    let good = "primary=20&secondary=-10&phase=1&component=dynamic&projection=drr&size=64&low=0&high=1";
    assert_eq!(ask(port, &format!("/?token={token}"), &host).0, 200);
    assert_eq!(ask(port, &format!("/info?token={token}"), &host).0, 200);
    let (status, png) = ask(port, &frame(good), &host);
    assert_eq!(status, 200);
    let picture = image::load_from_memory(&png).unwrap().to_luma8();
    assert_eq!(picture.dimensions(), (64, 64));
    let (white, dark) = (|v: &u8| *v > 250, |v: &u8| *v < 200);
    assert!(picture.iter().filter(|v| white(v)).count() > picture.len() / 2, "vessels are few");
    assert!(picture.iter().filter(|v| dark(v)).count() > 8, "there are vessels");
    // Requests from others are refused.
    for (path, headers) in [
        ("/".to_owned(), host.clone()),
        ("/?token=00000000000000000000000000000000".into(), host.clone()),
        (frame(good), format!("Host: evil.example:{port}\r\n")),
        (frame(good), format!("{host}Origin: http://evil.example\r\n")),
        (frame(good), format!("{host}Sec-Fetch-Site: cross-site\r\n")),
        (format!("/info?x={token}"), host.clone()),
        ("/tree".into(), host.clone()),
    ] {
        assert_eq!(ask(port, &path, &headers).0, 403, "{path} {headers}");
    }
    for (from, to) in [
        ("phase=1", "phase=9"),
        ("size=64", "size=99999"),
        ("component=dynamic", "component=x"),
        ("low=0", "low=nan"),
        ("primary=20", "primary=1e99"),
        ("&projection=drr", ""),
    ] {
        let (status, body) = ask(port, &frame(&good.replace(from, to)), &host);
        assert_eq!(status, 400, "{to}: {}", String::from_utf8_lossy(&body));
    }
    browse(url, dir.path());
    server.kill().unwrap();
    server.wait().unwrap();
}

/// Opens the page in a headless browser: it draws vessels.
fn browse(url: &str, dir: &Path) {
    let shot = dir.join("view.png");
    Command::new("chromium")
        .args(["--headless", "--no-sandbox", "--disable-gpu", "--no-first-run", "--disable-background-networking"])
        .args(["--disable-component-update", "--disable-sync", "--window-size=900,600", "--virtual-time-budget=20000"])
        .arg(format!("--user-data-dir={}", dir.join("browser").display()))
        .arg(format!("--screenshot={}", shot.display()))
        .arg(url)
        .output()
        .unwrap_or_else(|e| panic!("chromium is needed to look at the viewer with: {e}"));
    let picture = image::open(&shot).unwrap().to_luma8();
    // The picture is on the left: white with dark vessels in its centre.
    let stage: Vec<u8> =
        (100..500).flat_map(|y| (100..500).map(move |x| (x, y))).map(|(x, y)| picture[(x, y)].0[0]).collect();
    let (white, dark) = (stage.iter().filter(|v| **v > 230).count(), stage.iter().filter(|v| **v < 160).count());
    assert!(white > stage.len() / 3 && dark > 100, "{white} white and {dark} dark of {} pixels", stage.len());
}

fn set(tag: dicom_core::Tag, vr: VR, value: &str) -> impl Fn(&mut InMemDicomObject) {
    let value = value.to_owned();
    move |o: &mut InMemDicomObject| {
        o.put(DataElement::new(tag, vr, PrimitiveValue::from(value.as_str())));
    }
}

#[test]
fn dicom_runs_get_phases_and_lose_their_patient() {
    let dir = tempfile::tempdir().unwrap();
    let files: Vec<PathBuf> = [("left view ü.dcm", "30"), ("right.dcm", "-30")]
        .map(|(name, angle)| {
            let file = dir.path().join(name);
            angiogram(&file, set(tags::POSITIONER_PRIMARY_ANGLE, VR::DS, angle));
            file
        })
        .to_vec();
    let out = dir.path().join("data");
    let import = |extra: &[&str]| {
        let args = [&["import", "dicom", text(&files[0]), text(&files[1]), "-o", text(&out), "--frames", "1-6"], extra];
        args.concat().iter().map(|s| (*s).to_owned()).collect::<Vec<_>>()
    };
    let run = |args: &[String]| nertca(&args.iter().map(String::as_str).collect::<Vec<_>>());
    // At 100 beats per minute a beat has 0.6 s, which is six frames of 0.1 s.
    let evenly = ["--phases", "6", "--heart-rate", "100", "--beat-scaling", "linear"];
    assert!(run(&import(&evenly)).status.success());
    let dataset = nertca_vk::scan::dataset::Dataset::open(&out).unwrap();
    assert_eq!((dataset.n_phases, dataset.training().len(), dataset.width), (6, 12, 64));
    let frame = dataset.training().iter().find(|f| f.phase == 2 && f.view == 0).unwrap();
    let row = &frame.integrals[30 * 64..31 * 64];
    let darkest = (0..64).max_by(|a, b| row[*a].total_cmp(&row[*b])).unwrap();
    assert!((25..=27).contains(&darkest), "the bar of the third frame is at column 26, not {darkest}");
    // A list of phases gives the same result.
    let list = dir.path().join("phases.txt");
    std::fs::write(&list, "# one per frame\n0\n1\n2\n3\n4\n5\n").unwrap();
    let again = dir.path().join("again");
    let mut args = import(&["--phases", "6", "--phase-list", text(&list)]);
    args[5] = text(&again).to_owned();
    assert!(run(&args).status.success());
    for (a, b) in nertca_vk::scan::dataset::Dataset::open(&again).unwrap().frames.iter().zip(&dataset.frames) {
        assert_eq!((a.phase, &a.integrals), (b.phase, &b.integrals));
    }
    let manifest = std::fs::read_to_string(out.join("dataset.json")).unwrap();
    assert!(!manifest.contains("SECRET"));
    // Without an ECG or a choice, the message says what is needed.
    let mut args = import(&["--phases", "6"]);
    args[5] = text(&dir.path().join("none")).to_owned();
    let none = run(&args);
    assert!(String::from_utf8_lossy(&none.stderr).contains("a heart rate"));
}

#[test]
fn dicom_nobody_should_send_is_refused_by_name() {
    let dir = tempfile::tempdir().unwrap();
    let out = dir.path().join("never made");
    let refuse = |name: &str, part: &str, options: &[&str]| {
        let file = dir.path().join(name);
        let args = ["import", "dicom", text(&file), "-o", text(&out), "--still"];
        // Either the file or the options are at fault.
        let code = if options.is_empty() { 1 } else { 2 };
        fails(&[&args[..], options].concat(), code, &[part]);
        assert!(!out.exists(), "{name}: something was written");
    };
    type Change = Box<dyn Fn(&mut InMemDicomObject)>;
    let remove = |tag| -> Change {
        Box::new(move |o: &mut InMemDicomObject| {
            o.remove_element(tag);
        })
    };
    let cases: Vec<(&str, &str, Change)> = vec![
        ("ct.dcm", "(0008,0060) Modality", Box::new(set(tags::MODALITY, VR::CS, "CT"))),
        ("rgb.dcm", "PhotometricInterpretation", Box::new(set(tags::PHOTOMETRIC_INTERPRETATION, VR::CS, "RGB"))),
        ("no angle.dcm", "(0018,1510)", remove(tags::POSITIONER_PRIMARY_ANGLE)),
        ("angle.dcm", "(0018,1511)", Box::new(set(tags::POSITIONER_SECONDARY_ANGLE, VR::DS, "999"))),
        ("words.dcm", "(0018,1510)", Box::new(set(tags::POSITIONER_PRIMARY_ANGLE, VR::DS, "left"))),
        ("sid.dcm", "(0018,1110)", Box::new(set(tags::DISTANCE_SOURCE_TO_DETECTOR, VR::DS, "-1000"))),
        ("sod.dcm", "(0018,1111)", Box::new(set(tags::DISTANCE_SOURCE_TO_PATIENT, VR::DS, "2000"))),
        ("no sid.dcm", "(0018,1110)", remove(tags::DISTANCE_SOURCE_TO_DETECTOR)),
        ("spacing.dcm", "(0018,1164)", Box::new(set(tags::IMAGER_PIXEL_SPACING, VR::DS, "0\\0"))),
        ("no spacing.dcm", "pixel spacing", remove(tags::IMAGER_PIXEL_SPACING)),
        ("frames.dcm", "(0028,0008)", Box::new(set(tags::NUMBER_OF_FRAMES, VR::IS, "0"))),
        ("many.dcm", "(0028,0008)", Box::new(set(tags::NUMBER_OF_FRAMES, VR::IS, "100000"))),
        ("too few pixels.dcm", "(7FE0,0010) PixelData", Box::new(set(tags::NUMBER_OF_FRAMES, VR::IS, "50"))),
        ("no pixels.dcm", "(7FE0,0010)", remove(tags::PIXEL_DATA)),
        ("time.dcm", "(0018,1063)", Box::new(set(tags::FRAME_TIME, VR::DS, "soon"))),
        ("shutter.dcm", "ShutterLeft", Box::new(set(tags::SHUTTER_LEFT_VERTICAL_EDGE, VR::IS, "64"))),
    ];
    for (name, part, change) in cases {
        angiogram(&dir.path().join(name), change);
        // The missing value could also be given as an option, but the message names the file nevertheless.
        let args = ["import", "dicom", text(&dir.path().join(name)), "-o", text(&out), "--still"].map(str::to_owned);
        fails(&args.iter().map(String::as_str).collect::<Vec<_>>(), 1, &[part, name]);
        assert!(!out.exists(), "{name}: something was written");
    }
    angiogram(&dir.path().join("good.dcm"), |_| ());
    let good = std::fs::read(dir.path().join("good.dcm")).unwrap();
    for (name, bytes) in [
        ("empty.dcm", Vec::new()),
        ("short.dcm", good[..100].to_vec()),
        ("truncated.dcm", good[..good.len() / 2].to_vec()),
        ("noise.dcm", good.iter().rev().copied().collect()),
    ] {
        std::fs::write(dir.path().join(name), bytes).unwrap();
        refuse(name, name, &[]);
    }
    refuse("not there.dcm", "not there.dcm", &[]);
    refuse("good.dcm", "frames", &["--frames", "3-9"]);
    refuse("good.dcm", "size", &["--size", "2"]);
    fails(&["import", "dicom", text(dir.path()), "-o", text(&out), "--still"], 1, &["is a folder"]);
}

/// Centre of a square of a colour, in which nearly all pixels have the colour.
fn square_of(picture: &image::RgbImage, colour: image::Rgb<u8>, [left, top]: [u32; 2], side: u32) -> Option<[f64; 2]> {
    const HALF: i64 = 5;
    let has = |x: i64, y: i64| picture.get_pixel_checked(x as u32, y as u32) == Some(&colour);
    let full = |x: u32, y: u32| {
        let around = (-HALF..=HALF).flat_map(|dy| (-HALF..=HALF).map(move |dx| (i64::from(x) + dx, i64::from(y) + dy)));
        around.filter(|(x, y)| has(*x, *y)).count()
    };
    let places = (top + 6..top + side - 6).flat_map(|y| (left + 6..left + side - 6).map(move |x| (x, y)));
    let (x, y) = places.max_by_key(|(x, y)| full(*x, *y))?;
    (full(x, y) >= 95).then(|| [f64::from(x), f64::from(y)])
}

#[test]
fn the_picture_of_a_geometry_has_sources_where_they_are() {
    let (dir, data, run) = trained();
    let file = dir.path().join("geometry.png");
    assert!(ok(&["info", text(data), "--picture", text(&file)]).contains("geometry.png"));
    let picture = image::open(&file).unwrap().to_rgb8();
    let field = picture.width() / 2;
    let dataset = nertca_vk::scan::dataset::Dataset::open(data).unwrap();
    // Colours of the lines with the names of views: the first coloured pixel of each row of letters.
    let mut colours: Vec<image::Rgb<u8>> = Vec::new();
    for y in 0..field {
        let coloured = |p: &image::Rgb<u8>| p.0.iter().max().unwrap() - p.0.iter().min().unwrap() > 60;
        let found = (field..2 * field).map(|x| *picture.get_pixel(x, y)).find(coloured);
        colours.extend(found.filter(|colour| !colours.contains(colour)));
    }
    assert_eq!(colours.len(), dataset.training_views().len());
    let mut per_mm = Vec::new();
    for (view, colour) in dataset.training_views().into_iter().zip(colours) {
        let nertca_vk::geometry::Geometry::CArm(c_arm) = &dataset.views[view].geometry else { panic!("a C-arm") };
        let (a, b) = (c_arm.primary_deg.to_radians(), c_arm.secondary_deg.to_radians());
        // The source is opposite to the direction of the beam, which points to the detector: LAO to the left, cranial to
        // the head.
        let source = [-a.sin() * b.cos(), a.cos() * b.cos(), -b.sin()].map(|v| v * c_arm.sod_mm);
        let [left, posterior, superior] = source;
        for (at, wanted) in [([0, 0], [left, posterior]), ([0, 1], [left, -superior]), ([1, 1], [posterior, -superior])]
        {
            let corner = at.map(|n| n * field);
            let Some(found) = square_of(&picture, colour, corner, field) else { continue };
            let middle = corner.map(|n| f64::from(n + field / 2));
            let found = [found[0] - middle[0], found[1] - middle[1]];
            let (far, length) = (found[0].hypot(found[1]), wanted[0].hypot(wanted[1]));
            let cosine = (found[0] * wanted[0] + found[1] * wanted[1]) / (far * length);
            assert!(cosine > 0.999, "view {view}, field {at:?}: {found:?} for {wanted:?}");
            per_mm.push(far / length);
        }
    }
    // Some sources hide behind others.
    assert!(per_mm.len() >= 7, "sources are seen: {}", per_mm.len());
    assert!(per_mm.iter().all(|scale| (scale / per_mm[0] - 1.0).abs() < 0.03), "one scale: {per_mm:?}");
    fails(&["info", text(run), "--picture", text(&file)], 2, &["--picture", "dataset"]);
}
