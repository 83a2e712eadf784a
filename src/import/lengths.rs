//! Checks that the elements of a DICOM file claim no more bytes than the file holds. The library that reads the file allocates
//! and fills the claimed length, which can be 4 GiB for a damaged file of a few bytes.

use crate::error::{Error, Result};
use std::io::{BufReader, Read};
use std::path::Path;

/// Largest accepted nesting depth of sequences.
const DEEPEST: u32 = 16;
const UNDEFINED: u32 = u32::MAX;
const EXPLICIT_BIG_ENDIAN: &str = "1.2.840.10008.1.2.2";
const IMPLICIT: &str = "1.2.840.10008.1.2";
const DEFLATED: &str = "1.2.840.10008.1.2.1.99";

struct Walker<'a> {
    file: BufReader<std::fs::File>,
    at: u64,
    end: u64,
    path: &'a Path,
    big_endian: bool,
    implicit: bool,
}

/// Rejects a file with elements that reach beyond its end.
///
/// # Errors
/// [`Error::Data`] naming the element; [`Error::Io`].
pub(super) fn check(path: &Path) -> Result<()> {
    let file = std::fs::File::open(path).map_err(Error::io("read", path))?;
    let end = file.metadata().map_err(Error::io("read", path))?.len();
    let mut w = Walker { file: BufReader::new(file), at: 0, end, path, big_endian: false, implicit: false };
    let head = w.take(132)?;
    if &head[128..] != b"DICM" {
        return Err(Error::data(path, "DICOM", "has no DICM after its preamble, so it is not a DICOM file"));
    }
    // The meta information group is always little endian with explicit types.
    let mut syntax = String::new();
    while w.at < end {
        let begin = w.at;
        let (group, element, length) = w.header()?;
        if group != 2 {
            w.seek(begin)?;
            break;
        }
        w.fits(group, element, length)?;
        let value = w.take(length as usize)?;
        if element == 0x0010 {
            syntax = String::from_utf8_lossy(&value).trim_end_matches([' ', '\0']).to_owned();
        }
    }
    if syntax == DEFLATED {
        return Err(Error::data(path, "(0002,0010) TransferSyntaxUID", "deflated files are not accepted"));
    }
    (w.big_endian, w.implicit) = (syntax == EXPLICIT_BIG_ENDIAN, syntax == IMPLICIT);
    w.elements(end, 0)
}

impl Walker<'_> {
    fn short(&self) -> Error {
        Error::data(self.path, "DICOM", format!("ends inside an element at byte {}; it may be truncated", self.at))
    }

    fn take(&mut self, n: usize) -> Result<Vec<u8>> {
        if self.end - self.at < n as u64 {
            return Err(self.short());
        }
        let mut bytes = vec![0; n];
        self.file.read_exact(&mut bytes).map_err(Error::io("read", self.path))?;
        self.at += n as u64;
        Ok(bytes)
    }

    fn seek(&mut self, to: u64) -> Result<()> {
        // Most steps end within the buffer, which a relative seek keeps.
        self.file.seek_relative(to as i64 - self.at as i64).map_err(Error::io("read", self.path))?;
        self.at = to;
        Ok(())
    }

    fn u16(&mut self) -> Result<u16> {
        let b = self.take(2)?;
        Ok(if self.big_endian { u16::from_be_bytes([b[0], b[1]]) } else { u16::from_le_bytes([b[0], b[1]]) })
    }

    fn u32(&mut self) -> Result<u32> {
        let b = [self.take(2)?, self.take(2)?].concat();
        let b = [b[0], b[1], b[2], b[3]];
        Ok(if self.big_endian { u32::from_be_bytes(b) } else { u32::from_le_bytes(b) })
    }

    /// Reads the header of an element: group, element and length.
    fn header(&mut self) -> Result<(u16, u16, u32)> {
        let (group, element) = (self.u16()?, self.u16()?);
        // Items and their delimiters have no type.
        if self.implicit || group == 0xfffe {
            return Ok((group, element, self.u32()?));
        }
        let kind = self.take(2)?;
        // Unknown types have 32-bit lengths, like the newer types.
        const SHORT: &[u8] = b"AE AS AT CS DA DS DT FL FD IS LO LT PN SH SL SS ST TM UI UL US";
        if SHORT.chunks(3).any(|known| known[..2] == kind[..]) {
            let length = self.u16()?;
            // If a value ended inside a number, its last bytes would be read as the next element.
            let number = match &kind[..] {
                b"FD" => 8,
                b"AT" | b"FL" | b"SL" | b"UL" => 4,
                b"SS" | b"US" => 2,
                _ => 1,
            };
            if length % number != 0 {
                let problem =
                    format!("has {length} bytes, which is not a multiple of {number}, the size of its numbers");
                return Err(Error::data(self.path, format!("({group:04X},{element:04X})"), problem));
            }
            return Ok((group, element, length.into()));
        }
        self.take(2)?;
        Ok((group, element, self.u32()?))
    }

    fn fits(&self, group: u16, element: u16, length: u32) -> Result<()> {
        if u64::from(length) <= self.end - self.at {
            return Ok(());
        }
        let problem =
            format!("states {length} bytes, but the file has only {} left; it may be truncated", self.end - self.at);
        Err(Error::data(self.path, format!("({group:04X},{element:04X})"), problem))
    }

    /// Checks elements up to a position in the file, or to the delimiter of an item of undefined length.
    fn elements(&mut self, end: u64, depth: u32) -> Result<()> {
        while self.at < end {
            let (group, element, length) = self.header()?;
            match (group, element) {
                (0xfffe, 0xe00d) => return Ok(()),
                // Fragments of pixel data are items without elements.
                (0x7fe0, 0x0010) if length == UNDEFINED => self.items(self.end, depth + 1, true)?,
                _ if length == UNDEFINED => self.items(self.end, depth + 1, false)?,
                _ => {
                    self.fits(group, element, length)?;
                    let after = self.at + u64::from(length);
                    if self.begins_with_item(length)? {
                        self.items(after, depth + 1, false)?;
                    }
                    self.seek(after)?;
                }
            }
        }
        Ok(())
    }

    /// Tells whether a value begins with an item and so is a sequence; with implicit types nothing else shows that.
    fn begins_with_item(&mut self, length: u32) -> Result<bool> {
        if length < 8 {
            return Ok(false);
        }
        let (begin, first) = (self.at, (self.u16()?, self.u16()?));
        self.seek(begin)?;
        Ok(first == (0xfffe, 0xe000))
    }

    /// Checks items, or fragments of pixel data, up to a position in the file or the delimiter of their sequence.
    fn items(&mut self, end: u64, depth: u32, fragments: bool) -> Result<()> {
        if depth > DEEPEST {
            return Err(Error::data(self.path, "DICOM", format!("sequences are nested more than {DEEPEST} deep")));
        }
        while self.at < end {
            let (group, element, length) = self.header()?;
            match (group, element) {
                (0xfffe, 0xe0dd) => return Ok(()),
                (0xfffe, 0xe000) if length == UNDEFINED => self.elements(self.end, depth)?,
                (0xfffe, 0xe000) => {
                    self.fits(group, element, length)?;
                    let after = self.at + u64::from(length);
                    if !fragments {
                        self.elements(after, depth)?;
                    }
                    self.seek(after)?;
                }
                _ => {
                    let field = format!("({group:04X},{element:04X})");
                    return Err(Error::data(self.path, field, "was found where an item is expected"));
                }
            }
        }
        Ok(())
    }
}
