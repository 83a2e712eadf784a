//! Every function of the C ABI with every detectable error in every argument: the result is a status and a message.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::undocumented_unsafe_blocks, reason = "tests of C functions")]

use crate::c_scene::*;
use crate::root::root;
use nertca_vk_abi::boundary::nertca_last_error;
use nertca_vk_abi::calibration::*;
use nertca_vk_abi::context::*;
use nertca_vk_abi::output::*;
use nertca_vk_abi::reconstruction::*;
use nertca_vk_abi::semaphores::*;
use nertca_vk_abi::status::*;
use nertca_vk_abi::training::*;
use nertca_vk_abi::tree::*;
use nertca_vk_abi::truth::*;
use nertca_vk_abi::types::*;
use std::cell::RefCell;
use std::collections::BTreeSet;
use std::ffi::{CString, c_char, c_void};
use std::ptr::{null, null_mut, without_provenance_mut};

/// Objects that the cases use, and the functions they have covered.
struct Bench {
    context: *mut nertca_context,
    bare: *mut nertca_reconstruction,
    trained: *mut nertca_reconstruction,
    covered: RefCell<BTreeSet<String>>,
    cases: RefCell<u32>,
}

impl Bench {
    /// Checks a call that must fail with a status and a message that names `part`.
    #[track_caller]
    fn refuses(&self, function: &str, wanted: nertca_status, part: &str, got: nertca_status) {
        self.covered.borrow_mut().insert(function.to_owned());
        *self.cases.borrow_mut() += 1;
        let text = last_error(null::<c_void>());
        assert_eq!(got, wanted, "{function} ({part}): {text}");
        assert!(text.contains(part), "{function}: `{text}` does not name `{part}`");
        assert!(!text.contains("--"), "{function}: `{text}` speaks of a command line");
    }

    /// Null, stale, wild and foreign handles.
    fn handles<H>(&self, function: &str, stale: *mut H, foreign: *mut c_void, call: impl Fn(*mut H) -> nertca_status) {
        if !function.ends_with("_destroy") {
            self.refuses(function, NERTCA_ERROR_HANDLE, "is null", call(null_mut()));
        }
        self.refuses(function, NERTCA_ERROR_HANDLE, "was destroyed or never existed", call(stale));
        for wild in [1, 8, 0xdead_beef, usize::MAX] {
            self.refuses(function, NERTCA_ERROR_HANDLE, "never existed", call(without_provenance_mut(wild)));
        }
        self.refuses(function, NERTCA_ERROR_HANDLE, "another type", call(foreign.cast()));
    }
}

fn text(t: &str) -> CString {
    CString::new(t).unwrap()
}

unsafe extern "C" fn ignore_log(_: u32, _: *const c_char, _: *mut c_void) {}

#[test]
fn every_function_refuses_what_it_cannot_use() {
    let context = context("validation = true");
    let trained = reconstruction(context, SMALL);
    add_frames(trained, 0..3);
    ok(unsafe { nertca_reconstruction_train(trained, 5, None, null_mut(), null_mut()) }, trained);
    let bare = reconstruction(context, SMALL);
    let b = Bench { context, bare, trained, covered: RefCell::default(), cases: RefCell::new(0) };
    contexts(&b);
    reconstructions(&b);
    frames(&b);
    calibration(&b);
    tree(&b);
    checkpoints(&b);
    training(&b);
    views(&b);
    volumes_and_scores(&b);
    buffers(&b);
    semaphores(&b);
    texts(&b);
    let header = std::fs::read_to_string(root().join("include/nertca_vk.h")).unwrap();
    let functions: BTreeSet<String> = header
        .lines()
        .filter_map(|line| line.strip_prefix("nertca_status nertca_")?.split('(').next())
        .map(|name| format!("nertca_{name}"))
        .collect();
    assert_eq!(*b.covered.borrow(), functions, "functions that return a status, and those misused here");
    println!("{} cases", b.cases.borrow());
    close(context, &[bare, trained]);
}

fn stale_context() -> *mut nertca_context {
    let stale = context("device = none");
    ok(unsafe { nertca_context_destroy(stale) }, stale);
    stale
}

