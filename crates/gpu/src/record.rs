//! Recordings of dispatches. The reads and writes of each dispatch follow from the shader's own qualifiers; barriers follow
//! from the reads and writes.

use super::buffer::Buffer;
use super::device::{Gpu, Shared};
use super::image::Image3d;
use super::lock::lock;
use super::pipeline::{BindingCode, BindingKind, Pipeline, descriptor_type};
use crate::error::{Error, Result};
use ash::vk;
use std::collections::HashSet;
use std::ffi::CString;
use std::sync::Arc;
use std::sync::atomic::Ordering;

/// Object that a dispatch binds.
#[derive(Clone, Copy)]
pub enum Bound<'a> {
    /// Buffer for a storage, uniform or texel binding.
    Buffer(&'a Buffer),
    /// Image for a 3D sampler.
    Image(&'a Image3d),
}

impl<'a> From<&'a Buffer> for Bound<'a> {
    fn from(buffer: &'a Buffer) -> Bound<'a> {
        Bound::Buffer(buffer)
    }
}

impl<'a> From<&'a Image3d> for Bound<'a> {
    fn from(volume: &'a Image3d) -> Bound<'a> {
        Bound::Image(volume)
    }
}

impl<'a> Bound<'a> {
    fn buffer(&self) -> Option<&'a Buffer> {
        match self {
            Bound::Buffer(buffer) => Some(buffer),
            Bound::Image(_) => None,
        }
    }
}

/// Number of workgroups along an axis that every device supports.
pub const MAX_GROUPS: u32 = 65_535;

/// Number of workgroups to run.
pub enum Groups<'a> {
    /// Number known at recording time.
    Direct([u32; 3]),
    /// Number that the device reads as three `u32` at a byte offset.
    Indirect(&'a Buffer, u64),
}

/// Device time of one pass.
#[derive(Debug, Clone, serde::Serialize)]
pub struct PassTime {
    /// Stage name.
    pub name: &'static str,
    /// Milliseconds.
    pub ms: f64,
}

/// Commands being recorded.
pub struct Recording {
    commands: Commands,
    read: HashSet<vk::Buffer>,
    written: HashSet<vk::Buffer>,
    timed: Option<u32>,
}

/// Finished commands; they may be submitted any number of times.
pub struct Commands {
    gpu: Arc<Shared>,
    name: String,
    pool: vk::CommandPool,
    raw: vk::CommandBuffer,
    descriptor_pools: Vec<vk::DescriptorPool>,
    queries: vk::QueryPool,
    passes: Vec<&'static str>,
    barriers: u32,
    buffers: Vec<Buffer>,
    images: Vec<Image3d>,
    pipelines: Vec<Arc<Pipeline>>,
    last_submit: std::sync::atomic::AtomicU64,
}

/// Object in a slot of a descriptor set.
enum Descriptor {
    Buffer(vk::DescriptorBufferInfo),
    Texel(vk::BufferView),
    Image(vk::DescriptorImageInfo),
}

impl Descriptor {
    fn of(pipeline: &Pipeline, binding: &BindingCode, what: &Bound<'_>) -> Result<Descriptor> {
        let name = match (binding.kind, what) {
            (BindingKind::Uniform, Bound::Buffer(b)) if b.bytes() > LARGEST_UNIFORM => b.name(),
            (BindingKind::Storage | BindingKind::Uniform, Bound::Buffer(b)) => {
                let whole = vk::DescriptorBufferInfo::default().buffer(b.raw()).range(vk::WHOLE_SIZE);
                return Ok(Descriptor::Buffer(whole));
            }
            (BindingKind::Texel, Bound::Buffer(b)) => match b.texel_view() {
                Some(view) => return Ok(Descriptor::Texel(view)),
                None => b.name(),
            },
            (BindingKind::Volume, Bound::Image(image)) => return Ok(Descriptor::Image(image.descriptor())),
            (_, Bound::Buffer(b)) => b.name(),
            (_, Bound::Image(_)) => "an image",
        };
        let (kernel, slot) = (pipeline.code.name, binding.name);
        Err(Error::Internal(format!("kernel {kernel}: `{name}` is bound to `{slot}`, but is not {:?}", binding.kind)))
    }

