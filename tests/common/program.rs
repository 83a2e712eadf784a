//! The program as users run it, but for its cache: pipelines and timings kept there by others must not decide what a test
//! sees, and tests must not decide what a user's next run does.
#![allow(missing_docs, clippy::unwrap_used, clippy::expect_used, reason = "shared by tests")]

use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::OnceLock;

/// A cache directory that is empty when the first test of this process asks for it.
fn cache() -> &'static Path {
    static CACHE: OnceLock<PathBuf> = OnceLock::new();
    CACHE.get_or_init(|| {
        let cache = Path::new(env!("CARGO_TARGET_TMPDIR")).join(concat!("cache-of-", env!("CARGO_CRATE_NAME")));
        if cache.exists() {
            std::fs::remove_dir_all(&cache).unwrap();
        }
        std::fs::create_dir_all(&cache).unwrap();
        cache
    })
}

/// The program, to be given arguments.
pub fn program() -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_nertca-vk"));
    command.env("XDG_CACHE_HOME", cache());
    command
}
