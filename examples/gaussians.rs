//! Fits Gaussians to a dataset and scores them on its validation views: `gaussians DIR [NOISE] [VIEWS_TO_DROP] [JSON]
//! [tree]`.
//! NOISE is white, as a share of the strongest change; JSON changes settings, e.g. `{"least_scale": 0.6}`.
#![allow(clippy::unwrap_used, clippy::expect_used, reason = "an example")]

use nertca_vk::config::{Config, Preset};
use nertca_vk::cpu::random::{STREAM_PHOTON, normal};
use nertca_vk::data::dataset::{Dataset, Split};
use nertca_vk::gaussians::maxima::maxima;
use nertca_vk::gaussians::scene::Scene;
use nertca_vk::gaussians::settings::Settings;
use nertca_vk::gaussians::trainer::GaussianTrainer;
use nertca_vk::gaussians::tree::settings::TreeSettings;
use nertca_vk::gaussians::tree::trainer::TreeTrainer;
use nertca_vk::gaussians::view::SplatView;
use nertca_vk::gpu::device::{DeviceOptions, Gpu};
use nertca_vk::model::scene::dynamic_half;
use nertca_vk::output::metrics;
use nertca_vk::soft_hull::carve::SoftMotion;
use std::time::Instant;

fn main() {
    let arguments: Vec<String> = std::env::args().collect();
    let mut dataset = Dataset::open(arguments[1].as_ref()).unwrap();
    let noise: f64 = arguments.get(2).map_or(0.0, |a| a.parse().unwrap());
    let drop: usize = arguments.get(3).map_or(0, |a| a.parse().unwrap());
    let settings: Settings = arguments.get(4).map_or_else(Settings::default, |a| serde_json::from_str(a).unwrap());
    let dropped = dataset.training_views()[..drop].to_vec();
    dataset.frames.retain(|f| f.split == Split::Validation || !dropped.contains(&f.view));
    let config = Config::load(Some(Preset::Fast), None, &[]).unwrap();
    let half = dynamic_half(&config, &dataset);
    if noise > 0.0 {
        let strongest = SoftMotion::new(&dataset, half, 16).views[0].background.strongest;
        for (index, frame) in dataset.frames.iter_mut().enumerate().filter(|(_, f)| f.split == Split::Train) {
            for (pixel, value) in frame.integrals.iter_mut().enumerate() {
                let n = normal(7, STREAM_PHOTON, index as u32, pixel as u32);
                *value += strongest * (noise * n) as f32;
            }
        }
    }
    let gpu =
        Gpu::open(&DeviceOptions { select: None, validation: false, cache_dir: None, memory_limit: None }).unwrap();
    let start = Instant::now();
    let motion = SoftMotion::new(&dataset, half, 112);
    let hull_s = start.elapsed().as_secs_f64();
    let scene = Scene::new(&dataset, &motion, &settings).unwrap();
    let units = scene.units;
    println!(
        "hull {:.3} % of the box, strongest change {:.2e}, pixel {:.4}, hull {hull_s:.2} s",
        100.0 * motion.hull.share(),
        units.strongest,
        units.pixel
    );
    let until = settings.iterations;
    let as_tree = arguments.get(5).is_some_and(|a| a == "tree");
    let mut losses = Vec::new();
    let (model, count) = if as_tree {
        let mut trainer = TreeTrainer::new(&gpu, scene, settings, &TreeSettings::default()).unwrap();
        println!("tracked after {:.2} s", start.elapsed().as_secs_f64());
        while trainer.step() < until {
            losses.extend(trainer.advance(until).unwrap());
        }
        let tree = trainer.tree().unwrap();
        (tree.expand(), tree.rest.rows.len())
    } else {
        let mut trainer = GaussianTrainer::new(&gpu, scene, settings).unwrap();
        while trainer.step() < until {
            losses.extend(trainer.advance(until).unwrap());
        }
        let model = trainer.model().unwrap();
        let count = model.rows.len();
        (model, count)
    };
    let trained_s = start.elapsed().as_secs_f64();
    let (first, last) = (losses[0], losses[losses.len() - 1]);
    println!("trained after {trained_s:.2} s, {count} Gaussians, loss {first:.2} -> {last:.2}");
    let level = dataset.vessel_attenuation.unwrap() / 3.0;
    let mut dice = [0.0; 3];
    for frame in dataset.validation() {
        let view = SplatView::new(&dataset.views[frame.view].rays, model.units);
        let seen = maxima(&model, &view, dataset.width, dataset.height, frame.phase as usize);
        for (dice, factor) in dice.iter_mut().zip([1.0, 0.6, 1.6]) {
            let found: Vec<bool> = seen.iter().map(|v| *v >= factor * level).collect();
            *dice += metrics::dice(&found, frame.mask.as_ref().unwrap()) / dataset.validation().len() as f64;
        }
    }
    println!("dice {:.3} (at 0.6 and 1.6 of the level {:.3} {:.3})", dice[0], dice[1], dice[2]);
}
