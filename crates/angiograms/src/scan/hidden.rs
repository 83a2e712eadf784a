//! Pixels that do not show the patient: behind a collimator's blade, outside a round detector, or beyond an image that is
//! smaller than others.

use crate::scan::canvas::framed;
use crate::scan::dataset::{Dataset, Split};
use std::borrow::Cow;
use std::collections::VecDeque;

/// Tolerance for the darkest pixels, as a share of an image's range of values.
const AS_DARK: f32 = 1e-4;

impl Dataset {
    /// Tells whether images of a view show the patient at a pixel.
    pub fn shows(&self, view: usize, pixel: usize) -> bool {
        self.hidden_of(view).is_none_or(|hidden| !hidden[pixel])
    }

    /// Returns the pixels, row-major, where images of a view do not show the patient; `None` where there are none.
    pub fn hidden_of(&self, view: usize) -> Option<&[bool]> {
        self.hidden.get(&view).map(Vec::as_slice)
    }

    /// Finds the pixels that do not show the patient. A blade or a rim gives the same value in a whole image, the darkest of
    /// the image, in all images of a view, in regions that touch the border of the image; the pixels next to these regions are
    /// partly hidden. Training images are filled there with the nearest visible value, so that a blade is not taken for tissue.
    /// All pixels of the canvas beyond an image are hidden.
    pub fn hide(&mut self) {
        for view in 0..self.views.len() {
            let of_view = self.frames.iter().filter(|f| f.view == view);
            let images: Vec<Cow<'_, [f32]>> = of_view.map(|f| self.own(view, &f.integrals)).collect();
            // A session keeps views whose frames are not used; the canvas may be too small for them.
            if images.is_empty() {
                continue;
            }
            let size = self.views[view].size;
            let hidden = hidden(&images, size[0], size[1]);
            let count = hidden.iter().filter(|h| **h).count();
            if count > 0 {
                self.notes.push(format!(
                    "view {view}: {:.0} % of the pixels show nothing of the patient, e.g. behind a blade of the \
                     collimator, and are ignored",
                    100.0 * count as f64 / hidden.len() as f64
                ));
            }
            let hidden = framed(&hidden, size, self.canvas(), true);
            if !hidden.contains(&true) {
                continue;
            }
            let nearest = nearest_shown(&hidden, self.width);
            for frame in self.frames.iter_mut().filter(|f| f.view == view && f.split == Split::Train) {
                frame.integrals = nearest.iter().map(|p| frame.integrals[*p]).collect();
            }
            self.hidden.insert(view, hidden);
        }
    }
}

