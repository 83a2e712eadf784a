//! Self-calibration of views that disagree, from the angiograms alone.

use crate::common::{gpu, small_dataset, tuning};
use crate::disagreeing::{PHASES, Shot, Studio, Wrong};
use glam::DVec3;
use nertca_vk::calibrate::calibrate;
use nertca_vk::calibrate::choose::{Correction, Tags, fit};
use nertca_vk::calibrate::correction::Calibration;
use nertca_vk::calibrate::observed::Observed;
use nertca_vk::calibrate::profiles::Planes;
use nertca_vk::config::Config;
use nertca_vk::geometry::{MM_PER_UNIT, ViewRays, lps_mm_from_world};
use nertca_vk::scan::dataset::{Dataset, Layout};
use nertca_vk::scan::writer;
use nertca_vk_runs::session::{FrameTime, NewFrame, Session, SessionOptions};
use std::time::Instant;

fn config(mode: &str) -> Config {
    Config::load(None, None, &[format!("calibrate.mode={mode}")]).unwrap()
}

/// Error of a dataset's geometry against the truth, pixels.
fn error_px(shot: &Shot, dataset: &Dataset) -> f64 {
    shot.error_px(&|view, phase| dataset.heart_rays_at(view, phase as u32))
}

/// Calibrates a shot, and returns the calibration and the remaining error, pixels.
fn calibrated(shot: &Shot, mode: &str) -> (Calibration, f64) {
    let begin = Instant::now();
    let calibration = calibrate(&shot.dataset, config(mode).calibration()).unwrap();
    let seconds = begin.elapsed().as_secs_f64();
    let error = error_px(shot, &shot.dataset.corrected(&calibration).unwrap());
    let before = error_px(shot, &shot.dataset);
    println!("{before:.2} px -> {error:.3} px, {seconds:.2} s; {}", calibration.notes.join("; "));
    (calibration, error)
}

#[test]
#[ignore = "long: tools/test --all"]
fn views_are_brought_together() {
    let gpu = gpu();
    let studio = Studio::new(&gpu, 100, 1);
    let none = Wrong { seed: 11, ..Wrong::default() };
    let moved = Wrong { angle_deg: 0.5, shift_mm: 1.0, ..none };
    let breathing = Wrong { breathing_mm: 3.0, ..none };
    let cases = [
        (3, Wrong { noise: 0.1, ..none }, Correction::Stated, 0.05),
        (4, Wrong { noise: 0.1, ..moved }, Correction::Static, 0.3),
        (3, breathing, Correction::Breathing, 0.2),
        (4, Wrong { breathing_mm: 3.0, angle_deg: 0.25, shift_mm: 0.5, ..none }, Correction::Breathing, 0.3),
    ];
    let mut failures = Vec::new();
    for (n_views, wrong, correction, max) in cases {
        let shot = studio.shoot(n_views, wrong);
        let (calibration, error) = calibrated(&shot, "auto");
        if calibration.correction != correction || error.is_nan() || error > max {
            failures.push(format!("{n_views} views, {wrong:?}: {:?}, {error:.3} px", calibration.correction));
        }
        let all: Vec<usize> = (0..PHASES as usize).collect();
        let observed = Observed::new(&shot.dataset);
        let poses = fit(&observed, Correction::Breathing, Tags::Usual, Planes::All);
        for t in all {
            let mean = poses.gains.iter().map(|g| g[t]).sum::<f64>() / f64::from(n_views);
            assert!(mean.abs() < 1e-3, "mean contrast of phase {t}: {mean}");
        }
    }
    assert_eq!(failures, Vec::<String>::new());
}

/// Places blades in front of the images of the first views, each on another side, which hide about `share` of the columns
/// or rows.
fn with_blades(shot: &mut Shot, views: usize, share: f64) {
    let (width, height) = (shot.dataset.width, shot.dataset.height);
    let depth = (share * width as f64) as usize;
    for view in 0..views {
        let shown = |p: usize| match view % 4 {
            0 => p % width >= depth,
            1 => p / width >= depth,
            2 => p % width < width - depth,
            _ => p / width < height - depth,
        };
        for frame in shot.dataset.frames.iter_mut().filter(|f| f.view == view) {
            let dark = frame.integrals.iter().copied().fold(f32::MIN, f32::max) + 1.0;
            frame.integrals.iter_mut().enumerate().filter(|(p, _)| !shown(*p)).for_each(|(_, v)| *v = dark);
        }
        shot.dataset.hidden.insert(view, (0..width * height).map(|p| !shown(p)).collect());
    }
}

