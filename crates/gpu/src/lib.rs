//! Vulkan compute: device, memory, pipelines, recording with derived barriers, sensors. This crate knows nothing of angiography and of
//! the configuration of its callers; its errors name objects and limits of the device, and callers add what can be changed.

pub mod buffer;
pub mod calls;
pub mod capabilities;
pub mod details;
pub mod device;
pub mod error;
pub mod image;
pub mod instance;
mod lock;
pub mod memory;
pub mod pace;
pub mod pipeline;
pub mod record;
#[cfg(unix)]
pub mod semaphore;
pub mod sensors;
pub mod statistics;
mod transfer;