fn contexts(b: &Bench) {
    let mut out = null_mut();
    let create = "nertca_context_create";
    for (options, part) in [
        ("memory_limit_mib = -1", "memory_limit_mib"),
        ("memory_limit_mib = 0", "memory_limit_mib"),
        ("validation = perhaps", "validation"),
        ("layers = 7", "layers"),
        ("colour = red", "unknown key `colour`"),
        ("device", "key = value"),
        ("{\"device\": [0]}", "device"),
    ] {
        let options = text(options);
        let status = unsafe { nertca_context_create(options.as_ptr(), null(), &mut out) };
        b.refuses(create, NERTCA_ERROR_ARGUMENT, part, status);
        assert!(out.is_null());
    }
    let nowhere = text("device = no such device");
    let status = unsafe { nertca_context_create(nowhere.as_ptr(), null(), &mut out) };
    b.refuses(create, NERTCA_ERROR_DEVICE, "no device matches", status);
    let none = text("device = none");
    b.refuses(create, NERTCA_ERROR_ARGUMENT, "context", unsafe {
        nertca_context_create(none.as_ptr(), null(), null_mut())
    });
    let bad_text = [0x64u8, 0xff, 0xfe, 0];
    b.refuses(create, NERTCA_ERROR_ARGUMENT, "UTF-8", unsafe {
        nertca_context_create(bad_text.as_ptr().cast(), null(), &mut out)
    });
    let log = |size, level, callback| nertca_log { size, callback, user: null_mut(), level };
    let full = size_of::<nertca_log>();
    for (log, part) in [
        (log(0, 1, Some(ignore_log as _)), "nertca_log.size"),
        (log(full - 1, 1, Some(ignore_log as _)), "nertca_log.size"),
        (log(1 << 40, 1, Some(ignore_log as _)), "nertca_log.size"),
        (log(full, 0, Some(ignore_log as _)), "log.level"),
        (log(full, 4, Some(ignore_log as _)), "log.level"),
        (log(full, 1, None), "log.callback"),
    ] {
        b.refuses(create, NERTCA_ERROR_ARGUMENT, part, unsafe { nertca_context_create(none.as_ptr(), &log, &mut out) });
    }
    #[repr(C)]
    struct Longer {
        log: nertca_log,
        more: usize,
    }
    let longer = |more| Longer { log: log(size_of::<Longer>(), 1, Some(ignore_log as _)), more };
    b.refuses(create, NERTCA_ERROR_ARGUMENT, "does not know", unsafe {
        nertca_context_create(none.as_ptr(), std::ptr::from_ref(&longer(1)).cast(), &mut out)
    });
    ok(
        unsafe { nertca_context_create(none.as_ptr(), std::ptr::from_ref(&longer(0)).cast(), &mut out) },
        null::<c_void>(),
    );
    ok(unsafe { nertca_context_destroy(out) }, out);

    let adopt = "nertca_context_adopt";
    b.refuses(adopt, NERTCA_ERROR_ARGUMENT, "nertca_vulkan", unsafe {
        nertca_context_adopt(null(), null(), null(), &mut out)
    });
    let vulkan = |size| nertca_vulkan { size, ..zeroed() };
    b.refuses(adopt, NERTCA_ERROR_ARGUMENT, "nertca_vulkan.size", unsafe {
        nertca_context_adopt(&vulkan(3), null(), null(), &mut out)
    });
    let mut theirs = vulkan(size_of::<nertca_vulkan>());
    let somewhere = without_provenance_mut(16);
    for part in ["vulkan.instance", "vulkan.physical_device", "vulkan.device", "vulkan.queue", "vulkan.lock"] {
        b.refuses(adopt, NERTCA_ERROR_ARGUMENT, part, unsafe {
            nertca_context_adopt(&theirs, null(), null(), &mut out)
        });
        match part {
            "vulkan.instance" => theirs.instance = somewhere,
            "vulkan.physical_device" => theirs.physical_device = somewhere,
            "vulkan.device" => theirs.device = somewhere,
            _ => (theirs.queue, theirs.lock) = (somewhere, Some(nothing as _)),
        }
    }
    (theirs.lock, theirs.cooperative_matrix) = (None, 1);
    b.refuses(adopt, NERTCA_ERROR_ARGUMENT, "cooperative_matrix", unsafe {
        nertca_context_adopt(&theirs, null(), null(), &mut out)
    });

    b.handles("nertca_context_describe", stale_context(), b.bare.cast(), |h| unsafe {
        nertca_context_describe(h, null_mut(), 0, &mut 0)
    });
    b.handles("nertca_context_destroy", stale_context(), b.bare.cast(), |h| unsafe { nertca_context_destroy(h) });
    b.refuses("nertca_context_destroy", NERTCA_ERROR_BUSY, "2 reconstructions", unsafe {
        nertca_context_destroy(b.context)
    });
    ok(unsafe { nertca_context_destroy(null_mut()) }, null::<c_void>());
}

unsafe extern "C" fn nothing(_: *mut c_void) {}

fn stale(b: &Bench) -> *mut nertca_reconstruction {
    let stale = reconstruction(b.context, SMALL);
    ok(unsafe { nertca_reconstruction_destroy(stale) }, stale);
    stale
}

fn reconstructions(b: &Bench) {
    let create = "nertca_reconstruction_create";
    let options = text("phases = 3");
    b.handles(create, stale_context(), b.bare.cast(), |h| unsafe {
        nertca_reconstruction_create(h, options.as_ptr(), &mut null_mut())
    });
    b.refuses(create, NERTCA_ERROR_ARGUMENT, "reconstruction", unsafe {
        nertca_reconstruction_create(b.context, options.as_ptr(), null_mut())
    });
    for (options, part) in [
        ("", "phases"),
        ("phases = 0", "phases"),
        ("phases = 1.5", "phases"),
        ("phases = 99999", "phases"),
        ("still = true\nphases = 3", "phases"),
        ("phases = 2\nstill = perhaps", "still"),
        ("phases = 3\ndepth_half_extent_mm = nan", "depth_half_extent_mm"),
        ("phases = 3\ndepth_half_extent_mm = -2", "depth_half_extent_mm"),
        ("phases = 3\nvessel_attenuation_per_mm = 0", "vessel_attenuation_per_mm"),
        ("phases = 3\npreset = slow", "preset"),
        ("phases = 3\ntrain.rays = 0", "train.rays"),
        ("phases = 3\ntrain.rayz = 1", "train.rayz"),
        ("{\"phases\": null}", "phases"),
    ] {
        let options = text(options);
        b.refuses(create, NERTCA_ERROR_ARGUMENT, part, unsafe {
            nertca_reconstruction_create(b.context, options.as_ptr(), &mut null_mut())
        });
    }
    b.handles("nertca_reconstruction_destroy", stale(b), b.context.cast(), |h| unsafe {
        nertca_reconstruction_destroy(h)
    });
    ok(unsafe { nertca_reconstruction_destroy(null_mut()) }, null::<c_void>());
    let times = [0.0, 1.0];
    let peaks = "nertca_reconstruction_set_r_peaks";
    b.handles(peaks, stale(b), b.context.cast(), |h| unsafe {
        nertca_reconstruction_set_r_peaks(h, times.as_ptr(), 2)
    });
    let set = |times: *const f64, n| unsafe { nertca_reconstruction_set_r_peaks(b.bare, times, n) };
    b.refuses(peaks, NERTCA_ERROR_ARGUMENT, "times_s", set(null(), 2));
    b.refuses(peaks, NERTCA_ERROR_ARGUMENT, "at least two are needed", set(times.as_ptr(), 0));
    b.refuses(peaks, NERTCA_ERROR_ARGUMENT, "count", set(times.as_ptr(), usize::MAX));
    b.refuses(peaks, NERTCA_ERROR_ARGUMENT, "at least two are needed", set(times.as_ptr(), 1));
    b.refuses(peaks, NERTCA_ERROR_ARGUMENT, "must increase", set([1.0, 0.5].as_ptr(), 2));
    b.refuses(peaks, NERTCA_ERROR_ARGUMENT, "not a time", set([1.0, f64::INFINITY].as_ptr(), 2));
    let prior = "nertca_reconstruction_set_prior";
    let points = [0.0, 1.0, 2.0];
    b.handles(prior, stale(b), b.context.cast(), |h| unsafe { nertca_reconstruction_set_prior(h, points.as_ptr(), 1) });
    let set = |points: *const f64, n| unsafe { nertca_reconstruction_set_prior(b.bare, points, n) };
    b.refuses(prior, NERTCA_ERROR_ARGUMENT, "points_mm", set(null(), 1));
    b.refuses(prior, NERTCA_ERROR_ARGUMENT, "no point", set(points.as_ptr(), 0));
    b.refuses(prior, NERTCA_ERROR_ARGUMENT, "count", set(points.as_ptr(), usize::MAX));
    b.refuses(prior, NERTCA_ERROR_ARGUMENT, "point 0: has a coordinate", set([0.0, f64::NAN, 0.0].as_ptr(), 1));
    let phase_of = "nertca_reconstruction_beat_phase";
    let mut phase = 0.0;
    let ask = |h, time_s, phase| unsafe { nertca_reconstruction_beat_phase(h, time_s, phase) };
    b.refuses(phase_of, NERTCA_ERROR_ARGUMENT, "phase: is null", ask(b.bare, 0.0, null_mut()));
    b.refuses(phase_of, NERTCA_ERROR_ARGUMENT, "time_s", ask(b.bare, f64::NAN, &mut phase));
    b.refuses(phase_of, NERTCA_ERROR_NOT_READY, "do not cover", ask(b.bare, 1.0, &mut phase));
    b.handles(phase_of, stale(b), b.context.cast(), |h| ask(h, 1.0, &mut 0.0));
    b.handles("nertca_reconstruction_cancel", stale(b), b.context.cast(), |h| nertca_reconstruction_cancel(h));
    let progress = "nertca_reconstruction_progress";
    let mut room: nertca_progress = zeroed();
    b.refuses(progress, NERTCA_ERROR_ARGUMENT, "nertca_progress.size", unsafe {
        nertca_reconstruction_progress(b.bare, &mut room)
    });
    b.refuses(progress, NERTCA_ERROR_ARGUMENT, "is null", unsafe {
        nertca_reconstruction_progress(b.bare, null_mut())
    });
    b.handles(progress, stale(b), b.context.cast(), |h| unsafe {
        nertca_reconstruction_progress(h, &mut nertca_progress { size: size_of::<nertca_progress>(), ..zeroed() })
    });
}

