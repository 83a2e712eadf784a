//! Runs of every preset through all events of its schedule: the start of the dynamic field, the restart after it, open windows,
//! ramps, density control, the change from Gaussians to the static field.

use crate::common::{expect_silence, gpu, phantom, run, small_config, small_dataset, tuning};
use nertca_vk::checkpoint::Checkpoint;
use nertca_vk::choice::Choice;
use nertca_vk::config::{Config, Preset};
use nertca_vk::fields::state::FieldsState;
use nertca_vk::plan::Plan;
use nertca_vk::train::dry_run::dry_run;
use nertca_vk::train::trainer::Trainer;

/// Iterations after the last event.
const AFTER: u32 = 20;

/// The published schedule at a tenth of its length, with thin batches.
const THIN: [&str; 7] = [
    "train.rays=64",
    "march.static_samples=48",
    "march.dynamic_samples=48",
    "march.render_samples=48",
    "train.iterations=3000",
    "dynamic.delay=150",
    "dynamic.window_iterations=1500",
];

#[test]
fn the_published_configuration_in_small_goes_through_its_delay_and_on() {
    let (gpu, directory) = (gpu(), tempfile::tempdir().unwrap());
    let dataset = phantom(&gpu, directory.path(), 50, 4);
    for preset in [Preset::Paper, Preset::PublicCode] {
        let config = Config::load(Some(preset), None, &THIN.map(String::from)).unwrap();
        let mut trainer = Trainer::new(&gpu, Plan::new(&config, &dataset).unwrap(), &dataset, tuning(&gpu)).unwrap();
        let before = run(&mut trainer, 150);
        assert_eq!(trainer.take_large_loss(), None, "{preset:?}");
        let after = run(&mut trainer, 150 + AFTER);
        // At the delay, the published rates change both fields by orders of magnitude; training must survive this.
        let large = trainer.take_large_loss().expect("a large loss at the delay");
        assert!((151..170).contains(&large.step) && large.ratio > 1e6, "{preset:?}: {large:?}");
        assert_eq!((before.len(), after.len()), (150, AFTER as usize));
        assert!(after.iter().all(|loss| loss.is_finite()), "{preset:?}: {after:?}");
        trainer.checkpoint().unwrap();

        // On request, training stops there.
        let stops = config.with(&["train.stop_at_loss_ratio=1e6".into()]).unwrap();
        let mut trainer = Trainer::new(&gpu, Plan::new(&stops, &dataset).unwrap(), &dataset, tuning(&gpu)).unwrap();
        run(&mut trainer, 150);
        let stopped = loop {
            if let Err(error) = trainer.advance(150 + AFTER) {
                break error.to_string();
            }
            assert!(trainer.step() < 150 + AFTER, "{preset:?}: it did not stop");
        };
        assert!(
            stopped.contains(&format!("iteration {}", large.step)) && stopped.contains("dynamic.delay"),
            "{stopped}"
        );
    }
    expect_silence(gpu);
}

#[test]
#[ignore = "long: tools/test --all"]
fn every_preset_trains_past_the_last_event_of_its_schedule() {
    let (gpu, directory) = (gpu(), tempfile::tempdir().unwrap());
    let dataset = phantom(&gpu, directory.path(), 32, 4);
    for preset in Preset::ALL {
        let mut settings = match preset {
            Preset::R2Gaussian | Preset::XGaussian | Preset::SaxNerf => vec![],
            Preset::NerfCa => vec!["train.rays=32", "train.chunk_samples=16384"],
            _ => vec!["train.rays=32", "train.chunk_samples=8192"],
        };
        settings.extend(match preset {
            Preset::R2Gaussian => vec!["r2.n_points=300", "r2.voxels=16", "r2.tv_vol_size=8"],
            Preset::XGaussian => vec!["x.voxels=16", "x.interval=2"],
            Preset::SaxNerf => {
                vec![
                    "sax.n_rays=16",
                    "sax.n_samples=16",
                    "sax.window_size=4",
                    "sax.log2_hashmap_size=10",
                    "sax.num_levels=4",
                ]
            }
            Preset::NerfCa => vec!["march.dynamic_samples=32", "dynamic.width=16"],
            Preset::Fast => vec!["gaussians.count=100"],
            _ => vec!["march.dynamic_samples=32", "march.static_samples=32", "dynamic.width=16"],
        });
        let settings: Vec<String> = settings.into_iter().map(String::from).collect();
        let mut config = Config::load(Some(*preset), None, &settings).unwrap().of_dry_run();
        let last = *config.schedule_events().last().unwrap();
        config.train.iterations = config.train.iterations.max(last + AFTER);
        let mut trainer = Trainer::new(&gpu, Plan::new(&config, &dataset).unwrap(), &dataset, tuning(&gpu)).unwrap();
        let losses = run(&mut trainer, last + AFTER);
        assert_eq!(losses.len() as u32, last + AFTER, "{preset:?}");
        assert!(losses.iter().all(|loss| loss.is_finite()), "{preset:?}: {losses:?}");
        trainer.checkpoint().unwrap();
    }
    expect_silence(gpu);
}

#[test]
fn runs_resumed_around_the_delay_are_bit_equal() {
    let gpu = gpu();
    let dataset = small_dataset(13, 11);
    for preset in ["paper", "public-code"] {
        let config = small_config(preset, &["dynamic.delay=5", "dynamic.occlusion=1e-3"]);
        let start = || Trainer::new(&gpu, Plan::new(&config, &dataset).unwrap(), &dataset, tuning(&gpu)).unwrap();
        let bits = |checkpoint: &Checkpoint| -> Vec<u32> {
            let moments = checkpoint.state::<FieldsState>().unwrap().moments.iter().flatten();
            checkpoint.model.params.iter().chain(moments).map(|v| v.to_bits()).collect()
        };
        let mut whole = start();
        run(&mut whole, 12);
        let whole = bits(&whole.checkpoint().unwrap());
        for stop in [4, 5, 6, 7] {
            let mut first = start();
            run(&mut first, stop);
            let saved = first.checkpoint().unwrap();
            let plan = Plan::new(&saved.model.config, &dataset).unwrap().in_scene(saved.model.scene.clone());
            let mut second = Trainer::resume(&gpu, plan, &dataset, tuning(&gpu), &saved).unwrap();
            run(&mut second, 12);
            assert_eq!(bits(&second.checkpoint().unwrap()), whole, "{preset} stopped after {stop}");
        }
    }
    expect_silence(gpu);
}

#[test]
fn a_dry_run_goes_through_all_events() {
    let gpu = gpu();
    let dataset = small_dataset(13, 11);
    let config = small_config("public-code", &["train.iterations=3000", "dynamic.delay=150"]);
    let done = dry_run(&gpu, &config, &dataset, &tuning(&gpu)).unwrap();
    assert_eq!((done.iterations, done.events), (20, vec![1, 2]));
    assert!(done.last_loss.is_finite());
    expect_silence(gpu);
}
