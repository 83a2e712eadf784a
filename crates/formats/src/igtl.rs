//! Messages of OpenIGTLink (<http://openigtlink.org/developers/spec>), which 3D Slicer, PLUS and robots exchange over TCP: written with header
//! version 1, read with versions 1 to 3. Coordinates are right, anterior, superior (RAS), mm.

use crc::{CRC_64_ECMA_182, Crc};
use glam::DVec3;
use std::time::Duration;

/// Bytes of a header.
pub const HEADER_BYTES: usize = 58;
/// Version of the header.
const HEADER_VERSION: u16 = 1;
/// Longest name of a device, bytes.
const NAME_BYTES: usize = 20;
/// Longest name of a type, bytes.
const TYPE_BYTES: usize = 12;
/// Version of the body of an image.
const IMAGE_VERSION: u16 = 1;
/// Code of pixels that are 32-bit floats.
const FLOAT: u8 = 10;
/// Code of big-endian pixels.
const BIG_ENDIAN: u8 = 1;
/// Code of RAS coordinates.
const RAS: u8 = 1;
/// Code of one number per point, among the attributes of lines.
const POINT_SCALARS: u8 = 0;
/// Version of the header from which on a body begins with a header of its own.
const EXTENDED_VERSION: u16 = 2;
/// Bytes of the longest body that is read.
const MAX_BODY_BYTES: u64 = 1 << 16;
const CHECKSUM: Crc<u64> = Crc::<u64>::new(&CRC_64_ECMA_182);

/// Returns a vector in LPS as one in RAS.
pub fn ras(lps: DVec3) -> DVec3 {
    DVec3::new(-lps.x, -lps.y, lps.z)
}

/// Returns a message: its header and its body. Names that are too long are cut.
pub fn message(kind: &str, device: &str, since_1970: Duration, body: &[u8]) -> Vec<u8> {
    let mut out = Vec::with_capacity(HEADER_BYTES + body.len());
    out.extend(HEADER_VERSION.to_be_bytes());
    out.extend(padded::<TYPE_BYTES>(kind));
    out.extend(padded::<NAME_BYTES>(device));
    // Seconds, and a fraction in units of 2^-32 s.
    let fraction = (u64::from(since_1970.subsec_nanos()) << 32) / 1_000_000_000;
    out.extend((since_1970.as_secs() as u32).to_be_bytes());
    out.extend((fraction as u32).to_be_bytes());
    out.extend((body.len() as u64).to_be_bytes());
    out.extend(CHECKSUM.checksum(body).to_be_bytes());
    out.extend(body);
    out
}

/// Returns a text of a fixed length, filled up with zeros.
fn padded<const N: usize>(text: &str) -> [u8; N] {
    let mut out = [0; N];
    out.iter_mut().zip(text.bytes()).for_each(|(to, from)| *to = from);
    out
}

fn floats(out: &mut Vec<u8>, vector: DVec3) {
    out.extend(vector.to_array().iter().flat_map(|v| (*v as f32).to_be_bytes()));
}

/// Returns the body of a TRANSFORM message: the unit axes of a device in columns, and its position.
pub fn transform(axes: [DVec3; 3], position_mm: DVec3) -> Vec<u8> {
    let mut out = Vec::new();
    axes.into_iter().chain([position_mm]).for_each(|column| floats(&mut out, column));
    out
}

/// Returns the columns of a TRANSFORM message: the axes of a device, and its position. `None` for a body of another length, and for numbers
/// that are not finite.
pub fn read_transform(content: &[u8]) -> Option<[DVec3; 4]> {
    let content: &[u8; 48] = content.try_into().ok()?;
    let (words, _) = content.as_chunks::<4>();
    let number = |i: usize| f64::from(f32::from_be_bytes(words[i]));
    let columns = [0, 3, 6, 9].map(|first| DVec3::new(number(first), number(first + 1), number(first + 2)));
    columns.iter().all(|column| column.is_finite()).then_some(columns)
}

/// A message that was received.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Received {
    /// Type.
    pub kind: String,
    /// Name of the device.
    pub device: String,
    /// Body without its own header and metadata.
    pub content: Vec<u8>,
}

/// Reads the messages of a stream.
#[derive(Debug, Default)]
pub struct Reader {
    held: Vec<u8>,
    /// Bytes of a long body that are still to come, and are not read.
    left_out: u64,
}

impl Reader {
    /// Takes the next bytes of the stream.
    pub fn push(&mut self, bytes: &[u8]) {
        let left_out = usize::try_from(self.left_out).unwrap_or(usize::MAX).min(bytes.len());
        self.left_out -= left_out as u64;
        self.held.extend(&bytes[left_out..]);
    }

