/* libnertca_vk: 4D reconstruction of the beating coronary arteries from 3 or 4 X-ray angiography views, on Vulkan.
 *
 * Every call returns a status, 0 for success; nertca_last_error gives the text of a failure. Handles are opaque and
 * checked: null, destroyed and foreign ones are errors. Buffers are the caller's, always with their length. Structs
 * begin with their size, to be set with sizeof; zero the rest before use. Text is UTF-8. Nothing is printed, no signal
 * handler is set, no environment is read but what the Vulkan loader and driver read themselves.
 * Calls may come from any thread at any time, where a function does not say otherwise. After a fork, handles made
 * before are errors in the child. The library stays mapped after dlclose. See docs/embedding.md. */

#ifndef NERTCA_VK_H
#define NERTCA_VK_H

/* Generated from the library's sources: do not edit. */

#include <stddef.h>
#include <stdint.h>

/**
 * Unsigned 8-bit pixels.
 */
#define NERTCA_PIXELS_U8 1

/**
 * Unsigned 16-bit pixels, in the machine's byte order.
 */
#define NERTCA_PIXELS_U16 2

/**
 * Pixels that are 32-bit floats.
 */
#define NERTCA_PIXELS_F32 3

/**
 * Pixel values `p` are line integrals of attenuation: `p * scale + offset`.
 */
#define NERTCA_INTENSITY_INTEGRAL 1

/**
 * Logarithmic detector: the line integral is `(i0 - p) * scale`; `i0` is positive.
 */
#define NERTCA_INTENSITY_LOG 2

/**
 * Detector linear in intensity: the line integral is `-ln(p / i0)`.
 */
#define NERTCA_INTENSITY_LINEAR 3

/**
 * A frame to train on.
 */
#define NERTCA_SPLIT_TRAIN 0

/**
 * A frame used only for scores.
 */
#define NERTCA_SPLIT_VALIDATION 1

/**
 * Both fields.
 */
#define NERTCA_COMPONENT_TOTAL 0

/**
 * Static field: the static background.
 */
#define NERTCA_COMPONENT_STATIC 1

/**
 * Dynamic field: the moving vessels.
 */
#define NERTCA_COMPONENT_DYNAMIC 2

/**
 * Projection by line integrals of attenuation, as in an angiogram.
 */
#define NERTCA_PROJECTION_DRR 0

/**
 * Projection by the maximum attenuation along each ray, 1/mm.
 */
#define NERTCA_PROJECTION_MIP 1

/**
 * Live quality: display rates, also during training. Gaussians are drawn directly; other fields through volumes baked from
 * them, whose resolution is their cell size (about 0.8 mm).
 */
#define NERTCA_QUALITY_LIVE 0

/**
 * Exact quality: from the fields themselves, many times slower.
 */
#define NERTCA_QUALITY_EXACT 1

/**
 * Not training.
 */
#define NERTCA_STATE_IDLE 0

/**
 * Training in the background.
 */
#define NERTCA_STATE_RUNNING 1

/**
 * Paused by `nertca_reconstruction_pause`.
 */
#define NERTCA_STATE_PAUSED 2

/**
 * Waiting: training in the background goes on as soon as there are enough frames that the settings can be met with.
 */
#define NERTCA_STATE_WAITING 3

/**
 * All iterations are done.
 */
#define NERTCA_STATE_FINISHED 4

/**
 * The progress callback ended training.
 */
#define NERTCA_STATE_CANCELLED 5

/**
 * An error ended training.
 */
#define NERTCA_STATE_FAILED 6

/**
 * Training uses the frame when it next takes frames in, if there are enough of them.
 */
#define NERTCA_USE_TRAINING 0

/**
 * The frame is kept for scores.
 */
#define NERTCA_USE_VALIDATION 1

/**
 * The phase of the frame is not known, because R-peaks do not cover its time.
 */
#define NERTCA_USE_NO_PHASE 2

/**
 * Training frames show the view at one phase only, so a preset that looks for what moves (`fast`, `fast-mlp`) leaves it out.
 */
#define NERTCA_USE_ONE_PHASE 3

/**
 * Version of the ABI: of functions, structs and constants. A library serves callers that were built against its own number,
 * which is also the number in its soname.
 */
#define NERTCA_ABI_VERSION 0

/**
 * Version of this header, first number (major).
 */
#define NERTCA_VERSION_MAJOR 0

/**
 * Version of this header, second number (minor).
 */
#define NERTCA_VERSION_MINOR 4

/**
 * Version of this header, third number (patch).
 */
#define NERTCA_VERSION_PATCH 0

/**
 * Severity of a log message: an error.
 */
#define NERTCA_LOG_ERROR 1

/**
 * Severity of a log message: a warning.
 */
#define NERTCA_LOG_WARNING 2

/**
 * Severity of a log message: information on the work being done, and the reasons.
 */
#define NERTCA_LOG_INFO 3

/**
 * The stated geometry of the frame is used.
 */
#define NERTCA_CORRECTION_STATED 0

/**
 * Angles and position of the frame's view are corrected.
 */
#define NERTCA_CORRECTION_STATIC 1

/**
 * The view is corrected, and so is a displacement of the heart in this frame.
 */
#define NERTCA_CORRECTION_BREATHING 2

/**
 * A buffer in device memory that other APIs and processes can import.
 */
typedef struct nertca_buffer nertca_buffer;

/**
 * A device with a log and limits. Make one per device; it can have any number of reconstructions.
 */
typedef struct nertca_context nertca_context;

/**
 * A reconstruction: its frames, its training, its fields.
 */
typedef struct nertca_reconstruction nertca_reconstruction;

/**
 * A semaphore of the device that other APIs and processes can import.
 */
typedef struct nertca_semaphore nertca_semaphore;

/**
 * Result of a call: 0 for success, negative for an error whose text `nertca_last_error` returns.
 */
typedef int32_t nertca_status;

/**
 * Receives log messages: level, UTF-8 text, and the caller's pointer. It is called on the thread on which a message arises,
 * which may be the training thread, and possibly on several threads at once. It must not call into the library.
 */
typedef void (*nertca_log_callback)(uint32_t level, const char *text, void *user);

/**
 * Receiver of log messages.
 */
typedef struct {
  /**
   * `sizeof(nertca_log)`.
   */
  size_t size;
  /**
   * Called for each message.
   */
  nertca_log_callback callback;
  /**
   * Passed to the callback unchanged.
   */
  void *user;
  /**
   * Lowest severity to report, one of `NERTCA_LOG_*`.
   */
  uint32_t level;
} nertca_log;

/**
 * A Vulkan device that the caller made and continues to own. It must outlive the context made from it.
 */
