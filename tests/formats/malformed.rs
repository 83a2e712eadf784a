//! The project's parsers on damaged files: the result is an error or a value, never a panic or a huge allocation; if a
//! parser does not terminate, neither does this test. `NERTCA_MALFORMED_INPUTS` sets the number of inputs for each parser;
//! a failure names its seed, and `NERTCA_MALFORMED_SEED` repeats it.

use crate::parsers::{MAX_ALLOCATION_BYTES, PARSERS, Parser, scratch};
use nertca_vk_import::ecg;
use std::alloc::{GlobalAlloc, Layout, System};
use std::path::Path;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Mutex, PoisonError};

/// Allocator that records the largest allocation, which must stay small for damaged files of a few kilobytes.
struct Bounded;

static LARGEST: AtomicUsize = AtomicUsize::new(0);

/// Held by the parser that runs, because the largest allocation is recorded for all of them.
static ALONE: Mutex<()> = Mutex::new(());

// SAFETY: hands everything on to the system's allocator.
unsafe impl GlobalAlloc for Bounded {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        LARGEST.fetch_max(layout.size(), Ordering::Relaxed);
        // SAFETY: as the caller vouches.
        unsafe { System.alloc(layout) }
    }

    unsafe fn alloc_zeroed(&self, layout: Layout) -> *mut u8 {
        LARGEST.fetch_max(layout.size(), Ordering::Relaxed);
        // SAFETY: as the caller vouches.
        unsafe { System.alloc_zeroed(layout) }
    }

    unsafe fn realloc(&self, at: *mut u8, layout: Layout, size: usize) -> *mut u8 {
        LARGEST.fetch_max(size, Ordering::Relaxed);
        // SAFETY: as the caller vouches.
        unsafe { System.realloc(at, layout, size) }
    }

    unsafe fn dealloc(&self, at: *mut u8, layout: Layout) {
        // SAFETY: as the caller vouches.
        unsafe { System.dealloc(at, layout) }
    }
}

#[global_allocator]
static ALLOCATOR: Bounded = Bounded;

struct Random(u64);

impl Random {
    fn below(&mut self, n: usize) -> usize {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        ((z ^ (z >> 31)) % n.max(1) as u64) as usize
    }
}

/// Damages mostly the beginning of a file, where headers are.
fn damage(seed: &[u8], random: &mut Random) -> Vec<u8> {
    let mut bytes = seed.to_vec();
    for _ in 0..=random.below(4) {
        let reach = if random.below(4) == 0 { bytes.len() } else { bytes.len().min(600) };
        let at = random.below(reach);
        match random.below(9) {
            0 => bytes.truncate(at),
            1 if !bytes.is_empty() => bytes[at] = random.below(256) as u8,
            2 if !bytes.is_empty() => bytes[at] ^= 1 << random.below(8),
            3 => {
                let tokens: [&[u8]; 14] = [
                    b"0",
                    b"-1",
                    b"nan",
                    b"1e400",
                    b"99999999999",
                    b"4294967296",
                    b" ",
                    b"\n",
                    b"{",
                    b"]",
                    b"\0\0\0\0",
                    b"\xff\xff\xff\xff",
                    b"null",
                    b"18446744073709551615",
                ];
                let token = tokens[random.below(tokens.len())];
                bytes.splice(at..at, token.iter().copied());
            }
            4 => {
                let end = (at + random.below(40)).min(bytes.len());
                bytes.drain(at..end);
            }
            5 => {
                let end = (at + random.below(80)).min(bytes.len());
                let part = bytes[at..end].to_vec();
                let to = random.below(bytes.len());
                bytes.splice(to..to, part);
            }
            // A digit is replaced by another, or one is added.
            6 | 7 => {
                let digits: Vec<usize> = (0..reach).filter(|i| bytes[*i].is_ascii_digit()).collect();
                if let Some(i) = digits.get(random.below(digits.len())) {
                    bytes[*i] = b'0' + random.below(10) as u8;
                    if random.below(3) == 0 {
                        bytes.insert(*i, b'9');
                    }
                }
            }
            _ => bytes.extend((0..random.below(64)).map(|i| i as u8)),
        }
    }
    bytes
}

