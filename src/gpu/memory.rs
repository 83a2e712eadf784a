//! Buffers over gpu-allocator: device-local, upload and read-back.

use super::device::{Gpu, Shared, lock};
use super::record::Recording;
use crate::error::{Error, Result};
use ash::vk;
use bytemuck::Pod;
use gpu_allocator::MemoryLocation;
use gpu_allocator::vulkan::{Allocation, AllocationCreateDesc, AllocationScheme};
use std::mem::ManuallyDrop;
use std::sync::{Arc, Mutex};

/// Where a buffer lives.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Memory {
    /// Fast for the device; reached by copies only.
    Device,
    /// Written by the host, read by the device.
    Upload,
    /// Written by the device, read by the host.
    Readback,
}

/// How shaders read a buffer of vec4.
#[derive(Debug, Clone, Copy, PartialEq, Eq, serde::Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Operands {
    /// As a storage buffer.
    Storage,
    /// As a `rgba32f` texel buffer.
    Texel,
    /// Through its address, without bounds checks.
    Address,
}

/// Bytes on the device. Clones share the same memory, freed with the last one.
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

/// Where a buffer's bytes are.
enum Backing {
    /// In a block of the allocator.
    Block(Mutex<ManuallyDrop<Allocation>>),
    /// In memory of its own, which may be exported.
    Own(vk::DeviceMemory),
}

/// Drivers may read a little past the last element when a loop of uniform loads through an address ends (seen with
/// llvmpipe of Mesa 26.2, which crashes without).
const ADDRESS_TAIL_BYTES: u64 = 4096;

/// Copies larger than this go through several staging buffers, to bound host memory.
const STAGING_BYTES: usize = 32 << 20;

impl Gpu {
    /// A buffer of `bytes` bytes, contents undefined.
    ///
    /// # Errors
    /// [`Error::OutOfMemory`] naming the buffer, or [`Error::Config`] beyond the device's limits.
    pub fn buffer(&self, name: &str, bytes: u64, memory: Memory) -> Result<Buffer> {
        self.make_buffer(name, bytes, memory, Operands::Storage)
    }

    /// A device buffer that shaders may, besides as a storage buffer, read as `operands` says.
    ///
    /// # Errors
    /// As [`Gpu::buffer`].
    pub fn operand_buffer(&self, name: &str, bytes: u64, operands: Operands) -> Result<Buffer> {
        let tail = if operands == Operands::Address { ADDRESS_TAIL_BYTES } else { 0 };
        self.make_buffer(name, bytes + tail, Memory::Device, operands)
    }

    /// A device buffer filled with `data`.
    ///
    /// # Errors
    /// As [`Gpu::buffer`], plus errors of the copy.
    pub fn buffer_with<T: Pod>(&self, name: &str, data: &[T]) -> Result<Buffer> {
        let buffer = self.buffer(name, size_of_val(data).max(16) as u64, Memory::Device)?;
        self.upload(&buffer, 0, data)?;
        Ok(buffer)
    }

