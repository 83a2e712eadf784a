//! Python for the tests: the environment made by `tools/setup`, never the first `python3` on the PATH.

use std::process::Command;

/// Command of Python with the packages of `tests/python/requirements.txt`. A missing environment fails the test, which is
/// never skipped.
pub fn python() -> Command {
    let python = crate::root::root().join(".cache/python/bin/python3");
    assert!(python.is_file(), "{} is missing: NERTCA_SETUP_TESTS=1 tools/setup makes it", python.display());
    let mut command = Command::new(python);
    // Scripts that import each other leave no cache files.
    command.env("PYTHONDONTWRITEBYTECODE", "1");
    command
}
