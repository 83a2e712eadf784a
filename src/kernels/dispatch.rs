//! Dispatches whose buffers are found by their names in the shaders.

use crate::error::{Error, Result};
use crate::gpu::buffer::Buffer;
use crate::gpu::record::{Bound, Groups, Recording};
use crate::kernels::push::PushConstants;
use crate::kernels::stages::Stage;

include!(concat!(env!("OUT_DIR"), "/bindings.rs"));

/// Buffers that shaders find by name.
pub trait BufferSet {
    /// Returns the buffer of that name, if the set has it.
    fn find(&self, name: Binding) -> Option<&Buffer>;
}

/// Declares a struct of buffers; shaders find each buffer by its field's name.
macro_rules! buffer_set {
    ($(#[$about:meta])* $visibility:vis struct $name:ident { $($(#[$doc:meta])* $field:ident,)* }) => {
        $(#[$about])*
        #[derive(Clone)]
        $visibility struct $name { $($(#[$doc])* pub $field: $crate::gpu::buffer::Buffer,)* }

        impl $crate::kernels::dispatch::BufferSet for $name {
            fn find(&self, name: $crate::kernels::dispatch::Binding) -> Option<&$crate::gpu::buffer::Buffer> {
                match name {
                    $($crate::kernels::dispatch::Binding::$field => Some(&self.$field),)*
                    _ => None,
                }
            }
        }
    };
}
pub(crate) use buffer_set;

/// Records `stage`; `bound` must provide everything that its shader binds.
///
/// # Errors
/// [`Error::Internal`] naming what is not bound; errors of [`Recording::dispatch`].
pub fn dispatch<P: PushConstants>(
    recording: &mut Recording,
    stage: &Stage<P>,
    groups: Groups<'_>,
    bound: &[(Binding, Bound<'_>)],
    push: P,
) -> Result<()> {
    dispatch_finding(recording, stage, groups, bound, |_| None, push)
}

/// Records `stage` like [`dispatch`]; buffers that are not in `bound` are looked up with `find`.
///
/// # Errors
/// Fails like [`dispatch`].
pub fn dispatch_finding<'a, P: PushConstants>(
    recording: &mut Recording,
    stage: &Stage<P>,
    groups: Groups<'_>,
    bound: &[(Binding, Bound<'a>)],
    find: impl Fn(Binding) -> Option<&'a Buffer>,
    push: P,
) -> Result<()> {
    let source = |name: Binding| {
        let direct = bound.iter().find(|(n, _)| *n == name).map(|(_, what)| *what);
        let source = direct.or_else(|| find(name).map(Bound::Buffer));
        let source = source.ok_or_else(|| {
            Error::Internal(format!("kernel {}: there is no buffer to bind to `{}`", P::SHADER, name.name()))
        })?;
        Ok((name.name(), source))
    };
    let bound = P::BINDINGS.iter().map(|name| source(*name)).collect::<Result<Vec<_>>>()?;
    Ok(recording.dispatch(stage.pipeline(), groups, &bound, &push)?)
}