typedef struct {
  /**
   * `sizeof(nertca_vulkan)`.
   */
  size_t size;
  /**
   * `vkGetInstanceProcAddr`; null selects that of the system's loader.
   */
  const void *get_instance_proc_addr;
  /**
   * `VkInstance`, made for Vulkan 1.2 or newer.
   */
  void *instance;
  /**
   * `VkPhysicalDevice`.
   */
  void *physical_device;
  /**
   * `VkDevice`, made with the feature `timelineSemaphore`.
   */
  void *device;
  /**
   * `VkQueue` that supports compute.
   */
  void *queue;
  /**
   * Family of the queue.
   */
  uint32_t queue_family;
  /**
   * Non-zero when the device was made with the feature `bufferDeviceAddress`.
   */
  uint32_t buffer_device_address;
  /**
   * Non-zero when the device was made with `VK_KHR_external_memory_fd`.
   */
  uint32_t external_memory_fd;
  /**
   * Called before every use of the queue, for a short time, on any thread; null when only the library uses the queue.
   */
  void (*lock)(void *user);
  /**
   * Called after every use of the queue, to release it; null exactly when `lock` is.
   */
  void (*unlock)(void *user);
  /**
   * Passed to `lock` and `unlock`.
   */
  void *user;
  /**
   * Non-zero when the device was made with the features `subgroupSizeControl` and `computeFullSubgroups` (of
   * `VK_EXT_subgroup_size_control`, or of Vulkan 1.3): sums then use shuffles, as on a device that the library opens itself.
   */
  uint32_t subgroup_size_control;
  /**
   * Non-zero when the device was made with `VK_KHR_cooperative_matrix` and its feature `cooperativeMatrix`, and with
   * `shaderFloat16`, `vulkanMemoryModel` and `vulkanMemoryModelDeviceScope`: networks then use matrices, where the library
   * has kernels for the device's shapes. Requires `subgroup_size_control` as well.
   */
  uint32_t cooperative_matrix;
  /**
   * Non-zero when the device was made with `VK_KHR_external_semaphore_fd`.
   */
  uint32_t external_semaphore_fd;
} nertca_vulkan;

/**
 * Geometry of an image. Patient coordinates are left, posterior, superior (LPS), mm, from the isocentre.
 */
typedef struct {
  /**
   * `sizeof(nertca_geometry)`.
   */
  size_t size;
  /**
   * Primary angle in degrees, LAO positive (DICOM PositionerPrimaryAngle).
   */
  double primary_deg;
  /**
   * Secondary angle in degrees, cranial positive (DICOM PositionerSecondaryAngle).
   */
  double secondary_deg;
  /**
   * Distance from source to detector, mm.
   */
  double sid_mm;
  /**
   * Distance from source to isocentre, mm.
   */
  double sod_mm;
  /**
   * Pixel pitch on the detector along columns and rows, mm.
   */
  double pixel_mm[2];
  /**
   * Offset of the detector's centre along columns and rows, mm.
   */
  double offset_mm[2];
  /**
   * Displacement of the patient by the table (LPS), mm.
   */
  double table_mm[3];
  /**
   * Null, or 12 numbers that replace all of the above: a row-major 3 x 4 projection from patient mm to homogeneous
   * pixels (column, row; integers are pixel centres).
   */
  const double *matrix;
} nertca_geometry;

/**
 * A calibrated angiogram. Frames of one size whose geometries agree within a tenth of a pixel, over a cube of 100 mm around the
 * isocentre, are a view: a C-arm that reports its angles for each frame does so with noise. All frames of a view are used with the
 * geometry of its first one.
 */
typedef struct {
  /**
   * `sizeof(nertca_frame)`.
   */
  size_t size;
  /**
   * Geometry of the image.
   */
  nertca_geometry geometry;
  /**
   * First row of the pixels, which are copied during the call.
   */
  const void *pixels;
  /**
   * Number of bytes readable from `pixels`.
   */
  size_t pixels_bytes;
  /**
   * Bytes from one row to the next; 0 when rows are contiguous.
   */
  size_t stride_bytes;
  /**
   * Columns, 1 to 8192. Frames of a reconstruction may differ in size.
   */
  uint32_t width;
  /**
   * Rows, 1 to 8192.
   */
  uint32_t height;
  /**
   * One of `NERTCA_PIXELS_*`.
   */
  uint32_t format;
  /**
   * Meaning of the values, one of `NERTCA_INTENSITY_*`.
   */
  uint32_t intensity;
  /**
   * Factor on the values, for `INTEGRAL` and `LOG`; 0 stands for 1.
   */
  double scale;
  /**
   * Added after the factor, for `INTEGRAL`.
   */
  double offset;
  /**
   * Value of an unattenuated ray, for `LOG` and `LINEAR`.
   */
  double i0;
  /**
   * Cardiac phase from 0; negative to find it from `time_s` and the R-peaks.
   */
  int32_t phase;
  /**
   * `NERTCA_SPLIT_TRAIN` or `NERTCA_SPLIT_VALIDATION`.
   */
  uint32_t split;
  /**
   * Time stamp on the clock of the R-peaks, seconds.
   */
  double time_s;
  /**
   * Null, or a vessel mask with one byte per pixel, non-zero inside vessels.
   */
  const uint8_t *mask;
  /**
   * Number of bytes readable from `mask`.
   */
  size_t mask_bytes;
  /**
   * Bytes from one row of the mask to the next; 0 when rows are contiguous.
   */
  size_t mask_stride_bytes;
} nertca_frame;

/**
 * Phase, view and use of a frame.
 */
typedef struct {
  /**
   * `sizeof(nertca_frame_status)`.
   */
  size_t size;
  /**
   * One of `NERTCA_USE_*`.
   */
  uint32_t usage;
  /**
   * 1 when training used the frame, as it is now, when it last took frames in; 0 otherwise.
   */
  uint32_t taken_in;
  /**
   * Number of the view. Frames of one size whose geometries agree within a tenth of a pixel have the same number.
   */
  uint32_t view;
  /**
   * Phase nearest to the frame's time, from 0; -1 while it is not known.
   */
  int32_t phase;
  /**
   * Time after that phase, counted in phases, from -0.5 to 0.5.
   */
  double after_phase;
} nertca_frame_status;

/**
 * Progress of training.
 */
typedef struct {
  /**
   * `sizeof(nertca_progress)`.
   */
  size_t size;
  /**
   * One of `NERTCA_STATE_*`.
   */
  uint32_t state;
  /**
   * Number of iterations done.
   */
  uint32_t step;
  /**
   * Number of iterations of the run.
   */
  uint32_t iterations;
  /**
   * Number of frames trained on.
   */
  uint32_t frames;
  /**
   * Loss of the last iteration.
   */
  double loss;
  /**
   * PSNR of the last iteration's rays, dB; NaN for fits of Gaussians, which have no rays.
   */
  double psnr_db;
  /**
   * Iterations per second since the last start of training.
   */
  double iterations_per_s;
} nertca_progress;

/**
 * Correction of a frame's geometry by calibration.
 */
