//! Buffers allocated with gpu-allocator (device-local, upload and read-back), and buffers in memory that other APIs can
//! import.

use super::device::{Gpu, Shared};
use super::lock::lock;
use crate::error::{Error, Result};
use ash::vk;
use bytemuck::Pod;
use gpu_allocator::MemoryLocation;
use gpu_allocator::vulkan::{Allocation, AllocationCreateDesc, AllocationScheme};
use std::sync::atomic::Ordering;
use std::sync::{Arc, Mutex, PoisonError};

/// Kind of memory of a buffer.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Memory {
    /// Fast for the device; accessible to the host by copies only.
    Device,
    /// Written by the host, read by the device.
    Upload,
    /// Written by the device, read by the host.
    Readback,
}

/// Access of shaders to a buffer of vec4.
#[derive(Debug, Clone, Copy, PartialEq, Eq, serde::Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Operands {
    /// Storage buffer.
    Storage,
    /// Texel buffer of format `rgba32f`.
    Texel,
    /// Access through the buffer's address, without bounds checks.
    Address,
}

/// Buffer on the device. Clones share the same memory, which is freed with the last one.
#[derive(Clone)]
pub struct Buffer {
    inner: Arc<Inner>,
}

struct Inner {
    gpu: Arc<Shared>,
    name: String,
    raw: vk::Buffer,
    texel_view: Option<vk::BufferView>,
    bytes: u64,
    backing: Backing,
}

/// Memory behind a buffer.
enum Backing {
    /// No memory yet.
    None,
    /// Block of the allocator.
    Block(Mutex<Allocation>),
    /// Separate allocation, which may be exported.
    #[cfg_attr(not(unix), allow(dead_code, reason = "memory is shared on Unix only"))]
    Own(vk::DeviceMemory),
}

/// Extra bytes of buffers read through an address: drivers may read a little past the last element when a loop of
/// uniform loads ends (seen with llvmpipe of Mesa 26.2, which crashes without them).
const ADDRESS_TAIL_BYTES: u64 = 4096;

impl Gpu {
    /// Makes a buffer of `bytes` bytes, contents undefined.
    ///
    /// # Errors
    /// [`Error::OutOfMemory`] naming the buffer, also beyond the device's limits.
    pub fn buffer(&self, name: &str, bytes: u64, memory: Memory) -> Result<Buffer> {
        self.make_buffer(name, bytes, memory, Operands::Storage)
    }

    /// Makes a device buffer that shaders can read as a storage buffer and also in the way `operands` says.
    ///
    /// # Errors
    /// Fails like [`Gpu::buffer`].
    pub fn operand_buffer(&self, name: &str, bytes: u64, operands: Operands) -> Result<Buffer> {
        let tail = if operands == Operands::Address { ADDRESS_TAIL_BYTES } else { 0 };
        self.make_buffer(name, bytes + tail, Memory::Device, operands)
    }

    fn make_buffer(&self, name: &str, bytes: u64, memory: Memory, operands: Operands) -> Result<Buffer> {
        let texel = operands == Operands::Texel;
        let bytes = rounded(bytes);
        self.check_limits(name, bytes, texel)?;
        let mut usage = vk::BufferUsageFlags::STORAGE_BUFFER
            | vk::BufferUsageFlags::UNIFORM_BUFFER
            | vk::BufferUsageFlags::INDIRECT_BUFFER
            | vk::BufferUsageFlags::TRANSFER_SRC
            | vk::BufferUsageFlags::TRANSFER_DST;
        if texel {
            usage |= vk::BufferUsageFlags::UNIFORM_TEXEL_BUFFER;
        }
        if operands == Operands::Address {
            usage |= vk::BufferUsageFlags::SHADER_DEVICE_ADDRESS;
        }
        self.shared.calls.buffers.fetch_add(1, Ordering::Relaxed);
        let mut inner = Inner::new(&self.shared, name, bytes)?;
        inner.create(&vk::BufferCreateInfo::default().size(bytes).usage(usage))?;
        inner.allocate(memory)?;
        if texel {
            inner.create_texel_view()?;
        }
        Ok(Buffer { inner: Arc::new(inner) })
    }

