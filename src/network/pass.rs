//! State that the stages of one recording share.

use crate::error::Result;
use crate::gpu::buffer::Buffer;
use crate::gpu::record::{Bound, Groups, Recording};
use crate::kernels::dispatch::{Binding, BufferSet, dispatch_finding};
use crate::kernels::layout::Setup;
use crate::kernels::push::PushConstants;
use crate::kernels::stages::{Kernels, Stage};
use crate::model::params::ParamMap;
use crate::network::Network;
use crate::network::forward::ForwardBuffers;
use crate::network::static_network::StaticNetwork;

/// Recording of stages, with all that they work with.
pub struct Pass<'a> {
    /// Recording that stages are added to.
    pub recording: &'a mut Recording,
    /// Pipelines of every path.
    pub kernels: &'a Kernels,
    /// The dynamic field's network; `None` where Gaussians are the dynamic field, or none is drawn.
    pub network: Option<&'a Network>,
    /// Static field, where it is a network as well.
    pub static_network: Option<&'a StaticNetwork>,
    /// Buffers of the forward pass.
    pub buffers: &'a ForwardBuffers,
    /// Further buffers for training.
    pub training: Option<&'a dyn BufferSet>,
    /// Positions of the parameters.
    pub params: &'a ParamMap,
    /// Constants of the run; `buffers` holds a copy.
    pub setup: &'a Setup,
}

impl<'a> Pass<'a> {
    /// Records a stage on the buffers that have the names used in its shader.
    ///
    /// # Errors
    /// [`crate::error::Error::Internal`] when a stage and its buffers do not fit.
    pub fn run<P: PushConstants>(&mut self, stage: &Stage<P>, groups: Groups<'_>, push: P) -> Result<()> {
        self.run_with(stage, groups, &[], push)
    }

    /// Records a stage like [`Pass::run`]; the buffers in `bound` take precedence.
    ///
    /// # Errors
    /// Fails like [`Pass::run`].
    pub fn run_with<P: PushConstants>(
        &mut self,
        stage: &Stage<P>,
        groups: Groups<'_>,
        bound: &[(Binding, Bound<'_>)],
        push: P,
    ) -> Result<()> {
        let (network, buffers, training) = (self.network, self.buffers, self.training);
        let find = |name: Binding| -> Option<&Buffer> {
            buffers.find(name).or_else(|| network?.find(name)).or_else(|| training?.find(name))
        };
        dispatch_finding(self.recording, stage, groups, bound, find, push)
    }
}