typedef struct {
  /**
   * `sizeof(nertca_correction)`.
   */
  size_t size;
  /**
   * One of `NERTCA_CORRECTION_*`.
   */
  uint32_t kind;
  /**
   * Added to the stated primary angle, degrees.
   */
  double primary_deg;
  /**
   * Added to the stated secondary angle, degrees.
   */
  double secondary_deg;
  /**
   * Additional displacement of the patient by the table, beyond the stated one (LPS), mm.
   */
  double table_mm[3];
  /**
   * Displacement of the heart by breathing in this frame (LPS), mm.
   */
  double heart_shift_mm[3];
  /**
   * Root mean square displacement of the heart's image in this view by the correction, pixels, without the motion common to
   * all views.
   */
  double moved_px;
  /**
   * Relative difference between this view's profiles and those of the other views before the correction.
   */
  double residual_before;
  /**
   * Relative difference between this view's profiles and those of the other views after the correction.
   */
  double residual_after;
  /**
   * Complete corrected geometry, including the displacement of the heart, as a row-major 3 x 4 projection from patient mm to
   * homogeneous pixels (column, row; integers are pixel centres): a value for `nertca_geometry.matrix`.
   */
  double matrix[3][4];
} nertca_correction;

/**
 * Receives progress of training from time to time; a non-zero result ends training. `progress` is valid during the call. It is
 * called on the thread that trains, with no lock held: it may call into the library, but must not stop, train or destroy the
 * same reconstruction.
 */
typedef int32_t (*nertca_progress_callback)(const nertca_progress *progress, void *user);

/**
 * Description of a view to draw.
 */
typedef struct {
  /**
   * `sizeof(nertca_view)`.
   */
  size_t size;
  /**
   * Geometry of the view.
   */
  nertca_geometry geometry;
  /**
   * Columns, 1 to 8192.
   */
  uint32_t width;
  /**
   * Rows, 1 to 8192.
   */
  uint32_t height;
  /**
   * Cardiac phase, from 0.
   */
  uint32_t phase;
  /**
   * One of `NERTCA_COMPONENT_*`.
   */
  uint32_t component;
  /**
   * One of `NERTCA_PROJECTION_*`.
   */
  uint32_t projection;
  /**
   * One of `NERTCA_QUALITY_*`.
   */
  uint32_t quality;
  /**
   * Time after `phase`, counted in phases, from 0 to below 1: such as the rest of what `nertca_reconstruction_beat_phase`
   * returns. Between two phases, live quality draws line integrals of the form of `fast`, one set of moving Gaussians; exact
   * quality also draws networks.
   */
  double after_phase;
} nertca_view;

/**
 * Memory to draw into.
 */
typedef struct {
  /**
   * `sizeof(nertca_image)`.
   */
  size_t size;
  /**
   * First row.
   */
  void *pixels;
  /**
   * Number of bytes writable from `pixels`.
   */
  size_t pixels_bytes;
  /**
   * Bytes from one row to the next; 0 when rows are contiguous.
   */
  size_t stride_bytes;
  /**
   * `NERTCA_PIXELS_F32` or `NERTCA_PIXELS_U8`.
   */
  uint32_t format;
  /**
   * Value shown as 0, for `U8`. With `low` = `high`, the image's own minimum and maximum are used.
   */
  double low;
  /**
   * Value shown as 255, for `U8`.
   */
  double high;
} nertca_image;

/**
 * Field that a live picture showed.
 */
typedef struct {
  /**
   * `sizeof(nertca_drawn)`.
   */
  size_t size;
  /**
   * Number of frames that it was fitted to; 0 for a checkpoint that was loaded.
   */
  uint32_t frames;
  /**
   * Number of iterations after which the oldest part of the picture was read.
   */
  uint32_t step;
} nertca_drawn;

/**
 * A regular grid of points in patient coordinates (LPS), left fastest, superior slowest.
 */
typedef struct {
  /**
   * `sizeof(nertca_grid)`.
   */
  size_t size;
  /**
   * First point, mm.
   */
  double origin_mm[3];
  /**
   * Distance between neighbours, mm.
   */
  double spacing_mm[3];
  /**
   * Points along each axis, 1 to 4096; at most 2^30 in all.
   */
  uint32_t points[3];
  /**
   * One of `NERTCA_COMPONENT_*`.
   */
  uint32_t component;
  /**
   * Cardiac phase, from 0.
   */
  uint32_t phase;
} nertca_grid;

/**
 * Vessels as trees of centrelines with radii: parameters of the search, and arrays for its result.
 */
typedef struct {
  /**
   * `sizeof(nertca_tree)`.
   */
  size_t size;
  /**
   * Threshold from which the dynamic field counts as vessel, 1/mm; 0 selects the threshold that scores use. Set to the
   * threshold used.
   */
  double threshold_per_mm;
  /**
   * Minimum length by which a branch must extend beyond the vessel it leaves, mm; shorter end branches are omitted. 0
   * selects three times the field's resolution.
   */
  double least_branch_mm;
  /**
   * Set to 1 where all phases have the same material points, to 0 where each phase has its own branches.
   */
  uint32_t followed;
  /**
   * Number of elements that each of the arrays `branch_*` has room for; set to the number of branches over all phases.
   */
  size_t branches;
  /**
   * Number of points that `points_mm` and `radius_mm` have room for; set to the number of points over all phases.
   */
  size_t points;
  /**
   * Cardiac phase of each branch, from 0.
   */
  uint32_t *branch_phase;
  /**
   * Index in these arrays of the branch that each branch leaves; -1 for a branch that begins at a root.
   */
  int32_t *branch_parent;
  /**
   * Index of the first point of each branch, from 0.
   */
  uint32_t *branch_first;
  /**
   * Number of points of each branch; the first is the last point of its parent.
   */
  uint32_t *branch_points;
  /**
   * Points of the centrelines (LPS), mm; three numbers each.
   */
  double *points_mm;
  /**
   * Radius of the vessel at each point, mm: as the frames show it where they are known and the options state the attenuation of vessels, else as
   * the field does.
   */
  double *radius_mm;
  /**
   * Half width of the interval that contains the true centreline with a probability of 68 %, along the least certain direction across the
   * vessel, for each point, mm. This array and the next two may be null, and have room for `points` elements otherwise. They hold NaN where
   * the reconstruction has no frames to compare with, as after a checkpoint was loaded, and with two views, whose vessels may have exchanged
   * their depths where they cross.
   */
  double *doubt_mm;
  /**
   * Half width for the material point, mm, which also holds its motion along the vessel, which no view shows; NaN where points are not
   * followed.
   */
  double *doubt_with_motion_mm;
  /**
   * Probability that a true vessel is within 3 mm of each point, 0 to 1.
   */
  double *existence;
  /**
   * Length of the gaps in each branch, mm; 0 where there are none. The field shows no vessel in a gap: two vessels are linked there because
   * one points at the other. May be null.
   */
  double *branch_gap_mm;
  /**
   * Set to 1 where radii are those that the frames show, to 0 where they are those of the field, which shows thin vessels blurred.
   */
  uint32_t radii_from_images;
} nertca_tree;

/**
 * A stenosis of the vessels that were found: a place where a vessel is narrower than its course elsewhere lets expect.
 */
