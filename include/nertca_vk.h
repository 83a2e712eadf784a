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
 * Pixels of 8 bits without sign.
 */
#define NERTCA_PIXELS_U8 1

/**
 * Pixels of 16 bits without sign, in the machine's byte order.
 */
#define NERTCA_PIXELS_U16 2

/**
 * Pixels of 32-bit floats.
 */
#define NERTCA_PIXELS_F32 3

/**
 * Pixel values `p` are line integrals of attenuation: `p * scale + offset`.
 */
#define NERTCA_INTENSITY_INTEGRAL 1

/**
 * Logarithmic detector: the line integral is `(i0 - p) * scale`.
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
 * A frame to score with only.
 */
#define NERTCA_SPLIT_VALIDATION 1

/**
 * Both fields.
 */
#define NERTCA_COMPONENT_TOTAL 0

/**
 * The still background.
 */
#define NERTCA_COMPONENT_STATIC 1

/**
 * The moving vessels.
 */
#define NERTCA_COMPONENT_DYNAMIC 2

/**
 * Line integrals of attenuation, as an angiogram shows them.
 */
#define NERTCA_PROJECTION_DRR 0

/**
 * The largest attenuation along each ray, 1/mm.
 */
#define NERTCA_PROJECTION_MIP 1

/**
 * Display rates, also while training: Gaussians as they are, other fields through volumes baked from them, as fine as their
 * cells (about 0.8 mm).
 */
#define NERTCA_QUALITY_LIVE 0

/**
 * Through the fields themselves: exact, and many times slower.
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
 * Held by `nertca_reconstruction_pause`.
 */
#define NERTCA_STATE_PAUSED 2

/**
 * Will train in the background as soon as there are frames enough.
 */
#define NERTCA_STATE_WAITING 3

/**
 * All iterations are done.
 */
#define NERTCA_STATE_FINISHED 4

/**
 * The progress callback ended it.
 */
#define NERTCA_STATE_CANCELLED 5

/**
 * An error ended it.
 */
#define NERTCA_STATE_FAILED 6

/**
 * Version of the ABI: of functions, structs and constants. A library serves callers built against its own number; it
 * is also the number in its soname.
 */
#define NERTCA_ABI_VERSION 0

/**
 * Version this header was made with, first number.
 */
#define NERTCA_VERSION_MAJOR 0

/**
 * Version this header was made with, second number.
 */
#define NERTCA_VERSION_MINOR 2

/**
 * Version this header was made with, third number.
 */
#define NERTCA_VERSION_PATCH 0

/**
 * Severity of a log message: an error.
 */
#define NERTCA_LOG_ERROR 1

/**
 * Severity of a log message: something to look at.
 */
#define NERTCA_LOG_WARNING 2

/**
 * Severity of a log message: what is being done, and why.
 */
#define NERTCA_LOG_INFO 3

/**
 * A frame's geometry is taken as stated.
 */
#define NERTCA_CORRECTION_STATED 0

/**
 * Angles and position of the frame's view are corrected.
 */
#define NERTCA_CORRECTION_STATIC 1

/**
 * A correction of the view, and a displacement of the heart in this frame.
 */
#define NERTCA_CORRECTION_BREATHING 2

/**
 * Memory on the device that other APIs and processes can import.
 */
typedef struct nertca_buffer nertca_buffer;

/**
 * A device with a log and limits. Make one per device, and any number of reconstructions in it.
 */
typedef struct nertca_context nertca_context;

/**
 * A reconstruction: its frames, its training, its fields.
 */
typedef struct nertca_reconstruction nertca_reconstruction;

/**
 * What a call returns: 0 for success, negative for an error whose text `nertca_last_error` gives.
 */
typedef int32_t nertca_status;

/**
 * Receives log messages: level, UTF-8 text, and the caller's pointer. Called on whichever thread a message arises,
 * also on the training thread, possibly on several at once. It must not call into the library.
 */
typedef void (*nertca_log_callback)(uint32_t level, const char *text, void *user);

