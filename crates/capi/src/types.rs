//! Structs of the ABI. Each begins with its size, so that later versions can add fields at its end.

use crate::status::{Failure, Outcome};
use nertca_vk::geometry::{CArm, Geometry, Matrix};
use nertca_vk::scan::dataset::{Intensity, Split};
use nertca_vk_runs::session::{FrameTime, NewFrame, State};
use std::ffi::{c_char, c_void};

/// Unsigned 8-bit pixels.
pub const NERTCA_PIXELS_U8: u32 = 1;
/// Unsigned 16-bit pixels, in the machine's byte order.
pub const NERTCA_PIXELS_U16: u32 = 2;
/// Pixels that are 32-bit floats.
pub const NERTCA_PIXELS_F32: u32 = 3;

/// Pixel values `p` are line integrals of attenuation: `p * scale + offset`.
pub const NERTCA_INTENSITY_INTEGRAL: u32 = 1;
/// Logarithmic detector: the line integral is `(i0 - p) * scale`; `i0` is positive.
pub const NERTCA_INTENSITY_LOG: u32 = 2;
/// Detector linear in intensity: the line integral is `-ln(p / i0)`.
pub const NERTCA_INTENSITY_LINEAR: u32 = 3;

/// A frame to train on.
pub const NERTCA_SPLIT_TRAIN: u32 = 0;
/// A frame used only for scores.
pub const NERTCA_SPLIT_VALIDATION: u32 = 1;

/// Both fields.
pub const NERTCA_COMPONENT_TOTAL: u32 = 0;
/// Static field: the static background.
pub const NERTCA_COMPONENT_STATIC: u32 = 1;
/// Dynamic field: the moving vessels.
pub const NERTCA_COMPONENT_DYNAMIC: u32 = 2;

/// Projection by line integrals of attenuation, as in an angiogram.
pub const NERTCA_PROJECTION_DRR: u32 = 0;
/// Projection by the maximum attenuation along each ray, 1/mm.
pub const NERTCA_PROJECTION_MIP: u32 = 1;

/// Live quality: display rates, also during training. Gaussians are drawn directly; other fields through volumes baked from
/// them, whose resolution is their cell size (about 0.8 mm).
pub const NERTCA_QUALITY_LIVE: u32 = 0;
/// Exact quality: from the fields themselves, many times slower.
pub const NERTCA_QUALITY_EXACT: u32 = 1;

/// Not training.
pub const NERTCA_STATE_IDLE: u32 = 0;
/// Training in the background.
pub const NERTCA_STATE_RUNNING: u32 = 1;
/// Paused by `nertca_reconstruction_pause`.
pub const NERTCA_STATE_PAUSED: u32 = 2;
/// Waiting: training in the background goes on as soon as there are enough frames that the settings can be met with.
pub const NERTCA_STATE_WAITING: u32 = 3;
/// All iterations are done.
pub const NERTCA_STATE_FINISHED: u32 = 4;
/// The progress callback ended training.
pub const NERTCA_STATE_CANCELLED: u32 = 5;
/// An error ended training.
pub const NERTCA_STATE_FAILED: u32 = 6;

/// Receives log messages: level, UTF-8 text, and the caller's pointer. It is called on the thread on which a message arises,
/// which may be the training thread, and possibly on several threads at once. It must not call into the library.
pub type nertca_log_callback = Option<unsafe extern "C" fn(level: u32, text: *const c_char, user: *mut c_void)>;

/// Receiver of log messages.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct nertca_log {
    /// `sizeof(nertca_log)`.
    pub size: usize,
    /// Called for each message.
    pub callback: nertca_log_callback,
    /// Passed to the callback unchanged.
    pub user: *mut c_void,
    /// Lowest severity to report, one of `NERTCA_LOG_*`.
    pub level: u32,
}

