//! Parsers of files that other programs make, each with files that it reads: input of the tests of damaged files and of the fuzzer.
#![allow(missing_docs, clippy::unwrap_used, clippy::expect_used, reason = "shared by tests")]

use crate::common;
use glam::DVec3;
use nertca_vk::checkpoint::Checkpoint;
use nertca_vk::formats::volume::{Volume, VolumeHeader, VolumeHints};
use nertca_vk::formats::vtp::{Lines, Values};
use nertca_vk::formats::{images, metaimage, nifti, npy, nrrd, png, volume_files};
use nertca_vk::gpu::device::{DeviceOptions, Gpu};
use nertca_vk::plan::Plan;
use nertca_vk::scan::dataset::{Dataset, Layout};
use nertca_vk::train::trainer::Trainer;
use nertca_vk_phantom::tree_file::TreeFile;
use std::path::{Path, PathBuf};
use std::sync::OnceLock;

/// Largest single allocation, in bytes, that a damaged file of a few kilobytes may cause.
pub const MAX_ALLOCATION_BYTES: usize = 512 << 20;

/// A parser with files that it accepts.
pub struct Parser {
    pub name: &'static str,
    /// Name of the file that is parsed: some parsers go by it.
    pub file: &'static str,
    pub seeds: fn() -> Vec<Vec<u8>>,
    /// Parses a file, and tells whether it was accepted.
    pub parse: fn(&Path) -> bool,
}

pub const PARSERS: &[Parser] = &[
    Parser { name: "nrrd", file: "v.nrrd", seeds: nrrd_files, parse: reads_volume },
    Parser { name: "metaimage", file: "v.mha", seeds: metaimage_files, parse: reads_volume },
    Parser { name: "nifti", file: "v.nii", seeds: nifti_files, parse: reads_volume },
    Parser { name: "npy", file: "v.npy", seeds: npy_volumes, parse: reads_volume },
    Parser { name: "npy_image", file: "i.npy", seeds: npy_images, parse: reads_image },
    Parser { name: "png", file: "i.png", seeds: png_images, parse: reads_image },
    Parser { name: "jpeg", file: "f.jpg", seeds: || vec![crate::dicom::baseline()], parse: reads_frames },
    Parser { name: "tiff", file: "f.tif", seeds: tiff_frames, parse: reads_frames },
    Parser {
        name: "views_file",
        file: "views.toml",
        seeds: || vec![VIEWS.as_bytes().to_vec()],
        parse: |p| nertca_vk_import::views_file::read(p).is_ok(),
    },
    Parser {
        name: "rtk",
        file: "geometry.xml",
        seeds: || vec![include_bytes!("../formats/rtk/geometry.xml").to_vec()],
        parse: |p| nertca_vk::formats::rtk::read_geometry(p).is_ok(),
    },
    Parser { name: "vtp", file: "t.vtp", seeds: vtp_trees, parse: reads_tree },
    Parser { name: "tree_json", file: "t.json", seeds: json_trees, parse: reads_tree },
    Parser { name: "manifest", file: "dataset.json", seeds: || vec![manifest(&NATIVE)], parse: |p| opens(&NATIVE, p) },
    Parser {
        name: "nerfca_geometry",
        file: "general.json",
        seeds: || vec![manifest(&GEOMETRY)],
        parse: |p| opens(&GEOMETRY, p),
    },
    Parser {
        name: "nerfca_frames",
        file: "train-0.json",
        seeds: || vec![manifest(&FRAMES)],
        parse: |p| opens(&FRAMES, p),
    },
    Parser { name: "checkpoint", file: "c.safetensors", seeds: checkpoints, parse: |p| Checkpoint::read(p).is_ok() },
    Parser {
        name: "dicom",
        file: "a.dcm",
        seeds: angiograms,
        parse: |p| nertca_vk_import::dicom::Run::read(p, None).is_ok(),
    },
];

pub fn scratch() -> tempfile::TempDir {
    // A memory file system is faster than a disk for a million small files.
    tempfile::tempdir_in("/dev/shm").or_else(|_| tempfile::tempdir()).unwrap()
}

