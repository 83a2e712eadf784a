//! Scores against the true vessels through the C ABI equal those of `eval` for the same run.
#![allow(
    missing_docs,
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::undocumented_unsafe_blocks,
    reason = "tests of C functions"
)]

use crate::c_scene::{close, context, last_error, ok, reconstruction, zeroed};
use crate::known_tree::{ok as runs, phantom, text};
use nertca_vk::checkpoint;
use nertca_vk::formats::volume::VolumeHints;
use nertca_vk::formats::volume_files;
use nertca_vk::geometry::Geometry;
use nertca_vk::scan::dataset::{Dataset, Split};
use nertca_vk::scan::truth::{VOLUMES, truth_file};
use nertca_vk_abi::reconstruction::*;
use nertca_vk_abi::status::*;
use nertca_vk_abi::truth::*;
use nertca_vk_abi::types::*;
use nertca_vk_phantom::tree_file::{TREE, TreeFile};
use serde_json::Value;
use std::ffi::CString;
use std::path::Path;
use std::ptr::null;

const PHASES: u32 = 4;

fn add_frames(to: *mut nertca_reconstruction, dataset: &Dataset) {
    for frame in &dataset.frames {
        let Geometry::CArm(c_arm) = &dataset.views[frame.view].geometry else { panic!("a C-arm is expected") };
        let mask: Vec<u8> = frame.mask.iter().flatten().map(|m| u8::from(*m)).collect();
        let frame = nertca_frame {
            size: size_of::<nertca_frame>(),
            geometry: nertca_geometry {
                size: size_of::<nertca_geometry>(),
                primary_deg: c_arm.primary_deg,
                secondary_deg: c_arm.secondary_deg,
                sid_mm: c_arm.sid_mm,
                sod_mm: c_arm.sod_mm,
                pixel_mm: c_arm.pixel_mm,
                offset_mm: c_arm.offset_mm,
                ..zeroed()
            },
            pixels: frame.integrals.as_ptr().cast(),
            pixels_bytes: 4 * frame.integrals.len(),
            width: dataset.width as u32,
            height: dataset.height as u32,
            format: NERTCA_PIXELS_F32,
            intensity: NERTCA_INTENSITY_INTEGRAL,
            scale: 1.0,
            phase: frame.phase as i32,
            split: if frame.split == Split::Train { NERTCA_SPLIT_TRAIN } else { NERTCA_SPLIT_VALIDATION },
            mask: mask.as_ptr(),
            mask_bytes: mask.len(),
            ..zeroed()
        };
        ok(unsafe { nertca_reconstruction_add_frame(to, &frame) }, to);
    }
}

/// Voxels with at least half of the vessels' attenuation, on their grid.
fn true_vessels(data: &Path, phase: u32, vessel_per_mm: f64) -> (nertca_grid, Vec<u8>) {
    let volume = volume_files::read(&truth_file(&data.join(VOLUMES), phase), &VolumeHints::default()).unwrap();
    let axes = volume.index_to_lps.matrix3;
    let grid = nertca_grid {
        size: size_of::<nertca_grid>(),
        origin_mm: volume.index_to_lps.translation.to_array(),
        spacing_mm: [axes.x_axis.x, axes.y_axis.y, axes.z_axis.z],
        points: volume.size.map(|n| n as u32),
        phase,
        ..zeroed()
    };
    (grid, volume.values.iter().map(|v| u8::from(f64::from(*v) > 0.5 * vessel_per_mm)).collect())
}

/// Arrays of a tree over the beat.
#[derive(Default)]
struct Lines {
    branch_phase: Vec<u32>,
    branch_first: Vec<u32>,
    branch_points: Vec<u32>,
    points_mm: Vec<f64>,
    radius_mm: Vec<f64>,
}

impl Lines {
    fn read(data: &Path) -> Lines {
        let (file, mut lines) = (TreeFile::read(&data.join(VOLUMES).join(TREE)).unwrap(), Lines::default());
        for phase in 0..PHASES {
            for branch in file.at(f64::from(phase) / f64::from(PHASES)).branches {
                lines.branch_phase.push(phase);
                lines.branch_first.push(lines.radius_mm.len() as u32);
                lines.branch_points.push(branch.points.len() as u32);
                lines.points_mm.extend(branch.points.iter().flat_map(|p| p.to_array()));
                lines.radius_mm.extend(&branch.radius_mm);
            }
        }
        lines
    }

