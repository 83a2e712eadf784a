//! Comparison of the motion hull with the phantom's truth, without noise: no moving vessel is carved away.

use crate::common;
use crate::common::{expect_silence, gpu, run, small_config, small_dataset, tuning};
use glam::DVec3;
use nertca_vk::fields::carve::carve;
use nertca_vk::fields::motion;
use nertca_vk::fields::scale::dynamic_half;
use nertca_vk::formats::volume::{Volume, VolumeHints};
use nertca_vk::formats::volume_files;
use nertca_vk::geometry::world_from_lps_mm;
use nertca_vk::gpu::device::Gpu;
use nertca_vk::kernels::tuning::Tuning;
use nertca_vk::model::hull::Hull;
use nertca_vk::plan::Plan;
use nertca_vk::raster::{Image, dilate};
use nertca_vk::render::renderer::Renderer;
use nertca_vk::scan::dataset::{Dataset, Layout};
use nertca_vk::train::trainer::Trainer;
use nertca_vk_phantom::dataset::{PhantomOptions, Setting, make};
use nertca_vk_phantom::degradations::Degradations;
use nertca_vk_phantom::projector::Projector;
use nertca_vk_phantom::views::ViewAngles;
use std::num::NonZeroU32;

const PHASES: u32 = 8;
const RESOLUTION: usize = 96;

/// A phantom with the voxels of its vessels.
struct Phantom {
    dataset: Dataset,
    vessels: Vec<Volume>,
}

fn phantom(gpu: &Gpu, views: u32) -> Phantom {
    let directory = tempfile::tempdir().unwrap();
    let out = directory.path().join("phantom");
    let options = PhantomOptions {
        setting: Setting::SmallXcat,
        size: 100,
        phases: PHASES,
        views: ViewAngles::published(views).unwrap(),
        seed: 1,
        stenoses: Vec::new(),
        degradations: Degradations::default(),
        layout: Layout::Native,
        anatomy: None,
        volumes_every: Some(NonZeroU32::MIN),
    };
    make(gpu, &options, &out, |_, _, _| ()).unwrap();
    let vessels = (0..PHASES)
        .map(|phase| {
            let file = out.join(format!("volumes/vessels-{phase:02}.nrrd"));
            volume_files::read(&file, &VolumeHints::default()).unwrap()
        })
        .collect();
    Phantom { dataset: Dataset::open(&out).unwrap(), vessels }
}

/// Voxels that are entirely vessel, in world units; those at the wall have less contrast.
fn inside_vessels(volume: &Volume) -> Vec<DVec3> {
    let max = volume.values.iter().copied().fold(0.0, f32::max);
    let [nx, ny, _] = volume.size;
    let full = volume.values.iter().enumerate().filter(|(_, v)| **v > 0.5 * max);
    full.map(|(i, _)| {
        let lps = volume.index_to_lps.transform_point3(DVec3::new(
            (i % nx) as f64,
            (i / nx % ny) as f64,
            (i / (nx * ny)) as f64,
        ));
        world_from_lps_mm(lps)
    })
    .collect()
}

/// Tells whether every training view has a pixel for a point.
fn seen_by_all(point: DVec3, dataset: &Dataset) -> bool {
    let (width, height) = (dataset.width as f64, dataset.height as f64);
    dataset.training_views().iter().all(|view| {
        dataset.views[*view]
            .rays
            .project(point)
            .is_some_and(|(i, j)| (-0.5..width - 0.5).contains(&i) && (-0.5..height - 0.5).contains(&j))
    })
}

/// Tells whether a kept cell lies within half a cell of a point along each axis, since carving tests the centres of cells.
fn kept_nearby(hull: &Hull, point: DVec3, phase: usize) -> bool {
    let steps = [-0.5, 0.0, 0.5].map(|s| s * hull.cell);
    steps
        .iter()
        .any(|x| steps.iter().any(|y| steps.iter().any(|z| hull.contains_point(point + DVec3::new(*x, *y, *z), phase))))
}

