//! 2D arrays on disk: float `.npy` (npyz) and 8/16-bit grey `.png` (image).

use crate::error::{Error, Result};
use crate::files;
use crate::raster::Image;
use std::path::Path;

/// Largest accepted file; an 8192 x 8192 image of 64-bit floats and its header fit.
const MAX_FILE_BYTES: u64 = (8192 * 8192 * 8) + 4096;
/// Largest accepted side of an image.
pub const MAX_SIDE: usize = 8192;

/// Reads an image by its extension.
///
/// # Errors
/// [`Error::Io`] or [`Error::Data`] naming the file.
pub fn read_image(path: &Path) -> Result<Image> {
    match path.extension().and_then(|e| e.to_str()).map(str::to_lowercase).as_deref() {
        Some("npy") => {
            let (shape, values) = read_npy(path)?;
            let [height, width] = shape[..] else {
                return Err(Error::data(path, "shape", format!("{shape:?}; an image has two axes")));
            };
            check_side(path, width, height)?;
            Ok(Image { width, height, values })
        }
        Some("png") => read_png(path),
        _ => Err(Error::data(path, "extension", "is neither .npy nor .png")),
    }
}

fn check_side(path: &Path, width: usize, height: usize) -> Result<()> {
    if width == 0 || height == 0 || width > MAX_SIDE || height > MAX_SIDE {
        return Err(Error::data(path, "shape", format!("{width} x {height}; sides go from 1 to {MAX_SIDE}")));
    }
    Ok(())
}

fn read_png(path: &Path) -> Result<Image> {
    let bytes = files::read_limited(path, MAX_FILE_BYTES)?;
    let mut reader = image::ImageReader::with_format(std::io::Cursor::new(bytes), image::ImageFormat::Png);
    let mut limits = image::Limits::default();
    limits.max_image_width = Some(MAX_SIDE as u32);
    limits.max_image_height = Some(MAX_SIDE as u32);
    reader.limits(limits);
    let decoded = reader.decode().map_err(|e| Error::data(path, "png", e.to_string()))?;
    let (width, height) = (decoded.width() as usize, decoded.height() as usize);
    check_side(path, width, height)?;
    let values = match decoded {
        image::DynamicImage::ImageLuma8(grey) => grey.into_raw().into_iter().map(f32::from).collect(),
        image::DynamicImage::ImageLuma16(grey) => grey.into_raw().into_iter().map(f32::from).collect(),
        other => {
            return Err(Error::data(path, "png", format!("{:?} pixels; grey of 8 or 16 bit is needed", other.color())));
        }
    };
    Ok(Image { width, height, values })
}

/// Reads a numeric `.npy` of any shape (C or Fortran order) as `f32` in C order.
///
/// # Errors
/// As [`read_image`].
pub fn read_npy(path: &Path) -> Result<(Vec<usize>, Vec<f32>)> {
    read_npy_limited(path, MAX_FILE_BYTES)
}

/// [`read_npy`] with a caller's bound on the file's size, bytes.
///
/// # Errors
/// As [`read_image`].
pub fn read_npy_limited(path: &Path, limit: u64) -> Result<(Vec<usize>, Vec<f32>)> {
    let bytes = files::read_limited(path, limit)?;
    let bad = |problem: String| Error::data(path, "npy", problem);
    check_npy_shape(&bytes).map_err(|shape| bad(format!("absurd shape ({shape})")))?;
    let npy = npyz::NpyFile::new(&bytes[..]).map_err(|e| bad(format!("header: {e}")))?;
    let mut shape = Vec::new();
    let mut elements: u64 = 1;
    for &axis in npy.shape() {
        elements = elements.checked_mul(axis).ok_or_else(|| bad(format!("absurd shape {:?}", npy.shape())))?;
        shape.push(axis as usize);
    }
    if elements > bytes.len() as u64 {
        return Err(bad(format!("shape {shape:?} needs more than the file's {} bytes: truncated?", bytes.len())));
    }
    let fortran = npy.order() == npyz::Order::Fortran && shape.len() > 1;
    let npyz::DType::Plain(dtype) = npy.dtype() else {
        return Err(bad("a structured array; numbers are needed".into()));
    };
    let name = dtype.to_string();
    macro_rules! read_as {
        ($ty:ty) => {
            npy.into_vec::<$ty>().map(|v| v.into_iter().map(|x| x as f32).collect())
        };
    }
    let values: std::io::Result<Vec<f32>> = match name.trim_start_matches(['<', '>', '|', '=']) {
        "f4" => npy.into_vec::<f32>(),
        "f8" => read_as!(f64),
        "u1" => read_as!(u8),
        "u2" => read_as!(u16),
        "u4" => read_as!(u32),
        "i1" => read_as!(i8),
        "i2" => read_as!(i16),
        "i4" => read_as!(i32),
        "b1" => npy.into_vec::<bool>().map(|v| v.into_iter().map(|b| f32::from(u8::from(b))).collect()),
        other => {
            return Err(bad(format!("element type {other}; floats, integers up to 32 bit and booleans are read")));
        }
    };
    let values = values.map_err(|e| bad(format!("{e}: truncated?")))?;
    if values.len() as u64 != elements {
        return Err(bad(format!("{} elements for shape {shape:?}", values.len())));
    }
    Ok((shape.clone(), if fortran { fortran_to_c(&shape, &values) } else { values }))
}

