//! Images of different sizes in one dataset: a cropped view keeps its geometry, and the removed part is not used.

use crate::common::{expect_silence, gpu, phantom, run, tuning};
use nertca_vk::check::check;
use nertca_vk::config::{Config, Preset};
use nertca_vk::gpu::device::Gpu;
use nertca_vk::model::Model;
use nertca_vk::plan::Plan;
use nertca_vk::render::renderer::Renderer;
use nertca_vk::scan::dataset::{Dataset, Frame, Layout, Split};
use nertca_vk::scan::writer::convert;
use nertca_vk::train::trainer::Trainer;
use nertca_vk_vessels::score::eval::{Evaluation, evaluate};
use serde_json::{Value, json};
use std::path::Path;
use std::sync::OnceLock;

const SIZE: usize = 100;

/// Part of a view's images that is kept: first column and row, columns and rows.
#[derive(Clone, Copy)]
struct Window {
    view: usize,
    first: [usize; 2],
    size: [usize; 2],
}

/// A training view and an unseen one.
const CROPPED: [Window; 2] =
    [Window { view: 1, first: [12, 9], size: [80, 86] }, Window { view: 5, first: [20, 5], size: [61, 73] }];

/// The default phantom with whole images, made once.
fn whole() -> &'static Dataset {
    static DATASET: OnceLock<(tempfile::TempDir, Dataset)> = OnceLock::new();
    let (_, dataset) = DATASET.get_or_init(|| {
        let (gpu, directory) = (gpu(), tempfile::tempdir().unwrap());
        let dataset = phantom(&gpu, &directory.path().join("whole"), SIZE, 4);
        expect_silence(gpu);
        (directory, dataset)
    });
    dataset
}

/// Crops a numpy file of 32-bit floats, rows first, without any reader of the library.
fn crop_npy(file: &Path, w: &Window) {
    let bytes = std::fs::read(file).unwrap();
    let header = 10 + usize::from(u16::from_le_bytes([bytes[8], bytes[9]]));
    let values = &bytes[header..];
    assert!(bytes[..header].windows(3).any(|at| at == b"<f4") && values.len() == 4 * SIZE * SIZE);
    let mut said =
        format!("{{'descr': '<f4', 'fortran_order': False, 'shape': ({}, {}), }}", w.size[1], w.size[0]).into_bytes();
    said.resize(118 - 1, b' ');
    said.push(b'\n');
    let mut out = [b"\x93NUMPY\x01\x00".as_slice(), &118u16.to_le_bytes(), &said].concat();
    for row in w.first[1]..w.first[1] + w.size[1] {
        let start = 4 * (row * SIZE + w.first[0]);
        out.extend_from_slice(&values[start..start + 4 * w.size[0]]);
    }
    std::fs::write(file, out).unwrap();
}

fn crop_png(file: &Path, w: &Window) {
    let [x, y, width, height] = [w.first[0], w.first[1], w.size[0], w.size[1]].map(|n| n as u32);
    image::open(file).unwrap().crop_imm(x, y, width, height).save(file).unwrap();
}

/// Returns a copy of the dataset with some views cropped, and the geometry of their detectors adapted.
fn cropped(full: &Dataset, to: &Path, windows: &[Window]) -> Dataset {
    for folder in ["images", "masks"] {
        std::fs::create_dir_all(to.join(folder)).unwrap();
    }
    let mut manifest: Value = serde_json::from_slice(&std::fs::read(full.path.join("dataset.json")).unwrap()).unwrap();
    for frame in manifest["frames"].as_array_mut().unwrap() {
        let files = ["image", "mask"].map(|key| frame[key].as_str().unwrap().to_owned());
        for file in &files {
            std::fs::copy(full.path.join(file), to.join(file)).unwrap();
        }
        let Some(w) = windows.iter().find(|w| files[0].contains(&format!("view{}-", w.view))) else { continue };
        crop_npy(&to.join(&files[0]), w);
        crop_png(&to.join(&files[1]), w);
        for axis in 0..2 {
            // Distance on the detector between the centres of the kept part and of the whole image.
            let moved = w.first[axis] as f64 + 0.5 * w.size[axis] as f64 - 0.5 * SIZE as f64;
            let pixel_mm = frame["geometry"]["pixel_mm"][axis].as_f64().unwrap();
            let offset_mm = frame["geometry"]["offset_mm"][axis].as_f64().unwrap();
            frame["geometry"]["offset_mm"][axis] = json!(offset_mm + moved * pixel_mm);
        }
    }
    std::fs::write(to.join("dataset.json"), manifest.to_string()).unwrap();
    Dataset::open(to).unwrap()
}

/// Index of the view with the phantom's number `number`.
fn view(dataset: &Dataset, number: usize) -> usize {
    dataset.frames.iter().find(|f| f.name.contains(&format!("view{number}-"))).unwrap().view
}

