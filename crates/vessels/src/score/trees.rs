//! Agreement of a vessel tree with the true one, over the beat (see `docs/formats.md`).

use crate::calibrate::gauge::RigidMotion;
use crate::error::{Error, Result};
use crate::geometry::{MM_PER_UNIT, ViewRays, world_from_lps_mm};
use crate::scan::dataset::{Dataset, Frame, Split};
use crate::scan::gating::BeatTime;
use crate::scan::truth::Truth;
use crate::score::calibrated::{TrueFrames, shift_of, true_rays};
use crate::score::dice::mean;
use crate::score::lesions::LesionScores;
use crate::score::nearest::{LinePlace, Lines};
use crate::score::shapes::WITHIN_MM;
use crate::trees::tree::{BeatTree, EXISTS_WITHIN_MM, PhaseTree};
use glam::{DVec2, DVec3};
use rayon::prelude::*;
use serde::Serialize;

/// Distance of the points at which lines are compared, mm: below the resolution of images.
const STEP_MM: f64 = 0.25;

/// A true vessel at one moment.
#[derive(Debug, Clone)]
pub struct TrueLine {
    /// Points, LPS mm; point i is the same material point at every moment.
    pub points_mm: Vec<DVec3>,
    /// Radius of the lumen at each point, mm.
    pub radius_mm: Vec<f64>,
}

/// Scores of one phase, or their means. Distances are from points of one centreline to the nearest point of the other.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct TreeAgreement {
    /// Share of the true centreline with the reconstructed one within [`WITHIN_MM`].
    pub true_centreline_found: f64,
    /// Share of the reconstructed centreline with a true one within [`WITHIN_MM`].
    pub our_centreline_true: f64,
    /// Mean distance of the reconstructed centreline to the true one, mm.
    pub ours_to_true_mm: f64,
    /// Mean of the reconstructed radius minus the true one, where the reconstructed centreline counts as true, mm.
    pub radius_error_mm: Option<f64>,
    /// Root mean square of the radius error, where the reconstructed centreline counts as true, mm.
    pub radius_rmse_mm: Option<f64>,
    /// Number of connected trees of the reconstruction.
    pub components: f64,
    /// Mean distance of the reconstructed centreline to the true one in the training images, mm at the isocentre.
    pub reprojection_training_mm: Option<f64>,
    /// Mean distance of the centrelines in images of views that were not trained on, mm at the isocentre.
    pub reprojection_unseen_mm: Option<f64>,
    /// Share of the reconstructed centreline whose true place is within the interval of its doubt, 0 to 1; `None` where doubt is not
    /// stated.
    pub within_doubt: Option<f64>,
    /// Share of the reconstructed centreline that exists by the rule of [`EXISTS_WITHIN_MM`], minus the mean probability stated.
    pub existence_error: Option<f64>,
    /// Mean error of the displacement of the reconstructed points since the reference phase, against the nearest true
    /// points, mm; only where points are followed, and not for the reference phase itself.
    pub motion_error_mm: Option<f64>,
}

/// Scores of one phase.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct PhaseTreeScores {
    /// Cardiac phase, from 0.
    pub phase: u32,
    /// Scores of the phase.
    #[serde(flatten)]
    pub scores: TreeAgreement,
}

/// Scores of a tree over the beat.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct TreeScores {
    /// Maximum distance at which centrelines count as one vessel, mm.
    pub within_mm: f64,
    /// Means over the phases that have a value.
    pub mean: TreeAgreement,
    /// Means without the motion of the reconstruction, where that motion was applied to the truth.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub mean_as_stated: Option<TreeAgreement>,
    /// One row per phase.
    pub phases: Vec<PhaseTreeScores>,
    /// Scores of the stenoses; `None` where the true ones are not known.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub lesions: Option<LesionScores>,
}

