//! Pixel data: which fragments belong to which frame, and the values of frames as they are stored.

use crate::codecs::{Codec, native};
use crate::elements::{DataSet, Element, Fragments, Value, numbers};
use crate::formats::decoders;
use dicom_core::VR;
use dicom_dictionary_std::tags;
use rayon::prelude::*;
use std::borrow::Cow;

const END_OF_IMAGE: [u8; 2] = [0xff, 0xd9];
/// Bytes at the end of a fragment in which an end of an image is searched: it may be followed by padding.
const PADDING_BYTES: usize = 10;
/// Bytes of the header of an item, which offsets of frames count.
const ITEM_HEADER_BYTES: u64 = 8;

/// Layout of the pixels of a run.
#[derive(Debug, Clone, Copy)]
pub(super) struct Layout {
    pub(super) frames: usize,
    /// Columns and rows.
    pub(super) size: [usize; 2],
    /// Bytes of a value: BitsAllocated / 8.
    pub(super) bytes_per_value: usize,
    /// BitsStored.
    pub(super) bits: u32,
    /// HighBit.
    pub(super) high_bit: u32,
    /// Whether values are two's complement.
    pub(super) signed: bool,
}

impl Layout {
    fn pixels(&self) -> usize {
        self.size[0] * self.size[1]
    }

    /// Value of the bits of a pixel; those that are not stored may hold anything, such as an overlay.
    fn value(&self, bits: u32, codec: Codec) -> f32 {
        // JPEG images hold the stored bits alone.
        let lowest = if codec.first_marker().is_some() { 0 } else { (self.high_bit + 1).saturating_sub(self.bits) };
        let unused = u32::BITS - self.bits;
        let topmost = bits >> lowest << unused;
        if self.signed { (topmost as i32 >> unused) as f32 } else { (topmost >> unused) as f32 }
    }
}

/// Returns the values of each frame as they are stored.
///
/// # Errors
/// The problem of the pixel data.
pub(super) fn decode(
    data: &DataSet,
    codec: Codec,
    layout: &Layout,
    notes: &mut Vec<String>,
) -> Result<Vec<Vec<f32>>, String> {
    let element = data.get(tags::PIXEL_DATA).ok_or("is missing")?;
    let stored: Vec<Vec<u32>> = match &element.value {
        Value::Fragments(fragments) => {
            let frames = frames_of(fragments, data, codec, layout.frames, notes)?;
            let decode = |(i, parts): (usize, &Vec<usize>)| {
                let bytes = joined(fragments, parts);
                let values = codec.decode(&bytes, layout.size, layout.bytes_per_value);
                values.map_err(|problem| format!("frame {}: {problem}", i + 1))
            };
            // The first frame that is damaged is named, whichever is decoded first.
            let decoded: Vec<Result<Vec<u32>, String>> =
                decoders::caught(|| frames.par_iter().enumerate().map(decode).collect())?;
            decoded.into_iter().collect::<Result<_, String>>()?
        }
        Value::Bytes { bytes, .. } if codec == Codec::Native => {
            notes.extend(more_frames(bytes.len(), layout));
            uncompressed(bytes, element, layout)?
        }
        _ => return Err("is not compressed, though the transfer syntax says that it is".into()),
    };
    let values = |frame: Vec<u32>| -> Vec<f32> { frame.into_iter().map(|bits| layout.value(bits, codec)).collect() };
    let frames: Vec<Vec<f32>> = stored.into_par_iter().map(values).collect();
    match frames.iter().position(|frame| frame.len() != layout.pixels()) {
        Some(i) => Err(format!("frame {}: has {} values where {} are needed", i + 1, frames[i].len(), layout.pixels())),
        None => Ok(frames),
    }
}

/// Returns a warning where pixel data hold more frames than the file states.
fn more_frames(bytes: usize, layout: &Layout) -> Option<String> {
    let held = bytes / (layout.pixels() * layout.bytes_per_value);
    (held > layout.frames).then(|| {
        format!(
            "warning: PixelData holds {held} frames, but NumberOfFrames states {}, which are read: the others are left out",
            layout.frames
        )
    })
}

fn uncompressed(bytes: &[u8], element: &Element, layout: &Layout) -> Result<Vec<Vec<u32>>, String> {
    let big_endian = element.bytes().is_some_and(|(_, big_endian)| big_endian);
    let (frame, needed) =
        (layout.pixels() * layout.bytes_per_value, layout.pixels() * layout.bytes_per_value * layout.frames);
    if bytes.len() < needed {
        return Err(format!("has {} bytes where {needed} are needed for {} frames", bytes.len(), layout.frames));
    }
    // Bytes in big-endian words of two are in the wrong order.
    let swapped = big_endian && layout.bytes_per_value == 1 && element.vr == VR::OW;
    let frame_of = |i: usize| {
        let of_frame = |bytes: &[u8]| native(bytes, layout.pixels(), layout.bytes_per_value, big_endian);
        match swapped {
            true => (i * frame..(i + 1) * frame)
                .map(|at| bytes.get(at ^ 1).map(|b| u32::from(*b)).ok_or_else(short))
                .collect(),
            false => of_frame(&bytes[i * frame..(i + 1) * frame]),
        }
    };
    (0..layout.frames).into_par_iter().map(frame_of).collect()
}

