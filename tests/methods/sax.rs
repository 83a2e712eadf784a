//! SAX-NeRF (the preset `sax-nerf`): stages equal their twins, and the twins agree with PyTorch and finite differences; the
//! hash and the attention are correct; runs fit, repeat and resume with equal bits; each phase uses its own images only.

use crate::common::{
    expect_agreement, expect_silence, gpu, relative_error, run, small_dataset, tuning, uneven_dataset,
};
use crate::golden_file::Golden;
use nertca_vk::checkpoint::Checkpoint;
use nertca_vk::config::sections::SaxSettings;
use nertca_vk::config::{Config, Preset};
use nertca_vk::error::Error;
use nertca_vk::fitting::sets::seed_of_set;
use nertca_vk::gpu::device::Gpu;
use nertca_vk::kernels::layout::SaxLevel;
use nertca_vk::methods::sax_nerf::data::SaxData;
use nertca_vk::methods::sax_nerf::field::{SaxField, SaxShape, SaxState};
use nertca_vk::methods::sax_nerf::setup::{fit_setup, outline};
use nertca_vk::methods::sax_nerf::trainer::SaxTrainer;
use nertca_vk::model::Model;
use nertca_vk::model::component::Component;
use nertca_vk::plan::Plan;
use nertca_vk::render::baked::Baked;
use nertca_vk::render::grid::Grid;
use nertca_vk::render::quantity::{Projection, Quantity};
use nertca_vk::render::renderer::Renderer;
use nertca_vk::scan::dataset::Dataset;
use nertca_vk::train::trainer::Trainer;
use nertca_vk_twins::reference::sax_nerf::{self as reference, Lineformer, SampledRay, entry, objective};
use nertca_vk_twins::selftest::sax_nerf::{compare, f64s, hard_case, small_config};
use std::collections::HashSet;
use std::sync::Arc;

fn config(settings: &[&str]) -> Config<SaxSettings> {
    small_config(settings).unwrap()
}

#[test]
fn every_stage_of_an_iteration_matches() {
    let gpu = gpu();
    expect_agreement(|findings| compare(&gpu, findings));
    expect_silence(gpu);
}

/// Parameters of a field by the script's formula, which has the parts in the same order.
fn formula(shape: SaxShape) -> Vec<f64> {
    let mut params = vec![0.0; shape.n_params()];
    for (index, part) in shape.parts().iter().enumerate() {
        for i in 0..part.len() {
            let value = (12.9898 * i as f64 + 78.233 * index as f64).sin() * 43758.5453;
            let spread = 2.0 * (value - value.floor()) - 1.0;
            params[part.first + i] = match part.name {
                "norm1.weight" | "norm2.weight" => 1.0 + 0.3 * spread,
                "norm1.bias" | "norm2.bias" => 0.3 * spread,
                "grid" | "attention.position" => 0.5 * spread,
                name if name.ends_with("bias") => 0.5 * spread,
                _ => spread / (part.shape[part.shape.len() - 1] as f64).sqrt(),
            };
        }
    }
    params
}

