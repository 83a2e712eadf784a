//! Self-calibration: makes inconsistent views consistent with each other, from the angiograms alone (method, robustness of
//! geometry).
//!
//! The change over the beat in one view must add up, in every plane through both sources, to the change in another view
//! ([`profiles`]). Gauss-Newton on the difference ([`solve`], with the unknowns and priors of [`estimate`]) finds two angles
//! and a translation per view and, where the heart breathes, a displacement of the heart per frame. The component that no
//! image determines is removed ([`gauge`]), and a correction is kept only if it predicts phases it was not fitted to ([`choose`]).

pub mod adjustment;
pub mod choose;
pub mod correction;
pub mod estimate;
pub mod gauge;
pub mod observed;
pub mod pose;
pub mod profiles;
pub mod runs;
#[cfg(test)]
pub(crate) mod samples;
pub mod settings;
mod sight;
pub mod silhouettes;
pub mod solve;

use crate::error::{Error, Result};
use crate::geometry::{MM_PER_UNIT, lps_mm_from_world};
use crate::scan::canvas::corner;
use crate::scan::dataset::Dataset;
use adjustment::Adjusted;
use choose::{Correction, Tags, Validated, best, fit, validate};
use correction::{Calibration, FrameCorrection, ViewCorrection};
use estimate::{ACROSS_MM, ANGLE_DEG, DEPTH_MM, HEART_MM};
use gauge::{FrameRays, RigidMotion, common_motion, frame_rays, heart_points};
use glam::DVec3;
use observed::Observed;
use pose::Poses;
use profiles::Planes;
use settings::{CalibrateMode, CalibrateSettings};

/// Corrections beyond this many standard deviations of the expected errors are rejected.
const BOUND: f64 = 4.0;
/// Corrections that leave at most this share of the squared residual of planes to which they were not fitted are accepted beyond the bound.
/// Six right ones of a phantom with wrong tags leave .13 to .22, a wrong one behind blades (4.2 pixels of error) left .63.
const EXPLAINS: f64 = 0.5;
/// Changes over the beat below this share of the images' range are rounding errors.
pub(crate) const MIN_CHANGE: f64 = 1e-5;

/// Calibrates the training views of a dataset as the settings ask.
///
/// # Errors
/// [`Error::Config`] when breathing is requested for a method that takes corrections per view only, such as a dynamic
/// network.
pub fn calibrate(dataset: &Dataset, settings: CalibrateSettings) -> Result<Calibration> {
    let CalibrateSettings { mode, follows_breath } = settings;
    if mode == CalibrateMode::Off {
        return Ok(Calibration::none(None));
    }
    if mode == CalibrateMode::Breathing && !follows_breath {
        let problem =
            "the method of the preset supports corrections per view only: choose static, or the preset `fast`";
        return Err(Error::config("calibrate.mode", "breathing", problem));
    }
    let observed = Observed::new(dataset);
    if let Some(why) = nothing_to_tell(dataset, &observed) {
        return Ok(Calibration::none(Some(format!("the views are not calibrated: {why}"))));
    }
    let mut notes = Vec::new();
    let cut: Vec<usize> = observed.cut_off().into_iter().map(|slot| observed.views[slot]).collect();
    if !cut.is_empty() {
        notes.push(format!(
            "vessels are cut off at the border of views {cut:?}, so parts that other views show are missing there: a \
             correction is accepted only if the views agree clearly better with it"
        ));
    }
    if mode == CalibrateMode::Auto && !follows_breath && !dataset.still {
        notes.push("the network supports corrections per view only, so breathing is not corrected".into());
    }
    let candidates = candidates(mode, follows_breath && !dataset.still);
    Ok(Calibrator { dataset, observed: &observed, notes }.choose(&candidates))
}

/// Returns a calibration after an adjustment of its views: with the adjusted poses where they were accepted, and the record.
///
/// # Errors
/// [`Error::Internal`] when the adjustment belongs to other views.
pub fn adjusted(dataset: &Dataset, calibration: Calibration, adjusted: Adjusted) -> Result<Calibration> {
    let Adjusted { views, poses, record } = adjusted;
    let mut notes = vec![record.describe()];
    if !record.accepted {
        notes.splice(0..0, calibration.notes);
        return Ok(Calibration { adjustment: Some(record), notes, ..calibration });
    }
    let observed = Observed::new(dataset);
    if observed.views != views {
        return Err(Error::Internal("views were adjusted that are not calibrated".into()));
    }
    let calibrator = Calibrator { dataset, observed: &observed, notes };
    let described = calibrator.described(Correction::Breathing, &poses, None, calibration.tried);
    Ok(Calibration { adjustment: Some(record), ..described })
}