    /// Returns the next message; `None` until all of it has come. A message that is longer than 64 KiB, has a wrong checksum or is misshapen
    /// is left out.
    pub fn next_message(&mut self) -> Option<Received> {
        loop {
            let header: [u8; HEADER_BYTES] = *self.held.first_chunk()?;
            let eight = |at: usize| header[at..].first_chunk().map_or(0, |bytes| u64::from_be_bytes(*bytes));
            let [n_bytes, checksum] = [eight(42), eight(50)];
            if n_bytes > MAX_BODY_BYTES {
                let rest = self.held.split_off(HEADER_BYTES);
                (self.held, self.left_out) = (Vec::new(), n_bytes);
                self.push(&rest);
                continue;
            }
            let end = HEADER_BYTES + n_bytes as usize;
            if self.held.len() < end {
                return None;
            }
            let rest = self.held.split_off(end);
            let message = std::mem::replace(&mut self.held, rest);
            let body = &message[HEADER_BYTES..];
            if CHECKSUM.checksum(body) != checksum {
                continue;
            }
            let version = u16::from_be_bytes([header[0], header[1]]);
            if let Some(content) = content(version, body) {
                let [kind, device] = [&header[2..2 + TYPE_BYTES], &header[14..14 + NAME_BYTES]].map(unpadded);
                return Some(Received { kind, device, content: content.to_owned() });
            }
        }
    }
}

/// Returns a body without its own header and its metadata; `None` where it is shorter than it states.
fn content(version: u16, body: &[u8]) -> Option<&[u8]> {
    if version < EXTENDED_VERSION {
        return Some(body);
    }
    // Bytes of this header, of the header of the metadata, and of the metadata.
    let [a, b, c, d, e, f, g, h] = *body.first_chunk()?;
    let metadata = u32::from(u16::from_be_bytes([c, d])).checked_add(u32::from_be_bytes([e, f, g, h]))?;
    let end = body.len().checked_sub(metadata as usize)?;
    body.get(usize::from(u16::from_be_bytes([a, b]))..end)
}

/// Returns a text that was filled up with zeros.
fn unpadded(bytes: &[u8]) -> String {
    let text = bytes.split(|byte| *byte == 0).next().unwrap_or_default();
    String::from_utf8_lossy(text).into_owned()
}

/// A picture in space.
#[derive(Debug, Clone, Copy)]
pub struct Picture<'a> {
    /// Values, row by row.
    pub values: &'a [f32],
    /// Columns and rows.
    pub size: [u16; 2],
    /// Steps from a column and a row to the next one, mm.
    pub steps_mm: [DVec3; 2],
    /// Middle of the picture, mm.
    pub middle_mm: DVec3,
}

/// Returns the body of an IMAGE message: a single slice of floats.
pub fn image(picture: &Picture<'_>) -> Vec<u8> {
    let mut out = Vec::with_capacity(72 + 4 * picture.values.len());
    out.extend(IMAGE_VERSION.to_be_bytes());
    let components = 1;
    out.extend([components, FLOAT, BIG_ENDIAN, RAS]);
    let [columns, rows] = picture.size;
    let size = [columns, rows, 1u16].map(u16::to_be_bytes).concat();
    out.extend(&size);
    let [across, down] = picture.steps_mm;
    // The length of the normal is the thickness of the slice.
    let normal = across.cross(down).normalize_or(DVec3::Z) * across.length();
    [across, down, normal, picture.middle_mm].into_iter().for_each(|vector| floats(&mut out, vector));
    // The message holds the whole picture.
    let first = [0u16; 3].map(u16::to_be_bytes).concat();
    out.extend(first.iter().chain(&size));
    out.extend(picture.values.iter().flat_map(|value| value.to_be_bytes()));
    out
}

