//! Frames and views from C: frames that share a view, phases and uses, better geometry, removal, and what training does about it.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::undocumented_unsafe_blocks, reason = "tests of C functions")]

use crate::c_scene::*;
use nertca_vk::formats::npy;
use nertca_vk::geometry::{CArm, Geometry};
use nertca_vk::scan::dataset::Dataset;
use nertca_vk_abi::calibration::*;
use nertca_vk_abi::output::*;
use nertca_vk_abi::reconstruction::*;
use nertca_vk_abi::status::*;
use nertca_vk_abi::training::*;
use nertca_vk_abi::types::*;
use std::ffi::CStr;
use std::ptr::{null, null_mut};
use std::time::Duration;

fn bytes_of(reconstruction: *mut nertca_reconstruction) -> Vec<u8> {
    let mut length = 0;
    ok(unsafe { nertca_reconstruction_save_memory(reconstruction, null_mut(), 0, &mut length) }, reconstruction);
    let mut bytes = vec![0u8; length];
    let to = bytes.as_mut_ptr().cast();
    ok(unsafe { nertca_reconstruction_save_memory(reconstruction, to, bytes.len(), &mut length) }, reconstruction);
    bytes
}

#[track_caller]
fn status_of(reconstruction: *mut nertca_reconstruction, frame: u32) -> nertca_frame_status {
    let mut status = nertca_frame_status { size: size_of::<nertca_frame_status>(), ..zeroed() };
    ok(unsafe { nertca_reconstruction_frame_status(reconstruction, frame, &mut status) }, reconstruction);
    status
}

#[track_caller]
fn uses(reconstruction: *mut nertca_reconstruction, frames: std::ops::Range<u32>) -> Vec<(u32, u32, i32)> {
    let told = |frame| {
        let nertca_frame_status { view, usage, phase, .. } = status_of(reconstruction, frame);
        (view, usage, phase)
    };
    frames.map(told).collect()
}

fn progress(reconstruction: *mut nertca_reconstruction) -> nertca_progress {
    let mut progress = nertca_progress { size: size_of::<nertca_progress>(), ..zeroed() };
    ok(unsafe { nertca_reconstruction_progress(reconstruction, &mut progress) }, reconstruction);
    progress
}

/// Waits for an expected event on a possibly busy machine; exceeding the limit is a failure.
#[track_caller]
fn wait_until(what: &str, come: impl Fn() -> bool) {
    for _ in 0..60_000 {
        if come() {
            return;
        }
        std::thread::sleep(Duration::from_millis(5));
    }
    panic!("{what} did not come");
}

/// Frames of two views whose angles have the noise of sensors: a tenth of it, one thousandth of a pixel, would suffice to tell them
/// apart as numbers.
fn add_noisy_frames(reconstruction: *mut nertca_reconstruction, noise_deg: f64) {
    for view in 0..2 {
        for phase in 0..PHASES {
            let pixels = pixels(view, phase);
            let mut noisy = frame(view, phase, &pixels);
            noisy.geometry.primary_deg += noise_deg * f64::from(phase);
            ok(unsafe { nertca_reconstruction_add_frame(reconstruction, &noisy) }, reconstruction);
        }
    }
}

#[test]
fn frames_whose_angles_have_noise_are_one_view() {
    let context = context("validation = true\ndeterministic = true");
    let steady = reconstruction(context, SMALL);
    add_noisy_frames(steady, 0.0);
    train(steady, 5);
    // A pixel is 3.6 mm at the isocentre: 0.001 degrees are 0.001 mm at 50 mm.
    for noise_deg in [1e-9, 1e-3] {
        let noisy = reconstruction(context, SMALL);
        add_noisy_frames(noisy, noise_deg);
        let [first, second]: [Vec<_>; 2] = [uses(noisy, 0..3), uses(noisy, 3..6)];
        assert_eq!(first, [0, 1, 2].map(|phase| (0, NERTCA_USE_TRAINING, phase)), "noise of {noise_deg} degrees");
        assert_eq!(second, [0, 1, 2].map(|phase| (1, NERTCA_USE_TRAINING, phase)));
        assert_eq!(train(noisy, 5), 5);
        assert!(bytes_of(noisy) == bytes_of(steady), "all frames of a view have the geometry of its first one");
        ok(unsafe { nertca_reconstruction_destroy(noisy) }, noisy);
    }
    // Far apart, each frame is a view of its own, and the message states the reason.
    let moving = reconstruction(context, SMALL);
    add_noisy_frames(moving, 10.0);
    let status = unsafe { nertca_reconstruction_train(moving, 1, None, null_mut(), null_mut()) };
    assert_eq!(status, NERTCA_ERROR_NOT_READY);
    let told = last_error(moving);
    assert!(told.contains("of 6 training frames, 6 belong to views") && told.contains("within 0.1 pixels"), "{told}");
    close(context, &[steady, moving]);
}