    fn check_limits(&self, name: &str, bytes: u64, texel: bool) -> Result<()> {
        let info = self.info();
        let beyond = |detail: String| {
            let (object, may_pass) = (name.into(), false);
            Err(Error::OutOfMemory { object, bytes, detail, may_pass })
        };
        if bytes > u64::from(info.max_storage_buffer_range) {
            let max = info.max_storage_buffer_range;
            return beyond(format!("a buffer of {} has at most {max} bytes", info.name));
        }
        if texel && bytes / 16 > u64::from(info.max_texel_buffer_elements) {
            let max = info.max_texel_buffer_elements;
            return beyond(format!("a texel buffer of {} has at most {max} elements", info.name));
        }
        Ok(())
    }

    /// Makes a device buffer whose memory other processes and APIs can import, as an opaque file descriptor; the buffer begins
    /// at offset 0.
    ///
    /// # Errors
    /// [`Error::NoDevice`] where `VK_KHR_external_memory_fd` is missing; [`Error::OutOfMemory`].
    #[cfg(unix)]
    pub fn exported_buffer(&self, name: &str, bytes: u64) -> Result<(Buffer, ExportedMemory)> {
        let info = self.info();
        if !info.external_memory_fd {
            return Err(Error::NoDevice(format!(
                "{}: the device does not support VK_KHR_external_memory_fd",
                info.name
            )));
        }
        let bytes = rounded(bytes);
        let mut external = vk::ExternalMemoryBufferCreateInfo::default().handle_types(EXPORTED);
        let usage = vk::BufferUsageFlags::STORAGE_BUFFER
            | vk::BufferUsageFlags::TRANSFER_SRC
            | vk::BufferUsageFlags::TRANSFER_DST;
        let mut inner = Inner::new(&self.shared, name, bytes)?;
        inner.create(&vk::BufferCreateInfo::default().size(bytes).usage(usage).push_next(&mut external))?;
        let (memory, memory_type, allocated_bytes) = inner.allocate_exportable()?;
        let descriptor = inner.export(memory)?;
        Ok((Buffer { inner: Arc::new(inner) }, ExportedMemory { descriptor, memory_type, allocated_bytes }))
    }
}

/// Memory of a buffer for import by others. It is dedicated to the buffer; a Vulkan device imports it with the same type and size.
#[cfg(unix)]
pub struct ExportedMemory {
    /// Opaque file descriptor.
    pub descriptor: std::os::fd::OwnedFd,
    /// Index of its type among the memory types of the physical device.
    pub memory_type: u32,
    /// Size of the allocation, bytes, which may exceed the buffer's.
    pub allocated_bytes: u64,
}

/// Handle type of exported memory.
#[cfg(unix)]
const EXPORTED: vk::ExternalMemoryHandleTypeFlags = vk::ExternalMemoryHandleTypeFlags::OPAQUE_FD;

/// Rounds a size up to whole vec4; at least one.
fn rounded(bytes: u64) -> u64 {
    bytes.max(16).next_multiple_of(16)
}

impl Inner {
    /// Starts a buffer without Vulkan objects; dropping it frees whatever has been created by then.
    fn new(gpu: &Arc<Shared>, name: &str, bytes: u64) -> Result<Inner> {
        gpu.reserve(name, bytes)?;
        gpu.track();
        Ok(Inner {
            gpu: gpu.clone(),
            name: name.to_owned(),
            raw: vk::Buffer::null(),
            texel_view: None,
            bytes,
            backing: Backing::None,
        })
    }

    fn create(&mut self, create: &vk::BufferCreateInfo<'_>) -> Result<()> {
        // SAFETY: the create info, with its chain, lives until the call returns; the device lives as long as `self`.
        self.raw = unsafe { self.gpu.device.create_buffer(create, None) }
            .map_err(Error::vulkan("vkCreateBuffer", &self.name))?;
        self.gpu.set_name(self.raw, &self.name);
        Ok(())
    }

    fn requirements(&self) -> vk::MemoryRequirements {
        // SAFETY: `create` made the buffer from this device.
        unsafe { self.gpu.device.get_buffer_memory_requirements(self.raw) }
    }

