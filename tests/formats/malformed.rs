//! The project's parsers on damaged files: the result is an error or a value, never a panic or a huge allocation; if a
//! parser does not terminate, neither does this test. `NERTCA_MALFORMED_INPUTS` sets the number of inputs for each parser;
//! a failure names its seed, and `NERTCA_MALFORMED_SEED` repeats it.

use crate::common;
use crate::dicom;
use glam::DVec3;
use nertca_vk::checkpoint::Checkpoint;
use nertca_vk::formats::images;
use nertca_vk::formats::npy;
use nertca_vk::formats::volume::{Volume, VolumeHints};
use nertca_vk::formats::volume_files;
use nertca_vk::gpu::device::{DeviceOptions, Gpu};
use nertca_vk::import::ecg;
use nertca_vk::plan::Plan;
use nertca_vk::scan::dataset::Dataset;
use nertca_vk::train::trainer::Trainer;
use std::alloc::{GlobalAlloc, Layout, System};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Mutex, PoisonError};

/// Allocator that records the largest allocation, which must stay small for damaged files of a few kilobytes.
struct Bounded;

static LARGEST: AtomicUsize = AtomicUsize::new(0);

// SAFETY: hands everything on to the system's allocator.
unsafe impl GlobalAlloc for Bounded {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        LARGEST.fetch_max(layout.size(), Ordering::Relaxed);
        // SAFETY: as the caller vouches.
        unsafe { System.alloc(layout) }
    }

    // Zeroed memory costs nothing until it is written, and is then counted by `alloc` or `realloc`.
    unsafe fn alloc_zeroed(&self, layout: Layout) -> *mut u8 {
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

fn scratch() -> tempfile::TempDir {
    // A memory file system is faster than a disk for a million small files.
    tempfile::tempdir_in("/dev/shm").or_else(|_| tempfile::tempdir()).unwrap()
}

/// Passes damaged copies of the seeds, as a file called `name`, to a parser.
fn feed(name: &str, seeds: &[Vec<u8>], parse: impl Fn(&Path) -> bool) {
    // Only one parser runs at a time, because the largest allocation is recorded for all of them.
    static ALONE: Mutex<()> = Mutex::new(());
    let _alone = ALONE.lock().unwrap_or_else(PoisonError::into_inner);
    let number = |variable| std::env::var(variable).ok().map(|n| n.parse::<u64>().unwrap());
    let count = number("NERTCA_MALFORMED_INPUTS").unwrap_or(3000);
    let only = number("NERTCA_MALFORMED_SEED");
    let dir = scratch();
    let path = dir.path().join(name);
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
        match std::panic::catch_unwind(std::panic::AssertUnwindSafe(|| parse(&path))) {
            Ok(fine) => accepted += u64::from(fine),
            Err(_) => panic!("{name}: input {input} made it panic: {}", keep(name, &bytes)),
        }
        let largest = LARGEST.load(Ordering::Relaxed);
        if largest >= 512 << 20 {
            panic!("{name}: input {input} asked for {largest} bytes: {}", keep(name, &bytes));
        }
    }
    println!("{name}: {count} inputs, {accepted} of them still good");
    assert!(only.is_some() || accepted < count, "no damage was noticed");
}

/// Keeps an input for inspection, and returns its path.
fn keep(name: &str, bytes: &[u8]) -> String {
    let path = std::env::temp_dir().join(format!("malformed-{name}"));
    std::fs::write(&path, bytes).unwrap();
    path.display().to_string()
}

/// A header followed by 60 values.
fn volume_file(header: &str) -> Vec<u8> {
    let values = (0..60u16).flat_map(|i| f32::from(i).to_le_bytes());
    header.bytes().chain(values).collect()
}

fn reads_volume(path: &Path) -> bool {
    let hints = VolumeHints { spacing_mm: Some([1.0; 3]), ..VolumeHints::default() };
    volume_files::read(path, &hints).is_ok()
}