/**
 * Where log messages go.
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
   * Handed to the callback unchanged.
   */
  void *user;
  /**
   * Least severe level wanted, one of `NERTCA_LOG_*`.
   */
  uint32_t level;
} nertca_log;

/**
 * A Vulkan device that the caller made and goes on owning. It must outlive the context made from it.
 */
typedef struct {
  /**
   * `sizeof(nertca_vulkan)`.
   */
  size_t size;
  /**
   * `vkGetInstanceProcAddr`; null takes that of the system's loader.
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
   * `VkQueue` that computes.
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
   * Taken around every use of the queue, for a short time, on any thread; null when the queue is the library's alone.
   */
  void (*lock)(void *user);
  /**
   * Gives the queue back after `lock`; null exactly when `lock` is.
   */
  void (*unlock)(void *user);
  /**
   * Handed to `lock` and `unlock`.
   */
  void *user;
  /**
   * Non-zero when the device was made with the features `subgroupSizeControl` and `computeFullSubgroups` (of
   * `VK_EXT_subgroup_size_control`, or of Vulkan 1.3): sums then go by shuffles, as on a device of the library's own.
   */
  uint32_t subgroup_size_control;
  /**
   * Non-zero when the device was made with `VK_KHR_cooperative_matrix` and its feature `cooperativeMatrix`, and with
   * `shaderFloat16`, `vulkanMemoryModel` and `vulkanMemoryModelDeviceScope`: networks then go by matrices, where the
   * library has kernels for the device's. Needs `subgroup_size_control` as well.
   */
  uint32_t cooperative_matrix;
} nertca_vulkan;

/**
 * How an image is taken. Patient coordinates are left, posterior, superior (LPS), mm, from the isocentre.
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
   * Source to detector, mm.
   */
  double sid_mm;
  /**
   * Source to isocentre, mm.
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
   * How far the table has carried the patient (LPS), mm.
   */
  double table_mm[3];
  /**
   * Null, or 12 numbers that replace all of the above: a row-major 3 x 4 projection from patient mm to homogeneous
   * pixels (column, row; integers are pixel centres).
   */
  const double *matrix;
} nertca_geometry;

/**
 * A calibrated angiogram.
 */
typedef struct {
  /**
   * `sizeof(nertca_frame)`.
   */
  size_t size;
  /**
   * How it was taken.
   */
  nertca_geometry geometry;
  /**
   * First row; copied during the call.
   */
  const void *pixels;
  /**
   * Bytes readable from `pixels`.
   */
  size_t pixels_bytes;
  /**
   * Bytes from one row to the next; 0 when rows follow each other at once.
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
   * What values mean, one of `NERTCA_INTENSITY_*`.
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
   * Null, or a vessel mask of a byte per pixel, non-zero inside vessels.
   */
  const uint8_t *mask;
  /**
   * Bytes readable from `mask`.
   */
  size_t mask_bytes;
  /**
   * Bytes from one row of the mask to the next; 0 when rows follow each other at once.
   */
  size_t mask_stride_bytes;
} nertca_frame;

/**
 * How far training is.
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
   * Iterations done.
   */
  uint32_t step;
  /**
   * Length of the run.
   */
  uint32_t iterations;
  /**
   * Frames trained on.
   */
  uint32_t frames;
  /**
   * Loss of the last iteration.
   */
  double loss;
  /**
   * PSNR of the last iteration's rays, dB; NaN while Gaussians are fitted, which have no rays.
   */
  double psnr_db;
  /**
   * Iterations per second since training was last begun.
   */
  double iterations_per_s;
} nertca_progress;

/**
 * How calibration sees a frame.
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
   * How much further than stated the table has carried the patient (LPS), mm.
   */
  double table_mm[3];
  /**
   * Where breathing has carried the heart in this frame (LPS), mm.
   */
  double heart_shift_mm[3];
  /**
   * Root mean square of how far the correction moves the heart's image in this view, pixels, less what moves all views
   * alike.
   */
  double moved_px;
  /**
   * Difference of this view's profiles from those of the others before the correction, as a share of the profiles.
   */
  double residual_before;
  /**
   * Difference of this view's profiles from those of the others after the correction, as a share of the profiles.
   */
  double residual_after;
  /**
   * All of it, displacement of the heart included, as a row-major 3 x 4 projection from patient mm to homogeneous pixels
   * (column, row; integers are pixel centres): what `nertca_geometry.matrix` takes.
   */
  double matrix[3][4];
} nertca_correction;

