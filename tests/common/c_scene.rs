//! A small dynamic scene through the C ABI, and calls that must succeed.
#![allow(dead_code, missing_docs, clippy::unwrap_used, clippy::expect_used, reason = "each test file uses its part")]
#![allow(clippy::missing_safety_doc, clippy::undocumented_unsafe_blocks, reason = "tests of C functions")]

use nertca_vk_abi::boundary::nertca_last_error;
use nertca_vk_abi::context::*;
use nertca_vk_abi::output::*;
use nertca_vk_abi::reconstruction::*;
use nertca_vk_abi::status::*;
use nertca_vk_abi::training::*;
use nertca_vk_abi::types::*;
use std::ffi::{CStr, CString, c_void};
use std::ptr::{null, null_mut};

pub const SIZE: u32 = 20;
pub const PHASES: u32 = 3;

/// Settings small enough for a CPU driver.
pub const SMALL: &str = "phases = 3
depth_half_extent_mm = 90
vessel_attenuation_per_mm = 0.01
train.rays = 21
train.chunk_samples = 1024
train.iterations = 60
train.checkpoint_every = 20
march.static_samples = 24
march.render_samples = 32
static.grid = 9
dynamic.half_extent_mm = 20";

pub fn last_error<H>(handle: *const H) -> String {
    let mut text = [0; 1024];
    unsafe { nertca_last_error(handle.cast(), text.as_mut_ptr(), text.len(), null_mut()) };
    unsafe { CStr::from_ptr(text.as_ptr()) }.to_str().unwrap().to_owned()
}

#[track_caller]
pub fn ok<H>(status: nertca_status, handle: *const H) {
    assert_eq!(status, NERTCA_OK, "{}", last_error(handle));
}

/// A context with validation layers, or without a device.
pub fn context(options: &str) -> *mut nertca_context {
    let options = CString::new(options).unwrap();
    let mut context = null_mut();
    ok(unsafe { nertca_context_create(options.as_ptr(), null(), &mut context) }, null::<c_void>());
    context
}

pub fn reconstruction(context: *mut nertca_context, options: &str) -> *mut nertca_reconstruction {
    let options = CString::new(options).unwrap();
    let mut reconstruction = null_mut();
    ok(unsafe { nertca_reconstruction_create(context, options.as_ptr(), &mut reconstruction) }, context);
    reconstruction
}

pub fn zeroed<T>() -> T {
    unsafe { std::mem::zeroed() }
}

pub fn geometry(view: usize) -> nertca_geometry {
    let (primary_deg, secondary_deg) = [(-30.0, 20.0), (40.0, -10.0), (85.0, 15.0)][view % 3];
    nertca_geometry {
        size: size_of::<nertca_geometry>(),
        primary_deg,
        secondary_deg,
        sid_mm: 1000.0,
        sod_mm: 600.0,
        pixel_mm: [120.0 / f64::from(SIZE); 2],
        ..zeroed()
    }
}

/// Line integrals of a moving blob on a gradient.
pub fn pixels(view: usize, phase: u32) -> Vec<f32> {
    let centre = (0.4 + 0.1 * f64::from(phase), 0.5 - 0.05 * view as f64);
    let n = SIZE as usize;
    (0..n * n)
        .map(|p| {
            let (x, y) = ((p % n) as f64 / n as f64, (p / n) as f64 / n as f64);
            let d2 = (x - centre.0).powi(2) + (y - centre.1).powi(2);
            (0.8 + 0.3 * x - 0.2 * y + 0.5 * (-d2 / 0.005).exp()) as f32
        })
        .collect()
}

/// A frame that points to `pixels`, which must stay alive as long.
pub fn frame(view: usize, phase: u32, pixels: &[f32]) -> nertca_frame {
    nertca_frame {
        size: size_of::<nertca_frame>(),
        geometry: geometry(view),
        pixels: pixels.as_ptr().cast(),
        pixels_bytes: size_of_val(pixels),
        width: SIZE,
        height: SIZE,
        format: NERTCA_PIXELS_F32,
        intensity: NERTCA_INTENSITY_INTEGRAL,
        phase: phase as i32,
        ..zeroed()
    }
}

pub fn add_frames(reconstruction: *mut nertca_reconstruction, views: std::ops::Range<usize>) {
    for view in views {
        for phase in 0..PHASES {
            let pixels = pixels(view, phase);
            ok(
                unsafe { nertca_reconstruction_add_frame(reconstruction, &frame(view, phase, &pixels)) },
                reconstruction,
            );
        }
    }
}

pub fn view(phase: u32) -> nertca_view {
    nertca_view { size: size_of::<nertca_view>(), geometry: geometry(0), width: SIZE, height: SIZE, phase, ..zeroed() }
}

pub fn image(pixels: &mut [f32]) -> nertca_image {
    nertca_image {
        size: size_of::<nertca_image>(),
        pixels: pixels.as_mut_ptr().cast(),
        pixels_bytes: size_of_val(pixels),
        format: NERTCA_PIXELS_F32,
        ..zeroed()
    }
}

/// Trains in this thread, and returns the number of iterations.
#[track_caller]
pub fn train(reconstruction: *mut nertca_reconstruction, iterations: u32) -> u32 {
    let mut done = 0;
    let status = unsafe { nertca_reconstruction_train(reconstruction, iterations, None, null_mut(), &mut done) };
    ok(status, reconstruction);
    done
}

/// Renders a view.
#[track_caller]
pub fn drawn(reconstruction: *mut nertca_reconstruction, view: &nertca_view) -> Vec<f32> {
    let mut pixels = vec![f32::NAN; (view.width * view.height) as usize];
    ok(unsafe { nertca_reconstruction_render(reconstruction, view, &image(&mut pixels)) }, reconstruction);
    assert!(pixels.iter().all(|p| p.is_finite()));
    pixels
}

/// Description of a context by itself.
pub fn described(context: *mut nertca_context) -> serde_json::Value {
    let mut text = vec![0; 1 << 16];
    ok(unsafe { nertca_context_describe(context, text.as_mut_ptr(), text.len(), null_mut()) }, context);
    serde_json::from_str(unsafe { CStr::from_ptr(text.as_ptr()) }.to_str().unwrap()).unwrap()
}

/// Destroys a reconstruction and its context; nothing may be left, and the validation layers must have reported nothing.
pub fn close(context: *mut nertca_context, reconstructions: &[*mut nertca_reconstruction]) {
    for reconstruction in reconstructions {
        ok(unsafe { nertca_reconstruction_destroy(*reconstruction) }, *reconstruction);
    }
    let described = described(context);
    if !described["device"].is_null() {
        assert_eq!(described["validation_messages"], serde_json::json!([]));
        assert_eq!(described["memory_in_use"], 0, "device memory was not freed");
    }
    ok(unsafe { nertca_context_destroy(context) }, context);
}
