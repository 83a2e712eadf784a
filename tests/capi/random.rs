//! Random sequences of calls, with random arguments and handles that are alive, stale, foreign or invented: nothing
//! crashes, nothing leaks, and the validation layers report nothing. `NERTCA_RANDOM_SEQUENCES` and
//! `NERTCA_RANDOM_DEVICE_SEQUENCES` set the numbers of sequences; a failure names its seed, and `NERTCA_RANDOM_SEED`
//! repeats it.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::undocumented_unsafe_blocks, reason = "tests of C functions")]

use crate::c_scene::*;
use nertca_vk_abi::boundary::nertca_last_error;
use nertca_vk_abi::calibration::*;
use nertca_vk_abi::context::*;
use nertca_vk_abi::output::*;
use nertca_vk_abi::reconstruction::*;
use nertca_vk_abi::status::*;
use nertca_vk_abi::training::*;
use nertca_vk_abi::truth::*;
use nertca_vk_abi::types::*;
use std::ffi::CString;
use std::ptr::{null, null_mut, without_provenance_mut};

/// SplitMix64.
struct Random(u64);

impl Random {
    fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^ (z >> 31)
    }

    fn below(&mut self, n: usize) -> usize {
        (self.next() % n as u64) as usize
    }

    /// Returns one of the choices.
    fn pick<T: Copy>(&mut self, choices: &[T]) -> T {
        choices[self.below(choices.len())]
    }

    fn number(&mut self) -> f64 {
        let wild = [0.0, -1.0, 1.0, 0.5, 1e9, -1e9, f64::NAN, f64::INFINITY, f64::MIN_POSITIVE, 600.0, 1000.0];
        if self.below(4) == 0 { f64::from_bits(self.next()) } else { self.pick(&wild) }
    }
}

/// Objects that a sequence has created so far, alive or not.
struct Pool {
    random: Random,
    contexts: Vec<*mut nertca_context>,
    reconstructions: Vec<*mut nertca_reconstruction>,
    buffers: Vec<*mut nertca_buffer>,
    device: bool,
    /// Context kept from sequence to sequence, since opening a device takes long; a sequence may destroy it.
    base: Option<*mut nertca_context>,
    statuses: [u32; 32],
}

impl Pool {
    fn handle<H>(&mut self, alive: &[*mut H]) -> *mut H {
        match self.random.below(24) {
            0 => null_mut(),
            1 => without_provenance_mut(self.random.next() as usize),
            2 => self.contexts.first().map_or(null_mut(), |c| c.cast()),
            3 => self.reconstructions.first().map_or(null_mut(), |r| r.cast()),
            _ if alive.is_empty() => null_mut(),
            _ => alive[self.random.below(alive.len())],
        }
    }

    fn context(&mut self) -> *mut nertca_context {
        let all = self.contexts.clone();
        self.handle(&all)
    }

    fn reconstruction(&mut self) -> *mut nertca_reconstruction {
        let all = self.reconstructions.clone();
        self.handle(&all)
    }

    fn buffer(&mut self) -> *mut nertca_buffer {
        let all = self.buffers.clone();
        self.handle(&all)
    }

    /// A geometry that is mostly valid.
    fn geometry(&mut self) -> nertca_geometry {
        let mut g = geometry(self.random.below(3));
        match self.random.below(12) {
            0 => g.size = self.random.below(5000),
            1 => g.sid_mm = self.random.number(),
            2 => g.sod_mm = self.random.number(),
            3 => g.pixel_mm[0] = self.random.number(),
            4 => g.table_mm[1] = self.random.number(),
            5 => g.primary_deg = self.random.number(),
            _ => (),
        }
        g
    }

