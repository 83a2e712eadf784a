//! Exit codes of the program, and hints after an error.

use nertca_vk::error::{Error, SMALLER_BATCHES};
use nertca_vk::files;

/// Exit code for a command or an option that is not usable.
const USAGE: u8 = 2;
/// Exit code when no Vulkan device fits.
const NO_DEVICE: u8 = 3;
/// Exit code for failures that may not occur at a later attempt (`EX_TEMPFAIL`); schedulers use it.
pub const TRY_AGAIN: u8 = 75;
/// Exit code after a stop by Ctrl-C or SIGTERM; the work done is saved.
pub const INTERRUPTED: u8 = 130;

/// Ends the process at once, with the exit code of a stop and without partial files, while other threads still work.
pub fn interrupted() -> ! {
    let _no_writing = files::remove_unfinished();
    #[cfg(unix)]
    // SAFETY: the function takes a number and does not return. It calls no exit handlers, which is why it is called: those of a
    // driver free what the threads of the driver still use, and the process would die of a segmentation fault.
    unsafe {
        libc::_exit(i32::from(INTERRUPTED))
    }
    #[cfg(not(unix))]
    std::process::exit(i32::from(INTERRUPTED))
}

/// Returns the exit code of an error; 1 for errors without a code of their own.
pub fn code(error: &Error) -> u8 {
    match error {
        Error::Config { .. } | Error::Unmet { .. } => USAGE,
        Error::NoDevice(_) => NO_DEVICE,
        Error::DeviceLost { .. } => TRY_AGAIN,
        Error::OutOfMemory { may_pass: true, .. } | Error::Busy(_) => TRY_AGAIN,
        Error::Interrupted => INTERRUPTED,
        _ => 1,
    }
}

/// Returns command-line options to try after an error, where the error itself does not name them.
pub fn hint(error: &Error) -> Option<&'static str> {
    match error {
        Error::DeviceLost { .. } => Some(
            "`train --resume` continues a run from its last checkpoint; --set train.iterations_per_submit=N makes \
             submits smaller, and --device chooses another device",
        ),
        Error::OutOfMemory { instead: SMALLER_BATCHES, .. } => Some(
            "lower values of --set train.chunk_samples=N and --set train.rays=N need less memory, and --device chooses \
             another device",
        ),
        Error::Diverged { .. } => {
            Some("--set key=value changes a setting; `train --print-config` prints the current values")
        }
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn schedulers_can_tell_what_to_try_again() {
        let memory_for = |may_pass, instead| {
            let (object, detail) = ("rays".into(), String::new());
            Error::OutOfMemory { object, bytes: 1, detail, may_pass, instead }
        };
        let memory = |may_pass| memory_for(may_pass, SMALLER_BATCHES);
        let lost = Error::DeviceLost { pass: "training".into() };
        assert_eq!((code(&lost), code(&memory(true))), (TRY_AGAIN, 75));
        assert_eq!(code(&Error::Busy("another process".into())), TRY_AGAIN);
        assert_eq!(code(&memory(false)), 1, "a limit of the device stays where it is");
        assert_eq!(code(&Error::config("phase", 77, "")), USAGE);
        assert!(hint(&lost).is_some_and(|hint| hint.contains("--resume")));
        assert!(hint(&memory(true)).is_some_and(|hint| hint.contains("train.rays")));
        assert_eq!(hint(&memory_for(true, "fewer fields")), None, "rays would not help");
    }
}
