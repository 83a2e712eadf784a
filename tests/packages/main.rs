//! Wheel and archive, studies under Snakemake, and kernels as compilers of absent GPUs make them. All are ignored unless asked for.
#![allow(missing_docs, clippy::unwrap_used, clippy::expect_used, reason = "tests")]

#[path = "../common/program.rs"]
mod program;
#[path = "../common/python.rs"]
mod python;
#[path = "../common/root.rs"]
mod root;

mod null_gpus;
mod package;
#[cfg(unix)]
mod snakemake;
mod wheel;
