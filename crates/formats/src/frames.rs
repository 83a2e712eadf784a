//! Reads grey frames from pictures: PNG, JPEG and TIFF, also of several pages.

use crate::decoders;
use crate::error::{Error, Result};
use crate::files;
use crate::image_limits::{MAX_FILE_BYTES, MAX_SIDE};
use crate::raster::Image;
use image::metadata::Orientation;
use image::{DynamicImage, ImageDecoder, ImageFormat};
use std::io::Cursor;
use std::path::Path;
use tiff::ColorType;
use tiff::decoder::{Decoder, DecodingResult, Limits};

/// Largest factor by which a compression of TIFF makes an image smaller: LZW, for a single value.
const MAX_COMPRESSION: usize = 4096;
/// Largest number of pages of a TIFF file.
const MAX_PAGES: usize = 2000;

/// A grey frame with the meaning of its numbers.
#[derive(Debug, Clone, PartialEq)]
pub struct GreyFrame {
    /// Stored values; colours are reduced to their luminance.
    pub image: Image,
    /// Largest value that the file can store.
    pub white: f32,
    /// Whether some pixel has a colour.
    pub is_coloured: bool,
    /// Whether it was stored turned or mirrored, which was undone.
    pub is_turned: bool,
}

/// Returns the format of a picture by the extension of its name.
fn format_of(path: &Path) -> Option<ImageFormat> {
    match path.extension()?.to_string_lossy().to_lowercase().as_str() {
        "png" => Some(ImageFormat::Png),
        "jpg" | "jpeg" => Some(ImageFormat::Jpeg),
        "tif" | "tiff" => Some(ImageFormat::Tiff),
        _ => None,
    }
}

/// Tells whether a file's name is that of a picture that can be read.
pub fn is_picture(path: &Path) -> bool {
    format_of(path).is_some()
}

/// Reads all frames of a picture file: one, or the pages of a TIFF file.
///
/// # Errors
/// [`Error::Io`] or [`Error::Data`] naming the file.
pub fn read(path: &Path) -> Result<Vec<GreyFrame>> {
    let bad = |problem: String| Error::data(path, "picture", problem);
    let format = format_of(path).ok_or_else(|| bad("is none of .png .jpg .jpeg .tif .tiff".into()))?;
    let bytes = files::read_limited(path, MAX_FILE_BYTES)?;
    decoders::caught(|| if format == ImageFormat::Tiff { pages(&bytes) } else { picture(&bytes, format) })
        .and_then(|frames| frames)
        .map_err(bad)
}

/// Reads the only frame of a PNG or JPEG file.
fn picture(bytes: &[u8], format: ImageFormat) -> std::result::Result<Vec<GreyFrame>, String> {
    let mut reader = image::ImageReader::with_format(Cursor::new(bytes), format);
    let mut limits = image::Limits::default();
    (limits.max_image_width, limits.max_image_height) = (Some(MAX_SIDE as u32), Some(MAX_SIDE as u32));
    reader.limits(limits);
    let mut decoder = reader.into_decoder().map_err(|e| e.to_string())?;
    // Viewers apply the orientation that EXIF data state.
    let orientation = decoder.orientation().map_err(|e| e.to_string())?;
    let mut decoded = DynamicImage::from_decoder(decoder).map_err(|e| e.to_string())?;
    decoded.apply_orientation(orientation);
    Ok(vec![GreyFrame { is_turned: orientation != Orientation::NoTransforms, ..grey(decoded)? }])
}

fn grey(decoded: DynamicImage) -> std::result::Result<GreyFrame, String> {
    let (width, height) = (decoded.width() as usize, decoded.height() as usize);
    let colours = decoded.color();
    let white = match colours.bytes_per_pixel() / colours.channel_count() {
        1 => 255.0,
        2 => 65535.0,
        _ => return Err(format!("{colours:?} pixels are not supported; 8 or 16 bits per channel are needed")),
    };
    let channels = usize::from(colours.channel_count());
    let values: Vec<f32> = match &decoded {
        DynamicImage::ImageLuma8(p) => p.as_raw().iter().copied().map(f32::from).collect(),
        DynamicImage::ImageLumaA8(p) => p.as_raw().iter().copied().map(f32::from).collect(),
        DynamicImage::ImageRgb8(p) => p.as_raw().iter().copied().map(f32::from).collect(),
        DynamicImage::ImageRgba8(p) => p.as_raw().iter().copied().map(f32::from).collect(),
        DynamicImage::ImageLuma16(p) => p.as_raw().iter().copied().map(f32::from).collect(),
        DynamicImage::ImageLumaA16(p) => p.as_raw().iter().copied().map(f32::from).collect(),
        DynamicImage::ImageRgb16(p) => p.as_raw().iter().copied().map(f32::from).collect(),
        DynamicImage::ImageRgba16(p) => p.as_raw().iter().copied().map(f32::from).collect(),
        other => return Err(format!("{:?} pixels are not supported", other.color())),
    };
    Ok(of_channels(&values, channels, [width, height], white))
}

