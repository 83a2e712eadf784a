//! A complete run of the program, and its messages.
#![allow(missing_docs, clippy::unwrap_used, clippy::expect_used, reason = "shared by tests")]

use crate::program::program;
use std::path::Path;

pub fn text(path: &Path) -> &str {
    path.to_str().unwrap()
}

/// Messages of the program on stderr, after it has succeeded or failed as expected.
#[track_caller]
pub fn run(args: &[&str], succeeds: bool) -> String {
    let out = program().args(args).output().unwrap();
    let said = String::from_utf8(out.stderr).unwrap();
    assert_eq!(out.status.success(), succeeds, "{args:?}: {said}");
    said
}
