//! Push constants of each shader, made by build.rs; stages take those of their own shader only.

use crate::kernels::dispatch::Binding;

/// Push constants that know their shader.
pub trait PushConstants: bytemuck::Pod {
    /// Name of the shader.
    const SHADER: &'static str;
    /// What the shader binds.
    const BINDINGS: &'static [Binding];
    /// Invocations of a workgroup, unless a stage is built with another number.
    const LOCAL_SIZE: u32;
}

include!(concat!(env!("OUT_DIR"), "/push.rs"));