fn calibration(b: &Bench) {
    let correction = "nertca_reconstruction_correction";
    let mut room = nertca_correction { size: size_of::<nertca_correction>(), ..zeroed() };
    b.refuses(correction, NERTCA_ERROR_ARGUMENT, "0 were added", unsafe {
        nertca_reconstruction_correction(b.bare, 0, &mut room)
    });
    b.handles(correction, stale(b), b.context.cast(), |h| unsafe {
        nertca_reconstruction_correction(h, 0, &mut nertca_correction { size: room.size, ..zeroed() })
    });
    let set = "nertca_reconstruction_set_geometry";
    b.refuses(set, NERTCA_ERROR_ARGUMENT, "is null", unsafe { nertca_reconstruction_set_geometry(b.bare, 0, null()) });
    b.refuses(set, NERTCA_ERROR_ARGUMENT, "0 were added", unsafe {
        nertca_reconstruction_set_geometry(b.bare, 0, &geometry(0))
    });
    b.handles(set, stale(b), b.context.cast(), |h| unsafe { nertca_reconstruction_set_geometry(h, 0, &geometry(0)) });
    let set = "nertca_reconstruction_set_view_geometry";
    let of_view = |h, frame, geometry: *const nertca_geometry| unsafe {
        nertca_reconstruction_set_view_geometry(h, frame, geometry)
    };
    b.refuses(set, NERTCA_ERROR_ARGUMENT, "is null", of_view(b.bare, 0, null()));
    b.refuses(set, NERTCA_ERROR_ARGUMENT, "0 were added", of_view(b.bare, 0, &geometry(0)));
    let backwards = nertca_geometry { sod_mm: 2000.0, ..geometry(0) };
    b.refuses(set, NERTCA_ERROR_ARGUMENT, "sod_mm", of_view(b.trained, 0, &backwards));
    b.handles(set, stale(b), b.context.cast(), |h| of_view(h, 0, &geometry(0)));
    let remove = "nertca_reconstruction_remove_frame";
    b.refuses(remove, NERTCA_ERROR_ARGUMENT, "0 were added", nertca_reconstruction_remove_frame(b.bare, 0));
    b.handles(remove, stale(b), b.context.cast(), |h| nertca_reconstruction_remove_frame(h, 0));
    let status = "nertca_reconstruction_frame_status";
    let size = size_of::<nertca_frame_status>();
    let ask = |h, frame, status: nertca_frame_status| unsafe {
        nertca_reconstruction_frame_status(h, frame, &mut { status })
    };
    b.refuses(status, NERTCA_ERROR_ARGUMENT, "nertca_frame_status.size", ask(b.trained, 0, zeroed()));
    b.refuses(
        status,
        NERTCA_ERROR_ARGUMENT,
        "9 were added",
        ask(b.trained, 9, nertca_frame_status { size, ..zeroed() }),
    );
    b.refuses(status, NERTCA_ERROR_ARGUMENT, "is null", unsafe {
        nertca_reconstruction_frame_status(b.trained, 0, null_mut())
    });
    b.handles(status, stale(b), b.context.cast(), |h| ask(h, 0, nertca_frame_status { size, ..zeroed() }));
    let drawn = "nertca_reconstruction_drawn";
    let size = size_of::<nertca_drawn>();
    let ask = |h, drawn: nertca_drawn| unsafe { nertca_reconstruction_drawn(h, &mut { drawn }) };
    b.refuses(drawn, NERTCA_ERROR_NOT_READY, "no live picture", ask(b.bare, nertca_drawn { size, ..zeroed() }));
    b.handles(drawn, stale(b), b.context.cast(), |h| ask(h, nertca_drawn { size, ..zeroed() }));
}