/// Change of each pixel of each training view by vessels alone, from its minimum to each phase, as a share of the strongest
/// change in its view.
fn changes(gpu: &Gpu, phantom: &Phantom) -> Vec<Vec<Vec<f32>>> {
    let dataset = &phantom.dataset;
    let projector = Projector::new(gpu, dataset.width, dataset.height).unwrap();
    let rays: Vec<_> = dataset.training_views().iter().map(|v| dataset.views[*v].rays.clone()).collect();
    let images: Vec<Vec<Vec<f32>>> = phantom
        .vessels
        .iter()
        .map(|volume| projector.project(&projector.load(volume.clone()).unwrap(), &rays, DVec3::ZERO).unwrap())
        .collect();
    (0..rays.len())
        .map(|view| {
            let min = |p: usize| images.iter().map(|phase| phase[view][p]).fold(f32::INFINITY, f32::min);
            let min: Vec<f32> = (0..dataset.n_pixels()).map(min).collect();
            let change = |phase: &Vec<Vec<f32>>| phase[view].iter().zip(&min).map(|(v, l)| v - l).collect();
            let mut changes: Vec<Vec<f32>> = images.iter().map(change).collect();
            let max = changes.iter().flatten().copied().fold(0.0, f32::max);
            changes.iter_mut().flatten().for_each(|c| *c /= max);
            changes
        })
        .collect()
}

/// Number of vessel voxels that every view sees and that change each view's pixel by at least `visible`, and the number of
/// them outside a hull.
fn lost(phantom: &Phantom, changes: &[Vec<Vec<f32>>], hull: &Hull, half: f64, visible: f32) -> (usize, usize) {
    let dataset = &phantom.dataset;
    let shows = |phase: usize, point: DVec3| {
        dataset.training_views().iter().zip(changes).all(|(view, changes)| {
            let (i, j) = dataset.views[*view].rays.project(point).unwrap();
            changes[phase][j.round() as usize * dataset.width + i.round() as usize] >= visible
        })
    };
    let (mut all, mut lost) = (0, 0);
    for (phase, volume) in phantom.vessels.iter().enumerate() {
        for point in inside_vessels(volume) {
            if point.abs().max_element() < half && seen_by_all(point, dataset) && shows(phase, point) {
                all += 1;
                lost += usize::from(!kept_nearby(hull, point, phase));
            }
        }
    }
    (all, lost)
}

/// Changes of this size in every view are never taken for noise over the beat; at a single phase the limit is larger.
const VISIBLE_OVER_THE_BEAT: f32 = 0.1;
const VISIBLE_AT_A_PHASE: f32 = 0.2;
/// Maximum lost share of all vessels, including those as thin as a pixel and those that hardly move. Measured: 0.028 with
/// three views and 0.009 with four for hulls per phase, 0.011 and 0.001 for those of the whole beat.
const MAX_LOST: f64 = 0.04;

#[test]
fn no_vessel_that_moves_is_carved_away() {
    let gpu = gpu();
    for views in [3, 4] {
        let phantom = phantom(&gpu, views);
        let dataset = &phantom.dataset;
        let changes = changes(&gpu, &phantom);
        let motion = motion::analyse(dataset, motion::Thresholds::default());
        let half = dynamic_half(0.0, dataset);
        for (per_phase, visible) in [(true, VISIBLE_AT_A_PHASE), (false, VISIBLE_OVER_THE_BEAT)] {
            let hull = carve(dataset, &motion, half, RESOLUTION, per_phase);
            let (shown, gone) = lost(&phantom, &changes, &hull, half, visible);
            assert!(shown > 5000, "only {shown} voxels show their motion");
            assert_eq!(gone, 0, "of {shown} voxels with {views} views, per phase: {per_phase}");
            let (all, gone) = lost(&phantom, &changes, &hull, half, 0.0);
            println!("{views} views, per phase {per_phase}: {gone} of {all} lost, {:.4} of the box kept", hull.share());
            assert!((gone as f64) < MAX_LOST * all as f64, "{gone} of {all} voxels with {views} views");
            assert!(hull.share() < 0.05, "a hull that keeps everything loses nothing: {}", hull.share());
        }
    }
    common::expect_silence(gpu);
}