    fn bind(&self, memory: vk::DeviceMemory, offset: u64) -> Result<()> {
        // SAFETY: callers allocated the memory for this buffer's requirements, and bind once.
        unsafe { self.gpu.device.bind_buffer_memory(self.raw, memory, offset) }
            .map_err(Error::vulkan("vkBindBufferMemory", &self.name))
    }

    fn allocate(&mut self, memory: Memory) -> Result<()> {
        let allocation = lock(&self.gpu.allocator)
            .allocate(&AllocationCreateDesc {
                name: &self.name,
                requirements: self.requirements(),
                location: match memory {
                    Memory::Device => MemoryLocation::GpuOnly,
                    Memory::Upload => MemoryLocation::CpuToGpu,
                    Memory::Readback => MemoryLocation::GpuToCpu,
                },
                linear: true,
                allocation_scheme: AllocationScheme::GpuAllocatorManaged,
            })
            .map_err(|e| self.gpu.no_memory(&self.name, self.bytes, &e))?;
        // SAFETY: the handle is only used for binding; the allocation, which `self` keeps, still owns it.
        let (memory, offset) = (unsafe { allocation.memory() }, allocation.offset());
        self.backing = Backing::Block(Mutex::new(allocation));
        self.bind(memory, offset)
    }

    fn create_texel_view(&mut self) -> Result<()> {
        let create = vk::BufferViewCreateInfo::default()
            .buffer(self.raw)
            .format(vk::Format::R32G32B32A32_SFLOAT)
            .range(vk::WHOLE_SIZE);
        // SAFETY: the buffer was made with texel usage and has its memory; every device has texel buffers of this
        // format (Vulkan's required formats).
        let view = unsafe { self.gpu.device.create_buffer_view(&create, None) }
            .map_err(Error::vulkan("vkCreateBufferView", &self.name))?;
        self.gpu.set_name(view, &self.name);
        self.texel_view = Some(view);
        Ok(())
    }

    /// Allocates the buffer's memory for export; returns it with the index of its type and its size in bytes.
    #[cfg(unix)]
    fn allocate_exportable(&mut self) -> Result<(vk::DeviceMemory, u32, u64)> {
        let (gpu, requirements) = (&self.gpu, self.requirements());
        // SAFETY: the physical device is the one this device was made from.
        let memories = unsafe { gpu.device.instance.get_physical_device_memory_properties(gpu.physical) };
        let kind = (0..memories.memory_type_count)
            .filter(|i| requirements.memory_type_bits >> i & 1 == 1)
            // The first type of the device's own memory; types that the host reaches as well come later, and may be small.
            .min_by_key(|i| {
                !memories.memory_types[*i as usize].property_flags.contains(vk::MemoryPropertyFlags::DEVICE_LOCAL)
            })
            .ok_or_else(|| {
                Error::NoDevice(format!("{}: the device has no memory that can be exported", gpu.info.name))
            })?;
        let mut export = vk::ExportMemoryAllocateInfo::default().handle_types(EXPORTED);
        let mut dedicated = vk::MemoryDedicatedAllocateInfo::default().buffer(self.raw);
        let allocate = vk::MemoryAllocateInfo::default()
            .allocation_size(requirements.size)
            .memory_type_index(kind)
            .push_next(&mut export)
            .push_next(&mut dedicated);
        // SAFETY: the chain consists of locals that live until the call returns; the device has the extension.
        let memory = unsafe { gpu.device.allocate_memory(&allocate, None) }
            .map_err(Error::vulkan("vkAllocateMemory", &self.name))?;
        self.backing = Backing::Own(memory);
        self.bind(memory, 0)?;
        Ok((memory, kind, requirements.size))
    }

    #[cfg(unix)]
    fn export(&self, memory: vk::DeviceMemory) -> Result<std::os::fd::OwnedFd> {
        use std::os::fd::FromRawFd;
        let get = vk::MemoryGetFdInfoKHR::default().memory(memory).handle_type(EXPORTED);
        let export = ash::khr::external_memory_fd::Device::new(&self.gpu.device.instance, &self.gpu.device);
        // SAFETY: the memory was allocated for export as this type.
        let fd = unsafe { export.get_memory_fd(&get) }.map_err(Error::vulkan("vkGetMemoryFdKHR", &self.name))?;
        // SAFETY: Vulkan passes ownership of the descriptor to its caller, and nothing else uses it.
        Ok(unsafe { std::os::fd::OwnedFd::from_raw_fd(fd) })
    }
}

