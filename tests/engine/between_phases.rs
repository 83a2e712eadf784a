//! Frames taken between two phases: reading, writing, refusal, and use in the fit.

use crate::common;
use crate::common::{gpu, tuning};
use nertca_vk::config::{Config, Preset};
use nertca_vk::fields::data::FieldData;
use nertca_vk::gaussians::field::GaussianField;
use nertca_vk::gaussians::pictures::Pictures;
use nertca_vk::methods::dynamic_gaussians::data::GaussianData;
use nertca_vk::plan::Plan;
use nertca_vk::render::renderer::Renderer;
use nertca_vk::scan::dataset::{Dataset, Layout, Split};
use nertca_vk::scan::gating::BeatTime;
use nertca_vk::scan::writer;
use nertca_vk_twins::selftest::blobs;
use nertca_vk_twins::selftest::problems::drawn_fields;
use serde_json::Value;
use std::path::Path;

/// Writes a dataset of three phases in which the time of the first frame is `phase`.
fn with_first_frame_at(directory: &Path, phase: Value) {
    writer::convert(&common::small_dataset(8, 8), Layout::Native, directory).unwrap();
    let file = directory.join("dataset.json");
    let mut manifest: Value = serde_json::from_slice(&std::fs::read(&file).unwrap()).unwrap();
    assert!(manifest["frames"][0]["phase"].is_u64(), "whole phases are written as whole numbers");
    manifest["frames"][0]["phase"] = phase;
    std::fs::write(file, manifest.to_string()).unwrap();
}

#[test]
fn a_frame_keeps_its_time_from_file_to_file() {
    for (phase, nearest, after) in [(1.3, 1, 0.3), (2.75, 0, -0.25), (2.0, 2, 0.0)] {
        let [first, second] = [0, 1].map(|_| tempfile::tempdir().unwrap());
        with_first_frame_at(first.path(), phase.into());
        let read = Dataset::open(first.path()).unwrap();
        writer::convert(&read, Layout::Native, second.path()).unwrap();
        for dataset in [read, Dataset::open(second.path()).unwrap()] {
            let frame = &dataset.frames[0];
            assert_eq!(frame.phase, nearest, "phase {phase}: the beat closes");
            assert!((frame.after_phase - after).abs() < 1e-9, "phase {phase}: {}", frame.after_phase);
            assert!((frame.beat_time().phases(dataset.n_phases) - phase).abs() < 1e-9);
        }
    }
}

#[test]
fn times_outside_the_beat_are_refused() {
    for phase in [Value::from(3), 3.2.into(), (-0.1).into(), "2".into(), Value::Null] {
        let directory = tempfile::tempdir().unwrap();
        with_first_frame_at(directory.path(), phase.clone());
        let refused = Dataset::open(directory.path()).unwrap_err().to_string();
        let named = refused.contains("frames[0].phase") && refused.contains("phases go from 0 to 2");
        assert!(named || !phase.is_number() && refused.contains("line"), "{phase}: {refused}");
    }
}

#[test]
fn a_moving_tree_is_fitted_to_frames_at_their_own_time() {
    let mut dataset = common::small_dataset(40, 40);
    dataset.frames.iter_mut().filter(|f| f.phase == 1).for_each(|f| f.after_phase = 0.25);
    let taken = dataset.training().iter().filter(|f| f.split == Split::Train && f.after_phase != 0.0).count();
    let config = |form: &str| Config::load(Some(Preset::Fast), None, &[format!("gaussians.form={form}")]).unwrap();
    let planned = |form: &str| Plan::new(&config(form), &dataset).unwrap();
    let plan = planned("tree");
    let targets = &plan.data::<GaussianData>().unwrap().targets;
    for phase in 0..targets.n_phases {
        let wanted = if phase == 1 { 0.25 } else { 0.0 };
        assert!(targets.views_at(phase).count() > 1);
        assert!(targets.views_at(phase).all(|(_, view)| view.after_phase == wanted), "phase {phase}");
    }
    let told =
        |plan: &Plan, fate: &str| plan.notes.iter().any(|n| n.starts_with(&format!("{taken} of")) && n.contains(fate));
    assert!(told(&plan, "fitted at their own time"), "{:?}", plan.notes);
    assert!(told(&planned("phase"), "are used as frames of the nearest phase"));
    let network = Plan::new(&Config::preset(Preset::FastMlp), &dataset).unwrap();
    assert!(told(&network, "trained at their own time"), "{:?}", network.notes);
    for (row, frame) in network.data::<FieldData>().unwrap().frames.iter().zip(dataset.training()) {
        let own_time = if frame.phase == 1 { (1, 2, 0.25) } else { (frame.phase, (frame.phase + 1) % 3, 0.0) };
        assert_eq!((row.phase, row.beyond, row.beyond_share), own_time);
    }
}

