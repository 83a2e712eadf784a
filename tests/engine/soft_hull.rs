//! The soft hull on phantoms with a known truth: the kept share of the vessels and of the box, at four noise levels.

use crate::common;
use crate::common::{drop_first_view, gpu, phantom_with_volumes, whiten};
use glam::DVec3;
use nertca_vk::formats::volume::VolumeHints;
use nertca_vk::formats::volume_files;
use nertca_vk::methods::dynamic_gaussians::soft_hull::carve::{SoftHull, SoftMotion};
use nertca_vk::random::{STREAM_PHOTON, normal};
use std::collections::{HashMap, HashSet};
use std::path::Path;
use std::time::Instant;

const RESOLUTION: usize = 112;
/// Half side of the phantom's box, world units: the position where the corners of its images meet the isocentre plane.
const HALF: f64 = 0.2546;

/// Vessels of a phase: cells of the hull's grid with the number of vessel voxels in them, and the share of these voxels
/// that lie in thin vessels.
struct Truth {
    cells: HashMap<u32, (f64, f64)>,
}

/// Finds voxels at least half full, and classifies them as thick or thin.
fn truth(directory: &Path, phase: usize, hull: &SoftHull) -> Truth {
    let path = directory.join(format!("volumes/vessels-{phase:02}.nrrd"));
    let volume = volume_files::read(&path, &VolumeHints::default()).unwrap();
    let [nx, ny, nz] = volume.size;
    let max = volume.values.iter().copied().fold(0f32, f32::max);
    let full: Vec<bool> = volume.values.iter().map(|v| *v > 0.5 * max).collect();
    let thick = thick(&full, volume.size);
    let mut cells: HashMap<u32, (f64, f64)> = HashMap::new();
    for index in (0..nx * ny * nz).filter(|i| full[*i]) {
        let at = DVec3::new((index % nx) as f64, (index / nx % ny) as f64, (index / (nx * ny)) as f64);
        let lps = volume.index_to_lps.transform_point3(at);
        let cell = ((nertca_vk::geometry::world_from_lps_mm(lps) - hull.min) / hull.cell).floor();
        let n = hull.resolution as f64;
        let entry = cells.entry(((cell.z * n + cell.y) * n + cell.x) as u32).or_default();
        entry.0 += 1.0;
        entry.1 += f64::from(u8::from(!thick[index]));
    }
    Truth { cells }
}

/// Voxels within an opening by a ball of three voxels: vessels of about 0.9 mm or more in diameter.
fn thick(full: &[bool], size: [usize; 3]) -> Vec<bool> {
    const RADIUS: isize = 3;
    let range = -RADIUS..=RADIUS;
    let offsets: Vec<[isize; 3]> = range
        .clone()
        .flat_map(|z| range.clone().flat_map(move |y| (-RADIUS..=RADIUS).map(move |x| [x, y, z])))
        .filter(|o| o.iter().map(|v| v * v).sum::<isize>() <= RADIUS * RADIUS)
        .collect();
    let index = |at: [isize; 3]| {
        let inside = at.iter().zip(size).all(|(v, n)| *v >= 0 && *v < n as isize);
        inside.then(|| ((at[2] as usize * size[1]) + at[1] as usize) * size[0] + at[0] as usize)
    };
    let position = |i: usize| [i % size[0], i / size[0] % size[1], i / (size[0] * size[1])].map(|v| v as isize);
    let beside = |at: [isize; 3], o: &[isize; 3]| index([at[0] + o[0], at[1] + o[1], at[2] + o[2]]);
    let mut out = vec![false; full.len()];
    for i in (0..full.len()).filter(|i| full[*i]) {
        let at = position(i);
        if offsets.iter().all(|o| beside(at, o).is_some_and(|j| full[j])) {
            for j in offsets.iter().filter_map(|o| beside(at, o)) {
                out[j] = true;
            }
        }
    }
    out
}

#[derive(Debug)]
#[allow(dead_code, reason = "all of it is printed")]
struct Score {
    recall: f64,
    thin: f64,
    share_percent: f64,
    precision: f64,
}

fn score(directory: &Path, hull: &SoftHull) -> Score {
    let (mut all, mut thin, mut kept, mut kept_thin, mut cells, mut right) = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0);
    for phase in (0..hull.cells.len()).step_by(3) {
        let truth = truth(directory, phase, hull);
        let found: HashSet<u32> = hull.cells[phase].iter().map(|c| c.index).collect();
        for (cell, (count, of_thin)) in &truth.cells {
            let here = f64::from(u8::from(found.contains(cell)));
            all += count;
            thin += of_thin;
            kept += here * count;
            kept_thin += here * of_thin;
            right += here;
        }
        cells += found.len() as f64;
    }
    Score { recall: kept / all, thin: kept_thin / thin, share_percent: 100.0 * hull.share(), precision: right / cells }
}

/// Line integral of the strongest vessel: 99.5th percentile over pixels of the mask's maximum change.
fn strongest(motion: &SoftMotion) -> f64 {
    motion.views.iter().map(|v| f64::from(v.background.strongest)).fold(0.0, f64::max)
}

