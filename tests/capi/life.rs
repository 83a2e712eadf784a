//! Guarantees of the C ABI: formats, gating, determinism, limits, many threads.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::undocumented_unsafe_blocks, reason = "tests of C functions")]

use crate::c_scene::*;
use nertca_vk::scan::gating::{SYSTOLE_S, SYSTOLE_SHARE};
use nertca_vk_abi::calibration::*;
use nertca_vk_abi::context::*;
use nertca_vk_abi::output::*;
use nertca_vk_abi::reconstruction::*;
use nertca_vk_abi::status::*;
use nertca_vk_abi::training::*;
use nertca_vk_abi::truth::*;
use nertca_vk_abi::types::*;
use std::ffi::{CString, c_char, c_void};
use std::ptr::{null, null_mut};
use std::sync::atomic::{AtomicU32, Ordering};
use std::time::Duration;

fn bytes_of(reconstruction: *mut nertca_reconstruction) -> Vec<u8> {
    let mut length = 0;
    ok(unsafe { nertca_reconstruction_save_memory(reconstruction, null_mut(), 0, &mut length) }, reconstruction);
    loop {
        let mut bytes = vec![0u8; length];
        let to = bytes.as_mut_ptr().cast();
        let status = unsafe { nertca_reconstruction_save_memory(reconstruction, to, bytes.len(), &mut length) };
        // Training has continued in between, and its state has grown.
        if status == NERTCA_ERROR_BUFFER {
            assert!(length > bytes.len(), "{length} bytes are needed, {} were given", bytes.len());
            continue;
        }
        ok(status, reconstruction);
        bytes.truncate(length);
        return bytes;
    }
}

fn load(reconstruction: *mut nertca_reconstruction, bytes: &[u8]) {
    let status = unsafe { nertca_reconstruction_load_memory(reconstruction, bytes.as_ptr().cast(), bytes.len()) };
    ok(status, reconstruction);
}

fn exact(phase: u32, component: u32) -> nertca_view {
    nertca_view { quality: NERTCA_QUALITY_EXACT, component, ..view(phase) }
}

fn far(a: &[f32], b: &[f32]) -> f32 {
    let scale = b.iter().fold(1e-9f32, |m, v| m.max(v.abs()));
    a.iter().zip(b).map(|(a, b)| (a - b).abs() / scale).fold(0.0, f32::max)
}

/// Creates the frame of a view and phase and passes it on while its pixels are alive.
type Prepare<'a> = dyn Fn(usize, u32, &mut dyn FnMut(&nertca_frame)) + 'a;

#[test]
fn pixel_formats_strides_and_intensities_mean_the_same() {
    let context = context("validation = true\ndeterministic = true");
    // 16-bit codes that all formats can carry exactly.
    let codes = |view, phase| pixels(view, phase).iter().map(|v| (v * 10_000.0) as u16).collect::<Vec<_>>();
    let checkpoint = |prepare: &Prepare<'_>| {
        let made = reconstruction(context, SMALL);
        for view in 0..3 {
            for phase in 0..PHASES {
                prepare(view, phase, &mut |frame| {
                    ok(unsafe { nertca_reconstruction_add_frame(made, frame) }, made);
                });
            }
        }
        train(made, 3);
        let bytes = bytes_of(made);
        ok(unsafe { nertca_reconstruction_destroy(made) }, made);
        bytes
    };
    let floats = checkpoint(&|view, phase, add| {
        let pixels: Vec<f32> = codes(view, phase).iter().map(|c| f32::from(*c)).collect();
        add(&nertca_frame { scale: 1e-4, ..frame(view, phase, &pixels) });
    });
    let shorts = checkpoint(&|view, phase, add| {
        // Rows are 7 pixels longer than the image's width.
        let mut padded = Vec::new();
        for row in codes(view, phase).chunks(SIZE as usize) {
            padded.extend_from_slice(row);
            padded.extend([u16::MAX; 7]);
        }
        add(&nertca_frame {
            pixels: padded.as_ptr().cast(),
            pixels_bytes: 2 * padded.len(),
            stride_bytes: 2 * (SIZE as usize + 7),
            format: NERTCA_PIXELS_U16,
            scale: 1e-4,
            ..frame(view, phase, &[])
        });
    });
    assert_eq!(floats, shorts, "16-bit frames with a stride");
    let log = checkpoint(&|view, phase, add| {
        let inverted: Vec<u16> = codes(view, phase).iter().map(|c| 20_000 - c).collect();
        add(&nertca_frame {
            pixels: inverted.as_ptr().cast(),
            pixels_bytes: 2 * inverted.len(),
            format: NERTCA_PIXELS_U16,
            intensity: NERTCA_INTENSITY_LOG,
            i0: 20_000.0,
            scale: 1e-4,
            ..frame(view, phase, &[])
        });
    });
    let (a, b) = (reconstruction(context, SMALL), reconstruction(context, SMALL));
    load(a, &floats);
    load(b, &log);
    let (of_a, of_b) = (drawn(a, &exact(1, NERTCA_COMPONENT_TOTAL)), drawn(b, &exact(1, NERTCA_COMPONENT_TOTAL)));
    assert!(far(&of_a, &of_b) < 1e-3, "a logarithmic detector: {}", far(&of_a, &of_b));
    close(context, &[a, b]);
}

