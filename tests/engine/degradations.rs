//! Degraded phantoms: each factor has its intended effect and no other, and `truth.json` states its size. The truth is
//! tested with images made directly from volumes.

use crate::common::{expect_silence, gpu};
use glam::DVec3;
use nertca_vk::formats::images::read_image;
use nertca_vk::formats::nrrd;
use nertca_vk::formats::volume::{Volume, VolumeHints};
use nertca_vk::geometry::{CArm, Geometry, ViewRays};
use nertca_vk::gpu::device::Gpu;
use nertca_vk::scan::dataset::{Dataset, Frame, Layout, Split};
use nertca_vk::scan::gating::BeatScaling;
use nertca_vk::scan::gating::contraction;
use nertca_vk::scan::truth::{TrueFrame, Truth};
use nertca_vk_phantom::dataset::{Anatomy, PhantomOptions, Setting, VolumeOptions, make, project_volumes};
use nertca_vk_phantom::degradations::{Breathing, Degradations, GeometryError, Rhythm};
use nertca_vk_phantom::noise::Photons;
use nertca_vk_phantom::projector::Projector;
use nertca_vk_phantom::tree::{Bounds, Heart, Tree};
use nertca_vk_phantom::tree_file::TreeFile;
use nertca_vk_phantom::views::{Angles, CArmOptions, PixelPitch, ViewAngles};
use nertca_vk_phantom::voxels::{self, Breath, Tissues};
use serde_json::json;
use std::path::{Path, PathBuf};
use tempfile::TempDir;

const SIZE: usize = 40;
const PIXELS: usize = SIZE * SIZE;
const PHASES: u32 = 5;
const TRAINING: usize = 3;
/// Attenuation of vessels in the patient, 1/mm.
const IODINE: f64 = 0.1;

/// A dataset and its truth.
struct Set {
    dataset: Dataset,
    truth: Truth,
    directory: TempDir,
}

impl Set {
    fn read(directory: TempDir) -> Set {
        let (dataset, truth) = (Dataset::open(directory.path()).unwrap(), Truth::load(directory.path()).unwrap());
        assert_eq!(dataset.frames.len(), truth.frames.len());
        Set { dataset, truth, directory }
    }

    /// Each image with its truth.
    fn frames(&self) -> impl Iterator<Item = (&Frame, &TrueFrame)> {
        self.truth.frames.iter().map(|truth| {
            let name = truth.image.file_stem().unwrap().to_str().unwrap();
            (self.dataset.frames.iter().find(|f| f.name == name).unwrap(), truth)
        })
    }

    fn training(&self) -> impl Iterator<Item = (&Frame, &TrueFrame)> {
        self.frames().filter(|(_, truth)| truth.split == Split::Train)
    }

    fn stated(&self, frame: &Frame) -> CArm {
        match &self.dataset.views[frame.view].geometry {
            Geometry::CArm(c_arm) => c_arm.clone(),
            Geometry::Matrix(_) => unreachable!("phantoms have C-arms"),
        }
    }

    /// Truth of the image with this name.
    fn same_truth(&self, truth: &TrueFrame) -> &TrueFrame {
        self.truth.frames.iter().find(|t| t.image == truth.image).unwrap()
    }

    /// Image with this name.
    fn same<'a>(&'a self, frame: &Frame) -> &'a Frame {
        self.dataset.frames.iter().find(|f| f.name == frame.name).unwrap()
    }
}

fn views() -> ViewAngles {
    let at = |primary_deg, secondary_deg| Angles { primary_deg, secondary_deg };
    let training = [at(-30.0, 30.0), at(60.0, -30.0), at(10.0, 0.0)];
    ViewAngles::given(&training, Some(&[at(90.0, 0.0)])).unwrap()
}

fn options(degradations: Degradations, anatomy: Option<Anatomy>) -> PhantomOptions {
    PhantomOptions {
        setting: Setting::SmallXcat,
        size: SIZE,
        phases: PHASES,
        views: views(),
        seed: 5,
        stenoses: Vec::new(),
        degradations,
        layout: Layout::Native,
        anatomy,
        volumes_every: None,
    }
}

/// The procedural phantom.
fn thorax(gpu: &Gpu, degradations: Degradations) -> Set {
    let directory = tempfile::tempdir().unwrap();
    let options = options(degradations, None);
    make(gpu, &options, directory.path(), |_, _, _| ()).unwrap();
    Set::read(directory)
}

