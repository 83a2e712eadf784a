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
        if matches!(event, Event::Preparing { .. }) {
            return Ok(());
        }
        let line = serde_json::to_string(event).map_err(|e| Error::Internal(e.to_string()))? + "\n";
        self.file.write_all(line.as_bytes()).map_err(Error::io("append to", &self.path))
    }
}
