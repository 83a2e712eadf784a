//! Whole runs: the loss decreases, runs repeat with equal bits, resuming equals an uninterrupted run, rendering equals the
//! twin.

use crate::common::{expect_agreement, expect_silence, gpu, run, small_config, small_dataset, tuning};
use nertca_vk::checkpoint::{self, Checkpoint};
use nertca_vk::config::Preset;
use nertca_vk::error::Error;
use nertca_vk::fields::state::FieldsState;
use nertca_vk::kernels::tuning::Tuning;
use nertca_vk::model::component::Component;
use nertca_vk::plan::Plan;
use nertca_vk::render::baked::Baked;
use nertca_vk::render::quantity::{Projection, Quantity};
use nertca_vk::render::renderer::Renderer;
use nertca_vk::train::trainer::Trainer;
use nertca_vk_runs::run::events::Event;
use nertca_vk_runs::run::reconstruct::{RunOptions, reconstruct};
use nertca_vk_twins::selftest::drawing;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

#[test]
fn the_loss_falls_and_runs_repeat_bit_by_bit() {
    let gpu = gpu();
    let dataset = small_dataset(13, 11);
    for preset in ["fast-mlp", "paper"] {
        let config =
            small_config(preset, &["loss.normalise=true", "dynamic.lr=3e-3", "train.iterations=120", "train.rays=64"]);
        let train = || {
            let mut trainer =
                Trainer::new(&gpu, Plan::new(&config, &dataset).unwrap(), &dataset, tuning(&gpu)).unwrap();
            let losses = run(&mut trainer, 120);
            (losses, trainer.model().unwrap().params)
        };
        let ((losses, params), (again, same)) = (train(), train());
        let mean = |l: &[f64]| l.iter().sum::<f64>() / l.len() as f64;
        assert!(mean(&losses[100..]) < 0.3 * mean(&losses[..5]), "{preset}: {:?}", &losses[..5]);
        assert_eq!(losses, again, "{preset}: losses differ between equal runs");
        assert_eq!(params, same, "{preset}: parameters differ between equal runs");
    }
    expect_silence(gpu);
}

#[test]
fn resume_equals_no_interruption() {
    let gpu = gpu();
    let dataset = small_dataset(13, 11);
    let config =
        small_config("fast-mlp", &["dynamic.delay=7", "train.checkpoint_every=1000", "train.validate_every=16"]);
    let directory = tempfile::tempdir().unwrap();
    let never = AtomicBool::new(false);
    let go = |name: &str, resume: bool, stop_at: Option<u32>| {
        let path = directory.path().join(name);
        let options = RunOptions { tuning: &tuning(&gpu), run: &path, resume, stop_at, cancel: &never };
        reconstruct(&gpu, &config, &dataset, &options, &mut |_| {}).unwrap();
        Checkpoint::read(&checkpoint::newest(&path).unwrap()).unwrap()
    };
    let whole = go("whole", false, None);
    let stopped = go("parts", false, Some(13));
    assert_eq!(stopped.model.step, 13);
    assert_ne!(stopped.model.params, whole.model.params);
    let parts = go("parts", true, None);
    assert_eq!((parts.model.step, whole.model.step), (40, 40));
    assert_eq!(parts.model.params, whole.model.params);
    let moments = |checkpoint: &Checkpoint| checkpoint.state::<FieldsState>().unwrap().moments.clone();
    assert_eq!(moments(&parts), moments(&whole));
    let steps = |name: &str| -> Vec<(String, u64)> {
        let text = std::fs::read_to_string(directory.path().join(name).join("metrics.jsonl")).unwrap();
        // The stop adds a line of its own; the regular lines are equal.
        let lines = text.lines().map(|l| serde_json::from_str::<serde_json::Value>(l).unwrap());
        lines
            .filter(|v| v["event"] == "progress" && v["step"].as_u64().unwrap() % 10 == 0)
            .map(|v| (v["data"].to_string(), v["step"].as_u64().unwrap()))
            .collect()
    };
    assert_eq!(steps("parts"), steps("whole"), "metrics.jsonl differs");
    expect_silence(gpu);
}