/// A Vulkan device that the caller made and continues to own. It must outlive the context made from it.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct nertca_vulkan {
    /// `sizeof(nertca_vulkan)`.
    pub size: usize,
    /// `vkGetInstanceProcAddr`; null selects that of the system's loader.
    pub get_instance_proc_addr: *const c_void,
    /// `VkInstance`, made for Vulkan 1.2 or newer.
    pub instance: *mut c_void,
    /// `VkPhysicalDevice`.
    pub physical_device: *mut c_void,
    /// `VkDevice`, made with the feature `timelineSemaphore`.
    pub device: *mut c_void,
    /// `VkQueue` that supports compute.
    pub queue: *mut c_void,
    /// Family of the queue.
    pub queue_family: u32,
    /// Non-zero when the device was made with the feature `bufferDeviceAddress`.
    pub buffer_device_address: u32,
    /// Non-zero when the device was made with `VK_KHR_external_memory_fd`.
    pub external_memory_fd: u32,
    /// Called before every use of the queue, for a short time, on any thread; null when only the library uses the queue.
    pub lock: Option<unsafe extern "C" fn(user: *mut c_void)>,
    /// Called after every use of the queue, to release it; null exactly when `lock` is.
    pub unlock: Option<unsafe extern "C" fn(user: *mut c_void)>,
    /// Passed to `lock` and `unlock`.
    pub user: *mut c_void,
    /// Non-zero when the device was made with the features `subgroupSizeControl` and `computeFullSubgroups` (of
    /// `VK_EXT_subgroup_size_control`, or of Vulkan 1.3): sums then use shuffles, as on a device that the library opens itself.
    pub subgroup_size_control: u32,
    /// Non-zero when the device was made with `VK_KHR_cooperative_matrix` and its feature `cooperativeMatrix`, and with
    /// `shaderFloat16`, `vulkanMemoryModel` and `vulkanMemoryModelDeviceScope`: networks then use matrices, where the library
    /// has kernels for the device's shapes. Requires `subgroup_size_control` as well.
    pub cooperative_matrix: u32,
    /// Non-zero when the device was made with `VK_KHR_external_semaphore_fd`.
    pub external_semaphore_fd: u32,
}

/// Geometry of an image. Patient coordinates are left, posterior, superior (LPS), mm, from the isocentre.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct nertca_geometry {
    /// `sizeof(nertca_geometry)`.
    pub size: usize,
    /// Primary angle in degrees, LAO positive (DICOM PositionerPrimaryAngle).
    pub primary_deg: f64,
    /// Secondary angle in degrees, cranial positive (DICOM PositionerSecondaryAngle).
    pub secondary_deg: f64,
    /// Distance from source to detector, mm.
    pub sid_mm: f64,
    /// Distance from source to isocentre, mm.
    pub sod_mm: f64,
    /// Pixel pitch on the detector along columns and rows, mm.
    pub pixel_mm: [f64; 2],
    /// Offset of the detector's centre along columns and rows, mm.
    pub offset_mm: [f64; 2],
    /// Displacement of the patient by the table (LPS), mm.
    pub table_mm: [f64; 3],
    /// Null, or 12 numbers that replace all of the above: a row-major 3 x 4 projection from patient mm to homogeneous
    /// pixels (column, row; integers are pixel centres).
    pub matrix: *const f64,
}

/// A calibrated angiogram. Frames of one size whose geometries agree within a tenth of a pixel, over a cube of 100 mm around the
/// isocentre, are a view: a C-arm that reports its angles for each frame does so with noise. All frames of a view are used with the
/// geometry of its first one.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct nertca_frame {
    /// `sizeof(nertca_frame)`.
    pub size: usize,
    /// Geometry of the image.
    pub geometry: nertca_geometry,
    /// First row of the pixels, which are copied during the call.
    pub pixels: *const c_void,
    /// Number of bytes readable from `pixels`.
    pub pixels_bytes: usize,
    /// Bytes from one row to the next; 0 when rows are contiguous.
    pub stride_bytes: usize,
    /// Columns, 1 to 8192. Frames of a reconstruction may differ in size.
    pub width: u32,
    /// Rows, 1 to 8192.
    pub height: u32,
    /// One of `NERTCA_PIXELS_*`.
    pub format: u32,
    /// Meaning of the values, one of `NERTCA_INTENSITY_*`.
    pub intensity: u32,
    /// Factor on the values, for `INTEGRAL` and `LOG`; 0 stands for 1.
    pub scale: f64,
    /// Added after the factor, for `INTEGRAL`.
    pub offset: f64,
    /// Value of an unattenuated ray, for `LOG` and `LINEAR`.
    pub i0: f64,
    /// Cardiac phase from 0; negative to find it from `time_s` and the R-peaks.
    pub phase: i32,
    /// `NERTCA_SPLIT_TRAIN` or `NERTCA_SPLIT_VALIDATION`.
    pub split: u32,
    /// Time stamp on the clock of the R-peaks, seconds.
    pub time_s: f64,
    /// Null, or a vessel mask with one byte per pixel, non-zero inside vessels.
    pub mask: *const u8,
    /// Number of bytes readable from `mask`.
    pub mask_bytes: usize,
    /// Bytes from one row of the mask to the next; 0 when rows are contiguous.
    pub mask_stride_bytes: usize,
}

