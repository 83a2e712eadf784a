//! `.png` pictures, through the `image` crate.

use crate::decoders;
use crate::error::{Error, Result};
use crate::files;
use crate::image_limits::{MAX_FILE_BYTES, MAX_SIDE};
use crate::raster::Image;
use image::codecs::png::{CompressionType, FilterType, PngEncoder};
use image::{DynamicImage, ExtendedColorType, ImageEncoder};
use std::path::Path;

/// Reads a grey PNG of 8 or 16 bits; the values are the stored integers.
///
/// # Errors
/// [`Error::Io`] or [`Error::Data`] naming the file.
pub fn read(path: &Path) -> Result<Image> {
    let bytes = files::read_limited(path, MAX_FILE_BYTES)?;
    let mut reader = image::ImageReader::with_format(std::io::Cursor::new(bytes), image::ImageFormat::Png);
    let mut limits = image::Limits::default();
    limits.max_image_width = Some(MAX_SIDE as u32);
    limits.max_image_height = Some(MAX_SIDE as u32);
    reader.limits(limits);
    let bad = |problem: String| Error::data(path, "png", problem);
    let decoded = decoders::caught(|| reader.decode()).map_err(bad)?.map_err(|e| bad(e.to_string()))?;
    let (width, height) = (decoded.width() as usize, decoded.height() as usize);
    let values = match decoded {
        DynamicImage::ImageLuma8(grey) => grey.into_raw().into_iter().map(f32::from).collect(),
        DynamicImage::ImageLuma16(grey) => grey.into_raw().into_iter().map(f32::from).collect(),
        other => {
            return Err(Error::data(
                path,
                "png",
                format!("{:?} pixels are not supported; grey values of 8 or 16 bits are needed", other.color()),
            ));
        }
    };
    Ok(Image { width, height, values })
}

/// Writes a 16-bit grey PNG of codes 0..=65535.
///
/// # Errors
/// [`Error::Io`] or [`Error::Internal`].
pub fn write_grey16(path: &Path, width: usize, height: usize, codes: Vec<u16>) -> Result<()> {
    let buffer = image::ImageBuffer::<image::Luma<u16>, _>::from_raw(width as u32, height as u32, codes)
        .ok_or_else(|| Error::Internal("the PNG buffer has the wrong size".into()))?;
    write(path, &DynamicImage::ImageLuma16(buffer))
}

/// Encodes 8-bit grey codes as PNG, optimised for speed rather than size: for web pages, not for files.
///
/// # Errors
/// [`Error::Internal`] where there are not `width` x `height` codes.
pub fn grey8(width: usize, height: usize, codes: &[u8]) -> Result<Vec<u8>> {
    if codes.len() != width * height {
        return Err(Error::Internal("the PNG buffer has the wrong size".into()));
    }
    let mut png = Vec::new();
    PngEncoder::new_with_quality(&mut png, CompressionType::Fast, FilterType::Sub)
        .write_image(codes, width as u32, height as u32, ExtendedColorType::L8)
        .map_err(|e| Error::Internal(format!("PNG: {e}")))?;
    Ok(png)
}

/// Writes a picture as PNG.
///
/// # Errors
/// Errors of [`write_grey16`].
pub fn write(path: &Path, picture: &DynamicImage) -> Result<()> {
    let mut bytes = std::io::Cursor::new(Vec::new());
    picture
        .write_to(&mut bytes, image::ImageFormat::Png)
        .map_err(|e| Error::Internal(format!("encoding {}: {e}", path.display())))?;
    files::write_atomic(path, bytes.get_ref())
}
