//! Limits of image files.

/// Largest accepted file, bytes: an 8192 x 8192 image of 64-bit floats with its header.
pub const MAX_FILE_BYTES: u64 = (8192 * 8192 * 8) + 4096;
/// Largest accepted side of an image, pixels.
pub const MAX_SIDE: usize = 8192;