/// Makes a frame of pixels with 1 to 4 channels: grey, grey and opacity, red, green and blue, or these and opacity. Opacity is
/// ignored.
fn of_channels(values: &[f32], channels: usize, [width, height]: [usize; 2], white: f32) -> GreyFrame {
    let mut is_coloured = false;
    let mut luminance = |pixel: &[f32]| match *pixel {
        [r, g, b, ..] if r != g || g != b => {
            is_coloured = true;
            // Rec. ITU-R BT.709.
            0.2126 * r + 0.7152 * g + 0.0722 * b
        }
        _ => pixel[0],
    };
    let values = values.chunks_exact(channels).map(&mut luminance).collect();
    GreyFrame { image: Image { width, height, values }, white, is_coloured, is_turned: false }
}

/// Reads all pages of a TIFF file.
fn pages(bytes: &[u8]) -> std::result::Result<Vec<GreyFrame>, String> {
    let told = |e: tiff::TiffError| e.to_string();
    let mut limits = Limits::default();
    // Pictures, and lists of places in the file.
    limits.decoding_buffer_size = (4 * 8 * MAX_SIDE * MAX_SIDE).min(bytes.len() * MAX_COMPRESSION);
    let mut decoder = Decoder::new(Cursor::new(bytes)).map_err(told)?.with_limits(limits);
    let mut frames = Vec::new();
    let mut claimed = 0;
    loop {
        let (width, height) = decoder.dimensions().map_err(told)?;
        let (width, height) = (width as usize, height as usize);
        if !(1..=MAX_SIDE).contains(&width) || !(1..=MAX_SIDE).contains(&height) {
            return Err(format!(
                "page {}: {width} x {height} pixels are more than {MAX_SIDE} a side",
                frames.len() + 1
            ));
        }
        let colours = decoder.colortype().map_err(told)?;
        let channels = match colours {
            ColorType::Gray(_) => 1,
            ColorType::GrayA(_) => 2,
            ColorType::RGB(_) => 3,
            ColorType::RGBA(_) => 4,
            other => return Err(format!("page {}: {other:?} pixels are not supported", frames.len() + 1)),
        };
        claimed += width * height * channels * usize::from(colours.bit_depth().div_ceil(8));
        if claimed > bytes.len() * MAX_COMPRESSION {
            let page = frames.len() + 1;
            return Err(format!("page {page}: {width} x {height} pixels are more than {} bytes can hold", bytes.len()));
        }
        let white = 2f32.powi(i32::from(colours.bit_depth())) - 1.0;
        let values: Vec<f32> = match decoder.read_image().map_err(told)? {
            DecodingResult::U8(values) if colours.bit_depth() == 8 => values.into_iter().map(f32::from).collect(),
            DecodingResult::U16(values) => values.into_iter().map(f32::from).collect(),
            _ => return Err(format!("page {}: {colours:?} pixels are not supported", frames.len() + 1)),
        };
        if values.len() != width * height * channels {
            return Err(format!("page {}: has {} values", frames.len() + 1, values.len()));
        }
        frames.push(of_channels(&values, channels, [width, height], white));
        if !decoder.more_images() {
            return Ok(frames);
        }
        if frames.len() == MAX_PAGES {
            return Err(format!("has more than {MAX_PAGES} pages"));
        }
        decoder.next_image().map_err(told)?;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use image::ImageEncoder;
    use image::codecs::jpeg::JpegEncoder;

    /// EXIF data (a TIFF directory of one entry) with an orientation.
    fn exif(orientation: u8) -> Vec<u8> {
        let mut bytes = b"II*\0\x08\0\0\0\x01\0\x12\x01\x03\0\x01\0\0\0".to_vec();
        bytes.extend([orientation, 0, 0, 0, 0, 0, 0, 0]);
        bytes
    }

    #[test]
    fn the_orientation_of_a_jpeg_picture_is_applied() {
        // Dark on the left, bright on the right, 16 columns and 8 rows.
        let pixels: Vec<u8> = (0..16 * 8).map(|p| if p % 16 < 8 { 20 } else { 220 }).collect();
        let stored = |orientation: u8| {
            let mut bytes = Vec::new();
            let mut encoder = JpegEncoder::new_with_quality(&mut bytes, 100);
            encoder.set_exif_metadata(exif(orientation)).unwrap();
            encoder.write_image(&pixels, 16, 8, image::ExtendedColorType::L8).unwrap();
            picture(&bytes, ImageFormat::Jpeg).unwrap().remove(0)
        };
        let upright = stored(1);
        assert_eq!((upright.image.width, upright.image.height, upright.is_turned), (16, 8, false));
        // 6: the picture is to be turned clockwise by 90 degrees, which brings the left side to the top.
        let turned = stored(6);
        assert_eq!((turned.image.width, turned.image.height, turned.is_turned), (8, 16, true));
        let row = |y: usize| turned.image.values[8 * y + 4];
        assert!(row(2) < 60.0 && row(13) > 180.0, "{} {}", row(2), row(13));
    }
}