#[test]
#[ignore = "long: tools/test --all"]
fn blades_do_not_pull_views_apart() {
    let gpu = gpu();
    let studio = Studio::new(&gpu, 100, 1);
    let none = Wrong { seed: 11, ..Wrong::default() };
    let moved = Wrong { angle_deg: 0.5, shift_mm: 1.0, ..none };
    let mut failures = Vec::new();
    for (n_views, blades, share, wrong, max) in [(3, 3, 0.35, none, 0.05), (4, 4, 0.15, moved, 0.5)] {
        let mut shot = studio.shoot(n_views, wrong);
        with_blades(&mut shot, blades, share);
        let (calibration, error) = calibrated(&shot, "auto");
        if error.is_nan() || error > max {
            let chosen = calibration.correction;
            failures.push(format!("{n_views} views, {blades} blades of {share}, {wrong:?}: {chosen:?}, {error:.3} px"));
        }
    }
    assert_eq!(failures, Vec::<String>::new());
}

#[test]
fn what_tells_nothing_is_left_as_stated() {
    let phases_alike = {
        let mut dataset = small_dataset(40, 40);
        let first: Vec<_> = dataset.frames.clone();
        for f in &mut dataset.frames {
            let same = first.iter().find(|g| g.view == f.view).unwrap();
            f.integrals.clone_from(&same.integrals);
        }
        dataset
    };
    let mut one_view = small_dataset(40, 40);
    one_view.frames.retain(|f| f.view == 0);
    for (dataset, why) in [(phases_alike, "all phases look the same"), (one_view, "at least two such views are needed")]
    {
        let calibration = calibrate(&dataset, config("auto").calibration()).unwrap();
        assert_eq!(calibration.correction, Correction::Stated);
        assert!(calibration.notes.join(" ").contains(why), "{:?}", calibration.notes);
        assert_eq!(dataset.corrected(&calibration).unwrap().views[0].geometry, dataset.views[0].geometry);
    }
    assert_eq!(calibrate(&small_dataset(40, 40), config("off").calibration()).unwrap(), Calibration::none(None));
    let network =
        Config::load(Some(nertca_vk::config::Preset::FastMlp), None, &["calibrate.mode=breathing".into()]).unwrap();
    let refused = calibrate(&small_dataset(40, 40), network.calibration()).unwrap_err().to_string();
    assert!(refused.contains("calibrate.mode") && refused.contains("per view only"), "{refused}");
}

#[test]
fn corrections_are_written_and_read() {
    let dataset = small_dataset(24, 20);
    let stated = dataset.views[1].geometry.clone();
    let mut corrected = dataset.clone();
    corrected.views[1].geometry = stated.corrected([0.3, -0.2], glam::DVec3::new(0.01, 0.0, -0.02));
    corrected.views[1].rays = corrected.views[1].geometry.rays(24, 20).unwrap();
    corrected.frames[0].heart_shift_mm = [1.0, -0.5, 2.0];
    let directory = tempfile::tempdir().unwrap();
    let of_view = |view: usize| (view == 1).then(|| stated.clone());
    writer::write(&corrected, Layout::Native, directory.path(), "test".into(), &of_view).unwrap();
    let read = Dataset::open(directory.path()).unwrap();
    assert_eq!(read.views[1].geometry, corrected.views[1].geometry);
    assert_eq!(read.frames[0].heart_shift_mm, [1.0, -0.5, 2.0]);
    let source = read.heart_rays(&read.frames[0]).source() - read.views[read.frames[0].view].rays.source();
    assert!((source - glam::DVec3::new(-0.01, 0.005, -0.02)).length() < 1e-12, "{source}");
    let text = std::fs::read_to_string(directory.path().join("dataset.json")).unwrap();
    assert!(text.contains("stated_geometry"));
    let refused = writer::convert(&read, Layout::Nerfca, &directory.path().join("x")).unwrap_err().to_string();
    assert!(refused.contains("nerfca"), "{refused}");
}

