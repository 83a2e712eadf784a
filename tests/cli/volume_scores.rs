//! Scores in 3D, and SSIM: compared with SciPy and scikit-image, and through the program, with a truth that the program
//! exported.

use crate::program::{program, whole_config};
use crate::python::python;
use glam::DVec3;
use nertca_vk::config::Preset;
use nertca_vk::formats::nrrd;
use nertca_vk::formats::volume::{Volume, VolumeHints};
use nertca_vk::formats::volume_files;
use nertca_vk::random::uniform01;
use nertca_vk_vessels::score::metrics::ssim;
use nertca_vk_vessels::score::shapes::compare;
use nertca_vk_vessels::vessels::centreline::centreline;
use nertca_vk_vessels::vessels::mask::Mask;
use serde_json::{Value, json};
use std::path::{Path, PathBuf};
use std::sync::OnceLock;

/// Chains of balls along curved paths through a grid, like vessels, displaced by `wobble_mm`.
fn vessels(seed: u32, size: [usize; 3], spacing_mm: DVec3, wobble_mm: f64) -> Mask {
    let extent_mm = spacing_mm * DVec3::from_array(size.map(|n| n as f64));
    let number = |what: u32, i: u32| uniform01(seed, 0, what, i);
    let mut balls = Vec::new();
    for chain in 0..3 {
        let coordinate = |i: u32, end: u32| number(chain, 6 * end + i);
        let end = |end: u32| extent_mm * DVec3::new(coordinate(0, end), coordinate(1, end), coordinate(2, end));
        let (from, to, radius_mm) = (end(0), end(1), 1.0 + 1.5 * coordinate(3, 0));
        for step in 0..100 {
            let along = f64::from(step) / 99.0;
            let bend = DVec3::new(0.0, (5.0 * along).sin(), (4.0 * along).cos()) * 3.0;
            let wobble = wobble_mm * DVec3::new((9.0 * along).sin(), (7.0 * along).cos(), (8.0 * along).sin());
            balls.push((from.lerp(to, along) + bend + wobble, radius_mm * (1.0 - 0.5 * along)));
        }
    }
    let [nx, ny, nz] = size;
    let at = |i: usize| DVec3::new((i % nx) as f64, (i / nx % ny) as f64, (i / (nx * ny)) as f64) * spacing_mm;
    let inside = |p: DVec3| balls.iter().any(|(centre, radius_mm)| p.distance_squared(*centre) < radius_mm.powi(2));
    Mask { size, spacing_mm, inside: (0..nx * ny * nz).map(|i| inside(at(i))).collect() }
}

/// Writes a mask as a numpy file: (z, y, x).
fn write_npy(path: &Path, mask: &Mask) {
    let [x, y, z] = mask.size;
    let mut header = format!("{{'descr': '|u1', 'fortran_order': False, 'shape': ({z}, {y}, {x}), }}");
    header += &" ".repeat(63 - (10 + header.len()) % 64);
    header.push('\n');
    let mut bytes = b"\x93NUMPY\x01\x00".to_vec();
    bytes.extend((header.len() as u16).to_le_bytes());
    bytes.extend(header.bytes());
    bytes.extend(mask.inside.iter().map(|inside| u8::from(*inside)));
    std::fs::write(path, bytes).unwrap();
}

#[test]
fn scores_are_those_of_scipy_and_scikit_image() {
    const SMALLEST_MM3: f64 = 2.0;
    let dir = tempfile::tempdir().unwrap();
    for seed in 0..6 {
        let (size, spacing_mm) = match seed % 3 {
            0 => ([48, 40, 44], DVec3::splat(0.5)),
            1 => ([40, 56, 32], DVec3::new(0.6, 0.4, 0.7)),
            _ => ([32, 32, 48], DVec3::new(0.8, 0.7, 0.5)),
        };
        let (truth, mut ours) = (vessels(seed, size, spacing_mm, 0.0), vessels(seed, size, spacing_mm, 0.9));
        // Specks, of which a few are large enough to count.
        for voxel in 0..ours.inside.len() {
            ours.inside[voxel] |= uniform01(seed, 1, voxel as u32 / 3, 0) < 2e-4;
        }
        let scores = compare(&truth, &ours, SMALLEST_MM3).unwrap();
        let file = dir.path().join(format!("pair-{seed}.json"));
        for (name, mask) in
            [("truth", &truth), ("ours", &ours), ("truth_line", &centreline(&truth)), ("our_line", &centreline(&ours))]
        {
            write_npy(&file.with_extension(format!("{name}.npy")), mask);
        }
        let said = json!({
        "spacing_mm": spacing_mm.to_array(), "scores": scores, "smallest_component_mm3": SMALLEST_MM3,
                });
        std::fs::write(file, said.to_string()).unwrap();
    }
    let script = crate::root::root().join("tests/python/check_shapes.py");
    let outcome = python().arg(script).arg(dir.path()).output().unwrap();
    print!("{}", String::from_utf8_lossy(&outcome.stdout));
    assert!(outcome.status.success(), "{}", String::from_utf8_lossy(&outcome.stderr));
}