#[test]
fn golden_values_of_pytorch() {
    let golden = Golden::open("sax", "tools/reference_sax.py");
    let case = |key: &str| golden.case[key].as_u64().unwrap() as usize;
    let shape =
        SaxShape { levels: case("levels") as u32, base: case("base") as u32, log2_table: case("log2_table") as u32 };
    let mut params = formula(shape);
    let (points, paths, targets) = (golden.get("points"), golden.get("paths"), golden.get("targets"));
    let n = case("samples");
    let rays: Vec<SampledRay> = (0..case("rays"))
        .map(|r| SampledRay {
            points: (r * n..(r + 1) * n).map(|s| ([0, 1, 2].map(|k| points[3 * s + k] as f32), paths[s])).collect(),
            target: targets[r],
        })
        .collect();
    let levels = shape.grid();
    let features: Vec<Vec<f64>> = rays
        .iter()
        .flat_map(|ray| &ray.points)
        .map(|(unit, _)| reference::encode(&levels, &params[shape.n_weights()..], *unit))
        .collect();
    let lineformer = Lineformer::new(shape, &params);
    let sigma: Vec<f32> = features
        .chunks(2)
        .flat_map(|pair| lineformer.fwd([&pair[0], &pair[1]]).sigma())
        .map(|sigma| sigma as f32)
        .collect();
    let (error, at) = relative_error(&sigma, &golden.get("sigma"));
    assert!(error < 1e-6, "density {at}: {error:e}");
    let kept = |values: &[f64], len: usize| -> Vec<f32> {
        let stride = if len > case("few") { case("stride") } else { 1 };
        values.iter().step_by(stride).map(|v| *v as f32).collect()
    };
    let (loss, gradient) = objective(shape, &params, &rays);
    assert!((loss / golden.get("loss")[0] - 1.0).abs() < 1e-9, "{loss}");
    for part in shape.parts() {
        let got = kept(&gradient[part.first..][..part.len()], part.len());
        let (error, at) = relative_error(&got, &golden.get(&format!("gradient/{}", part.name)));
        assert!(error < 1e-6, "gradient of {}[{at}]: {error:e}", part.name);
    }
    let (mut first, mut second) = (vec![0.0; params.len()], vec![0.0; params.len()]);
    for step in 1..=case("updates") as i32 {
        let (_, gradient) = objective(shape, &params, &rays);
        for (i, g) in gradient.iter().enumerate() {
            first[i] = 0.9 * first[i] + 0.1 * g;
            second[i] = 0.999 * second[i] + 0.001 * g * g;
            let corrected = [first[i] / (1.0 - 0.9f64.powi(step)), second[i] / (1.0 - 0.999f64.powi(step))];
            params[i] -= golden.case["rate"].as_f64().unwrap() * corrected[0] / (corrected[1].sqrt() + 1e-8);
        }
    }
    for part in shape.parts() {
        let got = kept(&params[part.first..][..part.len()], part.len());
        let (error, at) = relative_error(&got, &golden.get(&format!("final/{}", part.name)));
        assert!(error < 1e-6, "{}[{at}] after all updates: {error:e}", part.name);
    }
}

#[test]
fn twin_gradient_is_the_derivative_of_the_twin_loss() {
    let shape = SaxShape { levels: 4, base: 3, log2_table: 6 };
    let params = formula(shape);
    let wave = |k: f64, i: usize| 0.5 + 0.49 * (k * (i as f64 + 0.3)).sin();
    let ray = |r: usize| SampledRay {
        points: (6 * r..6 * r + 6)
            .map(|i| ([0.9, 1.7, 2.3].map(|k| wave(k, i) as f32), 0.1 + 0.1 * wave(3.1, i)))
            .collect(),
        target: 0.3 + 0.2 * r as f64,
    };
    let rays: Vec<SampledRay> = (0..4).map(ray).collect();
    let (_, gradient) = objective(shape, &params, &rays);
    for part in shape.parts() {
        let largest = gradient[part.first..][..part.len()].iter().fold(0f64, |m, g| m.max(g.abs()));
        assert!(largest > 0.0, "{}", part.name);
        for i in (0..part.len()).step_by(part.len() / 6 + 1) {
            let at = part.first + i;
            let loss = |h: f64| {
                let mut moved = params.clone();
                moved[at] += h;
                objective(shape, &moved, &rays).0
            };
            let difference = (loss(1e-6) - loss(-1e-6)) / 2e-6;
            let error = (difference - gradient[at]).abs();
            assert!(
                error < 1e-4 * gradient[at].abs() + 1e-6 * largest,
                "{}[{i}]: {difference} {}",
                part.name,
                gradient[at]
            );
        }
    }
}

#[test]
fn samples_that_are_alike_share_what_they_see_evenly() {
    let shape = SaxShape { levels: 4, base: 3, log2_table: 6 };
    let mut params = formula(shape);
    let range = |name: &str| {
        let parts = shape.parts();
        let part = parts.iter().find(|part| part.name == name).unwrap();
        part.first..part.first + part.len()
    };
    params[range("attention.position")].fill(0.0);
    let features: Vec<f64> = (0..8).map(|i| 0.1 * f64::from(i)).collect();
    let other: Vec<f64> = features.iter().map(|x| 0.4 - x).collect();
    // If all keys are equal, each sample receives the mean of both values.
    let mut same_keys = params.clone();
    let keys = range("attention.key_value");
    same_keys[keys.start..keys.start + 32 * 32].fill(0.0);
    let trace = Lineformer::new(shape, &same_keys).fwd([&features, &other]);
    let mean: Vec<f64> = trace.values()[0].iter().zip(trace.values()[1]).map(|(a, b)| 0.5 * (a + b)).collect();
    for seen in trace.seen() {
        assert!(seen.iter().zip(&mean).all(|(seen, mean)| (seen - mean).abs() < 1e-12), "{seen:?} {mean:?}");
    }
    assert!(trace.values()[0] != trace.values()[1]);
    // With different keys the samples differ.
    let trace = Lineformer::new(shape, &params).fwd([&features, &other]);
    let off: f64 = trace.seen()[0].iter().zip(trace.seen()[1]).map(|(a, b)| (a - b).abs()).sum();
    assert!(off > 1e-3, "{off}");
}