#[test]
fn a_frame_with_better_geometry_stays_used_or_is_told_to_be_left_out() {
    let context = context("validation = true\ndeterministic = true");
    let made = reconstruction(context, SMALL);
    add_frames(made, 0..3);
    assert_eq!(status_of(made, 4).taken_in, 0);
    train(made, 2);
    assert_eq!(status_of(made, 4).taken_in, 1);
    // Closer than a tenth of a pixel, it stays in its view.
    let nearly = nertca_geometry { primary_deg: geometry(1).primary_deg + 1e-3, ..geometry(1) };
    ok(unsafe { nertca_reconstruction_set_geometry(made, 4, &nearly) }, made);
    assert_eq!(uses(made, 4..5), [(1, NERTCA_USE_TRAINING, 1)]);
    // Alone at its place, nothing is known to move in it.
    let better = nertca_geometry { primary_deg: geometry(1).primary_deg + 2.0, ..geometry(1) };
    ok(unsafe { nertca_reconstruction_set_geometry(made, 4, &better) }, made);
    let alone = status_of(made, 4);
    assert_eq!((alone.usage, alone.phase, alone.taken_in), (NERTCA_USE_ONE_PHASE, 1, 0));
    assert_eq!(uses(made, 3..4), [(1, NERTCA_USE_TRAINING, 0)], "the other two of its view are used");
    train(made, 2);
    assert_eq!((status_of(made, 3).taken_in, status_of(made, 4).taken_in), (1, 0));
    // With another phase beside it, it is a view.
    ok(unsafe { nertca_reconstruction_set_geometry(made, 5, &better) }, made);
    assert_eq!(uses(made, 4..6), [(alone.view, NERTCA_USE_TRAINING, 1), (alone.view, NERTCA_USE_TRAINING, 2)]);
    assert_eq!(uses(made, 3..4), [(1, NERTCA_USE_ONE_PHASE, 0)]);
    // A whole view by one call; the same as one by one.
    ok(unsafe { nertca_reconstruction_set_view_geometry(made, 3, &better) }, made);
    assert_eq!(uses(made, 3..6), [0, 1, 2].map(|phase| (alone.view, NERTCA_USE_TRAINING, phase)));
    ok(unsafe { nertca_reconstruction_set_view_geometry(made, 5, &geometry(1)) }, made);
    assert_eq!(uses(made, 3..6), [0, 1, 2].map(|phase| (1, NERTCA_USE_TRAINING, phase)));
    let given = reconstruction(context, SMALL);
    add_frames(given, 0..3);
    let fresh = reconstruction(context, SMALL);
    add_frames(fresh, 0..3);
    ok(unsafe { nertca_reconstruction_set_view_geometry(fresh, 4, &better) }, fresh);
    ok(unsafe { nertca_reconstruction_set_view_geometry(fresh, 4, &geometry(1)) }, fresh);
    train(given, 2);
    train(fresh, 2);
    assert!(bytes_of(given) == bytes_of(fresh), "there and back");
    close(context, &[made, given, fresh]);
}

