//! The C library. Its functions are those of [`nertca_vk_abi`], where each is documented; `include/nertca_vk.h` is generated from
//! there. This crate makes the shared and the static library of them, so that neither the program nor the tests build and link these
//! large files.

pub use nertca_vk_abi::*;