/**
 * Told now and then how far training is; a non-zero result ends it. `progress` is valid during the call. Called on the
 * thread that trains, with no lock held: it may call into the library, but not stop, train or destroy the same
 * reconstruction.
 */
typedef int32_t (*nertca_progress_callback)(const nertca_progress *progress, void *user);

/**
 * What to draw.
 */
typedef struct {
  /**
   * `sizeof(nertca_view)`.
   */
  size_t size;
  /**
   * From where the view is drawn.
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
} nertca_view;

/**
 * Where to draw to.
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
   * Bytes writable from `pixels`.
   */
  size_t pixels_bytes;
  /**
   * Bytes from one row to the next; 0 when rows follow each other at once.
   */
  size_t stride_bytes;
  /**
   * `NERTCA_PIXELS_F32` or `NERTCA_PIXELS_U8`.
   */
  uint32_t format;
  /**
   * The value shown as 0, for `U8`. With `low` = `high`, both are the image's own extremes.
   */
  double low;
  /**
   * The value shown as 255, for `U8`.
   */
  double high;
} nertca_image;

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
 * Vessels as trees of centrelines with radii: what is asked for, and room for the answer.
 */
typedef struct {
  /**
   * `sizeof(nertca_tree)`.
   */
  size_t size;
  /**
   * The moving field is vessel above this, 1/mm; 0 for the threshold that scores take. Set to what was taken.
   */
  double threshold_per_mm;
  /**
   * Branches that end without reaching so far beyond the vessel they leave are left out, mm; 0 for three times what the
   * field resolves.
   */
  double least_branch_mm;
  /**
   * Set to 1 where all phases have the same material points, to 0 where each has branches of its own.
   */
  uint32_t followed;
  /**
   * Elements that each of `branch_*` has room for; set to how many branches there are, over all phases.
   */
  size_t branches;
  /**
   * Points that `points_mm` and `radius_mm` have room for; set to how many there are, over all phases.
   */
  size_t points;
  /**
   * Cardiac phase of each branch, from 0.
   */
  uint32_t *branch_phase;
  /**
   * The branch that each leaves, by its place in these arrays; -1 for one that begins at a root.
   */
  int32_t *branch_parent;
  /**
   * First point of each branch, from 0.
   */
  uint32_t *branch_first;
  /**
   * How many points each branch has; the first is the last of its parent.
   */
  uint32_t *branch_points;
  /**
   * Points of the centrelines (LPS), mm: three numbers each.
   */
  double *points_mm;
  /**
   * Radius of the vessel at each point, mm.
   */
  double *radius_mm;
} nertca_tree;

/**
 * Scores on the frames added for validation.
 */