/// Vessel pixels of a view at one phase, and the part that the other views explain before and after a correction.
pub struct Silhouettes {
    /// Index into the dataset's views.
    pub view: usize,
    /// Cardiac phase.
    pub phase: u32,
    /// Columns of the images.
    pub width: usize,
    /// Images above the static background.
    pub seen: Vec<f32>,
    /// Pixels that show vessels.
    pub shown: Vec<bool>,
    /// Vessel pixels that the other views explain, before and after the correction.
    pub explained: [Vec<bool>; 2],
}

/// Returns the silhouettes of each training view at the phase that shows the most vessel pixels.
pub fn silhouettes(dataset: &Dataset, corrected: &Dataset) -> Vec<Silhouettes> {
    let before = Observed::new(dataset);
    let (after, heart) = before.by_geometry_of(corrected);
    let stated = Poses::stated(before.views.len(), before.n_phases());
    let displaced = Poses { heart, ..stated.clone() };
    let of_view = |slot: usize| {
        let (size, canvas_width) = (before.sizes[slot], before.fine.views[slot].size[0]);
        let count = |t: &usize| before.shown[slot][*t].iter().flatten().filter(|s| **s).count();
        let phase = (0..before.n_phases()).max_by_key(count)?;
        Some(Silhouettes {
            view: before.views[slot],
            phase: phase as u32,
            width: size[0],
            seen: corner(before.seen[slot][phase].as_ref()?, canvas_width, size),
            shown: corner(before.shown[slot][phase].as_ref()?, canvas_width, size),
            explained: [
                corner(&silhouettes::explained_pixels(&before, &stated, slot, phase)?, canvas_width, size),
                corner(&silhouettes::explained_pixels(&after, &displaced, slot, phase)?, canvas_width, size),
            ],
        })
    };
    (0..before.views.len()).filter_map(of_view).collect()
}

/// Returns the reason why the agreement of the views cannot be determined, if there is one.
fn nothing_to_tell(dataset: &Dataset, observed: &Observed) -> Option<String> {
    if dataset.heart_shifts() {
        return Some("the dataset already states displacements of the heart for its frames".into());
    }
    let n = observed.views.len();
    if n < 2 {
        return Some(format!(
            "{n} training views show two phases, and at least two such views are needed for a comparison"
        ));
    }
    if observed.fine.pairs.is_empty() {
        return Some(
            "all views look along the same line, so no two views have planes in common that can be compared".into(),
        );
    }
    (observed.change < MIN_CHANGE).then(|| "there is no motion in the images: all phases look the same".into())
}

/// Returns the corrections to try, the smallest first.
fn candidates(mode: CalibrateMode, breathes: bool) -> Vec<Correction> {
    match mode {
        CalibrateMode::Off => vec![Correction::Stated],
        CalibrateMode::Static => vec![Correction::Stated, Correction::Static],
        CalibrateMode::Breathing => vec![Correction::Stated, Correction::Breathing],
        CalibrateMode::Auto if breathes => vec![Correction::Stated, Correction::Static, Correction::Breathing],
        CalibrateMode::Auto => vec![Correction::Stated, Correction::Static],
    }
}

struct Calibrator<'a> {
    dataset: &'a Dataset,
    observed: &'a Observed,
    notes: Vec<String>,
}

