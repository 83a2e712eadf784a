//! The engine behind a Vulkan loader that makes calls fail, hides features, or replaces shader code.
#![allow(missing_docs, clippy::unwrap_used, clippy::expect_used, reason = "tests")]

#[path = "../common/mod.rs"]
mod common;
#[path = "../common/faults.rs"]
mod faults;
#[path = "../shim/mod.rs"]
mod shim;

mod canaries;
mod gpu_failures;
mod idle_devices;
mod int64_atomics;
mod matrices;
mod poor_devices;
mod selftest;
