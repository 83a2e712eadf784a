//! 3D images of one f16 channel, sampled with linear interpolation.

use super::device::{Gpu, Shared};
use super::lock::lock;
use crate::error::{Error, Result};
use ash::vk;
use gpu_allocator::MemoryLocation;
use gpu_allocator::vulkan::{Allocation, AllocationCreateDesc, AllocationScheme};
use std::sync::Arc;

/// An image in the tiling optimal for sampling. Clones share the same memory, which is freed with the last one.
#[derive(Clone)]
pub struct Image3d {
    inner: Arc<Inner>,
}

struct Inner {
    gpu: Arc<Shared>,
    name: String,
    raw: vk::Image,
    view: vk::ImageView,
    sampler: vk::Sampler,
    size: [u32; 3],
    bytes: u64,
    allocation: Option<Allocation>,
}

const FORMAT: vk::Format = vk::Format::R16_SFLOAT;
const CELL_BYTES: u64 = 2;

impl Gpu {
    /// Makes an image of `size` cells with undefined contents. Outside the image, the nearest cell's value repeats.
    ///
    /// # Errors
    /// [`Error::Internal`] for a size of zero, [`Error::OutOfMemory`].
    pub fn image_3d(&self, name: &str, size: [u32; 3]) -> Result<Image3d> {
        let n: u64 = size.iter().map(|s| u64::from(*s)).product();
        if n == 0 {
            return Err(Error::Internal(format!("{name}: an image cannot have {size:?} cells")));
        }
        let mut inner = Inner::new(&self.shared, name, size, CELL_BYTES * n)?;
        inner.create()?;
        inner.allocate()?;
        inner.create_view()?;
        inner.create_sampler()?;
        Ok(Image3d { inner: Arc::new(inner) })
    }
}

impl Inner {
    /// Starts an image without Vulkan objects; dropping it frees whatever has been created by then.
    fn new(gpu: &Arc<Shared>, name: &str, size: [u32; 3], bytes: u64) -> Result<Inner> {
        gpu.reserve(name, bytes)?;
        gpu.track();
        Ok(Inner {
            gpu: gpu.clone(),
            name: name.to_owned(),
            raw: vk::Image::null(),
            view: vk::ImageView::null(),
            sampler: vk::Sampler::null(),
            size,
            bytes,
            allocation: None,
        })
    }

    fn create(&mut self) -> Result<()> {
        let [width, height, depth] = self.size;
        let create = vk::ImageCreateInfo::default()
            .image_type(vk::ImageType::TYPE_3D)
            .format(FORMAT)
            .extent(vk::Extent3D { width, height, depth })
            .mip_levels(1)
            .array_layers(1)
            .samples(vk::SampleCountFlags::TYPE_1)
            .usage(vk::ImageUsageFlags::SAMPLED | vk::ImageUsageFlags::TRANSFER_DST);
        // SAFETY: the create info lives until the call returns; every device samples R16_SFLOAT with linear filters
        // (Vulkan's required formats).
        self.raw = unsafe { self.gpu.device.create_image(&create, None) }
            .map_err(Error::vulkan("vkCreateImage", &self.name))?;
        self.gpu.set_name(self.raw, &self.name);
        Ok(())
    }

    fn allocate(&mut self) -> Result<()> {
        // SAFETY: `create` made the image from this device.
        let requirements = unsafe { self.gpu.device.get_image_memory_requirements(self.raw) };
        let allocation = lock(&self.gpu.allocator)
            .allocate(&AllocationCreateDesc {
                name: &self.name,
                requirements,
                location: MemoryLocation::GpuOnly,
                linear: false,
                allocation_scheme: AllocationScheme::GpuAllocatorManaged,
            })
            .map_err(|e| self.gpu.no_memory(&self.name, requirements.size, &e))?;
        // SAFETY: the handle is only used for binding; the allocation, which `self` keeps, still owns it.
        let (memory, offset) = (unsafe { allocation.memory() }, allocation.offset());
        self.allocation = Some(allocation);
        // SAFETY: the allocator gave memory and offset for exactly this image's requirements; it is bound once.
        unsafe { self.gpu.device.bind_image_memory(self.raw, memory, offset) }
            .map_err(Error::vulkan("vkBindImageMemory", &self.name))
    }

    fn create_view(&mut self) -> Result<()> {
        let create = vk::ImageViewCreateInfo::default()
            .image(self.raw)
            .view_type(vk::ImageViewType::TYPE_3D)
            .format(FORMAT)
            .subresource_range(Image3d::RANGE);
        // SAFETY: the image has its memory, and the view names the format and type it was made with.
        self.view = unsafe { self.gpu.device.create_image_view(&create, None) }
            .map_err(Error::vulkan("vkCreateImageView", &self.name))?;
        Ok(())
    }

    fn create_sampler(&mut self) -> Result<()> {
        let create = vk::SamplerCreateInfo::default()
            .mag_filter(vk::Filter::LINEAR)
            .min_filter(vk::Filter::LINEAR)
            .address_mode_u(vk::SamplerAddressMode::CLAMP_TO_EDGE)
            .address_mode_v(vk::SamplerAddressMode::CLAMP_TO_EDGE)
            .address_mode_w(vk::SamplerAddressMode::CLAMP_TO_EDGE);
        // SAFETY: the create info lives until the call returns and asks for no optional feature.
        self.sampler = unsafe { self.gpu.device.create_sampler(&create, None) }
            .map_err(Error::vulkan("vkCreateSampler", &self.name))?;
        Ok(())
    }
}

impl Image3d {
    /// Range of the whole image.
    pub(super) const RANGE: vk::ImageSubresourceRange = vk::ImageSubresourceRange {
        aspect_mask: vk::ImageAspectFlags::COLOR,
        base_mip_level: 0,
        level_count: 1,
        base_array_layer: 0,
        layer_count: 1,
    };

    /// Returns the number of cells along x, y, z.
    pub(super) fn size(&self) -> [u32; 3] {
        self.inner.size
    }

    /// Returns the bytes of all cells.
    pub(super) fn bytes(&self) -> u64 {
        self.inner.bytes
    }

    pub(super) fn gpu(&self) -> Gpu {
        Gpu { shared: self.inner.gpu.clone() }
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
}

impl Drop for Inner {
    fn drop(&mut self) {
        // SAFETY: recordings hold clones of the images they use, so no submit in flight needs this one; null handles
        // are ignored; nothing else destroys them.
        unsafe {
            self.gpu.device.destroy_sampler(self.sampler, None);
            self.gpu.device.destroy_image_view(self.view, None);
            self.gpu.device.destroy_image(self.raw, None);
        }
        if let Some(allocation) = self.allocation.take()
            && let Err(e) = lock(&self.gpu.allocator).free(allocation)
        {
            tracing::error!(target: "vulkan", "freeing `{}`: {e}", self.name);
        }
        self.gpu.release(self.bytes);
        self.gpu.untrack();
    }
}