#[test]
fn nrrd() {
    let plain = "NRRD0004\ntype: float\ndimension: 3\nspace: left-posterior-superior\nsizes: 3 4 5\n\
                 space directions: (1,0,0) (0,2,0) (0,0,3)\nendian: little\nencoding: raw\nspace origin: (1,2,3)\n\n";
    let dir = scratch();
    let zipped = dir.path().join("z.nrrd");
    let half = Volume::centred([3, 4, 5], 1.0, DVec3::ZERO, vec![0.5; 60]);
    nertca_vk::formats::nrrd::write(&zipped, &half, "halves").unwrap();
    feed("v.nrrd", &[volume_file(plain), std::fs::read(&zipped).unwrap()], reads_volume);
}

#[test]
fn metaimage() {
    let header = "ObjectType = Image\nNDims = 3\nBinaryData = True\nBinaryDataByteOrderMSB = False\n\
                  TransformMatrix = 1 0 0 0 1 0 0 0 1\nOffset = 0 0 0\nElementSpacing = 1 1 2\nDimSize = 3 4 5\n\
                  ElementType = MET_FLOAT\nElementDataFile = LOCAL\n";
    feed("v.mha", &[volume_file(header)], reads_volume);
}

#[test]
fn npy_volumes_and_images() {
    let dir = scratch();
    let (cube, square) = (dir.path().join("c.npy"), dir.path().join("s.npy"));
    npy::write(&cube, &[3, 4, 5], &[0.5; 60]).unwrap();
    npy::write(&square, &[6, 10], &[0.5; 60]).unwrap();
    feed("v.npy", &[std::fs::read(&cube).unwrap()], reads_volume);
    feed("i.npy", &[std::fs::read(&square).unwrap()], |p| images::read_image(p).is_ok());
}

/// Writes a small dataset.
fn dataset(layout: nertca_vk::scan::dataset::Layout) -> (tempfile::TempDir, PathBuf) {
    let dir = scratch();
    let out = dir.path().join("data");
    nertca_vk::scan::writer::convert(&common::small_dataset(8, 8), layout, &out).unwrap();
    (dir, out)
}

fn feed_dataset(layout: nertca_vk::scan::dataset::Layout, manifest: &str) {
    let (_dir, out) = dataset(layout);
    let seed = std::fs::read(out.join(manifest)).unwrap();
    feed(manifest, &[seed], |path| {
        std::fs::copy(path, out.join(manifest)).unwrap();
        Dataset::open(&out).is_ok()
    });
}

#[test]
fn manifests() {
    feed_dataset(nertca_vk::scan::dataset::Layout::Native, "dataset.json");
}

#[test]
fn the_authors_geometry() {
    feed_dataset(nertca_vk::scan::dataset::Layout::Nerfca, "general.json");
}

#[test]
fn the_authors_frames() {
    feed_dataset(nertca_vk::scan::dataset::Layout::Nerfca, "train-0.json");
}

#[test]
fn checkpoints() {
    let data = common::small_dataset(8, 8);
    let config = common::small_config(
        "fast-mlp",
        &["static.grid=3", "dynamic.width=16", "dynamic.layers=2", "occupancy.enabled=false"],
    );
    let gpu = Gpu::open(&DeviceOptions::default()).unwrap();
    let plan = Plan::new(&config, &data).unwrap();
    let seed = Trainer::new(&gpu, plan, &data, common::tuning(&gpu)).unwrap().checkpoint().unwrap().to_bytes().unwrap();
    feed("c.safetensors", &[seed], |p| Checkpoint::read(p).is_ok());
}

#[test]
fn angiograms() {
    let dir = scratch();
    let file = dir.path().join("a.dcm");
    dicom::angiogram(&file, |_| ());
    feed("a.dcm", &[std::fs::read(&file).unwrap()], |p| nertca_vk::import::dicom::Run::read(p, None).is_ok());
}

#[test]
fn ecg_traces() {
    let seed: Vec<u8> = (0..400).map(|i| if i % 80 < 3 { 250 } else { (i % 7) as u8 }).collect();
    feed("ecg", &[seed], |path| {
        let trace: Vec<f64> = std::fs::read(path).unwrap().iter().map(|b| f64::from(*b)).collect();
        ecg::r_peaks(&trace, 100.0).is_ok()
    });
}
