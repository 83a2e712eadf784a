//! The Python the tests use: the environment `tools/setup` makes, never whatever `python3` is first on the PATH.

use std::path::Path;
use std::process::Command;

/// Python with the packages of `tests/python/requirements.txt`. A missing environment fails the test: it is never skipped.
pub fn python() -> Command {
    let python = Path::new(env!("CARGO_MANIFEST_DIR")).join(".cache/python/bin/python3");
    assert!(python.is_file(), "{} is missing: NERTCA_SETUP_TESTS=1 tools/setup makes it", python.display());
    let mut command = Command::new(python);
    // Scripts that use each other leave nothing beside them.
    command.env("PYTHONDONTWRITEBYTECODE", "1");
    command
}
