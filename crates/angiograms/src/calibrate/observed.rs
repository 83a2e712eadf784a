//! The evidence of moving vessels in the angiograms, as far as the self-calibration needs it.

use crate::calibrate::pose::StatedView;
use crate::calibrate::profiles::{Moving, Views};
use crate::evidence::ratios::ViewEvidence;
use crate::evidence::series::Series;
use crate::raster::{percentile, widened};
use crate::scan::dataset::{Dataset, Frame, View};
use glam::DVec3;
use rayon::prelude::*;

/// Number of pixels that longer sides are binned to, approximately.
const SIDE: usize = 128;
/// Minimum side of a view's binned images, pixels.
const MIN_SIDE: usize = 32;
/// Log-likelihood ratio of "a vessel is here" from which, at any phase, a pixel takes part; near the maximum of a single
/// view.
const LIKELY: f32 = 2.0;
/// Margin around the pixels that take part, pixels: tight masks bias noisy data. Chosen on the data sets of the blurs in `choose.rs`.
const MASK_MARGIN: usize = 2;
/// Minimum change of a pixel that visibly shows a vessel, as a share of the strongest change.
const SHOWN_SHARE: f32 = 0.15;
/// Width of the border, pixels.
const BORDER: usize = 2;
/// Share of a view's change at the border above which the image cuts vessels off.
const CUT_OFF: f64 = 0.02;
/// Changes at the border up to this many standard deviations of the noise do not count as vessels.
const CLEAR: f32 = 4.0;

/// The training views that show at least two phases.
#[derive(Debug, Clone)]
pub struct Observed {
    /// Indices into [`Dataset::views`].
    pub views: Vec<usize>,
    /// Geometry of each view.
    pub stands: Vec<StatedView>,
    /// Pixels of the dataset along the side of one binned pixel.
    pub factor: usize,
    /// Positive differences from the static background, for the coarse stages.
    pub coarse: Views,
    /// Differences of either sign from the static background, for the fine stages.
    pub fine: Views,
    /// `[view][phase]`: images above the static background. All images are on the canvas of the dataset's images.
    pub seen: Vec<Vec<Option<Vec<f32>>>>,
    /// `[view][phase]`: pixels that show vessels.
    pub shown: Vec<Vec<Option<Vec<bool>>>>,
    /// `[view]`: pixels that show the patient.
    pub visible: Vec<Vec<bool>>,
    /// `[view]`: columns and rows of its images.
    pub sizes: Vec<[usize; 2]>,
    /// Strongest change over the beat of any view, as a share of the range of its line integrals.
    pub change: f64,
    /// Strongest change over the beat of each view, as a share of the range of its line integrals.
    pub changes: Vec<f64>,
    /// Median noise of each view's binned pixels, as a share of its strongest change; infinite where nothing changes.
    pub noise: Vec<f64>,
    /// Size of the wide motion that was removed from each view, as a share of the strongest change.
    pub wide_motion: Vec<Option<f64>>,
    /// Share of each view's change that lies at the border of its images.
    pub at_border: Vec<f64>,
}

/// Averages `factor` x `factor` pixels.
fn binned(values: &[f32], width: usize, factor: usize) -> Vec<f32> {
    let (w, h) = (width / factor, values.len() / width / factor);
    let scale = 1.0 / (factor * factor) as f32;
    let mut out = vec![0.0; w * h];
    for y in 0..h * factor {
        for x in 0..w * factor {
            out[y / factor * w + x / factor] += values[y * width + x] * scale;
        }
    }
    out
}

/// Binned pixels that are partly hidden.
fn binned_hidden(hidden: &[bool], width: usize, factor: usize) -> Vec<bool> {
    let values: Vec<f32> = hidden.iter().map(|h| f32::from(u8::from(*h))).collect();
    binned(&values, width, factor).iter().map(|share| *share > 0.0).collect()
}

/// Number of pixels along one binned pixel that makes the training images about [`SIDE`] wide, and none too small.
fn factor(dataset: &Dataset) -> usize {
    let sides = || dataset.training_views().into_iter().flat_map(|view| dataset.views[view].size);
    let (min, max) = (sides().min().unwrap_or(0), sides().max().unwrap_or(0));
    ((max as f64 / SIDE as f64).round() as usize).min(min / MIN_SIDE).max(1)
}