typedef struct {
  /**
   * `sizeof(nertca_lesion)`.
   */
  size_t size;
  /**
   * Cardiac phase, from 0.
   */
  uint32_t phase;
  /**
   * Branch with the least diameter, as its index in the arrays `branch_*` of `nertca_tree`.
   */
  uint32_t branch;
  /**
   * Point of the branch with the least diameter, from 0.
   */
  uint32_t point;
  /**
   * Position of the least diameter along the vessels, mm from the root.
   */
  double from_root_mm;
  /**
   * Length of the part that is narrowed by a tenth of the reference or more, mm.
   */
  double length_mm;
  /**
   * Least diameter, mm.
   */
  double min_diameter_mm;
  /**
   * Reference diameter there, mm: the stenosis is 1 - `min_diameter_mm` / `reference_diameter_mm`.
   */
  double reference_diameter_mm;
} nertca_lesion;

/**
 * Scores on the frames added for validation, and of the vessels in 3D where the truth is known.
 */
typedef struct {
  /**
   * `sizeof(nertca_scores)`.
   */
  size_t size;
  /**
   * Number of iterations of the model.
   */
  uint32_t step;
  /**
   * Number of images scored.
   */
  uint32_t images;
  /**
   * Mean Dice of the moving vessels; NaN without masks.
   */
  double dice_dynamic;
  /**
   * Mean Dice of both fields; NaN without masks.
   */
  double dice_total;
  /**
   * Mean PSNR, dB.
   */
  double psnr_db;
  /**
   * Mean structural similarity.
   */
  double ssim;
  /**
   * Attenuation from which the dynamic field counts as vessel, 1/mm.
   */
  double threshold_per_mm;
  /**
   * Number of phases whose true vessels are known as voxels (`nertca_reconstruction_set_true_vessels`).
   */
  uint32_t volume_phases;
  /**
   * Number of phases whose true vessels are known as a tree (`nertca_reconstruction_set_true_tree`).
   */
  uint32_t tree_phases;
  /**
   * Dice of the vessel voxels. This field and all that follow are means over the phases, and NaN where the truth is not
   * known.
   */
  double volume_dice;
  /**
   * Mean distance from a voxel of one set to the nearest voxel of the other, with equal weight of both directions, mm.
   */
  double chamfer_mm;
  /**
   * The larger of both directions' 95th percentiles of these distances, mm.
   */
  double hausdorff95_mm;
  /**
   * Share of the true centreline's voxels that have a reconstructed one within 1 mm.
   */
  double true_centreline_found;
  /**
   * Share of the reconstructed centreline's voxels that have a true one within 1 mm.
   */
  double our_centreline_true;
  /**
   * Centreline Dice: the harmonic mean of the shares of each centreline inside the other set.
   */
  double cl_dice;
  /**
   * Number of connected components of the reconstruction that are at least as wide as a pixel at the isocentre.
   */
  double components;
  /**
   * Number of connected components of the truth.
   */
  double true_components;
  /**
   * Share of the true tree's length with a reconstructed centreline within 1 mm.
   */
  double tree_true_centreline_found;
  /**
   * Share of the reconstructed tree's length with a true centreline within 1 mm.
   */
  double tree_our_centreline_true;
  /**
   * Mean distance from the reconstructed centreline to the true one, mm.
   */
  double tree_ours_to_true_mm;
  /**
   * Number of connected trees of the reconstruction.
   */
  double tree_components;
  /**
   * Mean difference of the reconstructed radius and the true one, where the reconstructed centreline has a true one within 1
   * mm, mm.
   */
  double radius_error_mm;
  /**
   * Root mean square of this difference, mm.
   */
  double radius_rmse_mm;
  /**
   * Mean distance between the displacements of reconstructed points since the reference phase and those of the nearest true
   * points, mm.
   */
  double motion_error_mm;
} nertca_scores;

/**
 * Success.
 */
#define NERTCA_OK 0

/**
 * An argument is null, out of range, or contradicts another.
 */
#define NERTCA_ERROR_ARGUMENT -1

/**
 * A handle was destroyed, has another type, or is not a handle.
 */
#define NERTCA_ERROR_HANDLE -2

/**
 * Data that was passed (for example a checkpoint) is malformed.
 */
#define NERTCA_ERROR_DATA -3

/**
 * The operating system refused a file operation.
 */
#define NERTCA_ERROR_IO -4

/**
 * No device fits, or it lacks a requested feature.
 */
#define NERTCA_ERROR_DEVICE -5

/**
 * The device stopped answering: destroy everything made from the context, then the context.
 */
#define NERTCA_ERROR_DEVICE_LOST -6

/**
 * Memory ran out, or the context's limit was reached.
 */
#define NERTCA_ERROR_MEMORY -7

/**
 * Training diverged; the last good state is kept.
 */
#define NERTCA_ERROR_DIVERGED -8

/**
 * A callback cancelled the call.
 */
#define NERTCA_ERROR_CANCELLED -9

/**
 * The call is not possible while something else is active (training, or handles that still exist).
 */
#define NERTCA_ERROR_BUSY -10

/**
 * The buffer passed is too small; the required length was written.
 */
#define NERTCA_ERROR_BUFFER -11

/**
 * The call needs something that is not there yet: frames, or training.
 */
#define NERTCA_ERROR_NOT_READY -12

/**
 * A handle of the parent process was used after a fork.
 */
#define NERTCA_ERROR_FORKED -13

/**
 * A fault of this library. Please report it.
 */
#define NERTCA_ERROR_INTERNAL -14