    fn step(&mut self) -> nertca_status {
        let n = self.random.below(31);
        match n {
            0 => {
                let options = if self.device {
                    [
                        "validation = true",
                        "validation = true\ndeterministic = true",
                        "device = none",
                        "memory_limit_mib = 1",
                    ]
                } else {
                    [
                        "device = none",
                        "{\"device\": \"none\"}",
                        "device = none\ndeterministic = true",
                        "device = none\nx = 1",
                    ]
                };
                let options = CString::new(self.random.pick(&options)).unwrap();
                let mut out = null_mut();
                let status = unsafe { nertca_context_create(options.as_ptr(), null(), &mut out) };
                if !out.is_null() {
                    self.contexts.push(out);
                }
                status
            }
            1 | 2 => {
                let context = self.context();
                let options = self.random.pick(&[
                    SMALL,
                    SMALL,
                    SMALL,
                    "phases = 2",
                    "phases = -1",
                    "",
                    "{}",
                    "phases = 3\nseed = 7",
                ]);
                let options = CString::new(options).unwrap();
                let mut out = null_mut();
                let status = unsafe { nertca_reconstruction_create(context, options.as_ptr(), &mut out) };
                if !out.is_null() {
                    self.reconstructions.push(out);
                }
                status
            }
            3..=9 => {
                let r = self.reconstruction();
                let (view, phase) = (self.random.below(3), self.random.below(4) as u32);
                let mut data = pixels(view, phase);
                if self.random.below(30) == 0 {
                    data[7] = f32::NAN;
                }
                let mut frame = frame(view, phase, &data);
                if self.random.below(4) == 0 {
                    frame.geometry = self.geometry();
                }
                match self.random.below(16) {
                    0 => frame.pixels_bytes = self.random.below(1600),
                    1 => frame.format = self.random.below(5) as u32,
                    2 => frame.stride_bytes = self.random.next() as usize,
                    3 => frame.width = self.random.below(30) as u32,
                    4 => frame.intensity = self.random.below(5) as u32,
                    5 => (frame.phase, frame.time_s) = (-1, self.random.number()),
                    6 => frame.split = self.random.below(3) as u32,
                    7 => frame.size = self.random.below(400),
                    8 => frame.scale = self.random.number(),
                    9 => frame.i0 = self.random.number(),
                    _ => (),
                }
                // The caller's guarantees must hold.
                frame.pixels_bytes = frame.pixels_bytes.min(size_of_val(&data[..]));
                if frame.size > size_of::<nertca_frame>() {
                    frame.size = size_of::<nertca_frame>();
                }
                if frame.geometry.size > size_of::<nertca_geometry>() {
                    frame.geometry.size = size_of::<nertca_geometry>();
                }
                unsafe { nertca_reconstruction_add_frame(r, &frame) }
            }
            10 if self.random.below(2) == 0 => {
                let points: Vec<f64> = (0..3 * self.random.below(4)).map(|_| self.random.number()).collect();
                unsafe { nertca_reconstruction_set_prior(self.reconstruction(), points.as_ptr(), points.len() / 3) }
            }
            10 => {
                let times: Vec<f64> = (0..self.random.below(4)).map(|i| i as f64 + self.random.number()).collect();
                unsafe { nertca_reconstruction_set_r_peaks(self.reconstruction(), times.as_ptr(), times.len()) }
            }
            11 | 12 => {
                let (r, iterations) = (self.reconstruction(), self.random.below(4) as u32);
                unsafe { nertca_reconstruction_train(r, iterations, None, null_mut(), null_mut()) }
            }
            13 => unsafe { nertca_reconstruction_start(self.reconstruction(), None, null_mut()) },
            14 => nertca_reconstruction_pause(self.reconstruction()),
            15 => nertca_reconstruction_resume(self.reconstruction()),
            16 => nertca_reconstruction_stop(self.reconstruction()),
            17 => unsafe { nertca_reconstruction_wait(self.reconstruction(), self.random.below(3) as u32, null_mut()) },
            18 | 19 => {
                let mut room = vec![0f32; (SIZE * SIZE) as usize];
                let image = image(&mut room);
                let mut view = view(self.random.below(4) as u32);
                if self.random.below(3) == 0 {
                    view.geometry = self.geometry();
                    view.geometry.size = size_of::<nertca_geometry>();
                }
                match self.random.below(8) {
                    0 => view.component = self.random.below(4) as u32,
                    1 => view.quality = self.random.below(3) as u32,
                    2 => view.projection = self.random.below(3) as u32,
                    3 => view.width = self.random.below(SIZE as usize + 3) as u32,
                    _ => (),
                }
                unsafe { nertca_reconstruction_render(self.reconstruction(), &view, &image) }
            }
            20 => {
                let mut room = [0f32; 125];
                let points = [0; 3].map(|_| self.random.below(7) as u32);
                let grid = nertca_grid {
                    size: size_of::<nertca_grid>(),
                    origin_mm: [self.random.number(), 0.0, -3.0],
                    spacing_mm: [1.0, self.random.number(), 2.0],
                    points,
                    component: self.random.below(4) as u32,
                    phase: self.random.below(4) as u32,
                };
                unsafe { nertca_reconstruction_sample(self.reconstruction(), &grid, room.as_mut_ptr(), room.len()) }
            }
            21 => {
                let mut scores = nertca_scores { size: size_of::<nertca_scores>(), ..zeroed() };
                let threshold = self.random.number();
                unsafe { nertca_reconstruction_evaluate(self.reconstruction(), threshold, &mut scores) }
            }
            22 => {
                // Copies a state from one into another, sometimes damaged.
                let (from, to) = (self.reconstruction(), self.reconstruction());
                let mut length = 0;
                let mut status = unsafe { nertca_reconstruction_save_memory(from, null_mut(), 0, &mut length) };
                if status == NERTCA_OK {
                    let mut bytes = vec![0u8; length + 1024];
                    status = unsafe {
                        nertca_reconstruction_save_memory(from, bytes.as_mut_ptr().cast(), bytes.len(), &mut length)
                    };
                    bytes.truncate(length.min(bytes.len()));
                    if self.random.below(2) == 0 && !bytes.is_empty() {
                        let at = self.random.below(bytes.len().min(4000));
                        bytes[at] ^= self.random.next() as u8;
                    }
                    status = status
                        .min(unsafe { nertca_reconstruction_load_memory(to, bytes.as_ptr().cast(), bytes.len()) });
                }
                status
            }
            23 => {
                let mut progress = nertca_progress { size: self.random.below(100), ..zeroed() };
                progress.size = progress.size.min(size_of::<nertca_progress>());
                unsafe { nertca_reconstruction_progress(self.reconstruction(), &mut progress) }
            }
            24 => {
                let mut out = null_mut();
                let bytes = self.random.pick(&[0, 64, 1600, u64::MAX]);
                let status = unsafe { nertca_buffer_create(self.context(), bytes, &mut out) };
                if !out.is_null() {
                    self.buffers.push(out);
                }
                status
            }
            25 => unsafe {
                let (r, buffer) = (self.reconstruction(), self.buffer());
                nertca_reconstruction_render_buffer(r, &view(0), buffer)
            },
            26 => match self.random.below(3) {
                0 => unsafe { nertca_reconstruction_destroy(self.reconstruction()) },
                1 => nertca_buffer_destroy(self.buffer()),
                _ => unsafe { nertca_context_destroy(self.context()) },
            },
            27 => {
                let mut correction = nertca_correction { size: self.random.below(300), ..zeroed() };
                correction.size = correction.size.min(size_of::<nertca_correction>());
                let (r, frame) = (self.reconstruction(), self.random.below(12) as u32);
                unsafe { nertca_reconstruction_correction(r, frame, &mut correction) }
            }
            28 => {
                let (r, frame, geometry) = (self.reconstruction(), self.random.below(12) as u32, self.geometry());
                match self.random.below(3) {
                    0 => unsafe { nertca_reconstruction_set_geometry(r, frame, &geometry) },
                    1 => unsafe { nertca_reconstruction_set_view_geometry(r, frame, &geometry) },
                    _ => nertca_reconstruction_remove_frame(r, frame),
                }
            }
            29 => {
                let (r, frame) = (self.reconstruction(), self.random.below(12) as u32);
                let mut status = nertca_frame_status { size: self.random.below(48), ..zeroed() };
                status.size = status.size.min(size_of::<nertca_frame_status>());
                let mut drawn = nertca_drawn { size: self.random.below(24), ..zeroed() };
                drawn.size = drawn.size.min(size_of::<nertca_drawn>());
                match self.random.below(4) {
                    0 => nertca_reconstruction_cancel(r),
                    1 => unsafe { nertca_reconstruction_beat_phase(r, self.random.number(), &mut 0.0) },
                    2 => unsafe { nertca_reconstruction_drawn(r, &mut drawn) },
                    _ => unsafe { nertca_reconstruction_frame_status(r, frame, &mut status) },
                }
            }
            _ => {
                let mut text = [0; 64];
                let size = self.random.below(65);
                let handle = self.reconstruction();
                unsafe { nertca_last_error(handle.cast(), text.as_mut_ptr(), size, null_mut()) }
            }
        }
    }

