//! The four real angiography runs of a static coronary phantom, if present (`NERTCA_DATA`, or `../shared/data` beside the
//! project): imported, reconstructed, and compared with the reconstruction.

use crate::shared::shared;
use nertca_vk::config::{Config, Preset};
use nertca_vk::gpu::device::{DeviceOptions, Gpu};
use nertca_vk::kernels::tuning::Tuning;
use nertca_vk::plan::Plan;
use nertca_vk::render::renderer::Renderer;
use nertca_vk::scan::dataset::Dataset;
use nertca_vk::scan::gating::BeatScaling;
use nertca_vk::train::trainer::Trainer;
use nertca_vk_import::angiograms::{Gating, ImportOptions};
use nertca_vk_import::intake::import_dicom;
use nertca_vk_vessels::vessels::threshold::vessel_threshold;
use std::path::PathBuf;

fn runs() -> Option<Vec<PathBuf>> {
    let folder = shared("xa")?;
    Some((1..=4).map(|i| folder.join(format!("IM{i}.dcm"))).collect())
}

fn options() -> ImportOptions {
    ImportOptions {
        phases: 1,
        gating: Gating::Still,
        scaling: BeatScaling::Linear,
        frames: None,
        pixel_mm: None,
        size: Some(256),
        all_beats: false,
        depth_half_extent_mm: 100.0,
        keep_references: false,
    }
}

#[test]
fn runs_become_a_dataset_without_a_patient() {
    let Some(files) = runs() else { return };
    let dir = tempfile::tempdir().unwrap();
    let notes = import_dicom(&files, &options(), dir.path()).unwrap().join("\n");
    assert!(notes.contains("0.390625 mm from FieldOfViewDimensions") && notes.contains("DISP"), "{notes}");
    let dataset = Dataset::open(dir.path()).unwrap();
    assert_eq!((dataset.views.len(), dataset.n_phases, dataset.width), (4, 2, 249));
    let angles: Vec<_> = dataset.views.iter().map(|v| v.geometry.angles_deg().unwrap()).collect();
    assert_eq!(angles, [(31.3, 0.1), (-27.3, -0.1), (-0.8, -23.2), (0.1, 28.7)]);
    // The phantom's "patient" is called PHANTOM; this name must not appear in any file.
    for entry in std::fs::read_dir(dir.path().join("images")).unwrap().chain(std::fs::read_dir(dir.path()).unwrap()) {
        let path = entry.unwrap().path();
        if path.is_file() {
            let bytes = std::fs::read(&path).unwrap();
            assert!(!bytes.windows(7).any(|w| w == b"PHANTOM"), "{}", path.display());
        }
    }
}

/// Zhang and Suen's thinning: the pixels of a mask's centreline.
fn centreline(mask: &[bool], width: usize) -> Vec<(f64, f64)> {
    let (mut m, height) = (mask.to_vec(), mask.len() / width);
    loop {
        let mut changed = false;
        for pass in 0..2 {
            let mut gone = Vec::new();
            for y in 1..height - 1 {
                for x in 1..width - 1 {
                    let at = |dx: isize, dy: isize| m[(y as isize + dy) as usize * width + (x as isize + dx) as usize];
                    let ring = [at(0, -1), at(1, -1), at(1, 0), at(1, 1), at(0, 1), at(-1, 1), at(-1, 0), at(-1, -1)];
                    let n = ring.iter().filter(|v| **v).count();
                    let turns = (0..8).filter(|i| !ring[*i] && ring[(i + 1) % 8]).count();
                    let [north, _, east, _, south, _, west, _] = ring;
                    let open = if pass == 0 {
                        !(east && south && (north || west))
                    } else {
                        !(north && west && (east || south))
                    };
                    if at(0, 0) && (2..=6).contains(&n) && turns == 1 && open {
                        gone.push(y * width + x);
                    }
                }
            }
            changed |= !gone.is_empty();
            gone.into_iter().for_each(|p| m[p] = false);
        }
        if !changed {
            break;
        }
    }
    (0..m.len()).filter(|p| m[*p]).map(|p| ((p % width) as f64, (p / width) as f64)).collect()
}

/// Median distance from each point to the nearest of others.
fn median_distance(from: &[(f64, f64)], to: &[(f64, f64)]) -> f64 {
    let mut distances: Vec<f64> =
        from.iter().map(|a| to.iter().map(|b| (a.0 - b.0).hypot(a.1 - b.1)).fold(f64::MAX, f64::min)).collect();
    distances.sort_by(f64::total_cmp);
    distances[distances.len() / 2]
}

#[test]
fn the_reconstruction_lies_on_the_vessels_it_was_made_from() {
    let Some(files) = runs() else { return };
    let dir = tempfile::tempdir().unwrap();
    import_dicom(&files, &options(), dir.path()).unwrap();
    let dataset = Dataset::open(dir.path()).unwrap();
    let gpu = Gpu::open(&DeviceOptions::default()).unwrap();
    let tuning = Tuning::for_device(gpu.info());
    let config = Config::load(Some(Preset::Fast), None, &["train.iterations=400".into()]).unwrap();
    let mut trainer = Trainer::new(&gpu, Plan::new(&config, &dataset).unwrap(), &dataset, tuning.clone()).unwrap();
    // Only the Gaussians are looked at.
    let end = config.gaussian_iterations();
    while trainer.step() < end {
        trainer.advance(end).unwrap();
    }
    let model = trainer.model().unwrap();
    let renderer = Renderer::new(&gpu, &model, tuning).unwrap();
    for view in 0..4 {
        let of = |phase| dataset.frames.iter().find(|f| f.view == view && f.phase == phase).unwrap();
        let real: Vec<f32> =
            of(0).integrals.iter().zip(&of(1).integrals).map(|(with, without)| with - without).collect();
        let seen =
            renderer.render(&dataset.views[view].rays, dataset.width, dataset.height, 0).unwrap().dynamic_integral;
        let line = |values: &[f32]| {
            let positive: Vec<f32> = values.iter().copied().filter(|v| *v > 0.0).collect();
            let limit = vessel_threshold(&positive);
            centreline(&values.iter().map(|v| *v > limit).collect::<Vec<_>>(), dataset.width)
        };
        let (real, seen) = (line(&real), line(&seen));
        assert!(real.len() > 150 && seen.len() > 150, "view {view}: {} and {} points", real.len(), seen.len());
        // Distances are in pixels of the detector; the images average two by two.
        let (there, back) = (2.0 * median_distance(&seen, &real), 2.0 * median_distance(&real, &seen));
        println!("view {view}: reconstruction to vessels {there:.2} px, vessels to reconstruction {back:.2} px");
        assert!(there <= 2.0 && back <= 2.0, "view {view}: {there} and {back} pixels");
    }
}