/// Description of a view to draw.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct nertca_view {
    /// `sizeof(nertca_view)`.
    pub size: usize,
    /// Geometry of the view.
    pub geometry: nertca_geometry,
    /// Columns, 1 to 8192.
    pub width: u32,
    /// Rows, 1 to 8192.
    pub height: u32,
    /// Cardiac phase, from 0.
    pub phase: u32,
    /// One of `NERTCA_COMPONENT_*`.
    pub component: u32,
    /// One of `NERTCA_PROJECTION_*`.
    pub projection: u32,
    /// One of `NERTCA_QUALITY_*`.
    pub quality: u32,
    /// Time after `phase`, counted in phases, from 0 to below 1: such as the rest of what `nertca_reconstruction_beat_phase`
    /// returns. Between two phases, live quality draws line integrals of the form of `fast`, one set of moving Gaussians; exact
    /// quality also draws networks.
    pub after_phase: f64,
}

/// Memory to draw into.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct nertca_image {
    /// `sizeof(nertca_image)`.
    pub size: usize,
    /// First row.
    pub pixels: *mut c_void,
    /// Number of bytes writable from `pixels`.
    pub pixels_bytes: usize,
    /// Bytes from one row to the next; 0 when rows are contiguous.
    pub stride_bytes: usize,
    /// `NERTCA_PIXELS_F32` or `NERTCA_PIXELS_U8`.
    pub format: u32,
    /// Value shown as 0, for `U8`. With `low` = `high`, the image's own minimum and maximum are used.
    pub low: f64,
    /// Value shown as 255, for `U8`.
    pub high: f64,
}

/// A regular grid of points in patient coordinates (LPS), left fastest, superior slowest.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct nertca_grid {
    /// `sizeof(nertca_grid)`.
    pub size: usize,
    /// First point, mm.
    pub origin_mm: [f64; 3],
    /// Distance between neighbours, mm.
    pub spacing_mm: [f64; 3],
    /// Points along each axis, 1 to 4096; at most 2^30 in all.
    pub points: [u32; 3],
    /// One of `NERTCA_COMPONENT_*`.
    pub component: u32,
    /// Cardiac phase, from 0.
    pub phase: u32,
}

/// Progress of training.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct nertca_progress {
    /// `sizeof(nertca_progress)`.
    pub size: usize,
    /// One of `NERTCA_STATE_*`.
    pub state: u32,
    /// Number of iterations done.
    pub step: u32,
    /// Number of iterations of the run.
    pub iterations: u32,
    /// Number of frames trained on.
    pub frames: u32,
    /// Loss of the last iteration.
    pub loss: f64,
    /// PSNR of the last iteration's rays, dB; NaN for fits of Gaussians, which have no rays.
    pub psnr_db: f64,
    /// Iterations per second since the last start of training.
    pub iterations_per_s: f64,
}

/// Correction of a frame's geometry by calibration.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct nertca_correction {
    /// `sizeof(nertca_correction)`.
    pub size: usize,
    /// One of `NERTCA_CORRECTION_*`.
    pub kind: u32,
    /// Added to the stated primary angle, degrees.
    pub primary_deg: f64,
    /// Added to the stated secondary angle, degrees.
    pub secondary_deg: f64,
    /// Additional displacement of the patient by the table, beyond the stated one (LPS), mm.
    pub table_mm: [f64; 3],
    /// Displacement of the heart by breathing in this frame (LPS), mm.
    pub heart_shift_mm: [f64; 3],
    /// Root mean square displacement of the heart's image in this view by the correction, pixels, without the motion common to
    /// all views.
    pub moved_px: f64,
    /// Relative difference between this view's profiles and those of the other views before the correction.
    pub residual_before: f64,
    /// Relative difference between this view's profiles and those of the other views after the correction.
    pub residual_after: f64,
    /// Complete corrected geometry, including the displacement of the heart, as a row-major 3 x 4 projection from patient mm to
    /// homogeneous pixels (column, row; integers are pixel centres): a value for `nertca_geometry.matrix`.
    pub matrix: [[f64; 4]; 3],
}