    fn make_buffer(&self, name: &str, bytes: u64, memory: Memory, operands: Operands) -> Result<Buffer> {
        let shared = &self.shared;
        let bytes = bytes.max(16).next_multiple_of(16);
        let info = self.info();
        let texel = operands == Operands::Texel;
        if bytes > u64::from(info.max_storage_buffer_range) {
            return Err(Error::OutOfMemory {
                object: name.into(),
                bytes,
                detail: format!("one buffer of {} is limited to {} bytes", info.name, info.max_storage_buffer_range),
                may_pass: false,
            });
        }
        if texel && bytes / 16 > u64::from(info.max_texel_buffer_elements) {
            return Err(Error::OutOfMemory {
                object: name.into(),
                bytes,
                detail: format!(
                    "a texel buffer of {} has at most {} elements",
                    info.name, info.max_texel_buffer_elements
                ),
                may_pass: false,
            });
        }
        let mut usage = vk::BufferUsageFlags::STORAGE_BUFFER
            | vk::BufferUsageFlags::INDIRECT_BUFFER
            | vk::BufferUsageFlags::TRANSFER_SRC
            | vk::BufferUsageFlags::TRANSFER_DST;
        if texel {
            usage |= vk::BufferUsageFlags::UNIFORM_TEXEL_BUFFER;
        }
        if operands == Operands::Address {
            usage |= vk::BufferUsageFlags::SHADER_DEVICE_ADDRESS;
        }
        let create = vk::BufferCreateInfo::default().size(bytes).usage(usage);
        // SAFETY: the device is alive and the create info is complete.
        let raw =
            unsafe { shared.device.create_buffer(&create, None) }.map_err(Error::vulkan("vkCreateBuffer", name))?;
        // SAFETY: `raw` was just made.
        let requirements = unsafe { shared.device.get_buffer_memory_requirements(raw) };
        if let Err(e) = shared.reserve(name, bytes) {
            // SAFETY: nothing uses `raw` yet.
            unsafe { shared.device.destroy_buffer(raw, None) };
            return Err(e);
        }
        let allocated = lock(&shared.allocator).allocate(&AllocationCreateDesc {
            name,
            requirements,
            location: match memory {
                Memory::Device => MemoryLocation::GpuOnly,
                Memory::Upload => MemoryLocation::CpuToGpu,
                Memory::Readback => MemoryLocation::GpuToCpu,
            },
            linear: true,
            allocation_scheme: AllocationScheme::GpuAllocatorManaged,
        });
        let allocation = match allocated {
            Ok(allocation) => allocation,
            Err(e) => {
                // SAFETY: nothing uses `raw` yet.
                unsafe { shared.device.destroy_buffer(raw, None) };
                shared.release(bytes);
                return Err(Error::OutOfMemory { object: name.into(), bytes, detail: e.to_string(), may_pass: true });
            }
        };
        let (memory, offset) = {
            // SAFETY: the memory is used for this buffer alone, whose `Inner` gives it back to the allocator.
            (unsafe { allocation.memory() }, allocation.offset())
        };
        shared.set_name(raw, name);
        shared.track();
        // From here on `Inner::drop` cleans up, also when a later step fails.
        let mut inner = Inner {
            gpu: shared.clone(),
            name: name.to_owned(),
            raw,
            texel_view: None,
            bytes,
            backing: Backing::Block(Mutex::new(ManuallyDrop::new(allocation))),
        };
        // SAFETY: memory and offset come from the allocator for exactly these requirements.
        unsafe { shared.device.bind_buffer_memory(raw, memory, offset) }
            .map_err(Error::vulkan("vkBindBufferMemory", name))?;
        if texel {
            let view = vk::BufferViewCreateInfo::default()
                .buffer(raw)
                .format(vk::Format::R32G32B32A32_SFLOAT)
                .range(vk::WHOLE_SIZE);
            // SAFETY: the buffer is bound and was made with texel usage.
            let view = unsafe { shared.device.create_buffer_view(&view, None) }
                .map_err(Error::vulkan("vkCreateBufferView", name))?;
            shared.set_name(view, name);
            inner.texel_view = Some(view);
        }
        Ok(Buffer { inner: Arc::new(inner) })
    }

