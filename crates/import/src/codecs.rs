//! Transfer syntaxes, and images as they compress them: one frame of grey values at a time.

use crate::elements::syntax;
use crate::formats::decoders::caught;
use hayro_jpeg2000::{DecodeSettings, DecoderContext, Image};
use jpeg_decoder::{Decoder, PixelFormat, UnsupportedFeature};

/// Marker with which a JPEG 2000 codestream begins; the marker of its size follows.
const START_OF_CODESTREAM: [u8; 2] = [0xff, 0x4f];
const SIZE_MARKER: [u8; 2] = [0xff, 0x51];
/// Offset of the precision of the first component in a JPEG 2000 codestream, bytes (ISO 15444-1, A.5.1).
const PRECISION_AT: usize = 42;
/// Bit of a precision that says that values are signed.
const IS_SIGNED: u8 = 0x80;
/// Bytes of the header of an RLE image: the number of its segments, and 15 offsets.
const RLE_HEADER_BYTES: usize = 64;

/// Way in which a transfer syntax stores frames.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Codec {
    /// Numbers as they are, one frame after the other or each in a fragment.
    Native,
    Rle,
    Jpeg,
    JpegLs,
    Jpeg2000,
}

impl Codec {
    /// Returns the codec of a transfer syntax.
    ///
    /// # Errors
    /// A sentence that names the codec, and a tool that converts it.
    pub(super) fn of(uid: &str) -> Result<Codec, String> {
        match uid {
            syntax::IMPLICIT | syntax::EXPLICIT | syntax::EXPLICIT_BIG_ENDIAN | syntax::DEFLATED => Ok(Codec::Native),
            // Encapsulated uncompressed.
            "1.2.840.10008.1.2.1.98" => Ok(Codec::Native),
            "1.2.840.10008.1.2.5" => Ok(Codec::Rle),
            // Baseline, extended, progressive, and lossless with any predictor or the first.
            "1.2.840.10008.1.2.4.50"
            | "1.2.840.10008.1.2.4.51"
            | "1.2.840.10008.1.2.4.55"
            | "1.2.840.10008.1.2.4.57"
            | "1.2.840.10008.1.2.4.70" => Ok(Codec::Jpeg),
            // Lossless, and near-lossless.
            "1.2.840.10008.1.2.4.80" | "1.2.840.10008.1.2.4.81" => Ok(Codec::JpegLs),
            // Lossless, and either.
            "1.2.840.10008.1.2.4.90" | "1.2.840.10008.1.2.4.91" => Ok(Codec::Jpeg2000),
            other => Err(not_read(other)),
        }
    }

    /// Marker with which each frame begins, where the codec has markers; all end with the same one.
    pub(super) fn first_marker(self) -> Option<[u8; 2]> {
        match self {
            Codec::Native | Codec::Rle => None,
            Codec::Jpeg | Codec::JpegLs => Some([0xff, 0xd8]),
            Codec::Jpeg2000 => Some(START_OF_CODESTREAM),
        }
    }

    /// Decodes the grey values of a frame of `size` (columns, rows), each with the bits that are stored for it.
    ///
    /// # Errors
    /// The problem of a damaged image, or of one that does not fit the layout.
    pub(super) fn decode(self, bytes: &[u8], size: [usize; 2], bytes_per_value: usize) -> Result<Vec<u32>, String> {
        match self {
            Codec::Native => native(bytes, size[0] * size[1], bytes_per_value, false),
            Codec::Rle => rle(bytes, size[0] * size[1], bytes_per_value),
            Codec::Jpeg => caught(|| jpeg(bytes, size))?,
            Codec::JpegLs => caught(|| jpeg_ls(bytes, size))?,
            Codec::Jpeg2000 => caught(|| jpeg2000(bytes, size))?,
        }
    }
}

