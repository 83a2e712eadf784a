//! Objects at rest: the appearance of a view without vessels, as in subtraction angiography, so that the rest of the engine sees
//! vessels that appear and vanish.

use crate::geometry::MM_PER_UNIT;
use crate::raster::{Image, dilate, opening, percentile};
use crate::scan::dataset::{Frame, Split, View};

/// Width of the widest vessel that is searched, mm at the isocentre.
pub const WIDEST_VESSEL_MM: f64 = 6.0;
/// Number of phases of an object at rest: phase 0 shows it, phase 1 is the same without vessels.
pub const PHASES: u32 = 2;
/// Threshold for structures that stand out, in standard deviations of the noise.
const NOISE_SIGMAS: f32 = 4.0;

/// Returns half the width of the widest vessel, in pixels of `pixel_mm` at the isocentre.
pub fn vessel_pixels(pixel_mm: f64) -> usize {
    ((0.5 * WIDEST_VESSEL_MM / pixel_mm).ceil() as usize).max(2)
}

/// Removes structures as thin as vessels from an image of line integrals: pixels that stand out of their surroundings by more
/// than noise are set to the level of the surroundings. `vessel` is half the width of the widest vessel, in pixels; areas of at
/// least `dark` belong to the collimator or the detector's rim, whose outlines are as thin as vessels.
pub fn without_vessels(image: &Image, vessel: usize, dark: f32) -> Image {
    let mut background = opening(image, vessel);
    let stand_out: Vec<f32> = image.values.iter().zip(&background.values).map(|(v, b)| v - b).collect();
    // An opening follows the minimum of the surroundings, which noise makes too small; the median difference corrects for that.
    let typical = percentile(&stand_out, 0.5);
    let spread = percentile(&stand_out.iter().map(|s| (s - typical).abs()).collect::<Vec<_>>(), 0.5);
    let limit = typical + NOISE_SIGMAS * 1.4826 * spread;
    let closed = closed(&background, 2 * vessel, dark);
    for (p, b) in background.values.iter_mut().enumerate() {
        *b = if stand_out[p] > limit && !closed[p] { *b + typical } else { image.values[p] };
    }
    background
}

/// Adds a training frame of phase 1 for each view of an object at rest that has none: the mean of its images without structures as
/// thin as vessels. The frames have the sizes of their views. Returns a note if there are such views.
pub fn add_appearance_without_vessels(views: &[View], frames: &mut Vec<Frame>) -> Option<String> {
    let mut made = 0;
    for (index, view) in views.iter().enumerate() {
        let of_view = |phase: u32| {
            let used = move |f: &&Frame| (f.view, f.split, f.phase) == (index, Split::Train, phase);
            frames.iter().filter(used)
        };
        let shown: Vec<&Frame> = of_view(0).collect();
        if shown.is_empty() || of_view(1).next().is_some() {
            continue;
        }
        let [width, height] = view.size;
        let mut mean = Image::zeros(width, height);
        for frame in &shown {
            mean.values.iter_mut().zip(&frame.integrals).for_each(|(sum, v)| *sum += v / shown.len() as f32);
        }
        let pixel_mm = view.rays.direction[1].length() * view.rays.sod * MM_PER_UNIT;
        let background = without_vessels(&mean, vessel_pixels(pixel_mm), f32::INFINITY);
        let frame = Frame {
            name: format!("{}-without-vessels", shown[0].name),
            phase: 1,
            integrals: background.values.into(),
            mask: None,
            ..shown[0].clone()
        };
        frames.push(frame);
        made += 1;
    }
    let note = format!(
        "the object is at rest: the appearance of {made} views without vessels was estimated from their images, without structures up \
         to {WIDEST_VESSEL_MM} mm wide"
    );
    (made > 0).then_some(note)
}

/// Pixels within `margin` of the image's edge, or of dark areas.
fn closed(background: &Image, margin: usize, dark: f32) -> Vec<bool> {
    let (w, h) = (background.width, background.height);
    let dark = background.values.iter().map(|v| f32::from(u8::from(*v > dark))).collect();
    let grown = dilate(&Image { values: dark, ..*background }, margin);
    (0..w * h)
        .map(|p| {
            let (x, y) = (p % w, p / w);
            grown.values[p] > 0.0 || x.min(w - 1 - x).min(y).min(h - 1 - y) < margin
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn thin_structures_go_and_all_else_stays() {
        const SIZE: usize = 40;
        let level = |p: usize| 3.0 + 0.02 * (p % SIZE) as f32;
        let is_vessel = |p: usize| (18..21).contains(&(p % SIZE)) && (10..30).contains(&(p / SIZE));
        let is_wide = |p: usize| p % SIZE > 30;
        let value = |p: usize| level(p) + if is_vessel(p) { 0.4 } else { 0.0 } + if is_wide(p) { 1.0 } else { 0.0 };
        let image = Image { width: SIZE, height: SIZE, values: (0..SIZE * SIZE).map(value).collect() };
        let without = without_vessels(&image, 3, f32::INFINITY);
        for (p, found) in without.values.iter().enumerate() {
            let wanted = if is_vessel(p) { level(p) } else { image.values[p] };
            assert!((found - wanted).abs() < 0.1, "pixel {p}: {found}, not {wanted}");
        }
        assert_eq!(without_vessels(&image, 3, 2.0).values, image.values, "all of it is as dark as a collimator");
    }
}