    fn write(&self, binding: &BindingCode, set: vk::DescriptorSet) -> vk::WriteDescriptorSet<'_> {
        let write = vk::WriteDescriptorSet::default()
            .dst_set(set)
            .dst_binding(binding.slot)
            .descriptor_type(descriptor_type(binding));
        match self {
            Descriptor::Buffer(info) => write.buffer_info(std::slice::from_ref(info)),
            Descriptor::Texel(view) => write.texel_buffer_view(std::slice::from_ref(view)),
            Descriptor::Image(info) => write.image_info(std::slice::from_ref(info)),
        }
    }
}

/// Largest uniform buffer that every device supports, bytes.
const LARGEST_UNIFORM: u64 = 16384;
const SETS_PER_POOL: u32 = 64;
const MAX_BINDINGS: u32 = 16;

impl Recording {
    /// Starts recording on `gpu`.
    ///
    /// # Errors
    /// [`Error::Vulkan`] or [`Error::OutOfMemory`].
    pub fn new(gpu: &Gpu, name: &str) -> Result<Recording> {
        Self::start(gpu, name, None)
    }

    /// Starts a recording like [`Recording::new`], with a timestamp before and after each of at most `max_passes` dispatches.
    ///
    /// # Errors
    /// Fails like [`Recording::new`].
    pub fn timed(gpu: &Gpu, name: &str, max_passes: u32) -> Result<Recording> {
        Self::start(gpu, name, (gpu.info().timestamp_period_ns > 0.0).then_some(max_passes))
    }

    fn start(gpu: &Gpu, name: &str, timed: Option<u32>) -> Result<Recording> {
        let shared = &gpu.shared;
        shared.track();
        shared.calls.recordings.fetch_add(1, Ordering::Relaxed);
        // From here on `Commands::drop` cleans up.
        let mut commands = Commands {
            gpu: shared.clone(),
            name: name.to_owned(),
            pool: vk::CommandPool::null(),
            raw: vk::CommandBuffer::null(),
            descriptor_pools: Vec::new(),
            queries: vk::QueryPool::null(),
            passes: Vec::new(),
            barriers: 0,
            buffers: Vec::new(),
            images: Vec::new(),
            pipelines: Vec::new(),
            last_submit: std::sync::atomic::AtomicU64::new(0),
        };
        let device = &shared.device;
        let create = vk::CommandPoolCreateInfo::default().queue_family_index(shared.queue_family);
        // SAFETY: the create info lives until the call returns; the family is that of the device's queue.
        commands.pool =
            unsafe { device.create_command_pool(&create, None) }.map_err(Error::vulkan("vkCreateCommandPool", name))?;
        let allocate = vk::CommandBufferAllocateInfo::default().command_pool(commands.pool).command_buffer_count(1);
        // SAFETY: the pool was just made, and no other thread knows of it.
        commands.raw = unsafe { device.allocate_command_buffers(&allocate) }
            .map_err(Error::vulkan("vkAllocateCommandBuffers", name))?[0];
        shared.set_name(commands.raw, name);
        // Two submits of the same commands may be in flight.
        let begin = vk::CommandBufferBeginInfo::default().flags(vk::CommandBufferUsageFlags::SIMULTANEOUS_USE);
        // SAFETY: the command buffer was just allocated, so it is in the initial state.
        unsafe { device.begin_command_buffer(commands.raw, &begin) }
            .map_err(Error::vulkan("vkBeginCommandBuffer", name))?;
        if let Some(passes) = timed {
            let create =
                vk::QueryPoolCreateInfo::default().query_type(vk::QueryType::TIMESTAMP).query_count(2 * passes);
            // SAFETY: `Recording::timed` asks for timestamps only where the queue has them.
            commands.queries =
                unsafe { device.create_query_pool(&create, None) }.map_err(Error::vulkan("vkCreateQueryPool", name))?;
            // SAFETY: the command buffer was begun above; the pool was just made with this many queries.
            unsafe { device.cmd_reset_query_pool(commands.raw, commands.queries, 0, 2 * passes) };
        }
        let mut recording = Recording { commands, read: HashSet::new(), written: HashSet::new(), timed };
        // Earlier submits may have left writes that this one reads.
        recording.barrier();
        Ok(recording)
    }