fn c_arms() -> CArmOptions {
    let pixel = PixelPitch::FieldOfView(120.0);
    CArmOptions { sod_mm: vec![750.0], sid_mm: vec![1100.0], pixel, offset_mm: vec![[0.0; 2]] }
}

/// Files of a patient: a beating tree, and a CT.
struct Files {
    directory: TempDir,
}

impl Files {
    fn new() -> Files {
        let directory = tempfile::tempdir().unwrap();
        // Two vessels that share their origin; RAS mm.
        let phase = |p: usize| {
            let beat = 8.0 * (std::f64::consts::PI * p as f64 / 10.0).sin().powi(2);
            let vessel = |side: f64| {
                move |i: usize| {
                    let along = i as f64 / 19.0;
                    [side * 35.0 * along - 0.3 * beat, 20.0 * along + beat, 30.0 - 55.0 * along + 0.5 * beat]
                }
            };
            (0..20).map(vessel(1.0)).chain((0..20).map(vessel(-0.6))).collect::<Vec<_>>()
        };
        let tree = json!({
            "branches": [{"name": "a", "first": 0, "count": 20}, {"name": "b", "first": 20, "count": 20}],
            "radius_mm": vec![1.8; 40],
            "points_mm": (0..10).map(phase).collect::<Vec<_>>(),
        });
        std::fs::write(directory.path().join("tree.json"), tree.to_string()).unwrap();
        // A chest in Hounsfield units: soft tissue, with bands that distinguish heights.
        let n = 40;
        let bands = |i: usize| if (i / (n * n)) % 5 < 2 { 150.0 } else { -50.0 };
        let ct = Volume::centred([n; 3], 5.0, DVec3::ZERO, (0..n * n * n).map(bands).collect());
        nrrd::write(&directory.path().join("ct.nrrd"), &ct, "HU").unwrap();
        Files { directory }
    }

    fn tree(&self) -> PathBuf {
        self.directory.path().join("tree.json")
    }

    /// A tree from a file, with or without the CT around it.
    fn patient(&self, gpu: &Gpu, ct: bool, degradations: Degradations) -> Set {
        let directory = tempfile::tempdir().unwrap();
        let anatomy = Anatomy {
            tree: self.tree(),
            background: ct.then(|| self.directory.path().join("ct.nrrd")),
            centre: false,
            c_arms: c_arms(),
            iodine_per_mm: IODINE,
        };
        let options = options(degradations, Some(anatomy));
        make(gpu, &options, directory.path(), |_, _, _| ()).unwrap();
        Set::read(directory)
    }
}

/// Images of volumes, computed independently of the dataset code.
struct Pictures {
    projector: Projector,
}

impl Pictures {
    fn new(gpu: &Gpu) -> Pictures {
        Pictures { projector: Projector::new(gpu, SIZE, SIZE).unwrap() }
    }

    fn of(&self, volume: Volume, c_arm: &CArm) -> Vec<f32> {
        let rays: ViewRays = Geometry::CArm(c_arm.clone()).rays(SIZE, SIZE).unwrap();
        let loaded = self.projector.load(volume).unwrap();
        self.projector.project(&loaded, &[rays], DVec3::ZERO).unwrap().swap_remove(0)
    }
}

/// Vessels of the procedural phantom, and their surroundings, at a fraction of its beat.
fn thorax_at(fraction: f64, phases: u32) -> (Volume, [Volume; 2]) {
    const SCALE: f64 = 0.37;
    let tissues = Tissues::XCAT;
    let tree_of = |heart: &Heart, fraction| Tree::procedural(heart, SCALE, fraction, 5);
    let heart = Heart::new(DVec3::ZERO, SCALE);
    let bounds = Bounds::over_the_beat(phases, |fraction| tree_of(&heart, fraction));
    let heart_mm = -0.5 * (bounds.low_mm + bounds.high_mm);
    let heart = Heart::new(heart_mm, SCALE);
    let bounds = Bounds::over_the_beat(phases, |fraction| tree_of(&heart, fraction));
    let tree = tree_of(&heart, fraction);
    let vessels = voxels::vessels(&tree, bounds.joined(tree.bounds()), tissues.vessel, 0.4 * SCALE);
    let still = voxels::thorax(tissues, heart_mm, SCALE, DVec3::new(-25.0, 10.0, 25.0), DVec3::splat(64.0));
    let squeeze = contraction(fraction);
    let moving = voxels::heart_and_diaphragm(tissues, &heart, squeeze, Breath::default(), heart_mm, SCALE, &still);
    (vessels, [still, moving])
}