impl Buffer {
    /// Returns the size in bytes (rounded up to 16).
    pub fn bytes(&self) -> u64 {
        self.inner.bytes
    }

    /// Returns the debug name.
    pub fn name(&self) -> &str {
        &self.inner.name
    }

    pub(super) fn raw(&self) -> vk::Buffer {
        self.inner.raw
    }

    /// Returns the device address of an [`Operands::Address`] buffer.
    pub(super) fn address(&self) -> u64 {
        let info = vk::BufferDeviceAddressInfo::default().buffer(self.inner.raw);
        // SAFETY: only pipelines that push addresses call this, and these exist only on devices with the feature;
        // kernels declare which of their buffers need addresses, and those are made as `Operands::Address`.
        unsafe { self.inner.gpu.device.get_buffer_device_address(&info) }
    }

    pub(super) fn texel_view(&self) -> Option<vk::BufferView> {
        self.inner.texel_view
    }

    /// Checks that a range lies inside the buffer.
    ///
    /// # Errors
    /// [`Error::Internal`] if it does not.
    pub fn check_range(&self, offset: u64, bytes: u64) -> Result<()> {
        match offset.checked_add(bytes) {
            Some(end) if end <= self.inner.bytes => Ok(()),
            _ => Err(Error::Internal(format!(
                "{} bytes at {offset} do not fit into buffer `{}` of {} bytes",
                bytes, self.inner.name, self.inner.bytes
            ))),
        }
    }

    /// Writes to the start of an [`Memory::Upload`] or [`Memory::Readback`] buffer.
    ///
    /// # Errors
    /// [`Error::Internal`] when the buffer is not mapped or too small.
    pub fn write<T: Pod>(&self, data: &[T]) -> Result<()> {
        let bytes: &[u8] = bytemuck::cast_slice(data);
        self.check_range(0, bytes.len() as u64)?;
        let Backing::Block(allocation) = &self.inner.backing else { return Err(self.not_mapped()) };
        let mut allocation = lock(allocation);
        let mapped = allocation.mapped_slice_mut().ok_or_else(|| self.not_mapped())?;
        mapped[..bytes.len()].copy_from_slice(bytes);
        Ok(())
    }

    /// Reads from the start of a [`Memory::Readback`] buffer.
    ///
    /// # Errors
    /// Fails like [`Buffer::write`].
    pub fn read<T: Pod>(&self, out: &mut [T]) -> Result<()> {
        let bytes: &mut [u8] = bytemuck::cast_slice_mut(out);
        self.check_range(0, bytes.len() as u64)?;
        let Backing::Block(allocation) = &self.inner.backing else { return Err(self.not_mapped()) };
        let allocation = lock(allocation);
        let mapped = allocation.mapped_slice().ok_or_else(|| self.not_mapped())?;
        bytes.copy_from_slice(&mapped[..bytes.len()]);
        Ok(())
    }

    fn not_mapped(&self) -> Error {
        Error::Internal(format!("buffer `{}` is not visible to the host", self.inner.name))
    }
}

impl Drop for Inner {
    fn drop(&mut self) {
        let device = &self.gpu.device;
        // SAFETY: recordings hold clones of the buffers they use, so no submit in flight needs this one; null handles
        // are ignored; nothing else destroys them.
        unsafe {
            if let Some(view) = self.texel_view {
                device.destroy_buffer_view(view, None);
            }
            device.destroy_buffer(self.raw, None);
        }
        match std::mem::replace(&mut self.backing, Backing::None) {
            Backing::None => {}
            // SAFETY: the memory was allocated for this buffer alone, which is destroyed.
            Backing::Own(memory) => unsafe { device.free_memory(memory, None) },
            Backing::Block(allocation) => {
                let allocation = allocation.into_inner().unwrap_or_else(PoisonError::into_inner);
                if let Err(e) = lock(&self.gpu.allocator).free(allocation) {
                    tracing::error!(target: "vulkan", "freeing `{}`: {e}", self.name);
                }
            }
        }
        self.gpu.release(self.bytes);
        self.gpu.untrack();
    }
}