fn tree(b: &Bench) {
    let lesion = "nertca_reconstruction_lesion";
    b.refuses(lesion, NERTCA_ERROR_ARGUMENT, "is null, and count as well", unsafe {
        nertca_reconstruction_lesion(b.bare, 0, null_mut(), null_mut())
    });
    b.refuses(lesion, NERTCA_ERROR_NOT_READY, "no vessels were found yet", unsafe {
        nertca_reconstruction_lesion(b.bare, 0, null_mut(), &mut 0)
    });
    b.handles(lesion, stale(b), b.context.cast(), |h| unsafe {
        nertca_reconstruction_lesion(h, 0, null_mut(), &mut 0)
    });
    let tree = "nertca_reconstruction_tree";
    let size = size_of::<nertca_tree>();
    let ask = |h, asked: nertca_tree| unsafe { nertca_reconstruction_tree(h, &mut { asked }) };
    b.refuses(tree, NERTCA_ERROR_ARGUMENT, "is null", unsafe { nertca_reconstruction_tree(b.bare, null_mut()) });
    b.refuses(tree, NERTCA_ERROR_ARGUMENT, "nertca_tree.size", ask(b.bare, zeroed()));
    b.refuses(tree, NERTCA_ERROR_NOT_READY, "", ask(b.bare, nertca_tree { size, ..zeroed() }));
    let mut radius_mm = 0.0;
    let partly = nertca_tree { size, radius_mm: &mut radius_mm, ..zeroed() };
    b.refuses(tree, NERTCA_ERROR_ARGUMENT, "branch_phase", ask(b.trained, partly));
    let only_doubt = nertca_tree { size, existence: &mut radius_mm, ..zeroed() };
    b.refuses(tree, NERTCA_ERROR_ARGUMENT, "branch_phase", ask(b.trained, only_doubt));
    for bad in [-1.0, f64::NAN, f64::INFINITY] {
        let asked = nertca_tree { size, threshold_per_mm: bad, ..zeroed() };
        b.refuses(tree, NERTCA_ERROR_ARGUMENT, "threshold_per_mm", ask(b.trained, asked));
        let asked = nertca_tree { size, threshold_per_mm: 1e-4, least_branch_mm: bad, ..zeroed() };
        b.refuses(tree, NERTCA_ERROR_ARGUMENT, "least_branch_mm", ask(b.trained, asked));
    }
    let nothing = nertca_tree { size, threshold_per_mm: 1e6, ..zeroed() };
    b.refuses(tree, NERTCA_ERROR_ARGUMENT, "no vessel", ask(b.trained, nothing));
    b.handles(tree, stale(b), b.context.cast(), |h| ask(h, nertca_tree { size, ..zeroed() }));
}

fn frames(b: &Bench) {
    let add = "nertca_reconstruction_add_frame";
    let data = pixels(0, 0);
    let good = frame(0, 0, &data);
    b.handles(add, stale(b), b.context.cast(), |h| unsafe { nertca_reconstruction_add_frame(h, &good) });
    b.refuses(add, NERTCA_ERROR_ARGUMENT, "nertca_frame: is null", unsafe {
        nertca_reconstruction_add_frame(b.bare, null())
    });
    let mut nan = data.clone();
    nan[21] = f32::NAN;
    let singular = [0.0f64; 12];
    let mask = [1u8; 16];
    type Change<'a> = Box<dyn Fn(&mut nertca_frame) + 'a>;
    let cases: Vec<(&str, Change<'_>)> = vec![
        ("nertca_frame.size", Box::new(|f| f.size = 0)),
        ("nertca_frame.size", Box::new(|f| f.size -= 8)),
        ("nertca_geometry.size", Box::new(|f| f.geometry.size = 1)),
        ("pixels: is null", Box::new(|f| f.pixels = null())),
        ("pixels_bytes", Box::new(|f| f.pixels_bytes -= 1)),
        ("pixels_bytes", Box::new(|f| f.pixels_bytes = 0)),
        ("pixels stride", Box::new(|f| f.stride_bytes = 4)),
        ("pixels_bytes", Box::new(|f| f.stride_bytes = usize::MAX)),
        ("width", Box::new(|f| f.width = 0)),
        ("width", Box::new(|f| f.width = u32::MAX)),
        ("height", Box::new(|f| f.height = 0)),
        ("height", Box::new(|f| f.height = 8193)),
        ("format", Box::new(|f| f.format = 0)),
        ("format", Box::new(|f| f.format = 9)),
        ("intensity", Box::new(|f| f.intensity = 0)),
        ("intensity", Box::new(|f| f.intensity = 4)),
        ("scale", Box::new(|f| f.scale = f64::NAN)),
        ("offset", Box::new(|f| f.offset = f64::INFINITY)),
        ("i0", Box::new(|f| (f.intensity, f.i0) = (NERTCA_INTENSITY_LINEAR, 0.0))),
        ("i0", Box::new(|f| (f.intensity, f.i0) = (NERTCA_INTENSITY_LOG, f64::NAN))),
        ("i0", Box::new(|f| (f.intensity, f.i0) = (NERTCA_INTENSITY_LOG, 0.0))),
        ("phase", Box::new(|f| f.phase = 3)),
        ("phase", Box::new(|f| f.phase = i32::MAX)),
        ("time", Box::new(|f| (f.phase, f.time_s) = (-1, f64::NAN))),
        ("split", Box::new(|f| f.split = 2)),
        ("mask_bytes", Box::new(|f| (f.mask, f.mask_bytes) = (mask.as_ptr(), mask.len()))),
        ("mask stride", Box::new(|f| (f.mask, f.mask_bytes, f.mask_stride_bytes) = (mask.as_ptr(), 16, 1))),
        ("column 1, row 1", Box::new(|f| f.pixels = nan.as_ptr().cast())),
        ("sid_mm", Box::new(|f| f.geometry.sid_mm = -1.0)),
        ("sod_mm", Box::new(|f| f.geometry.sod_mm = f64::NAN)),
        ("sod_mm", Box::new(|f| f.geometry.sod_mm = 2000.0)),
        ("sod_mm", Box::new(|f| f.geometry.sod_mm = 50.0)),
        ("pixel_mm[0]", Box::new(|f| f.geometry.pixel_mm[0] = 0.0)),
        ("pixel_mm[1]", Box::new(|f| f.geometry.pixel_mm[1] = f64::INFINITY)),
        ("primary_deg", Box::new(|f| f.geometry.primary_deg = 1e9)),
        ("secondary_deg", Box::new(|f| f.geometry.secondary_deg = f64::NAN)),
        ("offset_mm", Box::new(|f| f.geometry.offset_mm[1] = f64::NAN)),
        ("table_mm", Box::new(|f| f.geometry.table_mm[2] = f64::NAN)),
        ("matrix", Box::new(|f| f.geometry.matrix = singular.as_ptr())),
    ];
    for (part, change) in cases {
        let mut frame = good;
        change(&mut frame);
        b.refuses(add, NERTCA_ERROR_ARGUMENT, part, unsafe { nertca_reconstruction_add_frame(b.bare, &frame) });
    }
}

