//! The program as users run it, except for its cache: pipelines and timings cached by others must not affect a test, and
//! tests must not affect a user's next run.
#![allow(missing_docs, clippy::unwrap_used, clippy::expect_used, reason = "shared by tests")]

use nertca_vk::config::{Config, Preset};
use nertca_vk_twins::selftest::problems::with_values;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::OnceLock;

/// A cache directory that is empty at its first use by a test of this process.
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

/// Writes a whole configuration, which may have other constants than the program, for `--config`.
#[allow(dead_code, reason = "not every test changes constants")]
pub fn whole_config(directory: &Path, preset: Preset, constants: &[&str]) -> PathBuf {
    let config = with_values(&Config::preset(preset), constants.iter().copied()).unwrap();
    let path = directory.join("whole-config.toml");
    std::fs::write(&path, config.to_toml().unwrap()).unwrap();
    path
}

/// Command of the program, without arguments.
pub fn program() -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_nertca-vk"));
    command.env("XDG_CACHE_HOME", cache());
    command
}
