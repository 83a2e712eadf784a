//! The usual mistakes in a dataset, and how to undo them.

use crate::calibrate::observed::Observed;
use crate::calibrate::pose::StatedView;
use crate::calibrate::profiles::Views;
use crate::geometry::{CArm, Geometry};
use crate::scan::canvas::{framed, onto_canvas};
use crate::scan::dataset::{Dataset, View};

/// A mistake in all images or all geometries.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Mistake {
    /// Rows and columns are exchanged.
    Transposed,
    /// Columns run the wrong way; the mirrored patient with the opposite sign of the primary angle gives equal images.
    Mirrored,
    /// Rows run the wrong way; the mirrored patient with the opposite sign of the secondary angle gives equal images.
    UpsideDown,
    /// Rows and columns both run the wrong way: images are rotated by half a turn, or both angles have the wrong sign.
    Turned,
    /// Primary and secondary angle are exchanged.
    AnglesExchanged,
    /// The pixel pitch is stated at the isocentre instead of at the detector.
    PitchAtIsocentre,
    /// The logarithm was taken of line integrals.
    LogTwice,
    /// Intensities were taken as line integrals.
    LogMissing,
}

/// All mistakes.
pub const MISTAKES: [Mistake; 8] = [
    Mistake::Transposed,
    Mistake::Mirrored,
    Mistake::UpsideDown,
    Mistake::Turned,
    Mistake::AnglesExchanged,
    Mistake::PitchAtIsocentre,
    Mistake::LogTwice,
    Mistake::LogMissing,
];

/// Smallest intensity whose logarithm is taken, as a share of the largest.
const DARKEST: f32 = 1e-6;

impl Mistake {
    /// Describes the mistake and how to undo it.
    pub fn advice(self) -> &'static str {
        match self {
            Mistake::Transposed => "the images are transposed: exchange rows and columns of every image",
            Mistake::Mirrored => {
                "the images are mirrored left to right, or the primary angle has the wrong sign (LAO is positive): \
                 both explain the data; the patient's anatomy shows which one is true"
            }
            Mistake::UpsideDown => {
                "the images are upside down, or the secondary angle has the wrong sign (cranial is positive): both \
                 explain the data; the patient's anatomy shows which one is true"
            }
            Mistake::Turned => {
                "the images are rotated by 180 degrees, or both angles have the wrong sign (LAO and cranial are \
                 positive)"
            }
            Mistake::AnglesExchanged => "primary and secondary angle are exchanged",
            Mistake::PitchAtIsocentre => {
                "pixel_mm is the pixel pitch at the isocentre, but the pitch on the detector is needed, which is \
                 sid_mm / sod_mm times as large"
            }
            Mistake::LogTwice => {
                "the logarithm was taken twice: the images were line integrals already (intensity kind `integral`)"
            }
            Mistake::LogMissing => {
                "the images are intensities, not line integrals: take their negative logarithm (intensity kind `linear`)"
            }
        }
    }

    /// Returns the data without the mistake; `None` where it cannot have been made.
    pub fn undone(self, dataset: &Dataset) -> Option<Dataset> {
        match self {
            Mistake::Transposed => moved(dataset, |[w, h]| [h, w], |i, [w, h]| i % h * w + i / h),
            Mistake::Mirrored => moved(dataset, |size| size, |i, [w, _]| i / w * w + (w - 1 - i % w)),
            Mistake::UpsideDown => moved(dataset, |size| size, |i, [w, h]| (h - 1 - i / w) * w + i % w),
            Mistake::Turned => moved(dataset, |size| size, |i, [w, h]| w * h - 1 - i),
            Mistake::AnglesExchanged => geometries(dataset, |c| CArm {
                primary_deg: c.secondary_deg,
                secondary_deg: c.primary_deg,
                ..c.clone()
            }),
            Mistake::PitchAtIsocentre => {
                geometries(dataset, |c| CArm { pixel_mm: c.pixel_mm.map(|p| p * c.sid_mm / c.sod_mm), ..c.clone() })
            }
            Mistake::LogTwice => Some(revalued(dataset, |v| (-v).exp())),
            Mistake::LogMissing => {
                let brightest = dataset.training().iter().flat_map(|f| &f.integrals).copied().fold(0f32, f32::max);
                let min = dataset.training().iter().flat_map(|f| &f.integrals).copied().fold(f32::INFINITY, f32::min);
                // Intensities are never negative.
                (brightest > 0.0 && min >= 0.0).then(|| revalued(dataset, |v| -(v / brightest).max(DARKEST).ln()))
            }
        }
    }
}

