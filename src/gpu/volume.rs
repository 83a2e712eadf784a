//! 3D images of one f16 channel, sampled with linear interpolation.

use super::device::{Gpu, Shared, lock};
use super::memory::Memory;
use super::record::{Commands, Recording};
use crate::error::{Error, Result};
use ash::vk;
use gpu_allocator::MemoryLocation;
use gpu_allocator::vulkan::{Allocation, AllocationCreateDesc, AllocationScheme};
use std::mem::ManuallyDrop;
use std::sync::{Arc, Mutex};

/// A volume in the device's sampling units. Clones share the same memory, freed with the last one.
#[derive(Clone)]
pub struct Volume {
    inner: Arc<Inner>,
}

struct Inner {
    gpu: Arc<Shared>,
    raw: vk::Image,
    view: vk::ImageView,
    sampler: vk::Sampler,
    size: [u32; 3],
    bytes: u64,
    allocation: Mutex<Option<ManuallyDrop<Allocation>>>,
}

const RANGE: vk::ImageSubresourceRange = vk::ImageSubresourceRange {
    aspect_mask: vk::ImageAspectFlags::COLOR,
    base_mip_level: 0,
    level_count: 1,
    base_array_layer: 0,
    layer_count: 1,
};

impl Gpu {
    /// A volume of `size` cells, still to be filled; outside, its nearest cell repeats.
    ///
    /// # Errors
    /// [`Error::Internal`] for a size of zero, [`Error::OutOfMemory`].
    pub fn volume(&self, name: &str, size: [u32; 3]) -> Result<Volume> {
        let n = size.iter().map(|s| *s as usize).product::<usize>();
        if n == 0 {
            return Err(Error::Internal(format!("{name}: a volume of {size:?} cells")));
        }
        let shared = &self.shared;
        let bytes = 2 * n as u64;
        shared.reserve(name, bytes)?;
        shared.track();
        // From here on `Inner::drop` cleans up; null handles are ignored by Vulkan's destroy calls.
        let mut inner = Inner {
            gpu: shared.clone(),
            raw: vk::Image::null(),
            view: vk::ImageView::null(),
            sampler: vk::Sampler::null(),
            size,
            bytes,
            allocation: Mutex::new(None),
        };
        let device = &shared.device;
        let [width, height, depth] = size;
        let create = vk::ImageCreateInfo::default()
            .image_type(vk::ImageType::TYPE_3D)
            .format(vk::Format::R16_SFLOAT)
            .extent(vk::Extent3D { width, height, depth })
            .mip_levels(1)
            .array_layers(1)
            .samples(vk::SampleCountFlags::TYPE_1)
            .usage(vk::ImageUsageFlags::SAMPLED | vk::ImageUsageFlags::TRANSFER_DST);
        // SAFETY: the device is alive; every device samples R16_SFLOAT with linear filters (Vulkan's required formats).
        inner.raw = unsafe { device.create_image(&create, None) }.map_err(Error::vulkan("vkCreateImage", name))?;
        // SAFETY: the image was just made.
        let requirements = unsafe { device.get_image_memory_requirements(inner.raw) };
        let allocation = lock(&shared.allocator)
            .allocate(&AllocationCreateDesc {
                name,
                requirements,
                location: MemoryLocation::GpuOnly,
                linear: false,
                allocation_scheme: AllocationScheme::GpuAllocatorManaged,
            })
            .map_err(|e| Error::OutOfMemory {
                object: name.into(),
                bytes: requirements.size,
                detail: e.to_string(),
                may_pass: true,
            })?;
        // SAFETY: memory and offset come from the allocator for exactly these requirements.
        unsafe { device.bind_image_memory(inner.raw, allocation.memory(), allocation.offset()) }
            .map_err(Error::vulkan("vkBindImageMemory", name))?;
        *lock(&inner.allocation) = Some(ManuallyDrop::new(allocation));
        shared.set_name(inner.raw, name);
        let create = vk::ImageViewCreateInfo::default()
            .image(inner.raw)
            .view_type(vk::ImageViewType::TYPE_3D)
            .format(vk::Format::R16_SFLOAT)
            .subresource_range(RANGE);
        // SAFETY: the image is bound.
        inner.view =
            unsafe { device.create_image_view(&create, None) }.map_err(Error::vulkan("vkCreateImageView", name))?;
        let create = vk::SamplerCreateInfo::default()
            .mag_filter(vk::Filter::LINEAR)
            .min_filter(vk::Filter::LINEAR)
            .address_mode_u(vk::SamplerAddressMode::CLAMP_TO_EDGE)
            .address_mode_v(vk::SamplerAddressMode::CLAMP_TO_EDGE)
            .address_mode_w(vk::SamplerAddressMode::CLAMP_TO_EDGE);
        // SAFETY: the device is alive.
        inner.sampler =
            unsafe { device.create_sampler(&create, None) }.map_err(Error::vulkan("vkCreateSampler", name))?;
        Ok(Volume { inner: Arc::new(inner) })
    }
}

impl Volume {
    /// Replaces all cells, x fastest, between what was submitted so far and what is submitted next. Dropping the result
    /// waits.
    ///
    /// # Errors
    /// [`Error::Internal`] for another number of cells; errors of the upload.
    pub fn fill(&self, cells: &[half::f16]) -> Result<Commands> {
        let bytes: &[u8] = bytemuck::cast_slice(cells);
        if bytes.len() as u64 != self.inner.bytes {
            return Err(Error::Internal(format!("{} bytes for a volume of {}", bytes.len(), self.inner.bytes)));
        }
        let gpu = Gpu { shared: self.inner.gpu.clone() };
        let staging = gpu.buffer("volume staging", self.inner.bytes, Memory::Upload)?;
        staging.write(bytes)?;
        let mut recording = Recording::new(&gpu, "volume upload")?;
        recording.fill_volume(&staging, self, self.inner.size)?;
        let commands = recording.finish()?;
        commands.submit()?;
        Ok(commands)
    }

    pub(super) fn raw(&self) -> vk::Image {
        self.inner.raw
    }

    pub(super) fn descriptor(&self) -> vk::DescriptorImageInfo {
        vk::DescriptorImageInfo::default()
            .sampler(self.inner.sampler)
            .image_view(self.inner.view)
            .image_layout(vk::ImageLayout::SHADER_READ_ONLY_OPTIMAL)
    }

    pub(super) const RANGE: vk::ImageSubresourceRange = RANGE;
}

impl Drop for Inner {
    fn drop(&mut self) {
        // SAFETY: recordings hold clones of the volumes they use, so no submit in flight needs this one; null handles
        // are allowed; the allocation is taken exactly once, here.
        unsafe {
            self.gpu.device.destroy_sampler(self.sampler, None);
            self.gpu.device.destroy_image_view(self.view, None);
            self.gpu.device.destroy_image(self.raw, None);
            if let Some(allocation) = lock(&self.allocation).take()
                && let Err(e) = lock(&self.gpu.allocator).free(ManuallyDrop::into_inner(allocation))
            {
                tracing::error!(target: "vulkan", "freeing a volume: {e}");
            }
        }
        self.gpu.release(self.bytes);
        self.gpu.untrack();
    }
}
