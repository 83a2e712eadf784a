//! C, C++ and Python programs that use the C library, and its header.
#![allow(missing_docs, clippy::unwrap_used, clippy::expect_used, reason = "tests")]

#[path = "../common/c_library.rs"]
mod c_library;
#[path = "../common/python.rs"]
mod python;
#[path = "../common/root.rs"]
mod root;

mod examples;
mod header;
