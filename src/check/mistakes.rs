//! The usual mistakes in a dataset, and what it would be without them.

use crate::calibrate::profiles::Views;
use crate::geometry::{CArm, Geometry};
use crate::scan::canvas::{framed, onto_canvas};
use crate::scan::dataset::{Dataset, View};

/// Something that is wrong with all images or all geometries alike.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Mistake {
    /// Rows are columns.
    Transposed,
    /// Columns run the wrong way; the mirrored patient, with the sign of the primary angle turned, shows the same.
    Mirrored,
    /// Rows run the wrong way; with the sign of the secondary angle turned, the mirrored patient shows the same.
    UpsideDown,
    /// Both: images are turned by half a turn, or both angles have the wrong sign.
    Turned,
    /// Primary and secondary angle are exchanged.
    AnglesExchanged,
    /// The pixel pitch is that at the isocentre, where the detector's is wanted.
    PitchAtIsocentre,
    /// The logarithm was taken of line integrals.
    LogTwice,
    /// Intensities were taken for line integrals.
    LogMissing,
}

/// All of them.
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
    /// What the mistake is, and how to undo it.
    pub fn advice(self) -> &'static str {
        match self {
            Mistake::Transposed => "the images are transposed: exchange rows and columns of every image",
            Mistake::Mirrored => {
                "the images are mirrored left to right, or the primary angle has the wrong sign (LAO is positive): both \
                 explain the data; the patient's anatomy tells which"
            }
            Mistake::UpsideDown => {
                "the images are upside down, or the secondary angle has the wrong sign (cranial is positive): both explain \
                 the data; the patient's anatomy tells which"
            }
            Mistake::Turned => {
                "the images are turned by half a turn, or both angles have the wrong sign (LAO and cranial are positive)"
            }
            Mistake::AnglesExchanged => "primary and secondary angle are exchanged",
            Mistake::PitchAtIsocentre => {
                "pixel_mm is the pitch at the isocentre: the detector's is wanted, which is sid_mm / sod_mm times as large"
            }
            Mistake::LogTwice => {
                "the logarithm was taken twice: the images were line integrals already (intensity kind `integral`)"
            }
            Mistake::LogMissing => {
                "the images are intensities, not line integrals: take their negative logarithm (intensity kind `linear`)"
            }
        }
    }

    /// The data without the mistake; none where it cannot have been made.
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
                let least = dataset.training().iter().flat_map(|f| &f.integrals).copied().fold(f32::INFINITY, f32::min);
                // Intensities are never negative.
                (brightest > 0.0 && least >= 0.0).then(|| revalued(dataset, |v| -(v / brightest).max(DARKEST).ln()))
            }
        }
    }
}

/// The dataset with the pixels of its training images elsewhere: `sized` gives the size (columns, rows) of images of another, and
/// `from` where each pixel was in an image of a size.
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

/// The dataset with other values in its training images.
fn revalued(dataset: &Dataset, value: impl Fn(f32) -> f32) -> Dataset {
    let mut changed = Dataset { frames: dataset.training().to_vec(), ..dataset.clone() };
    for frame in &mut changed.frames {
        frame.integrals.iter_mut().for_each(|v| *v = value(*v));
        frame.mask = None;
    }
    changed
}

/// The dataset with other C-arms; none where a geometry is a matrix, or would be impossible.
fn geometries(dataset: &Dataset, change: impl Fn(&CArm) -> CArm) -> Option<Dataset> {
    let mut changed = dataset.clone();
    for view in &mut changed.views {
        let Geometry::CArm(c_arm) = &view.geometry else { return None };
        let geometry = Geometry::CArm(change(c_arm));
        *view = View::new(geometry, view.size).ok()?;
    }
    Some(changed)
}

/// Something wrong with the phases of one view.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct PhaseMistake {
    /// The view, by its place among those that show motion.
    pub view: usize,
    /// The view's phases run backwards.
    pub reversed: bool,
    /// Phases by which it is late.
    pub late: usize,
}

impl PhaseMistake {
    /// All that one view can have.
    pub fn all(n_views: usize, n_phases: usize) -> impl Iterator<Item = PhaseMistake> {
        let of_view = move |view| {
            let late = (1..n_phases).map(move |late| PhaseMistake { view, reversed: false, late });
            late.chain((0..n_phases).map(move |late| PhaseMistake { view, reversed: true, late }))
        };
        (0..n_views).flat_map(of_view)
    }

    /// What the views show without it.
    pub fn undone(self, views: &Views) -> Views {
        let n = views.n_phases;
        let taken = |t: usize| if self.reversed { (2 * n - 1 - t + self.late) % n } else { (t + self.late) % n };
        let mut changed = views.clone();
        let phases = &views.views[self.view].phases;
        changed.views[self.view].phases = (0..n).map(|t| phases[taken(t)].clone()).collect();
        changed
    }
}

/// Two views whose images, or geometries, are exchanged; none where one is impossible for the other's images.
pub fn exchanged(dataset: &Dataset, [a, b]: [usize; 2]) -> Option<Dataset> {
    let mut changed = dataset.clone();
    changed.views.swap(a, b);
    for view in [a, b] {
        let size = dataset.views[view].size;
        if changed.views[view].size != size {
            changed.views[view] = View::new(changed.views[view].geometry.clone(), size).ok()?;
        }
    }
    Some(changed)
}
