//! Lines on stdout, and the first error of writing them.

use nertca_vk::error::{Error, Result};
use std::fmt::Arguments;
use std::io::{ErrorKind, Write as _};
use std::sync::Mutex;

/// First error of writing to stdout. Lines come from callbacks that return nothing, so it is kept until the command ends.
static FAILED: Mutex<Option<std::io::Error>> = Mutex::new(None);

/// Prints a line to stdout. A closed pipe (as with `| head`) is not an error; any other error fails the command in [`finish`].
pub fn print_line(text: Arguments<'_>) {
    if let Err(error) = writeln!(std::io::stdout(), "{text}") {
        keep(error);
    }
}

fn keep(error: std::io::Error) {
    let mut failed = FAILED.lock().unwrap_or_else(|poisoned| poisoned.into_inner());
    if error.kind() != ErrorKind::BrokenPipe && failed.is_none() {
        *failed = Some(error);
    }
}

/// Writes what is still buffered, and returns the first error of writing to stdout.
///
/// # Errors
/// [`Error::Io`].
pub fn finish() -> Result<()> {
    if let Err(error) = std::io::stdout().flush() {
        keep(error);
    }
    let failed = FAILED.lock().unwrap_or_else(|poisoned| poisoned.into_inner()).take();
    failed.map_or(Ok(()), |error| Err(Error::io("write", "standard output")(error)))
}