typedef struct {
  /**
   * `sizeof(nertca_scores)`.
   */
  size_t size;
  /**
   * Iterations of the model.
   */
  uint32_t step;
  /**
   * Images scored.
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
   * Attenuation from which the moving field counts as vessel, 1/mm.
   */
  double threshold_per_mm;
  /**
   * Phases whose true vessels are known as voxels (`nertca_reconstruction_set_true_vessels`).
   */
  uint32_t volume_phases;
  /**
   * Phases whose true vessels are known as a tree (`nertca_reconstruction_set_true_tree`).
   */
  uint32_t tree_phases;
  /**
   * Dice of the voxels that are vessel; this and what follows are means over the phases, and NaN where nothing is known.
   */
  double volume_dice;
  /**
   * Mean distance of a voxel of one set to the nearest of the other, both directions weighing the same, mm.
   */
  double chamfer_mm;
  /**
   * The larger of both directions' 95th percentiles of these distances, mm.
   */
  double hausdorff95_mm;
  /**
   * Share of the true centreline's voxels with one of ours within 1 mm.
   */
  double true_centreline_found;
  /**
   * Share of our centreline's voxels with a true one within 1 mm.
   */
  double our_centreline_true;
  /**
   * Centreline Dice: the harmonic mean of the shares of each centreline inside the other set.
   */
  double cl_dice;
  /**
   * Connected components of ours that are a pixel at the isocentre wide or more.
   */
  double components;
  /**
   * Connected components of the truth.
   */
  double true_components;
  /**
   * Share of the true tree's length with ours within 1 mm.
   */
  double tree_true_centreline_found;
  /**
   * Share of our tree's length with a true one within 1 mm.
   */
  double tree_our_centreline_true;
  /**
   * Mean distance of our centreline to the true one, mm.
   */
  double tree_ours_to_true_mm;
  /**
   * Connected trees of ours.
   */
  double tree_components;
  /**
   * Mean of our radius less the true one, where our centreline is true, mm.
   */
  double radius_error_mm;
  /**
   * Root of the mean square of the same, mm.
   */
  double radius_rmse_mm;
  /**
   * Mean distance between where our points have come since the phase that is followed and where the true points beside them have, mm.
   */
  double motion_error_mm;
} nertca_scores;

/**
 * Done.
 */
#define NERTCA_OK 0

/**
 * An argument is null, out of range, or contradicts another.
 */
#define NERTCA_ERROR_ARGUMENT -1

/**
 * A handle was destroyed, is of another type, or never was one.
 */
#define NERTCA_ERROR_HANDLE -2

/**
 * Data given (a checkpoint, say) is malformed.
 */
#define NERTCA_ERROR_DATA -3

/**
 * The operating system refused a file operation.
 */
#define NERTCA_ERROR_IO -4

/**
 * No device fits, or it lacks what was asked for.
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
 * A callback ended the call.
 */
#define NERTCA_ERROR_CANCELLED -9

/**
 * The call cannot be done while something else goes on (training, or handles that still exist).
 */
#define NERTCA_ERROR_BUSY -10

/**
 * The buffer given is too small; the length needed was written.
 */
#define NERTCA_ERROR_BUFFER -11

/**
 * The call needs something that is still to come: frames, or training.
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
 * Text of the last failed call on `handle` (of any type) in this thread, or of the last failed call at all when
 * `handle` is null; empty when there was none. UTF-8, with a closing zero, cut to `size` bytes; `*length` gets the
 * full length without the zero. With a null `text` and a `size` of 0, only the length is given.
 *
 * Any thread. Texts of calls without a handle (those that create one) are found under null.
 *
 * @return NERTCA_OK, NERTCA_ERROR_BUFFER when the text was cut, NERTCA_ERROR_ARGUMENT.
 *
 * # Safety
 * `text` must hold `size` bytes; `length` must be writable or null.
 */
nertca_status nertca_last_error(const void *handle, char *text, size_t size, size_t *length);

/**
 * A short description of a status, for logs. Never null; the text is static. Any thread.
 */
const char *nertca_status_text(nertca_status status);

/**
 * Version of the library, as `major.minor.patch`. Static text. Any thread.
 */
const char *nertca_version(void);

/**
 * `NERTCA_ABI_VERSION` of the library in use, to compare with that of the header. Any thread.
 */
uint32_t nertca_abi_version(void);

/**
 * Opens a device.
 *
 * `options` are lines of `key = value` or a JSON object, or null for defaults:
 * `device` (index, part of the name or UUID; `none` for a context that checks and keeps frames but cannot train; the
 * best device without), `validation` (true for the Khronos layer, which then reports to the log), `cache_dir` (where
 * compiled kernels are kept between processes), `memory_limit_mib` (ceiling on device memory of everything made from
 * the context), `deterministic` (true refuses whatever would make results depend on timing: frames added while
 * training in the background), `layers` (f32 or matrices: how the network is computed, for which the device decides
 * otherwise).
 *
 * `log` may be null. `*context` is null on failure; the text is then found by `nertca_last_error(NULL, ...)`.
 * Any thread.
 *
 * # Safety
 * `options` must be null or end with a zero, `log` be null or as long as it says, `context` be writable.
 */
