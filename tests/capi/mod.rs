//! Helpers shared by the tests of the C ABI: the library's location, and compilation of programs against it.
#![allow(dead_code, missing_docs, clippy::unwrap_used, clippy::expect_used, reason = "each test file uses its part")]

use std::path::{Path, PathBuf};
use std::process::Command;

/// Root of the project, which may be above the crate of the test.
pub fn root() -> PathBuf {
    let root =
        Path::new(env!("CARGO_MANIFEST_DIR")).ancestors().find(|folder| folder.join("include/nertca_vk.h").is_file());
    root.unwrap().to_path_buf()
}

/// The shared library, which is built along with the tests of its crate.
pub fn library() -> PathBuf {
    let deps = std::env::current_exe().unwrap().parent().unwrap().to_path_buf();
    let library = deps.join("libnertca_vk.so");
    assert!(library.is_file(), "{} was not built", library.display());
    library
}

/// A directory in which the library has the name of its soname.
pub fn library_directory(scratch: &Path) -> PathBuf {
    let directory = scratch.join("lib");
    std::fs::create_dir_all(&directory).unwrap();
    for name in
        ["libnertca_vk.so".to_owned(), format!("libnertca_vk.so.{}", nertca_vk::capi::types::NERTCA_ABI_VERSION)]
    {
        let link = directory.join(name);
        if !link.exists() {
            std::os::unix::fs::symlink(library(), link).unwrap();
        }
    }
    directory
}

/// Builds a program against the header and the library.
pub fn compile(compiler: &str, flags: &[&str], source: &Path, scratch: &Path) -> PathBuf {
    let libraries = library_directory(scratch);
    let binary = scratch.join(format!("{}-{compiler}", source.file_stem().unwrap().to_str().unwrap()));
    let outcome = Command::new(compiler)
        .args(["-O1", "-g", "-Wall", "-Wextra", "-Wpedantic", "-Werror", "-pthread"])
        .args(flags)
        .arg("-I")
        .arg(root().join("include"))
        .arg(source)
        .arg("-o")
        .arg(&binary)
        .arg("-L")
        .arg(&libraries)
        .arg(format!("-Wl,-rpath,{}", libraries.display()))
        .args(["-lnertca_vk", "-lm"])
        .output()
        .unwrap_or_else(|e| panic!("{compiler} is needed for the tests of the C ABI: {e}"));
    assert!(outcome.status.success(), "{compiler} {}: {}", source.display(), String::from_utf8_lossy(&outcome.stderr));
    binary
}

pub mod scene;