fn text(path: &Path) -> &str {
    path.to_str().unwrap()
}

#[track_caller]
fn ok(args: &[&str]) -> String {
    let out = program().args(args).output().unwrap();
    assert!(out.status.success(), "{args:?}: {}", String::from_utf8_lossy(&out.stderr));
    String::from_utf8(out.stdout).unwrap()
}

/// Vessel attenuation of the default phantom, per mm.
const VESSEL_PER_MM: f32 = 0.0015;
const THRESHOLD_PER_MM: f32 = 0.0004;
const SPACING_MM: f64 = 0.5;
const PHASES: u32 = 3;

struct Trained {
    directory: tempfile::TempDir,
    data: PathBuf,
    run: PathBuf,
    /// Dynamic field exported by the program, per phase.
    fields: Vec<Volume>,
}

/// A small run, created once. Its dataset has volumes.
fn trained() -> &'static Trained {
    static RUN: OnceLock<Trained> = OnceLock::new();
    RUN.get_or_init(|| {
        let directory = tempfile::tempdir().unwrap();
        let (data, run) = (directory.path().join("data"), directory.path().join("run"));
        ok(&["phantom", text(&data), "--size", "40", "--phases", &PHASES.to_string()]);
        ok(&["train", text(&data), "-o", text(&run), "--iterations", "60"]);
        let export = |phase: u32| {
            let file = directory.path().join(format!("exported-{phase}.nrrd"));
            let (spacing, number) = (SPACING_MM.to_string(), phase.to_string());
            let what = ["--component", "dynamic", "--spacing", &spacing, "--phase", &number];
            ok(&[&["export", text(&run), "-o", text(&file)], &what[..]].concat());
            volume_files::read(&file, &VolumeHints::default()).unwrap()
        };
        let fields = (0..PHASES).map(export).collect();
        Trained { directory, data, run, fields }
    })
}

/// True vessels from the field itself: the vessels' attenuation where the field exceeds the threshold.
fn vessels_of(field: &Volume) -> Volume {
    let values: Vec<f32> =
        field.values.iter().map(|v| if *v > THRESHOLD_PER_MM { VESSEL_PER_MM } else { 0.0 }).collect();
    assert!(values.iter().any(|v| *v > 0.0), "the run shows no vessels");
    Volume { values, ..field.clone() }
}

/// Scores in 3D of the run against other true vessels in its dataset.
fn scores(name: &str, truth: impl Fn(&Volume) -> Volume) -> Value {
    evaluated(name, truth)["volume"].take()
}

/// All scores of the run against other true vessels in its dataset.
fn evaluated(name: &str, truth: impl Fn(&Volume) -> Volume) -> Value {
    let Trained { directory, data, run, fields } = trained();
    let copy = directory.path().join(name);
    for part in ["images", "masks"] {
        std::fs::create_dir_all(copy.join(part)).unwrap();
        for file in std::fs::read_dir(data.join(part)).unwrap() {
            let file = file.unwrap();
            std::fs::copy(file.path(), copy.join(part).join(file.file_name())).unwrap();
        }
    }
    std::fs::copy(data.join("dataset.json"), copy.join("dataset.json")).unwrap();
    for (phase, field) in fields.iter().enumerate() {
        let file = copy.join(format!("volumes/vessels-{phase:02}.nrrd"));
        nrrd::write(&file, &truth(field), "attenuation per mm").unwrap();
    }
    let threshold = THRESHOLD_PER_MM.to_string();
    let said = ok(&["eval", text(run), "--data", text(&copy), "--threshold", &threshold, "--ceiling", "--json"]);
    serde_json::from_str(&said).unwrap()
}

fn number(scores: &Value, name: &str) -> f64 {
    scores[name].as_f64().unwrap_or_else(|| panic!("{name} in {scores}"))
}

/// Positions of the voxels of a volume above a value, mm, and their values.
fn above(volume: &Volume, value: f32) -> Vec<(DVec3, f64)> {
    let [nx, ny, _] = volume.size;
    let index = |i: usize| DVec3::new((i % nx) as f64, (i / nx % ny) as f64, (i / (nx * ny)) as f64);
    let at = |i: usize| volume.index_to_lps.transform_point3(index(i));
    let voxels = volume.values.iter().enumerate().filter(|(_, v)| **v > value);
    voxels.map(|(i, v)| (at(i), f64::from(*v))).collect()
}

