//! Procedural phantoms against the attenuations and extents of the authors' volumes.

use crate::common::{expect_silence, gpu};
use nertca_vk::choice::Choice;
use nertca_vk::formats::volume::{Volume, VolumeHints};
use nertca_vk::formats::volume_files;
use nertca_vk::scan::dataset::{Dataset, Layout};
use nertca_vk_phantom::dataset::{PhantomOptions, Setting, make};
use nertca_vk_phantom::degradations::Degradations;
use nertca_vk_phantom::views::ViewAngles;
use std::num::NonZeroU32;

const SIZE: usize = 64;
/// Attenuation of lung, soft tissue and bone in the authors' XCAT volumes, 1/mm.
const TISSUES_PER_MM: [f32; 3] = [3e-5, 1e-4, 2.5e-4];

struct Made {
    dataset: Dataset,
    background: Volume,
    vessels: Volume,
}

#[test]
fn names_of_settings_are_those_in_files() {
    for &setting in Setting::ALL {
        assert_eq!(serde_json::to_value(setting).unwrap(), setting.name());
    }
}

fn made(setting: Setting) -> Made {
    let gpu = gpu();
    let directory = tempfile::tempdir().unwrap();
    let out = directory.path().join("phantom");
    let options = PhantomOptions {
        setting,
        size: SIZE,
        phases: 3,
        views: ViewAngles::published(4).unwrap(),
        seed: 1,
        stenoses: Vec::new(),
        degradations: Degradations::default(),
        layout: Layout::Native,
        anatomy: None,
        volumes_every: Some(NonZeroU32::MIN),
    };
    make(&gpu, &options, &out, |_, _, _| ()).unwrap();
    expect_silence(gpu);
    let volume = |name: &str| volume_files::read(&out.join("volumes").join(name), &VolumeHints::default()).unwrap();
    Made {
        dataset: Dataset::open(&out).unwrap(),
        background: volume("background-00.nrrd"),
        vessels: volume("vessels-00.nrrd"),
    }
}

/// Mean line integral of all pixels without a vessel.
fn mean_background(dataset: &Dataset) -> f64 {
    let pixels = dataset.frames.iter().flat_map(|frame| frame.integrals.iter().zip(frame.mask.as_ref().unwrap()));
    let values: Vec<f64> = pixels.filter(|(_, vessel)| !**vessel).map(|(value, _)| f64::from(*value)).collect();
    values.iter().sum::<f64>() / values.len() as f64
}

/// Share of an image's vessel pixels that lie at its edge.
fn share_at_the_edge(mask: &[bool]) -> f64 {
    let at_edge = |pixel: usize| [pixel % SIZE, pixel / SIZE].iter().any(|at| *at == 0 || *at == SIZE - 1);
    let vessel: Vec<usize> = (0..SIZE * SIZE).filter(|pixel| mask[*pixel]).collect();
    vessel.iter().filter(|pixel| at_edge(**pixel)).count() as f64 / vessel.len() as f64
}

#[test]
fn xcat_has_the_attenuations_and_extents_of_the_authors_volume() {
    let Made { dataset, background, vessels } = made(Setting::Xcat);
    assert_eq!(background.size, [128, 128, 100], "128 x 128 x 100 mm with voxels of 1 mm");
    let share_of = |tissue: f32| {
        let near = background.values.iter().filter(|value| (**value / tissue - 1.0).abs() < 0.01).count();
        near as f64 / background.values.len() as f64
    };
    let [lung, soft, bone] = TISSUES_PER_MM.map(share_of);
    println!("lung {lung:.3}, soft tissue {soft:.3}, bone {bone:.3}");
    assert!(lung > 0.2 && soft > 0.3 && bone > 0.01, "shares of the volume: {lung}, {soft}, {bone}");
    let densest = vessels.values.iter().fold(0f32, |max, value| max.max(*value));
    assert!((densest / 1.5e-3 - 1.0).abs() < 0.1, "0.15 per 100 mm where filled: {densest}");
    // Soft tissue over the full 128 mm would have .0128; lungs take away a third of it.
    let mean = mean_background(&dataset);
    assert!((0.0080..0.0090).contains(&mean), "mean line integral beside the vessels: {mean}");
    let cut = dataset.frames.iter().map(|frame| share_at_the_edge(frame.mask.as_ref().unwrap())).fold(0.0, f64::max);
    assert!(cut < 0.04, "only tips of the tree leave the image: {cut}");
}

#[test]
fn the_small_body_attenuates_less() {
    let mean = mean_background(&made(Setting::SmallXcat).dataset);
    assert!((0.0073..0.0080).contains(&mean), "mean line integral beside the vessels: {mean}");
}