fn checkpoints(b: &Bench) {
    let path = text("/nowhere/at/all/checkpoint.safetensors");
    let save = "nertca_reconstruction_save";
    b.handles(save, stale(b), b.context.cast(), |h| unsafe { nertca_reconstruction_save(h, path.as_ptr()) });
    b.refuses(save, NERTCA_ERROR_ARGUMENT, "path", unsafe { nertca_reconstruction_save(b.trained, null()) });
    b.refuses(save, NERTCA_ERROR_ARGUMENT, "path", unsafe { nertca_reconstruction_save(b.trained, c"".as_ptr()) });
    b.refuses(save, NERTCA_ERROR_NOT_READY, "not ready", unsafe { nertca_reconstruction_save(b.bare, path.as_ptr()) });
    let occupied = text("/dev/null/checkpoint.safetensors");
    b.refuses(save, NERTCA_ERROR_IO, "/dev/null", unsafe { nertca_reconstruction_save(b.trained, occupied.as_ptr()) });
    let load = "nertca_reconstruction_load";
    b.handles(load, stale(b), b.context.cast(), |h| unsafe { nertca_reconstruction_load(h, path.as_ptr()) });
    b.refuses(load, NERTCA_ERROR_ARGUMENT, "path", unsafe { nertca_reconstruction_load(b.bare, null()) });
    b.refuses(load, NERTCA_ERROR_IO, "/nowhere", unsafe { nertca_reconstruction_load(b.bare, path.as_ptr()) });
    let memory = "nertca_reconstruction_save_memory";
    let (mut small, mut length) = ([0u8; 8], 0);
    b.handles(memory, stale(b), b.context.cast(), |h| unsafe {
        nertca_reconstruction_save_memory(h, null_mut(), 0, &mut 0)
    });
    b.refuses(memory, NERTCA_ERROR_ARGUMENT, "length", unsafe {
        nertca_reconstruction_save_memory(b.trained, small.as_mut_ptr().cast(), 8, null_mut())
    });
    b.refuses(memory, NERTCA_ERROR_ARGUMENT, "bytes", unsafe {
        nertca_reconstruction_save_memory(b.trained, null_mut(), 8, &mut length)
    });
    b.refuses(memory, NERTCA_ERROR_BUFFER, "bytes are needed", unsafe {
        nertca_reconstruction_save_memory(b.trained, small.as_mut_ptr().cast(), 8, &mut length)
    });
    assert!(length > 8);
    let read = "nertca_reconstruction_load_memory";
    let load_bytes =
        |h, bytes: &[u8]| unsafe { nertca_reconstruction_load_memory(h, bytes.as_ptr().cast(), bytes.len()) };
    b.handles(read, stale(b), b.context.cast(), |h| load_bytes(h, &small));
    b.refuses(read, NERTCA_ERROR_ARGUMENT, "bytes", unsafe { nertca_reconstruction_load_memory(b.bare, null(), 8) });
    b.refuses(read, NERTCA_ERROR_ARGUMENT, "size", unsafe {
        nertca_reconstruction_load_memory(b.bare, small.as_ptr().cast(), usize::MAX)
    });
    b.refuses(read, NERTCA_ERROR_DATA, "memory", load_bytes(b.bare, &small));
    b.refuses(read, NERTCA_ERROR_DATA, "memory", load_bytes(b.bare, &[]));
    let mut whole = vec![0u8; length + 4096];
    ok(
        unsafe { nertca_reconstruction_save_memory(b.trained, whole.as_mut_ptr().cast(), whole.len(), &mut length) },
        b.trained,
    );
    whole.truncate(length);
    b.refuses(read, NERTCA_ERROR_DATA, "memory", load_bytes(b.bare, &whole[..length / 2]));
    // A truncated header, and values that are not finite.
    b.refuses(read, NERTCA_ERROR_DATA, "memory", load_bytes(b.bare, &whole[8..]));
    let last = whole.len() - 4;
    let header = u64::from_le_bytes(whole[..8].try_into().unwrap()) as usize;
    whole[8 + header..last].fill(0xff);
    b.refuses(read, NERTCA_ERROR_DATA, "not finite", load_bytes(b.bare, &whole));
}

