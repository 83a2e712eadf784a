//! The C ABI: `include/nertca_vk.h` is generated from here. The crate in `library` makes the shared and the static library of it.
#![allow(non_camel_case_types, reason = "types have the names they have in C")]

pub mod boundary;
pub mod calibration;
mod callsites;
pub mod context;
pub mod handles;
pub mod log;
pub mod options;
pub mod output;
pub mod reconstruction;
pub mod semaphores;
mod shared_memory;
pub mod status;
pub mod training;
pub mod tree;
pub mod truth;
pub mod types;