/// Index of an entry by the published hash in 32-bit words.
fn entry_in_words(level: &SaxLevel, corner: [u32; 3]) -> usize {
    let side = level.cells + 1;
    let index = match level.dense {
        0 => corner[0] ^ corner[1].wrapping_mul(19_349_663) ^ corner[2].wrapping_mul(83_492_791),
        _ => corner[0] + side * (corner[1] + side * corner[2]),
    };
    (level.first + index % level.entries) as usize
}

#[test]
fn the_hash_finds_the_entries_of_all_published_levels() {
    let shape = SaxShape { levels: 16, base: 16, log2_table: 19 };
    let (mut wrapped, mut first) = (0, 0);
    for level in shape.grid() {
        assert_eq!(level.first, first);
        first += level.entries;
        let mut entries = HashSet::new();
        for i in 0..2000u32 {
            let corner = [9973u32, 7919, 104_729].map(|k| i.wrapping_mul(k) % (level.cells + 1));
            assert_eq!(entry(&level, corner), entry_in_words(&level, corner), "{level:?} {corner:?}");
            assert!((level.first..first).contains(&(entry(&level, corner) as u32)));
            wrapped += u32::from(u64::from(corner[2]) * 83_492_791 > u64::from(u32::MAX));
            entries.insert(entry(&level, corner));
        }
        // Corners are spread over the table.
        let corners = (u64::from(level.cells) + 1).min(2000) as usize;
        assert!(2 * entries.len() > corners.min(level.entries as usize), "{level:?}: {} entries", entries.len());
    }
    assert!(wrapped > 1000, "{wrapped}");
    assert_eq!(2 * first, 14_262_438);
}

#[test]
fn dense_levels_have_an_entry_for_each_corner() {
    let levels = SaxShape { levels: 3, base: 2, log2_table: 8 }.grid();
    for level in levels.iter().filter(|level| level.dense == 1) {
        let side = level.cells + 1;
        let corners = (0..side.pow(3)).map(|i| entry(level, [i % side, i / side % side, i / side / side]));
        assert_eq!(corners.collect::<HashSet<_>>().len(), side.pow(3) as usize);
    }
    assert_eq!(levels.iter().map(|level| level.dense).collect::<Vec<_>>(), [1, 1, 0]);
}

#[test]
fn a_batch_is_windows_and_pixels_outside_of_them_that_show_something() {
    for settings in [&[][..], &["sax.window_num=10", "sax.n_rays=60"], &["sax.window_num=0", "sax.n_rays=31"]] {
        let config = config(settings);
        let (mut data, ..) = hard_case(&config).unwrap();
        // A third of the pixels is empty.
        let images: Vec<f32> = data.images.iter().enumerate().map(|(i, v)| if i % 3 == 0 { 0.0 } else { *v }).collect();
        data.images = images;
        data.listed.retain(|p| p % 3 != 0);
        let n = data.n_pixels();
        assert!(n % 3 == 0, "pixels of all images are alike");
        let of_image = (n - n / 3) as u32;
        for (i, list) in (0..).zip(&mut data.lists) {
            (list.first, list.n) = (i * of_image, of_image);
        }
        let setup = fit_setup(&outline(&data, &config.sax, 0), &data, &config.sax);
        let side = setup.window as usize;
        let of_windows = setup.n_windows as usize * side * side;
        let mut orders = HashSet::new();
        for step in 0..12 {
            let rays = reference::batch(&data, &setup, 1, seed_of_set(1, 1), step);
            assert_eq!(rays.len(), setup.n_rays as usize);
            let image = data.sets.images(1)[step as usize % data.sets.images(1).len()];
            assert!(rays.iter().all(|id| id / n == image));
            let pixels: Vec<usize> = rays.iter().map(|id| id % n).collect();
            let (windows, singles) = pixels.split_at(of_windows);
            for window in windows.chunks(side * side) {
                let (column, row) = (window[0] % data.width, window[0] / data.width);
                assert!(column % side == 0 && row % side == 0);
                let all = |(at, p): (usize, &usize)| *p == (row + at / side) * data.width + column + at % side;
                assert!(window.iter().enumerate().all(all));
            }
            assert_eq!(windows.iter().collect::<HashSet<_>>().len(), of_windows, "windows do not overlap");
            assert!(singles.iter().all(|p| p % 3 != 0 && !windows.contains(p)));
            assert_eq!(singles.iter().collect::<HashSet<_>>().len(), singles.len(), "no pixel twice");
            orders.insert(pixels);
        }
        assert_eq!(orders.len(), 12);
    }
}