nertca_status nertca_context_create(const char *options, const nertca_log *log, nertca_context **context);

/**
 * Makes a context as `nertca_context_create` does, on a device of the caller: both then share one GPU, its memory and, if wanted, buffers.
 * Of the options, `device` and `validation` do not apply. Instance, device and queue must outlive the context, which
 * leaves them as they are.
 *
 * # Safety
 * As `nertca_context_create`; the handles in `vulkan` must be valid and made as its fields say.
 */
nertca_status nertca_context_adopt(const nertca_vulkan *vulkan,
                                   const char *options,
                                   const nertca_log *log,
                                   nertca_context **context);

/**
 * The device and the paths chosen for it, as JSON; `text`, `size` and `length` as for `nertca_last_error`, but what it says of
 * memory may be longer at the next call. Any thread.
 *
 * # Safety
 * `text` must hold `size` bytes; `length` must be writable or null.
 */
nertca_status nertca_context_describe(nertca_context *context,
                                      char *text,
                                      size_t size,
                                      size_t *length);

/**
 * All Vulkan devices of this machine, usable or not, as a JSON list; `text`, `size` and `length` as for
 * `nertca_last_error`, but what it says of free memory may be longer at the next call. Any thread.
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
 * @return NERTCA_ERROR_BUSY, and nothing is done, while reconstructions or buffers made from it exist, or from inside
 * a callback of a call on it.
 *
 * # Safety
 * None: a stale handle is an error.
 */
nertca_status nertca_context_destroy(nertca_context *context);

/**
 * Begins a reconstruction without frames.
 *
 * `options` are lines of `key = value` or a JSON object: `phases` (cardiac phases; needed), `depth_half_extent_mm`
 * (attenuation is searched within this distance of the isocentre plane; 100), `vessel_attenuation_per_mm` (of filled
 * vessels, where known: sets the Dice threshold), `preset` (fast, fast-mlp, paper, public-code, nerf-ca, r2-gaussian,
 * x-gaussian or sax-nerf) and every key that `nertca-vk train --print-config` shows, as in `train.iterations = 800`.
 *
 * `*reconstruction` is null on failure. Any thread.
 *
 * # Safety
 * `options` must be null or end with a zero; `reconstruction` must be writable.
 */
nertca_status nertca_reconstruction_create(nertca_context *context,
                                           const char *options,
                                           nertca_reconstruction **reconstruction);

/**
 * Ends a reconstruction: stops its training, waits for calls on it in other threads, and frees its memory. Null is
 * allowed, and does nothing. Any thread but that of its own callbacks.
 *
 * @return NERTCA_ERROR_BUSY, and nothing is done, from inside a callback of a call on it.
 *
 * # Safety
 * None: a stale handle is an error.
 */
nertca_status nertca_reconstruction_destroy(nertca_reconstruction *reconstruction);

/**
 * Adds a frame, whose pixels are copied. It may come at any time: training in the background takes it in by itself
 * (soon: frames that come in quick succession are taken in together), other training when it next begins.
 * Any thread.
 *
 * @return NERTCA_ERROR_ARGUMENT naming the field that is wrong; NERTCA_ERROR_BUSY while training in the background in a
 * deterministic context.
 *
 * # Safety
 * `frame` must be as long as it says, and its pointers readable as far as it says.
 */
nertca_status nertca_reconstruction_add_frame(nertca_reconstruction *reconstruction, const nertca_frame *frame);

/**
 * Gives the times of the R-peaks, seconds, rising: frames with time stamps get their phase from them,
 * systole keeping its length (310 ms, 35 % of the phases) and diastole taking the rest; where one set of Gaussians moves, they are
 * fitted at their own time within it. Replaces those given earlier, so that a growing list can be given again and again. Any
 * thread.
 *
 * # Safety
 * `times_s` must be readable for `count` numbers.
 */
nertca_status nertca_reconstruction_set_r_peaks(nertca_reconstruction *reconstruction,
                                                const double *times_s,
                                                size_t count);