/// Training uses the frame when it next takes frames in, if there are enough of them.
pub const NERTCA_USE_TRAINING: u32 = 0;
/// The frame is kept for scores.
pub const NERTCA_USE_VALIDATION: u32 = 1;
/// The phase of the frame is not known, because R-peaks do not cover its time.
pub const NERTCA_USE_NO_PHASE: u32 = 2;
/// Training frames show the view at one phase only, so a preset that looks for what moves (`fast`, `fast-mlp`) leaves it out.
pub const NERTCA_USE_ONE_PHASE: u32 = 3;

/// Phase, view and use of a frame.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct nertca_frame_status {
    /// `sizeof(nertca_frame_status)`.
    pub size: usize,
    /// One of `NERTCA_USE_*`.
    pub usage: u32,
    /// 1 when training used the frame, as it is now, when it last took frames in; 0 otherwise.
    pub taken_in: u32,
    /// Number of the view. Frames of one size whose geometries agree within a tenth of a pixel have the same number.
    pub view: u32,
    /// Phase nearest to the frame's time, from 0; -1 while it is not known.
    pub phase: i32,
    /// Time after that phase, counted in phases, from -0.5 to 0.5.
    pub after_phase: f64,
}

/// Field that a live picture showed.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct nertca_drawn {
    /// `sizeof(nertca_drawn)`.
    pub size: usize,
    /// Number of frames that it was fitted to; 0 for a checkpoint that was loaded.
    pub frames: u32,
    /// Number of iterations after which the oldest part of the picture was read.
    pub step: u32,
}

/// Vessels as trees of centrelines with radii: parameters of the search, and arrays for its result.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct nertca_tree {
    /// `sizeof(nertca_tree)`.
    pub size: usize,
    /// Threshold from which the dynamic field counts as vessel, 1/mm; 0 selects the threshold that scores use. Set to the
    /// threshold used.
    pub threshold_per_mm: f64,
    /// Minimum length by which a branch must extend beyond the vessel it leaves, mm; shorter end branches are omitted. 0
    /// selects three times the field's resolution.
    pub least_branch_mm: f64,
    /// Set to 1 where all phases have the same material points, to 0 where each phase has its own branches.
    pub followed: u32,
    /// Number of elements that each of the arrays `branch_*` has room for; set to the number of branches over all phases.
    pub branches: usize,
    /// Number of points that `points_mm` and `radius_mm` have room for; set to the number of points over all phases.
    pub points: usize,
    /// Cardiac phase of each branch, from 0.
    pub branch_phase: *mut u32,
    /// Index in these arrays of the branch that each branch leaves; -1 for a branch that begins at a root.
    pub branch_parent: *mut i32,
    /// Index of the first point of each branch, from 0.
    pub branch_first: *mut u32,
    /// Number of points of each branch; the first is the last point of its parent.
    pub branch_points: *mut u32,
    /// Points of the centrelines (LPS), mm; three numbers each.
    pub points_mm: *mut f64,
    /// Radius of the vessel at each point, mm: as the frames show it where they are known and the options state the attenuation of vessels, else as
    /// the field does.
    pub radius_mm: *mut f64,
    /// Half width of the interval that contains the true centreline with a probability of 68 %, along the least certain direction across the
    /// vessel, for each point, mm. This array and the next two may be null, and have room for `points` elements otherwise. They hold NaN where
    /// the reconstruction has no frames to compare with, as after a checkpoint was loaded, and with two views, whose vessels may have exchanged
    /// their depths where they cross.
    pub doubt_mm: *mut f64,
    /// Half width for the material point, mm, which also holds its motion along the vessel, which no view shows; NaN where points are not
    /// followed.
    pub doubt_with_motion_mm: *mut f64,
    /// Probability that a true vessel is within 3 mm of each point, 0 to 1.
    pub existence: *mut f64,
    /// Length of the gaps in each branch, mm; 0 where there are none. The field shows no vessel in a gap: two vessels are linked there because
    /// one points at the other. May be null.
    pub branch_gap_mm: *mut f64,
    /// Set to 1 where radii are those that the frames show, to 0 where they are those of the field, which shows thin vessels blurred.
    pub radii_from_images: u32,
}