    fn barrier(&mut self) {
        let access = vk::AccessFlags::SHADER_READ
            | vk::AccessFlags::UNIFORM_READ
            | vk::AccessFlags::SHADER_WRITE
            | vk::AccessFlags::TRANSFER_READ
            | vk::AccessFlags::TRANSFER_WRITE;
        let barrier = [vk::MemoryBarrier::default()
            .src_access_mask(vk::AccessFlags::SHADER_WRITE | vk::AccessFlags::TRANSFER_WRITE)
            .dst_access_mask(access | vk::AccessFlags::INDIRECT_COMMAND_READ)];
        let work = vk::PipelineStageFlags::COMPUTE_SHADER | vk::PipelineStageFlags::TRANSFER;
        // SAFETY: a `Recording` has begun its command buffer and not ended it; the barrier lives until the call returns.
        unsafe {
            self.commands.gpu.device.cmd_pipeline_barrier(
                self.commands.raw,
                work,
                work | vk::PipelineStageFlags::DRAW_INDIRECT,
                vk::DependencyFlags::empty(),
                &barrier,
                &[],
                &[],
            );
        }
        self.commands.barriers += 1;
        self.read.clear();
        self.written.clear();
    }

    /// Declares the accesses of the next command; inserts a barrier when it depends on an earlier one.
    fn depend(&mut self, reads: &[&Buffer], writes: &[&Buffer]) {
        let hazard = reads.iter().any(|b| self.written.contains(&b.raw()))
            || writes.iter().any(|b| self.written.contains(&b.raw()) || self.read.contains(&b.raw()));
        if hazard {
            self.barrier();
        }
        for buffer in reads {
            self.read.insert(buffer.raw());
            self.commands.buffers.push((*buffer).clone());
        }
        for buffer in writes {
            self.written.insert(buffer.raw());
            self.commands.buffers.push((*buffer).clone());
        }
    }