/// Trains with default settings up to an iteration.
fn trained(gpu: &Gpu, dataset: &Dataset, until: u32) -> Model {
    let plan = Plan::new(&Config::preset(Preset::Fast), dataset).unwrap();
    let mut trainer = Trainer::new(gpu, plan, dataset, tuning(gpu)).unwrap();
    run(&mut trainer, until);
    trainer.model().unwrap()
}

/// Unseen images of every fifth phase, which tell as much as all.
fn unseen(dataset: &Dataset) -> Vec<&Frame> {
    dataset.validation().iter().filter(|frame| frame.phase % 5 == 0).collect()
}

fn scored(gpu: &Gpu, model: &Model, dataset: &Dataset) -> Evaluation {
    let renderer = Renderer::new(gpu, model, tuning(gpu)).unwrap();
    let frames = unseen(dataset);
    evaluate(&renderer, dataset, &frames, model.step, None, |_| Ok(())).unwrap()
}

#[test]
fn a_cropped_view_has_the_rays_and_pixels_it_had() {
    let (gpu, directory) = (gpu(), tempfile::tempdir().unwrap());
    let full = whole();
    let cut = cropped(full, &directory.path().join("cut"), &CROPPED);
    assert_eq!((cut.canvas(), cut.views.len()), ([SIZE; 2], full.views.len()));
    for w in &CROPPED {
        let (a, b) = (&full.views[view(full, w.view)], view(&cut, w.view));
        assert_eq!(cut.views[b].size, w.size);
        for [i, j] in [[0.0, 0.0], [30.5, 7.25], [60.0, 72.0]] {
            let (was, is) = (a.rays.pixel(i + w.first[0] as f64, j + w.first[1] as f64), cut.views[b].rays.pixel(i, j));
            assert!(was.0.distance(is.0) < 1e-12 && was.1.distance(is.1) < 1e-12, "view {}, pixel {i}, {j}", w.view);
        }
        let beyond = |p: usize| p % SIZE >= w.size[0] || p / SIZE >= w.size[1];
        assert!((0..SIZE * SIZE).all(|p| cut.shows(b, p) != beyond(p)), "view {}", w.view);
    }
    for (was, is) in full.frames.iter().zip(&cut.frames) {
        let own = cut.own_frame(is);
        let w = CROPPED.iter().find(|w| is.name.contains(&format!("view{}-", w.view)));
        let w = w.copied().unwrap_or(Window { view: 0, first: [0; 2], size: [SIZE; 2] });
        let from = |p: usize| (w.first[1] + p / w.size[0]) * SIZE + w.first[0] + p % w.size[0];
        assert_eq!(own.integrals.len(), w.size[0] * w.size[1]);
        assert!((0..own.integrals.len()).all(|p| own.integrals[p] == was.integrals[from(p)]), "{}", is.name);
        let (mask, before) = (own.mask.as_ref().unwrap(), was.mask.as_ref().unwrap());
        assert!((0..mask.len()).all(|p| mask[p] == before[from(p)]), "{}", is.name);
        let beyond = is.mask.as_ref().unwrap().iter().filter(|m| **m).count() - mask.iter().filter(|m| **m).count();
        assert_eq!(beyond, 0, "nothing of a mask is beyond its image");
    }
    // The cropped dataset passes the check, and is written unchanged.
    assert!(check(&cut).unwrap().sound());
    let again = directory.path().join("again");
    convert(&cut, Layout::Native, &again).unwrap();
    let again = Dataset::open(&again).unwrap();
    assert_eq!(
        again.views.iter().map(|v| v.size).collect::<Vec<_>>(),
        cut.views.iter().map(|v| v.size).collect::<Vec<_>>()
    );
    assert!(again.frames.iter().zip(&cut.frames).all(|(a, b)| a.integrals == b.integrals && a.mask == b.mask));
    let refused = convert(&cut, Layout::Nerfca, &directory.path().join("theirs")).unwrap_err().to_string();
    assert!(refused.contains("one size for all images"), "{refused}");
    assert!(!directory.path().join("theirs").exists(), "nothing is written of what cannot be");
    expect_silence(gpu);
}

/// One mistake tried by `check` turns images on their side, which changes the canvas.
#[test]
#[ignore = "long: tools/test --all"]
fn unseen_images_of_another_shape_change_no_check() {
    let (gpu, directory) = (gpu(), tempfile::tempdir().unwrap());
    let full = whole();
    let window = |view| match view {
        0..4 => Window { view, first: [5, 0], size: [90, SIZE] },
        _ => Window { view, first: [0, 5], size: [SIZE, 90] },
    };
    let windows: Vec<Window> = (0..full.views.len()).map(window).collect();
    let cut = cropped(full, &directory.path().join("cut"), &windows);
    let training = cut.training_views();
    assert!((0..cut.views.len()).all(|view| (cut.views[view].size == [90, SIZE]) == training.contains(&view)));
    assert_eq!(cut.canvas(), [SIZE; 2]);
    assert!(check(&cut).unwrap().sound());
    expect_silence(gpu);
}