fn training(b: &Bench) {
    let train = "nertca_reconstruction_train";
    b.handles(train, stale(b), b.context.cast(), |h| unsafe {
        nertca_reconstruction_train(h, 1, None, null_mut(), null_mut())
    });
    b.refuses(train, NERTCA_ERROR_ARGUMENT, "iterations", unsafe {
        nertca_reconstruction_train(b.trained, 0, None, null_mut(), null_mut())
    });
    b.refuses(train, NERTCA_ERROR_NOT_READY, "frames", unsafe {
        nertca_reconstruction_train(b.bare, 1, None, null_mut(), null_mut())
    });
    let without = context("device = none");
    let idle = reconstruction(without, SMALL);
    add_frames(idle, 0..3);
    b.refuses(train, NERTCA_ERROR_DEVICE, "without a device", unsafe {
        nertca_reconstruction_train(idle, 1, None, null_mut(), null_mut())
    });
    let start = "nertca_reconstruction_start";
    b.refuses(start, NERTCA_ERROR_DEVICE, "without a device", unsafe {
        nertca_reconstruction_start(idle, None, null_mut())
    });
    close(without, &[idle]);
    b.handles(start, stale(b), b.context.cast(), |h| unsafe { nertca_reconstruction_start(h, None, null_mut()) });
    ok(unsafe { nertca_reconstruction_start(b.bare, None, null_mut()) }, b.bare);
    b.refuses(start, NERTCA_ERROR_BUSY, "already", unsafe { nertca_reconstruction_start(b.bare, None, null_mut()) });
    b.refuses(train, NERTCA_ERROR_BUSY, "background", unsafe {
        nertca_reconstruction_train(b.bare, 1, None, null_mut(), null_mut())
    });
    ok(nertca_reconstruction_stop(b.bare), b.bare);
    b.handles("nertca_reconstruction_pause", stale(b), b.context.cast(), |h| nertca_reconstruction_pause(h));
    b.handles("nertca_reconstruction_resume", stale(b), b.context.cast(), |h| nertca_reconstruction_resume(h));
    b.handles("nertca_reconstruction_stop", stale(b), b.context.cast(), |h| nertca_reconstruction_stop(h));
    b.handles("nertca_reconstruction_wait", stale(b), b.context.cast(), |h| unsafe {
        nertca_reconstruction_wait(h, 0, null_mut())
    });
}

fn views(b: &Bench) {
    let render = "nertca_reconstruction_render";
    let mut room = vec![0f32; (SIZE * SIZE) as usize];
    let good_image = image(&mut room);
    let good = view(0);
    b.handles(render, stale(b), b.context.cast(), |h| unsafe { nertca_reconstruction_render(h, &good, &good_image) });
    b.refuses(render, NERTCA_ERROR_NOT_READY, "no reconstruction yet", unsafe {
        nertca_reconstruction_render(b.bare, &good, &good_image)
    });
    b.refuses(render, NERTCA_ERROR_ARGUMENT, "nertca_view: is null", unsafe {
        nertca_reconstruction_render(b.trained, null(), &good_image)
    });
    b.refuses(render, NERTCA_ERROR_ARGUMENT, "nertca_image: is null", unsafe {
        nertca_reconstruction_render(b.trained, &good, null())
    });
    type Change = fn(&mut nertca_view);
    let wrong_views: [(&str, Change); 14] = [
        ("nertca_view.size", |v| v.size = 8),
        ("nertca_geometry.size", |v| v.geometry.size = 0),
        ("width", |v| v.width = 0),
        ("height", |v| v.height = 9000),
        ("phase", |v| v.phase = 3),
        ("phase", |v| v.phase = u32::MAX),
        ("after_phase", |v| v.after_phase = -0.1),
        ("after_phase", |v| v.after_phase = 1.0),
        ("after_phase", |v| v.after_phase = f64::NAN),
        ("component", |v| v.component = 3),
        ("projection", |v| v.projection = 2),
        ("quality", |v| v.quality = 2),
        ("sid_mm", |v| v.geometry.sid_mm = 0.0),
        ("primary_deg", |v| v.geometry.primary_deg = f64::NAN),
    ];
    for (part, change) in wrong_views {
        let mut view = good;
        change(&mut view);
        b.refuses(render, NERTCA_ERROR_ARGUMENT, part, unsafe {
            nertca_reconstruction_render(b.trained, &view, &good_image)
        });
    }
    type ChangeImage = fn(&mut nertca_image);
    let wrong_images: [(&str, ChangeImage); 9] = [
        ("nertca_image.size", |i| i.size = 1),
        ("pixels: is null", |i| i.pixels = null_mut()),
        ("pixels_bytes", |i| i.pixels_bytes -= 1),
        ("pixels stride", |i| i.stride_bytes = 3),
        ("pixels_bytes", |i| i.stride_bytes = usize::MAX / 2),
        ("format", |i| i.format = NERTCA_PIXELS_U16),
        ("format", |i| i.format = 77),
        ("low, high", |i| i.low = f64::NAN),
        ("low, high", |i| (i.low, i.high) = (1.0, 0.0)),
    ];
    for (part, change) in wrong_images {
        let mut image = good_image;
        change(&mut image);
        b.refuses(render, NERTCA_ERROR_ARGUMENT, part, unsafe {
            nertca_reconstruction_render(b.trained, &good, &image)
        });
    }
}

