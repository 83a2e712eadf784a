//! Lines on stdout and stderr, and the first error of writing to stdout.

use nertca_vk::error::{Error, Result};
use std::borrow::Cow;
use std::fmt::Arguments;
use std::io::{ErrorKind, IsTerminal as _, Write as _};
use std::sync::Mutex;

/// First error of writing to stdout. Lines come from callbacks that return nothing, so it is kept until the command ends.
static FAILED: Mutex<Option<std::io::Error>> = Mutex::new(None);

/// Prints a line to stdout. A closed pipe (as with `| head`) is not an error; any other error fails the command in [`finish`].
pub fn print_line(text: Arguments<'_>) {
    let mut stdout = std::io::stdout();
    let written = match stdout.is_terminal() {
        true => writeln!(stdout, "{}", printable(&text.to_string())),
        false => writeln!(stdout, "{text}"),
    };
    if let Err(error) = written {
        keep(error);
    }
}

/// Prints a message to stderr. That it cannot be written is no error: there is nobody to tell.
pub fn print_message(text: Arguments<'_>) {
    let _ = writeln!(std::io::stderr(), "{}", printable(&text.to_string()));
}

/// Escapes control characters other than line ends and tabs, because names of files and texts in files, which others chose, must
/// not reach a terminal as commands.
pub fn printable(text: &str) -> Cow<'_, str> {
    let is_command = |c: char| c.is_control() && !matches!(c, '\n' | '\t');
    if !text.contains(is_command) {
        return Cow::Borrowed(text);
    }
    let escaped = |c: char| if is_command(c) { c.escape_default().to_string() } else { c.to_string() };
    Cow::Owned(text.chars().map(escaped).collect())
}

/// Keeps the first error of writing to stdout for [`finish`]; a closed pipe is none.
pub fn keep(error: std::io::Error) {
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn commands_to_a_terminal_are_shown_as_text() {
        assert_eq!(printable("lat\u{e9}ral\n\tview"), "lat\u{e9}ral\n\tview");
        assert_eq!(printable("a\u{1b}[2Jb\r\u{9b}c"), "a\\u{1b}[2Jb\\r\\u{9b}c");
    }
}