#[test]
fn a_reconstruction_lives_from_frames_to_scores() {
    let context = context("validation = true");
    let settings = SMALL.replace("march.render_samples = 32", "march.render_samples = 256");
    let made = reconstruction(context, &settings);
    add_frames(made, 0..3);
    let pixels_of = pixels(1, 2);
    let mask: Vec<u8> = pixels_of.iter().map(|p| u8::from(*p > 1.1)).collect();
    let unseen = nertca_frame {
        split: NERTCA_SPLIT_VALIDATION,
        mask: mask.as_ptr(),
        mask_bytes: mask.len(),
        ..frame(1, 2, &pixels_of)
    };
    ok(unsafe { nertca_reconstruction_add_frame(made, &unseen) }, made);
    assert_eq!(train(made, 40), 40);
    assert_eq!(train(made, 40), 20, "the run has 60 iterations");
    assert_eq!(train(made, 40), 0);
    // Live quality shows the fields, except for the resolution of its cells; both use the same parameters.
    for component in [NERTCA_COMPONENT_TOTAL, NERTCA_COMPONENT_STATIC, NERTCA_COMPONENT_DYNAMIC] {
        let live = drawn(made, &nertca_view { component, ..view(2) });
        let fields = drawn(made, &exact(2, component));
        assert!(far(&live, &fields) < 0.15, "component {component}: {}", far(&live, &fields));
        assert!(fields.iter().any(|p| *p > 0.0));
    }
    let total = drawn(made, &exact(2, NERTCA_COMPONENT_TOTAL));
    let parts = [NERTCA_COMPONENT_STATIC, NERTCA_COMPONENT_DYNAMIC].map(|c| drawn(made, &exact(2, c)));
    let sum: Vec<f32> = parts[0].iter().zip(&parts[1]).map(|(s, d)| s + d).collect();
    assert!(far(&total, &sum) < 1e-5);
    // An 8-bit image with a stride; the bytes between rows are left unchanged.
    let apart = SIZE as usize + 5;
    let mut codes = vec![77u8; apart * SIZE as usize];
    let (low, high) = (0.0, f64::from(total.iter().fold(0f32, |m, v| m.max(*v))));
    let eight_bits = nertca_image {
        size: size_of::<nertca_image>(),
        pixels: codes.as_mut_ptr().cast(),
        pixels_bytes: codes.len(),
        stride_bytes: apart,
        format: NERTCA_PIXELS_U8,
        low,
        high,
    };
    ok(unsafe { nertca_reconstruction_render(made, &exact(2, NERTCA_COMPONENT_TOTAL), &eight_bits) }, made);
    for (row, shown) in codes.chunks(apart).zip(total.chunks(SIZE as usize)) {
        assert_eq!(row[SIZE as usize..], [77; 5]);
        for (code, value) in row.iter().zip(shown) {
            assert!((f64::from(*code) - 255.0 * f64::from(*value) / high).abs() <= 1.0);
        }
    }
    // The volume's integral equals the picture: sums over left, for an almost parallel view from the patient's left. The
    // grid is fine enough for sums of Gaussians, which are sharper than a cell of a coarse grid.
    let n = 96u32;
    let grid = nertca_grid {
        size: size_of::<nertca_grid>(),
        origin_mm: [-60.0; 3],
        spacing_mm: [120.0 / f64::from(n - 1); 3],
        points: [n; 3],
        component: NERTCA_COMPONENT_DYNAMIC,
        phase: 2,
    };
    let mut cells = vec![f32::NAN; (n * n * n) as usize];
    ok(unsafe { nertca_reconstruction_sample(made, &grid, cells.as_mut_ptr(), cells.len()) }, made);
    let (sid, sod) = (50_000.0, 49_000.0);
    let lateral = nertca_view {
        geometry: nertca_geometry {
            primary_deg: 90.0,
            secondary_deg: 0.0,
            sid_mm: sid,
            sod_mm: sod,
            pixel_mm: [120.0 / f64::from(n) * sid / sod; 2],
            ..geometry(0)
        },
        width: n,
        height: n,
        ..exact(2, NERTCA_COMPONENT_DYNAMIC)
    };
    let picture = drawn(made, &lateral);
    // Columns run along posterior (towards the image's right at LAO 90), rows from superior to inferior.
    let step = 120.0 / (n - 1) as f32;
    let summed =
        |p: usize, s: usize| (0..n as usize).map(|l| cells[(s * n as usize + p) * n as usize + l]).sum::<f32>() * step;
    let all: f32 = picture.iter().sum();
    let mean = |of: &dyn Fn(usize, usize) -> f32, weight: &dyn Fn(usize, usize) -> f32| {
        let pairs = (0..n as usize).flat_map(|j| (0..n as usize).map(move |i| (i, j)));
        pairs.map(|(i, j)| of(i, j) * weight(i, j)).sum::<f32>()
    };
    let volume: f32 = mean(&|p, s| summed(p, s), &|_, _| 1.0);
    assert!(all > 0.5, "there is something to see: {all}");
    assert!((volume / all - 1.0).abs() < 0.1, "sum of the volume {volume}, of the picture {all}");
    // The centres of mass are compared: posterior with columns, superior with rows.
    let half = (n - 1) as f32 / 2.0;
    let across = mean(&|i, j| picture[j * n as usize + i], &|i, _| i as f32 - half) / all;
    let down = mean(&|i, j| picture[j * n as usize + i], &|_, j| j as f32 - half) / all;
    let posterior = mean(&|p, s| summed(p, s), &|p, _| p as f32 - half) / volume;
    let superior = mean(&|p, s| summed(p, s), &|_, s| s as f32 - half) / volume;
    assert!(
        (across.abs() - posterior.abs()).abs() < 1.0 && (down + superior).abs() < 1.0,
        "picture at ({across}, {down}), volume at posterior {posterior}, superior {superior}"
    );
    let mut scores = nertca_scores { size: size_of::<nertca_scores>(), ..zeroed() };
    ok(unsafe { nertca_reconstruction_evaluate(made, 0.0, &mut scores) }, made);
    assert_eq!((scores.step, scores.images), (60, 1));
    assert!(scores.psnr_db > 5.0 && (0.0..=1.0).contains(&scores.dice_dynamic), "{}", scores.psnr_db);
    assert!((scores.threshold_per_mm - 0.01 / 5.0).abs() < 1e-9);
    close(context, &[made]);
}