/// Image of the procedural phantom at a fraction of its beat.
fn thorax_image(pictures: &Pictures, c_arm: &CArm, fraction: f64) -> Vec<f32> {
    let (vessels, [still, moving]) = thorax_at(fraction, PHASES);
    let mut image = pictures.of(still, c_arm);
    for volume in [moving, vessels] {
        image.iter_mut().zip(pictures.of(volume, c_arm)).for_each(|(a, b)| *a += b);
    }
    image
}

/// Maximum difference as a share of the maximum value.
fn difference(a: &[f32], b: &[f32]) -> f32 {
    let max = b.iter().fold(0f32, |m, v| m.max(v.abs()));
    a.iter().zip(b).fold(0f32, |m, (a, b)| m.max((a - b).abs())) / max
}

fn bits(values: &[f32]) -> Vec<u32> {
    values.iter().map(|v| v.to_bits()).collect()
}

fn breathing(background: bool) -> Degradations {
    let breathing = Breathing { peak_to_peak_mm: 6.0, period_s: 3.0, background };
    Degradations { breathing: Some(breathing), ..Degradations::default() }
}

fn rhythm(frames_per_s: f64, beats: u32, gating: BeatScaling) -> Degradations {
    let beats_per_min = vec![50.0, 70.0, 90.0];
    Degradations { rhythm: Some(Rhythm { beats_per_min, frames_per_s, beats, gating }), ..Degradations::default() }
}

#[test]
fn nothing_asked_for_changes_nothing() {
    let gpu = gpu();
    let (set, pictures) = (thorax(&gpu, Degradations::default()), Pictures::new(&gpu));
    for (frame, truth) in set.frames() {
        let fraction = f64::from(truth.phase) / f64::from(PHASES);
        assert_eq!(bits(&frame.integrals), bits(&thorax_image(&pictures, &truth.geometry, fraction)), "{}", frame.name);
        assert_eq!((truth.phase, &truth.geometry), (frame.phase, &set.stated(frame)));
        assert_eq!((truth.heart_shift_mm, truth.contrast_gain, truth.cut_share), ([0.0; 3], 1.0, 0.0));
        assert!((truth.beat_phase - f64::from(truth.phase)).abs() < 1e-12);
    }
    drop(pictures);
    expect_silence(gpu);
}

#[test]
fn stated_geometry_is_off_and_images_are_not() {
    let gpu = gpu();
    let photons = Some(Photons::Unattenuated(1e6));
    let right = thorax(&gpu, Degradations { photons, ..Degradations::default() });
    let geometry_error = Some(GeometryError { angle_deg: 0.5, position_mm: 2.0 });
    let wrong = thorax(&gpu, Degradations { photons, geometry_error, ..Degradations::default() });
    let mut errors = Vec::new();
    for (frame, truth) in wrong.frames() {
        let other = right.same(frame);
        assert_eq!((bits(&frame.integrals), &frame.mask), (bits(&other.integrals), &other.mask), "{}", frame.name);
        let (said, true_arm) = (wrong.stated(frame), right.stated(other));
        assert_eq!(truth.geometry, true_arm);
        if truth.split == Split::Validation {
            assert_eq!(said, true_arm);
        } else if truth.phase == 0 {
            errors.extend([said.primary_deg - true_arm.primary_deg, said.secondary_deg - true_arm.secondary_deg]);
            errors.extend(said.table_mm.iter().map(|mm| mm / 4.0));
            let rest = CArm { primary_deg: 0.0, secondary_deg: 0.0, table_mm: [0.0; 3], ..said };
            assert_eq!(rest, CArm { primary_deg: 0.0, secondary_deg: 0.0, ..true_arm }, "distances and pixels stay");
        }
    }
    let deviation = (errors.iter().map(|e| e * e).sum::<f64>() / errors.len() as f64).sqrt();
    assert!(errors.len() == 5 * TRAINING && (0.25..0.8).contains(&deviation), "{deviation} deg: {errors:?}");
    let mut distinct = errors.clone();
    distinct.sort_by(f64::total_cmp);
    distinct.dedup();
    assert_eq!(distinct.len(), errors.len(), "every error is drawn by itself");
    expect_silence(gpu);
}