#[test]
fn a_removed_frame_is_as_if_never_added() {
    let context = context("validation = true\ndeterministic = true");
    let (with, without) = (reconstruction(context, SMALL), reconstruction(context, SMALL));
    add_frames(with, 0..1);
    let unwanted = vec![7f32; (SIZE * SIZE) as usize];
    ok(unsafe { nertca_reconstruction_add_frame(with, &frame(1, 0, &unwanted)) }, with);
    add_frames(with, 1..3);
    add_frames(without, 0..3);
    ok(nertca_reconstruction_remove_frame(with, 3), with);
    assert_eq!(nertca_reconstruction_remove_frame(with, 3), NERTCA_ERROR_ARGUMENT);
    assert!(last_error(with).contains("was removed"), "{}", last_error(with));
    assert_eq!(uses(with, 4..5), [(1, NERTCA_USE_TRAINING, 0)], "the others keep their numbers");
    train(with, 3);
    train(without, 3);
    assert!(bytes_of(with) == bytes_of(without));
    close(context, &[with, without]);
}

#[test]
fn training_waits_when_frames_become_too_few_and_goes_on_when_they_come() {
    let context = context("validation = true");
    let made = reconstruction(context, &SMALL.replace("train.iterations = 60", "train.iterations = 100000"));
    add_frames(made, 0..2);
    train(made, 5);
    // The last view falls apart: each of its frames has a place of its own.
    for phase in 0..PHASES {
        let apart = nertca_geometry { primary_deg: 60.0 + 10.0 * f64::from(phase), ..geometry(1) };
        ok(unsafe { nertca_reconstruction_set_geometry(made, 3 + phase, &apart) }, made);
    }
    ok(unsafe { nertca_reconstruction_start(made, None, null_mut()) }, made);
    wait_until("waiting for frames", || progress(made).state == NERTCA_STATE_WAITING);
    let held = progress(made).step;
    assert_eq!(drawn(made, &view(1)), drawn(made, &view(1)), "the field so far is shown");
    assert_eq!(progress(made).step, held);
    add_frames(made, 2..3);
    wait_until("training with the new view", || progress(made).frames == 6 && progress(made).step > held);
    // The same while it trains.
    for frame in 6..9 {
        ok(nertca_reconstruction_remove_frame(made, frame), made);
    }
    wait_until("waiting again", || progress(made).state == NERTCA_STATE_WAITING);
    ok(unsafe { nertca_reconstruction_set_view_geometry(made, 3, &geometry(1)) }, made);
    ok(unsafe { nertca_reconstruction_set_view_geometry(made, 4, &geometry(1)) }, made);
    wait_until("training with two phases of the old view", || progress(made).state == NERTCA_STATE_RUNNING);
    ok(nertca_reconstruction_stop(made), made);
    assert_eq!(progress(made).state, NERTCA_STATE_IDLE);
    close(context, &[made]);
}

fn failure_of(reconstruction: *mut nertca_reconstruction) -> String {
    let mut text = [0; 1024];
    let written = unsafe { nertca_reconstruction_failure(reconstruction, text.as_mut_ptr(), text.len(), &mut 0) };
    ok(written, reconstruction);
    unsafe { CStr::from_ptr(text.as_ptr()) }.to_str().unwrap().to_owned()
}

#[test]
fn training_waits_for_frames_that_the_settings_can_be_met_with() {
    let context = context("validation = true");
    let made = reconstruction(context, SMALL);
    // Contrast has not come yet: the frames of a view are alike.
    for view in 0..2 {
        for phase in 0..PHASES {
            let blank = vec![0.8; (SIZE * SIZE) as usize];
            ok(unsafe { nertca_reconstruction_add_frame(made, &frame(view, phase, &blank)) }, made);
        }
    }
    let status = unsafe { nertca_reconstruction_train(made, 1, None, null_mut(), null_mut()) };
    assert_eq!(status, NERTCA_ERROR_NOT_READY, "{}", last_error(made));
    ok(unsafe { nertca_reconstruction_start(made, None, null_mut()) }, made);
    wait_until("waiting for frames", || progress(made).state == NERTCA_STATE_WAITING);
    assert!(failure_of(made).contains("nothing changes over the beat"), "{}", failure_of(made));
    add_frames(made, 0..3);
    wait_until("training with all frames", || progress(made).step > 0);
    assert_eq!(failure_of(made), "");
    ok(nertca_reconstruction_stop(made), made);
    assert_eq!((progress(made).state, failure_of(made)), (NERTCA_STATE_IDLE, String::new()));
    close(context, &[made]);
}