#[test]
fn saved_and_continued_is_as_if_never_stopped_and_runs_repeat() {
    let context = context("validation = true\ndeterministic = true");
    let once = reconstruction(context, SMALL);
    add_frames(once, 0..3);
    train(once, 30);
    let halfway = bytes_of(once);
    train(once, 20);
    let straight = bytes_of(once);

    let again = reconstruction(context, SMALL);
    add_frames(again, 0..3);
    train(again, 50);
    assert_eq!(bytes_of(again), straight, "the same calls give the same bytes");

    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("half way ü.safetensors");
    std::fs::write(&path, &halfway).unwrap();
    let resumed = reconstruction(context, SMALL);
    add_frames(resumed, 0..3);
    let path = CString::new(path.to_str().unwrap()).unwrap();
    ok(unsafe { nertca_reconstruction_load(resumed, path.as_ptr()) }, resumed);
    train(resumed, 20);
    assert_eq!(bytes_of(resumed), straight, "as if never stopped");
    ok(unsafe { nertca_reconstruction_save(resumed, path.as_ptr()) }, resumed);

    // These calls are refused by a deterministic context.
    ok(unsafe { nertca_reconstruction_start(resumed, None, null_mut()) }, resumed);
    let more = pixels(0, 0);
    let status = unsafe { nertca_reconstruction_add_frame(resumed, &frame(0, 0, &more)) };
    assert!(status == NERTCA_ERROR_BUSY || status == NERTCA_OK && progress(resumed).state == NERTCA_STATE_FINISHED);
    ok(nertca_reconstruction_stop(resumed), resumed);
    close(context, &[once, again, resumed]);
}

