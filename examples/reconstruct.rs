//! Reconstructs a dataset in memory, draws a view nobody has taken, and exports the vessels:
//!
//! ```sh
//! target/release/nertca-vk phantom out/phantom --size 64
//! cargo run --release --example reconstruct -- out/phantom out/example
//! ```

use nertca_vk::config::{Config, Preset};
use nertca_vk::error::{Error, Result};
use nertca_vk::export::volumes::{Compression, Format, VolumeExport, grid_over};
use nertca_vk::geometry::{CArm, Geometry};
use nertca_vk::gpu::device::{DeviceOptions, Gpu};
use nertca_vk::kernels::tuning::Tuning;
use nertca_vk::model::component::Component;
use nertca_vk::plan::Plan;
use nertca_vk::render::renderer::Renderer;
use nertca_vk::scan::dataset::Dataset;
use nertca_vk::train::trainer::Trainer;
use nertca_vk::train::training::Training;
use nertca_vk_vessels::score::eval::evaluate;
use nertca_vk_vessels::score::pictures::{Window, write_grey};
use std::path::PathBuf;

fn main() -> Result<()> {
    let mut paths = std::env::args().skip(1).map(PathBuf::from);
    let (Some(data), Some(out)) = (paths.next(), paths.next()) else {
        return Err(Error::config("arguments", "", "a dataset and a directory for the results are needed"));
    };
    let dataset = Dataset::open(&data)?;
    let gpu = Gpu::open(&DeviceOptions::default())?;
    let tuning = Tuning::for_device(gpu.info());

    // Train.
    let config = Config::preset(Preset::Fast);
    let plan = Plan::new(&config, &dataset)?;
    plan.notes.iter().for_each(|note| println!("{note}"));
    let mut training = Training::new(Trainer::new(&gpu, plan, &dataset, tuning.clone())?);
    while training.trainer().step() < config.train.iterations {
        for progress in training.advance(config.train.iterations)? {
            if progress.loss.step % 200 == 0 {
                println!("{} iterations, {:.1} dB", progress.loss.step, progress.smoothed_psnr_db);
            }
        }
    }
    let model = training.trainer_mut().model()?;

    // Draw the vessels from an angle of choice, and score the views kept for that.
    let renderer = Renderer::new(&gpu, &model, tuning)?;
    let c_arm = CArm { primary_deg: 20.0, secondary_deg: 25.0, ..model.c_arm.clone() };
    let [width, height] = model.image_size;
    let rays =
        Geometry::CArm(c_arm).rays(width, height).map_err(|(field, problem)| Error::config(field, "", problem))?;
    let view = renderer.render(&rays, width, height, 0)?;
    let window = Window::of(&view.dynamic_integral);
    write_grey(&out.join("vessels.png"), &view.dynamic_integral, width, window)?;
    score(&renderer, &dataset, model.step)?;

    // Export the beat for 3D Slicer.
    let export = VolumeExport {
        grid: grid_over(&model.scene, Component::Dynamic, 1.0)?,
        component: Component::Dynamic,
        phases: (0..dataset.n_phases).collect(),
        sequence: true,
        format: Format::Nrrd,
        compression: Compression::None,
    };
    let files = export.write(&renderer, &out.join("beat.seq.nrrd"), |_, _| {})?;
    files.iter().for_each(|file| println!("{}", file.display()));
    Ok(())
}

fn score(renderer: &Renderer, dataset: &Dataset, step: u32) -> Result<()> {
    let frames: Vec<_> = dataset.validation().iter().collect();
    if frames.is_empty() {
        return Ok(());
    }
    let evaluation = evaluate(renderer, dataset, &frames, step, None, |_| Ok(()))?;
    match evaluation.dice.dynamic {
        Some(dice) => println!("Dice {dice:.3} on {} unseen images", frames.len()),
        None => println!("PSNR {:.2} dB on {} unseen images", evaluation.psnr, frames.len()),
    }
    Ok(())
}