/// Returns the training images of each view with at least two phases, binned as for [`Observed`].
pub(crate) fn binned_series(dataset: &Dataset) -> Vec<Series> {
    Series::of(&coarsened(dataset, factor(dataset)))
}

/// Returns the training frames of a dataset, binned as for [`Observed`].
pub fn coarsened_for_calibration(dataset: &Dataset) -> Dataset {
    coarsened(dataset, factor(dataset))
}

/// Returns the training frames of a dataset, binned as far as the smaller side of each image keeps `min_side` pixels.
pub fn binned_to(dataset: &Dataset, min_side: usize) -> Dataset {
    let sides = dataset.training_views().into_iter().flat_map(|view| dataset.views[view].size);
    coarsened(dataset, (sides.min().unwrap_or(0) / min_side).max(1))
}

/// Bins the training frames.
fn coarsened(dataset: &Dataset, factor: usize) -> Dataset {
    let frame =
        |f: &Frame| Frame { integrals: binned(&f.integrals, dataset.width, factor).into(), mask: None, ..f.clone() };
    let mut coarse = Dataset {
        frames: dataset.training().par_iter().map(frame).collect(),
        hidden: dataset.hidden.iter().map(|(v, h)| (*v, binned_hidden(h, dataset.width, factor))).collect(),
        width: dataset.width / factor,
        height: dataset.height / factor,
        views: dataset.views.clone(),
        path: dataset.path.clone(),
        notes: Vec::new(),
        prior: dataset.prior.clone(),
        ..*dataset
    };
    for view in &mut coarse.views {
        *view = View {
            geometry: view.geometry.clone(),
            size: view.size.map(|n| n / factor),
            rays: view.rays.binned(factor),
        };
    }
    coarse
}

/// Evidence of one view.
struct ObservedView {
    stand: StatedView,
    /// Pixels that change.
    mask: Vec<bool>,
    /// Pixels that change, with a margin.
    wide_mask: Vec<bool>,
    /// `[phase]`: image above the static background.
    above: Vec<Option<Vec<f32>>>,
    /// `[phase]`: pixels that show vessels.
    shown: Vec<Option<Vec<bool>>>,
    /// Pixels that show the patient.
    visible: Vec<bool>,
    noise: Vec<f32>,
    /// Median noise as a share of the strongest change.
    noise_share: f64,
    wide_motion: Option<f64>,
    change: f64,
    at_border: f64,
}

/// `[phase]`: pixels that are likely to show a vessel and change clearly; a moving heart or diaphragm is wider.
fn shown(evidence: &ViewEvidence) -> Vec<Option<Vec<bool>>> {
    let min = SHOWN_SHARE * evidence.background.strongest;
    let phases = evidence.ratios.iter().zip(&evidence.background.changes).map(|(ratio, change)| {
        let pixels = ratio.as_ref()?.values.iter().zip(&change.as_ref()?.values);
        Some(pixels.map(|(ratio, change)| *ratio > LIKELY && *change > min).collect())
    });
    phases.collect()
}