    /// Records one dispatch. `given` are bound by their names in the shader.
    ///
    /// # Errors
    /// [`Error::Internal`] when a name or a push-constant size does not fit the shader, or a group count the device.
    pub fn dispatch<P: bytemuck::Pod>(
        &mut self,
        pipeline: &Arc<Pipeline>,
        groups: Groups<'_>,
        given: &[(&str, Bound<'_>)],
        push: &P,
    ) -> Result<()> {
        let code = pipeline.code;
        let fault = |problem: String| Error::Internal(format!("kernel {}: {problem}", code.name));
        if size_of::<P>() as u32 != code.push_bytes {
            return Err(fault(format!(
                "{} bytes of push constants were given where {} are expected",
                size_of::<P>(),
                code.push_bytes
            )));
        }
        if let Some((name, _)) = given.iter().find(|(n, _)| !code.bindings.iter().any(|b| b.name == *n)) {
            return Err(fault(format!("it has no binding `{name}`")));
        }
        let mut bound = Vec::with_capacity(code.bindings.len());
        for binding in code.bindings {
            let (_, what) = given
                .iter()
                .find(|(n, _)| *n == binding.name)
                .ok_or_else(|| fault(format!("nothing is bound to `{}`", binding.name)))?;
            bound.push((binding, *what));
        }
        if let Groups::Direct([x, y, z]) = groups
            && (x > self.commands.gpu.info.max_workgroup_count || y.max(z) > MAX_GROUPS)
        {
            return Err(fault(format!(
                "{x} x {y} x {z} workgroups exceed the limits of {}",
                self.commands.gpu.info.name
            )));
        }
        let mut reads: Vec<&Buffer> = bound.iter().filter(|(b, _)| b.reads).filter_map(|(_, x)| x.buffer()).collect();
        let writes: Vec<&Buffer> = bound.iter().filter(|(b, _)| b.writes).filter_map(|(_, x)| x.buffer()).collect();
        if let Groups::Indirect(buffer, offset) = groups {
            buffer.check_range(offset, 12)?;
            reads.push(buffer);
        }
        self.depend(&reads, &writes);
        let set = self.descriptor_set(pipeline, &bound)?;
        let device = self.commands.gpu.device.clone();
        let raw = self.commands.raw;
        let mut pushed = vec![0u8; code.all_push_bytes() as usize];
        pushed[..size_of::<P>()].copy_from_slice(bytemuck::bytes_of(push));
        for (name, offset) in code.addresses {
            let buffer = bound
                .iter()
                .find(|(b, _)| b.name == *name)
                .and_then(|(_, what)| what.buffer())
                .ok_or_else(|| fault(format!("it needs the address of `{name}`, which is not bound")))?;
            pushed[*offset as usize..][..8].copy_from_slice(&buffer.address().to_le_bytes());
        }
        self.begin_pass(code.name)?;
        // SAFETY: the command buffer is being recorded; `commands` keeps buffers, images and the set's pool alive, and the
        // pipeline once it is pushed below; the push constants have the size of the layout's range.
        unsafe {
            device.cmd_bind_pipeline(raw, vk::PipelineBindPoint::COMPUTE, pipeline.raw);
            device.cmd_bind_descriptor_sets(raw, vk::PipelineBindPoint::COMPUTE, pipeline.layout, 0, &[set], &[]);
            if !pushed.is_empty() {
                device.cmd_push_constants(raw, pipeline.layout, vk::ShaderStageFlags::COMPUTE, 0, &pushed);
            }
            match groups {
                Groups::Direct([x, y, z]) => device.cmd_dispatch(raw, x, y, z),
                Groups::Indirect(buffer, offset) => device.cmd_dispatch_indirect(raw, buffer.raw(), offset),
            }
        }
        self.end_pass(code.name);
        self.commands.pipelines.push(pipeline.clone());
        lock(&self.commands.gpu.recorded).insert(code.shader);
        Ok(())
    }

    fn begin_pass(&mut self, name: &'static str) -> Result<()> {
        if let Some(debug) = &self.commands.gpu.device.debug_names {
            let label = CString::new(name).unwrap_or_default();
            let label = vk::DebugUtilsLabelEXT::default().label_name(&label);
            // SAFETY: the command buffer is being recorded; `label` and its text live until the call returns.
            unsafe { debug.cmd_begin_debug_utils_label(self.commands.raw, &label) };
        }
        if let Some(max) = self.timed {
            let pass = self.commands.passes.len() as u32;
            if pass >= max {
                return Err(Error::Internal(format!("{}: more than {max} timed passes", self.commands.name)));
            }
            // A barrier after each pass keeps passes from overlapping, so that each time belongs to one pass only.
            self.barrier();
            // SAFETY: the start of this recording reset all queries, of which there are two for each of `max` passes.
            unsafe {
                self.commands.gpu.device.cmd_write_timestamp(
                    self.commands.raw,
                    vk::PipelineStageFlags::COMPUTE_SHADER,
                    self.commands.queries,
                    2 * pass,
                );
            }
        }
        Ok(())
    }

    fn end_pass(&mut self, name: &'static str) {
        if self.timed.is_some() {
            let pass = self.commands.passes.len() as u32;
            // SAFETY: `begin_pass` checked that this pass has its two queries; this is the second.
            unsafe {
                self.commands.gpu.device.cmd_write_timestamp(
                    self.commands.raw,
                    vk::PipelineStageFlags::COMPUTE_SHADER,
                    self.commands.queries,
                    2 * pass + 1,
                );
            }
            self.commands.passes.push(name);
            self.barrier();
        }
        if let Some(debug) = &self.commands.gpu.device.debug_names {
            // SAFETY: the command buffer is being recorded, and `begin_pass` opened the label.
            unsafe { debug.cmd_end_debug_utils_label(self.commands.raw) };
        }
    }

    fn descriptor_set(
        &mut self,
        pipeline: &Pipeline,
        bound: &[(&BindingCode, Bound<'_>)],
    ) -> Result<vk::DescriptorSet> {
        let set = self.empty_set(pipeline)?;
        let mut descriptors = Vec::with_capacity(bound.len());
        for (binding, what) in bound {
            if let Bound::Image(image) = what {
                self.commands.images.push((*image).clone());
            }
            descriptors.push((*binding, Descriptor::of(pipeline, binding, what)?));
        }
        let writes: Vec<_> = descriptors.iter().map(|(binding, d)| d.write(binding, set)).collect();
        // SAFETY: the set was just allocated, so nothing uses it; `descriptors` lives until the call returns; each was
        // checked to be of the kind that the set's layout has in its slot.
        unsafe { self.commands.gpu.device.update_descriptor_sets(&writes, &[]) };
        Ok(set)
    }

    /// Allocates a set from the last pool, or from a new one when that is full.
    fn empty_set(&mut self, pipeline: &Pipeline) -> Result<vk::DescriptorSet> {
        let layouts = [pipeline.set_layout];
        let gpu = self.commands.gpu.clone();
        let from = |pool| {
            let allocate = vk::DescriptorSetAllocateInfo::default().descriptor_pool(pool).set_layouts(&layouts);
            // SAFETY: the pool belongs to this recording, which one thread at a time uses; the layout belongs to the pipeline.
            unsafe { gpu.device.allocate_descriptor_sets(&allocate) }.map(|sets| sets[0])
        };
        let failed = || Error::vulkan("vkAllocateDescriptorSets", pipeline.code.name);
        if let Some(pool) = self.commands.descriptor_pools.last() {
            match from(*pool) {
                Err(vk::Result::ERROR_OUT_OF_POOL_MEMORY | vk::Result::ERROR_FRAGMENTED_POOL) => {}
                outcome => return outcome.map_err(failed()),
            }
        }
        let sizes = [
            vk::DescriptorType::STORAGE_BUFFER,
            vk::DescriptorType::UNIFORM_BUFFER,
            vk::DescriptorType::UNIFORM_TEXEL_BUFFER,
            vk::DescriptorType::COMBINED_IMAGE_SAMPLER,
        ]
        .map(|ty| vk::DescriptorPoolSize::default().ty(ty).descriptor_count(SETS_PER_POOL * MAX_BINDINGS));
        let create = vk::DescriptorPoolCreateInfo::default().max_sets(SETS_PER_POOL).pool_sizes(&sizes);
        // SAFETY: the create info and `sizes` live until the call returns.
        let pool = unsafe { gpu.device.create_descriptor_pool(&create, None) }
            .map_err(Error::vulkan("vkCreateDescriptorPool", &self.commands.name))?;
        self.commands.descriptor_pools.push(pool);
        from(pool).map_err(failed())
    }

    /// Records a copy of `bytes` bytes.
    ///
    /// # Errors
    /// [`Error::Internal`] when a range does not fit.
    pub fn copy(&mut self, from: &Buffer, from_at: u64, to: &Buffer, to_at: u64, bytes: u64) -> Result<()> {
        from.check_range(from_at, bytes)?;
        to.check_range(to_at, bytes)?;
        self.depend(&[from], &[to]);
        let region = [vk::BufferCopy::default().src_offset(from_at).dst_offset(to_at).size(bytes)];
        // SAFETY: both ranges were checked; the command buffer is being recorded, and keeps both buffers.
        unsafe { self.commands.gpu.device.cmd_copy_buffer(self.commands.raw, from.raw(), to.raw(), &region) };
        Ok(())
    }

    /// Records a copy from a buffer to a whole image; afterwards the image may be sampled.
    pub(super) fn fill_image(&mut self, from: &Buffer, to: &Image3d) -> Result<()> {
        from.check_range(0, to.bytes())?;
        self.depend(&[from], &[]);
        self.commands.images.push(to.clone());
        let [width, height, depth] = to.size();
        let (device, raw) = (&self.commands.gpu.device, self.commands.raw);
        let barrier = |old, new, before, after| {
            [vk::ImageMemoryBarrier::default()
                .image(to.raw())
                .subresource_range(Image3d::RANGE)
                .old_layout(old)
                .new_layout(new)
                .src_access_mask(before)
                .dst_access_mask(after)
                .src_queue_family_index(vk::QUEUE_FAMILY_IGNORED)
                .dst_queue_family_index(vk::QUEUE_FAMILY_IGNORED)]
        };
        let copying = vk::ImageLayout::TRANSFER_DST_OPTIMAL;
        let (write, none) = (vk::AccessFlags::TRANSFER_WRITE, vk::AccessFlags::empty());
        let before = barrier(vk::ImageLayout::UNDEFINED, copying, none, write);
        let after = barrier(copying, vk::ImageLayout::SHADER_READ_ONLY_OPTIMAL, write, vk::AccessFlags::SHADER_READ);
        let region = [vk::BufferImageCopy::default()
            .image_subresource(vk::ImageSubresourceLayers {
                aspect_mask: vk::ImageAspectFlags::COLOR,
                mip_level: 0,
                base_array_layer: 0,
                layer_count: 1,
            })
            .image_extent(vk::Extent3D { width, height, depth })];
        let (transfer, compute) = (vk::PipelineStageFlags::TRANSFER, vk::PipelineStageFlags::COMPUTE_SHADER);
        let top = vk::PipelineStageFlags::TOP_OF_PIPE;
        let by_region = vk::DependencyFlags::empty();
        // SAFETY: the command buffer is being recorded; the buffer holds all cells, as checked; `commands` keeps both.
        unsafe {
            // Work submitted earlier may still read the old contents.
            device.cmd_pipeline_barrier(raw, top | compute, transfer, by_region, &[], &[], &before);
            device.cmd_copy_buffer_to_image(raw, from.raw(), to.raw(), copying, &region);
            device.cmd_pipeline_barrier(raw, transfer, compute, by_region, &[], &[], &after);
        }
        Ok(())
    }

    /// Records filling a whole buffer with a 32-bit pattern.
    pub fn fill(&mut self, buffer: &Buffer, pattern: u32) {
        self.depend(&[], &[buffer]);
        let (device, raw) = (&self.commands.gpu.device, self.commands.raw);
        // SAFETY: the command buffer is being recorded, and keeps the buffer, whose size is a multiple of 16.
        unsafe { device.cmd_fill_buffer(raw, buffer.raw(), 0, buffer.bytes(), pattern) };
    }

    /// Ends the recording.
    ///
    /// # Errors
    /// [`Error::Vulkan`] or [`Error::OutOfMemory`].
    pub fn finish(mut self) -> Result<Commands> {
        // Makes the last writes visible to host reads of read-back buffers.
        let barrier = [vk::MemoryBarrier::default()
            .src_access_mask(vk::AccessFlags::SHADER_WRITE | vk::AccessFlags::TRANSFER_WRITE)
            .dst_access_mask(vk::AccessFlags::HOST_READ)];
        let commands = &mut self.commands;
        // SAFETY: `Recording::new` began the command buffer, and only this function, which takes the recording, ends it.
        unsafe {
            commands.gpu.device.cmd_pipeline_barrier(
                commands.raw,
                vk::PipelineStageFlags::COMPUTE_SHADER | vk::PipelineStageFlags::TRANSFER,
                vk::PipelineStageFlags::HOST,
                vk::DependencyFlags::empty(),
                &barrier,
                &[],
                &[],
            );
            commands.gpu.device.end_command_buffer(commands.raw)
        }
        .map_err(Error::vulkan("vkEndCommandBuffer", &commands.name))?;
        Ok(self.commands)
    }
}

/// A point in the sequence of the device's submits; see [`Gpu::wait`].
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub struct Ticket(u64);

impl Ticket {
    /// Returns the value that the device's timeline has after this point.
    #[cfg(unix)]
    pub(super) fn value(self) -> u64 {
        self.0
    }
}

/// Work of a submit: commands, and a binary semaphore that is signalled after them.
#[derive(Default)]
struct Work {
    commands: Option<vk::CommandBuffer>,
    signalled: Option<vk::Semaphore>,
}

impl Shared {
    /// Submits work to the device, after all that was submitted before.
    ///
    /// # Safety
    /// The commands must be ended and alive until the submit is complete, as the semaphore must, which no submit may wait for or signal
    /// at the same time.
    unsafe fn submit(&self, work: &Work, name: &str) -> Result<Ticket> {
        let queue = self.locked_queue();
        let value = self.last_submitted.load(Ordering::Acquire) + 1;
        // The value of a binary semaphore is ignored.
        let (mut values, mut semaphores) = (vec![value], vec![self.timeline]);
        if let Some(signalled) = work.signalled {
            values.push(0);
            semaphores.push(signalled);
        }
        let mut timeline = vk::TimelineSemaphoreSubmitInfo::default().signal_semaphore_values(&values);
        let submit = [vk::SubmitInfo::default()
            .command_buffers(work.commands.as_slice())
            .signal_semaphores(&semaphores)
            .push_next(&mut timeline)];
        // SAFETY: the queue is locked for us; callers keep commands and semaphore alive; the chain lives until the call returns.
        unsafe { self.device.queue_submit(*queue, &submit, vk::Fence::null()) }
            .map_err(Error::vulkan("vkQueueSubmit", name))?;
        self.last_submitted.store(value, Ordering::Release);
        self.calls.submits.fetch_add(1, Ordering::Relaxed);
        Ok(Ticket(value))
    }

    /// Submits the signal of a binary semaphore that outlives it.
    #[cfg(unix)]
    pub(super) fn submit_signal(&self, semaphore: vk::Semaphore, name: &str) -> Result<Ticket> {
        // SAFETY: the owner of the semaphore waits in its drop for this submit.
        unsafe { self.submit(&Work { signalled: Some(semaphore), ..Work::default() }, name) }
    }
}

impl Commands {
    /// Submits the commands to the device.
    ///
    /// # Errors
    /// [`Error::DeviceLost`], [`Error::OutOfMemory`] or [`Error::Vulkan`].
    pub fn submit(&self) -> Result<Ticket> {
        let work = Work { commands: Some(self.raw), ..Work::default() };
        // SAFETY: the commands were ended, allow simultaneous use, and wait in their drop for this submit.
        let ticket = unsafe { self.gpu.submit(&work, &self.name) }?;
        self.last_submit.store(ticket.0, Ordering::Release);
        self.gpu.calls.barriers.fetch_add(self.barriers.into(), Ordering::Relaxed);
        Ok(ticket)
    }

    /// Returns the number of barriers at which commands wait for earlier ones, including the barrier at the start.
    pub fn barriers(&self) -> u32 {
        self.barriers
    }

    /// Returns the device time of each pass of the last submit, which must be complete. Empty without timestamps.
    ///
    /// # Errors
    /// [`Error::Vulkan`].
    pub fn pass_times(&self) -> Result<Vec<PassTime>> {
        if self.passes.is_empty() {
            return Ok(Vec::new());
        }
        let mut ticks = vec![0u64; 2 * self.passes.len()];
        let flags = vk::QueryResultFlags::TYPE_64 | vk::QueryResultFlags::WAIT;
        // SAFETY: the pool has two queries for each pass, which every submit writes.
        unsafe { self.gpu.device.get_query_pool_results(self.queries, 0, &mut ticks, flags) }
            .map_err(Error::vulkan("vkGetQueryPoolResults", &self.name))?;
        let period_ms = f64::from(self.gpu.info.timestamp_period_ns) * 1e-6;
        // Counters of fewer bits wrap around to zero.
        let bits = self.gpu.info.timestamp_bits;
        let mask = if bits < u64::BITS { (1 << bits) - 1 } else { u64::MAX };
        Ok(self
            .passes
            .iter()
            .zip(ticks.chunks_exact(2))
            .map(|(name, t)| PassTime { name, ms: (t[1].wrapping_sub(t[0]) & mask) as f64 * period_ms })
            .collect())
    }
}

impl Gpu {
    /// Waits until the work up to `ticket` is done.
    ///
    /// # Errors
    /// [`Error::DeviceLost`] or [`Error::Vulkan`].
    pub fn wait(&self, ticket: Ticket) -> Result<()> {
        self.shared.calls.waits.fetch_add(1, Ordering::Relaxed);
        self.shared.wait(ticket.0)
    }
}

impl Drop for Commands {
    fn drop(&mut self) {
        let submitted = self.last_submit.load(Ordering::Acquire);
        if submitted > 0 {
            // A lost device runs nothing, so destroying is allowed even if the wait fails.
            let _ = self.gpu.wait(submitted);
        }
        // SAFETY: the last submit is complete, and each pool is destroyed once, here; null handles are ignored.
        unsafe {
            for pool in &self.descriptor_pools {
                self.gpu.device.destroy_descriptor_pool(*pool, None);
            }
            self.gpu.device.destroy_query_pool(self.queries, None);
            self.gpu.device.destroy_command_pool(self.pool, None);
        }
        self.gpu.untrack();
    }
}