#[test]
fn the_heart_breathes_by_what_the_truth_says() {
    let gpu = gpu();
    let files = Files::new();
    let (bare, in_ct) = (files.patient(&gpu, false, breathing(false)), files.patient(&gpu, true, breathing(false)));
    let [bare_held, held] = [false, true].map(|ct| files.patient(&gpu, ct, Degradations::default()));
    let with_chest = files.patient(&gpu, true, breathing(true));
    let (pictures, tree) = (Pictures::new(&gpu), TreeFile::read(&files.tree()).unwrap());
    let bounds = Bounds::over_the_beat(PHASES, |fraction| tree.at(fraction));
    let mut first_shifts = Vec::new();
    for (frame, truth) in bare.frames() {
        let [posterior, left, superior] = truth.heart_shift_mm;
        // A patient moved by the table appears in the same place as one moved by breathing.
        let c_arm = CArm { table_mm: [left, posterior, superior], ..truth.geometry.clone() };
        let still = tree.at(truth.beat_phase / f64::from(PHASES));
        let wanted = pictures.of(voxels::vessels(&still, bounds, IODINE, 0.5), &c_arm);
        let off = difference(&frame.integrals, &wanted);
        assert!(off < 0.02, "{}: {off}", frame.name);
        assert_eq!(truth.geometry, bare.stated(frame));
        // The chest adds the same to images with and without breathing, as long as it is static itself.
        let before = |set: &Set, other: &Set| -> Vec<f32> {
            let (a, b) = (set.same(frame), other.same(frame));
            a.integrals.iter().zip(&b.integrals).map(|(a, b)| a - b).collect()
        };
        let chest = before(&in_ct, &bare);
        assert!(difference(&chest, &before(&held, &bare_held)) < 1e-5, "{}", frame.name);
        let chest_moved = difference(&before(&with_chest, &bare), &chest);
        if truth.split == Split::Validation {
            assert_eq!((truth.heart_shift_mm, chest_moved), ([0.0; 3], 0.0));
            continue;
        }
        assert!(superior.abs() <= 3.0 && (posterior - superior * 1.3 / 4.9).abs() < 1e-9 && left == 0.0);
        assert!(chest_moved > 1e-3 || superior.abs() < 0.3, "{}: {superior} mm, {chest_moved}", frame.name);
        if truth.phase == 0 {
            first_shifts.push(superior);
        }
        // A breath takes 3 seconds while phases are acquired.
        let begin = bare.training().find(|(_, t)| t.view == truth.view && t.phase == 0).unwrap().1;
        let angle = |s: f64| (s / 3.0).clamp(-1.0, 1.0).asin();
        let turned = std::f64::consts::TAU * truth.time_s / 3.0;
        let [a, b] = [angle(begin.heart_shift_mm[2]), std::f64::consts::PI - angle(begin.heart_shift_mm[2])]
            .map(|start| (3.0 * (start + turned).sin() - superior).abs());
        assert!(a.min(b) < 1e-6, "{}: {a}, {b}", frame.name);
    }
    first_shifts.sort_by(f64::total_cmp);
    assert!(first_shifts[TRAINING - 1] - first_shifts[0] > 0.5, "runs begin where they like: {first_shifts:?}");
    drop(pictures);
    expect_silence(gpu);
}

#[test]
fn photons_make_the_noise_of_their_counts() {
    let gpu = gpu();
    let files = Files::new();
    let clean = files.patient(&gpu, true, Degradations::default());
    let unattenuated = |image: &[f32], photons: f64| {
        photons / (image.iter().map(|v| (-f64::from(*v)).exp()).sum::<f64>() / PIXELS as f64)
    };
    for (photons, at_detector) in [(Photons::Unattenuated(1e5), None), (Photons::Detector(2e4), Some(2e4))] {
        let noisy = files.patient(&gpu, true, Degradations { photons: Some(photons), ..Degradations::default() });
        let (mut squares, mut n) = (0.0, 0.0);
        for (frame, truth) in noisy.frames() {
            let exact = clean.same(frame);
            assert_eq!((&frame.mask, truth), (&exact.mask, clean.same_truth(truth)));
            let open = at_detector.map_or(1e5, |photons| unattenuated(&exact.integrals, photons));
            for (value, integral) in frame.integrals.iter().zip(&exact.integrals) {
                // Counts of n photons have a standard deviation of sqrt(n), their logarithm one of 1 / sqrt(n).
                squares += f64::from(value - integral).powi(2) * open * (-f64::from(*integral)).exp();
                n += 1.0;
            }
        }
        let relative = squares / n;
        assert!((relative - 1.0).abs() < 0.02, "{photons:?}: variance is {relative} of Poisson's");
    }
    expect_silence(gpu);
}