#[test]
fn vessels_are_kept_and_little_else_at_four_noise_levels() {
    let gpu = gpu();
    let directory = tempfile::tempdir().unwrap();
    let clean = phantom_with_volumes(&gpu, directory.path(), 100, 4);
    let s = strongest(&SoftMotion::new(&clean, HALF, 32));
    // Noise as a share of the strongest vessel; minimum recall of all and of thin vessels; maximum share of the box, %.
    let four = [(0.0, 0.94, 0.90, 0.5), (0.01, 0.93, 0.88, 0.4), (0.03, 0.91, 0.84, 0.4), (0.1, 0.85, 0.67, 0.5)];
    let three = [(0.0, 0.95, 0.92, 0.8), (0.01, 0.93, 0.89, 0.65), (0.03, 0.93, 0.87, 0.7), (0.1, 0.86, 0.70, 1.0)];
    let mut failures = Vec::new();
    for (n_views, levels) in [(4, four), (3, three)] {
        for (noise, recall, thin, share) in levels {
            let mut dataset = clean.clone();
            whiten(&mut dataset, noise * s);
            if n_views == 3 {
                drop_first_view(&mut dataset);
            }
            let start = Instant::now();
            let motion = SoftMotion::new(&dataset, HALF, RESOLUTION);
            let seconds = start.elapsed().as_secs_f64();
            let got = score(directory.path(), &motion.hull);
            let line = format!("{n_views} views, noise {noise}: {got:.3?}, {seconds:.2} s");
            println!("{line}");
            if got.recall < recall || got.thin < thin || got.share_percent > share {
                failures.push(line);
            }
        }
    }
    assert!(failures.is_empty(), "{failures:#?}");
}

#[test]
fn noise_alone_leaves_next_to_nothing() {
    let mut dataset = common::small_dataset(64, 64);
    for frame in &mut dataset.frames {
        let view = frame.view;
        let still = |p: usize| 1.0 + 0.3 * ((p % 64) as f32 / 9.0 + view as f32).sin();
        let noise = |p: usize| 0.02 * normal(1, STREAM_PHOTON, frame.phase * 8 + view as u32, p as u32) as f32;
        frame.integrals = (0..64 * 64).map(|p| still(p) + noise(p)).collect();
    }
    let hull = SoftMotion::new(&dataset, 0.2, 64).hull;
    assert!(hull.share() < 0.02, "{}", hull.share());
}

#[test]
fn degenerate_scenes_are_answered() {
    // With a single phase per view, motion is unknown.
    let mut dataset = common::small_dataset(16, 16);
    dataset.frames.retain(|f| f.phase == 0);
    let motion = SoftMotion::new(&dataset, 0.2, 16);
    assert!(motion.views.is_empty() && motion.hull.share() == 0.0);
    // Nothing moves, and there is no noise: no NaN results, and nothing is kept.
    let mut dataset = common::small_dataset(16, 16);
    dataset.frames.iter_mut().for_each(|f| f.integrals.fill(1.0));
    let motion = SoftMotion::new(&dataset, 0.2, 16);
    assert_eq!(motion.hull.share(), 0.0);
    assert!(motion.views.iter().all(|v| v.background.noise.values.iter().all(|s| s.is_finite())));
}

#[test]
fn a_heart_that_hardly_moves_has_the_hull_of_one_that_rests() {
    let rests = common::small_dataset(48, 48);
    let mut moves = rests.clone();
    moves.frames.iter_mut().for_each(|f| f.heart_shift_mm[2] = 1e-9);
    assert!(moves.heart_shifts() && !rests.heart_shifts(), "points are projected for each phase, or once for all");
    let [expected, found] = [&rests, &moves].map(|dataset| SoftMotion::new(dataset, 0.3, 32).hull);
    assert!(expected.share() > 0.0);
    assert_eq!(found.cells, expected.cells);
}

#[test]
fn the_hull_as_bits_is_the_same_hull() {
    let dataset = common::small_dataset(32, 32);
    let soft = SoftMotion::new(&dataset, 0.3, 32).hull;
    assert!(soft.share() > 0.0);
    let hull = soft.to_hull();
    assert!((hull.share() - soft.share()).abs() < 1e-12);
    for (phase, cells) in soft.cells.iter().enumerate() {
        assert!(cells.iter().all(|c| hull.contains_point(soft.centre(c.index), phase)));
    }
    // Its silhouette covers the pixel of each cell's centre, and omits pixels far from all cells.
    let view = &dataset.views[dataset.training()[0].view];
    let covered = hull.silhouette(&view.rays, (dataset.width, dataset.height), 1);
    let cells: Vec<_> = soft.cells[1].iter().filter_map(|c| view.rays.project(soft.centre(c.index))).collect();
    let seen = |(column, row): (f64, f64)| covered[row.round() as usize * dataset.width + column.round() as usize];
    assert!(!cells.is_empty() && cells.iter().all(|at| seen(*at)));
    for (i, covered) in covered.iter().enumerate().filter(|(_, covered)| **covered) {
        let (column, row) = ((i % dataset.width) as f64, (i / dataset.width) as f64);
        let near = cells.iter().any(|at| (at.0 - column).abs().max((at.1 - row).abs()) < 6.0);
        assert!(*covered && near, "column {column}, row {row}");
    }
    let volume = hull.to_volume();
    let max = volume.values.iter().copied().fold(0f32, f32::max);
    assert!(max >= 1.0 && max <= soft.cells.len() as f32);
}