/// Hidden pixels of a view. Returns no pixel if fewer pixels than the shorter side of the image are dark, or if all would be
/// hidden.
fn hidden(images: &[Cow<'_, [f32]>], width: usize, height: usize) -> Vec<bool> {
    let mut dark = vec![!images.is_empty(); width * height];
    for image in images {
        let [min, max] = image.iter().fold([f32::MAX, f32::MIN], |[l, m], v| [l.min(*v), m.max(*v)]);
        let limit = max - AS_DARK * (max - min);
        dark.iter_mut().zip(image.as_ref()).for_each(|(dark, v)| *dark &= min < max && *v >= limit);
    }
    let border = (0..dark.len()).filter(|p| dark[*p] && at_border(*p, width, height));
    let reached = flood(border, width, height, |p| dark[p]);
    let mut hidden: Vec<bool> = reached.iter().map(Option::is_some).collect();
    let count = hidden.iter().filter(|h| **h).count();
    if count < width.min(height) {
        return vec![false; hidden.len()];
    }
    let beside: Vec<usize> =
        (0..hidden.len()).filter(|p| !hidden[*p] && neighbours(*p, width, height).any(|q| hidden[q])).collect();
    if count + beside.len() == hidden.len() {
        return vec![false; hidden.len()];
    }
    beside.into_iter().for_each(|p| hidden[p] = true);
    hidden
}

/// Index of the nearest visible pixel, for each pixel.
fn nearest_shown(hidden: &[bool], width: usize) -> Vec<usize> {
    let shown = (0..hidden.len()).filter(|p| !hidden[*p]);
    let from = flood(shown, width, hidden.len() / width, |_| true);
    from.iter().enumerate().map(|(p, from)| from.unwrap_or(p)).collect()
}

/// For each pixel, the start from which it is reached first, by steps along rows and columns to pixels that `enters` allows.
pub(crate) fn flood(
    starts: impl Iterator<Item = usize>,
    width: usize,
    height: usize,
    enters: impl Fn(usize) -> bool,
) -> Vec<Option<usize>> {
    let mut from = vec![None; width * height];
    let mut queue: VecDeque<usize> = starts.inspect(|p| from[*p] = Some(*p)).collect();
    while let Some(pixel) = queue.pop_front() {
        for next in neighbours(pixel, width, height).filter(|p| enters(*p)) {
            if from[next].is_none() {
                from[next] = from[pixel];
                queue.push_back(next);
            }
        }
    }
    from
}

pub(crate) fn at_border(pixel: usize, width: usize, height: usize) -> bool {
    let (x, y) = (pixel % width, pixel / width);
    x == 0 || y == 0 || x + 1 == width || y + 1 == height
}

fn neighbours(pixel: usize, width: usize, height: usize) -> impl Iterator<Item = usize> {
    let (x, y) = (pixel % width, pixel / width);
    let beside = [
        (x > 0).then(|| pixel - 1),
        (x + 1 < width).then(|| pixel + 1),
        (y > 0).then(|| pixel - width),
        (y + 1 < height).then(|| pixel + width),
    ];
    beside.into_iter().flatten()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scan::dataset::Frame;

    const WIDTH: usize = 30;
    const HEIGHT: usize = 20;

    fn frame(phase: u32, value: impl Fn(usize, usize) -> f32) -> Frame {
        Frame {
            name: String::new(),
            view: 0,
            phase,
            split: Split::Train,
            integrals: (0..WIDTH * HEIGHT).map(|p| value(p % WIDTH, p / WIDTH)).collect(),
            mask: None,
            after_phase: 0.0,
            heart_shift_mm: [0.0; 3],
            contrast: 1.0,
        }
    }

    fn hidden_of(frames: &[Frame]) -> Vec<bool> {
        hidden(&frames.iter().map(|frame| Cow::Borrowed(frame.integrals.as_slice())).collect::<Vec<_>>(), WIDTH, HEIGHT)
    }

    /// A chest with a moving vessel, and dark columns from `first` on.
    fn chest(phase: u32, dark: f32, first: usize) -> Frame {
        frame(phase, move |x, y| match x {
            x if x >= first => dark,
            x if x + 1 == first => 0.5 * dark,
            x if x == 5 + phase as usize => 2.0,
            _ => 1.0 + 0.01 * y as f32,
        })
    }

    #[test]
    fn a_blade_and_the_pixels_it_half_covers_are_hidden() {
        // Each image has a scale of its own, as when frames state intensities.
        let frames = [chest(0, 9.0, 24), chest(1, 8.0, 24), chest(2, 9.5, 24)];
        let hidden = hidden_of(&frames);
        assert!(hidden.iter().enumerate().all(|(p, h)| *h == (p % WIDTH >= 23)));
        let nearest = nearest_shown(&hidden, WIDTH);
        assert!(nearest.iter().enumerate().all(|(p, q)| *q == p / WIDTH * WIDTH + (p % WIDTH).min(22)));
    }

    #[test]
    fn the_corners_of_a_round_detector_are_hidden() {
        let outside = |x: usize, y: usize| (x as f32 - 14.5).powi(2) + (y as f32 - 9.5).powi(2) > 200.0;
        let frames = [0, 1].map(|t| frame(t, move |x, y| if outside(x, y) { 5.0 } else { 1.0 + t as f32 * 0.1 }));
        let hidden = hidden_of(&frames);
        assert!((0..hidden.len()).filter(|p| outside(p % WIDTH, p / WIDTH)).all(|p| hidden[p]));
        assert!(!hidden[10 * WIDTH + 15] && hidden.iter().filter(|h| **h).count() < WIDTH * HEIGHT / 2);
    }

    #[test]
    fn what_shows_the_patient_is_not_hidden() {
        let none = |frames: &[Frame]| hidden_of(frames).iter().all(|h| !h);
        assert!(none(&[chest(0, 9.0, usize::MAX), chest(1, 9.0, usize::MAX)]), "nothing is dark");
        assert!(none(&[frame(0, |_, _| 3.0), frame(1, |_, _| 3.0)]), "images that show nothing anywhere");
        // A dense spot in the middle, a border that darkens at one phase only, and a border whose dark values vary.
        assert!(none(&[frame(0, |x, y| if x.abs_diff(15) < 4 && y.abs_diff(10) < 4 { 9.0 } else { 1.0 })]));
        assert!(none(&[chest(0, 9.0, 24), chest(1, 9.0, usize::MAX)]));
        assert!(none(&[0, 1].map(|t| frame(t, |x, y| if x > 24 { 8.0 + 0.01 * y as f32 } else { 1.0 }))));
        assert!(none(&[0, 1].map(|t| frame(t, |x, y| if x + y < 3 { 9.0 } else { 1.0 }))), "a few pixels are no blade");
        assert!(none(&[]));
    }
}