/// Field of a model, as SAX-NeRF's own type.
fn field_of(model: &Model) -> SaxField {
    model.field.as_ref().unwrap().downcast::<SaxField>().unwrap().clone()
}

/// State of a fit in a checkpoint, as SAX-NeRF's own type.
fn state_of(checkpoint: &Checkpoint) -> SaxState {
    checkpoint.state::<SaxState>().unwrap().clone()
}

/// Changes the field of a checkpoint.
fn change_field(checkpoint: &mut Checkpoint, change: impl FnOnce(&mut SaxField)) {
    let mut field = field_of(&checkpoint.model);
    change(&mut field);
    checkpoint.model.field = Some(Arc::new(field));
}

fn start(gpu: &Gpu, config: &Config<SaxSettings>, dataset: &Dataset) -> Trainer {
    Trainer::new(gpu, Plan::new(&config.clone().into_any(), dataset).unwrap(), dataset, tuning(gpu)).unwrap()
}

#[test]
fn runs_fit_their_images_and_repeat_and_resume_bit_by_bit() {
    let gpu = gpu();
    let dataset = uneven_dataset(13, 11);
    for static_data in ["per-phase", "pooled"] {
        let data = format!("sax.static_data={static_data}");
        let config = config(&[&data, "train.iterations=24", "sax.lrate_step=20", "sax.lrate=1e-2"]);
        let mut whole = start(&gpu, &config, &dataset);
        let losses = run(&mut whole, 24);
        let mean = |l: &[f64]| l.iter().sum::<f64>() / l.len() as f64;
        let (first, last) = (mean(&losses[..4]), mean(&losses[20..]));
        assert!(last < 0.6 * first, "{static_data}: {first} to {last}");
        // The stop is not at the end of a submit.
        let stop = 11;
        let mut parts = start(&gpu, &config, &dataset);
        let mut again = run(&mut parts, stop);
        let saved = parts.checkpoint().unwrap();
        let read = Checkpoint::from_bytes(&saved.to_bytes().unwrap(), "checkpoint".as_ref()).unwrap();
        assert_eq!((state_of(&read), field_of(&read.model)), (state_of(&saved), field_of(&saved.model)));
        let plan = Plan::new(&config.clone().into_any(), &dataset).unwrap().in_scene(read.model.scene.clone());
        let mut resumed = Trainer::resume(&gpu, plan, &dataset, tuning(&gpu), &read).unwrap();
        assert_eq!(resumed.step(), stop);
        again.extend(run(&mut resumed, 24));
        assert_eq!(losses, again, "{static_data}");
        let (want, got) = (whole.checkpoint().unwrap(), resumed.checkpoint().unwrap());
        assert!(state_of(&want) == state_of(&got) && field_of(&want.model) == field_of(&got.model), "{static_data}");
    }
    expect_silence(gpu);
}

