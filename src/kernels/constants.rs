//! Numbers that the shaders fix, made by build.rs: constants of `glsl/inc`, and, in a module for each kernel, what its
//! text or `glsl/variants.txt` defines.

include!(concat!(env!("OUT_DIR"), "/constants_layout.rs"));
include!(concat!(env!("OUT_DIR"), "/constants_lineformer_layout.rs"));
include!(concat!(env!("OUT_DIR"), "/constants_occupancy.rs"));
include!(concat!(env!("OUT_DIR"), "/constants_positions.rs"));
include!(concat!(env!("OUT_DIR"), "/constants_sample_rays.rs"));
include!(concat!(env!("OUT_DIR"), "/numbers.rs"));