/**
 * State and progress. Any thread, at any time.
 *
 * @return NERTCA_OK also when training has failed: `state` is then `NERTCA_STATE_FAILED`, and the reason found by
 * `nertca_reconstruction_failure`.
 *
 * # Safety
 * `progress` must be writable, with its size set.
 */
nertca_status nertca_reconstruction_progress(nertca_reconstruction *reconstruction, nertca_progress *progress);

/**
 * Why training in the background failed; empty when it did not. `text`, `size` and `length` as for
 * `nertca_last_error`. Any thread.
 *
 * # Safety
 * `text` must hold `size` bytes; `length` must be writable or null.
 */
nertca_status nertca_reconstruction_failure(nertca_reconstruction *reconstruction,
                                            char *text,
                                            size_t size,
                                            size_t *length);

/**
 * Writes everything needed to continue into a file, which appears whole or not at all. Any thread, also while training.
 *
 * @return NERTCA_ERROR_NOT_READY before anything was trained or loaded.
 *
 * # Safety
 * `path` must end with a zero.
 */
nertca_status nertca_reconstruction_save(nertca_reconstruction *reconstruction, const char *path);

/**
 * Saves as `nertca_reconstruction_save` does, into memory. `*length` gets the bytes needed; with a null `bytes` and a `size` of
 * 0 nothing else is done.
 *
 * @return NERTCA_ERROR_BUFFER when `size` is too small. While training goes on in the background the state grows and shrinks, by
 * kilobytes when Gaussians are added: then try again with the new `*length`.
 *
 * # Safety
 * `bytes` must hold `size` bytes; `length` must be writable.
 */
nertca_status nertca_reconstruction_save_memory(nertca_reconstruction *reconstruction,
                                                void *bytes,
                                                size_t size,
                                                size_t *length);

/**
 * Takes over a checkpoint file, of this library or of `nertca-vk train`, with its hyper-parameters and phases: it can
 * be drawn at once, and trained further with the frames of this reconstruction. Any thread.
 *
 * @return NERTCA_ERROR_BUSY while training in the background; NERTCA_ERROR_DATA for a malformed file.
 *
 * # Safety
 * `path` must end with a zero.
 */
nertca_status nertca_reconstruction_load(nertca_reconstruction *reconstruction, const char *path);

/**
 * Loads as `nertca_reconstruction_load` does, from memory.
 *
 * # Safety
 * `bytes` must be readable for `size` bytes.
 */
nertca_status nertca_reconstruction_load_memory(nertca_reconstruction *reconstruction, const void *bytes, size_t size);

/**
 * How the reconstruction sees a frame since training last took frames in: as stated, or as calibration (`calibrate.mode`)
 * corrected it. Frames count from 0 in the order in which they were added. To draw the vessels over a frame, render with
 * its `matrix`. Any thread, at any time.
 *
 * A motion that all views share is not seen by any of them and is no part of the correction; and what a checkpoint was
 * corrected by is not known after loading it.
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
 * States another geometry for a frame that was added: what the C-arm, or a calibration elsewhere, knows better by now.
 * Training takes it in as it does a new frame. Calibration begins from what is stated; with `calibrate.mode = off` that
 * is what the reconstruction goes by. Any thread.
 *
 * @return NERTCA_ERROR_ARGUMENT naming the field that is wrong, or for a frame that was not added; NERTCA_ERROR_BUSY
 * while training in the background in a deterministic context.
 *
 * # Safety
 * `geometry` must be as long as it says, and its matrix null or readable for 12 numbers.
 */
nertca_status nertca_reconstruction_set_geometry(nertca_reconstruction *reconstruction,
                                                 uint32_t frame,
                                                 const nertca_geometry *geometry);

