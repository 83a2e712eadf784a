//! Arrays of VTK's XML files, in every encoding that VTK itself writes except two compressions: as text, as base64 inside the
//! element, or appended as base64 or raw bytes; uncompressed or in zlib blocks; in either byte order, with lengths of 32 or 64
//! bits.

use crate::error::{Error, Result};
use flate2::read::ZlibDecoder;
use roxmltree::{Document, Node};
use std::io::Read;
use std::path::Path;

/// Largest accepted array after decompression, bytes.
const MAX_BYTES: usize = 1 << 27;
const APPENDED: &[u8] = b"<AppendedData";
const ROOT: &str = "VTKFile";
const ZLIB: &str = "vtkZLibDataCompressor";

/// A file split into its XML and the appended data, which need not be XML.
pub(super) struct SplitFile<'a> {
    /// The XML without the appended data.
    pub(super) text: String,
    appended: Option<Appended<'a>>,
}

#[derive(Clone, Copy)]
struct Appended<'a> {
    base64: bool,
    data: &'a [u8],
}

impl<'a> SplitFile<'a> {
    /// Splits the bytes of a file.
    pub(super) fn of(bytes: &'a [u8]) -> SplitFile<'a> {
        let Some(start) = bytes.windows(APPENDED.len()).position(|w| w == APPENDED) else {
            return SplitFile { text: String::from_utf8_lossy(bytes).into_owned(), appended: None };
        };
        let (head, tail) = bytes.split_at(start);
        let tag_end = tail.iter().position(|b| *b == b'>').unwrap_or(tail.len());
        let (tag, rest) = tail.split_at(tag_end);
        let base64 = String::from_utf8_lossy(tag).contains("base64");
        // The data begin after an underscore.
        let data = rest.iter().position(|b| *b == b'_').map_or(&rest[..0], |mark| &rest[mark + 1..]);
        let text = format!("{}</{ROOT}>", String::from_utf8_lossy(head));
        SplitFile { text, appended: Some(Appended { base64, data }) }
    }
}

/// Storage options of the arrays of a file.
pub(super) struct Arrays<'a> {
    file: &'a Path,
    wide_lengths: bool,
    big_endian: bool,
    zlib: bool,
    appended: Option<Appended<'a>>,
}

