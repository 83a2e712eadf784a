//! Memory that cannot be had ends the program with the exit code for failures that may pass, instead of an abort.

use nertca_vk::error::{Error, Result};
use std::alloc::{GlobalAlloc, Layout, System};

/// Address space that a training takes on a CPU driver with small images, bytes: below it, drivers crash where they are refused
/// memory.
const ROOM_FOR_TRAINING: usize = 1 << 30;

/// Ends the program if the address space that every training takes cannot be had.
///
/// # Errors
/// [`Error::OutOfMemory`] where the refusal does not end the program.
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

/// The system's allocator; a request that it refuses ends the program, as nothing could be done without the memory.
struct OrExit;

#[global_allocator]
static MEMORY: OrExit = OrExit;

/// Passes a block of memory on; without one, the program ends.
fn given(block: *mut u8) -> *mut u8 {
    if block.is_null() {
        give_up();
    }
    block
}

/// Says that memory ran out and ends the program, without reserving any.
#[cfg(unix)]
#[cold]
fn give_up() {
    const MESSAGE: &[u8] =
        b"nertca-vk: out of memory: the system refuses more, because of a limit of the process (ulimit -v) or \
        because other programs hold it. What was saved is intact; smaller images need less\n";
    unsafe extern "C" {
        fn write(file: i32, bytes: *const u8, count: usize) -> isize;
        fn _exit(code: i32) -> !;
    }
    // SAFETY: the message lives as long as the program; both functions may be called in any state and reserve no memory.
    unsafe {
        write(2, MESSAGE.as_ptr(), MESSAGE.len());
        _exit(i32::from(crate::exit::TRY_AGAIN));
    }
}

/// Leaves the refusal to the standard library, which aborts.
#[cfg(not(unix))]
fn give_up() {}

// SAFETY: every call is passed on to the system's allocator unchanged, whose promises hold for the blocks that are returned.
unsafe impl GlobalAlloc for OrExit {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        // SAFETY: as for this function.
        given(unsafe { System.alloc(layout) })
    }

    unsafe fn alloc_zeroed(&self, layout: Layout) -> *mut u8 {
        // SAFETY: as for this function.
        given(unsafe { System.alloc_zeroed(layout) })
    }

    unsafe fn realloc(&self, block: *mut u8, layout: Layout, size: usize) -> *mut u8 {
        // SAFETY: as for this function.
        given(unsafe { System.realloc(block, layout, size) })
    }

    unsafe fn dealloc(&self, block: *mut u8, layout: Layout) {
        // SAFETY: as for this function.
        unsafe { System.dealloc(block, layout) }
    }
}