    /// A device buffer whose memory other processes and APIs can import: an opaque file descriptor of
    /// [`Buffer::bytes`] bytes at offset 0. The descriptor is the caller's to close, or to hand to an import.
    ///
    /// # Errors
    /// [`Error::NoDevice`] where `VK_KHR_external_memory_fd` is missing; [`Error::OutOfMemory`].
    #[cfg(unix)]
    pub fn exported_buffer(&self, name: &str, bytes: u64) -> Result<(Buffer, std::os::fd::OwnedFd)> {
        use std::os::fd::FromRawFd;
        let shared = &self.shared;
        let info = self.info();
        if !info.external_memory_fd {
            return Err(Error::NoDevice(format!("{}: no VK_KHR_external_memory_fd", info.name)));
        }
        let bytes = bytes.max(16).next_multiple_of(16);
        shared.reserve(name, bytes)?;
        shared.track();
        let opaque = vk::ExternalMemoryHandleTypeFlags::OPAQUE_FD;
        let mut external = vk::ExternalMemoryBufferCreateInfo::default().handle_types(opaque);
        let usage = vk::BufferUsageFlags::STORAGE_BUFFER
            | vk::BufferUsageFlags::TRANSFER_SRC
            | vk::BufferUsageFlags::TRANSFER_DST;
        let create = vk::BufferCreateInfo::default().size(bytes).usage(usage).push_next(&mut external);
        // From here on `Inner::drop` cleans up; null handles are ignored by Vulkan's destroy calls.
        let mut inner = Inner {
            gpu: shared.clone(),
            name: name.to_owned(),
            raw: vk::Buffer::null(),
            texel_view: None,
            bytes,
            backing: Backing::Own(vk::DeviceMemory::null()),
        };
        // SAFETY: the device is alive and has the extension.
        inner.raw =
            unsafe { shared.device.create_buffer(&create, None) }.map_err(Error::vulkan("vkCreateBuffer", name))?;
        // SAFETY: the buffer was just made; the physical device is this device's.
        let (requirements, memories) = unsafe {
            (
                shared.device.get_buffer_memory_requirements(inner.raw),
                shared.instance.get_physical_device_memory_properties(shared.physical),
            )
        };
        let kind = (0..memories.memory_type_count)
            .filter(|i| requirements.memory_type_bits >> i & 1 == 1)
            .max_by_key(|i| {
                memories.memory_types[*i as usize].property_flags.contains(vk::MemoryPropertyFlags::DEVICE_LOCAL)
            })
            .ok_or_else(|| Error::NoDevice(format!("{}: no memory can be exported", info.name)))?;
        let mut export = vk::ExportMemoryAllocateInfo::default().handle_types(opaque);
        let mut dedicated = vk::MemoryDedicatedAllocateInfo::default().buffer(inner.raw);
        let allocate = vk::MemoryAllocateInfo::default()
            .allocation_size(requirements.size)
            .memory_type_index(kind)
            .push_next(&mut export)
            .push_next(&mut dedicated);
        // SAFETY: the chain lives until the call returns.
        let memory = unsafe { shared.device.allocate_memory(&allocate, None) }
            .map_err(Error::vulkan("vkAllocateMemory", name))?;
        inner.backing = Backing::Own(memory);
        // SAFETY: size and type fit the buffer, which is bound once.
        unsafe { shared.device.bind_buffer_memory(inner.raw, memory, 0) }
            .map_err(Error::vulkan("vkBindBufferMemory", name))?;
        shared.set_name(inner.raw, name);
        let get = vk::MemoryGetFdInfoKHR::default().memory(memory).handle_type(opaque);
        let export = ash::khr::external_memory_fd::Device::new(&shared.instance, &shared.device);
        // SAFETY: the memory was made exportable; the descriptor is ours, and owned from here on.
        let fd = unsafe {
            let fd = export.get_memory_fd(&get).map_err(Error::vulkan("vkGetMemoryFdKHR", name))?;
            std::os::fd::OwnedFd::from_raw_fd(fd)
        };
        Ok((Buffer { inner: Arc::new(inner) }, fd))
    }