/// A stenosis of the vessels that were found: a place where a vessel is narrower than its course elsewhere lets expect.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct nertca_lesion {
    /// `sizeof(nertca_lesion)`.
    pub size: usize,
    /// Cardiac phase, from 0.
    pub phase: u32,
    /// Branch with the least diameter, as its index in the arrays `branch_*` of `nertca_tree`.
    pub branch: u32,
    /// Point of the branch with the least diameter, from 0.
    pub point: u32,
    /// Position of the least diameter along the vessels, mm from the root.
    pub from_root_mm: f64,
    /// Length of the part that is narrowed by a tenth of the reference or more, mm.
    pub length_mm: f64,
    /// Least diameter, mm.
    pub min_diameter_mm: f64,
    /// Reference diameter there, mm: the stenosis is 1 - `min_diameter_mm` / `reference_diameter_mm`.
    pub reference_diameter_mm: f64,
}

/// Scores on the frames added for validation, and of the vessels in 3D where the truth is known.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct nertca_scores {
    /// `sizeof(nertca_scores)`.
    pub size: usize,
    /// Number of iterations of the model.
    pub step: u32,
    /// Number of images scored.
    pub images: u32,
    /// Mean Dice of the moving vessels; NaN without masks.
    pub dice_dynamic: f64,
    /// Mean Dice of both fields; NaN without masks.
    pub dice_total: f64,
    /// Mean PSNR, dB.
    pub psnr_db: f64,
    /// Mean structural similarity.
    pub ssim: f64,
    /// Attenuation from which the dynamic field counts as vessel, 1/mm.
    pub threshold_per_mm: f64,
    /// Number of phases whose true vessels are known as voxels (`nertca_reconstruction_set_true_vessels`).
    pub volume_phases: u32,
    /// Number of phases whose true vessels are known as a tree (`nertca_reconstruction_set_true_tree`).
    pub tree_phases: u32,
    /// Dice of the vessel voxels. This field and all that follow are means over the phases, and NaN where the truth is not
    /// known.
    pub volume_dice: f64,
    /// Mean distance from a voxel of one set to the nearest voxel of the other, with equal weight of both directions, mm.
    pub chamfer_mm: f64,
    /// The larger of both directions' 95th percentiles of these distances, mm.
    pub hausdorff95_mm: f64,
    /// Share of the true centreline's voxels that have a reconstructed one within 1 mm.
    pub true_centreline_found: f64,
    /// Share of the reconstructed centreline's voxels that have a true one within 1 mm.
    pub our_centreline_true: f64,
    /// Centreline Dice: the harmonic mean of the shares of each centreline inside the other set.
    pub cl_dice: f64,
    /// Number of connected components of the reconstruction that are at least as wide as a pixel at the isocentre.
    pub components: f64,
    /// Number of connected components of the truth.
    pub true_components: f64,
    /// Share of the true tree's length with a reconstructed centreline within 1 mm.
    pub tree_true_centreline_found: f64,
    /// Share of the reconstructed tree's length with a true centreline within 1 mm.
    pub tree_our_centreline_true: f64,
    /// Mean distance from the reconstructed centreline to the true one, mm.
    pub tree_ours_to_true_mm: f64,
    /// Number of connected trees of the reconstruction.
    pub tree_components: f64,
    /// Mean difference of the reconstructed radius and the true one, where the reconstructed centreline has a true one within 1
    /// mm, mm.
    pub radius_error_mm: f64,
    /// Root mean square of this difference, mm.
    pub radius_rmse_mm: f64,
    /// Mean distance between the displacements of reconstructed points since the reference phase and those of the nearest true
    /// points, mm.
    pub motion_error_mm: f64,
}

/// Receives progress of training from time to time; a non-zero result ends training. `progress` is valid during the call. It is
/// called on the thread that trains, with no lock held: it may call into the library, but must not stop, train or destroy the
/// same reconstruction.
pub type nertca_progress_callback =
    Option<unsafe extern "C" fn(progress: *const nertca_progress, user: *mut c_void) -> i32>;