fn progress(reconstruction: *mut nertca_reconstruction) -> nertca_progress {
    let mut progress = nertca_progress { size: size_of::<nertca_progress>(), ..zeroed() };
    ok(unsafe { nertca_reconstruction_progress(reconstruction, &mut progress) }, reconstruction);
    progress
}

fn correction(reconstruction: *mut nertca_reconstruction, frame: u32) -> nertca_correction {
    let mut correction = nertca_correction { size: size_of::<nertca_correction>(), ..zeroed() };
    ok(unsafe { nertca_reconstruction_correction(reconstruction, frame, &mut correction) }, reconstruction);
    correction
}

#[test]
fn geometry_is_told_and_can_be_known_better_later() {
    let context = context("validation = true\ndeterministic = true");
    let as_stated = format!("{SMALL}\ncalibrate.mode = off");
    let [corrected, given] = [(); 2].map(|()| reconstruction(context, &as_stated));
    for view in 0..3 {
        for phase in 0..PHASES {
            let pixels = pixels(view, phase);
            let wrong = nertca_geometry { primary_deg: 10.0 * f64::from(phase), ..geometry(view) };
            let frame = nertca_frame { geometry: wrong, ..frame(view, phase, &pixels) };
            ok(unsafe { nertca_reconstruction_add_frame(corrected, &frame) }, corrected);
        }
    }
    for index in 0..9 {
        let geometry = geometry(index as usize / 3);
        ok(unsafe { nertca_reconstruction_set_geometry(corrected, index, &geometry) }, corrected);
    }
    add_frames(given, 0..3);
    train(corrected, 3);
    train(given, 3);
    let (a, b) = (drawn(corrected, &exact(1, NERTCA_COMPONENT_TOTAL)), drawn(given, &exact(1, NERTCA_COMPONENT_TOTAL)));
    assert_eq!(a, b, "frames whose geometry was stated anew");
    // The matrix describes the geometry: rendering by it equals rendering by the C-arm.
    let seen = correction(corrected, 4);
    assert_eq!((seen.kind, seen.heart_shift_mm), (NERTCA_CORRECTION_STATED, [0.0; 3]));
    let by_angles = nertca_view { geometry: geometry(1), ..exact(1, NERTCA_COMPONENT_TOTAL) };
    let matrix = nertca_geometry { size: by_angles.geometry.size, matrix: seen.matrix.as_ptr().cast(), ..zeroed() };
    let by_matrix = nertca_view { geometry: matrix, ..by_angles };
    let away = far(&drawn(corrected, &by_matrix), &drawn(corrected, &by_angles));
    assert!(away < 1e-4, "drawn by its matrix, a view differs by {away}");
    assert!(far(&drawn(corrected, &by_matrix), &a) > 0.01, "two views differ");
    close(context, &[corrected, given]);
}