/// Returns the bytes of a file that `write` makes.
fn written(file: &str, write: impl FnOnce(&Path)) -> Vec<u8> {
    let directory = scratch();
    let path = directory.path().join(file);
    write(&path);
    std::fs::read(path).unwrap()
}

/// A header followed by 60 values.
fn volume_file(header: &[u8]) -> Vec<u8> {
    let values = (0..60u16).flat_map(|i| f32::from(i).to_le_bytes());
    header.iter().copied().chain(values).collect()
}

fn halves() -> Volume {
    Volume::centred([3, 4, 5], 1.0, DVec3::ZERO, vec![0.5; 60])
}

fn reads_volume(path: &Path) -> bool {
    let hints = VolumeHints { spacing_mm: Some([1.0; 3]), ..VolumeHints::default() };
    volume_files::read(path, &hints).is_ok()
}

fn reads_image(path: &Path) -> bool {
    images::read_image(path).is_ok()
}

fn nrrd_files() -> Vec<Vec<u8>> {
    let plain = "NRRD0004\ntype: float\ndimension: 3\nspace: left-posterior-superior\nsizes: 3 4 5\n\
                 space directions: (1,0,0) (0,2,0) (0,0,3)\nendian: little\nencoding: raw\nspace origin: (1,2,3)\n\n";
    vec![volume_file(plain.as_bytes()), written("z.nrrd", |p| nrrd::write(p, &halves(), "halves").unwrap())]
}

/// Header of 3 x 4 x 5 values, as exports write it.
fn exported() -> VolumeHeader {
    VolumeHeader {
        origin_mm: DVec3::new(1.0, 2.0, 3.0),
        spacing_mm: DVec3::new(1.0, 2.0, 3.0),
        size: [3, 4, 5],
        phases: None,
        quantity: "attenuation".into(),
    }
}

fn metaimage_files() -> Vec<Vec<u8>> {
    let header = "ObjectType = Image\nNDims = 3\nBinaryData = True\nBinaryDataByteOrderMSB = False\n\
                  TransformMatrix = 1 0 0 0 1 0 0 0 1\nOffset = 0 0 0\nElementSpacing = 1 1 2\nDimSize = 3 4 5\n\
                  ElementType = MET_FLOAT\nElementDataFile = LOCAL\n";
    vec![volume_file(header.as_bytes()), volume_file(&metaimage::header_of(&exported()))]
}

fn nifti_files() -> Vec<Vec<u8>> {
    vec![volume_file(&nifti::header_of(&exported()))]
}

fn npy_volumes() -> Vec<Vec<u8>> {
    vec![written("c.npy", |p| npy::write(p, &[3, 4, 5], &[0.5; 60]).unwrap())]
}

fn npy_images() -> Vec<Vec<u8>> {
    vec![written("s.npy", |p| npy::write(p, &[6, 10], &[0.5; 60]).unwrap())]
}

fn png_images() -> Vec<Vec<u8>> {
    let codes8: Vec<u8> = (0..60).collect();
    let codes16: Vec<u16> = (0..60).map(|i| 1000 * i).collect();
    vec![png::grey8(10, 6, &codes8).unwrap(), written("i.png", |p| png::write_grey16(p, 10, 6, codes16).unwrap())]
}

fn reads_frames(path: &Path) -> bool {
    nertca_vk::formats::frames::read(path).is_ok()
}

/// A file of two pages of 2 x 2 pixels: a header, their values, and a directory for each page.
fn tiff_frames() -> Vec<Vec<u8>> {
    const PIXELS_AT: [u32; 2] = [8, 12];
    // Width, height, bits, no compression, white is the largest value, place of the values, rows, bytes.
    let entries = |at| [(256, 2), (257, 2), (258, 8), (259, 1), (262, 1), (273, at), (278, 2), (279, 4)];
    let mut file = b"II*\0".to_vec();
    file.extend(16u32.to_le_bytes());
    file.extend([10, 200, 30, 40, 50, 60, 70, 80]);
    for (page, at) in PIXELS_AT.into_iter().enumerate() {
        let entries = entries(at);
        file.extend((entries.len() as u16).to_le_bytes());
        for (tag, value) in entries {
            let (tag, long, one): (u16, u16, u32) = (tag, 4, 1);
            file.extend(tag.to_le_bytes().into_iter().chain(long.to_le_bytes()));
            file.extend(one.to_le_bytes().into_iter().chain(value.to_le_bytes()));
        }
        let next = if page == 0 { file.len() as u32 + 4 } else { 0 };
        file.extend(next.to_le_bytes());
    }
    vec![file]
}