/// Converts a state to its number.
pub(super) fn state_code(state: State) -> u32 {
    match state {
        State::Idle => NERTCA_STATE_IDLE,
        State::Running => NERTCA_STATE_RUNNING,
        State::Paused => NERTCA_STATE_PAUSED,
        State::Waiting => NERTCA_STATE_WAITING,
        State::Finished => NERTCA_STATE_FINISHED,
        State::Cancelled => NERTCA_STATE_CANCELLED,
        State::Failed => NERTCA_STATE_FAILED,
    }
}

/// A struct that begins with its size and for which every bit pattern is valid.
///
/// # Safety
/// `#[repr(C)]`, with a `usize` first, and no field with invalid bit patterns.
pub(super) unsafe trait Versioned: Copy {
    const NAME: &'static str;
    /// Size in the first ABI version that had the struct; fields after it are omitted for callers that do not know them.
    const FIRST: usize = size_of::<Self>();
}

macro_rules! versioned {
    ($($name:ident)*) => { $(
        // SAFETY: integers, floats, pointers and optional function pointers after a `usize`.
        unsafe impl Versioned for $name {
            const NAME: &'static str = stringify!($name);
        }
    )* };
}
versioned!(nertca_log nertca_geometry nertca_frame nertca_image nertca_grid nertca_progress nertca_correction
       nertca_lesion nertca_frame_status nertca_drawn);

// SAFETY: integers, floats and pointers after a `usize`.
unsafe impl Versioned for nertca_view {
    const NAME: &'static str = "nertca_view";
    const FIRST: usize = std::mem::offset_of!(nertca_view, after_phase);
}

// SAFETY: integers, floats and pointers after a `usize`.
unsafe impl Versioned for nertca_tree {
    const NAME: &'static str = "nertca_tree";
    const FIRST: usize = std::mem::offset_of!(nertca_tree, doubt_mm);
}

// SAFETY: integers, pointers and optional function pointers after a `usize`.
unsafe impl Versioned for nertca_vulkan {
    const NAME: &'static str = "nertca_vulkan";
    const FIRST: usize = std::mem::offset_of!(nertca_vulkan, subgroup_size_control);
}

// SAFETY: integers and floats after a `usize`.
unsafe impl Versioned for nertca_scores {
    const NAME: &'static str = "nertca_scores";
    const FIRST: usize = std::mem::offset_of!(nertca_scores, volume_phases);
}

fn check_size<T: Versioned>(size: usize) -> Outcome<()> {
    if size < T::FIRST || size > 4096 {
        let name = T::NAME;
        let problem =
            format!("{size} where sizeof({name}) = {} is needed: set the field `size` of the struct", size_of::<T>());
        return Err(Failure::argument(&format!("{name}.size"), problem));
    }
    Ok(())
}

/// Reads a struct of the caller. A longer struct, of a later version, is accepted if all fields unknown here are zero; fields
/// missing from a shorter struct are zero here.
///
/// # Safety
/// `from` must be null or point to a struct as long as its `size` says.
pub(super) unsafe fn read<T: Versioned>(from: *const T) -> Outcome<T> {
    if from.is_null() {
        return Err(Failure::argument(T::NAME, "is null"));
    }
    // SAFETY: the struct begins with its size.
    let size = unsafe { from.cast::<usize>().read_unaligned() };
    check_size::<T>(size)?;
    let known = size.min(size_of::<T>());
    // SAFETY: the struct is as long as its size says.
    let rest = unsafe { std::slice::from_raw_parts(from.cast::<u8>().add(known), size - known) };
    if rest.iter().any(|byte| *byte != 0) {
        return Err(Failure::argument(
            T::NAME,
            "has fields that this version of the library does not know, and they are not zero",
        ));
    }
    let mut value = std::mem::MaybeUninit::<T>::zeroed();
    // SAFETY: the struct is as long as its size says, ours has room for as much, and every bit pattern of it is valid.
    unsafe {
        std::ptr::copy_nonoverlapping(from.cast::<u8>(), value.as_mut_ptr().cast(), known);
        Ok(value.assume_init())
    }
}