#[test]
#[ignore = "long: tools/test --all"]
fn a_reconstruction_of_cropped_views_is_as_good_and_scored_on_what_they_show() {
    let (gpu, directory) = (gpu(), tempfile::tempdir().unwrap());
    let full = whole();
    let cut = cropped(full, &directory.path().join("cut"), &CROPPED);
    let config = Config::preset(Preset::Fast);
    // Of the second model only the Gaussians are scored.
    let of_full = trained(&gpu, full, config.train.iterations);
    let of_cut = trained(&gpu, &cut, config.gaussian_iterations());
    // With one model, uncropped images have equal scores, and cropped ones the scores computed by hand.
    let (a, b) = (scored(&gpu, &of_full, full), scored(&gpu, &of_full, &cut));
    let renderer = Renderer::new(&gpu, &of_full, tuning(&gpu)).unwrap();
    let window = &CROPPED[1];
    for ((frame, a), b) in unseen(full).into_iter().zip(&a.images).zip(&b.images) {
        if frame.view != view(full, window.view) {
            assert_eq!((a.dice_dynamic, a.psnr, a.ssim), (b.dice_dynamic, b.psnr, b.ssim), "{}", a.name);
            continue;
        }
        let seen = renderer.render_taken(&full.heart_rays(frame), SIZE, SIZE, frame.beat_time()).unwrap();
        let rows = window.first[1]..window.first[1] + window.size[1];
        let kept: Vec<usize> =
            rows.flat_map(|y| (0..window.size[0]).map(move |x| y * SIZE + window.first[0] + x)).collect();
        let total = seen.total_integral();
        let [low, high] =
            kept.iter().map(|p| frame.integrals[*p]).fold([f32::MAX, f32::MIN], |[l, h], v| [l.min(v), h.max(v)]);
        let squared = |p: &usize| f64::from((total[*p] - frame.integrals[*p]) / (high - low)).powi(2);
        let psnr = -10.0 * (kept.iter().map(squared).sum::<f64>() / kept.len() as f64).log10();
        let mask = frame.mask.as_ref().unwrap();
        let threshold = 0.2 * full.vessel_attenuation.unwrap();
        let found = |p: &usize| f64::from(seen.dynamic_max[*p]) > threshold;
        let both = kept.iter().filter(|p| mask[**p] && found(p)).count();
        let either = kept.iter().filter(|p| mask[**p]).count() + kept.iter().filter(|p| found(p)).count();
        let dice = 2.0 * both as f64 / either as f64;
        println!(
            "{}: PSNR {:.4} by hand {psnr:.4}, Dice {:.5} by hand {dice:.5}",
            b.name,
            b.psnr,
            b.dice_dynamic.unwrap()
        );
        // Rays of a cropped view are equal in f64, and to some digits in the f32 used for rendering.
        assert!((b.psnr - psnr).abs() < 0.02 && (b.dice_dynamic.unwrap() - dice).abs() < 0.005, "{}", b.name);
        assert!((b.psnr - a.psnr).abs() > 0.05, "what was cut away would have counted");
    }
    let (all, less) = (a.dice.dynamic.unwrap(), scored(&gpu, &of_cut, full).dice.dynamic.unwrap());
    println!("Dice {all:.4} of whole images, {less:.4} of cropped ones");
    assert!(less > all - 0.02, "{less} of cropped views, {all} of whole ones");
    assert_eq!(of_cut.image_size, [SIZE; 2]);
    assert!(cut.training().iter().any(|f| f.split == Split::Train && f.view == view(&cut, 1)));
    drop(renderer);
    expect_silence(gpu);
}

/// Side of images that are fitted from coarse to fine, and that two does not divide.
const LARGE: usize = 261;

#[test]
#[ignore = "long: tools/test --all"]
fn large_images_are_fitted_from_coarse_to_fine() {
    let (gpu, directory) = (gpu(), tempfile::tempdir().unwrap());
    let dataset = phantom(&gpu, &directory.path().join("large"), LARGE, 4);
    let config = Config::preset(Preset::Fast);
    let plan = Plan::new(&config, &dataset).unwrap();
    let mut trainer = Trainer::new(&gpu, plan, &dataset, tuning(&gpu)).unwrap();
    let pixel_of = |trainer: &Trainer| trainer.outline().gaussians.unwrap().rows().units.pixel;
    run(&mut trainer, 70);
    let coarse = pixel_of(&trainer);
    run(&mut trainer, config.gaussian_iterations());
    let fine = pixel_of(&trainer);
    assert!((coarse / fine - 2.0).abs() < 1e-6, "{coarse} and {fine}");
    let frames = unseen(&dataset);
    let renderer = Renderer::new(&gpu, &trainer.model().unwrap(), tuning(&gpu)).unwrap();
    let dice = evaluate(&renderer, &dataset, &frames, 0, None, |_| Ok(())).unwrap().dice.dynamic.unwrap();
    println!("Dice {dice:.4}");
    assert!(dice > 0.92, "{dice}");
}