impl Calibrator<'_> {
    fn choose(mut self, candidates: &[Correction]) -> Calibration {
        let tried: Vec<Validated> = candidates.iter().map(|c| validate(self.observed, *c, Tags::Usual)).collect();
        let residuals: Vec<f64> = tried.iter().map(|t| t.residual).collect();
        let gain = if self.observed.cut_off().is_empty() { choose::MIN_GAIN } else { choose::LARGE_GAIN };
        let chosen = best(&residuals, gain);
        let (mut correction, mut tags, mut validated) = (candidates[chosen], Tags::Usual, &tried[chosen]);
        let shares: Vec<_> = candidates.iter().copied().zip(residuals.iter().map(|r| r.sqrt())).collect();
        let wrong_tags = validate(self.observed, Correction::Static, Tags::Wrong);
        if candidates.len() > 1 && best(&[validated.residual, wrong_tags.residual], choose::LARGE_GAIN) == 1 {
            (correction, tags, validated) = (Correction::Static, Tags::Wrong, &wrong_tags);
            self.notes.push(format!(
                "some tags of the views are wrong by far more than usual: positions that allow for it leave {:.1} % of the profiles",
                100.0 * wrong_tags.residual.sqrt()
            ));
        }
        if correction == Correction::Stated {
            self.notes.push(format!(
                "the views agree with the stated geometry: a correction does not reduce the residual of planes to which it \
                 was not fitted ({})",
                in_words(&shares)
            ));
            return Calibration { tried: shares, notes: self.notes, ..Calibration::none(None) };
        }
        let explains = validated.residual <= EXPLAINS * residuals[0];
        let poses = fit(self.observed, correction, tags, Planes::All);
        if let Some(what) = out_of_bounds(self.observed, &poses).filter(|_| !explains) {
            self.notes.push(format!(
                "the views disagree, but the correction that was found is too large to be plausible ({what}), so the \
                 stated geometry is kept. Check the orientation of the images, the signs of the angles and the phases"
            ));
            return Calibration { tried: shares, notes: self.notes, ..Calibration::none(None) };
        }
        let [even, odd] = &validated.halves;
        let repeatability = 0.5 * self.distance_px(even, odd);
        self.described(correction, &poses, Some(repeatability), shares)
    }

    /// Describes poses as corrections of the views and frames.
    fn described(
        self,
        correction: Correction,
        poses: &Poses,
        repeatability_px: Option<f64>,
        tried: Vec<(Correction, f64)>,
    ) -> Calibration {
        let stated = self.stated();
        let moved = self.motion(&stated, poses);
        let disagreement_px = self.distance_px(&stated, poses);
        let view = |slot: usize| self.view(slot, poses, &moved);
        let views: Vec<ViewCorrection> = (0..self.observed.views.len()).map(view).collect();
        let frames = if correction == Correction::Breathing { self.frames(poses) } else { Vec::new() };
        let mut calibration = Calibration {
            correction,
            views,
            frames,
            disagreement_px,
            repeatability_px,
            tried,
            explained: self.explained(poses),
            explained_by_chance: Some(silhouettes::explained_by_chance(self.observed, poses)),
            adjustment: None,
            notes: self.notes,
        };
        calibration.describe();
        calibration
    }

    fn view(&self, slot: usize, poses: &Poses, moved: &RigidMotion) -> ViewCorrection {
        let view = self.observed.views[slot];
        let pose = &poses.views[slot];
        let stated = self.dataset.views[view].geometry.clone();
        let residual = |poses: &Poses| {
            let mut views = self.observed.fine.clone();
            views.pairs.retain(|p| p.views.contains(&slot));
            choose::misfit(&views, poses, Planes::All).share()
        };
        let before = self.stated();
        let frames = frame_rays(&self.observed.stands, slot..slot + 1, [&before, poses]);
        ViewCorrection {
            view,
            primary_deg: pose.angles_deg[0],
            secondary_deg: pose.angles_deg[1],
            table_mm: lps_mm_from_world(pose.shift).to_array(),
            moved_px: moved.remainder_px(&frames, &self.points()),
            residual_before: residual(&before),
            residual_after: residual(poses),
            corrected: stated.corrected(pose.angles_deg, pose.shift),
            stated,
        }
    }

    fn frames(&self, poses: &Poses) -> Vec<FrameCorrection> {
        let of_view = |slot: usize| {
            let phases = &self.observed.fine.views[slot].phases;
            let seen = (0..phases.len()).filter(|t| phases[*t].is_some());
            seen.map(move |t| FrameCorrection {
                view: self.observed.views[slot],
                phase: t as u32,
                heart_shift_mm: (poses.heart[slot][t] * MM_PER_UNIT).to_array(),
                contrast: 1.0 + poses.gains[slot][t],
            })
        };
        (0..self.observed.views.len()).flat_map(of_view).collect()
    }

    /// Points that represent the heart.
    fn points(&self) -> Vec<DVec3> {
        heart_points(&self.observed.stands[0].rays, self.observed.sizes[0])
    }

    /// Rays of all frames at two sets of poses, in binned pixels.
    fn frame_rays(&self, poses: [&Poses; 2]) -> Vec<FrameRays> {
        frame_rays(&self.observed.stands, 0..self.observed.stands.len(), poses)
    }

    /// Shares of the vessel pixels that the other views explain, as stated and at poses.
    fn explained(&self, poses: &Poses) -> [f64; 2] {
        [&self.stated(), poses].map(|poses| silhouettes::explained(self.observed, poses))
    }

    /// Poses without corrections.
    fn stated(&self) -> Poses {
        Poses::stated(self.observed.views.len(), self.observed.n_phases())
    }

    /// Motion common to all views from one set of poses to another.
    fn motion(&self, a: &Poses, b: &Poses) -> RigidMotion {
        let breathes = [a, b].iter().any(|p| p.heart.iter().flatten().any(|s| *s != DVec3::ZERO));
        common_motion(&self.frame_rays([a, b]), &self.points(), self.observed.n_phases(), breathes)
    }

    /// Root mean square distance between the images of the heart at two sets of poses, without the motion common to all
    /// views, in the dataset's pixels.
    fn distance_px(&self, a: &Poses, b: &Poses) -> f64 {
        let frames = self.frame_rays([a, b]);
        self.motion(a, b).remainder_px(&frames, &self.points()) * self.observed.factor as f64
    }
}