/// Writes a struct of the caller, whose `size` must be set.
///
/// # Safety
/// `to` must be null or point to a struct as long as its `size` says.
pub(super) unsafe fn write<T: Versioned>(to: *mut T, value: impl FnOnce(usize) -> T) -> Outcome<()> {
    if to.is_null() {
        return Err(Failure::argument(T::NAME, "is null"));
    }
    // SAFETY: the struct begins with its size.
    let size = unsafe { to.cast::<usize>().read_unaligned() };
    check_size::<T>(size)?;
    let value = value(size);
    // SAFETY: the struct is as long as its size says, and bytes need no alignment.
    unsafe {
        std::ptr::copy_nonoverlapping((&raw const value).cast::<u8>(), to.cast::<u8>(), size.min(size_of::<T>()));
    }
    Ok(())
}

impl nertca_geometry {
    /// # Safety
    /// `matrix` must be null or point to 12 numbers.
    pub(super) unsafe fn geometry(&self) -> Outcome<Geometry> {
        check_size::<nertca_geometry>(self.size)?;
        if self.matrix.is_null() {
            return Ok(Geometry::CArm(CArm {
                primary_deg: self.primary_deg,
                secondary_deg: self.secondary_deg,
                sid_mm: self.sid_mm,
                sod_mm: self.sod_mm,
                pixel_mm: self.pixel_mm,
                offset_mm: self.offset_mm,
                table_mm: self.table_mm,
            }));
        }
        // SAFETY: the caller guarantees 12 numbers.
        let m = unsafe { self.matrix.cast::<[[f64; 4]; 3]>().read_unaligned() };
        Ok(Geometry::Matrix(Matrix { matrix: m }))
    }
}

/// Largest side of an image.
const MAX_SIDE: u32 = nertca_vk::formats::image_limits::MAX_SIDE as u32;

/// Checks width and height of an image.
pub(super) fn sides(width: u32, height: u32) -> Outcome<(usize, usize)> {
    for (name, side) in [("width", width), ("height", height)] {
        if side == 0 || side > MAX_SIDE {
            return Err(Failure::argument(name, format!("{side} is not in the accepted range, 1 to {MAX_SIDE}")));
        }
    }
    Ok((width as usize, height as usize))
}

/// Checks that rows of `row_bytes` fit, and returns the distance between rows.
pub(super) fn stride(name: &str, row_bytes: usize, height: usize, stride: usize, bytes: usize) -> Outcome<usize> {
    let stride = if stride == 0 { row_bytes } else { stride };
    if stride < row_bytes {
        return Err(Failure::argument(
            &format!("{name} stride"),
            format!("is {stride} bytes, but a row has {row_bytes} bytes"),
        ));
    }
    let needed = stride.checked_mul(height - 1).and_then(|n| n.checked_add(row_bytes));
    match needed {
        Some(needed) if needed <= bytes => Ok(stride),
        _ => Err(Failure::argument(
            &format!("{name}_bytes"),
            format!(
                "is {bytes}, but {height} rows at a stride of {stride} bytes need {}",
                needed.unwrap_or(usize::MAX)
            ),
        )),
    }
}

/// Returns the bytes of a pixel.
pub(super) fn pixel_bytes(format: u32) -> Outcome<usize> {
    match format {
        NERTCA_PIXELS_U8 => Ok(1),
        NERTCA_PIXELS_U16 => Ok(2),
        NERTCA_PIXELS_F32 => Ok(4),
        other => Err(Failure::argument("format", format!("{other} is not one of NERTCA_PIXELS_*"))),
    }
}