#[test]
fn contrast_varies_by_the_gains_of_the_truth() {
    let gpu = gpu();
    let files = Files::new();
    let (empty, usual) = (files.patient(&gpu, false, Degradations::default()), thorax(&gpu, Degradations::default()));
    let variation = Degradations { contrast_variation: 0.2, ..Degradations::default() };
    let (bare, chest) = (files.patient(&gpu, false, variation.clone()), thorax(&gpu, variation));
    let mut gains = Vec::new();
    for (frame, truth) in bare.frames() {
        let gain = truth.contrast_gain as f32;
        let wanted: Vec<f32> = empty.same(frame).integrals.iter().map(|v| v * gain).collect();
        assert!(difference(&frame.integrals, &wanted) < 1e-6, "{}", frame.name);
        assert_eq!(frame.mask, empty.same(frame).mask);
        assert_eq!(truth.split == Split::Validation, gain == 1.0);
        gains.push((truth.view, gain));
    }
    let of = |view: usize| gains.iter().filter(move |(v, _)| *v == view).map(|(_, gain)| *gain);
    let spread =
        |gains: &[f32]| gains.iter().fold(f32::MIN, |m, g| m.max(*g)) - gains.iter().fold(f32::MAX, |m, g| m.min(*g));
    let first: Vec<f32> = (0..TRAINING).map(|view| of(view).next().unwrap()).collect();
    assert!(spread(&first) > 0.03 && spread(&of(0).collect::<Vec<_>>()) > 0.01, "{gains:?}");
    // The surroundings of the vessels keep their attenuation.
    let pictures = Pictures::new(&gpu);
    for (frame, truth) in chest.training().take(TRAINING) {
        let vessels = pictures.of(thorax_at(f64::from(truth.phase) / f64::from(PHASES), PHASES).0, &truth.geometry);
        let gain = truth.contrast_gain as f32 - 1.0;
        let added: Vec<f32> = vessels.iter().map(|v| gain * v).collect();
        let found: Vec<f32> = frame.integrals.iter().zip(&usual.same(frame).integrals).map(|(a, b)| a - b).collect();
        assert!(difference(&found, &added) < 1e-2, "{}", frame.name);
    }
    drop(pictures);
    expect_silence(gpu);
}

#[test]
fn contrast_flows_in_with_the_time_of_a_run() {
    let gpu = gpu();
    let files = Files::new();
    // Regular phases are equal parts of one second.
    let (full, flowing) = (
        files.patient(&gpu, false, Degradations::default()),
        files.patient(&gpu, false, Degradations { inflow_s: 0.5, ..Degradations::default() }),
    );
    let mut shares: Vec<Vec<f64>> = vec![Vec::new(); TRAINING];
    for (frame, truth) in flowing.frames() {
        let everything = full.same(frame);
        let sum = |integrals: &[f32]| integrals.iter().map(|v| f64::from(*v)).sum::<f64>();
        if truth.split == Split::Validation || truth.time_s >= 0.5 {
            assert_eq!((truth.filled_to, bits(&frame.integrals)), (1.0, bits(&everything.integrals)), "{}", frame.name);
        } else {
            assert!((truth.filled_to - truth.time_s / 0.5).abs() < 1e-12);
            let above = frame.integrals.iter().zip(&everything.integrals).all(|(some, all)| *some <= all + 1e-6);
            assert!(above, "{}: nothing is denser than when full", frame.name);
            shares[truth.view].push(sum(&frame.integrals) / sum(&everything.integrals));
        }
    }
    for view in shares {
        assert!(view[0] == 0.0 && view.windows(2).all(|pair| pair[1] > pair[0]), "{view:?}");
        assert!(view.len() > 1 && view[view.len() - 1] > 0.2, "{view:?}");
    }
    expect_silence(gpu);
}

