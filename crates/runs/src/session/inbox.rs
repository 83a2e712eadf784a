//! Frames of a session, as they came.

use crate::config::Config;
use crate::error::{Error, Result};
use crate::geometry::{Geometry, MM_PER_UNIT};
use crate::methods;
use crate::scan::at_rest;
use crate::scan::canvas::onto_canvas;
use crate::scan::dataset::{Dataset, Frame, Layout, Split, View};
use crate::scan::frame_checks::{Complaint, check_phase, check_values};
use crate::scan::gating::{BeatScaling, BeatTime, RPeaks};
use crate::scan::prior::VesselPrior;
use crate::scan::same_view::{SAME_VIEW_PX, find_or_add};
use std::collections::{BTreeMap, BTreeSet};
use std::path::PathBuf;
use std::sync::Arc;

/// Options of a session.
#[derive(Debug, Clone)]
pub struct SessionOptions {
    /// Hyper-parameters.
    pub config: Config,
    /// Cardiac phases; 1 or 2 for an object at rest, which has two in the session.
    pub phases: u32,
    /// Attenuation is searched within this distance before and behind the isocentre plane, mm.
    pub depth_half_extent_mm: f64,
    /// Attenuation of contrast-filled vessels, 1/mm, where known; a fifth of it is the Dice threshold.
    pub vessel_attenuation_per_mm: Option<f64>,
    /// Whether the object is at rest: frames of phase 0, and frames with a time in seconds, show it, and those of phase 1 the same
    /// without vessels. Phase 1 is estimated for views without a frame of it.
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

/// Use of a frame that was added.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum FrameUse {
    /// Training uses it when it next takes frames in, if there are enough of them.
    Training,
    /// It is kept for scores.
    Validation,
    /// Its phase is not known: its time is not covered by R-peaks.
    NoPhase,
    /// The training frames of its view show one phase only, so nothing in it is known to move.
    OnePhase,
}

/// Properties that a session has found for a frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FrameStatus {
    /// Use of the frame.
    pub usage: FrameUse,
    /// Time in the beat, where it is known.
    pub beat_time: Option<BeatTime>,
    /// View that it belongs to: frames of one size whose geometries agree within a tenth of a pixel have the same number.
    pub view: usize,
    /// Whether the reconstruction was trained with it, as it is now, since training last took frames in.
    pub taken_in: bool,
}

/// A frame as it came.
pub(super) struct Kept {
    pub(super) frame: Frame,
    pub(super) moment: FrameTime,
    /// Rises with every change of the frame.
    pub(super) change: u64,
}

/// Checked frames, and how they are to be used.
pub(super) struct Inbox {
    pub(super) options: SessionOptions,
    pub(super) views: Vec<View>,
    /// Frames in the order in which they were added; none where a frame was removed.
    pub(super) frames: Vec<Option<Kept>>,
    /// Vessels that are known before.
    pub(super) prior: Option<Arc<VesselPrior>>,
    pub(super) r_peaks: Option<RPeaks>,
}

