//! Element types of binary data, their decoding, and raw binary volumes.

use crate::error::{Error, Result};
use crate::files;
use crate::volume::{MAX_BYTES, Volume, VolumeHints};
use std::io::{Read, Write};
use std::path::Path;
use strum::{IntoStaticStr, VariantArray};

/// Type of the numbers in a file, named after the Rust type.
#[derive(Debug, Clone, Copy, PartialEq, Eq, IntoStaticStr, VariantArray)]
#[allow(missing_docs, reason = "named after the types they stand for")]
#[strum(serialize_all = "kebab-case")]
pub enum Element {
    F32,
    F64,
    I8,
    U8,
    I16,
    U16,
    I32,
    U32,
}

/// Byte order of numbers.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ByteOrder {
    /// Least significant byte first.
    Little,
    /// Most significant byte first.
    Big,
}

impl Element {
    /// Name of the type in `--raw-type` and in messages.
    pub fn name(self) -> &'static str {
        self.into()
    }

    /// Returns the type with a name.
    fn named(name: &str) -> Option<Element> {
        Element::VARIANTS.iter().copied().find(|element| element.name() == name)
    }

    /// Size of one number, bytes.
    pub fn bytes(self) -> usize {
        match self {
            Element::F64 => 8,
            Element::F32 | Element::I32 | Element::U32 => 4,
            Element::I16 | Element::U16 => 2,
            Element::I8 | Element::U8 => 1,
        }
    }

    /// Decodes the first `n` numbers of `bytes`.
    ///
    /// # Errors
    /// [`Error::Data`] naming `path`, when there are fewer.
    pub fn decode(self, path: &Path, order: ByteOrder, bytes: &[u8], n: usize) -> Result<Vec<f32>> {
        let wanted = n * self.bytes();
        let Some(bytes) = bytes.get(..wanted) else {
            let kind = self.name();
            let problem =
                format!("has {} bytes where {n} voxels of {kind} need {wanted}; it may be truncated", bytes.len());
            return Err(Error::data(path, "data", problem));
        };
        macro_rules! numbers {
            ($ty:ty) => {{
                let from = match order {
                    ByteOrder::Little => <$ty>::from_le_bytes,
                    ByteOrder::Big => <$ty>::from_be_bytes,
                };
                bytes.as_chunks::<{ size_of::<$ty>() }>().0.iter().map(|word| from(*word) as f32).collect()
            }};
        }
        Ok(match self {
            Element::F32 => numbers!(f32),
            Element::F64 => numbers!(f64),
            Element::I8 => numbers!(i8),
            Element::U8 => numbers!(u8),
            Element::I16 => numbers!(i16),
            Element::U16 => numbers!(u16),
            Element::I32 => numbers!(i32),
            Element::U32 => numbers!(u32),
        })
    }
}

/// Names of all types, separated by commas, for messages.
fn names() -> String {
    Element::VARIANTS.iter().map(|element| element.name()).collect::<Vec<_>>().join(", ")
}

/// Reads a raw binary volume, x varying fastest, little endian; size, type and spacing come from `hints`.
///
/// # Errors
/// [`Error::Data`] or [`Error::Io`] naming file and field.
pub fn read(path: &Path, hints: &VolumeHints) -> Result<Volume> {
    let stated = hints.size.unwrap_or_default();
    let size = Volume::check_size(path, "size", &stated.map(|n| n as u64))?;
    let kind = hints.raw_type.as_deref().unwrap_or(Element::F32.name());
    let element = Element::named(kind)
        .ok_or_else(|| Error::data(path, "type", format!("`{kind}` is not supported; {} are", names())))?;
    let bytes = files::read_limited(path, MAX_BYTES)?;
    let values = element.decode(path, ByteOrder::Little, &bytes, size.iter().product())?;
    Ok(Volume { size, values, index_to_lps: Volume::axis_aligned(size, hints.spacing(path)?) })
}

/// Decompresses at most `n` bytes, the size that the header states, so that a decompression bomb cannot exhaust the memory.
pub(super) fn read_at_most(compressed: impl Read, n: usize) -> std::io::Result<Vec<u8>> {
    let mut out = Vec::new();
    compressed.take(n as u64).read_to_end(&mut out)?;
    Ok(out)
}

/// Writes floats in a byte order, in blocks rather than through a copy of all values.
///
/// # Errors
/// Errors of `out`.
pub fn write_floats(mut out: impl Write, values: &[f32], order: ByteOrder) -> std::io::Result<()> {
    let bytes = match order {
        ByteOrder::Little => f32::to_le_bytes,
        ByteOrder::Big => f32::to_be_bytes,
    };
    for block in values.chunks(1 << 16) {
        let block: Vec<u8> = block.iter().flat_map(|v| bytes(*v)).collect();
        out.write_all(&block)?;
    }
    Ok(())
}