/// Names the first correction that exceeds the accepted bounds.
fn out_of_bounds(observed: &Observed, poses: &Poses) -> Option<String> {
    for (slot, pose) in poses.views.iter().enumerate() {
        let view = observed.views[slot];
        let axes = observed.stands[slot].axes();
        let along = |k: usize| (pose.shift.dot(axes.col(k)) * MM_PER_UNIT).abs();
        let angle = pose.angles_deg[0].abs().max(pose.angles_deg[1].abs());
        if angle.is_nan() || angle > BOUND * ANGLE_DEG {
            return Some(format!("view {view} turns by {angle:.1} deg"));
        }
        let (across, depth) = (along(0).max(along(1)), along(2));
        if across.is_nan() || across > BOUND * ACROSS_MM || depth.is_nan() || depth > BOUND * DEPTH_MM {
            return Some(format!("view {view} moves by {:.1} mm", across.max(depth)));
        }
        for (phase, shift) in poses.heart[slot].iter().enumerate() {
            let far = |k: usize| (shift[k] * MM_PER_UNIT).abs() > BOUND * HEART_MM[k];
            if (0..3).any(far) || !shift.is_finite() {
                return Some(format!(
                    "the heart moves by {:.1} mm in view {view}, phase {phase}",
                    shift.length() * MM_PER_UNIT
                ));
            }
        }
    }
    None
}

fn in_words(tried: &[(Correction, f64)]) -> String {
    let name = |c: &Correction| match c {
        Correction::Stated => "as stated",
        Correction::Static => "static",
        Correction::Breathing => "breathing",
    };
    let each: Vec<String> = tried.iter().map(|(c, r)| format!("{} {:.1} %", name(c), 100.0 * r)).collect();
    format!("residual: {}", each.join(", "))
}

impl Calibration {
    /// Adds a description of the correction, view by view, to the notes.
    fn describe(&mut self) {
        let known = self.repeatability_px.map_or(String::new(), |px| format!(", repeatable to {px:.2} px"));
        let kind = match self.correction {
            Correction::Breathing => "positions of views and breathing of each frame",
            _ => "positions of views",
        };
        let lengths = self.frames.iter().map(|f| DVec3::from_array(f.heart_shift_mm).length());
        let breath = lengths.fold(0.0, f64::max);
        let breath = if breath > 0.0 {
            format!(", the heart is displaced by up to {breath:.1} mm from its mean position")
        } else {
            String::new()
        };
        self.notes.push(format!(
            "the views disagree by {:.2} px; corrected: {kind}{known}{breath} ({})",
            self.disagreement_px,
            in_words(&self.tried)
        ));
        for v in &self.views {
            let [l, p, s] = v.table_mm;
            self.notes.push(format!(
                "view {}: {:+.2} deg primary, {:+.2} deg secondary, patient {l:+.2} {p:+.2} {s:+.2} mm (left, posterior, \
                 superior)",
                v.view, v.primary_deg, v.secondary_deg
            ));
        }
    }
}