/// Training frames of a session: index, phase, view and change of each.
pub(super) type Taken = Vec<(usize, BeatTime, usize, u64)>;

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
            FrameTime::Beat(BeatTime { after_phase, .. }) if self.options.still && after_phase != 0.0 => {
                let problem = "lies between two phases, which an object at rest does not";
                return Err(bad("time", after_phase.to_string(), problem.into()));
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
            integrals: new.integrals.into(),
            mask: new.mask,
            after_phase: 0.0,
            heart_shift_mm: [0.0; 3],
            contrast: 1.0,
        };
        self.frames.push(Some(Kept { frame, moment: new.moment, change: 0 }));
        Ok(())
    }

    /// Sets another geometry for a frame, or for all frames of its view.
    pub(super) fn set_geometry(&mut self, index: usize, geometry: Geometry, whole_view: bool) -> Result<FrameUse> {
        let before = self.frame(index)?.frame.view;
        let view = self.view(geometry, self.views[before].size)?;
        for (at, kept) in self.frames.iter_mut().enumerate() {
            let Some(kept) = kept else { continue };
            if at == index || whole_view && kept.frame.view == before {
                (kept.frame.view, kept.change) = (view, kept.change + 1);
            }
        }
        self.usage(index)
    }

    /// Removes a frame; the others keep their numbers.
    pub(super) fn remove(&mut self, index: usize) -> Result<()> {
        self.frame(index)?;
        self.frames[index] = None;
        Ok(())
    }

    /// A frame, counted from 0 as they were added.
    pub(super) fn frame(&self, index: usize) -> Result<&Kept> {
        let wrong = |problem: String| Error::config("frame", index, problem);
        match self.frames.get(index) {
            Some(Some(kept)) => Ok(kept),
            Some(None) => Err(wrong("was removed".into())),
            None => Err(wrong(format!(
                "there is no such frame: {} were added, and they are counted from 0",
                self.frames.len()
            ))),
        }
    }

    /// Index of the view of images of `size` (columns, rows), which is new unless an earlier frame was taken from there.
    fn view(&mut self, geometry: Geometry, size: [usize; 2]) -> Result<usize> {
        let depth_before = self.options.depth_half_extent_mm / MM_PER_UNIT;
        find_or_add(&mut self.views, geometry, size, depth_before).map_err(told)
    }

    /// Use of a frame.
    pub(super) fn usage(&self, index: usize) -> Result<FrameUse> {
        let kept = self.frame(index)?;
        Ok(self.usage_of(kept, &self.known_phases()))
    }

    /// Properties of a frame; `taken` are the frames that training took in.
    pub(super) fn status(&self, index: usize, taken: &Taken) -> Result<FrameStatus> {
        let kept = self.frame(index)?;
        let (beat_time, view) = (self.beat_time(kept.moment), kept.frame.view);
        let as_now = |beat_time| (index, beat_time, view, kept.change);
        Ok(FrameStatus {
            usage: self.usage(index)?,
            beat_time,
            view,
            taken_in: beat_time.is_some_and(|beat_time| taken.contains(&as_now(beat_time))),
        })
    }

    /// Phases at which training frames show each view.
    fn known_phases(&self) -> BTreeMap<usize, BTreeSet<u32>> {
        let mut known: BTreeMap<usize, BTreeSet<u32>> = BTreeMap::new();
        for kept in self.frames.iter().flatten().filter(|kept| kept.frame.split == Split::Train) {
            if let Some(taken) = self.beat_time(kept.moment) {
                known.entry(kept.frame.view).or_default().insert(taken.phase);
            }
        }
        if self.options.still {
            // The other phase is estimated from the first.
            known
                .values_mut()
                .filter(|phases| phases.contains(&0))
                .for_each(|phases| phases.extend(0..at_rest::PHASES));
        }
        known
    }

    fn usage_of(&self, kept: &Kept, known_phases: &BTreeMap<usize, BTreeSet<u32>>) -> FrameUse {
        let phases = known_phases.get(&kept.frame.view).map_or(0, BTreeSet::len);
        if self.beat_time(kept.moment).is_none() {
            FrameUse::NoPhase
        } else if kept.frame.split == Split::Validation {
            FrameUse::Validation
        } else if self.is_temporal() && phases < 2 {
            FrameUse::OnePhase
        } else {
            FrameUse::Training
        }
    }

    /// Tells whether the dynamic field is found by what changes over the beat, so that a view needs two phases.
    fn is_temporal(&self) -> bool {
        self.options.config.is_temporal()
    }

    /// Returns the time in the beat of a moment, where that is known.
    pub(super) fn beat_time(&self, moment: FrameTime) -> Option<BeatTime> {
        match (moment, &self.r_peaks) {
            (FrameTime::Phase(phase), _) => Some(BeatTime::at_phase(phase)),
            (FrameTime::Beat(taken), _) => Some(taken),
            (FrameTime::TimeS(_), _) if self.options.still => Some(BeatTime::at_phase(0)),
            (FrameTime::TimeS(time), Some(peaks)) => peaks.beat_time(time, self.options.phases, BeatScaling::default()),
            (FrameTime::TimeS(_), None) => None,
        }
    }

    /// The frames that `keep` wants, among those whose phase is known.
    fn dataset(&self, keep: impl Fn(FrameUse) -> bool) -> Result<(Dataset, Taken)> {
        let known_phases = self.known_phases();
        let (mut frames, mut taken) = (Vec::new(), Taken::new());
        for (index, kept) in self.frames.iter().enumerate() {
            let Some(kept) = kept.as_ref().filter(|kept| keep(self.usage_of(kept, &known_phases))) else { continue };
            let Some(beat_time) = self.beat_time(kept.moment) else { continue };
            let BeatTime { phase, after_phase } = beat_time;
            frames.push(Frame { phase, after_phase, ..kept.frame.clone() });
            taken.push((index, beat_time, kept.frame.view, kept.change));
        }
        let mut notes = Vec::new();
        if self.options.still {
            notes.extend(at_rest::add_appearance_without_vessels(&self.views, &mut frames));
        }
        frames.sort_by_key(|f| f.split);
        let Some([width, height]) = onto_canvas(&self.views, &mut frames).map_err(told)? else {
            return Err(Error::NotReady(format!("no frame can be used: {}", self.why_left_out())));
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
            vessels_alone: false,
            views_adjusted: false,
            prior: self.prior.clone(),
            notes,
        };
        dataset.hide();
        Ok((dataset, taken))
    }

    /// All frames whose phase is known, for scores.
    pub(super) fn scored_dataset(&self) -> Result<Dataset> {
        self.dataset(|_| true).map(|(dataset, _)| dataset)
    }

    /// The training frames: with a temporal target, those of views seen at two phases or more.
    pub(super) fn training_dataset(&self) -> Result<(Dataset, Taken)> {
        let (dataset, taken) = self.dataset(|usage| usage == FrameUse::Training)?;
        let views = dataset.training_views().len();
        if self.is_temporal() && views < 2 {
            return Err(Error::NotReady(format!(
                "{views} view has frames of two or more phases, and at least two such views are needed; {}",
                self.why_left_out()
            )));
        }
        Ok((dataset, taken))
    }

    /// Returns the configuration of training while frames may arrive.
    pub(super) fn training_config(&self) -> Config {
        let mut config = self.options.config.clone();
        if let Some(repeats) = methods::of(&config).abilities.repeat_fits {
            // Pictures are wanted while frames arrive, and a mean of fits cannot go on with new ones.
            (repeats.only_one)(&mut config);
        }
        config
    }

    /// Returns the configuration of training after a fit to all frames has ended.
    pub(super) fn refining_config(&self) -> Config {
        self.options.config.clone()
    }

    /// Explains how many training frames are left out and why.
    pub(super) fn why_left_out(&self) -> String {
        let known_phases = self.known_phases();
        let training = || self.frames.iter().flatten().filter(|kept| kept.frame.split == Split::Train);
        let count = |usage| training().filter(|kept| self.usage_of(kept, &known_phases) == usage).count();
        let mut reasons = Vec::new();
        let (without_phase, alone) = (count(FrameUse::NoPhase), count(FrameUse::OnePhase));
        if without_phase > 0 {
            reasons.push(format!("{without_phase} have no phase, because R-peaks do not cover their times"));
        }
        if alone > 0 {
            reasons.push(format!(
                "{alone} belong to views of which training frames show one phase only (frames share a view while their \
                 geometries agree within {SAME_VIEW_PX} pixels; if the C-arm turns or the table moves during a run, use \
                 the preset paper, which is trained on whole images)"
            ));
        }
        let all = training().count();
        if reasons.is_empty() {
            return format!("there are {all} training frames");
        }
        format!("of {all} training frames, {}", reasons.join(", and "))
    }

    /// Tells whether training leaves out frames whose phase is known.
    pub(super) fn leaves_out(&self) -> bool {
        let known_phases = self.known_phases();
        self.frames.iter().flatten().any(|kept| self.usage_of(kept, &known_phases) == FrameUse::OnePhase)
    }
}