fn short() -> String {
    "has an odd number of bytes in words of two".into()
}

fn joined<'a>(fragments: &'a Fragments, parts: &[usize]) -> Cow<'a, [u8]> {
    match parts {
        [one] => Cow::Borrowed(&fragments.fragments[*one]),
        parts => Cow::Owned(parts.iter().flat_map(|part| fragments.fragments[*part].iter().copied()).collect()),
    }
}

/// Returns the fragments of each frame.
fn frames_of(
    fragments: &Fragments,
    data: &DataSet,
    codec: Codec,
    frames: usize,
    notes: &mut Vec<String>,
) -> Result<Vec<Vec<usize>>, String> {
    let count = fragments.fragments.len();
    if count < frames {
        return Err(format!("has {count} fragments, but {frames} frames need one each"));
    }
    if frames == 1 {
        return Ok(vec![(0..count).collect()]);
    }
    if count == frames {
        return Ok((0..count).map(|fragment| vec![fragment]).collect());
    }
    let extended = extended_offsets(data);
    let tables = [("extended offset table", &extended), ("basic offset table", &fragments.offsets)];
    for (name, table) in tables.into_iter().filter(|(_, table)| !table.is_empty()) {
        match by_offsets(fragments, table, frames).filter(|starts| begin_images(fragments, starts, codec)) {
            Some(starts) => return Ok(between(&starts, count)),
            None => {
                notes.push(format!("the {name} of the pixel data does not agree with the fragments, and was not used"))
            }
        }
    }
    if let Some(marker) = codec.first_marker()
        && let Some(starts) = by_ends(fragments, frames).or_else(|| by_begins(fragments, frames, marker))
    {
        return Ok(between(&starts, count));
    }
    Err(format!(
        "has {count} fragments for {frames} frames, and neither an offset table nor the markers of its images tell where frames \
         begin; try `gdcmconv --raw`"
    ))
}

fn extended_offsets(data: &DataSet) -> Vec<u64> {
    let table = data.get(tags::EXTENDED_OFFSET_TABLE).and_then(Element::bytes);
    table.and_then(|(bytes, big_endian)| numbers(bytes, big_endian, u64::from_le_bytes).ok()).unwrap_or_default()
}

/// First fragment of each frame by a table of offsets; none if the table points between fragments.
fn by_offsets(fragments: &Fragments, table: &[u64], frames: usize) -> Option<Vec<usize>> {
    let mut at = 0;
    let places: Vec<u64> = fragments
        .fragments
        .iter()
        .map(|fragment| {
            let place = at;
            at += ITEM_HEADER_BYTES + fragment.len() as u64;
            place
        })
        .collect();
    let starts = table.iter().map(|offset| places.binary_search(offset).ok()).collect::<Option<Vec<usize>>>()?;
    let rising = starts.windows(2).all(|pair| pair[0] < pair[1]);
    (starts.len() == frames && starts[0] == 0 && rising).then_some(starts)
}

/// Tells whether the fragments at which frames begin also begin images, where that can be seen.
fn begin_images(fragments: &Fragments, starts: &[usize], codec: Codec) -> bool {
    let begins = |marker: [u8; 2]| starts.iter().all(|start| fragments.fragments[*start].starts_with(&marker));
    codec.first_marker().is_none_or(begins)
}

/// First fragment of each frame by the ends of images; none unless there is one for each frame.
fn by_ends(fragments: &Fragments, frames: usize) -> Option<Vec<usize>> {
    let ends = |fragment: &[u8]| {
        let tail = &fragment[fragment.len().saturating_sub(PADDING_BYTES)..];
        tail.windows(2).any(|pair| pair == END_OF_IMAGE)
    };
    let after: Vec<usize> =
        (0..fragments.fragments.len()).filter(|i| ends(&fragments.fragments[*i])).map(|i| i + 1).collect();
    let is_last = after.last() == Some(&fragments.fragments.len());
    let starts = || [0].into_iter().chain(after[..frames - 1].iter().copied()).collect();
    (after.len() == frames && is_last).then(starts)
}

/// First fragment of each frame by the beginnings of images; none unless there is one for each frame.
fn by_begins(fragments: &Fragments, frames: usize, marker: [u8; 2]) -> Option<Vec<usize>> {
    let begins = |i: &usize| fragments.fragments[*i].starts_with(&marker);
    let starts: Vec<usize> = (0..fragments.fragments.len()).filter(begins).collect();
    (starts.len() == frames && starts[0] == 0).then_some(starts)
}

/// Fragments from each start to the next.
fn between(starts: &[usize], count: usize) -> Vec<Vec<usize>> {
    let ends = starts.iter().skip(1).copied().chain([count]);
    starts.iter().copied().zip(ends).map(|(start, end)| (start..end).collect()).collect()
}