/// Returns the dataset with the pixels of its training images moved: `sized` maps the size (columns, rows) of an image, and
/// `from` gives the source pixel of each pixel in an image of that size.
fn moved(
    dataset: &Dataset,
    sized: impl Fn([usize; 2]) -> [usize; 2],
    from: impl Fn(usize, [usize; 2]) -> usize,
) -> Option<Dataset> {
    let mut changed = revalued(dataset, |v| v);
    for view in &mut changed.views {
        let size = sized(view.size);
        if size != view.size {
            *view = View::new(view.geometry.clone(), size).ok()?;
        }
    }
    let was = |view: usize| dataset.views[view].size;
    for frame in &mut changed.frames {
        let own = dataset.own(frame.view, &frame.integrals);
        frame.integrals = (0..own.len()).map(|i| own[from(i, was(frame.view))]).collect();
    }
    let [width, height] = onto_canvas(&changed.views, &mut changed.frames).ok()??;
    (changed.width, changed.height) = (width, height);
    let seen: Vec<usize> = changed.training_views();
    changed.hidden.retain(|view, _| seen.contains(view));
    for (view, hidden) in &mut changed.hidden {
        let own = dataset.own(*view, hidden);
        let own: Vec<bool> = (0..own.len()).map(|i| own[from(i, was(*view))]).collect();
        *hidden = framed(&own, changed.views[*view].size, [width, height], true);
    }
    Some(changed)
}

/// Returns the dataset with other values in its training images.
fn revalued(dataset: &Dataset, value: impl Fn(f32) -> f32) -> Dataset {
    let mut changed = Dataset { frames: dataset.training().to_vec(), ..dataset.clone() };
    for frame in &mut changed.frames {
        frame.integrals.iter_mut().for_each(|v| *v = value(*v));
        frame.mask = None;
    }
    changed
}

/// Returns the dataset with other C-arms; `None` where a geometry is a matrix, or would be impossible.
fn geometries(dataset: &Dataset, change: impl Fn(&CArm) -> CArm) -> Option<Dataset> {
    let mut changed = dataset.clone();
    for view in &mut changed.views {
        let Geometry::CArm(c_arm) = &view.geometry else { return None };
        let geometry = Geometry::CArm(change(c_arm));
        *view = View::new(geometry, view.size).ok()?;
    }
    Some(changed)
}

/// A mistake in the phases of one view.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct PhaseMistake {
    /// The view, by its index among those that show motion.
    pub view: usize,
    /// The view's phases run backwards.
    pub reversed: bool,
    /// Number of phases by which the view is late.
    pub late: usize,
}

impl PhaseMistake {
    /// All phase mistakes that one view can have.
    pub fn all(n_views: usize, n_phases: usize) -> impl Iterator<Item = PhaseMistake> {
        let of_view = move |view| {
            let late = (1..n_phases).map(move |late| PhaseMistake { view, reversed: false, late });
            late.chain((0..n_phases).map(move |late| PhaseMistake { view, reversed: true, late }))
        };
        (0..n_views).flat_map(of_view)
    }

    /// Returns the views without the mistake.
    pub fn undone(self, views: &Views) -> Views {
        let n = views.n_phases;
        let taken = |t: usize| if self.reversed { (2 * n - 1 - t + self.late) % n } else { (t + self.late) % n };
        let mut changed = views.clone();
        let phases = &views.views[self.view].phases;
        changed.views[self.view].phases = (0..n).map(|t| phases[taken(t)].clone()).collect();
        changed
    }
}

/// Exchanges the geometries of two observed views; `None` where one is impossible for the other's images.
pub fn exchanged(dataset: &Dataset, observed: &Observed, views: &Views, [a, b]: [usize; 2]) -> Option<Views> {
    let mut changed = views.clone();
    for (slot, of) in [(a, b), (b, a)] {
        let [own, other] = [slot, of].map(|slot| &dataset.views[observed.views[slot]]);
        let view = View::new(other.geometry.clone(), own.size).ok()?;
        let stand = StatedView::new(&view.geometry, &view.rays.binned(observed.factor));
        changed.views[slot] = views.views[slot].seen_from(stand);
    }
    Some(changed)
}