/// Sentence about a codec that is not read.
fn not_read(uid: &str) -> String {
    let (name, tool) = match uid {
        "1.2.840.10008.1.2.4.92" | "1.2.840.10008.1.2.4.93" => ("JPEG 2000 with several components", "gdcmconv --raw"),
        "1.2.840.10008.1.2.4.201" | "1.2.840.10008.1.2.4.202" | "1.2.840.10008.1.2.4.203" => {
            ("High-Throughput JPEG 2000", "gdcmconv --raw")
        }
        "1.2.840.10008.1.2.4.110" | "1.2.840.10008.1.2.4.111" | "1.2.840.10008.1.2.4.112" => {
            ("JPEG XL", "gdcmconv --raw")
        }
        video if video.starts_with("1.2.840.10008.1.2.4.10") => {
            return format!(
                "is a video (MPEG or HEVC) by {video}, which is not read; export the run as images, or as uncompressed DICOM"
            );
        }
        uid => {
            return format!(
                "{uid} is no transfer syntax that is read; convert the file, for example with `gdcmconv --raw`"
            );
        }
    };
    format!("is {name} ({uid}), which is not read; convert the file, for example with `{tool} FILE NEW.dcm`")
}

/// Reads numbers of one, two or four bytes.
pub(super) fn native(bytes: &[u8], pixels: usize, width: usize, big_endian: bool) -> Result<Vec<u32>, String> {
    let Some(bytes) = bytes.get(..pixels * width) else {
        return Err(format!("has {} bytes where {} are needed", bytes.len(), pixels * width));
    };
    let number = |part: &[u8]| {
        let shifted = |sum: u32, byte: &u8| sum << 8 | u32::from(*byte);
        if big_endian { part.iter().fold(0, shifted) } else { part.iter().rev().fold(0, shifted) }
    };
    Ok(bytes.chunks_exact(width).map(number).collect())
}

/// Decodes an RLE image (Part 5, annex G): a segment for each byte of the values, the most significant first.
fn rle(bytes: &[u8], pixels: usize, width: usize) -> Result<Vec<u32>, String> {
    let header = bytes.get(..RLE_HEADER_BYTES).ok_or("its RLE header is incomplete")?;
    let word = |i: usize| {
        u32::from_le_bytes([header[4 * i], header[4 * i + 1], header[4 * i + 2], header[4 * i + 3]]) as usize
    };
    if word(0) != width {
        return Err(format!("its RLE image has {} segments where {width} are needed", word(0)));
    }
    let mut values = vec![0u32; pixels];
    for segment in 0..width {
        let begin = word(segment + 1);
        let end = if segment + 1 < width { word(segment + 2) } else { bytes.len() };
        let packed =
            bytes.get(begin..end).ok_or_else(|| format!("its RLE segment {segment} lies outside the image"))?;
        let unpacked = unpack(packed, pixels);
        if unpacked.len() < pixels {
            return Err(format!("its RLE segment {segment} has {} bytes where {pixels} are needed", unpacked.len()));
        }
        values.iter_mut().zip(unpacked).for_each(|(value, byte)| *value = *value << 8 | u32::from(byte));
    }
    Ok(values)
}

/// Unpacks at most `most` bytes that PackBits has packed.
fn unpack(packed: &[u8], most: usize) -> Vec<u8> {
    let (mut at, mut out) = (0, Vec::new());
    while at < packed.len() && out.len() < most {
        let head = packed[at];
        at += 1;
        match head {
            0..=127 => {
                let end = (at + usize::from(head) + 1).min(packed.len());
                out.extend_from_slice(&packed[at..end]);
                at = end;
            }
            // Nothing follows.
            128 => {}
            129.. => {
                let Some(byte) = packed.get(at) else { break };
                out.resize(out.len() + 257 - usize::from(head), *byte);
                at += 1;
            }
        }
    }
    out.truncate(most);
    out
}

