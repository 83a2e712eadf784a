//! Helpers shared by the tests of the C ABI: the library's location, and compilation of programs against it.
#![allow(dead_code, missing_docs, clippy::unwrap_used, clippy::expect_used, reason = "each test file uses its part")]

use crate::root::root;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::OnceLock;

/// Returns the path of the shared library of this build, up to date with its sources.
///
/// `cargo test` does not build a library that tests cannot link as Rust code, so this function builds it. `--test` makes
/// cargo choose the features of dependencies as it did for this test, so that only the shared library itself is made.
pub fn library() -> PathBuf {
    static LIBRARY: OnceLock<PathBuf> = OnceLock::new();
    LIBRARY.get_or_init(build_library).clone()
}

fn build_library() -> PathBuf {
    let test = std::env::current_exe().unwrap();
    let profile = test.parent().and_then(Path::parent).unwrap();
    let mut cargo = Command::new(std::env::var_os("CARGO").unwrap_or_else(|| "cargo".into()));
    cargo.args(["build", "--locked", "--quiet", "--lib", "--test", "c_programs"]).current_dir(root());
    cargo.arg("--target-dir").arg(profile.parent().unwrap());
    if !cfg!(debug_assertions) {
        cargo.arg("--release");
    }
    let outcome = cargo.output().unwrap_or_else(|e| panic!("cargo is needed to build the C library: {e}"));
    assert!(outcome.status.success(), "{cargo:?}: {}", String::from_utf8_lossy(&outcome.stderr));
    let library = profile.join("libnertca_vk.so");
    assert!(library.is_file(), "{} was not built", library.display());
    library
}

/// A directory in which the library has the name of its soname.
pub fn library_directory(scratch: &Path) -> PathBuf {
    let directory = scratch.join("lib");
    std::fs::create_dir_all(&directory).unwrap();
    for name in ["libnertca_vk.so".to_owned(), format!("libnertca_vk.so.{}", nertca_vk_abi::types::NERTCA_ABI_VERSION)]
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
