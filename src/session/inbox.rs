//! Frames of a session, as they came.

use crate::config::{Config, DynamicTarget};
use crate::error::{Error, Result};
use crate::geometry::{Geometry, MM_PER_UNIT};
use crate::scan::canvas::onto_canvas;
use crate::scan::dataset::{Dataset, Frame, Layout, Split, View};
use crate::scan::frame_checks::{Complaint, check_phase, check_values, checked_view};
use crate::scan::gating::{BeatScaling, BeatTime, RPeaks};
use std::collections::BTreeMap;
use std::path::PathBuf;

/// Options of a session.
#[derive(Debug, Clone)]
pub struct SessionOptions {
    /// Hyper-parameters.
    pub config: Config,
    /// Cardiac phases; 1 for a still object.
    pub phases: u32,
    /// Attenuation is searched within this distance before and behind the isocentre plane, mm.
    pub depth_half_extent_mm: f64,
    /// Attenuation of contrast-filled vessels, 1/mm, where known; a fifth of it is the Dice threshold.
    pub vessel_attenuation_per_mm: Option<f64>,
    /// Whether the object is at rest: frames of phase 0 show it, and those of phase 1 the same without vessels, of two phases.
    pub still: bool,
    /// Refuse frames while training in the background, so that results never depend on timing.
    pub deterministic: bool,
}

/// When a frame was taken.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum FrameTime {
    /// At a known cardiac phase, from 0.
    Phase(u32),
    /// At a known time of the beat, which may lie between two phases.
    Beat(BeatTime),
    /// At a time in seconds, on the clock of the R-peaks.
    TimeS(f64),
}

/// A calibrated angiogram.
#[derive(Debug, Clone)]
pub struct NewFrame {
    /// Geometry by which it was taken.
    pub geometry: Geometry,
    /// Moment at which it was taken.
    pub moment: FrameTime,
    /// Whether to train on it, or to score with it.
    pub split: Split,
    /// Columns.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// Line integrals, rows first.
    pub integrals: Vec<f32>,
    /// Vessel mask, where known.
    pub mask: Option<Vec<bool>>,
}

fn bad(field: &str, value: String, problem: String) -> Error {
    Error::config(format!("frame: {field}"), value, problem)
}

fn told(complaint: Complaint) -> Error {
    bad(&complaint.field, complaint.value, complaint.problem)
}

/// Checked frames, and how they are to be used.
pub(super) struct Inbox {
    pub(super) options: SessionOptions,
    pub(super) views: Vec<View>,
    pub(super) frames: Vec<(Frame, FrameTime)>,
    pub(super) r_peaks: Option<RPeaks>,
}

impl Inbox {
    pub(super) fn add(&mut self, new: NewFrame) -> Result<()> {
        let pixels = new.width.checked_mul(new.height).filter(|n| *n > 0);
        if pixels != Some(new.integrals.len()) || new.mask.as_ref().is_some_and(|m| Some(m.len()) != pixels) {
            let size = format!("{} x {}", new.width, new.height);
            return Err(bad("size", size, "does not agree with the number of pixels, or with that of the mask".into()));
        }
        check_values(&new.integrals, new.width).map_err(told)?;
        match new.moment {
            FrameTime::Phase(phase) => check_phase(phase.into(), self.options.phases).map_err(told)?,
            FrameTime::Beat(BeatTime { after_phase, .. }) if !(-0.5..=0.5).contains(&after_phase) => {
                return Err(bad(
                    "time",
                    after_phase.to_string(),
                    "is out of range: -0.5 to 0.5 phases after the nearest phase are accepted".into(),
                ));
            }
            FrameTime::Beat(taken) => check_phase(taken.phase.into(), self.options.phases).map_err(told)?,
            FrameTime::TimeS(time) if !time.is_finite() => {
                return Err(bad("time", time.to_string(), "is not a time in seconds".into()));
            }
            FrameTime::TimeS(_) => (),
        }
        let view = self.view(new.geometry, [new.width, new.height])?;
        let frame = Frame {
            name: format!("frame-{}", self.frames.len()),
            view,
            phase: if let FrameTime::Phase(phase) = new.moment { phase } else { 0 },
            split: new.split,
            integrals: new.integrals,
            mask: new.mask,
            after_phase: 0.0,
            heart_shift_mm: [0.0; 3],
        };
        self.frames.push((frame, new.moment));
        Ok(())
    }