impl ObservedView {
    fn new(data: &Dataset, series: &Series) -> ObservedView {
        let evidence = ViewEvidence::new(series).on_canvas(data.canvas());
        let level = &evidence.background.level.values;
        let visible: Vec<bool> = (0..data.n_pixels()).map(|p| data.shows(series.view, p)).collect();
        let likely = |p: usize| visible[p] && evidence.ratios.iter().flatten().any(|r| r.values[p] > LIKELY);
        let mask: Vec<bool> = (0..data.n_pixels()).map(likely).collect();
        let mut wide_mask = widened(&mask, [data.width, data.height], MASK_MARGIN);
        wide_mask.iter_mut().zip(&visible).for_each(|(m, v)| *m &= *v);
        let above = evidence.background.stilled.images.iter().map(|image| {
            let values = &image.as_ref()?.values;
            Some(values.iter().zip(level).map(|(y, b)| y - b).collect::<Vec<f32>>())
        });
        let above: Vec<_> = above.collect();
        let view = &data.views[series.view];
        let mut shown = shown(&evidence);
        for pixels in shown.iter_mut().flatten() {
            pixels.iter_mut().zip(&visible).for_each(|(s, v)| *s &= *v);
        }
        let stand = StatedView::new(&view.geometry, &view.rays);
        let values = series.seen().flat_map(|image| &image.values);
        let [min, max] = values.fold([f32::MAX, f32::MIN], |[l, m], v| [l.min(*v), m.max(*v)]);
        let change = f64::from(evidence.background.strongest) / f64::from(max - min).max(f64::MIN_POSITIVE);
        let strongest = f64::from(evidence.background.strongest);
        let wide_motion = evidence.background.drift.size().map(f64::from);
        let noise = evidence.background.noise.values;
        let typical = f64::from(percentile(&noise, 0.5));
        let noise_share = if strongest > 0.0 { typical / strongest } else { f64::INFINITY };
        let at_border = 0.0;
        let mut seen = ObservedView {
            stand,
            mask,
            wide_mask,
            above,
            shown,
            visible,
            noise,
            noise_share,
            wide_motion,
            change,
            at_border,
        };
        seen.at_border = seen.share_at_border(&border(&seen.visible, [data.width, data.height]));
        seen
    }

    fn share_at_border(&self, border: &[bool]) -> f64 {
        let clear = |p: usize| CLEAR * self.noise[p];
        let change = |p: usize| -> f64 {
            self.above.iter().flatten().map(|y| y[p]).filter(|y| *y > clear(p)).map(f64::from).sum()
        };
        let (mut all, mut beside) = (f64::MIN_POSITIVE, 0.0);
        for p in (0..self.mask.len()).filter(|p| self.mask[*p]) {
            all += change(p);
            beside += if border[p] { change(p) } else { 0.0 };
        }
        beside / all
    }
}

/// Pixels next to those that a view does not show: beyond the edges of its images, or hidden.
fn border(visible: &[bool], [width, height]: [usize; 2]) -> Vec<bool> {
    let hidden: Vec<bool> = visible.iter().map(|v| !v).collect();
    let beside = widened(&hidden, [width, height], BORDER);
    let at_edge = |p: usize| (p % width).min(p / width).min(width - 1 - p % width).min(height - 1 - p / width) < BORDER;
    (0..visible.len()).map(|p| at_edge(p) || beside[p]).collect()
}

impl Observed {
    /// Analyses a dataset.
    pub fn new(dataset: &Dataset) -> Observed {
        let factor = factor(dataset);
        let data = coarsened(dataset, factor);
        let size = [data.width, data.height];
        let n_phases = data.n_phases as usize;
        let series = Series::of(&data);
        let seen: Vec<ObservedView> = series.par_iter().map(|s| ObservedView::new(&data, s)).collect();
        let positive = |s: &ObservedView| {
            let above = s.above.iter().map(|y| Some(y.as_ref()?.iter().map(|v| v.max(0.0)).collect()));
            Moving::new(s.stand.clone(), size, &s.mask, &above.collect::<Vec<_>>())
        };
        let signed = |s: &ObservedView| Moving::new(s.stand.clone(), size, &s.wide_mask, &s.above);
        let views = |all: Vec<Moving>| Views { vessels_alone: dataset.vessels_alone, ..Views::new(all, n_phases) };
        Observed {
            views: series.iter().map(|s| s.view).collect(),
            coarse: views(seen.iter().map(positive).collect()),
            fine: views(seen.iter().map(signed).collect()),
            change: seen.iter().map(|s| s.change).fold(0.0, f64::max),
            changes: seen.iter().map(|s| s.change).collect(),
            noise: seen.iter().map(|s| s.noise_share).collect(),
            wide_motion: seen.iter().map(|s| s.wide_motion).collect(),
            at_border: seen.iter().map(|s| s.at_border).collect(),
            sizes: series.iter().map(|s| data.views[s.view].size).collect(),
            stands: seen.iter().map(|s| s.stand.clone()).collect(),
            seen: seen.iter().map(|s| s.above.clone()).collect(),
            visible: seen.iter().map(|s| s.visible.clone()).collect(),
            shown: seen.into_iter().map(|s| s.shown).collect(),
            factor,
        }
    }