#[test]
fn images_show_the_heart_at_the_time_they_are_taken() {
    let gpu = gpu();
    let pictures = Pictures::new(&gpu);
    let set = thorax(&gpu, rhythm(15.0, 3, BeatScaling::TwoSegment));
    let mut between = 0;
    for (frame, truth) in set.frames() {
        assert_eq!((frame.phase, &truth.geometry), (truth.phase, &set.stated(frame)));
        if truth.phase % 2 == 0 {
            let wanted = thorax_image(&pictures, &truth.geometry, truth.beat_phase / f64::from(PHASES));
            assert!(difference(&frame.integrals, &wanted) < 1e-6, "{}", frame.name);
        }
        let off = (truth.beat_phase - f64::from(truth.phase)).rem_euclid(f64::from(PHASES));
        let off = off.min(f64::from(PHASES) - off);
        if truth.split == Split::Validation {
            assert!(off < 1e-12);
            continue;
        }
        // The tolerance is half a phase of sampling, and systoles of 280 to 340 ms where gating assumes 310.
        assert!(off < 0.75, "{}: {off} phases", frame.name);
        between += usize::from(off > 0.02);
        let images = 15.0 * truth.time_s;
        assert!((images - images.round()).abs() < 1e-9 && truth.time_s <= 3.0 * 60.0 / 50.0);
    }
    assert!(between > PHASES as usize, "images fall between phases");
    // Linear gating of a slow heart assigns late phases to early events.
    let worst = |set: &Set, view| {
        let frames = set.training().filter(|(_, t)| t.view == view);
        let off = |t: &TrueFrame| (t.beat_phase - f64::from(t.phase) + 2.5).rem_euclid(5.0) - 2.5;
        frames.map(|(_, t)| off(t)).fold(f64::MIN, f64::max)
    };
    let files = Files::new();
    let linear = files.patient(&gpu, false, rhythm(1000.0, 1, BeatScaling::Linear));
    let two_segment = files.patient(&gpu, false, rhythm(1000.0, 1, BeatScaling::TwoSegment));
    assert!(
        worst(&linear, 0) > 0.25 && worst(&two_segment, 0) < 0.2,
        "{} {}",
        worst(&linear, 0),
        worst(&two_segment, 0)
    );
    // With few images some phases are missing, first in the views of fast hearts.
    let few = files.patient(&gpu, false, rhythm(2.0, 1, BeatScaling::TwoSegment));
    let seen = |view| few.training().filter(|(_, t)| t.view == view).count();
    assert!((1..=3).contains(&seen(0)) && (1..=2).contains(&seen(2)), "{} {}", seen(0), seen(2));
    assert_eq!(few.frames().count() - few.training().count(), PHASES as usize, "unseen views have every phase");
    drop(pictures);
    expect_silence(gpu);
}

/// Checks that hidden pixels are found when a dataset is read, with the pixels beside them and no others.
fn found_hidden(dataset: &Dataset, view: usize, hidden: &[bool]) {
    let found: Vec<bool> = (0..PIXELS).map(|p| !dataset.shows(view, p)).collect();
    assert!(found.iter().zip(hidden).all(|(found, hidden)| *found || !hidden), "all of it");
    let count = |pixels: &[bool]| pixels.iter().filter(|p| **p).count();
    let beside = if hidden.contains(&true) { SIZE } else { 0 };
    assert_eq!(count(&found), count(hidden) + beside);
}

#[test]
fn a_blade_hides_the_share_of_the_truth() {
    let gpu = gpu();
    let files = Files::new();
    let whole = files.patient(&gpu, true, Degradations::default());
    let vessels = files.patient(&gpu, false, Degradations::default());
    let photons = Some(Photons::Unattenuated(1e7));
    let degradations = Degradations { collimated_share: 0.15, photons, ..Degradations::default() };
    let cut = files.patient(&gpu, true, degradations);
    let noisy = files.patient(&gpu, true, Degradations { photons, ..Degradations::default() });
    for view in 0..=TRAINING {
        let frames: Vec<_> = cut.frames().filter(|(_, t)| t.view == view).collect();
        let written: Vec<Vec<f32>> =
            frames.iter().map(|(_, t)| read_image(&cut.directory.path().join(&t.image)).unwrap().values).collect();
        let hidden: Vec<bool> = (0..PIXELS).map(|p| written.iter().all(|image| image[p] == written[0][p])).collect();
        found_hidden(&cut.dataset, frames[0].0.view, &hidden);
        let lowest = |p: usize| frames.iter().map(|(f, _)| vessels.same(f).integrals[p]).fold(f32::MAX, f32::min);
        let moving: Vec<f32> =
            (0..PIXELS).map(|p| frames.iter().map(|(f, _)| vessels.same(f).integrals[p] - lowest(p)).sum()).collect();
        let lost: f32 = moving.iter().zip(&hidden).filter(|(_, h)| **h).map(|(m, _)| m).sum();
        let share = f64::from(lost / moving.iter().sum::<f32>());
        let wanted = if view == TRAINING { 0.0 } else { 0.15 };
        assert!((share - wanted).abs() < 0.04, "view {view}: {share}");
        let densest = frames.iter().flat_map(|(f, _)| &whole.same(f).integrals).fold(0f32, |m, v| m.max(*v));
        for ((frame, truth), written) in frames.iter().zip(&written) {
            assert!((truth.cut_share - share).abs() < 1e-3, "view {view}: {} and {share}", truth.cut_share);
            for (p, hidden) in hidden.iter().enumerate() {
                let (value, mask) = (written[p], frame.mask.as_ref().unwrap()[p]);
                match hidden {
                    true => assert!(value > 1.5 * densest && !mask, "pixel {p} of a blade: {value}"),
                    false => {
                        let other = noisy.same(frame);
                        assert_eq!((value, mask), (other.integrals[p], other.mask.as_ref().unwrap()[p]), "pixel {p}");
                    }
                }
            }
        }
    }
    expect_silence(gpu);
}