/// Scores a tree. `truth` returns the true vessels at a moment of the beat, which goes from 0 to the dataset's number of
/// phases. The dataset has the geometry used by the reconstruction, with its unseen views in the frame of the
/// reconstruction. Where the true acquisition `taken` is known, the true vessels are projected by it. Where the
/// reconstruction is `carried` against the truth, the motion is applied to the true vessels before the comparison in 3D.
///
/// # Errors
/// [`Error::Data`] for a truth without vessels.
pub fn score(
    beat: &BeatTree,
    dataset: &Dataset,
    taken: Option<&Truth>,
    carried: Option<&RigidMotion>,
    truth: impl Fn(f64) -> Vec<TrueLine> + Sync,
) -> Result<TreeScores> {
    let images = Images { dataset, truth: taken.map(|taken| TrueFrames::new(taken, dataset)) };
    let true_at = |phase: u32| {
        let mut lines = truth(f64::from(phase));
        if let Some(motion) = carried {
            let carry = motion.patient_mm(phase as usize);
            lines.iter_mut().flat_map(|line| &mut line.points_mm).for_each(|p| *p = carry.transform_point3(*p));
        }
        lines
    };
    let rest = true_at(beat.reference_phase.unwrap_or(0));
    if rest.iter().all(|line| line.points_mm.len() < 2) {
        return Err(Error::data(&dataset.path, "true tree", "has no line"));
    }
    let first = beat.phases.iter().find(|tree| Some(tree.phase) == beat.reference_phase);
    let phases = beat.phases.par_iter().map(|tree| -> Result<PhaseTreeScores> {
        let now = true_at(tree.phase);
        let mut scores = agreement(tree, &now);
        scores.reprojection_training_mm = images.reprojection_mm(beat, tree, Split::Train, &truth)?;
        scores.reprojection_unseen_mm = images.reprojection_mm(beat, tree, Split::Validation, &truth)?;
        // The reference phase has no motion by definition and would bias the mean to lower values.
        let first = first.filter(|first| first.phase != tree.phase);
        scores.motion_error_mm = first.and_then(|first| motion_error_mm([first, tree], [&rest, &now]));
        Ok(PhaseTreeScores { phase: tree.phase, scores })
    });
    let phases = phases.collect::<Result<Vec<PhaseTreeScores>>>()?;
    Ok(TreeScores { within_mm: WITHIN_MM, mean: means(&phases), mean_as_stated: None, phases, lesions: None })
}

fn means(phases: &[PhaseTreeScores]) -> TreeAgreement {
    let some = |pick: fn(&TreeAgreement) -> Option<f64>| mean(phases.iter().filter_map(|p| pick(&p.scores)));
    let all = |pick: fn(&TreeAgreement) -> f64| mean(phases.iter().map(|p| pick(&p.scores))).unwrap_or(f64::NAN);
    TreeAgreement {
        true_centreline_found: all(|s| s.true_centreline_found),
        our_centreline_true: all(|s| s.our_centreline_true),
        ours_to_true_mm: all(|s| s.ours_to_true_mm),
        radius_error_mm: some(|s| s.radius_error_mm),
        radius_rmse_mm: some(|s| s.radius_rmse_mm),
        components: all(|s| s.components),
        reprojection_training_mm: some(|s| s.reprojection_training_mm),
        reprojection_unseen_mm: some(|s| s.reprojection_unseen_mm),
        within_doubt: some(|s| s.within_doubt),
        existence_error: some(|s| s.existence_error),
        motion_error_mm: some(|s| s.motion_error_mm),
    }
}

/// A mean, weighted by lengths.
#[derive(Default)]
struct Along {
    length_mm: f64,
    sum: f64,
}

impl Along {
    fn add(&mut self, length_mm: f64, value: f64) {
        self.length_mm += length_mm;
        self.sum += length_mm * value;
    }

    /// Returns the mean; `None` where the length is zero.
    fn mean(&self) -> Option<f64> {
        (self.length_mm > 0.0).then(|| self.sum / self.length_mm)
    }
}

fn is_near(away_mm: f64) -> f64 {
    f64::from(u8::from(away_mm <= WITHIN_MM))
}

/// Places on lines at most [`STEP_MM`] apart, and the length that each represents, mm.
fn finely(lines: &[&[DVec3]]) -> Vec<(LinePlace, f64)> {
    let of_line = |(line, points): (usize, &&[DVec3])| {
        let steps = points.windows(2).enumerate().flat_map(move |(from, ends)| {
            let length = ends[0].distance(ends[1]);
            let n = (length / STEP_MM).ceil().max(1.0);
            (0..n as usize).map(move |i| (LinePlace { line, from, share: (i as f64 + 0.5) / n }, length / n))
        });
        steps.collect::<Vec<_>>()
    };
    lines.iter().enumerate().flat_map(of_line).collect()
}

fn ours(tree: &PhaseTree) -> Vec<&[DVec3]> {
    tree.branches.iter().map(|branch| &branch.points_mm[..]).collect()
}

