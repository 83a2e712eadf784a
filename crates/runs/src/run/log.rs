//! The log of a run.

use crate::error::{Error, Result};
use crate::files;
use crate::run::events::Event;
use std::io::Write;
use std::path::{Path, PathBuf};

/// `metrics.jsonl`, appended line by line. On resume, lines beyond the resumed step are dropped first.
pub(super) struct MetricsLog {
    path: PathBuf,
    file: std::fs::File,
}

impl MetricsLog {
    pub(super) fn open(path: &Path, step: u32) -> Result<MetricsLog> {
        let old = if step == 0 { String::new() } else { std::fs::read_to_string(path).unwrap_or_default() };
        let kept: String = old
            .lines()
            .filter(|line| {
                serde_json::from_str::<serde_json::Value>(line)
                    .is_ok_and(|v| v["step"].as_u64().is_some_and(|s| s <= u64::from(step)))
            })
            .flat_map(|line| [line, "\n"])
            .collect();
        files::write_atomic(path, kept.as_bytes())?;
        let file = std::fs::OpenOptions::new().append(true).open(path).map_err(Error::io("append to", path))?;
        Ok(MetricsLog { path: path.to_path_buf(), file })
    }

    pub(super) fn write(&mut self, event: &Event) -> Result<()> {
        if matches!(event, Event::Preparing { .. } | Event::Adjusting { .. }) {
            return Ok(());
        }
        if self.is_removed() {
            let problem = "was removed or moved away during the run, so the run cannot be completed: start it again, and leave its \
                           directory in place";
            return Err(Error::data(&self.path, "log", problem));
        }
        let line = serde_json::to_string(event).map_err(|e| Error::Internal(e.to_string()))? + "\n";
        self.file.write_all(line.as_bytes()).map_err(Error::io("append to", &self.path))
    }
    /// Tells whether another file, or none, is where the log was opened: what is written to it, and beside it, would be lost.
    fn is_removed(&self) -> bool {
        #[cfg(unix)]
        let same = {
            use std::os::unix::fs::MetadataExt;
            let id = |found: std::fs::Metadata| (found.dev(), found.ino());
            match (self.file.metadata(), self.path.metadata()) {
                (Ok(written), Ok(there)) => id(written) == id(there),
                _ => false,
            }
        };
        #[cfg(not(unix))]
        let same = self.path.exists();
        !same
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_log_whose_directory_is_gone_is_an_error() {
        let directory = tempfile::tempdir().unwrap();
        let event = Event::Evaluation { images: 0, of: 1, elapsed_s: 0.0, left_s: None };
        for moved in [false, true] {
            let run = directory.path().join("run");
            files::create_directory(&run).unwrap();
            let mut log = MetricsLog::open(&run.join("metrics.jsonl"), 0).unwrap();
            log.write(&event).unwrap();
            if moved {
                std::fs::rename(&run, directory.path().join("elsewhere")).unwrap();
            } else {
                std::fs::remove_dir_all(&run).unwrap();
            }
            let message = log.write(&event).unwrap_err().to_string();
            assert!(message.contains("metrics.jsonl") && message.contains("removed or moved"), "{message}");
            // A checkpoint that was being written makes the directory again, which does not make the run whole.
            files::create_directory(&run).unwrap();
            std::fs::write(run.join("metrics.jsonl"), b"").unwrap();
            assert_eq!(log.write(&event).is_err(), cfg!(unix));
            std::fs::remove_dir_all(&run).unwrap();
        }
    }
}
