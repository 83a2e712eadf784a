//! Dispatches whose buffers are found by the names the shaders give them.

use crate::error::{Error, Result};
use crate::gpu::memory::Buffer;
use crate::gpu::pipeline::{BindingKind, Pipeline};
use crate::gpu::record::{Bound, Groups, Recording};
use crate::gpu::volume::Volume;
use bytemuck::Pod;
use std::collections::HashMap;
use std::sync::Arc;

/// Buffers under the names the shaders use.
#[derive(Clone, Default)]
pub struct Buffers {
    by_name: HashMap<&'static str, Buffer>,
    volumes: HashMap<&'static str, Volume>,
}

impl Buffers {
    /// Adds or replaces a buffer.
    pub fn set(&mut self, name: &'static str, buffer: Buffer) {
        self.by_name.insert(name, buffer);
    }

    /// Adds or replaces a volume.
    pub fn set_volume(&mut self, name: &'static str, volume: Volume) {
        self.volumes.insert(name, volume);
    }

    fn volume(&self, name: &str) -> Result<&Volume> {
        self.volumes.get(name).ok_or_else(|| Error::Internal(format!("no volume is called `{name}`")))
    }

    /// A buffer by name.
    ///
    /// # Errors
    /// [`Error::Internal`] when it was never set.
    pub fn get(&self, name: &str) -> Result<&Buffer> {
        self.by_name.get(name).ok_or_else(|| Error::Internal(format!("no buffer is called `{name}`")))
    }
}

/// Records `stage`, binding each buffer its shader names from `buffers`; `renamed` takes precedence.
///
/// # Errors
/// Errors of [`Recording::dispatch`].
pub fn dispatch<P: Pod>(
    recording: &mut Recording,
    stage: &Arc<Pipeline>,
    groups: Groups<'_>,
    buffers: &Buffers,
    renamed: &[(&str, &str)],
    push: P,
) -> Result<()> {
    let bound = stage
        .bindings()
        .iter()
        .map(|b| {
            let source = renamed.iter().find(|(shader, _)| *shader == b.name).map_or(b.name, |(_, name)| name);
            Ok((
                b.name,
                match b.kind {
                    BindingKind::Volume => Bound::Volume(buffers.volume(source)?),
                    _ => Bound::Buffer(buffers.get(source)?),
                },
            ))
        })
        .collect::<Result<Vec<_>>>()?;
    recording.dispatch(stage, groups, &bound, &push)
}

/// `n` invocations in workgroups of `pipeline`'s size.
pub fn groups_for(pipeline: &Pipeline, n: u32) -> Groups<'static> {
    Groups::Direct([n.div_ceil(pipeline.local_size).max(1), 1, 1])
}