#[test]
fn a_method_that_needs_all_phases_waits_for_the_last() {
    let context = context("validation = true");
    let made = reconstruction(context, "phases = 3\npreset = r2-gaussian\ntrain.iterations = 20");
    let add = |phases: std::ops::Range<u32>| {
        for (view, phase) in phases.flat_map(|phase| (0..3).map(move |view| (view, phase))) {
            let pixels = pixels(view, phase);
            ok(unsafe { nertca_reconstruction_add_frame(made, &frame(view, phase, &pixels)) }, made);
        }
    };
    add(0..2);
    ok(unsafe { nertca_reconstruction_start(made, None, null_mut()) }, made);
    wait_until("waiting for frames", || progress(made).state == NERTCA_STATE_WAITING);
    assert!(failure_of(made).contains("no image shows the phases [2]"), "{}", failure_of(made));
    add(2..3);
    wait_until("training with all phases", || progress(made).step > 0);
    ok(nertca_reconstruction_stop(made), made);
    close(context, &[made]);
}

#[test]
fn training_in_another_thread_ends_when_its_reconstruction_is_destroyed() {
    let context = context("validation = true");
    let made = reconstruction(context, &SMALL.replace("train.iterations = 60", "train.iterations = 1000000"));
    add_frames(made, 0..3);
    let handle = made.addr();
    let training = std::thread::spawn(move || {
        let made = std::ptr::with_exposed_provenance_mut(handle);
        let mut done = 0;
        (unsafe { nertca_reconstruction_train(made, 1_000_000, None, null_mut(), &mut done) }, done)
    });
    wait_until("training", || progress(made).step > 0);
    ok(unsafe { nertca_reconstruction_destroy(made) }, made);
    let (status, done) = training.join().unwrap();
    assert_eq!(status, NERTCA_ERROR_CANCELLED);
    assert!((1..1_000_000).contains(&done), "{done}");
    close(context, &[]);
}

/// Line integrals of a thin vessel along the axis of the patient, which all views show in their middle, on a gradient.
fn vessel_at_rest() -> Vec<f32> {
    let at = |p: u32| (p % SIZE, p / SIZE);
    let is_vessel = |x: u32, y: u32| (9..11).contains(&x) && (5..15).contains(&y);
    let value = |(x, y): (u32, u32)| 0.8 + 0.01 * x as f32 + if is_vessel(x, y) { 0.5 } else { 0.0 };
    (0..SIZE * SIZE).map(at).map(value).collect()
}

/// Images without vessels that a dataset of the same views has, whose manifest says that the object is at rest.
fn appearance_without_vessels() -> Vec<Vec<f32>> {
    let directory = tempfile::tempdir().unwrap();
    let image = vessel_at_rest();
    npy::write(&directory.path().join("i.npy"), &[SIZE as usize, SIZE as usize], &image).unwrap();
    let frame = |view: usize| {
        let nertca_geometry { primary_deg, secondary_deg, sid_mm, sod_mm, pixel_mm, .. } = geometry(view);
        let (offset_mm, table_mm) = ([0.0; 2], [0.0; 3]);
        let c_arm = CArm { primary_deg, secondary_deg, sid_mm, sod_mm, pixel_mm, offset_mm, table_mm };
        serde_json::json!({"image": "i.npy", "phase": 0, "split": "train", "intensity": {"kind": "integral"}, "geometry": Geometry::CArm(c_arm)})
    };
    let manifest = serde_json::json!({"format": "nertca-dataset", "version": 1, "phases": 1, "still": true, "depth_half_extent_mm": 90,
        "vessel_attenuation_per_mm": 0.01, "frames": [frame(0), frame(1), frame(2)]});
    std::fs::write(directory.path().join("dataset.json"), manifest.to_string()).unwrap();
    let dataset = Dataset::open(directory.path()).unwrap();
    let estimated: Vec<_> = dataset.frames.iter().filter(|f| f.phase == 1).map(|f| f.integrals.to_vec()).collect();
    assert!(estimated.len() == 3 && estimated.iter().all(|f| *f != image));
    estimated
}