/**
 * Trains up to `iterations` more in the calling thread, with the frames there are. `progress` may be null; a non-zero
 * result of it ends the call. `*done` (may be null) gets the iterations done: fewer at the end of the run.
 *
 * One call at a time on a reconstruction; everything else may be called meanwhile from other threads.
 *
 * @return NERTCA_ERROR_CANCELLED when the callback ended it; NERTCA_ERROR_NOT_READY without frames enough;
 * NERTCA_ERROR_BUSY while training in the background; NERTCA_ERROR_DIVERGED, with the last good state kept.
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
 * Trains in the background until the run is done, and waits for frames while there are too few. `progress` may be
 * null; it is called on the training thread, and a non-zero result of it ends training. Any thread.
 *
 * @return NERTCA_ERROR_BUSY while it does so already.
 *
 * # Safety
 * `progress` must be callable with `user` on another thread until training has ended.
 */
nertca_status nertca_reconstruction_start(nertca_reconstruction *reconstruction,
                                          nertca_progress_callback progress,
                                          void *user);

/**
 * Holds training in the background after the iterations under way; does nothing without any. Any thread.
 */
nertca_status nertca_reconstruction_pause(nertca_reconstruction *reconstruction);

/**
 * Lets paused training go on; does nothing otherwise. Any thread.
 */
nertca_status nertca_reconstruction_resume(nertca_reconstruction *reconstruction);

/**
 * Ends training in the background after the iterations under way and waits for that; does nothing without any.
 * Training may be started again. Any thread but that of the progress callback.
 *
 * @return NERTCA_ERROR_BUSY from inside the progress callback.
 */
nertca_status nertca_reconstruction_stop(nertca_reconstruction *reconstruction);

/**
 * Waits until training in the background has ended, at most `limit_ms` milliseconds; `*ended` (may be null) gets 1 or
 * 0. Any thread but that of the progress callback.
 *
 * # Safety
 * `ended` must be writable or null.
 */
nertca_status nertca_reconstruction_wait(nertca_reconstruction *reconstruction, uint32_t limit_ms, int32_t *ended);

/**
 * Draws a view into the caller's memory: line integrals, or attenuation per mm for a maximum projection. Works while
 * training too, from the parameters as they then are: `NERTCA_QUALITY_LIVE` at display rates, from volumes that are
 * refreshed as fast as is possible in a fifth of the time, `NERTCA_QUALITY_EXACT` from the fields themselves.
 *
 * Any thread; calls on one reconstruction draw one after the other.
 *
 * @return NERTCA_ERROR_NOT_READY before anything was trained or loaded; NERTCA_ERROR_ARGUMENT naming what is wrong.
 *
 * # Safety
 * `view` and `image` must be as long as they say, and their pointers valid as far as they say.
 */
nertca_status nertca_reconstruction_render(nertca_reconstruction *reconstruction,
                                           const nertca_view *view,
                                           const nertca_image *image);

/**
 * Draws a view as `nertca_reconstruction_render` does, into a buffer of the same context: `width * height` floats, rows first. Live
 * quality is written by the device itself, without a copy; maxima are then per 100 mm (divide by 100). The buffer is
 * complete when the call returns.
 *
 * # Safety
 * `view` must be as long as it says.
 */
nertca_status nertca_reconstruction_render_buffer(nertca_reconstruction *reconstruction,
                                                  const nertca_view *view,
                                                  nertca_buffer *buffer);

/**
 * Samples a volume into the caller's memory: attenuation per mm at each point of a grid, left fastest. Zero outside
 * what was reconstructed. Any thread, also while training.
 *
 * # Safety
 * `grid` must be as long as it says; `values` must be writable for `count` floats.
 */
nertca_status nertca_reconstruction_sample(nertca_reconstruction *reconstruction,
                                           const nertca_grid *grid,
                                           float *values,
                                           size_t count);

/**
 * Samples the fields as `nertca_reconstruction_sample` does, into a buffer of the same context.
 *
 * # Safety
 * `grid` must be as long as it says.
 */
nertca_status nertca_reconstruction_sample_buffer(nertca_reconstruction *reconstruction,
                                                  const nertca_grid *grid,
                                                  nertca_buffer *buffer);

/**
 * Makes a buffer on the device that can be shared through `VK_KHR_external_memory_fd`. `*buffer` is null on failure.
 * Any thread.
 *
 * @return NERTCA_ERROR_DEVICE where the device lacks the extension (`external_memory_fd` of
 * `nertca_context_describe`).
 *
 * # Safety
 * `buffer` must be writable.
 */