#[test]
fn a_catheter_leads_to_the_ostium() {
    let gpu = gpu();
    let files = Files::new();
    let bare = files.patient(&gpu, true, Degradations::default());
    let led = files.patient(&gpu, true, Degradations { catheter: true, ..Degradations::default() });
    let tree = TreeFile::read(&files.tree()).unwrap();
    for view in 0..=TRAINING {
        let mut outside = vec![Vec::new(); PIXELS];
        for (frame, truth) in led.frames().filter(|(_, t)| t.view == view) {
            let other = bare.same(frame);
            assert_eq!((&frame.mask, truth), (&other.mask, bare.same_truth(truth)));
            let added: Vec<f32> = frame.integrals.iter().zip(&other.integrals).map(|(a, b)| a - b).collect();
            if truth.split == Split::Validation {
                assert_eq!(bits(&frame.integrals), bits(&other.integrals));
                continue;
            }
            let at = tree.at(f64::from(truth.phase) / f64::from(PHASES)).ostium_mm().unwrap();
            let rays = Geometry::CArm(truth.geometry.clone()).rays(SIZE, SIZE).unwrap();
            let (column, row) = rays.project(nertca_vk::geometry::world_from_lps_mm(at)).unwrap();
            let near = |p: &usize| ((p % SIZE) as f64 - column).hypot((p / SIZE) as f64 - row) < 2.5;
            let tip: f32 = (0..PIXELS).filter(near).map(|p| added[p]).sum();
            assert!(tip > 0.15, "{}: the tip is in the ostium: {tip}", frame.name);
            let mask = other.mask.as_ref().unwrap();
            let outside_mask: f32 = (0..PIXELS).filter(|p| !mask[*p]).map(|p| added[p]).sum();
            let share = outside_mask / added.iter().sum::<f32>();
            assert!(outside_mask > 0.5 && share > 0.1, "{}: {outside_mask}, {share}", frame.name);
            (0..PIXELS).for_each(|p| outside[p].push(added[p]));
        }
        if view < TRAINING {
            let spread = |values: &[f32]| values.iter().fold(0f32, |m, v| m.max((v - values[0]).abs()));
            assert!(outside.iter().any(|values| spread(values) > 0.1), "view {view}: its tip moves");
        }
    }
    expect_silence(gpu);
}

/// Attenuation of the block that contains the vessels, 1/mm.
const BLOCK: f32 = 0.01;

/// Vessels of a phase, in voxels of 1 mm.
fn vessels_of(files: &Files, phase: u32) -> Volume {
    let tree = TreeFile::read(&files.tree()).unwrap();
    let bounds = Bounds::over_the_beat(PHASES, |fraction| tree.at(fraction));
    voxels::vessels(&tree.at(f64::from(phase) / f64::from(PHASES)), bounds, IODINE, 1.0)
}

/// Writes volumes with vessels in a block, one per phase.
fn volumes(directory: &Path, files: &Files) -> Vec<PathBuf> {
    let write = |phase: u32| {
        let mut volume = vessels_of(files, phase);
        volume.values.iter_mut().for_each(|v| *v += BLOCK);
        let path = directory.join(format!("volume-{phase}.nrrd"));
        nrrd::write(&path, &volume, "attenuation per mm").unwrap();
        path
    };
    (0..PHASES).map(write).collect()
}

