//! Memory that a training takes, asked for before it begins: drivers crash where they are refused memory later; and memory that it has
//! freed, returned to the system.

use nertca_vk::error::{Error, Result};

/// Address space that a training takes on a CPU driver with small images, bytes.
const ROOM_FOR_TRAINING: usize = 1 << 30;

/// Checks that the address space that every training takes can be had, such as below a limit of the process.
///
/// # Errors
/// [`Error::OutOfMemory`] otherwise.
pub fn room_for_training() -> Result<()> {
    let mut room = Vec::<u8>::new();
    let refused = room.try_reserve_exact(ROOM_FOR_TRAINING);
    // The reservation must not be removed by the compiler as unused.
    std::hint::black_box(room.as_ptr());
    refused.map_err(|error| Error::OutOfMemory {
        object: "a training".into(),
        bytes: ROOM_FOR_TRAINING as u64,
        detail: error.to_string(),
        may_pass: true,
        instead: "a higher limit of the process (ulimit -v)",
    })
}

/// Returns memory that was freed to the system, where the C library keeps it otherwise: images that a run has analysed before it starts leave
/// gaps that later, larger ones do not fit into.
pub fn return_freed() {
    #[cfg(all(target_os = "linux", target_env = "gnu"))]
    // SAFETY: the function may be called at any time, from any thread; it changes no memory that is in use.
    unsafe {
        libc::malloc_trim(0);
    }
}
