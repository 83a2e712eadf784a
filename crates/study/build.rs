//! Tells the crate the commit that it is built from.

use std::path::Path;

fn main() {
    println!("cargo:rerun-if-changed=build.rs");
    println!("cargo:rustc-env=NERTCA_COMMIT={}", commit());
}

/// Commit of the checkout, for reports and results; "unknown" outside one.
fn commit() -> String {
    // This file changes with every commit and checkout, but not with edits: a build of edited sources names the commit they are
    // based on.
    if let Some(log) = git(&["rev-parse", "--git-path", "logs/HEAD"]).filter(|log| Path::new(log).exists()) {
        println!("cargo:rerun-if-changed={log}");
    }
    git(&["describe", "--always", "--dirty"]).unwrap_or_else(|| "unknown".to_owned())
}

/// Returns the output of a git command; none when it fails or git is missing.
fn git(args: &[&str]) -> Option<String> {
    let output = std::process::Command::new("git").args(args).output().ok().filter(|output| output.status.success())?;
    Some(String::from_utf8_lossy(&output.stdout).trim().to_owned())
}