/// The corner of an image that a small off-centre detector sees, and its geometry.
fn corner_of(view: usize, phase: u32, [columns, rows]: [u32; 2]) -> (Vec<f32>, nertca_geometry) {
    let first = SIZE - columns;
    let kept = |p: &usize| *p as u32 % SIZE >= first && (*p as u32 / SIZE) < rows;
    let all = pixels(view, phase);
    let pixels = (0..all.len()).filter(kept).map(|p| all[p]).collect();
    let of = geometry(view);
    let middle = [0.5 * f64::from(SIZE + first), 0.5 * f64::from(rows)];
    let moved = [0, 1].map(|k| (middle[k] - 0.5 * f64::from(SIZE)) * of.pixel_mm[k]);
    (pixels, nertca_geometry { offset_mm: [of.offset_mm[0] + moved[0], of.offset_mm[1] + moved[1]], ..of })
}

#[test]
fn frames_of_different_sizes_go_together() {
    let context = context("validation = true\ndeterministic = true");
    let as_stated = format!("{SMALL}\ncalibrate.mode = off");
    let [whole, mixed] = [(); 2].map(|()| reconstruction(context, &as_stated));
    let add = |to, view, phase, size: [u32; 2], split| {
        let (pixels, geometry) = corner_of(view, phase, size);
        let mask: Vec<u8> = pixels.iter().map(|p| u8::from(*p > 1.1)).collect();
        let frame = nertca_frame {
            geometry,
            width: size[0],
            height: size[1],
            split,
            mask: mask.as_ptr(),
            mask_bytes: mask.len(),
            ..frame(view, phase, &pixels)
        };
        ok(unsafe { nertca_reconstruction_add_frame(to, &frame) }, to);
    };
    // A frame without a known phase, and larger than all first training images.
    let image = pixels(0, 0);
    let stamped = nertca_frame { phase: -1, time_s: 1.0, ..frame(0, 0, &image) };
    ok(unsafe { nertca_reconstruction_add_frame(mixed, &stamped) }, mixed);
    let (small, large, train_on, score) = ([17, 14], [SIZE; 2], NERTCA_SPLIT_TRAIN, NERTCA_SPLIT_VALIDATION);
    for phase in 0..PHASES {
        (0..2).for_each(|view| add(mixed, view, phase, small, train_on));
        (0..3).for_each(|view| add(whole, view, phase, large, train_on));
    }
    train(mixed, 5);
    // Larger images are added later; a small one is scored.
    (0..PHASES).for_each(|phase| add(mixed, 2, phase, large, train_on));
    add(mixed, 2, 1, small, score);
    train(mixed, 40);
    train(whole, 40);
    // A cropped frame keeps its place, three columns further to the left.
    let (seen, was) = (correction(mixed, 2).matrix, correction(whole, 1).matrix);
    let scale = was.iter().flatten().fold(0f64, |m, v| m.max(v.abs()));
    for k in 0..4 {
        let expected = [was[0][k] - 3.0 * was[2][k], was[1][k], was[2][k]];
        (0..3).for_each(|r| assert!((seen[r][k] - expected[r]).abs() < 1e-9 * scale, "row {r}, column {k}"));
    }
    let mut scores = nertca_scores { size: size_of::<nertca_scores>(), ..zeroed() };
    ok(unsafe { nertca_reconstruction_evaluate(mixed, 0.0, &mut scores) }, mixed);
    let (pixels, geometry) = corner_of(2, 1, small);
    let as_small = nertca_view { geometry, width: small[0], height: small[1], ..exact(1, NERTCA_COMPONENT_TOTAL) };
    let drawn = drawn(mixed, &as_small);
    let [low, high] = pixels.iter().fold([f32::MAX, f32::MIN], |[l, h], v| [l.min(*v), h.max(*v)]);
    let squared = pixels.iter().zip(&drawn).map(|(a, b)| f64::from((a - b) / (high - low)).powi(2)).sum::<f64>();
    let psnr = -10.0 * (squared / pixels.len() as f64).log10();
    println!("PSNR {} of the small frame, {psnr} by hand", scores.psnr_db);
    assert_eq!(scores.images, 1);
    assert!((scores.psnr_db - psnr).abs() < 1e-3, "{} is not {psnr}, of the small frame alone", scores.psnr_db);
    close(context, &[whole, mixed]);
}

