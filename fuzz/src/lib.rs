//! Fuzzing of all parsers of foreign files: each input is written to a file in memory and parsed. A panic or an allocation beyond
//! [`parsers::MAX_ALLOCATION_BYTES`] is a fault.
#![allow(missing_docs, clippy::unwrap_used, clippy::expect_used, reason = "a test")]

#[path = "../../tests/common/mod.rs"]
mod common;
#[path = "../../tests/common/dicom.rs"]
mod dicom;
#[path = "../../tests/common/parsers.rs"]
pub mod parsers;

use parsers::{MAX_ALLOCATION_BYTES, PARSERS, Parser};
use std::alloc::{GlobalAlloc, Layout, System};
use std::path::Path;
use std::sync::OnceLock;

/// Allocator that refuses an allocation beyond the bound, which ends the process with a message.
struct Bounded;

// SAFETY: hands on to the system's allocator, or fails as an allocator may.
unsafe impl GlobalAlloc for Bounded {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        if layout.size() > MAX_ALLOCATION_BYTES {
            return std::ptr::null_mut();
        }
        // SAFETY: as the caller vouches.
        unsafe { System.alloc(layout) }
    }

    unsafe fn dealloc(&self, at: *mut u8, layout: Layout) {
        // SAFETY: as the caller vouches.
        unsafe { System.dealloc(at, layout) }
    }
}

#[global_allocator]
static ALLOCATOR: Bounded = Bounded;

/// Parsers of studies, which the library does not contain.
const STUDIES: [Parser; 1] = [Parser {
    name: "study",
    file: "study.toml",
    seeds: || {
        vec![include_bytes!("../../studies/smoke.toml").to_vec(), include_bytes!("../../studies/table1.toml").to_vec()]
    },
    parse: |path| nertca_vk_study::file::read(path, Some(Path::new("../studies"))).is_ok(),
}];

/// Parser of this process, with the file that it parses.
struct Target {
    parser: &'static Parser,
    directory: tempfile::TempDir,
}

static TARGET: OnceLock<Target> = OnceLock::new();

/// Chooses the parser of a name, and writes the files that it reads, made by the project's own writers, to `corpus/NAME`.
pub fn begin(name: &str) {
    let parser = PARSERS.iter().chain(&STUDIES).find(|parser| parser.name == name).unwrap();
    let corpus = Path::new("corpus").join(name);
    std::fs::create_dir_all(&corpus).unwrap();
    for (index, seed) in (parser.seeds)().into_iter().enumerate() {
        std::fs::write(corpus.join(format!("seed-{index}")), seed).unwrap();
    }
    let directory = parsers::scratch();
    assert!(TARGET.set(Target { parser, directory }).is_ok());
}

/// Parses one input.
pub fn feed(bytes: &[u8]) {
    let Target { parser, directory } = TARGET.get().unwrap();
    let path = directory.path().join(parser.file);
    std::fs::write(&path, bytes).unwrap();
    (parser.parse)(&path);
}