#[test]
fn each_phase_sees_its_own_images_alone_unless_all_are_pooled() {
    let gpu = gpu();
    let dataset = small_dataset(13, 11);
    let mut other = dataset.clone();
    let changed = other.frames.iter_mut().filter(|f| f.phase == 1);
    changed.for_each(|f| f.integrals.iter_mut().for_each(|v| *v *= 0.5));
    let fields = |static_data: &str| {
        let config = config(&[&format!("sax.static_data={static_data}")]);
        [&dataset, &other].map(|dataset| {
            let mut trainer = start(&gpu, &config, dataset);
            run(&mut trainer, 3);
            field_of(&trainer.model().unwrap())
        })
    };
    let same = |[a, b]: &[SaxField; 2]| a.params.iter().zip(&b.params).map(|(a, b)| a == b).collect::<Vec<_>>();
    let own = fields("per-phase");
    assert_eq!(same(&own), [true, false, true]);
    assert_ne!(own[0].params[0], own[0].params[2]);
    let pooled = fields("pooled");
    assert_eq!(same(&pooled), [false]);
    assert_eq!((pooled[0].set_of(0), pooled[0].set_of(2), own[0].set_of(2)), (0, 0, 2));
    expect_silence(gpu);
}

#[test]
fn a_model_is_drawn_sampled_and_baked_at_whole_phases() {
    let gpu = gpu();
    let dataset = small_dataset(13, 11);
    let mut trainer = start(&gpu, &config(&[]), &dataset);
    run(&mut trainer, 2);
    let model = trainer.model().unwrap();
    assert!(!model.is_continuous());
    let renderer = Renderer::new(&gpu, &model, tuning(&gpu)).unwrap();
    let rays = &dataset.views[0].rays;
    let seen = renderer.render(rays, 13, 11, 1).unwrap();
    assert!(seen.dynamic_integral.iter().all(|v| v.is_finite() && *v > 0.0));
    assert!(seen.static_integral.iter().chain(&seen.static_max).all(|v| *v == 0.0), "there is no static field");
    assert_eq!(seen.dynamic_max, seen.total_max);
    assert_ne!(seen.dynamic_integral, renderer.render(rays, 13, 11, 0).unwrap().dynamic_integral);
    let error = renderer.render_at(rays, 13, 11, 0.5).unwrap_err().to_string();
    assert!(error.contains("between two phases"), "{error}");
    assert!(renderer.render_at(rays, 13, 11, 3.0).is_err(), "the beat does not close");
    // Short and long rows of cells have equal values, because pairs begin at the same positions.
    let corner = glam::DVec3::splat(-0.03);
    let grid = |size| Grid { origin: corner, spacing: glam::DVec3::splat(0.01), size };
    let short = renderer.sample(Component::Dynamic, 1, &grid([4, 3, 2])).unwrap();
    let long = renderer.sample(Component::Total, 1, &grid([6, 3, 2])).unwrap();
    for row in 0..6 {
        let (short, long) = (&short[4 * row..4 * row + 4], &long[6 * row..6 * row + 4]);
        assert!(short.iter().zip(long).all(|(a, b)| (a - b).abs() < 1e-5 * a.abs()), "{short:?} {long:?}");
    }
    // Another state of the run, from a checkpoint and from the device.
    run(&mut trainer, 4);
    let later = trainer.model().unwrap();
    renderer.set_model(&later).unwrap();
    let after = renderer.render(rays, 13, 11, 1).unwrap();
    assert_ne!(after.dynamic_integral, seen.dynamic_integral);
    renderer.set_model(&model).unwrap();
    let params = trainer.feed().own;
    assert!(!params.is_empty());
    renderer.follow_fit(&params);
    drop(params);
    assert_eq!(renderer.render(rays, 13, 11, 1).unwrap().dynamic_integral, after.dynamic_integral);
    let baked = Baked::new(Arc::new(renderer), 12).unwrap();
    let quantity = Quantity { projection: Projection::Mip, component: Component::Dynamic };
    let peaks = baked.render(rays, 13, 11, 1, quantity).unwrap();
    let largest = |values: &[f32]| values.iter().fold(0f32, |m, v| m.max(*v));
    assert!(
        largest(&peaks) > 0.5 * largest(&after.dynamic_max) && largest(&peaks) < 1.01 * largest(&after.dynamic_max)
    );
    drop((baked, trainer));
    expect_silence(gpu);
}