nertca_status nertca_buffer_create(nertca_context *context, uint64_t bytes, nertca_buffer **buffer);

/**
 * A new file descriptor of the buffer's memory (`VK_EXTERNAL_MEMORY_HANDLE_TYPE_OPAQUE_FD_BIT`), the caller's to
 * import or close, and the size of the allocation's buffer in bytes. Any thread.
 *
 * # Safety
 * `fd` must be writable; `bytes` must be writable or null.
 */
nertca_status nertca_buffer_export_fd(nertca_buffer *buffer, int32_t *fd, uint64_t *bytes);

/**
 * Frees a buffer; what others imported stays theirs. Null is allowed, and does nothing. Waits for calls on it in other
 * threads.
 */
nertca_status nertca_buffer_destroy(nertca_buffer *buffer);

/**
 * Finds the vessels at all phases as trees of centrelines with radii, and tells how much room they need: with all arrays of
 * `tree` null. Called again with arrays, it copies what it found, whatever training has done since. Takes seconds.
 *
 * Branches come phase by phase, each behind its parent. Where `followed` is 1, all phases have the same branches with the
 * same number of points, and point i of a branch is the same material point at every phase; elsewhere each phase has
 * branches of its own. Motion along a vessel is not observed in projections: what there is of it comes from smoothness
 * alone. Any thread, also while training.
 *
 * @return NERTCA_ERROR_NOT_READY before anything was trained or loaded; NERTCA_ERROR_ARGUMENT for a threshold or length
 * that is negative, for a moving field without vessels above the threshold, and where only some arrays are given;
 * NERTCA_ERROR_BUFFER when they are too short: the counts then tell what is needed.
 *
 * # Safety
 * `tree` must be as long as it says, and its arrays null or writable for `branches` and `points` elements.
 */
nertca_status nertca_reconstruction_tree(nertca_reconstruction *reconstruction,
                                         nertca_tree *tree);

/**
 * Says which voxels are vessel at the phase of `grid`, in place of what was said of that phase before: a non-zero byte for each
 * point of the grid that is inside one, left fastest; its component does not matter. `nertca_reconstruction_evaluate` then has
 * scores in 3D. Null `vessels`, with `bytes` 0, forget the phase. The bytes are copied. Any thread.
 *
 * @return NERTCA_ERROR_ARGUMENT for a phase that there is not, a grid of more than 2^26 points, or too few bytes.
 *
 * # Safety
 * `grid` must be as long as it says; `vessels` must be readable for `bytes` bytes or null.
 */
nertca_status nertca_reconstruction_set_true_vessels(nertca_reconstruction *reconstruction,
                                                     const nertca_grid *grid,
                                                     const uint8_t *vessels,
                                                     size_t bytes);

/**
 * Says where the true centrelines are, and how wide the vessels, in place of what was said before: arrays as
 * `nertca_reconstruction_tree` fills them, of one phase or more, of which 0 is one, with the same branches of as many points at
 * each; point i of a branch is the same material point at every phase. `branch_parent` may be null. No branches forget them.
 * `nertca_reconstruction_evaluate` then finds the vessels as a tree, which takes seconds, and scores it. The arrays are copied.
 * Any thread.
 *
 * @return NERTCA_ERROR_ARGUMENT naming what is wrong.
 *
 * # Safety
 * `tree` must be as long as it says, and its arrays readable for `branches` and `points` elements.
 */
nertca_status nertca_reconstruction_set_true_tree(nertca_reconstruction *reconstruction,
                                                  const nertca_tree *tree);

/**
 * Scores the frames that were added with `NERTCA_SPLIT_VALIDATION`, of which there must be one, and what was reconstructed
 * against the true vessels, where these are known. `threshold_per_mm` is the attenuation from which
 * the moving field counts as vessel; 0 for a fifth of `vessel_attenuation_per_mm`, or Otsu's where that is unknown.
 * Any thread, also while training. A library of an earlier version leaves fields alone that it does not know: set them to NaN before,
 * where that may be.
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
