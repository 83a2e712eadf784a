//! Sets the linker options of the shared library.

use std::{env, fs};

/// Source of the number of the ABI, from the folder of this crate.
const TYPES: &str = "../src/types.rs";

/// The soname carries the ABI version, and the library is never unmapped, because its own threads and those of drivers it loaded may
/// outlive a `dlclose`.
fn main() -> Result<(), Box<dyn std::error::Error>> {
    println!("cargo:rerun-if-changed={TYPES}");
    println!("cargo:rerun-if-changed=build.rs");
    if env::var("CARGO_CFG_TARGET_OS")? != "linux" {
        return Ok(());
    }
    println!("cargo:rustc-cdylib-link-arg=-Wl,-z,nodelete");
    // cargo-c sets a soname of its own.
    if env::var_os("CARGO_FEATURE_CAPI").is_none() {
        let source = fs::read_to_string(TYPES)?;
        let version = source.split("NERTCA_ABI_VERSION: u32 = ").nth(1).and_then(|rest| rest.split(';').next());
        let version = version.ok_or("crates/capi/src/types.rs has no NERTCA_ABI_VERSION")?;
        println!("cargo:rustc-cdylib-link-arg=-Wl,-soname,libnertca_vk.so.{version}");
    }
    Ok(())
}