    /// States another geometry for a frame, counted from 0 as they were added.
    pub(super) fn set_geometry(&mut self, index: usize, geometry: Geometry) -> Result<()> {
        let size = self.views[self.frame(index)?.0.view].size;
        self.frames[index].0.view = self.view(geometry, size)?;
        Ok(())
    }

    /// A frame, counted from 0 as they were added.
    pub(super) fn frame(&self, index: usize) -> Result<&(Frame, FrameTime)> {
        let none = || {
            Error::config(
                "frame",
                index,
                format!("there is no such frame: {} were added, and they are counted from 0", self.frames.len()),
            )
        };
        self.frames.get(index).ok_or_else(none)
    }

    /// Index of the view of images of `size` (columns, rows), which is new unless an earlier frame was taken from there.
    fn view(&mut self, geometry: Geometry, size: [usize; 2]) -> Result<usize> {
        if let Some(known) = self.views.iter().position(|v| v.geometry == geometry && v.size == size) {
            return Ok(known);
        }
        let depth_before = self.options.depth_half_extent_mm / MM_PER_UNIT;
        self.views.push(checked_view(geometry, size, depth_before).map_err(told)?);
        Ok(self.views.len() - 1)
    }

    /// Returns the time in the beat of a moment, where that is known.
    pub(super) fn beat_time(&self, moment: FrameTime) -> Option<BeatTime> {
        match (moment, &self.r_peaks) {
            (FrameTime::Phase(phase), _) => Some(BeatTime::at_phase(phase)),
            (FrameTime::Beat(taken), _) => Some(taken),
            (FrameTime::TimeS(time), Some(peaks)) => peaks.beat_time(time, self.options.phases, BeatScaling::default()),
            (FrameTime::TimeS(_), None) => None,
        }
    }

    /// The frames whose phase is known and that `keep` wants.
    pub(super) fn dataset(&self, keep: impl Fn(&Frame, &[Frame]) -> bool) -> Result<Dataset> {
        let known: Vec<Frame> = self
            .frames
            .iter()
            .filter_map(|(frame, moment)| {
                let BeatTime { phase, after_phase } = self.beat_time(*moment)?;
                Some(Frame { phase, after_phase, ..frame.clone() })
            })
            .collect();
        let mut frames: Vec<Frame> = known.iter().filter(|f| keep(f, &known)).cloned().collect();
        frames.sort_by_key(|f| f.split);
        let Some([width, height]) = onto_canvas(&self.views, &mut frames).map_err(told)? else {
            let n = self.frames.len();
            return Err(Error::NotReady(format!(
                "none of {n} frames can be used: a frame needs a phase, or a time stamp and R-peaks, and its view \
                 needs frames of two phases"
            )));
        };
        let half = self.options.depth_half_extent_mm / MM_PER_UNIT;
        let mut dataset = Dataset {
            path: PathBuf::from("session"),
            layout: Layout::Native,
            views: self.views.clone(),
            frames,
            hidden: BTreeMap::new(),
            width,
            height,
            n_phases: self.options.phases,
            depth_range: (-half, half),
            vessel_attenuation: self.options.vessel_attenuation_per_mm.map(|a| a * MM_PER_UNIT),
            still: self.options.still,
            notes: Vec::new(),
        };
        dataset.hide();
        Ok(dataset)
    }

    /// The training frames: with a temporal target, those of views seen at two phases or more.
    pub(super) fn training_dataset(&self) -> Result<Dataset> {
        let temporal = self.options.config.loss.dynamic_target == DynamicTarget::Temporal;
        let dataset = self.dataset(|frame, known| {
            let beats = |f: &&Frame| f.view == frame.view && f.split == Split::Train && f.phase != frame.phase;
            frame.split == Split::Train && (!temporal || known.iter().any(|f| beats(&f)))
        })?;
        let views = dataset.training_views().len();
        if temporal && views < 2 {
            return Err(Error::NotReady(format!(
                "{views} views have frames of two or more phases, and at least two such views are needed (if the C-arm \
                 turns or the table moves, each frame is a view of its own: use the preset paper, which is trained on \
                 whole images)"
            )));
        }
        Ok(dataset)
    }
}
