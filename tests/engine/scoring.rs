//! Scoring that is observed, cancelled, and warns of a vanished field.

use crate::common::{expect_silence, gpu, small_config, small_dataset, tuning};
use nertca_vk::error::Error;
use nertca_vk::model::Model;
use nertca_vk::plan::Plan;
use nertca_vk::scan::dataset::{Dataset, Split};
use nertca_vk::train::trainer::Trainer;
use nertca_vk_runs::run::events::Event;
use nertca_vk_runs::run::score::{ScoreOptions, evaluate_model};
use std::sync::atomic::{AtomicBool, Ordering};

/// A dataset with one validation view of three images.
fn dataset() -> Dataset {
    let mut dataset = small_dataset(16, 12);
    for frame in dataset.frames.iter_mut().filter(|f| f.view == 2) {
        frame.split = Split::Validation;
        frame.mask = Some(frame.integrals.iter().map(|v| *v > 1.1).collect());
    }
    dataset.frames.sort_by_key(|f| f.split);
    dataset
}

/// An untrained model whose dynamic field attenuates by softplus(`bias`) in its own units.
fn model(gpu: &nertca_vk::gpu::device::Gpu, dataset: &Dataset, bias: f32) -> Model {
    let plan = Plan::new(&small_config("fast-mlp", &[]), dataset).unwrap();
    let mut model = Trainer::new(gpu, plan, dataset, tuning(gpu)).unwrap().model().unwrap();
    let bias_at = model.param_map.dynamic_network.as_ref().unwrap().out_bias;
    model.params[bias_at] = bias;
    model
}

#[test]
fn scoring_ends_after_the_image_under_way() {
    let (gpu, dataset) = (gpu(), dataset());
    let model = model(&gpu, &dataset, 0.0);
    let stop = AtomicBool::new(false);
    let dir = tempfile::tempdir().unwrap();
    let options = ScoreOptions { threshold_per_mm: None, pictures: Some(dir.path()), cancel: &stop };
    let mut heard = Vec::new();
    let outcome = evaluate_model(&gpu, &tuning(&gpu), &model, &dataset, &options, &mut |event| {
        let Event::Evaluation { images, of, left_s, .. } = event else { panic!("{event:?}") };
        assert_eq!(left_s.is_some(), *images > 0);
        heard.push((*images, *of));
        stop.store(*images == 2, Ordering::Relaxed);
    });
    assert!(matches!(outcome, Err(Error::Interrupted)), "{outcome:?}");
    assert_eq!(heard, [(0, 3), (1, 3), (2, 3)]);
    assert_eq!(std::fs::read_dir(dir.path()).unwrap().count(), 0, "half an evaluation leaves no pictures");
    // Without a cancel it completes, and animations reuse the rendered images.
    stop.store(false, Ordering::Relaxed);
    let mut heard = 0;
    let scores = evaluate_model(&gpu, &tuning(&gpu), &model, &dataset, &options, &mut |_| heard += 1).unwrap();
    assert_eq!((heard, scores.images.len()), (4, 3));
    assert_eq!(std::fs::read_dir(dir.path()).unwrap().count(), 3 + 1, "a picture of each image and one animation");
    expect_silence(gpu);
}

#[test]
fn a_dead_moving_field_is_told_of() {
    let (gpu, dataset) = (gpu(), dataset());
    let never = AtomicBool::new(false);
    let options = ScoreOptions { threshold_per_mm: None, pictures: None, cancel: &never };
    let warnings = |bias: f32| {
        let model = model(&gpu, &dataset, bias);
        evaluate_model(&gpu, &tuning(&gpu), &model, &dataset, &options, &mut |_| ()).unwrap().warnings
    };
    let dead = warnings(-30.0);
    assert!(dead.len() == 1 && dead[0].contains("dynamic field has become almost zero"), "{dead:?}");
    assert_eq!(warnings(30.0), Vec::<String>::new());
    expect_silence(gpu);
}