#[test]
fn an_object_at_rest_is_reconstructed_as_the_same_dataset_is() {
    let context = context("validation = true\ndeterministic = true");
    let options = SMALL.replace("phases = 3", "still = true");
    let (estimating, given) = (reconstruction(context, &options), reconstruction(context, &options));
    let image = vessel_at_rest();
    for view in 0..3 {
        // A frame needs no phase.
        let timed = nertca_frame { phase: -1, time_s: 0.3 * view as f64, ..frame(view, 0, &image) };
        ok(unsafe { nertca_reconstruction_add_frame(estimating, &timed) }, estimating);
        ok(unsafe { nertca_reconstruction_add_frame(given, &frame(view, 0, &image)) }, given);
    }
    assert_eq!(uses(estimating, 0..3), [0, 1, 2].map(|view| (view, NERTCA_USE_TRAINING, 0)));
    for (view, background) in appearance_without_vessels().iter().enumerate() {
        ok(unsafe { nertca_reconstruction_add_frame(given, &frame(view, 1, background)) }, given);
    }
    train(estimating, 5);
    train(given, 5);
    assert!(bytes_of(estimating) == bytes_of(given), "the estimated images are those of the dataset");
    let middle = |picture: Vec<f32>| picture[(SIZE * SIZE / 2 + SIZE / 2) as usize];
    let moving = |phase| nertca_view { component: NERTCA_COMPONENT_DYNAMIC, ..view(phase) };
    assert!(middle(drawn(estimating, &moving(0))) > 0.0, "the vessel is seen");
    let third = frame(0, 2, &image);
    assert_eq!(unsafe { nertca_reconstruction_add_frame(given, &third) }, NERTCA_ERROR_ARGUMENT, "no third phase");
    close(context, &[estimating, given]);
}

#[test]
fn a_prior_is_taken_by_methods_that_use_it() {
    let context = context("device = none");
    let points = [0.0, 0.0, 0.0, 1.0, 0.0, 0.0];
    for (preset, status) in [("fast", NERTCA_OK), ("fast-mlp", NERTCA_ERROR_ARGUMENT)] {
        let made = reconstruction(context, &format!("phases = 10\npreset = {preset}"));
        assert_eq!(unsafe { nertca_reconstruction_set_prior(made, points.as_ptr(), 2) }, status, "{preset}");
        ok(unsafe { nertca_reconstruction_set_prior(made, null(), 0) }, made);
        ok(unsafe { nertca_reconstruction_destroy(made) }, null::<std::ffi::c_void>());
    }
    close(context, &[]);
}

#[test]
fn a_frame_at_the_r_peak_is_half_a_phase_before_the_first() {
    let context = context("device = none");
    let made = reconstruction(context, "phases = 10");
    let pixels = pixels(0, 0);
    let at = |time_s| nertca_frame { phase: -1, time_s, ..frame(0, 0, &pixels) };
    ok(unsafe { nertca_reconstruction_add_frame(made, &at(1.0)) }, made);
    assert_eq!(uses(made, 0..1), [(0, NERTCA_USE_NO_PHASE, -1)]);
    let peaks = [1.0, 2.0, 3.0];
    ok(unsafe { nertca_reconstruction_set_r_peaks(made, peaks.as_ptr(), peaks.len()) }, made);
    let status = status_of(made, 0);
    assert_eq!((status.phase, status.after_phase), (0, -0.5));
    let phase_of = |time_s| {
        let mut phase = f64::NAN;
        ok(unsafe { nertca_reconstruction_beat_phase(made, time_s, &mut phase) }, made);
        phase
    };
    assert_eq!(phase_of(2.0), 9.5);
    // The end of systole, after 310 ms, is at 35 % of the ten phases.
    assert!((phase_of(2.31) - 3.0).abs() < 1e-6, "{}", phase_of(2.31));
    ok(unsafe { nertca_reconstruction_set_r_peaks(made, null(), 0) }, made);
    assert_eq!(status_of(made, 0).usage, NERTCA_USE_NO_PHASE, "R-peaks are cleared");
    let mut phase = 7.0;
    let status = unsafe { nertca_reconstruction_beat_phase(made, 2.0, &mut phase) };
    assert_eq!((status, phase), (NERTCA_ERROR_NOT_READY, 7.0));
    close(context, &[made]);
}