    /// Copies `data` into `buffer` at `offset` bytes and waits.
    ///
    /// # Errors
    /// [`Error::Internal`] when it does not fit; errors of the copy otherwise.
    pub fn upload<T: Pod>(&self, buffer: &Buffer, offset: u64, data: &[T]) -> Result<()> {
        let bytes: &[u8] = bytemuck::cast_slice(data);
        buffer.check_range(offset, bytes.len() as u64)?;
        let mut at = offset;
        for part in bytes.chunks(STAGING_BYTES) {
            let staging = self.buffer("upload staging", part.len() as u64, Memory::Upload)?;
            staging.write(part)?;
            let mut recording = Recording::new(self, "upload")?;
            recording.copy(&staging, 0, buffer, at, part.len() as u64)?;
            self.wait(recording.finish()?.submit()?)?;
            at += part.len() as u64;
        }
        Ok(())
    }

    /// Reads `count` elements at `offset` bytes of `buffer`, waiting for earlier submits.
    ///
    /// # Errors
    /// As [`Gpu::upload`].
    pub fn download<T: Pod>(&self, buffer: &Buffer, offset: u64, count: usize) -> Result<Vec<T>> {
        let mut out = vec![T::zeroed(); count];
        let bytes: &mut [u8] = bytemuck::cast_slice_mut(&mut out);
        buffer.check_range(offset, bytes.len() as u64)?;
        let mut at = offset;
        for part in bytes.chunks_mut(STAGING_BYTES) {
            let staging = self.buffer("download staging", part.len() as u64, Memory::Readback)?;
            let mut recording = Recording::new(self, "download")?;
            recording.copy(buffer, at, &staging, 0, part.len() as u64)?;
            self.wait(recording.finish()?.submit()?)?;
            staging.read(part)?;
            at += part.len() as u64;
        }
        Ok(out)
    }
}

impl Buffer {
    /// Size in bytes (rounded up to 16).
    pub fn bytes(&self) -> u64 {
        self.inner.bytes
    }

    /// Debug name.
    pub fn name(&self) -> &str {
        &self.inner.name
    }

    pub(super) fn raw(&self) -> vk::Buffer {
        self.inner.raw
    }

    /// Where shaders find an [`Operands::Address`] buffer.
    pub(super) fn address(&self) -> u64 {
        let info = vk::BufferDeviceAddressInfo::default().buffer(self.inner.raw);
        // SAFETY: pipelines that ask for addresses exist only on devices with the feature.
        unsafe { self.inner.gpu.device.get_buffer_device_address(&info) }
    }

    pub(super) fn texel_view(&self) -> Option<vk::BufferView> {
        self.inner.texel_view
    }

    /// Refuses a range that is not inside the buffer.
    ///
    /// # Errors
    /// [`Error::Internal`].
    pub fn check_range(&self, offset: u64, bytes: u64) -> Result<()> {
        match offset.checked_add(bytes) {
            Some(end) if end <= self.inner.bytes => Ok(()),
            _ => Err(Error::Internal(format!(
                "{} bytes at {offset} do not fit buffer `{}` of {} bytes",
                bytes, self.inner.name, self.inner.bytes
            ))),
        }
    }

    /// Writes to the start of an [`Memory::Upload`] buffer.
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
    /// As [`Buffer::write`].
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
        Error::Internal(format!("buffer `{}` is not host-visible", self.inner.name))
    }
}

impl Drop for Inner {
    fn drop(&mut self) {
        // SAFETY: recordings hold clones of the buffers they use, so no submit in flight needs this one;
        // the allocation is taken exactly once, here.
        unsafe {
            if let Some(view) = self.texel_view {
                self.gpu.device.destroy_buffer_view(view, None);
            }
            self.gpu.device.destroy_buffer(self.raw, None);
            match &self.backing {
                Backing::Own(memory) => self.gpu.device.free_memory(*memory, None),
                Backing::Block(allocation) => {
                    let allocation = ManuallyDrop::take(&mut *lock(allocation));
                    if let Err(e) = lock(&self.gpu.allocator).free(allocation) {
                        tracing::error!(target: "vulkan", "freeing `{}`: {e}", self.name);
                    }
                }
            }
        }
        self.gpu.release(self.bytes);
        self.gpu.untrack();
    }
}
