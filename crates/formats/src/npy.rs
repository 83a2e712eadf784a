//! `.npy` arrays of numbers, through the `npyz` crate.

use crate::error::{Error, Result};
use crate::files;
use std::io::Write;
use std::path::Path;

/// Largest header that is read: the largest of version 1, which arrays of numbers have.
const MAX_HEADER_BYTES: usize = 1 << 16;

/// A numeric array of any shape, in C order.
#[derive(Debug, Clone, PartialEq)]
pub struct Array {
    /// Length of each axis, the slowest-varying axis first.
    pub shape: Vec<usize>,
    /// Values, with the last axis varying fastest.
    pub values: Vec<f32>,
}

/// Reads a numeric `.npy` of any shape (C or Fortran order) and at most `limit` bytes.
///
/// # Errors
/// [`Error::Io`] or [`Error::Data`] naming the file.
pub fn read(path: &Path, limit: u64) -> Result<Array> {
    let bytes = files::read_limited(path, limit)?;
    let bad = |problem: String| Error::data(path, "npy", problem);
    let header = header(&bytes).map_err(bad)?;
    check_nesting(header).and_then(|()| check_shape(header)).map_err(bad)?;
    let npy = npyz::NpyFile::new(&bytes[..]).map_err(|e| bad(format!("header: {e}")))?;
    let mut shape = Vec::new();
    let mut elements: u64 = 1;
    for &axis in npy.shape() {
        elements =
            elements.checked_mul(axis).ok_or_else(|| bad(format!("the shape {:?} is too large", npy.shape())))?;
        shape.push(axis as usize);
    }
    if elements > bytes.len() as u64 {
        return Err(bad(format!(
            "the shape {shape:?} needs more than the file's {} bytes; it may be truncated",
            bytes.len()
        )));
    }
    let fortran = npy.order() == npyz::Order::Fortran && shape.len() > 1;
    let npyz::DType::Plain(dtype) = npy.dtype() else {
        return Err(bad("a structured array is not supported; an array of numbers is needed".into()));
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
            return Err(bad(format!(
                "the element type {other} is not supported; floats, integers of up to 32 bits and Booleans are"
            )));
        }
    };
    let values = values.map_err(|e| bad(format!("{e}; the file may be truncated")))?;
    if values.len() as u64 != elements {
        return Err(bad(format!("has {} elements, which do not fit the shape {shape:?}", values.len())));
    }
    let values = if fortran { fortran_to_c(&shape, &values) } else { values };
    Ok(Array { shape, values })
}

/// Returns the header of a file, which the library must not see before it is checked: it reserves memory for any length that a file
/// states.
fn header(bytes: &[u8]) -> std::result::Result<&[u8], String> {
    const VERSION_AT: usize = 6;
    const LENGTH_AT: usize = 8;
    let narrow = |at: &[u8]| at.first_chunk().map(|length| (usize::from(u16::from_le_bytes(*length)), LENGTH_AT + 2));
    let wide = |at: &[u8]| at.first_chunk().map(|length| (u32::from_le_bytes(*length) as usize, LENGTH_AT + 4));
    let version = bytes.get(VERSION_AT).copied().unwrap_or_default();
    let stated = bytes.get(LENGTH_AT..).and_then(|at| if version < 2 { narrow(at) } else { wide(at) });
    let (length, begin) = stated.ok_or("the file ends within its header")?;
    if length > MAX_HEADER_BYTES {
        return Err(format!(
            "the header claims {length} bytes, but that of an array of numbers has {MAX_HEADER_BYTES} at most"
        ));
    }
    bytes.get(begin..begin + length).ok_or_else(|| {
        format!("the header claims {length} bytes, but the file has {} in all; it may be truncated", bytes.len())
    })
}

/// Checks how deeply brackets in a header are nested: the library's parser needs a time that doubles with each level.
fn check_nesting(header: &[u8]) -> std::result::Result<(), String> {
    // A dictionary with a list of fields, each a tuple with a shape.
    const MAX_DEPTH: usize = 4;
    let mut depth = 0usize;
    for byte in header {
        match byte {
            b'{' | b'[' | b'(' => depth += 1,
            b'}' | b']' | b')' => depth = depth.saturating_sub(1),
            _ => {}
        }
        if depth > MAX_DEPTH {
            return Err("the header has too many nested brackets for an array of numbers".to_owned());
        }
    }
    Ok(())
}

/// Checks the shape in a header for overflow; the library multiplies its axes without a check.
fn check_shape(header: &[u8]) -> std::result::Result<(), String> {
    let header = String::from_utf8_lossy(header).replace('"', "'");
    let Some((_, rest)) = header.split_once("'shape'") else { return Ok(()) };
    let shape = rest.split_once('(').and_then(|(_, r)| r.split_once(')')).map_or("", |(s, _)| s);
    let axes = shape.split(',').map(str::trim).filter(|axis| !axis.is_empty());
    let elements = axes.map(|axis| axis.parse::<u64>().ok()).try_fold(1u64, |n, axis| n.checked_mul(axis?));
    elements.map(drop).ok_or_else(|| format!("the shape is too large ({shape})"))
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
pub fn write(path: &Path, shape: &[usize], values: &[f32]) -> Result<()> {
    files::write_atomic_with(path, |file| {
        let mut writer = begin(file, shape)?;
        writer.extend(values.iter().copied())?;
        writer.finish()
    })
}

/// Begins a `.npy` of `f32` in C order; the values are then written in pieces.
///
/// # Errors
/// Errors of `out`.
pub fn begin<W: Write>(out: W, shape: &[usize]) -> std::io::Result<npyz::NpyWriter<f32, W>> {
    use npyz::WriterBuilder;
    let shape: Vec<u64> = shape.iter().map(|&n| n as u64).collect();
    npyz::WriteOptions::new().default_dtype().shape(&shape).writer(out).begin_nd()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn round_trip_and_truncation() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a.npy");
        let array = Array { shape: vec![2, 3], values: vec![1.0, 2.0, 3.0, 4.0, 5.0, 6.5] };
        write(&path, &array.shape, &array.values).unwrap();
        assert_eq!(read(&path, 1 << 20).unwrap(), array);
        let bytes = std::fs::read(&path).unwrap();
        for keep in [0, 5, 60, bytes.len() - 1] {
            std::fs::write(&path, &bytes[..keep]).unwrap();
            let message = read(&path, 1 << 20).unwrap_err().to_string();
            assert!(message.contains("a.npy"), "{keep}: {message}");
        }
    }

    #[test]
    fn fortran_order_is_read_in_c_order() {
        assert_eq!(fortran_to_c(&[2, 3], &[0.0, 3.0, 1.0, 4.0, 2.0, 5.0]), [0.0, 1.0, 2.0, 3.0, 4.0, 5.0]);
    }
}