/// The library multiplies the axes of a header's shape without a look at their size.
fn check_npy_shape(bytes: &[u8]) -> std::result::Result<(), String> {
    let header = String::from_utf8_lossy(&bytes[..bytes.len().min(1 << 16)]);
    let Some((_, rest)) = header.split_once("'shape'") else { return Ok(()) };
    let shape = rest.split_once('(').and_then(|(_, r)| r.split_once(')')).map_or("", |(s, _)| s);
    let axes = shape.split(',').map(str::trim).filter(|axis| !axis.is_empty());
    let elements = axes.map(|axis| axis.parse::<u64>().ok()).try_fold(1u64, |n, axis| n.checked_mul(axis?));
    elements.map(drop).ok_or_else(|| shape.to_owned())
}

fn fortran_to_c(shape: &[usize], values: &[f32]) -> Vec<f32> {
    let mut strides = vec![1; shape.len()];
    for axis in 1..shape.len() {
        strides[axis] = strides[axis - 1] * shape[axis - 1];
    }
    (0..values.len())
        .map(|mut flat| {
            let mut at = 0;
            for axis in (0..shape.len()).rev() {
                at += flat % shape[axis] * strides[axis];
                flat /= shape[axis];
            }
            values[at]
        })
        .collect()
}

/// Writes a `.npy` of `f32` in C order.
///
/// # Errors
/// [`Error::Io`].
pub fn write_npy(path: &Path, shape: &[usize], values: &[f32]) -> Result<()> {
    use npyz::WriterBuilder;
    let shape: Vec<u64> = shape.iter().map(|&n| n as u64).collect();
    files::write_atomic_with(path, |file| {
        let mut writer = npyz::WriteOptions::new().default_dtype().shape(&shape).writer(file).begin_nd()?;
        writer.extend(values.iter().copied())?;
        writer.finish()
    })
}

/// Writes a 16-bit grey PNG of codes 0..=65535.
///
/// # Errors
/// [`Error::Io`] or [`Error::Internal`].
pub fn write_png16(path: &Path, width: usize, height: usize, codes: Vec<u16>) -> Result<()> {
    let buffer = image::ImageBuffer::<image::Luma<u16>, _>::from_raw(width as u32, height as u32, codes)
        .ok_or_else(|| Error::Internal("png buffer has the wrong size".into()))?;
    write_png(path, &image::DynamicImage::ImageLuma16(buffer))
}

/// Writes a PNG.
///
/// # Errors
/// As [`write_png16`].
pub fn write_png(path: &Path, picture: &image::DynamicImage) -> Result<()> {
    let mut bytes = std::io::Cursor::new(Vec::new());
    picture
        .write_to(&mut bytes, image::ImageFormat::Png)
        .map_err(|e| Error::Internal(format!("encoding {}: {e}", path.display())))?;
    files::write_atomic(path, bytes.get_ref())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn npy_round_trip_and_truncation() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a.npy");
        write_npy(&path, &[2, 3], &[1.0, 2.0, 3.0, 4.0, 5.0, 6.5]).unwrap();
        let image = read_image(&path).unwrap();
        assert_eq!((image.width, image.height, image.values[5]), (3, 2, 6.5));
        let bytes = std::fs::read(&path).unwrap();
        for keep in [0, 5, 60, bytes.len() - 1] {
            std::fs::write(&path, &bytes[..keep]).unwrap();
            let message = read_image(&path).unwrap_err().to_string();
            assert!(message.contains("a.npy"), "{keep}: {message}");
        }
    }

    #[test]
    fn fortran_order_is_read_in_c_order() {
        assert_eq!(fortran_to_c(&[2, 3], &[0.0, 3.0, 1.0, 4.0, 2.0, 5.0]), [0.0, 1.0, 2.0, 3.0, 4.0, 5.0]);
    }
}
