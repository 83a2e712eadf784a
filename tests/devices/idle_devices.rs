//! A device that completes its submits but reports no iterations: every trainer detects this at once.

use crate::common::{small_dataset, tuning};
use crate::faults::{code, no_stores};
use crate::shim;
use nertca_vk::config::{Config, Preset};
use nertca_vk::error::Error;
use nertca_vk::gpu::device::{DeviceOptions, Gpu};
use nertca_vk::plan::Plan;
use nertca_vk::train::trainer::Trainer;
use nertca_vk_twins::selftest::problems;
use nertca_vk_twins::selftest::r2_gaussian as r2;
use nertca_vk_twins::selftest::sax_nerf as sax;
use nertca_vk_twins::selftest::x_gaussian;

fn open() -> Gpu {
    Gpu::open(&DeviceOptions { loader: Some(shim::loader()), ..DeviceOptions::default() }).unwrap()
}

/// Trains three iterations on a device whose `stage`, if one is named, stores nothing.
fn train(config: &Config, silent_stage: Option<&str>) -> Result<u32, Error> {
    shim::begin(shim::Failing::None);
    let (gpu, dataset) = (open(), small_dataset(32, 27));
    if let Some(stage) = silent_stage {
        let words = code(&gpu, stage, None);
        let mut silent = words.clone();
        no_stores(&mut silent);
        assert!(words != silent, "{stage} stores nothing");
        shim::plant(words, silent);
    }
    let mut trainer = Trainer::new(&gpu, Plan::new(config, &dataset)?, &dataset, tuning(&gpu))?;
    while trainer.step() < 3 {
        trainer.advance(3)?;
    }
    Ok(trainer.step())
}

#[test]
fn every_trainer_says_that_it_is_told_nothing() {
    let gaussians = |form: &str| {
        let settings = [format!("gaussians.form={form}"), "gaussians.iterations=8".into(), "gaussians.count=40".into()];
        Config::preset(Preset::Fast).with(&settings).unwrap()
    };
    for (stage, config) in [
        ("report", problems::small_config(Preset::FastMlp, &[]).unwrap()),
        ("report", problems::small_config(Preset::NerfCa, &[]).unwrap()),
        ("gaussian_report", gaussians("phase")),
        ("gaussian_report", gaussians("tree")),
        ("gaussian_report", r2::small_config(&[]).unwrap().into_any()),
        ("sax_report", sax::small_config(&[]).unwrap().into_any()),
        ("x_report", x_gaussian::small_config(&[]).unwrap().into_any()),
    ] {
        assert_eq!(train(&config, None).map_err(|e| e.to_string()), Ok(3), "{stage} as it is");
        match train(&config, Some(stage)) {
            Err(Error::NoDevice(why)) => assert!(why.contains("nertca-vk selftest"), "{stage}: {why}"),
            other => panic!("{stage}: {other:?}"),
        }
    }
}