/// With the vessels' exact shadows as motion, no vessel may be lost.
#[test]
fn carving_by_exact_shadows_loses_nothing() {
    let gpu = gpu();
    let phantom = phantom(&gpu, 3);
    let dataset = &phantom.dataset;
    let half = dynamic_half(0.0, dataset);
    let mut motion = motion::analyse(dataset, motion::Thresholds::default());
    for m in &mut motion {
        for (phase, moving) in m.moving_at.iter_mut().enumerate() {
            let frame = dataset.training().iter().find(|f| f.view == m.view && f.phase as usize == phase).unwrap();
            // The mask samples shadows at the centres of pixels; a pixel that is only touched is beside one of these.
            let values = frame.mask.as_ref().unwrap().iter().map(|m| f32::from(u8::from(*m))).collect();
            let shadow = Image { width: dataset.width, height: dataset.height, values };
            *moving = dilate(&shadow, 1).values.iter().map(|v| *v > 0.0).collect();
        }
        m.moving = (0..dataset.n_pixels()).map(|p| m.moving_at.iter().any(|moving| moving[p])).collect();
    }
    let changes = vec![vec![vec![0.0; dataset.n_pixels()]; PHASES as usize]; motion.len()];
    for per_phase in [true, false] {
        let hull = carve(dataset, &motion, half, RESOLUTION, per_phase);
        let (all, gone) = lost(&phantom, &changes, &hull, half, 0.0);
        assert_eq!(gone, 0, "of {all} voxels, per phase: {per_phase}");
        assert!(hull.share() < 0.05, "{}", hull.share());
    }
    common::expect_silence(gpu);
}

#[test]
fn what_a_hull_leaves_is_drawn_the_same_in_any_chunks() {
    let (gpu, dataset) = (gpu(), small_dataset(52, 44));
    let hull = [
        "hull.enabled=true",
        "hull.max_share=1",
        "hull.resolution=24",
        "hull.dilate_pixels=3",
        "train.chunk_samples=65536",
    ];
    let plan = Plan::new(&small_config("fast-mlp", &hull), &dataset).unwrap();
    let share = plan.hull.as_ref().map_or(1.0, Hull::share);
    assert!(share > 0.0 && share < 0.9, "a hull that keeps {share} of the box");
    let mut trainer = Trainer::new(&gpu, plan, &dataset, tuning(&gpu)).unwrap();
    run(&mut trainer, 12);
    let model = trainer.model().unwrap();
    let see = |chunk_samples, side| {
        let path = Tuning { chunk_samples, ..tuning(&gpu) };
        let renderer = Renderer::new(&gpu, &model, path).unwrap();
        let drawn = [0, 1, 2].map(|phase| renderer.render(&dataset.views[1].rays, side, side, phase).unwrap());
        drawn.map(|seen| [seen.static_integral, seen.dynamic_integral, seen.dynamic_max, seen.total_max])
    };
    // The first run has all rays in one chunk even if all samples were live; the others are counted, and packed into few
    // and into many chunks.
    let whole = see(65_536, 60);
    // There is at least one sample for each pixel that shows something, which is more than the smallest chunks hold.
    let shown = |dynamic: &[f32]| dynamic.iter().filter(|value| **value > 0.0).count();
    let shown: Vec<usize> = whole.iter().map(|[_, dynamic, ..]| shown(dynamic)).collect();
    assert!(shown.iter().all(|n| (129..60 * 60).contains(n)), "{shown:?} pixels, hull {share}");
    assert!(whole == see(8192, 60) && whole == see(256, 60) && whole == see(128, 60));
    drop(trainer);
    expect_silence(gpu);
}