const VIEWS: &str = "still = false\n[all]\nsid_mm = 1050\nsod_mm = 750\npixel_mm = 0.3\nfps = 15\n[[view]]\npath = \"lao\"\n\
    angles_deg = [-30, 20]\nheart_rate_per_min = 72\n[[view]]\npath = \"rao\"\nangles_deg = [40.5, -1e1]\nsid_mm = 1100\n\
    offset_mm = [3, -1]\nr_peaks_s = [0.05, 0.88, 1.71]\n";

fn reads_tree(path: &Path) -> bool {
    // Its shapes are made as well, since they index its points.
    TreeFile::read(path).is_ok_and(|tree| !tree.at(0.3).branches.is_empty())
}

fn vtp_trees() -> Vec<Vec<u8>> {
    let lines = Lines {
        title: "two lines".into(),
        time: 0.0,
        points: (0..5).map(|i| [f64::from(i), 2.0, -3.0]).collect(),
        counts: vec![3, 2],
        of_points: vec![Values::Float("Radius", vec![1.0, 0.9, 0.8, 0.7, 0.6])],
        of_lines: vec![Values::Int("branch", vec![0, 1])],
    };
    vec![lines.to_vtp().into_bytes()]
}

fn json_trees() -> Vec<Vec<u8>> {
    let tree = r#"{"branches":[{"name":"a","first":0,"count":3},{"name":"b","first":3,"count":2}],"radius_mm":[2,1.5,1,1,0.5],
        "points_mm":[[[0,0,0],[5,0,1],[10,0,2],[5,0,1],[5,8,1]],[[0,1,0],[5,1,1],[10,1,2],[5,1,1],[5,9,1]]]}"#;
    vec![tree.as_bytes().to_vec()]
}

/// A dataset in which one file is replaced by the file that is parsed.
struct Around {
    layout: Layout,
    file: &'static str,
    made: OnceLock<(tempfile::TempDir, PathBuf)>,
}

static NATIVE: Around = Around { layout: Layout::Native, file: "dataset.json", made: OnceLock::new() };
static GEOMETRY: Around = Around { layout: Layout::Nerfca, file: "general.json", made: OnceLock::new() };
static FRAMES: Around = Around { layout: Layout::Nerfca, file: "train-0.json", made: OnceLock::new() };

impl Around {
    fn dataset(&self) -> &Path {
        &self
            .made
            .get_or_init(|| {
                let directory = scratch();
                let out = directory.path().join("data");
                nertca_vk::scan::writer::convert(&common::small_dataset(8, 8), self.layout, &out).unwrap();
                (directory, out)
            })
            .1
    }
}

fn manifest(around: &Around) -> Vec<u8> {
    std::fs::read(around.dataset().join(around.file)).unwrap()
}

fn opens(around: &Around, path: &Path) -> bool {
    // The timer of the fuzzer interrupts a copy in the kernel; reading and writing go on after a signal.
    std::fs::write(around.dataset().join(around.file), std::fs::read(path).unwrap()).unwrap();
    Dataset::open(around.dataset()).is_ok()
}

fn checkpoints() -> Vec<Vec<u8>> {
    let data = common::small_dataset(8, 8);
    let config = common::small_config(
        "fast-mlp",
        &["static.grid=3", "dynamic.width=16", "dynamic.layers=2", "occupancy.enabled=false"],
    );
    let gpu = Gpu::open(&DeviceOptions::default()).unwrap();
    let plan = Plan::new(&config, &data).unwrap();
    vec![Trainer::new(&gpu, plan, &data, common::tuning(&gpu)).unwrap().checkpoint().unwrap().to_bytes().unwrap()]
}

fn angiograms() -> Vec<Vec<u8>> {
    let directory = scratch();
    let plain = written("a.dcm", |p| crate::dicom::angiogram(p, |_| ()));
    [plain].into_iter().chain(crate::dicom::compressed(directory.path())).collect()
}
