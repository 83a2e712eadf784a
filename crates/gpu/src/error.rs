//! Errors of Vulkan compute.

/// Result of every fallible function of this crate.
pub type Result<T> = std::result::Result<T, Error>;

/// Error of Vulkan compute: its cause and the object that it concerns.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// No suitable Vulkan device was found.
    #[error("no usable Vulkan device: {0}")]
    NoDevice(String),
    /// A Vulkan call failed.
    #[error("Vulkan: {call} failed for {object}: {code}")]
    Vulkan {
        /// Name of the Vulkan entry point.
        call: &'static str,
        /// Debug name of the object or pass.
        object: String,
        /// The code the driver returned.
        code: ash::vk::Result,
    },
    /// The device was lost.
    #[error("the Vulkan device was lost during {pass}")]
    DeviceLost {
        /// The submit that was in flight.
        pass: String,
    },
    /// Memory ran out.
    #[error("out of memory: {object} needs {bytes} bytes ({detail})")]
    OutOfMemory {
        /// Debug name of the buffer.
        object: String,
        /// Requested size.
        bytes: u64,
        /// The allocator's message.
        detail: String,
        /// Whether it may succeed later, because only other programs hold the memory and no limit is exceeded.
        may_pass: bool,
    },
    /// A description of an adopted device claims a feature that the device cannot have.
    #[error("{field} = {value}: {problem}")]
    Claim {
        /// Field of the description.
        field: &'static str,
        /// Its value.
        value: bool,
        /// The contradiction, and the accepted values.
        problem: String,
    },
    /// An internal invariant was violated, which is a fault of the caller's program.
    #[error("internal fault: {0}")]
    Internal(String),
}

impl Error {
    /// Returns a function that wraps a Vulkan code with the call and the object it concerned.
    pub(crate) fn vulkan(call: &'static str, object: impl Into<String>) -> impl FnOnce(ash::vk::Result) -> Self {
        let object = object.into();
        move |code| match code {
            ash::vk::Result::ERROR_DEVICE_LOST => Error::DeviceLost { pass: object },
            ash::vk::Result::ERROR_OUT_OF_DEVICE_MEMORY | ash::vk::Result::ERROR_OUT_OF_HOST_MEMORY => {
                Error::OutOfMemory { object, bytes: 0, detail: format!("{call}: {code}"), may_pass: true }
            }
            code => Error::Vulkan { call, object, code },
        }
    }
}
