//! Data that are stored beside the project and are not part of it.
#![allow(dead_code, reason = "each test file uses its part")]

use std::path::PathBuf;

/// A folder of the shared data (`NERTCA_DATA`, or `../shared/data` beside the project). If it is absent the test reports
/// that it is skipped, or fails with `NERTCA_SHARED=require`.
pub fn shared(folder: &str) -> Option<PathBuf> {
    let beside = crate::root::root().join("../shared/data");
    let path = std::env::var_os("NERTCA_DATA").map_or(beside, PathBuf::from).join(folder);
    if path.is_dir() {
        return Some(path);
    }
    let required = std::env::var_os("NERTCA_SHARED").is_some_and(|v| v == "require");
    assert!(!required, "{} is absent, and NERTCA_SHARED=require asks for it", path.display());
    eprintln!("SKIPPED: {} is absent", path.display());
    None
}