#[test]
fn time_stamps_and_r_peaks_give_phases() {
    let context = context("validation = true\ndeterministic = true");
    let stamped = reconstruction(context, SMALL);
    for view in 0..3 {
        for phase in 0..PHASES {
            let pixels = pixels(view, phase);
            // The time is the middle of the phase, in different beats of 0.8 s, with the second R-peak at 1.0 s.
            let share = (f64::from(phase) + 0.5) / f64::from(PHASES);
            let since_r_s = if share < SYSTOLE_SHARE {
                SYSTOLE_S * share / SYSTOLE_SHARE
            } else {
                SYSTOLE_S + (0.8 - SYSTOLE_S) * (share - SYSTOLE_SHARE) / (1.0 - SYSTOLE_SHARE)
            };
            let time_s = 0.2 + 0.8 * view as f64 + since_r_s;
            let frame = nertca_frame { phase: -1, time_s, ..frame(view, phase, &pixels) };
            ok(unsafe { nertca_reconstruction_add_frame(stamped, &frame) }, stamped);
        }
    }
    let status = unsafe { nertca_reconstruction_train(stamped, 1, None, null_mut(), null_mut()) };
    assert_eq!(status, NERTCA_ERROR_NOT_READY, "without R-peaks no phase is known");
    let peaks = [0.2, 1.0, 1.8];
    ok(unsafe { nertca_reconstruction_set_r_peaks(stamped, peaks.as_ptr(), peaks.len()) }, stamped);
    train(stamped, 3);
    let given = reconstruction(context, SMALL);
    add_frames(given, 0..3);
    train(given, 3);
    assert!(bytes_of(stamped) == bytes_of(given), "the same frames by time and by phase");
    close(context, &[stamped, given]);
}

/// Waits for an expected event on a possibly busy machine; exceeding the limit is a failure.
#[track_caller]
fn wait_until(what: &str, come: impl Fn() -> bool) {
    const PATIENCE: Duration = Duration::from_secs(900);
    let began = std::time::Instant::now();
    while !come() {
        assert!(began.elapsed() < PATIENCE, "{what}: not within {PATIENCE:?}");
        std::thread::sleep(Duration::from_millis(5));
    }
}

#[test]
fn frames_come_in_while_training_goes_on() {
    let context = context("validation = true");
    let live = reconstruction(context, &SMALL.replace("train.iterations = 60", "train.iterations = 100000"));
    ok(unsafe { nertca_reconstruction_start(live, None, null_mut()) }, live);
    for view in 0..3 {
        add_frames(live, view..view + 1);
        std::thread::sleep(Duration::from_millis(50));
    }
    wait_until("all frames taken in", || progress(live).frames == 9 && progress(live).step >= 10);
    assert_eq!(progress(live).state, NERTCA_STATE_RUNNING);
    ok(nertca_reconstruction_pause(live), live);
    wait_until("a pause", || progress(live).state == NERTCA_STATE_PAUSED);
    let held = progress(live).step;
    drawn(live, &view(1));
    std::thread::sleep(Duration::from_millis(100));
    assert_eq!(progress(live).step, held, "paused is paused");
    ok(nertca_reconstruction_resume(live), live);
    let mut ended = 7;
    ok(unsafe { nertca_reconstruction_wait(live, 200, &mut ended) }, live);
    assert_eq!(ended, 0);
    wait_until("training after the pause", || progress(live).step > held);
    ok(nertca_reconstruction_stop(live), live);
    ok(unsafe { nertca_reconstruction_wait(live, 0, &mut ended) }, live);
    assert_eq!((ended, progress(live).state), (1, NERTCA_STATE_IDLE));
    close(context, &[live]);
}

/// A handle shared between threads, as the header permits.
#[derive(Clone, Copy)]
struct Shared(*mut nertca_reconstruction);
unsafe impl Send for Shared {}
unsafe impl Sync for Shared {}

impl Shared {
    fn get(self) -> *mut nertca_reconstruction {
        self.0
    }
}