#ifdef __cplusplus
extern "C" {
#endif // __cplusplus

/**
 * Returns the text of the last failed call on `handle` (of any type) in this thread, or of the last failed call of all when
 * `handle` is null; empty when there was none. The text is UTF-8 with a closing zero, truncated to `size` bytes. `*length`
 * receives the full length without the zero. With a null `text` and a `size` of 0, only the length is returned.
 *
 * Callable from any thread. Texts of calls without a handle (those that create one) are found under null.
 *
 * @return NERTCA_OK, NERTCA_ERROR_BUFFER when the text was truncated, NERTCA_ERROR_ARGUMENT.
 *
 * # Safety
 * `text` must hold `size` bytes; `length` must be writable or null.
 */
nertca_status nertca_last_error(const void *handle,
                                char *text,
                                size_t size,
                                size_t *length);

/**
 * Returns a short description of a status, for logs. The text is static, and never null. Callable from any thread.
 */
const char *nertca_status_text(nertca_status status);

/**
 * Returns the version of the library, as `major.minor.patch`. The text is static. Callable from any thread.
 */
const char *nertca_version(void);

/**
 * Returns the `NERTCA_ABI_VERSION` of the library in use, to compare with that of the header. Callable from any thread.
 */
uint32_t nertca_abi_version(void);

/**
 * Opens a device.
 *
 * `options` are lines of `key = value` or a JSON object, or null for defaults: `device` (index, part of the name or UUID, the
 * best device by default; `none` for a context that checks and keeps frames but cannot train), `validation` (true turns on the
 * Khronos validation layer, which then reports to the log), `cache_dir` (directory in which compiled kernels are kept between
 * processes), `memory_limit_mib` (limit on the device memory of everything made from the context), `deterministic` (true
 * refuses whatever would make results depend on timing: frames added while training in the background), `layers` (f32 or
 * matrices: computation of the network's layers; chosen for the device by default).
 *
 * `log` may be null. `*context` is null on failure; `nertca_last_error(NULL, ...)` then returns the text. Callable from any
 * thread.
 *
 * # Safety
 * `options` must be null or end with a zero, `log` be null or as long as its `size` says, `context` be writable.
 */
nertca_status nertca_context_create(const char *options,
                                    const nertca_log *log,
                                    nertca_context **context);

/**
 * Makes a context like `nertca_context_create`, on the caller's Vulkan device: both then share one GPU, its memory and, if
 * wanted, buffers. The options `device` and `validation` do not apply. Instance, device and queue must outlive the context,
 * which does not destroy them.
 *
 * # Safety
 * `options`, `log` and `context` as in `nertca_context_create`; the handles in `vulkan` must be valid and made as its fields
 * say.
 */
nertca_status nertca_context_adopt(const nertca_vulkan *vulkan,
                                   const char *options,
                                   const nertca_log *log,
                                   nertca_context **context);

/**
 * Describes the device and the computation paths chosen for it, as JSON. `text`, `size` and `length` work as in
 * `nertca_last_error`, but the part about memory may be longer at the next call. Callable from any thread.
 *
 * # Safety
 * `text` must hold `size` bytes; `length` must be writable or null.
 */
nertca_status nertca_context_describe(nertca_context *context, char *text, size_t size, size_t *length);

/**
 * Lists all Vulkan devices of this machine, usable or not, as JSON. `text`, `size` and `length` work as in
 * `nertca_last_error`, but the part about free memory may be longer at the next call. Callable from any thread.
 *
 * # Safety
 * `text` must hold `size` bytes; `length` must be writable or null.
 */
nertca_status nertca_devices(char *text, size_t size, size_t *length);

/**
 * Closes the device. Null is allowed, and does nothing.
 *
 * Waits for calls on the context in other threads.
 *
 * @return NERTCA_ERROR_BUSY, with nothing done, while reconstructions, buffers or semaphores made from it exist, or from inside a callback
 * of a call on it.
 *
 * # Safety
 * Any value is allowed: a stale handle is an error.
 */
nertca_status nertca_context_destroy(nertca_context *context);

/**
 * Creates a reconstruction without frames.
 *
 * `options` are lines of `key = value` or a JSON object: `phases` (number of cardiac phases; required, unless `still` is true), `still`
 * (`true` for an object at rest, as in `dataset.json`: frames of phase 0 show it, and frames of phase 1 the same without vessels, which
 * are estimated for views that have none; frames with a time need no R-peaks; the result has one phase, 0), `depth_half_extent_mm`
 * (attenuation is searched within this distance of the isocentre plane; 100), `vessel_attenuation_per_mm` (attenuation of
 * filled vessels, where known: sets the Dice threshold), `preset` (fast, fast-mlp, paper, public-code, nert-ca, nerf-ca, r2-gaussian,
 * x-gaussian or sax-nerf) and every key that `nertca-vk train --print-config` shows, as in `train.iterations = 800`.
 *
 * `*reconstruction` is null on failure. Callable from any thread.
 *
 * # Safety
 * `options` must be null or end with a zero; `reconstruction` must be writable.
 */
nertca_status nertca_reconstruction_create(nertca_context *context,
                                           const char *options,
                                           nertca_reconstruction **reconstruction);

/**
 * Destroys a reconstruction: stops its training, ends long calls on it in other threads, waits for all calls there, and frees its
 * memory. `_train`, `_evaluate`, `_tree`, `_sample` and exact pictures under way return NERTCA_ERROR_CANCELLED, after the iterations
 * or before the slice that they are at. Null is allowed, and does nothing. Callable from any thread except inside its own callbacks.
 *
 * @return NERTCA_ERROR_BUSY, with nothing done, from inside a callback of a call on it.
 *
 * # Safety
 * Any value is allowed: a stale handle is an error.
 */
nertca_status nertca_reconstruction_destroy(nertca_reconstruction *reconstruction);

/**
 * Adds a frame; its pixels are copied. Frames may be added at any time. Training in the background takes a new frame in by
 * itself after a short while (frames that arrive in quick succession are taken in together); other training takes it in when
 * it next begins. Callable from any thread.
 *
 * @return NERTCA_ERROR_ARGUMENT naming the field that is wrong; NERTCA_ERROR_BUSY while training in the background in a
 * deterministic context.
 *
 * # Safety
 * `frame` must be as long as its `size` says, and its pointers readable for the stated lengths.
 */
nertca_status nertca_reconstruction_add_frame(nertca_reconstruction *reconstruction,
                                              const nertca_frame *frame);

/**
 * Removes a frame, whose memory is freed; the others keep their numbers. Training in the background takes that in like a new frame;
 * training that has ended does so when it is next started. Callable from any thread.
 *
 * @return NERTCA_ERROR_ARGUMENT for a frame that was not added or was removed before; NERTCA_ERROR_BUSY while training in the
 * background in a deterministic context.
 */
nertca_status nertca_reconstruction_remove_frame(nertca_reconstruction *reconstruction,
                                                 uint32_t frame);

/**
 * Returns phase, view and use of a frame. Frames count from 0 in the order in which they were added. Callable from any thread.
 *
 * @return NERTCA_ERROR_ARGUMENT for a frame that was not added or was removed.
 *
 * # Safety
 * `status` must be writable, with its size set.
 */
nertca_status nertca_reconstruction_frame_status(nertca_reconstruction *reconstruction,
                                                 uint32_t frame,
                                                 nertca_frame_status *status);

/**
 * Returns the phase of a time on the clock of the R-peaks, seconds, as for a frame with this time stamp: from 0 to below the number
 * of phases, usually between two. Split into its whole part and the rest, it is `phase` and `after_phase` of a view. Callable from
 * any thread.
 *
 * @return NERTCA_ERROR_NOT_READY for a time that R-peaks do not cover.
 *
 * # Safety
 * `phase` must be writable.
 */
nertca_status nertca_reconstruction_beat_phase(nertca_reconstruction *reconstruction,
                                               double time_s,
                                               double *phase);

/**
 * Sets the times of the R-peaks, seconds, in ascending order. Frames with time stamps get their phase from them: systole keeps
 * its length (310 ms, 35 % of the phases) and diastole takes the rest of the beat. The phases 0 to T - 1 are the middles of T equal
 * parts of the beat, so a frame at an R-peak lies half a phase before phase 0, at T - 0.5. A method with one set of moving Gaussians
 * fits each frame at its own time within the phase. A call replaces the times given earlier, so that a growing list can be
 * given repeatedly. A null `times_s` with a `count` of 0 clears them. Callable from any thread.
 *
 * @return NERTCA_ERROR_ARGUMENT for fewer than two times, and for times that do not increase; NERTCA_ERROR_BUSY while training in the
 * background in a deterministic context.
 *
 * # Safety
 * `times_s` must be readable for `count` numbers.
 */
nertca_status nertca_reconstruction_set_r_peaks(nertca_reconstruction *reconstruction,
                                                const double *times_s,
                                                size_t count);

/**
 * States vessels that are known before, for example from a CT: points along their centrelines, about a millimetre apart, as patient mm
 * (left, posterior, superior) with the isocentre at the origin. They decide where vessels are sought first; the angiograms decide whether
 * they are there. A call replaces the points given earlier and acts on fits that begin later. A null `points_mm` with a `count` of 0
 * clears them. Callable from any thread.
 *
 * @return NERTCA_ERROR_ARGUMENT for coordinates that are not finite, and with a preset other than `fast`; NERTCA_ERROR_BUSY while
 * training in the background in a deterministic context.
 *
 * # Safety
 * `points_mm` must be readable for 3 x `count` numbers, the three coordinates of a point together.
 */
nertca_status nertca_reconstruction_set_prior(nertca_reconstruction *reconstruction,
                                              const double *points_mm,
                                              size_t count);

/**
 * Returns state and progress of training. Callable from any thread, at any time.
 *
 * @return NERTCA_OK also when training has failed: `state` is then `NERTCA_STATE_FAILED`, and `nertca_reconstruction_failure`
 * returns the reason.
 *
 * # Safety
 * `progress` must be writable, with its size set.
 */
nertca_status nertca_reconstruction_progress(nertca_reconstruction *reconstruction,
                                             nertca_progress *progress);

/**
 * Returns the reason why training in the background failed, or, in the state NERTCA_STATE_WAITING, why it cannot go on with the frames
 * there are; empty otherwise. `text`, `size` and `length` work as in `nertca_last_error`. Callable from any thread.
 *
 * # Safety
 * `text` must hold `size` bytes; `length` must be writable or null.
 */
nertca_status nertca_reconstruction_failure(nertca_reconstruction *reconstruction,
                                            char *text,
                                            size_t size,
                                            size_t *length);

/**
 * Writes a checkpoint, with everything needed to continue, into a file, which appears whole or not at all. Callable from any
 * thread, also during training.
 *
 * @return NERTCA_ERROR_NOT_READY before anything was trained or loaded.
 *
 * # Safety
 * `path` must end with a zero.
 */
nertca_status nertca_reconstruction_save(nertca_reconstruction *reconstruction,
                                         const char *path);

/**
 * Saves a checkpoint like `nertca_reconstruction_save`, into memory. `*length` receives the number of bytes needed; with a
 * null `bytes` and a `size` of 0, only the length is returned.
 *
 * @return NERTCA_ERROR_BUFFER when `size` is too small. During training in the background the size of the state changes, by
 * kilobytes when Gaussians are added: try again with the new `*length`.
 *
 * # Safety
 * `bytes` must hold `size` bytes; `length` must be writable.
 */
nertca_status nertca_reconstruction_save_memory(nertca_reconstruction *reconstruction,
                                                void *bytes,
                                                size_t size,
                                                size_t *length);

/**
 * Loads a checkpoint file of this library or of `nertca-vk train`, with its hyper-parameters and phases. It can be rendered at
 * once, and trained further with the frames of this reconstruction. Callable from any thread.
 *
 * @return NERTCA_ERROR_BUSY while training in the background; NERTCA_ERROR_DATA for a malformed file.
 *
 * # Safety
 * `path` must end with a zero.
 */
nertca_status nertca_reconstruction_load(nertca_reconstruction *reconstruction,
                                         const char *path);

/**
 * Loads a checkpoint like `nertca_reconstruction_load`, from memory.
 *
 * # Safety
 * `bytes` must be readable for `size` bytes.
 */
nertca_status nertca_reconstruction_load_memory(nertca_reconstruction *reconstruction, const void *bytes, size_t size);

/**
 * Returns how the reconstruction has corrected a frame's geometry since training last took in frames: not at all, or by
 * calibration (`calibrate.mode`). Frames count from 0 in the order in which they were added. To draw the vessels over a frame,
 * render with its `matrix`. Callable from any thread, at any time.
 *
 * A motion common to all views cannot be observed and is no part of the correction. After loading a checkpoint, the
 * corrections made before it was saved are not known.
 *
 * @return NERTCA_ERROR_ARGUMENT for a frame that was not added.
 *
 * # Safety
 * `correction` must be writable, with its size set.
 */
nertca_status nertca_reconstruction_correction(nertca_reconstruction *reconstruction,
                                               uint32_t frame,
                                               nertca_correction *correction);

/**
 * Sets another geometry for a frame that was added, for example when the C-arm or an external calibration provides a better one.
 * Training in the background takes it in like a new frame; training that has ended does so when it is next started. Calibration
 * starts from the stated geometry; with `calibrate.mode = off` the reconstruction uses the stated geometry. Callable from any
 * thread.
 *
 * A frame whose new geometry no other frame shares within a tenth of a pixel is a view of its own. Presets that look for what moves
 * (`fast`, `fast-mlp`) leave it out while it is the only phase of its view: the log says so, and `nertca_reconstruction_frame_status`
 * tells. `nertca_reconstruction_set_view_geometry` sets the geometry of a whole view.
 *
 * @return NERTCA_ERROR_ARGUMENT naming the field that is wrong, or for a frame that was not added; NERTCA_ERROR_BUSY while
 * training in the background in a deterministic context.
 *
 * # Safety
 * `geometry` must be as long as its `size` says, and its matrix null or readable for 12 numbers.
 */
nertca_status nertca_reconstruction_set_geometry(nertca_reconstruction *reconstruction,
                                                 uint32_t frame,
                                                 const nertca_geometry *geometry);

/**
 * Sets another geometry for a frame and for all other frames of its view, as `nertca_reconstruction_set_geometry` does for one.
 * Callable from any thread.
 *
 * @return as `nertca_reconstruction_set_geometry`.
 *
 * # Safety
 * `geometry` must be as long as its `size` says, and its matrix null or readable for 12 numbers.
 */
nertca_status nertca_reconstruction_set_view_geometry(nertca_reconstruction *reconstruction,
                                                      uint32_t frame,
                                                      const nertca_geometry *geometry);

/**
 * Trains up to `iterations` more iterations in the calling thread, with the frames added so far. `progress` may be
 * null; a non-zero result of it ends the call. `*done` (may be null) receives the number of iterations done, which is
 * smaller at the end of the run.
 *
 * Only one such call at a time is allowed on a reconstruction; other threads may make all other calls meanwhile.
 *
 * @return NERTCA_ERROR_CANCELLED when the callback ended the call, or `nertca_reconstruction_destroy`; NERTCA_ERROR_NOT_READY without
 * enough frames, or where the settings cannot be met with them; NERTCA_ERROR_BUSY while training in the background;
 * NERTCA_ERROR_DIVERGED, with the last good state kept.
 *
 * # Safety
 * `done` must be writable or null; `progress` must be callable with `user`.
 */
nertca_status nertca_reconstruction_train(nertca_reconstruction *reconstruction,
                                          uint32_t iterations,
                                          nertca_progress_callback progress,
                                          void *user,
                                          uint32_t *done);

/**
 * Trains in the background until the run is complete. While there are too few frames, or the settings cannot be met with those there
 * are (nothing moves in them, for example), it waits for more or other ones in the state NERTCA_STATE_WAITING;
 * `nertca_reconstruction_failure` tells why. `progress` may be null; it is called on the training thread, and a non-zero result of it
 * ends training. Callable from any thread.
 *
 * @return NERTCA_ERROR_BUSY if it is already training in the background.
 *
 * # Safety
 * `progress` must be callable with `user` on another thread until training has ended.
 */
nertca_status nertca_reconstruction_start(nertca_reconstruction *reconstruction,
                                          nertca_progress_callback progress,
                                          void *user);

/**
 * Pauses training in the background after the iterations under way; does nothing without such training. Callable from
 * any thread.
 */
nertca_status nertca_reconstruction_pause(nertca_reconstruction *reconstruction);

/**
 * Resumes paused training; does nothing otherwise. Callable from any thread.
 */
nertca_status nertca_reconstruction_resume(nertca_reconstruction *reconstruction);

/**
 * Ends training in the background after the iterations under way, and waits until it has ended; does nothing without
 * such training. Training may be started again. Callable from any thread except that of the progress callback.
 *
 * @return NERTCA_ERROR_BUSY from inside the progress callback.
 */
nertca_status nertca_reconstruction_stop(nertca_reconstruction *reconstruction);

/**
 * Waits until training in the background has ended, at most `limit_ms` milliseconds. `*ended` (may be null) receives 1
 * if it has ended, else 0. Callable from any thread except that of the progress callback.
 *
 * # Safety
 * `ended` must be writable or null.
 */
nertca_status nertca_reconstruction_wait(nertca_reconstruction *reconstruction, uint32_t limit_ms, int32_t *ended);

/**
 * Draws a view into the caller's memory: line integrals, or attenuation per mm for a maximum projection. It also works during
 * training, from the current parameters: `NERTCA_QUALITY_LIVE` at display rates, from volumes whose refreshing takes at most a
 * fifth of the time; `NERTCA_QUALITY_EXACT` from the fields themselves.
 *
 * Callable from any thread; live pictures of one reconstruction are drawn one after the other. They wait for no long work: exact
 * pictures, `_sample`, `_evaluate` and `_tree` are done in slices of some hundredths of a second, one call after the other, and live
 * pictures pass between slices. During training in another thread a live picture shows the volumes there are, which that thread
 * keeps up to date; `nertca_reconstruction_drawn` tells their age.
 *
 * @return NERTCA_ERROR_CANCELLED for an exact picture that `nertca_reconstruction_cancel` ended; NERTCA_ERROR_NOT_READY before
 * anything was trained or loaded; NERTCA_ERROR_ARGUMENT naming what is wrong.
 *
 * # Safety
 * `view` and `image` must be as long as their `size` says, and their pointers valid for the stated lengths.
 */
nertca_status nertca_reconstruction_render(nertca_reconstruction *reconstruction,
                                           const nertca_view *view,
                                           const nertca_image *image);

/**
 * Draws a view like `nertca_reconstruction_render`, into a buffer of the same context: `width * height` floats, row by row. At
 * live quality the device writes them itself, without a copy; maxima are then per 100 mm (divide by 100). The buffer is
 * complete when the call returns.
 *
 * # Safety
 * `view` must be as long as its `size` says.
 */
nertca_status nertca_reconstruction_render_buffer(nertca_reconstruction *reconstruction,
                                                  const nertca_view *view,
                                                  nertca_buffer *buffer);

/**
 * Returns which field the last live picture showed. Callable from any thread.
 *
 * @return NERTCA_ERROR_NOT_READY before the first live picture.
 *
 * # Safety
 * `drawn` must be writable, with its size set.
 */
nertca_status nertca_reconstruction_drawn(nertca_reconstruction *reconstruction, nertca_drawn *drawn);

/**
 * Cancels the long calls that are under way on a reconstruction in other threads: `_evaluate`, `_tree`, `_sample` and exact
 * pictures return NERTCA_ERROR_CANCELLED before their next slice. Calls that begin later are not affected, nor is training. Callable
 * from any thread.
 */
nertca_status nertca_reconstruction_cancel(nertca_reconstruction *reconstruction);

/**
 * Samples a volume into the caller's memory: attenuation per mm at each point of a grid, left fastest. Values outside the
 * reconstructed region are zero. Callable from any thread, also during training; live pictures pass.
 *
 * @return NERTCA_ERROR_CANCELLED when `nertca_reconstruction_cancel` ended the call.
 *
 * # Safety
 * `grid` must be as long as its `size` says; `values` must be writable for `count` floats.
 */
nertca_status nertca_reconstruction_sample(nertca_reconstruction *reconstruction,
                                           const nertca_grid *grid,
                                           float *values,
                                           size_t count);

/**
 * Samples the fields like `nertca_reconstruction_sample`, into a buffer of the same context.
 *
 * # Safety
 * `grid` must be as long as its `size` says.
 */
nertca_status nertca_reconstruction_sample_buffer(nertca_reconstruction *reconstruction,
                                                  const nertca_grid *grid,
                                                  nertca_buffer *buffer);

/**
 * Makes a buffer on the device that can be shared through `VK_KHR_external_memory_fd`. `*buffer` is null on failure. Callable
 * from any thread.
 *
 * @return NERTCA_ERROR_DEVICE where the device lacks the extension (`external_memory_fd` of `nertca_context_describe`).
 *
 * # Safety
 * `buffer` must be writable.
 */
nertca_status nertca_buffer_create(nertca_context *context,
                                   uint64_t bytes,
                                   nertca_buffer **buffer);

/**
 * Returns a new file descriptor of the buffer's memory (`VK_EXTERNAL_MEMORY_HANDLE_TYPE_OPAQUE_FD_BIT`), which the caller must
 * import or close, and the size of the exported buffer in bytes. Callable from any thread.
 *
 * # Safety
 * `fd` must be writable; `bytes` must be writable or null.
 */
nertca_status nertca_buffer_export_fd(nertca_buffer *buffer,
                                      int32_t *fd,
                                      uint64_t *bytes);

/**
 * Returns the type and the size of the buffer's memory, with which others import it: the index of the type in
 * `VkPhysicalDeviceMemoryProperties`, and the size of the allocation in bytes, at least that of the buffer. A Vulkan device must
 * import the memory with both, with `VkMemoryDedicatedAllocateInfo`, for a buffer of the size of `nertca_buffer_export_fd` with
 * the usages storage buffer, transfer source and transfer destination; CUDA and OpenGL need the size of the allocation. The type
 * may be one that the host cannot read. Callable from any thread.
 *
 * # Safety
 * `memory_type` and `bytes` must be writable.
 */
nertca_status nertca_buffer_memory(nertca_buffer *buffer,
                                   uint32_t *memory_type,
                                   uint64_t *bytes);

/**
 * Destroys a buffer; memory that others imported stays valid for them. Null is allowed, and does nothing. Waits for calls on
 * the buffer in other threads.
 */
nertca_status nertca_buffer_destroy(nertca_buffer *buffer);

/**
 * Makes a binary semaphore on the device that can be shared through `VK_KHR_external_semaphore_fd`. `*semaphore` is null on
 * failure. Callable from any thread.
 *
 * @return NERTCA_ERROR_DEVICE where the device does not export semaphores as opaque descriptors (`external_semaphore_fd` of
 * `nertca_context_describe` is false).
 *
 * # Safety
 * `semaphore` must be writable.
 */
nertca_status nertca_semaphore_create(nertca_context *context,
                                      nertca_semaphore **semaphore);

/**
 * Returns a new file descriptor of the semaphore (`VK_EXTERNAL_SEMAPHORE_HANDLE_TYPE_OPAQUE_FD_BIT`), which the caller must import
 * or close. Callable from any thread.
 *
 * # Safety
 * `fd` must be writable.
 */
nertca_status nertca_semaphore_export_fd(nertca_semaphore *semaphore,
                                         int32_t *fd);

/**
 * Signals the semaphore on the device's queue, after the work of all calls that have returned: a picture in a shared buffer, for
 * example, is then visible to the commands of another device that wait for the semaphore. The call does not wait. Each signal must be
 * waited for once before the next. Callable from any thread.
 *
 * @return NERTCA_ERROR_DEVICE_LOST where the device no longer works.
 */
nertca_status nertca_semaphore_signal(nertca_semaphore *semaphore);

/**
 * Destroys a semaphore, after its last signal; what others imported stays valid for them. Null is allowed, and does nothing. Waits for
 * calls on the semaphore in other threads.
 */
nertca_status nertca_semaphore_destroy(nertca_semaphore *semaphore);

/**
 * Finds the vessels at all phases as trees of centrelines with radii. If all arrays of `tree` are null, the call searches and
 * returns the sizes of the arrays. Called again with arrays, it copies the trees found before, whatever training has done since.
 * The search takes seconds; live pictures pass, and `nertca_reconstruction_cancel` ends it.
 *
 * Branches are listed phase by phase, each after its parent. Where `followed` is 1, all phases have the same branches with the
 * same number of points, and point i of a branch is the same material point at every phase; otherwise each phase has its own
 * branches. Motion along a vessel is not observed in projections: it is determined by smoothness alone. Callable from any
 * thread, also during training.
 *
 * @return NERTCA_ERROR_CANCELLED when `nertca_reconstruction_cancel` ended the search; NERTCA_ERROR_NOT_READY before anything
 * was trained or loaded; NERTCA_ERROR_ARGUMENT for a negative threshold or length, for a dynamic field without vessels above the
 * threshold, and where only some arrays are given; NERTCA_ERROR_BUFFER when the arrays are too short: the counts are then the
 * required ones.
 *
 * # Safety
 * `tree` must be as long as its `size` says, and its arrays null or writable for `branches` and `points` elements.
 */
nertca_status nertca_reconstruction_tree(nertca_reconstruction *reconstruction,
                                         nertca_tree *tree);

/**
 * Returns a stenosis, from 0, of the vessels that `nertca_reconstruction_tree` found last; `count` receives the number of all stenoses,
 * phase by phase. A null `lesion` asks for the number alone. A vessel is judged if it is wider than the field's resolution, except near its
 * ends; stenoses of less than 30 % are not listed. Where points are followed, a point has one radius, so that phases differ only as far as
 * lengths along the vessel change. Callable from any thread, also during training.
 *
 * @return NERTCA_ERROR_NOT_READY before `nertca_reconstruction_tree` has found vessels; NERTCA_ERROR_ARGUMENT for an `index` beyond the
 * last stenosis, and where both pointers are null.
 *
 * # Safety
 * `lesion` must be null or writable, with its size set; `count` must be null or writable.
 */
nertca_status nertca_reconstruction_lesion(nertca_reconstruction *reconstruction,
                                           size_t index,
                                           nertca_lesion *lesion,
                                           size_t *count);

/**
 * Sets the true vessel voxels at the phase of `grid`, in place of those set before for that phase. `vessels` has one byte for
 * each point of the grid, left fastest, non-zero inside a vessel; the grid's component is ignored.
 * `nertca_reconstruction_evaluate` then returns scores in 3D. Null `vessels`, with `bytes` 0, remove the phase. The bytes are
 * copied. Callable from any thread.
 *
 * @return NERTCA_ERROR_ARGUMENT for a phase that does not exist, a grid of more than 2^26 points, or too few bytes.
 *
 * # Safety
 * `grid` must be as long as its `size` says; `vessels` must be readable for `bytes` bytes or null.
 */
nertca_status nertca_reconstruction_set_true_vessels(nertca_reconstruction *reconstruction,
                                                     const nertca_grid *grid,
                                                     const uint8_t *vessels,
                                                     size_t bytes);

/**
 * Sets the true centrelines and vessel radii, in place of those set before. The arrays have the form that
 * `nertca_reconstruction_tree` fills. They contain one phase or more, among them phase 0, each with the same branches of the
 * same number of points; point i of a branch is the same material point at every phase. `branch_parent` may be null. Zero
 * branches remove the true centrelines. `nertca_reconstruction_evaluate` then finds the vessels as a tree, which takes
 * seconds, and scores it. The arrays are copied. Callable from any thread.
 *
 * @return NERTCA_ERROR_ARGUMENT naming what is wrong.
 *
 * # Safety
 * `tree` must be as long as its `size` says, and its arrays readable for `branches` and `points` elements.
 */
nertca_status nertca_reconstruction_set_true_tree(nertca_reconstruction *reconstruction,
                                                  const nertca_tree *tree);

/**
 * Scores the frames that were added with `NERTCA_SPLIT_VALIDATION` (at least one is required), and compares the reconstruction
 * with the true vessels where these are known. `threshold_per_mm` is the attenuation from which the dynamic field counts as
 * vessel; 0 selects a fifth of `vessel_attenuation_per_mm`, or of the strongest attenuation of the field where that is unknown. Callable from any
 * thread, also during training. A library of an earlier version does not write fields that it does not know: set them to NaN
 * before the call if the version may be older. Live pictures pass meanwhile.
 *
 * @return NERTCA_ERROR_CANCELLED when `nertca_reconstruction_cancel` ended the call.
 *
 * # Safety
 * `scores` must be writable, with its size set.
 */
nertca_status nertca_reconstruction_evaluate(nertca_reconstruction *reconstruction,
                                             double threshold_per_mm,
                                             nertca_scores *scores);

#ifdef __cplusplus
}  // extern "C"
#endif  // __cplusplus

#endif  /* NERTCA_VK_H */