fn volumes_and_scores(b: &Bench) {
    let sample = "nertca_reconstruction_sample";
    let mut room = [0f32; 64];
    let good = nertca_grid {
        size: size_of::<nertca_grid>(),
        origin_mm: [0.0; 3],
        spacing_mm: [1.0; 3],
        points: [4; 3],
        component: NERTCA_COMPONENT_TOTAL,
        phase: 0,
    };
    let at = room.as_mut_ptr();
    b.handles(sample, stale(b), b.context.cast(), |h| unsafe { nertca_reconstruction_sample(h, &good, at, 64) });
    b.refuses(sample, NERTCA_ERROR_NOT_READY, "no reconstruction yet", unsafe {
        nertca_reconstruction_sample(b.bare, &good, at, 64)
    });
    b.refuses(sample, NERTCA_ERROR_ARGUMENT, "nertca_grid: is null", unsafe {
        nertca_reconstruction_sample(b.trained, null(), at, 64)
    });
    b.refuses(sample, NERTCA_ERROR_ARGUMENT, "values", unsafe {
        nertca_reconstruction_sample(b.trained, &good, null_mut(), 64)
    });
    b.refuses(sample, NERTCA_ERROR_ARGUMENT, "count", unsafe {
        nertca_reconstruction_sample(b.trained, &good, at, 63)
    });
    type Change = fn(&mut nertca_grid);
    let wrong: [(&str, Change); 9] = [
        ("nertca_grid.size", |g| g.size = 9),
        ("origin", |g| g.origin_mm[0] = f64::NAN),
        ("spacing", |g| g.spacing_mm[1] = 0.0),
        ("spacing", |g| g.spacing_mm[2] = f64::INFINITY),
        ("1 to 4096 points", |g| g.points[0] = 0),
        ("1 to 4096 points", |g| g.points[1] = 5000),
        ("points", |g| g.points = [4096; 3]),
        ("component", |g| g.component = 7),
        ("phase", |g| g.phase = 12),
    ];
    for (part, change) in wrong {
        let mut grid = good;
        change(&mut grid);
        b.refuses(sample, NERTCA_ERROR_ARGUMENT, part, unsafe {
            nertca_reconstruction_sample(b.trained, &grid, at, 64)
        });
    }
    let evaluate = "nertca_reconstruction_evaluate";
    let mut scores = nertca_scores { size: size_of::<nertca_scores>(), ..zeroed() };
    b.handles(evaluate, stale(b), b.context.cast(), |h| unsafe {
        nertca_reconstruction_evaluate(h, 0.0, &mut nertca_scores { size: size_of::<nertca_scores>(), ..zeroed() })
    });
    for bad in [-1.0, f64::NAN, f64::INFINITY] {
        b.refuses(evaluate, NERTCA_ERROR_ARGUMENT, "threshold_per_mm", unsafe {
            nertca_reconstruction_evaluate(b.trained, bad, &mut scores)
        });
    }
    b.refuses(evaluate, NERTCA_ERROR_ARGUMENT, "scores", unsafe {
        nertca_reconstruction_evaluate(b.trained, 0.0, null_mut())
    });
    b.refuses(evaluate, NERTCA_ERROR_DATA, "no validation frame", unsafe {
        nertca_reconstruction_evaluate(b.trained, 0.0, &mut scores)
    });
    let set_vessels = "nertca_reconstruction_set_true_vessels";
    let (voxels, points) = ([1u8; 64], good.points.iter().product::<u32>() as usize);
    b.handles(set_vessels, stale(b), b.context.cast(), |h| unsafe {
        nertca_reconstruction_set_true_vessels(h, &good, voxels.as_ptr(), points)
    });
    let set = |grid: *const nertca_grid, at: *const u8, bytes: usize| unsafe {
        nertca_reconstruction_set_true_vessels(b.trained, grid, at, bytes)
    };
    b.refuses(set_vessels, NERTCA_ERROR_ARGUMENT, "nertca_grid", set(null(), voxels.as_ptr(), points));
    b.refuses(set_vessels, NERTCA_ERROR_ARGUMENT, "vessels", set(&good, null(), points));
    b.refuses(set_vessels, NERTCA_ERROR_ARGUMENT, "bytes", set(&good, voxels.as_ptr(), points - 1));
    let late = nertca_grid { phase: PHASES, ..good };
    b.refuses(set_vessels, NERTCA_ERROR_ARGUMENT, "phase", set(&late, voxels.as_ptr(), points));
    let set_tree = "nertca_reconstruction_set_true_tree";
    let none = nertca_tree { size: size_of::<nertca_tree>(), ..zeroed() };
    b.handles(set_tree, stale(b), b.context.cast(), |h| unsafe { nertca_reconstruction_set_true_tree(h, &none) });
    let set = |tree: nertca_tree| unsafe { nertca_reconstruction_set_true_tree(b.trained, &tree) };
    b.refuses(set_tree, NERTCA_ERROR_ARGUMENT, "nertca_tree.size", set(zeroed()));
    b.refuses(set_tree, NERTCA_ERROR_ARGUMENT, "branch_phase", set(nertca_tree { branches: 1, ..none }));
    b.refuses(set_tree, NERTCA_ERROR_ARGUMENT, "points", set(nertca_tree { points: usize::MAX, ..none }));
}