/// Passes damaged copies of its seeds to a parser.
fn feed(parser: &Parser) {
    feed_files(parser.name, parser.file, &(parser.seeds)(), parser.parse);
}

/// Passes damaged copies of `seeds`, as a file called `file`, to a parser.
fn feed_files(name: &str, file: &str, seeds: &[Vec<u8>], parse: fn(&Path) -> bool) {
    let _alone = ALONE.lock().unwrap_or_else(PoisonError::into_inner);
    let number = |variable| std::env::var(variable).ok().map(|n| n.parse::<u64>().unwrap());
    let count = number("NERTCA_MALFORMED_INPUTS").unwrap_or(3000);
    let only = number("NERTCA_MALFORMED_SEED");
    let dir = scratch();
    let path = dir.path().join(file);
    for seed in seeds {
        std::fs::write(&path, seed).unwrap();
        assert!(parse(&path), "{name}: the undamaged file is refused");
    }
    let mut accepted = 0;
    for input in only.map_or(0..count, |seed| seed..seed + 1) {
        let mut random = Random(input.wrapping_mul(0xd134_2543_de82_ef95) ^ name.len() as u64);
        let which = random.below(seeds.len());
        let bytes = damage(&seeds[which], &mut random);
        std::fs::write(&path, &bytes).unwrap();
        LARGEST.store(0, Ordering::Relaxed);
        match std::panic::catch_unwind(|| parse(&path)) {
            Ok(fine) => accepted += u64::from(fine),
            Err(_) => panic!("{name}: input {input} made it panic: {}", keep(file, &bytes)),
        }
        let largest = LARGEST.load(Ordering::Relaxed);
        if largest >= MAX_ALLOCATION_BYTES {
            panic!("{name}: input {input} asked for {largest} bytes: {}", keep(file, &bytes));
        }
    }
    println!("{name}: {count} inputs, {accepted} of them still good");
    assert!(only.is_some() || accepted < count, "no damage was noticed");
}

/// Keeps an input for inspection, and returns its path.
fn keep(file: &str, bytes: &[u8]) -> String {
    let path = std::env::temp_dir().join(format!("malformed-{file}"));
    std::fs::write(&path, bytes).unwrap();
    path.display().to_string()
}

#[test]
fn damaged_files_are_values_or_errors() {
    PARSERS.iter().for_each(feed);
}

/// An input that the fuzzer found: parsing it took a time that doubled with each bracket.
#[test]
fn nested_brackets_are_refused_at_once() {
    let header = format!("{{'descr': {}", "[".repeat(100));
    let length = (header.len() as u16).to_le_bytes();
    let dir = scratch();
    let path = dir.path().join("nested.npy");
    std::fs::write(&path, [b"\x93NUMPY\x01\0".as_slice(), &length, header.as_bytes()].concat()).unwrap();
    let error = nertca_vk::formats::npy::read(&path, 1 << 20).unwrap_err().to_string();
    assert!(error.contains("nested brackets"), "{error}");
}

/// Inputs that the fuzzer found: each once cost far more memory than it has bytes.
#[test]
fn sizes_that_files_only_claim_reserve_no_memory() {
    const NIFTI_DIM_AT: usize = 40;
    const NIFTI_DATATYPE_AT: usize = 70;
    const COMPLEX_256: i16 = 2048;
    /// Place of the number of values of the fifth entry of the first page.
    const TIFF_COUNT_AT: usize = 70;
    let parser = |name: &str| PARSERS.iter().find(|parser| parser.name == name).unwrap();
    let claimed_header = [b"\x93NUMPY\x02\0".as_slice(), &600_000_000u32.to_le_bytes(), b"{}"].concat();
    let mut without_values = (parser("nifti").seeds)().remove(0);
    let sizes = [3i16, 3, 16_000, 16_000].into_iter().enumerate();
    let shorts = sizes.map(|(axis, length)| (NIFTI_DIM_AT + 2 * axis, length));
    let no_bits = [(NIFTI_DATATYPE_AT, COMPLEX_256), (NIFTI_DATATYPE_AT + 2, 0)];
    for (at, value) in shorts.chain(no_bits) {
        without_values[at..][..2].copy_from_slice(&value.to_le_bytes());
    }
    let dir = scratch();
    let mut long_list = (parser("tiff").seeds)().remove(0);
    long_list[TIFF_COUNT_AT..][..4].copy_from_slice(&0x0200_0001u32.to_le_bytes());
    for (name, bytes) in [("npy", claimed_header), ("nifti", without_values), ("tiff", long_list)] {
        let Parser { file, parse, .. } = parser(name);
        let path = dir.path().join(file);
        std::fs::write(&path, bytes).unwrap();
        let _alone = ALONE.lock().unwrap_or_else(PoisonError::into_inner);
        LARGEST.store(0, Ordering::Relaxed);
        assert!(!parse(&path), "{name}: accepted");
        let largest = LARGEST.load(Ordering::Relaxed);
        assert!(largest < MAX_ALLOCATION_BYTES, "{name}: asked for {largest} bytes");
    }
}