#[test]
fn what_cannot_be_fitted_is_refused() {
    let gpu = gpu();
    let mut dataset = small_dataset(13, 11);
    let refused =
        |dataset: &Dataset, settings: &[&str]| match Plan::new(&config(settings).into_any(), dataset).map(|_| ()) {
            Err(Error::Config { problem, field, .. } | Error::Unmet { problem, field, .. }) => {
                format!("{field}: {problem}")
            }
            other => panic!("{other:?}"),
        };
    let problem = refused(&dataset, &["sax.window_size=6", "sax.window_num=3"]);
    assert!(problem.contains("sax.window_num") && problem.contains("room for at most 2 windows"), "{problem}");
    dataset.frames[2].integrals[15] = f32::NAN;
    assert!(refused(&dataset, &[]).contains("column 2, row 1"));
    let mut sizes = small_dataset(13, 11);
    sizes.views[0].size = [12, 11];
    assert!(refused(&sizes, &[]).contains("images of equal size"));
    // A field, and a batch, too large for the device's buffers.
    let dataset = small_dataset(13, 11);
    let largest = u64::from(gpu.info().max_storage_buffer_range);
    if largest < 1 << 30 {
        let too_large = |settings: &[&str]| {
            let config = config(settings);
            let plan = Plan::new(&config.clone().into_any(), &dataset).unwrap();
            Trainer::new(&gpu, plan, &dataset, tuning(&gpu)).map(|_| ()).unwrap_err().to_string()
        };
        let error = too_large(&["sax.num_levels=16", "sax.base_resolution=16", "sax.log2_hashmap_size=22"]);
        assert!(
            error.contains("sax.log2_hashmap_size") && error.contains("MiB") && error.contains("sax.num_levels"),
            "{error}"
        );
        let error = too_large(&["sax.n_samples=4096", "sax.n_rays=65535"]);
        assert!(error.contains("sax.n_samples") && error.contains("sax.n_rays"), "{error}");
    }
    // A damaged checkpoint, and one of other fields.
    let saved = start(&gpu, &config(&[]), &dataset).checkpoint().unwrap();
    let damaged = |damage: &dyn Fn(&mut Checkpoint)| {
        let mut other = saved.clone();
        damage(&mut other);
        Checkpoint::from_bytes(&other.to_bytes().unwrap(), "checkpoint".as_ref()).err().map(|e| e.to_string())
    };
    assert_eq!(damaged(&|_| ()), None);
    let grid = SaxShape::of(&saved.model.config.of::<SaxSettings>().unwrap().sax).n_weights();
    assert!(damaged(&|c| change_field(c, |field| field.params[1][grid] = f32::NAN)).unwrap().contains("sax.grid"));
    assert!(
        damaged(&|c| {
            let mut state = state_of(c);
            state.moments[2][0][1] = f32::NAN;
            c.fit = Arc::new(state);
        })
        .unwrap()
        .contains("sax.adam.v.norm1")
    );
    assert!(damaged(&|c| change_field(c, |field| field.bound = -1.0)).unwrap().contains("must be positive"));
    assert!(
        damaged(&|c| c.model.config = c.model.config.with(&["sax.num_levels=4".into()]).unwrap())
            .unwrap()
            .contains("sax.grid")
    );
    let other = SaxState { moments: state_of(&saved).moments[..2].to_vec() };
    let (field, config) = (field_of(&saved.model), config(&[]));
    let data = Plan::new(&config.clone().into_any(), &dataset).unwrap().data::<SaxData>().unwrap().clone();
    let error = SaxTrainer::with(&gpu, data, &config, &field, &other).map(|_| ()).unwrap_err().to_string();
    assert!(error.contains("checkpoint"), "{error}");
    expect_silence(gpu);
}

#[test]
fn presets_and_notes_say_what_the_method_is() {
    let config = Config::preset(Preset::SaxNerf);
    assert_eq!((config.gaussian_iterations(), config.train.iterations), (0, 4503));
    assert!(config.fields().is_none() && !config.has_network() && !config.follows_breath());
    let plan = Plan::new(&config, &uneven_dataset(64, 48)).unwrap();
    let says = |part: &str| assert!(plan.notes.iter().any(|note| note.contains(part)), "{part}: {:?}", plan.notes);
    says("a static method");
    says("passes over them");
    says("are used as frames of the nearest phase");
    let params =
        f64s(&nertca_vk::methods::sax_nerf::start::first_params(SaxShape { levels: 2, base: 2, log2_table: 5 }, 1));
    assert!(params.iter().all(|v| v.abs() <= 2.0));
}
