//! Memory that other processes and APIs import through file descriptors. Only Unix has it; other systems return an
//! error.

use nertca_vk::error::Result;
use nertca_vk::gpu::buffer::Buffer;
use nertca_vk::gpu::device::Gpu;

#[cfg(unix)]
mod system {
    use super::{Buffer, Gpu, Result};
    use nertca_vk::error::Error;
    use nertca_vk::gpu::buffer::ExportedMemory;
    use std::os::fd::{AsFd, IntoRawFd};

    /// Memory of a buffer, for import by others.
    pub struct Memory(ExportedMemory);

    pub fn make(gpu: &Gpu, bytes: u64) -> Result<(Buffer, Memory)> {
        let (buffer, memory) = gpu.exported_buffer("shared buffer", bytes)?;
        Ok((buffer, Memory(memory)))
    }

    impl Memory {
        /// Returns a new descriptor of the memory, which the caller owns.
        pub fn descriptor(&self) -> Result<i32> {
            let copy = self.0.descriptor.as_fd().try_clone_to_owned();
            Ok(copy.map_err(Error::io("duplicate the descriptor of", "a shared buffer"))?.into_raw_fd())
        }

        /// Returns the index of the memory's type, and the size of the allocation in bytes.
        pub fn type_and_bytes(&self) -> (u32, u64) {
            (self.0.memory_type, self.0.allocated_bytes)
        }
    }
}

#[cfg(not(unix))]
mod system {
    use super::{Buffer, Gpu, Result};
    use nertca_vk::error::Error;

    /// This type has no values: such memory does not exist here.
    pub enum Memory {}

    pub fn make(_: &Gpu, _: u64) -> Result<(Buffer, Memory)> {
        Err(Error::NoDevice("memory is shared through file descriptors, which this system does not support".into()))
    }

    impl Memory {
        pub fn descriptor(&self) -> Result<i32> {
            match *self {}
        }

        pub fn type_and_bytes(&self) -> (u32, u64) {
            match *self {}
        }
    }
}

pub(super) use system::{Memory, make};