/// Reconstructed lines as in an image taken near the phase of `tree`: where points are followed, linearly interpolated
/// towards the next phase.
fn shown(beat: &BeatTree, tree: &PhaseTree, taken: BeatTime, n_phases: u32) -> Vec<Vec<DVec3>> {
    let next = BeatTime { phase: tree.phase, ..taken }.beyond(n_phases);
    let beyond = beat.phases.iter().find(|t| beat.reference_phase.is_some() && t.phase == next);
    let (here, there, share) = (ours(tree), beyond.map_or_else(|| ours(tree), ours), taken.after_phase.abs());
    let between = |(a, b): (&[DVec3], &[DVec3])| a.iter().zip(b).map(|(a, b)| a.lerp(*b, share)).collect();
    here.into_iter().zip(there).map(between).collect()
}

fn true_points(lines: &[TrueLine]) -> Vec<&[DVec3]> {
    lines.iter().map(|line| &line.points_mm[..]).collect()
}

fn agreement(tree: &PhaseTree, truth: &[TrueLine]) -> TreeAgreement {
    let (our_lines, true_lines) = (ours(tree), true_points(truth));
    let (near_ours, near_truth) = (Lines::new(&our_lines), Lines::new(&true_lines));
    let mut found = Along::default();
    for (at, length) in finely(&true_lines) {
        found.add(length, is_near(near_ours.nearest(at.on(true_lines[at.line], DVec3::lerp)).0));
    }
    let mix = |a: f64, b: f64, share: f64| a + share * (b - a);
    let [mut to_true, mut near, mut error, mut squared, mut within, mut exists] = [(); 6].map(|()| Along::default());
    for (at, length) in finely(&our_lines) {
        let point = at.on(our_lines[at.line], DVec3::lerp);
        let (away, there) = near_truth.nearest(point);
        let doubt = tree.branches[at.line].doubt.get(at.from + usize::from(at.share > 0.5));
        if let Some((doubt, there)) = doubt.zip(there) {
            let off_mm = (there.on(true_lines[there.line], DVec3::lerp) - point).dot(doubt.direction).abs();
            within.add(length, f64::from(u8::from(off_mm <= doubt.across_mm)));
            exists.add(length, f64::from(u8::from(away <= EXISTS_WITHIN_MM)) - doubt.existence);
        }
        to_true.add(length, away);
        near.add(length, is_near(away));
        if let Some(there) = there.filter(|_| away <= WITHIN_MM) {
            let (ours, truth) = (&tree.branches[at.line].radius_mm, &truth[there.line].radius_mm);
            let wider = at.on(ours, mix) - there.on(truth, mix);
            error.add(length, wider);
            squared.add(length, wider * wider);
        }
    }
    TreeAgreement {
        true_centreline_found: found.mean().unwrap_or(f64::NAN),
        our_centreline_true: near.mean().unwrap_or(f64::NAN),
        ours_to_true_mm: to_true.mean().unwrap_or(f64::NAN),
        radius_error_mm: error.mean(),
        radius_rmse_mm: squared.mean().map(f64::sqrt),
        components: tree.components() as f64,
        reprojection_training_mm: None,
        reprojection_unseen_mm: None,
        within_doubt: within.mean(),
        existence_error: exists.mean(),
        motion_error_mm: None,
    }
}

/// Mean motion error of the reconstructed points between two phases, against the true points nearest to them at the first.
fn motion_error_mm([first, now]: [&PhaseTree; 2], [true_first, true_now]: [&[TrueLine]; 2]) -> Option<f64> {
    let (rest, moved) = (ours(first), ours(now));
    let (true_rest, true_moved) = (true_points(true_first), true_points(true_now));
    let beside = Lines::new(&true_rest);
    let mut error = Along::default();
    for (at, length) in finely(&rest) {
        let begin = at.on(rest[at.line], DVec3::lerp);
        let (away, there) = beside.nearest(begin);
        let Some(there) = there.filter(|_| away <= WITHIN_MM) else { continue };
        let way = at.on(moved[at.line], DVec3::lerp) - begin;
        let true_way = there.on(true_moved[there.line], DVec3::lerp) - there.on(true_rest[there.line], DVec3::lerp);
        error.add(length, way.distance(true_way));
    }
    error.mean()
}

/// Geometry of the images: that of the reconstruction and the true one.
struct Images<'a> {
    dataset: &'a Dataset,
    truth: Option<TrueFrames<'a>>,
}

/// Rays of the reconstruction and of the truth in one image, and its moment of the beat.
struct Image {
    rays: ViewRays,
    true_rays: ViewRays,
    moment: f64,
}

