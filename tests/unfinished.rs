//! The removal of what a process is writing when a signal ends it. Alone in its process, because it removes the partial files of
//! all threads.
#![allow(missing_docs, clippy::unwrap_used)]

use nertca_vk_formats::error::{Error, Result};
use nertca_vk_formats::files::{remove_unfinished, write_atomic, write_atomic_by};
use std::io::Write;
use std::path::Path;
use std::sync::mpsc::channel;
use std::time::Duration;

fn number_of_files(directory: &Path) -> usize {
    std::fs::read_dir(directory).unwrap().count()
}

#[test]
fn nothing_stays_of_an_ended_process() {
    let directory = tempfile::tempdir().unwrap();
    a_file_being_written_is_removed(directory.path());
    nothing_is_begun_or_completed_after_the_removal(directory.path());
}

fn a_file_being_written_is_removed(directory: &Path) {
    let target = directory.join("whole");
    let written = write_atomic_by(&target, |file| -> Result<()> {
        file.write_all(b"half").map_err(Error::io("write", &target))?;
        drop(remove_unfinished());
        Ok(())
    });
    assert!(written.is_err(), "the temporary file is gone");
    assert_eq!(number_of_files(directory), 0);
}

/// Other threads still work between the removal and the end of the process.
fn nothing_is_begun_or_completed_after_the_removal(directory: &Path) {
    let (first, second) = (directory.join("first"), directory.join("second"));
    let (begin, begun) = channel();
    let (go_on, gone_on) = channel::<()>();
    std::thread::scope(|scope| {
        let writer = scope.spawn(move || {
            let completed = write_atomic_by(&first, |_| -> Result<()> {
                begin.send(()).unwrap();
                gone_on.recv().unwrap();
                Ok(())
            });
            (completed, write_atomic(&second, b"whole"))
        });
        begun.recv().unwrap();
        let no_writing = remove_unfinished();
        go_on.send(()).unwrap();
        // The writer may reach the lock in this time or later; nothing may appear in either case.
        std::thread::sleep(Duration::from_millis(50));
        assert_eq!(number_of_files(directory), 0);
        drop(no_writing);
        let (completed, begun_later) = writer.join().unwrap();
        assert!(completed.is_err() && begun_later.is_ok());
    });
    assert_eq!(number_of_files(directory), 1);
}