fn buffers(b: &Bench) {
    let create = "nertca_buffer_create";
    b.handles(create, stale_context(), b.bare.cast(), |h| unsafe { nertca_buffer_create(h, 16, &mut null_mut()) });
    b.refuses(create, NERTCA_ERROR_ARGUMENT, "buffer", unsafe { nertca_buffer_create(b.context, 16, null_mut()) });
    b.refuses(create, NERTCA_ERROR_ARGUMENT, "bytes", unsafe { nertca_buffer_create(b.context, 0, &mut null_mut()) });
    b.refuses(create, NERTCA_ERROR_ARGUMENT, "bytes", unsafe {
        nertca_buffer_create(b.context, u64::MAX, &mut null_mut())
    });
    let without = context("device = none");
    b.refuses(create, NERTCA_ERROR_DEVICE, "without a device", unsafe {
        nertca_buffer_create(without, 16, &mut null_mut())
    });
    ok(unsafe { nertca_context_destroy(without) }, without);
    let mut buffer = null_mut();
    let exports = unsafe { nertca_buffer_create(b.context, 64, &mut buffer) } == NERTCA_OK;
    let good = view(0);
    let grid = nertca_grid {
        size: size_of::<nertca_grid>(),
        origin_mm: [0.0; 3],
        spacing_mm: [1.0; 3],
        points: [9; 3],
        component: NERTCA_COMPONENT_TOTAL,
        phase: 0,
    };
    if exports {
        let (render, sample) = ("nertca_reconstruction_render_buffer", "nertca_reconstruction_sample_buffer");
        b.refuses(render, NERTCA_ERROR_ARGUMENT, "64 bytes where 1600", unsafe {
            nertca_reconstruction_render_buffer(b.trained, &good, buffer)
        });
        b.refuses(sample, NERTCA_ERROR_ARGUMENT, "64 bytes where 2916", unsafe {
            nertca_reconstruction_sample_buffer(b.trained, &grid, buffer)
        });
        b.refuses("nertca_buffer_export_fd", NERTCA_ERROR_ARGUMENT, "fd", unsafe {
            nertca_buffer_export_fd(buffer, null_mut(), null_mut())
        });
        b.refuses("nertca_buffer_memory", NERTCA_ERROR_ARGUMENT, "memory_type", unsafe {
            nertca_buffer_memory(buffer, null_mut(), &mut 0)
        });
        b.refuses("nertca_buffer_memory", NERTCA_ERROR_ARGUMENT, "bytes", unsafe {
            nertca_buffer_memory(buffer, &mut 0, null_mut())
        });
        ok(nertca_buffer_destroy(buffer), buffer);
    } else {
        println!("this device exports no memory: {}", last_error(b.context));
        buffer = without_provenance_mut(0x1234_5678);
    }
    b.handles("nertca_reconstruction_render_buffer", stale(b), b.context.cast(), |h| unsafe {
        nertca_reconstruction_render_buffer(h, &good, buffer)
    });
    b.handles("nertca_reconstruction_render_buffer", buffer, b.context.cast(), |h| unsafe {
        nertca_reconstruction_render_buffer(b.trained, &good, h)
    });
    b.refuses("nertca_reconstruction_render_buffer", NERTCA_ERROR_ARGUMENT, "nertca_view", unsafe {
        nertca_reconstruction_render_buffer(b.trained, null(), buffer)
    });
    b.handles("nertca_reconstruction_sample_buffer", stale(b), b.context.cast(), |h| unsafe {
        nertca_reconstruction_sample_buffer(h, &grid, buffer)
    });
    b.handles("nertca_reconstruction_sample_buffer", buffer, b.context.cast(), |h| unsafe {
        nertca_reconstruction_sample_buffer(b.trained, &grid, h)
    });
    b.refuses("nertca_reconstruction_sample_buffer", NERTCA_ERROR_ARGUMENT, "nertca_grid", unsafe {
        nertca_reconstruction_sample_buffer(b.trained, null(), buffer)
    });
    b.handles("nertca_buffer_export_fd", buffer, b.context.cast(), |h| unsafe {
        nertca_buffer_export_fd(h, &mut 0, null_mut())
    });
    b.handles("nertca_buffer_memory", buffer, b.context.cast(), |h| unsafe { nertca_buffer_memory(h, &mut 0, &mut 0) });
    b.handles("nertca_buffer_destroy", buffer, b.context.cast(), |h| nertca_buffer_destroy(h));
    ok(nertca_buffer_destroy(null_mut()), null::<c_void>());
}

fn semaphores(b: &Bench) {
    let create = "nertca_semaphore_create";
    b.handles(create, stale_context(), b.bare.cast(), |h| unsafe { nertca_semaphore_create(h, &mut null_mut()) });
    b.refuses(create, NERTCA_ERROR_ARGUMENT, "semaphore", unsafe { nertca_semaphore_create(b.context, null_mut()) });
    let without = context("device = none");
    b.refuses(create, NERTCA_ERROR_DEVICE, "without a device", unsafe {
        nertca_semaphore_create(without, &mut null_mut())
    });
    ok(unsafe { nertca_context_destroy(without) }, without);
    let mut semaphore = null_mut();
    if unsafe { nertca_semaphore_create(b.context, &mut semaphore) } == NERTCA_OK {
        b.refuses("nertca_semaphore_export_fd", NERTCA_ERROR_ARGUMENT, "fd", unsafe {
            nertca_semaphore_export_fd(semaphore, null_mut())
        });
        ok(nertca_semaphore_destroy(semaphore), semaphore);
    } else {
        println!("this device exports no semaphores: {}", last_error(b.context));
        semaphore = without_provenance_mut(0x1234_5678);
    }
    b.handles("nertca_semaphore_export_fd", semaphore, b.context.cast(), |h| unsafe {
        nertca_semaphore_export_fd(h, &mut 0)
    });
    b.handles("nertca_semaphore_signal", semaphore, b.context.cast(), |h| nertca_semaphore_signal(h));
    b.handles("nertca_semaphore_destroy", semaphore, b.context.cast(), |h| nertca_semaphore_destroy(h));
    ok(nertca_semaphore_destroy(null_mut()), null::<c_void>());
}

fn texts(b: &Bench) {
    // Each of these is called with every wrong buffer size.
    type Ask<'a> = Box<dyn Fn(*mut c_char, usize, *mut usize) -> nertca_status + 'a>;
    let asks: [(&str, Ask<'_>); 4] = [
        ("nertca_devices", Box::new(|t, s, l| unsafe { nertca_devices(t, s, l) })),
        ("nertca_context_describe", Box::new(|t, s, l| unsafe { nertca_context_describe(b.context, t, s, l) })),
        (
            "nertca_reconstruction_failure",
            Box::new(|t, s, l| unsafe { nertca_reconstruction_failure(b.bare, t, s, l) }),
        ),
        ("nertca_last_error", Box::new(|t, s, l| unsafe { nertca_last_error(null(), t, s, l) })),
    ];
    let mut room: [c_char; 8] = [1; 8];
    for (name, ask) in &asks {
        b.covered.borrow_mut().insert((*name).to_owned());
        assert_eq!(ask(null_mut(), 0, null_mut()), NERTCA_ERROR_ARGUMENT, "{name}");
        assert_eq!(ask(null_mut(), 8, &mut 0), NERTCA_ERROR_ARGUMENT, "{name}");
        assert_eq!(ask(room.as_mut_ptr(), 0, &mut 0), NERTCA_ERROR_ARGUMENT, "{name}");
        let mut length = usize::MAX;
        assert_eq!(ask(null_mut(), 0, &mut length), NERTCA_OK, "{name}");
        let wanted = if length < 8 { NERTCA_OK } else { NERTCA_ERROR_BUFFER };
        assert_eq!(ask(room.as_mut_ptr(), 8, &mut length), wanted, "{name}");
        assert!(room.contains(&0), "{name}: the text has no end");
    }
    b.handles("nertca_reconstruction_failure", stale(b), b.context.cast(), |h| unsafe {
        nertca_reconstruction_failure(h, null_mut(), 0, &mut 0)
    });
    for status in -20..5 {
        assert!(!nertca_status_text(status).is_null());
    }
}
