//! The functions of the C interface, called from Rust.
#![allow(missing_docs, clippy::unwrap_used, clippy::expect_used, reason = "tests")]

#[path = "../common/c_scene.rs"]
mod c_scene;
#[path = "../common/root.rs"]
mod root;

mod adoption;
mod frames;
mod life;
mod misuse;
mod random;