/// Distances of points to the nearest of others, mm.
fn distances(from: &[(DVec3, f64)], to: &[(DVec3, f64)]) -> Vec<f64> {
    let nearest = |p: &DVec3| to.iter().map(|(q, _)| p.distance_squared(*q)).fold(f64::INFINITY, f64::min).sqrt();
    from.iter().map(|(p, _)| nearest(p)).collect()
}

#[test]
fn a_field_agrees_with_itself() {
    let volume = scores("itself", vessels_of);
    let rows = volume["phases"].as_array().unwrap();
    assert_eq!(rows.len(), PHASES as usize);
    for row in rows {
        // Voxels exactly at the threshold may be on either side, since positions are rounded.
        for (name, value, tolerance) in [
            ("dice", 1.0, 1e-3),
            ("chamfer_mm", 0.0, 1e-3),
            ("hausdorff95_mm", 0.0, 0.0),
            ("true_centreline_found", 1.0, 0.0),
            ("our_centreline_true", 1.0, 0.0),
            ("cl_dice", 1.0, 1e-3),
        ] {
            assert!((number(row, name) - value).abs() <= tolerance, "{name} in {row}");
        }
        assert_eq!(row["components"], row["true_components"], "{row}");
    }
    // The lumen is the part of the field above half of the stated attenuation.
    for (field, row) in trained().fields.iter().zip(rows) {
        let (truth, lumen) =
            (above(field, THRESHOLD_PER_MM).len() as f64, above(field, 0.5 * VESSEL_PER_MM).len() as f64);
        let expected = 2.0 * lumen / (truth + lumen);
        assert!(expected < 0.95 && (number(row, "lumen_dice") - expected).abs() < 2e-3, "{expected} in {row}");
    }
}

/// Translations by whole voxels along each patient axis, which differ from the world's axes.
#[test]
fn a_moved_truth_is_as_far_away_as_it_was_moved() {
    const VOXELS: f64 = 10.0;
    for (name, axis) in [("left", DVec3::X), ("posterior", DVec3::Y), ("superior", DVec3::Z)] {
        let moved = |field: &Volume| {
            let mut volume = vessels_of(field);
            volume.index_to_lps.translation += axis * VOXELS * SPACING_MM;
            volume
        };
        let volume = scores(name, moved);
        for (field, row) in trained().fields.iter().zip(volume["phases"].as_array().unwrap()) {
            let (ours, truth) = (above(field, THRESHOLD_PER_MM), above(&moved(field), 0.0));
            let [found, right] = [distances(&truth, &ours), distances(&ours, &truth)];
            let mean = |d: &[f64]| d.iter().sum::<f64>() / d.len() as f64;
            let chamfer = 0.5 * (mean(&found) + mean(&right));
            assert!((number(row, "chamfer_mm") - chamfer).abs() < 0.01 * chamfer, "{name}: {chamfer} in {row}");
            // Voxels of the field far from vessels, by their values.
            let field = above(field, 0.0);
            let away = distances(&field, &truth);
            let all: f64 = field.iter().map(|(_, v)| v).sum();
            for (name, limit_mm) in
                [("mass_beyond_2_mm", 2.0), ("mass_beyond_2_pixels", 2.0 * number(&volume, "pixel_mm"))]
            {
                let far: f64 = field.iter().zip(&away).filter(|(_, d)| **d > limit_mm).map(|((_, v), _)| v).sum();
                assert!((number(row, name) - far / all).abs() < 0.02, "{name}: {} in {row}", far / all);
            }
        }
    }
}

/// With the reconstruction's own field as the truth, rays through its volumes give the same values as rays through the
/// field.
#[test]
fn true_vessels_are_scored_as_the_field_is() {
    let evaluation = evaluated("ceiling", Volume::clone);
    let ceiling = &evaluation["ceiling"];
    let field = [number(&evaluation["dice"], "dynamic"), number(&evaluation["best_dice"]["dynamic"], "dice")];
    let volumes = [number(ceiling, "dice"), number(&ceiling["best"], "dice")];
    for (field, volumes) in field.into_iter().zip(volumes) {
        assert!(field > 0.2 && (volumes - field).abs() < 0.05, "{volumes} of the volumes, {field} of the field");
    }
    // At another position they score zero.
    let moved = |field: &Volume| {
        let mut volume = field.clone();
        volume.index_to_lps.translation += DVec3::new(0.0, 0.0, 15.0);
        volume
    };
    let moved = evaluated("elsewhere", moved);
    assert!(number(&moved["ceiling"], "dice") < 0.5 * field[0], "{}", moved["ceiling"]);
}