impl<'a> Arrays<'a> {
    /// Reads the storage options from the root of a document whose type must be `kind`.
    ///
    /// # Errors
    /// [`Error::Data`] for another kind of file and for a compression that is not read.
    pub(super) fn of(file: &'a Path, document: &Document<'_>, parts: &SplitFile<'a>, kind: &str) -> Result<Arrays<'a>> {
        let root = document.root_element();
        let found = root.attribute("type").unwrap_or_default();
        if root.tag_name().name() != ROOT || found != kind {
            let problem =
                format!("is `{found}` in a `{}`, but `{kind}` in a `{ROOT}` is needed", root.tag_name().name());
            return Err(Error::data(file, "type", problem));
        }
        let zlib = match root.attribute("compressor") {
            None => false,
            Some(ZLIB) => true,
            Some(other) => {
                let problem = format!("{other} is not supported: write the file with {ZLIB}, or without a compressor");
                return Err(Error::data(file, "compressor", problem));
            }
        };
        Ok(Arrays {
            file,
            wide_lengths: root.attribute("header_type") == Some("UInt64"),
            big_endian: root.attribute("byte_order") == Some("BigEndian"),
            zlib,
            appended: parts.appended,
        })
    }

    /// Reads the values of a `DataArray`.
    ///
    /// # Errors
    /// [`Error::Data`] naming the array.
    pub(super) fn values(&self, array: Node<'_, '_>) -> Result<Vec<f64>> {
        let name = array.attribute("Name").unwrap_or("Points");
        let fail = |problem: String| Error::data(self.file, format!("DataArray {name}"), problem);
        let text = array.text().unwrap_or_default();
        let mut stream = match array.attribute("format").unwrap_or("ascii") {
            "ascii" => {
                let number = |word: &str| word.parse().map_err(|_| fail(format!("`{word}` is not a number")));
                return text.split_ascii_whitespace().map(number).collect();
            }
            "binary" => Stream { rest: text.as_bytes(), base64: true, decoded: Vec::new() },
            "appended" => {
                let offset = array.attribute("offset").and_then(|offset| offset.trim().parse::<usize>().ok());
                let data = self.appended.and_then(|all| Some((all.base64, all.data.get(offset?..)?)));
                let (base64, rest) = data.ok_or_else(|| fail("its offset is outside the appended data".into()))?;
                Stream { rest, base64, decoded: Vec::new() }
            }
            other => return Err(fail(format!("the format `{other}` is not one of ascii, binary, appended"))),
        };
        let short = || fail("ends before its stated length, or does not agree with its encoding".into());
        let bytes = self.bytes(&mut stream).ok_or_else(short)?;
        let kind = array.attribute("type").unwrap_or_default();
        self.numbers(&bytes, kind)
            .ok_or_else(|| fail(format!("{} bytes are not a whole number of values of type `{kind}`", bytes.len())))
    }

    /// Reads a length or a number of blocks.
    fn length(&self, stream: &mut Stream<'_>) -> Option<usize> {
        let bytes = stream.take(if self.wide_lengths { 8 } else { 4 })?;
        let fold = |value: u64, byte: &u8| (value << 8) | u64::from(*byte);
        let value = if self.big_endian { bytes.iter().fold(0, fold) } else { bytes.iter().rev().fold(0, fold) };
        usize::try_from(value).ok().filter(|length| *length <= MAX_BYTES)
    }

    /// Reads the uncompressed bytes of an array; none if there are fewer than the array states.
    fn bytes(&self, stream: &mut Stream<'_>) -> Option<Vec<u8>> {
        let first = self.length(stream)?;
        if !self.zlib {
            return stream.take(first);
        }
        // The header of compressed data: number of blocks, size of a block, size of the last block if it is smaller (else 0),
        // and the compressed size of each block.
        let (block, last) = (self.length(stream)?, self.length(stream)?);
        let packed: Vec<usize> = (0..first).map_while(|_| self.length(stream)).collect();
        if packed.len() < first || first.checked_mul(block)? > MAX_BYTES {
            return None;
        }
        let mut all = Vec::new();
        for (index, length) in packed.into_iter().enumerate() {
            let wanted = if index + 1 == first && last > 0 { last } else { block };
            let before = all.len();
            let data = stream.take(length)?;
            // Reading one byte more than wanted detects blocks that are too large.
            ZlibDecoder::new(&data[..]).take(wanted as u64 + 1).read_to_end(&mut all).ok()?;
            if all.len() - before != wanted {
                return None;
            }
        }
        Some(all)
    }

    fn numbers(&self, bytes: &[u8], kind: &str) -> Option<Vec<f64>> {
        macro_rules! read {
            ($number:ty) => {
                bytes
                    .chunks(size_of::<$number>())
                    .map(|chunk| {
                        let chunk = chunk.try_into().ok()?;
                        let value = if self.big_endian {
                            <$number>::from_be_bytes(chunk)
                        } else {
                            <$number>::from_le_bytes(chunk)
                        };
                        Some(value as f64)
                    })
                    .collect()
            };
        }
        match kind {
            "Float64" => read!(f64),
            "Float32" => read!(f32),
            "Int64" => read!(i64),
            "UInt64" => read!(u64),
            "Int32" => read!(i32),
            "UInt32" => read!(u32),
            "Int16" => read!(i16),
            "UInt16" => read!(u16),
            "Int8" => read!(i8),
            "UInt8" | "String" => read!(u8),
            _ => None,
        }
    }
}

/// Bytes that are read in order and decoded as needed.
struct Stream<'a> {
    rest: &'a [u8],
    base64: bool,
    /// Bytes that are decoded but not yet taken.
    decoded: Vec<u8>,
}

impl Stream<'_> {
    /// Takes the next `n` bytes; returns none if there are fewer, before memory is reserved for them.
    fn take(&mut self, n: usize) -> Option<Vec<u8>> {
        if n > self.decoded.len() + self.rest.len() {
            return None;
        }
        if !self.base64 {
            let (taken, rest) = self.rest.split_at(n);
            self.rest = rest;
            return Some(taken.to_vec());
        }
        while self.decoded.len() < n {
            self.decode()?;
        }
        Some(self.decoded.drain(..n).collect())
    }

    /// Decodes the next four letters of base64. VTK pads each part of an array by itself, so padding does not end the data.
    fn decode(&mut self) -> Option<()> {
        let (mut bits, mut letters, mut padding) = (0u32, 0, 0);
        while letters < 4 {
            let (letter, rest) = self.rest.split_first()?;
            self.rest = rest;
            if letter.is_ascii_whitespace() {
                continue;
            }
            let value = match letter {
                b'A'..=b'Z' => letter - b'A',
                b'a'..=b'z' => letter - b'a' + 26,
                b'0'..=b'9' => letter - b'0' + 52,
                b'+' => 62,
                b'/' => 63,
                b'=' => 0,
                _ => return None,
            };
            padding += usize::from(*letter == b'=');
            bits = (bits << 6) | u32::from(value);
            letters += 1;
        }
        let bytes = [(bits >> 16) as u8, (bits >> 8) as u8, bits as u8];
        self.decoded.extend(&bytes[..3usize.checked_sub(padding)?]);
        Some(())
    }
}