#[test]
fn resuming_on_other_images_is_refused() {
    let gpu = gpu();
    let mut dataset = small_dataset(13, 11);
    let config = small_config("fast-mlp", &[]);
    let mut trainer = Trainer::new(&gpu, Plan::new(&config, &dataset).unwrap(), &dataset, tuning(&gpu)).unwrap();
    run(&mut trainer, 4);
    let saved = trainer.checkpoint().unwrap();
    dataset.frames[0].integrals[3] += 0.01;
    let plan = Plan::new(&saved.model.config, &dataset).unwrap().in_scene(saved.model.scene.clone());
    let refused = Trainer::resume(&gpu, plan, &dataset, tuning(&gpu), &saved).err().unwrap().to_string();
    assert!(refused.contains("different images"), "{refused}");
}

#[test]
fn a_cancelled_run_is_saved_and_a_diverging_one_keeps_its_checkpoint() {
    let gpu = gpu();
    let dataset = small_dataset(13, 11);
    let directory = tempfile::tempdir().unwrap();
    let cancel = AtomicBool::new(false);
    let options =
        RunOptions { tuning: &tuning(&gpu), run: directory.path(), resume: false, stop_at: None, cancel: &cancel };
    let mut stop_at_ten = |event: &Event| {
        if let Event::Progress { .. } = event {
            cancel.store(true, std::sync::atomic::Ordering::Relaxed);
        }
    };
    let config = small_config("fast-mlp", &["train.iterations=1000"]);
    let outcome = reconstruct(&gpu, &config, &dataset, &options, &mut stop_at_ten);
    assert!(matches!(outcome, Err(Error::Interrupted)), "{outcome:?}");
    assert!(Checkpoint::read(&checkpoint::newest(directory.path()).unwrap()).unwrap().model.step >= 10);

    let directory = tempfile::tempdir().unwrap();
    let never = AtomicBool::new(false);
    let options =
        RunOptions { tuning: &tuning(&gpu), run: directory.path(), resume: false, stop_at: None, cancel: &never };
    let config = small_config(
        "fast-mlp",
        &[
            "train.iterations=400",
            "train.checkpoint_every=1",
            "static.lr=100",
            "static.lr_end=100",
            "train.stop_at_loss_ratio=1e6",
        ],
    );
    let outcome = reconstruct(&gpu, &config, &dataset, &options, &mut |_| {});
    assert!(matches!(outcome, Err(Error::Diverged { .. })), "{outcome:?}");
    let kept = Checkpoint::read(&checkpoint::newest(directory.path()).unwrap()).unwrap();
    assert!(kept.model.params.iter().all(|p| p.is_finite()));
}

#[test]
fn views_equal_the_twin() {
    let gpu = gpu();
    for preset in [Preset::Paper, Preset::FastMlp] {
        expect_agreement(|findings| drawing::compare_views(&gpu, preset, &tuning(&gpu), findings));
    }
    expect_silence(gpu);
}

#[test]
fn damaged_checkpoints_are_refused() {
    let gpu = gpu();
    let dataset = small_dataset(13, 11);
    let mut trainer = Trainer::new(
        &gpu,
        Plan::new(&small_config("fast-mlp", &["occupancy.enabled=false"]), &dataset).unwrap(),
        &dataset,
        tuning(&gpu),
    )
    .unwrap();
    run(&mut trainer, 2);
    let directory = tempfile::tempdir().unwrap();
    let path = trainer.checkpoint().unwrap().save(directory.path()).unwrap();
    let bytes = std::fs::read(&path).unwrap();
    let refuse = |bytes: &[u8]| {
        std::fs::write(&path, bytes).unwrap();
        let message = Checkpoint::read(&path).err().unwrap().to_string();
        assert!(message.contains(Path::new(&path).file_name().unwrap().to_str().unwrap()), "{message}");
    };
    for keep in [0, 7, 100, bytes.len() / 2, bytes.len() - 1] {
        refuse(&bytes[..keep]);
    }
    let mut poisoned = bytes.clone();
    let last = poisoned.len() - 4;
    poisoned[last..].copy_from_slice(&f32::NAN.to_le_bytes());
    refuse(&poisoned);
}