#[test]
fn compressed_and_enhanced_angiograms() {
    let files = crate::pydicom::Files::by(
        "
import PIL.Image, SimpleITK
from pydicom import encaps
from pydicom.dataset import Dataset
d = read()
pixels = d.pixel_array
d.compress(pydicom.uid.RLELossless)
save('rle', d, pixels)
def jpeg(frame):
    b = io.BytesIO()
    PIL.Image.fromarray(frame).save(b, 'JPEG')
    return b.getvalue()
def lossless(frame):
    writer = SimpleITK.ImageFileWriter()
    writer.SetImageIO('GDCMImageIO')
    writer.UseCompressionOn()
    writer.SetCompressor('JPEG')
    writer.SetFileName(str(out / 'one.dat'))
    writer.Execute(SimpleITK.GetImageFromArray(frame[None]))
    return next(encaps.generate_frames(pydicom.dcmread(out / 'one.dat').PixelData, number_of_frames=1))
for name, syntax, encode in (('jpeg', pydicom.uid.JPEGBaseline8Bit, jpeg), ('lossless', pydicom.uid.JPEGLosslessSV1, lossless)):
    d = read()
    d.file_meta.TransferSyntaxUID = syntax
    d.PixelData = encaps.encapsulate([encode(frame) for frame in pixels], fragments_per_frame=2, has_bot=False)
    d['PixelData'].VR = 'OB'
    save(name, d, pixels)
def group(**values):
    d = Dataset()
    for name, value in values.items():
        setattr(d, name, value)
    return d
d = read()
d.SharedFunctionalGroupsSequence = [group(
    XRayGeometrySequence=[group(DistanceSourceToIsocenter=700.0, DistanceSourceToDetector=1000.0)],
    FramePixelDataPropertiesSequence=[group(ImagerPixelSpacing=[2.0, 1.5])],
    PositionerPositionSequence=[group(PositionerPrimaryAngle=30.0, PositionerSecondaryAngle=-20.0)])]
d.PerFrameFunctionalGroupsSequence = [group(FrameContentSequence=[group(FrameReferenceDateTime=f'2026112612000{k}')]) for k in range(6)]
save('enhanced', d, pixels)
write('unknown', before_pixels(element(0x21, 0x1010, b'UN', item(implicit(0x21, 0x1011, item(b'') + END)) + END)))
",
    );
    let seeds: Vec<Vec<u8>> = files.names().iter().map(|name| std::fs::read(files.path(name)).unwrap()).collect();
    assert_eq!(seeds.len(), 5);
    feed_files("dicom, compressed", "c.dcm", &seeds, |p| nertca_vk_import::dicom::Run::read(p, None).is_ok());
}

#[test]
fn ecg_traces() {
    let seeds = || vec![(0..400).map(|i| if i % 80 < 3 { 250 } else { (i % 7) as u8 }).collect()];
    let parse = |path: &Path| {
        let trace: Vec<f64> = std::fs::read(path).unwrap().iter().map(|b| f64::from(*b)).collect();
        ecg::r_peaks(&trace, 100.0).is_ok()
    };
    feed(&Parser { name: "ecg", file: "ecg", seeds, parse });
}