    fn run(&mut self, steps: usize) {
        for _ in 0..steps {
            let status = self.step();
            assert_ne!(status, NERTCA_ERROR_INTERNAL, "{}", last_error(null::<u8>()));
            self.statuses[-status as usize] += 1;
        }
        // All living objects can be destroyed, in the order that the header requires.
        for r in std::mem::take(&mut self.reconstructions) {
            let status = unsafe { nertca_reconstruction_destroy(r) };
            assert!([NERTCA_OK, NERTCA_ERROR_HANDLE].contains(&status), "{}", last_error(r));
        }
        for buffer in std::mem::take(&mut self.buffers) {
            nertca_buffer_destroy(buffer);
        }
        for context in std::mem::take(&mut self.contexts) {
            if Some(context) != self.base
                && unsafe { nertca_context_describe(context, null_mut(), 0, &mut 0) } == NERTCA_OK
            {
                close(context, &[]);
            }
        }
    }
}

fn sequences(device: bool, count: u64, steps: usize) {
    let given = std::env::var("NERTCA_RANDOM_SEED").ok().map(|s| s.parse::<u64>().unwrap());
    let mut pool = Pool {
        random: Random(0),
        contexts: Vec::new(),
        reconstructions: Vec::new(),
        buffers: Vec::new(),
        device,
        base: None,
        statuses: [0; 32],
    };
    for seed in given.map_or(0..count, |seed| seed..seed + 1) {
        pool.random = Random(seed.wrapping_mul(0x1234_5678_9abc_def1));
        let outcome = std::panic::catch_unwind(std::panic::AssertUnwindSafe(|| {
            // Most sequences need an object to work on.
            let options = if device { "validation = true" } else { "device = none" };
            let alive = |base: &*mut nertca_context| unsafe {
                nertca_context_describe(*base, null_mut(), 0, &mut 0) == NERTCA_OK
            };
            let base = *pool.base.insert(pool.base.filter(alive).unwrap_or_else(|| context(options)));
            pool.contexts.push(base);
            let first = reconstruction(pool.contexts[0], SMALL);
            pool.reconstructions.push(first);
            if device && pool.random.below(2) == 0 {
                add_frames(first, 0..3);
            }
            pool.run(steps);
        }));
        if let Err(panic) = outcome {
            eprintln!("sequence {seed} (NERTCA_RANDOM_SEED={seed})");
            std::panic::resume_unwind(panic);
        }
    }
    if let Some(base) =
        pool.base.filter(|base| unsafe { nertca_context_describe(*base, null_mut(), 0, &mut 0) == NERTCA_OK })
    {
        close(base, &[]);
    }
    let statuses = pool.statuses;
    println!("{count} sequences of {steps} calls; by status, from ok: {:?}", &statuses[..15]);
    if given.is_none() {
        let reached =
            [NERTCA_OK, NERTCA_ERROR_ARGUMENT, NERTCA_ERROR_HANDLE, NERTCA_ERROR_DEVICE, NERTCA_ERROR_NOT_READY];
        for status in reached {
            let seen = statuses[-status as usize];
            assert!(seen > 0 || device && status == NERTCA_ERROR_DEVICE, "no call gave {status}");
        }
    }
}

fn count(variable: &str, default: u64) -> u64 {
    std::env::var(variable).map_or(default, |n| n.parse().unwrap())
}

#[test]
fn random_calls_without_a_device() {
    sequences(false, count("NERTCA_RANDOM_SEQUENCES", 10_000), 20);
}

#[test]
fn random_calls_with_a_device() {
    sequences(true, count("NERTCA_RANDOM_DEVICE_SEQUENCES", 40), 30);
}