    fn of(&mut self) -> nertca_tree {
        nertca_tree {
            size: size_of::<nertca_tree>(),
            branches: self.branch_phase.len(),
            points: self.radius_mm.len(),
            branch_phase: self.branch_phase.as_mut_ptr(),
            branch_first: self.branch_first.as_mut_ptr(),
            branch_points: self.branch_points.as_mut_ptr(),
            points_mm: self.points_mm.as_mut_ptr(),
            radius_mm: self.radius_mm.as_mut_ptr(),
            ..zeroed()
        }
    }
}

fn scores(of: *mut nertca_reconstruction) -> nertca_scores {
    let mut scores = nertca_scores { size: size_of::<nertca_scores>(), ..zeroed() };
    ok(unsafe { nertca_reconstruction_evaluate(of, 0.0, &mut scores) }, of);
    scores
}

#[test]
fn scores_in_3d_are_those_of_eval() {
    let directory = tempfile::tempdir().unwrap();
    let (data, run) = (directory.path().join("data"), directory.path().join("run"));
    phantom(&data, PHASES as usize, &["--size", "64", "--offset", "2.5,-1.5", "--test-angles", "60,-10"]);
    let short = ["--iterations", "60", "--set", "gaussians.iterations=60", "--set", "calibrate.mode=off"];
    runs(&[&["train", text(&data), "-o", text(&run), "--tree"], &short[..]].concat());
    let told: Value = serde_json::from_slice(&std::fs::read(run.join("report/evaluation.json")).unwrap()).unwrap();

    let dataset = Dataset::open(&data).unwrap();
    let vessel_per_mm = dataset.vessel_attenuation.unwrap() / 100.0;
    let context = context("validation = true\ndeterministic = true");
    let made = reconstruction(context, &format!("phases = {PHASES}\nvessel_attenuation_per_mm = {vessel_per_mm}"));
    let saved = CString::new(text(&checkpoint::newest(&run).unwrap())).unwrap();
    ok(unsafe { nertca_reconstruction_load(made, saved.as_ptr()) }, made);
    add_frames(made, &dataset);

    let nothing = scores(made);
    assert_eq!((nothing.volume_phases, nothing.tree_phases), (0, 0));
    assert!(nothing.chamfer_mm.is_nan() && nothing.radius_rmse_mm.is_nan() && nothing.volume_dice.is_nan());
    let close_to = |name: &str, found: f64, of: &str, key: &str| {
        let expected = told[of]["mean"][key].as_f64().unwrap_or_else(|| panic!("{key} in {}", told[of]));
        println!("{name}: {found}, {expected} of eval");
        assert!((found - expected).abs() < 1e-6 * expected.abs().max(1e-3), "{name}: {found}, {expected} of eval");
    };

    for phase in 0..PHASES {
        let (grid, vessels) = true_vessels(&data, phase, vessel_per_mm);
        let set = unsafe { nertca_reconstruction_set_true_vessels(made, &grid, vessels.as_ptr(), vessels.len()) };
        ok(set, made);
    }
    let found = scores(made);
    assert_eq!((found.volume_phases, found.tree_phases), (PHASES, 0));
    for (name, value, key) in [
        ("Dice", found.volume_dice, "dice"),
        ("Chamfer", found.chamfer_mm, "chamfer_mm"),
        ("Hausdorff", found.hausdorff95_mm, "hausdorff95_mm"),
        ("found", found.true_centreline_found, "true_centreline_found"),
        ("true", found.our_centreline_true, "our_centreline_true"),
        ("clDice", found.cl_dice, "cl_dice"),
        ("components", found.components, "components"),
        ("true components", found.true_components, "true_components"),
    ] {
        close_to(name, value, "volume", key);
    }
    assert_eq!(found.dice_dynamic, nothing.dice_dynamic, "images score as before");

    let mut lines = Lines::read(&data);
    ok(unsafe { nertca_reconstruction_set_true_tree(made, &lines.of()) }, made);
    let found = scores(made);
    assert_eq!((found.volume_phases, found.tree_phases), (PHASES, PHASES));
    for (name, value, key) in [
        ("found", found.tree_true_centreline_found, "true_centreline_found"),
        ("true", found.tree_our_centreline_true, "our_centreline_true"),
        ("away", found.tree_ours_to_true_mm, "ours_to_true_mm"),
        ("trees", found.tree_components, "components"),
        ("motion", found.motion_error_mm, "motion_error_mm"),
    ] {
        close_to(name, value, "tree", key);
    }
    // `eval` measures radii in the images. A session does so once it has trained, because a checkpoint does not have the corrections of views.
    for (name, value, key) in
        [("radius", found.radius_error_mm, "radius_error_mm"), ("radius RMSE", found.radius_rmse_mm, "radius_rmse_mm")]
    {
        let of_images = told["tree"]["mean"][key].as_f64().unwrap();
        println!("{name}: {value} of the field, {of_images} of the images");
        assert!(value != of_images && (value - of_images).abs() < 0.3, "{name}: {value}, {of_images}");
    }

    // A caller of the previous version: the fields it knows are set, and the memory behind them is left unchanged.
    let known = std::mem::offset_of!(nertca_scores, volume_phases);
    let mut shorter = nertca_scores { size: known, chamfer_mm: 77.0, ..zeroed() };
    ok(unsafe { nertca_reconstruction_evaluate(made, 0.0, &mut shorter) }, made);
    assert_eq!((shorter.size, shorter.psnr_db, shorter.chamfer_mm), (known, found.psnr_db, 77.0));

    // Phases and trees can be removed as well.
    let (grid, vessels) = true_vessels(&data, 3, vessel_per_mm);
    ok(unsafe { nertca_reconstruction_set_true_vessels(made, &grid, null(), 0) }, made);
    let none = nertca_tree { size: size_of::<nertca_tree>(), ..zeroed() };
    ok(unsafe { nertca_reconstruction_set_true_tree(made, &none) }, made);
    let fewer = scores(made);
    assert_eq!((fewer.volume_phases, fewer.tree_phases), (PHASES - 1, 0));

    // Errors name invalid arguments.
    let set_vessels = |grid: &nertca_grid, bytes: usize, at: *const u8| unsafe {
        nertca_reconstruction_set_true_vessels(made, grid, at, bytes)
    };
    let refused = |status: nertca_status, part: &str| {
        let said = last_error(made);
        assert!(
            status == NERTCA_ERROR_ARGUMENT && said.contains(part),
            "{status} with `{said}` where `{part}` is wrong"
        );
    };
    refused(set_vessels(&grid, vessels.len() - 1, vessels.as_ptr()), "bytes");
    refused(set_vessels(&grid, vessels.len(), null()), "vessels");
    refused(set_vessels(&nertca_grid { phase: PHASES, ..grid }, vessels.len(), vessels.as_ptr()), "phase");
    refused(set_vessels(&nertca_grid { spacing_mm: [0.0; 3], ..grid }, vessels.len(), vessels.as_ptr()), "spacing");
    let good = lines.of();
    let with = |change: &dyn Fn(&mut nertca_tree)| {
        let mut tree = good;
        change(&mut tree);
        unsafe { nertca_reconstruction_set_true_tree(made, &tree) }
    };
    refused(with(&|t| t.points = 3), "branch_points");
    refused(with(&|t| t.branches -= 1), "another number of lines");
    refused(with(&|t| t.points_mm = std::ptr::null_mut()), "points_mm");
    refused(with(&|t| t.branches = usize::MAX), "branches");
    let mut late: Vec<u32> = lines.branch_phase.iter().map(|p| p + 1).collect();
    let late = late.as_mut_ptr();
    refused(with(&|t| t.branch_phase = late), "phase");
    assert_eq!(scores(made).tree_phases, 0, "what was refused was not taken");
    close(context, &[made]);
}