#[test]
fn pictures_between_phases_lie_between_theirs() {
    let context = context("validation = true");
    let made = reconstruction(context, &format!("{SMALL}\ngaussians.form = deformable"));
    add_frames(made, 0..3);
    train(made, 60);
    for quality in [NERTCA_QUALITY_LIVE, NERTCA_QUALITY_EXACT] {
        let at = |phase, after_phase, component| {
            drawn(made, &nertca_view { after_phase, quality, component, ..view(phase) })
        };
        let moving = |phase, after_phase| at(phase, after_phase, NERTCA_COMPONENT_DYNAMIC);
        let far = |a: &[f32], b: &[f32]| a.iter().zip(b).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
        let (first, next) = (moving(0, 0.0), moving(1, 0.0));
        let apart = far(&first, &next);
        assert!(apart > 0.01, "the vessel moves: {apart}");
        assert!(far(&moving(0, 1e-3), &first) < 0.05 * apart && far(&moving(0, 1.0 - 1e-3), &next) < 0.05 * apart);
        let middle = moving(0, 0.5);
        assert!(far(&middle, &first) > 0.1 * apart && far(&middle, &next) > 0.1 * apart, "it is between");
        // The beat closes.
        assert!(far(&moving(PHASES - 1, 1.0 - 1e-3), &first) < 0.05 * apart);
        let sum: Vec<f32> = at(0, 0.0, NERTCA_COMPONENT_STATIC).iter().zip(&middle).map(|(s, d)| s + d).collect();
        assert!(far(&at(0, 0.5, NERTCA_COMPONENT_TOTAL), &sum) < 1e-4, "the static field does not move");
    }
    // Volumes have whole phases.
    let mip = nertca_view { after_phase: 0.5, projection: NERTCA_PROJECTION_MIP, ..view(0) };
    let mut pixels = vec![0f32; (SIZE * SIZE) as usize];
    let status = unsafe { nertca_reconstruction_render(made, &mip, &image(&mut pixels)) };
    assert_eq!(status, NERTCA_ERROR_ARGUMENT);
    assert!(last_error(made).contains("between two phases"), "{}", last_error(made));
    // A caller of an earlier header does not know the field, whose bytes are then not read.
    let old = std::mem::offset_of!(nertca_view, after_phase);
    let earlier = nertca_view { size: old, after_phase: f64::NAN, ..view(1) };
    assert_eq!(drawn(made, &earlier), drawn(made, &view(1)));
    close(context, &[made]);
}

#[test]
fn the_drawn_field_tells_its_frames_and_its_moment() {
    let context = context("validation = true\ndeterministic = true");
    let made = reconstruction(context, SMALL);
    let mut told = nertca_drawn { size: size_of::<nertca_drawn>(), ..zeroed() };
    assert_eq!(unsafe { nertca_reconstruction_drawn(made, &mut told) }, NERTCA_ERROR_NOT_READY);
    add_frames(made, 0..2);
    train(made, 60);
    drawn(made, &view(0));
    ok(unsafe { nertca_reconstruction_drawn(made, &mut told) }, made);
    assert_eq!((told.frames, told.step), (6, 60));
    let saved = bytes_of(made);
    let loaded = reconstruction(context, SMALL);
    ok(unsafe { nertca_reconstruction_load_memory(loaded, saved.as_ptr().cast(), saved.len()) }, loaded);
    drawn(loaded, &view(0));
    ok(unsafe { nertca_reconstruction_drawn(loaded, &mut told) }, loaded);
    assert_eq!((told.frames, told.step), (0, 60), "a checkpoint does not say how many frames it had");
    close(context, &[made, loaded]);
}