fn jpeg(bytes: &[u8], size: [usize; 2]) -> Result<Vec<u32>, String> {
    let mut decoder = Decoder::new(bytes);
    decoder.read_info().map_err(|error| jpeg_problem(&error))?;
    let info = decoder.info().ok_or("its JPEG image has no header")?;
    let found = [usize::from(info.width), usize::from(info.height)];
    if found != size {
        return Err(format!(
            "its JPEG image has {} x {} pixels where {} x {} are needed",
            found[0], found[1], size[0], size[1]
        ));
    }
    if ![PixelFormat::L8, PixelFormat::L16].contains(&info.pixel_format) {
        return Err("its JPEG image is in colour, but grey values are needed".into());
    }
    let values = decoder.decode().map_err(|error| jpeg_problem(&error))?;
    Ok(match info.pixel_format {
        PixelFormat::L8 => values.into_iter().map(u32::from).collect(),
        _ => values.chunks_exact(2).map(|pair| u16::from_ne_bytes([pair[0], pair[1]]).into()).collect(),
    })
}

fn jpeg_ls(bytes: &[u8], [width, height]: [usize; 2]) -> Result<Vec<u32>, String> {
    // The decoder compares the sizes before it reserves memory.
    let decoded = jpegls::decode(bytes, width as u32, height as u32);
    let (values, ..) = decoded.map_err(|error| format!("its JPEG-LS image cannot be decoded: {error}"))?;
    Ok(values.into_iter().map(u32::from).collect())
}

fn jpeg2000(bytes: &[u8], size: [usize; 2]) -> Result<Vec<u32>, String> {
    let damaged = |error: hayro_jpeg2000::DecodeError| format!("its JPEG 2000 image cannot be decoded: {error}");
    // A damaged image is not to be read in part.
    let settings = DecodeSettings { resolve_palette_indices: false, strict: true, target_resolution: None };
    let image = Image::new(bytes, &settings).map_err(damaged)?;
    let found = [image.width() as usize, image.height() as usize];
    if found != size {
        let [x, y] = found;
        return Err(format!("its JPEG 2000 image has {x} x {y} pixels where {} x {} are needed", size[0], size[1]));
    }
    let mut context = DecoderContext::default();
    let decoded = image.decode(&mut context).map_err(damaged)?;
    let [component] = decoded.components() else {
        return Err("its JPEG 2000 image is in colour, but grey values are needed".into());
    };
    // The decoder shifts signed values to positive ones, as it does with unsigned values.
    let steps = 2f32.powi(component.bit_depth().into());
    let zero = if is_signed(bytes) { steps / 2.0 } else { 0.0 };
    let value = |sample: &f32| (sample.round().clamp(0.0, steps - 1.0) - zero) as i32 as u32;
    Ok(component.samples().iter().map(value).collect())
}

/// Tells whether the values of a JPEG 2000 codestream are signed.
fn is_signed(bytes: &[u8]) -> bool {
    let begin = [START_OF_CODESTREAM, SIZE_MARKER].concat();
    let codestream = bytes.windows(begin.len()).position(|window| window == begin).map_or(&[][..], |at| &bytes[at..]);
    codestream.get(PRECISION_AT).is_some_and(|precision| precision & IS_SIGNED != 0)
}

fn jpeg_problem(error: &jpeg_decoder::Error) -> String {
    match error {
        jpeg_decoder::Error::Unsupported(UnsupportedFeature::SamplePrecision(bits)) => format!(
            "is a lossy JPEG image of {bits} bits per pixel (JPEG extended), which is not read; convert the file, for example \
             with `dcmdjpeg FILE NEW.dcm`"
        ),
        jpeg_decoder::Error::Unsupported(feature) => format!(
            "is a JPEG image with a feature that is not read ({feature:?}); convert the file, for example with `dcmdjpeg FILE \
             NEW.dcm`"
        ),
        error => format!("its JPEG image cannot be decoded: {error}"),
    }
}