#[test]
fn a_session_tells_how_it_sees_its_frames() {
    let gpu = gpu();
    let wrong = Wrong { seed: 11, angle_deg: 0.5, shift_mm: 1.0, breathing_mm: 3.0, ..Wrong::default() };
    let shot = Studio::new(&gpu, 100, 1).shoot(3, wrong);
    let options = SessionOptions {
        config: config("auto"),
        phases: PHASES,
        depth_half_extent_mm: shot.dataset.depth_range.1 * MM_PER_UNIT,
        vessel_attenuation_per_mm: shot.dataset.vessel_attenuation.map(|a| a / MM_PER_UNIT),
        still: false,
        deterministic: true,
    };
    let session = Session::new(Some(gpu.clone()), Some(tuning(&gpu)), options).unwrap();
    let training = shot.dataset.training();
    for f in training {
        let new = NewFrame {
            geometry: shot.dataset.views[f.view].geometry.clone(),
            moment: FrameTime::Phase(f.phase),
            split: f.split,
            width: shot.dataset.width,
            height: shot.dataset.height,
            integrals: f.integrals.to_vec(),
            mask: None,
        };
        session.add_frame(new).unwrap();
    }
    // Corners of the heart, projected to pixels of a frame.
    let corners = (0..8).map(|k| DVec3::new((k & 1) as f64, (k >> 1 & 1) as f64, (k >> 2) as f64) * 0.1 - 0.05);
    let corners: Vec<DVec3> = corners.collect();
    let farthest = |frame: usize, rays: &ViewRays| {
        let seen = session.corrected_frame(frame).unwrap();
        let away = corners.iter().map(|corner| {
            let x = lps_mm_from_world(*corner);
            let [i, j, w] = seen.projection.map(|[a, b, c, d]| a * x.x + b * x.y + c * x.z + d);
            let (u, v) = rays.project(*corner).unwrap();
            (i / w - u).hypot(j / w - v)
        });
        (seen.correction, away.fold(0.0, f64::max))
    };
    for (index, f) in training.iter().enumerate() {
        let (correction, away) = farthest(index, &shot.dataset.views[f.view].rays);
        assert_eq!(correction, Correction::Stated, "nothing was trained");
        assert!(away < 1e-9, "frame {index} as stated: {away} px");
    }
    session.train(1, &mut |_| true).unwrap();
    let corrected = shot.dataset.corrected(&calibrate(&shot.dataset, config("auto").calibration()).unwrap()).unwrap();
    for (index, f) in corrected.training().iter().enumerate() {
        let (correction, away) = farthest(index, &corrected.heart_rays(f));
        assert_eq!(correction, Correction::Breathing);
        assert!(away < 1e-9, "frame {index} as corrected: {away} px");
        assert!(farthest(index, &shot.dataset.views[f.view].rays).1 > 0.5, "frame {index} was moved");
    }
    // A newly stated geometry is valid until training adopts it.
    let other = shot.dataset.views[training[0].view].geometry.corrected([1.0, 0.0], DVec3::ZERO);
    session.set_geometry(0, other.clone()).unwrap();
    let (correction, away) = farthest(0, &other.rays(shot.dataset.width, shot.dataset.height).unwrap());
    assert!(correction == Correction::Stated && away < 1e-9, "{correction:?}, {away} px");
    assert_eq!(farthest(1, &corrected.heart_rays(&corrected.training()[1])).0, Correction::Breathing);
    // The correction of a checkpoint is not known.
    session.load(session.checkpoint().unwrap()).unwrap();
    assert_eq!(farthest(1, &shot.dataset.views[training[1].view].rays).0, Correction::Stated);
    let none = session.corrected_frame(training.len()).unwrap_err().to_string();
    assert!(none.contains(&format!("{} were added", training.len())), "{none}");
}