impl Images<'_> {
    /// Returns the geometry of a frame; `None` for a frame that is not in `truth.json`.
    fn image(&self, frame: &Frame) -> Result<Option<Image>> {
        let rays = self.dataset.heart_rays(frame);
        let Some(truth) = &self.truth else {
            return Ok(Some(Image {
                true_rays: rays.clone(),
                rays,
                moment: frame.beat_time().phases(self.dataset.n_phases),
            }));
        };
        let Some(was) = truth.of(frame) else { return Ok(None) };
        let true_rays = true_rays(was, frame.view, self.dataset)?.moved(shift_of(was));
        Ok(Some(Image { rays, true_rays, moment: was.beat_phase }))
    }

    /// Mean reprojection error over the images of a phase; `None` without images.
    fn reprojection_mm(
        &self,
        beat: &BeatTree,
        tree: &PhaseTree,
        split: Split,
        truth: impl Fn(f64) -> Vec<TrueLine>,
    ) -> Result<Option<f64>> {
        let frames = self.dataset.frames.iter().filter(|frame| frame.phase == tree.phase && frame.split == split);
        let error_mm = |frame: &Frame| -> Result<Option<f64>> {
            let Some(image) = self.image(frame)? else { return Ok(None) };
            let pixel_mm = image.rays.anchor[1].length() * MM_PER_UNIT;
            let seen = |rays: &ViewRays, line: &[DVec3]| -> Option<Vec<DVec3>> {
                let place = |point: &DVec3| {
                    rays.project(world_from_lps_mm(*point)).map(|(i, j)| DVec2::new(i, j).extend(0.0) * pixel_mm)
                };
                line.iter().map(place).collect()
            };
            let lines =
                |rays: &ViewRays, all: &[&[DVec3]]| all.iter().filter_map(|l| seen(rays, l)).collect::<Vec<_>>();
            let ours = shown(beat, tree, frame.beat_time(), self.dataset.n_phases);
            let our_lines = lines(&image.rays, &ours.iter().map(|line| &line[..]).collect::<Vec<_>>());
            let true_lines = lines(&image.true_rays, &true_points(&truth(image.moment)));
            let (our_lines, true_lines): (Vec<&[DVec3]>, Vec<&[DVec3]>) =
                (our_lines.iter().map(|l| &l[..]).collect(), true_lines.iter().map(|l| &l[..]).collect());
            let (mut away, seen) = (Along::default(), Lines::new(&true_lines));
            for (at, length) in finely(&our_lines) {
                away.add(length, seen.nearest(at.on(our_lines[at.line], DVec3::lerp)).0);
            }
            Ok(away.mean())
        };
        let errors_mm = frames.filter_map(|frame| error_mm(frame).transpose()).collect::<Result<Vec<f64>>>()?;
        Ok(mean(errors_mm.into_iter()))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::trees::tree::{Branch, RadiiFrom};

    fn beat(reference_phase: Option<u32>) -> BeatTree {
        let line = |phase: u32| (0..3).map(|i| DVec3::new(f64::from(i), f64::from(phase * phase), 0.0)).collect();
        let branch = |phase| Branch {
            parent: None,
            points_mm: line(phase),
            radius_mm: vec![1.0; 3],
            agreement: Vec::new(),
            doubt: Vec::new(),
            gap_mm: 0.0,
        };
        let phases = (0..4).map(|phase| PhaseTree { phase, branches: vec![branch(phase)] }).collect();
        BeatTree {
            reference_phase,
            threshold_per_mm: 0.1,
            resolution_mm: 1.0,
            spacing_mm: 1.0,
            views: Vec::new(),
            phases,
            vessel_per_mm: None,
            radii_from: RadiiFrom::Field,
            measured_mm: Vec::new(),
        }
    }

    #[test]
    fn images_between_two_phases_show_what_is_between() {
        let height = |beat: &BeatTree, phase: u32, after_phase: f64| {
            let taken = BeatTime { phase, after_phase };
            shown(beat, &beat.phases[phase as usize], taken, 4)[0][1].y
        };
        let followed = beat(Some(0));
        assert_eq!(height(&followed, 2, 0.0), 4.0);
        assert_eq!(height(&followed, 2, 0.4), 4.0 + 0.4 * 5.0);
        assert_eq!(height(&followed, 2, -0.5), 2.5);
        assert_eq!((height(&followed, 3, 0.25), height(&followed, 0, -0.25)), (6.75, 2.25), "the beat closes");
        assert_eq!(height(&beat(None), 2, 0.4), 4.0, "nothing joins phases that have trees of their own");
    }
}