impl nertca_frame {
    /// Converts the frame; its pixels are copied as line integrals.
    ///
    /// # Safety
    /// Pointers must be null or readable for the stated lengths.
    pub(super) unsafe fn new_frame(&self) -> Outcome<NewFrame> {
        let (width, height) = sides(self.width, self.height)?;
        let bytes = pixel_bytes(self.format)?;
        if self.pixels.is_null() {
            return Err(Failure::argument("pixels", "is null"));
        }
        let apart = stride("pixels", width * bytes, height, self.stride_bytes, self.pixels_bytes)?;
        let scale = if self.scale == 0.0 { 1.0 } else { self.scale };
        let finite = |name: &str, value: f64| {
            if value.is_finite() { Ok(value) } else { Err(Failure::argument(name, format!("{value} is not finite"))) }
        };
        finite("scale", scale)?;
        let intensity = match self.intensity {
            NERTCA_INTENSITY_INTEGRAL => Intensity::Integral { scale, offset: finite("offset", self.offset)? },
            // (i0 - p) * scale = p * -scale + i0 * scale
            NERTCA_INTENSITY_LOG | NERTCA_INTENSITY_LINEAR if self.i0 <= 0.0 => {
                return Err(Failure::argument("i0", format!("{} is not positive", self.i0)));
            }
            NERTCA_INTENSITY_LOG => Intensity::Integral { scale: -scale, offset: finite("i0", self.i0)? * scale },
            NERTCA_INTENSITY_LINEAR => Intensity::Linear { i0: finite("i0", self.i0)? },
            other => return Err(Failure::argument("intensity", format!("{other} is not one of NERTCA_INTENSITY_*"))),
        };
        let mut integrals = Vec::with_capacity(width * height);
        for row in 0..height {
            // SAFETY: `stride` checked that every row lies within the bytes that the caller guarantees.
            let row = unsafe { std::slice::from_raw_parts(self.pixels.cast::<u8>().add(row * apart), width * bytes) };
            integrals.extend(row.chunks_exact(bytes).map(|p| {
                intensity.integral(match *p {
                    [a] => f32::from(a),
                    [a, b] => f32::from(u16::from_ne_bytes([a, b])),
                    [a, b, c, d] => f32::from_ne_bytes([a, b, c, d]),
                    _ => f32::NAN,
                })
            }));
        }
        let mask = if self.mask.is_null() {
            None
        } else {
            let apart = stride("mask", width, height, self.mask_stride_bytes, self.mask_bytes)?;
            let mut mask = Vec::with_capacity(width * height);
            for row in 0..height {
                // SAFETY: `stride` checked that every row lies within the bytes the caller gave for the mask.
                let row = unsafe { std::slice::from_raw_parts(self.mask.add(row * apart), width) };
                mask.extend(row.iter().map(|m| *m != 0));
            }
            Some(mask)
        };
        Ok(NewFrame {
            // SAFETY: the header requires that the geometry's matrix is null or has 12 numbers.
            geometry: unsafe { self.geometry.geometry() }?,
            moment: u32::try_from(self.phase).map_or(FrameTime::TimeS(self.time_s), FrameTime::Phase),
            split: match self.split {
                NERTCA_SPLIT_TRAIN => Split::Train,
                NERTCA_SPLIT_VALIDATION => Split::Validation,
                other => return Err(Failure::argument("split", format!("{other} is not one of NERTCA_SPLIT_*"))),
            },
            width,
            height,
            integrals,
            mask,
        })
    }
}

/// Version of the ABI: of functions, structs and constants. A library serves callers that were built against its own number,
/// which is also the number in its soname.
pub const NERTCA_ABI_VERSION: u32 = 0;

/// Version of this header, first number (major).
pub const NERTCA_VERSION_MAJOR: u32 = 0;
/// Version of this header, second number (minor).
pub const NERTCA_VERSION_MINOR: u32 = 4;
/// Version of this header, third number (patch).
pub const NERTCA_VERSION_PATCH: u32 = 0;

/// Returns the version of the library, as `major.minor.patch`. The text is static. Callable from any thread.
#[unsafe(no_mangle)]
pub extern "C" fn nertca_version() -> *const c_char {
    concat!(env!("CARGO_PKG_VERSION"), "\0").as_ptr().cast()
}

/// Returns the `NERTCA_ABI_VERSION` of the library in use, to compare with that of the header. Callable from any thread.
#[unsafe(no_mangle)]
pub extern "C" fn nertca_abi_version() -> u32 {
    NERTCA_ABI_VERSION
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn versions_agree() {
        let macros = format!("{NERTCA_VERSION_MAJOR}.{NERTCA_VERSION_MINOR}.{NERTCA_VERSION_PATCH}");
        assert_eq!(macros, env!("CARGO_PKG_VERSION"));
        let cmake = include_str!("../../../include/cmake/nertca_vkConfigVersion.cmake");
        assert!(cmake.contains(&format!("PACKAGE_VERSION {macros})")));
    }
}