#[test]
fn volumes_are_degraded_like_phantoms() {
    let gpu = gpu();
    let files = Files::new();
    let sources = tempfile::tempdir().unwrap();
    let options = |degradations, vessel_per_mm| VolumeOptions {
        volumes: volumes(sources.path(), &files),
        hints: VolumeHints::default(),
        hounsfield: false,
        scale: 1.0,
        vessel_per_mm,
        c_arms: c_arms(),
        size: SIZE,
        views: views(),
        still: false,
        seed: 5,
        degradations,
        layout: Layout::Native,
    };
    let project = |degradations| {
        let directory = tempfile::tempdir().unwrap();
        project_volumes(&gpu, &options(degradations, Some(0.06)), directory.path(), |_, _, _| ()).unwrap();
        Set::read(directory)
    };
    let (held, breathed) = (project(Degradations::default()), project(breathing(false)));
    let (pictures, breathing_patient) = (Pictures::new(&gpu), files.patient(&gpu, false, breathing(false)));
    for (frame, truth) in breathed.frames() {
        assert_eq!(truth.heart_shift_mm, breathing_patient.same_truth(truth).heart_shift_mm, "one seed, one breath");
        assert_eq!(truth.split == Split::Validation, truth.heart_shift_mm == [0.0; 3]);
        // The block is static, the vessels move.
        let [posterior, left, superior] = truth.heart_shift_mm;
        let c_arm = CArm { table_mm: [left, posterior, superior], ..truth.geometry.clone() };
        let vessels = vessels_of(&files, truth.phase);
        let block = Volume { values: vec![BLOCK; vessels.values.len()], ..vessels.clone() };
        let mut wanted = pictures.of(block, &truth.geometry);
        wanted.iter_mut().zip(pictures.of(vessels, &c_arm)).for_each(|(a, b)| *a += b);
        let off = difference(&frame.integrals, &wanted);
        assert!(off < 0.02, "{}: {off}", frame.name);
    }
    drop(pictures);
    // Between phases the nearest volume is shown, and the truth states which one.
    for (frame, truth) in project(rhythm(15.0, 3, BeatScaling::TwoSegment)).training() {
        let shown = truth.beat_phase.round();
        assert!((truth.beat_phase - shown).abs() < 1e-9);
        let name = frame.name.replace(&format!("phase{:02}", truth.phase), &format!("phase{shown:02}"));
        let wanted = held.dataset.frames.iter().find(|f| f.name == name).unwrap();
        assert_eq!(bits(&frame.integrals), bits(&wanted.integrals), "{}", frame.name);
    }
    let gained = project(Degradations { contrast_variation: 0.2, ..Degradations::default() });
    let (frame, truth) = gained.training().next().unwrap();
    let ratio = frame.integrals.iter().zip(&held.same(frame).integrals).map(|(a, b)| a / b);
    let max = ratio.fold(0f32, |m, r| m.max((r - 1.0).abs()));
    assert!(max > 0.3 * (truth.contrast_gain as f32 - 1.0).abs() && truth.contrast_gain != 1.0, "{max}");
    let refused = |degradations, part: &str| {
        let out = sources.path().join("none");
        let error = project_volumes(&gpu, &options(degradations, None), &out, |_, _, _| ()).unwrap_err().to_string();
        assert!(error.contains(part) && !out.exists(), "{error}");
    };
    refused(Degradations { contrast_variation: 0.1, ..Degradations::default() }, "vessel_per_mm");
    refused(Degradations { collimated_share: 0.1, ..Degradations::default() }, "vessel_per_mm");
    refused(Degradations { catheter: true, ..Degradations::default() }, "ostium");
    refused(Degradations { inflow_s: 0.5, ..Degradations::default() }, "ostium");
    expect_silence(gpu);
}

#[test]
fn one_seed_makes_one_set_of_everything_at_once() {
    let gpu = gpu();
    let files = Files::new();
    let all = || Degradations {
        geometry_error: Some(GeometryError { angle_deg: 0.5, position_mm: 2.0 }),
        photons: Some(Photons::Detector(1e5)),
        contrast_variation: 0.2,
        collimated_share: 0.1,
        catheter: true,
        breathing: breathing(true).breathing,
        ..rhythm(15.0, 3, BeatScaling::TwoSegment)
    };
    let (one, two) = (files.patient(&gpu, true, all()), files.patient(&gpu, true, all()));
    assert_eq!(one.truth, two.truth);
    for (frame, _) in one.frames() {
        assert_eq!(bits(&frame.integrals), bits(&two.same(frame).integrals));
    }
    let geometry_error = all().geometry_error;
    let alone = files.patient(&gpu, true, Degradations { geometry_error, ..Degradations::default() });
    for (frame, truth) in one.frames().filter(|(_, t)| t.phase == 0) {
        assert_eq!(one.stated(frame), alone.stated(alone.same(frame)), "errors of geometry depend on nothing else");
        assert_eq!(truth.cut_share > 0.0, truth.split == Split::Train);
    }
    expect_silence(gpu);
}
