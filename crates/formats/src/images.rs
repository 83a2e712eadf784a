//! Reads 2D arrays from files of any supported format: float `.npy` and grey `.png`.

use crate::error::{Error, Result};
use crate::image_limits::{MAX_FILE_BYTES, MAX_SIDE};
use crate::raster::Image;
use crate::{npy, png};
use std::path::Path;

/// Reads an image; the file name's extension selects the format.
///
/// # Errors
/// [`Error::Io`] or [`Error::Data`] naming the file.
pub fn read_image(path: &Path) -> Result<Image> {
    let image = match path.extension().and_then(|e| e.to_str()).map(str::to_lowercase).as_deref() {
        Some("npy") => {
            let npy::Array { shape, values } = npy::read(path, MAX_FILE_BYTES)?;
            let [height, width] = shape[..] else {
                return Err(Error::data(path, "shape", format!("is {shape:?}, but an image has two axes")));
            };
            Image { width, height, values }
        }
        Some("png") => png::read(path)?,
        _ => return Err(Error::data(path, "extension", "is neither .npy nor .png")),
    };
    let sides = 1..=MAX_SIDE;
    if !(sides.contains(&image.width) && sides.contains(&image.height)) {
        let problem =
            format!("{} x {} is out of range: sides of 1 to {MAX_SIDE} pixels are accepted", image.width, image.height);
        return Err(Error::data(path, "shape", problem));
    }
    Ok(image)
}