#[test]
fn pictures_are_full_or_filled_as_images_are() {
    const FILLING: [f32; 3] = [1.0, 0.5, 0.2];
    let gpu = gpu();
    let dataset = common::small_dataset(37, 29);
    let rays = &dataset.views[1].rays;
    let [_, full] = drawn_fields();
    let Some(mut set) = full.moving().cloned() else { unreachable!() };
    set.filling = Some((0..set.rest.rows.len()).flat_map(|_| FILLING).collect());
    let field = GaussianField::Moving(set);
    let [plain, shown] = [&full, &field].map(|field| Pictures::new(&gpu, field).unwrap());
    let imaged = Pictures::as_imaged(&gpu, &field).unwrap();
    for (time, share) in [(0.0, 1.0), (1.0, 0.5), (1.4, 0.38), (2.5, 0.6)] {
        let [plain, shown, imaged] = [&plain, &shown, &imaged].map(|p| p.draw_at(rays, (37, 29), time).unwrap());
        assert_eq!(shown, plain, "time {time}: drawn vessels are full");
        let max = plain.iter().fold(0f32, |max, v| max.max(*v));
        let worst = imaged.iter().zip(&plain).map(|(a, b)| (a - share * b).abs() / max).fold(0.0, f32::max);
        assert!(worst < 1e-4 && max > 0.1, "time {time}: {worst}");
    }
    drop((plain, shown, imaged));
    common::expect_silence(gpu);
}

#[test]
fn pictures_and_views_show_the_field_at_their_time() {
    let gpu = gpu();
    let dataset = common::small_dataset(37, 29);
    let rays = &dataset.views[1].rays;
    let far = |a: &[f32], b: &[f32]| {
        let max = b.iter().fold(1e-9f32, |m, v| m.max(*v));
        a.iter().zip(b).map(|(a, b)| (a - b).abs() / max).fold(0.0, f32::max)
    };
    let [sets, tree] = drawn_fields();
    for (field, moves) in [(sets, false), (tree, true)] {
        let pictures = Pictures::new(&gpu, &field).unwrap();
        let model = blobs::model(&gpu, &dataset, field, &tuning(&gpu)).unwrap();
        let renderer = Renderer::new(&gpu, &model, tuning(&gpu)).unwrap();
        let view = |phase: u32, after_phase: f64| {
            let taken = BeatTime { phase, after_phase };
            renderer.render_taken(rays, 37, 29, taken).unwrap().dynamic_integral
        };
        for (phase, after_phase, time) in [(1, 0.4, 1.4), (0, -0.3, 2.7), (2, 0.0, 2.0)] {
            let wanted = view(phase, after_phase);
            let drawn = pictures.draw_at(rays, (37, 29), time).unwrap();
            assert!(far(&drawn, &wanted) < 0.03, "phase {time}: {}", far(&drawn, &wanted));
            let elsewhere = far(&wanted, &view(phase, 0.0));
            assert_eq!(elsewhere > 0.05, moves && after_phase != 0.0, "phase {time}: {elsewhere} from the whole phase");
        }
    }
    common::expect_silence(gpu);
}
