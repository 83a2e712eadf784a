//! The program run to its end, and what it says.
#![allow(missing_docs, clippy::unwrap_used, clippy::expect_used, reason = "shared by tests")]

use crate::program::program;
use std::path::Path;

pub fn text(path: &Path) -> &str {
    path.to_str().unwrap()
}

/// What the program says on stderr, once it has succeeded or failed as it should.
#[track_caller]
pub fn run(args: &[&str], succeeds: bool) -> String {
    let out = program().args(args).output().unwrap();
    let said = String::from_utf8(out.stderr).unwrap();
    assert_eq!(out.status.success(), succeeds, "{args:?}: {said}");
    said
}