#[test]
fn reports_show_scores_in_3d_and_do_without() {
    let Trained { directory, run, .. } = trained();
    let report: Value = serde_json::from_slice(&std::fs::read(run.join("report/evaluation.json")).unwrap()).unwrap();
    let (rows, mean) = (report["volume"]["phases"].as_array().unwrap(), &report["volume"]["mean"]);
    for name in ["dice", "lumen_dice", "chamfer_mm", "true_components", "mass_beyond_2_pixels"] {
        let expected = rows.iter().map(|row| number(row, name)).sum::<f64>() / f64::from(PHASES);
        assert!((number(mean, name) - expected).abs() < 1e-9, "{name}: {expected} in {mean}");
    }
    assert!(std::fs::read_to_string(run.join("report.html")).unwrap().contains("Scores in 3D"));
    let told = ok(&["eval", text(run)]);
    assert!(told.contains("Chamfer") && told.contains("mean"), "{told}");
    // Without volumes, not even the field can be scored.
    let bare = directory.path().join("bare");
    ok(&["phantom", text(&bare), "--size", "40", "--phases", &PHASES.to_string(), "--no-volumes"]);
    let evaluation =
        || serde_json::from_str::<Value>(&ok(&["eval", text(run), "--data", text(&bare), "--ceiling", "--json"]));
    let without = evaluation().unwrap();
    assert!(without.get("volume").is_none() && without.get("ceiling").is_none());
    assert!(without["warnings"].to_string().contains("The true vessels are not scored"), "{}", without["warnings"]);
    // A truth that cannot be used is reported, and images are scored nevertheless.
    std::fs::create_dir_all(bare.join("volumes")).unwrap();
    std::fs::write(bare.join("volumes/vessels-01.nrrd"), "NRRD0004\n").unwrap();
    let warnings = evaluation().unwrap()["warnings"].to_string();
    assert!(warnings.contains("3D") && warnings.contains("vessels-01.nrrd"), "{warnings}");
}

/// A field that fills its box cannot be compared voxel by voxel; the run must continue.
#[test]
fn a_field_everywhere_has_no_distance_and_trains_on() {
    let directory = tempfile::tempdir().unwrap();
    let (data, run) = (directory.path().join("data"), directory.path().join("run"));
    // Pixels are small, so that the box of the paper's dynamic field has too many voxels.
    ok(&["phantom", text(&data), "--size", "100", "--phases", "2"]);
    let settings = [
        "train.rays=32",
        "train.validate_every=1",
        "march.static_samples=32",
        "march.dynamic_samples=32",
        "march.render_samples=32",
        "dynamic.width=16",
        "dynamic.delay=0",
        "loss.normalise=true",
        "dynamic.normalised_shift=8",
    ];
    let config = whole_config(directory.path(), Preset::Paper, &settings);
    let train = ["train", text(&data), "-o", text(&run), "--config", text(&config), "--iterations", "2", "--no-eval"];
    ok(&train);
    let metrics = std::fs::read_to_string(run.join("metrics.jsonl")).unwrap();
    let lines = metrics.lines().map(|line| serde_json::from_str::<Value>(line).unwrap());
    let validations: Vec<Value> = lines.filter(|line| line["event"] == "validation").collect();
    assert!(!validations.is_empty() && validations.iter().all(|line| line["chamfer_mm"].is_null()), "{metrics}");
}

#[test]
fn ssim_is_that_of_scikit_image() {
    // The script's pair of images.
    const WIDTH: usize = 37;
    let pixels = (0..23 * WIDTH).map(|i| ((i % WIDTH) as f64, (i / WIDTH) as f64));
    let (truth, prediction): (Vec<f64>, Vec<f64>) = pixels
        .map(|(x, y)| {
            let truth = (x * x + 3.0 * x * y + 40.0 * y) % 97.0 / 97.0 * 0.5 + 0.5 * x / WIDTH as f64;
            (truth, 0.8 * truth + (7.0 * x + 11.0 * y) % 13.0 / 13.0 * 0.2)
        })
        .unzip();
    let script = crate::root::root().join("tests/python/ssim_reference.py");
    let outcome = python().arg(script).output().unwrap();
    let said = String::from_utf8_lossy(&outcome.stdout);
    assert!(outcome.status.success(), "{said}{}", String::from_utf8_lossy(&outcome.stderr));
    let (got, want) = (ssim(&truth, &prediction, WIDTH), said.trim().parse::<f64>().unwrap());
    assert!((got - want).abs() < 1e-9, "{got} where scikit-image gives {want}");
}