/// Returns the body of a POLYDATA message: lines through points, with a number per point.
pub fn lines<'a>(lines: impl Iterator<Item = &'a [DVec3]> + Clone, name: &str, numbers: &[f64]) -> Vec<u8> {
    let n_lines = lines.clone().count() as u32;
    let n_points: usize = lines.clone().map(<[DVec3]>::len).sum();
    // Each line states its number of points and their numbers.
    let line_bytes = 4 * (n_lines as usize + n_points);
    let mut out = Vec::new();
    // Points; vertices, lines, polygons and strips with their bytes; attributes.
    for count in [n_points as u32, 0, 0, n_lines, line_bytes as u32, 0, 0, 0, 0, 1] {
        out.extend(count.to_be_bytes());
    }
    lines.clone().flatten().for_each(|point| floats(&mut out, *point));
    let mut next = 0u32;
    for line in lines {
        out.extend((line.len() as u32).to_be_bytes());
        for _ in line {
            out.extend(next.to_be_bytes());
            next += 1;
        }
    }
    out.extend([POINT_SCALARS, 1]);
    out.extend((numbers.len() as u32).to_be_bytes());
    out.extend(name.bytes().chain([0]));
    if name.len().is_multiple_of(2) {
        // Names with their end take an even number of bytes.
        out.push(0);
    }
    out.extend(numbers.iter().flat_map(|number| (*number as f32).to_be_bytes()));
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_message_has_the_published_header() {
        let since = Duration::new(1_700_000_000, 500_000_000);
        let message = message("TRANSFORM", "CArm", since, b"123456789");
        assert_eq!(message.len(), HEADER_BYTES + 9);
        assert_eq!(message[..2], [0, 1]);
        assert_eq!(&message[2..14], b"TRANSFORM\0\0\0");
        assert_eq!(&message[14..34], b"CArm\0\0\0\0\0\0\0\0\0\0\0\0\0\0\0\0");
        assert_eq!(message[34..38], 1_700_000_000u32.to_be_bytes());
        assert_eq!(message[38..42], 0x8000_0000u32.to_be_bytes(), "half a second");
        assert_eq!(message[42..50], 9u64.to_be_bytes());
        // The check value of CRC-64/ECMA-182.
        assert_eq!(message[50..58], 0x6c40_df5f_0b49_7347u64.to_be_bytes());
    }

    /// A message of header version 2, with 12 bytes before its content and 5 of metadata behind it.
    fn extended(content: &[u8]) -> Vec<u8> {
        let sizes = [&12u16.to_be_bytes()[..], &2u16.to_be_bytes(), &3u32.to_be_bytes(), &7u32.to_be_bytes()].concat();
        let mut message = message("TRANSFORM", "CArm", Duration::ZERO, &[&sizes[..], content, b"12345"].concat());
        message[1] = 2;
        message
    }

    #[test]
    fn messages_are_read_as_they_come() {
        let axes = [DVec3::X, DVec3::Y, DVec3::Z];
        let body = transform(axes, DVec3::new(1.0, 2.0, -3.0));
        let columns = [DVec3::X, DVec3::Y, DVec3::Z, DVec3::new(1.0, 2.0, -3.0)];
        assert_eq!(read_transform(&body), Some(columns));
        assert_eq!(read_transform(&body[1..]), None);
        assert_eq!(read_transform(&[0xff; 48]), None, "numbers that are not finite");
        let mut damaged = message("TRANSFORM", "damaged", Duration::ZERO, &body);
        damaged[HEADER_BYTES] ^= 1;
        let long = message("IMAGE", "long", Duration::ZERO, &vec![7; MAX_BODY_BYTES as usize + 1]);
        let mut misshapen = message("TRANSFORM", "misshapen", Duration::ZERO, &[0xff; 20]);
        misshapen[1] = 2;
        let old = message("TRANSFORM", "old", Duration::ZERO, &body);
        let stream = [old, damaged, long, misshapen, extended(&body)].concat();
        for step in [1, 57, 1000, stream.len()] {
            let (mut reader, mut read) = (Reader::default(), Vec::new());
            for bytes in stream.chunks(step) {
                reader.push(bytes);
                read.extend(std::iter::from_fn(|| reader.next_message()));
            }
            let devices: Vec<&str> = read.iter().map(|message| message.device.as_str()).collect();
            assert_eq!(devices, ["old", "CArm"], "{step} bytes at a time");
            assert!(read.iter().all(|message| message.kind == "TRANSFORM" && message.content == body));
            assert!(reader.held.is_empty(), "nothing is left");
        }
        let mut reader = Reader::default();
        reader.push(&[0xff; 4000]);
        assert_eq!(reader.next_message(), None, "no message at all");
    }

    #[test]
    fn bodies_have_their_published_lengths() {
        assert_eq!(transform([DVec3::X, DVec3::Y, DVec3::Z], DVec3::ONE).len(), 48);
        let picture =
            Picture { values: &[0.0; 6], size: [3, 2], steps_mm: [DVec3::X, DVec3::Y], middle_mm: DVec3::ZERO };
        assert_eq!(image(&picture).len(), 72 + 24);
        let (a, b) = ([DVec3::ZERO; 3], [DVec3::ONE; 2]);
        let body = lines([&a[..], &b[..]].into_iter(), "Radius", &[1.0; 5]);
        // Counts, points, both lines, the attribute's header, name and values.
        assert_eq!(body.len(), 40 + 5 * 12 + 4 * 7 + 6 + 8 + 5 * 4);
    }
}
