//! The root of the project, which is above the crate of some tests.

use std::path::{Path, PathBuf};

/// Returns the directory of the workspace.
pub fn root() -> PathBuf {
    let of_crate = Path::new(env!("CARGO_MANIFEST_DIR"));
    let root = of_crate.ancestors().find(|folder| folder.join("Cargo.lock").is_file());
    root.unwrap_or(of_crate).to_path_buf()
}