    /// Indices into [`Observed::views`] of the views whose vessels are cut off by the image or by its hidden part.
    pub fn cut_off(&self) -> Vec<usize> {
        (0..self.views.len()).filter(|slot| self.at_border[*slot] > CUT_OFF).collect()
    }

    /// Returns the images with the geometry of another dataset, and its displacements of the heart, `[view][phase]` in
    /// world units.
    pub fn by_geometry_of(&self, dataset: &Dataset) -> (Observed, Vec<Vec<DVec3>>) {
        let mut other = self.clone();
        for (stand, view) in other.stands.iter_mut().zip(&self.views) {
            let view = &dataset.views[*view];
            *stand = StatedView::new(&view.geometry, &view.rays.binned(self.factor));
        }
        let shift = |view: usize, t: usize| {
            let frame = dataset.training().iter().find(|f| f.view == view && f.phase as usize == t);
            frame.map_or(DVec3::ZERO, Frame::heart_shift)
        };
        let shifts = |view: &usize| (0..self.n_phases()).map(|t| shift(*view, t)).collect();
        let heart = self.views.iter().map(shifts).collect();
        (other, heart)
    }

    /// Number of phases that a view has, by its index among the observed ones.
    pub fn phases_of(&self, slot: usize) -> usize {
        self.fine.views[slot].phases.iter().flatten().count()
    }

    /// Number of cardiac phases.
    pub fn n_phases(&self) -> usize {
        self.fine.n_phases
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scan::small::small_dataset;
    use glam::DVec3;

    #[test]
    fn binned_images_show_the_same_places() {
        // The smaller side has 12 pixels: bins of 3 keep 4 of them, and leave out the last column and row.
        let mut fine = small_dataset(13, 12, 3).unwrap();
        let view = fine.training_views()[0];
        let mut hidden = vec![false; 13 * 12];
        hidden[5 * 13 + 7] = true;
        fine.hidden.insert(view, hidden);
        let coarse = binned_to(&fine, 4);
        assert_eq!((coarse.width, coarse.height, coarse.views[view].size), (4, 4, [4, 4]));
        assert_eq!(coarse.frames.len(), fine.training().len());

        let (of_fine, of_coarse) = (&fine.training()[0], &coarse.frames[0]);
        let bin = |x: usize, y: usize| {
            (0..9).map(|k| of_fine.integrals[(3 * y + k / 3) * 13 + 3 * x + k % 3]).sum::<f32>() / 9.0
        };
        for (x, y) in [(0, 0), (2, 1), (3, 3)] {
            let seen = of_coarse.integrals[y * 4 + x];
            assert!((seen - bin(x, y)).abs() < 1e-5, "{x}, {y}: {seen}, {}", bin(x, y));
        }
        let hidden: Vec<usize> = (0..16).filter(|p| !coarse.shows(view, *p)).collect();
        assert_eq!(hidden, [4 + 2], "a bin that is partly hidden is hidden");

        let place = DVec3::new(0.1, -0.07, 0.05);
        let at = |dataset: &Dataset| dataset.views[view].rays.project(place).unwrap();
        let (fine, coarse) = (at(&fine), at(&coarse));
        for (fine, coarse) in [(fine.0, coarse.0), (fine.1, coarse.1)] {
            assert!(
                ((fine + 0.5) / 3.0 - 0.5 - coarse).abs() < 1e-9,
                "pixel {fine} is pixel {coarse} of the binned image"
            );
        }
    }

    #[test]
    fn images_that_are_small_already_are_not_binned() {
        let fine = small_dataset(13, 12, 3).unwrap();
        let same = binned_to(&fine, 100);
        assert_eq!((same.width, same.height), (13, 12));
        assert_eq!(same.frames[0].integrals, fine.training()[0].integrals);
    }
}