unsafe extern "C" fn after(progress: *const nertca_progress, user: *mut c_void) -> i32 {
    let limit = unsafe { &*user.cast::<AtomicU32>() };
    i32::from(unsafe { (*progress).step } >= limit.load(Ordering::Relaxed))
}

#[test]
fn threads_draw_save_and_cancel_while_two_reconstructions_train() {
    let context = context("validation = true");
    let endless = SMALL.replace("train.iterations = 60", "train.iterations = 100000");
    let both = [reconstruction(context, &endless), reconstruction(context, &endless)];
    both.iter().for_each(|r| add_frames(*r, 0..3));
    const ROUNDS: u32 = 6;
    let drawings = AtomicU32::new(0);
    let mut pauses = 1u64;
    for round in 0..ROUNDS {
        let limits = [AtomicU32::new(u32::MAX), AtomicU32::new(u32::MAX)];
        for (r, limit) in both.iter().zip(&limits) {
            let user = std::ptr::from_ref(limit).cast_mut().cast();
            ok(unsafe { nertca_reconstruction_start(*r, Some(after), user) }, *r);
        }
        std::thread::scope(|scope| {
            for (thread, r) in both.iter().chain(&both).map(|r| Shared(*r)).enumerate() {
                let drawings = &drawings;
                scope.spawn(move || {
                    for phase in 0..PHASES {
                        let mut pixels = vec![0f32; (SIZE * SIZE) as usize];
                        let view = nertca_view { component: phase % 3, quality: (thread % 2) as u32, ..view(phase) };
                        let mut status = NERTCA_ERROR_NOT_READY;
                        while status == NERTCA_ERROR_NOT_READY {
                            std::thread::sleep(Duration::from_millis(1));
                            status = unsafe { nertca_reconstruction_render(r.get(), &view, &image(&mut pixels)) };
                        }
                        ok(status, r.get());
                        drawings.fetch_add(1, Ordering::Relaxed);
                        if thread == 3 {
                            assert!(bytes_of(r.get()).len() > 1000);
                        }
                    }
                });
            }
            // After the first iteration, rendering always succeeds.
            wait_until("training", || both.iter().all(|r| progress(*r).step > 0));
            // Training ends at a different moment every time, by the callback or by a stop.
            pauses = pauses.wrapping_mul(6_364_136_223_846_793_005) % 997;
            std::thread::sleep(Duration::from_millis(20 + pauses % 150));
            limits.iter().for_each(|limit| limit.store(0, Ordering::Relaxed));
            if round % 2 == 0 {
                both.iter().for_each(|r| ok(nertca_reconstruction_stop(*r), *r));
            }
        });
        for r in both {
            let mut ended = 0;
            ok(unsafe { nertca_reconstruction_wait(r, u32::MAX, &mut ended) }, r);
            assert_eq!(ended, 1);
            let state = progress(r).state;
            assert!([NERTCA_STATE_CANCELLED, NERTCA_STATE_IDLE].contains(&state), "state {state}");
        }
    }
    assert_eq!(drawings.load(Ordering::Relaxed), ROUNDS * 4 * PHASES);
    // Destroying a reconstruction in training stops it first.
    ok(unsafe { nertca_reconstruction_start(both[0], None, null_mut()) }, both[0]);
    close(context, &both);
}

struct Within {
    reconstruction: *mut nertca_reconstruction,
    context: *mut nertca_context,
    seen: AtomicU32,
}

unsafe extern "C" fn meddle(_: *const nertca_progress, user: *mut c_void) -> i32 {
    let within = unsafe { &*user.cast::<Within>() };
    let r = within.reconstruction;
    assert_eq!(unsafe { nertca_reconstruction_destroy(r) }, NERTCA_ERROR_BUSY);
    assert_eq!(unsafe { nertca_context_destroy(within.context) }, NERTCA_ERROR_BUSY);
    if std::thread::current().name() == Some("nertca-train") {
        assert_eq!(nertca_reconstruction_stop(r), NERTCA_ERROR_BUSY);
        assert_eq!(unsafe { nertca_reconstruction_start(r, None, null_mut()) }, NERTCA_ERROR_BUSY);
        assert_eq!(unsafe { nertca_reconstruction_train(r, 1, None, null_mut(), null_mut()) }, NERTCA_ERROR_BUSY);
    }
    drawn(r, &view(0));
    within.seen.fetch_add(1, Ordering::Relaxed);
    i32::from(within.seen.load(Ordering::Relaxed) >= 3)
}