#[test]
fn older_checkpoints_follow_the_stated_rule() {
    let gpu = gpu();
    let dataset = small_dataset(13, 11);
    let mut trainer =
        Trainer::new(&gpu, Plan::new(&small_config("fast-mlp", &[]), &dataset).unwrap(), &dataset, tuning(&gpu))
            .unwrap();
    let directory = tempfile::tempdir().unwrap();
    for step in 1..=5 {
        run(&mut trainer, step);
        trainer.checkpoint().unwrap().save(directory.path()).unwrap();
    }
    let steps: Vec<u32> = checkpoint::list(directory.path()).unwrap().iter().map(|(s, _)| *s).collect();
    assert_eq!(steps, [3, 4, 5]);
}

#[test]
fn sampled_fields_equal_the_twin_and_baked_views_the_rendered_ones() {
    let gpu = gpu();
    expect_agreement(|findings| drawing::compare_volumes(&gpu, &tuning(&gpu), findings));
    // Cells are finer than those used for display.
    let dataset = small_dataset(24, 20);
    let config = small_config("fast-mlp", &["train.rays=64", "train.chunk_samples=2000", "march.render_samples=200"]);
    let mut trainer = Trainer::new(&gpu, Plan::new(&config, &dataset).unwrap(), &dataset, tuning(&gpu)).unwrap();
    run(&mut trainer, 5);
    let renderer = Arc::new(Renderer::new(&gpu, &trainer.model().unwrap(), tuning(&gpu)).unwrap());
    let baked = Baked::new(renderer.clone(), 96).unwrap();
    let view = &dataset.views[1].rays;
    let exact = renderer.render(view, 24, 20, 1).unwrap();
    let show = |component, projection| baked.render(view, 24, 20, 1, Quantity { component, projection }).unwrap();
    let (drr, mip) = (Projection::Drr, Projection::Mip);
    for (name, got, want, limit) in [
        ("static", show(Component::Static, drr), exact.static_integral.clone(), 1e-2),
        ("dynamic", show(Component::Dynamic, drr), exact.dynamic_integral.clone(), 2e-2),
        ("total", show(Component::Total, drr), exact.total_integral(), 1e-2),
        ("static maximum", show(Component::Static, mip), exact.static_max.clone(), 2e-2),
        ("dynamic maximum", show(Component::Dynamic, mip), exact.dynamic_max.clone(), 2e-2),
    ] {
        let want: Vec<f64> = want.iter().map(|v| f64::from(*v)).collect();
        let norm = want.iter().map(|w| w * w).sum::<f64>();
        let off = got.iter().zip(&want).map(|(g, w)| (f64::from(*g) - w).powi(2)).sum::<f64>();
        assert!(norm > 0.0 && (off / norm).sqrt() < limit, "{name}: {:.1e} off", (off / norm).sqrt());
    }
    // A recorded command buffer serves any view.
    let other = Quantity { component: Component::Static, projection: drr };
    let turned = baked.render(&dataset.views[0].rays, 24, 20, 1, other).unwrap();
    assert_ne!(turned, show(Component::Static, drr));
    drop((baked, renderer, trainer));
    expect_silence(gpu);
}

#[test]
fn keeping_snapshots_beside_training_changes_nothing() {
    let gpu = gpu();
    let dataset = small_dataset(13, 11);
    let config = small_config("fast-mlp", &["train.checkpoint_every=12", "train.validate_every=8"]);
    let directory = tempfile::tempdir().unwrap();
    let never = AtomicBool::new(false);
    let go = |name: &str, overlap: bool| {
        let path = directory.path().join(name);
        let tuning = Tuning { overlap, ..tuning(&gpu) };
        let options = RunOptions { tuning: &tuning, run: &path, resume: false, stop_at: None, cancel: &never };
        let (mut saved, mut validated) = (Vec::new(), Vec::new());
        reconstruct(&gpu, &config, &dataset, &options, &mut |event| match event {
            Event::Saved { step, .. } => saved.push(*step),
            Event::Validation { step, psnr, .. } => validated.push((*step, psnr.to_bits())),
            _ => {}
        })
        .unwrap();
        let last = Checkpoint::read(&checkpoint::newest(&path).unwrap()).unwrap();
        let moments = last.state::<FieldsState>().unwrap().moments.clone();
        (saved, validated, last.model.params, moments)
    };
    let (between, beside) = (go("between", false), go("beside", true));
    assert_eq!(between.0, [12, 24, 36, 40]);
    assert_eq!(between.1.iter().map(|v| v.0).collect::<Vec<_>>(), [8, 16, 24, 32, 40]);
    assert_eq!(between, beside);
    expect_silence(gpu);
}