#[test]
fn a_callback_may_draw_but_not_destroy() {
    let context = context("validation = true");
    let made = reconstruction(context, SMALL);
    add_frames(made, 0..3);
    let within = Within { reconstruction: made, context, seen: AtomicU32::new(0) };
    let user = std::ptr::from_ref(&within).cast_mut().cast();
    let mut done = 77;
    let status = unsafe { nertca_reconstruction_train(made, 50, Some(meddle), user, &mut done) };
    assert_eq!(status, NERTCA_ERROR_CANCELLED);
    assert!((3..50).contains(&done), "{done}");
    ok(unsafe { nertca_reconstruction_start(made, Some(meddle), user) }, made);
    let mut ended = 0;
    ok(unsafe { nertca_reconstruction_wait(made, 30_000, &mut ended) }, made);
    assert_eq!((ended, progress(made).state), (1, NERTCA_STATE_CANCELLED));
    close(context, &[made]);
}

#[test]
fn memory_has_a_ceiling() {
    let limited = context("memory_limit_mib = 4");
    let made = reconstruction(limited, &SMALL.replace("train.chunk_samples = 1024", "train.chunk_samples = 262144"));
    add_frames(made, 0..3);
    let status = unsafe { nertca_reconstruction_train(made, 1, None, null_mut(), null_mut()) };
    assert_eq!(status, NERTCA_ERROR_MEMORY);
    assert!(last_error(made).contains("limit of 4194304"), "{}", last_error(made));
    close(limited, &[made]);
    let enough = context("memory_limit_mib = 64");
    let made = reconstruction(enough, SMALL);
    add_frames(made, 0..3);
    train(made, 2);
    close(enough, &[made]);
}

unsafe extern "C" fn count(level: u32, text: *const c_char, user: *mut c_void) {
    assert!((1..=3).contains(&level) && !text.is_null());
    unsafe { &*user.cast::<AtomicU32>() }.fetch_add(1, Ordering::Relaxed);
}

#[test]
fn each_context_has_its_own_log() {
    let counts = [AtomicU32::new(0), AtomicU32::new(0)];
    let open = |count_in: &AtomicU32, level| {
        let user = std::ptr::from_ref(count_in).cast_mut().cast();
        let log = nertca_log { size: size_of::<nertca_log>(), callback: Some(count), user, level };
        let mut context = null_mut();
        ok(unsafe { nertca_context_create(null(), &log, &mut context) }, null::<c_void>());
        context
    };
    let talkative = open(&counts[0], 3);
    let quiet = open(&counts[1], 1);
    let before = counts[0].load(Ordering::Relaxed);
    assert!(before > 0, "the device and its paths are told");
    for context in [talkative, quiet] {
        let made = reconstruction(context, SMALL);
        add_frames(made, 0..3);
        train(made, 1);
        close(context, &[made]);
    }
    assert!(counts[0].load(Ordering::Relaxed) > before);
    assert_eq!(counts[1].load(Ordering::Relaxed), 0);
}

#[test]
fn texts_are_kept_by_handle_and_thread() {
    let context = context("device = none");
    let made = reconstruction(context, "phases = 2");
    assert_eq!(unsafe { nertca_reconstruction_train(made, 1, None, null_mut(), null_mut()) }, NERTCA_ERROR_DEVICE);
    assert!(last_error(made).contains("without a device"));
    assert_eq!(last_error(context), "", "texts are kept by handle");
    let heard = std::thread::scope(|s| {
        let shared = Shared(made);
        s.spawn(move || last_error(shared.get())).join().unwrap()
    });
    assert_eq!(heard, "", "and by thread");
    close(context, &[made]);
}
