//! Objects at rest: the appearance of a view without vessels, as in subtraction angiography, so that the rest of the engine sees
//! vessels that appear and vanish.

use crate::geometry::MM_PER_UNIT;
use crate::raster::{Image, dilate, opening, percentile};
use crate::scan::dataset::{Frame, Split, View};
use crate::scan::hidden::flood;

/// Width of the widest vessel that is searched where contrast comes and goes, mm at the isocentre: coronary arteries are up to 5 mm wide.
const WIDEST_VESSEL_MM: f64 = 6.0;
/// Widths of the widest vessel that are tried for an object at rest, mm: aneurysms, grafts and phantoms are wider than healthy arteries.
const WIDTHS_MM: [f64; 4] = [WIDEST_VESSEL_MM, 9.0, 13.5, 20.0];
// The four numbers below are judgements that drawn tubes test, with and without ribs behind them; no data were measured with others.
/// Percentile of what stands out that counts as the strength of the vessels.
const STRENGTH_PERCENTILE: f64 = 0.9;
/// Share of that strength from which a pixel shows a vessel.
const SHOWN: f32 = 0.5;
/// Pixels as strong as the vessels that a larger width adds beside them, as a share of the vessels' own, from which vessels are wider:
/// junctions of narrow vessels add a few percent.
const WIDER: f64 = 0.5;
/// Growth of what stands out, with a larger width, from which vessels are still cut in depth.
const CUT: f64 = 1.2;
/// Number of phases of an object at rest: phase 0 shows it, phase 1 is the same without vessels.
pub const PHASES: u32 = 2;
/// Threshold for structures that stand out, in standard deviations of the noise.
const NOISE_SIGMAS: f32 = 4.0;

/// Returns half the width of the widest vessel, in pixels of `pixel_mm` at the isocentre.
pub fn vessel_pixels(pixel_mm: f64) -> usize {
    vessel_pixels_of(WIDEST_VESSEL_MM, pixel_mm)
}

/// Returns half a width in mm, in pixels of `pixel_mm` at the isocentre.
pub fn vessel_pixels_of(width_mm: f64, pixel_mm: f64) -> usize {
    ((0.5 * width_mm / pixel_mm).ceil() as usize).max(2)
}

/// Returns the width of the widest vessel in an image of an object at rest, mm at the isocentre, with pixels of `pixel_mm` there: wider
/// structures that are as strong as the narrow ones and continue them are vessels, too. Areas of at least `dark` are as in
/// [`without_vessels`].
pub fn widest_vessel_mm(image: &Image, pixel_mm: f64, dark: f32) -> f64 {
    let narrow = |width_mm: f64| {
        let vessel = vessel_pixels_of(width_mm, pixel_mm);
        let background = opening(image, vessel);
        let closed = closed(&background, 2 * vessel, dark);
        let values = image.values.iter().zip(&background.values).zip(&closed);
        values.map(|((v, b), closed)| if *closed { 0.0 } else { v - b }).collect::<Vec<f32>>()
    };
    let mut width_mm = WIDTHS_MM[0];
    let mut of_width = narrow(width_mm);
    for wider_mm in WIDTHS_MM.into_iter().skip(1) {
        let of_wider = narrow(wider_mm);
        let is_wide = width_mm > WIDTHS_MM[0] && grows(&of_width, &of_wider);
        if !is_wide && !continues(image.width, &of_width, &of_wider) {
            break;
        }
        (width_mm, of_width) = (wider_mm, of_wider);
    }
    width_mm
}

/// Tells whether vessels that are known to be wide are cut in depth: a larger width adds much to them.
fn grows(narrow: &[f32], wider: &[f32]) -> bool {
    let limit = stands_out_from(narrow);
    let both = narrow.iter().zip(wider).filter(|(narrow, _)| **narrow > limit);
    let [of_narrow, of_wider] = both.fold([0.0f64; 2], |[a, b], (n, w)| [a + f64::from(*n), b + f64::from(*w)]);
    of_wider > CUT * of_narrow
}

/// Tells whether the vessels of an image, `narrow` structures, go on in wider ones that are as strong.
fn continues(columns: usize, narrow: &[f32], wider: &[f32]) -> bool {
    let limit = stands_out_from(narrow);
    let standing: Vec<f32> = narrow.iter().copied().filter(|v| *v > limit).collect();
    if standing.is_empty() {
        return false;
    }
    let strength = percentile(&standing, STRENGTH_PERCENTILE);
    let is_vessel = |p: usize| narrow[p] > SHOWN * strength;
    let is_added = |p: usize| !is_vessel(p) && wider[p] > strength;
    let vessels: Vec<usize> = (0..narrow.len()).filter(|p| is_vessel(*p)).collect();
    let reached = flood(vessels.iter().copied(), columns, narrow.len() / columns, is_added);
    let added = reached.iter().flatten().count() - vessels.len();
    added as f64 >= WIDER * vessels.len() as f64
}

/// Returns the value from which structures stand out of noise: deviations from the median that noise has.
fn stands_out_from(stand_out: &[f32]) -> f32 {
    let typical = percentile(stand_out, 0.5);
    let spread = percentile(&stand_out.iter().map(|s| (s - typical).abs()).collect::<Vec<_>>(), 0.5);
    typical + NOISE_SIGMAS * 1.4826 * spread
}

/// Removes structures as thin as vessels from an image of line integrals: pixels that stand out of their surroundings by more
/// than noise are set to the level of the surroundings. `vessel` is half the width of the widest vessel, in pixels; areas of at
/// least `dark` belong to the collimator or the detector's rim, whose outlines are as thin as vessels.
pub fn without_vessels(image: &Image, vessel: usize, dark: f32) -> Image {
    let mut background = opening(image, vessel);
    let stand_out: Vec<f32> = image.values.iter().zip(&background.values).map(|(v, b)| v - b).collect();
    // An opening follows the minimum of the surroundings, which noise makes too small; the median difference corrects for that.
    let (typical, limit) = (percentile(&stand_out, 0.5), stands_out_from(&stand_out));
    let closed = closed(&background, 2 * vessel, dark);
    for (p, b) in background.values.iter_mut().enumerate() {
        *b = if stand_out[p] > limit && !closed[p] { *b + typical } else { image.values[p] };
    }
    background
}

/// Adds a training frame of phase 1 for each view of an object at rest that has none: the mean of its images without structures as
/// thin as vessels. The frames have the sizes of their views. Returns a note if there are such views.
pub fn add_appearance_without_vessels(views: &[View], frames: &mut Vec<Frame>) -> Option<String> {
    let (mut made, mut widest_mm) = (0, 0.0f64);
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
        let width_mm = widest_vessel_mm(&mean, pixel_mm, f32::INFINITY);
        widest_mm = width_mm.max(widest_mm);
        let background = without_vessels(&mean, vessel_pixels_of(width_mm, pixel_mm), f32::INFINITY);
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
         to {widest_mm} mm wide"
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
    fn a_wide_vessel_is_more_than_its_stenosis() {
        const SIZE: usize = 120;
        // A tube in pixels of 0.5 mm, `wide` of them, with a stenosis of 4; its line integrals grow with its width.
        let tube = |wide: f64, ribs: bool| {
            let half = |y: usize| if (50..70).contains(&y) { 2.0 } else { 0.5 * wide };
            let value = |p: usize| {
                let (x, y) = ((p % SIZE) as f64 - 60.0, p / SIZE);
                let depth = 2.0 * (half(y).powi(2) - x * x).max(0.0).sqrt();
                let rib = if ribs && (p / SIZE) % 40 < 16 { 0.25 } else { 0.0 };
                (2.0 + 0.05 * depth + rib + 1e-3 * ((p * 7919) % 13) as f64) as f32
            };
            Image { width: SIZE, height: SIZE, values: (0..SIZE * SIZE).map(value).collect() }
        };
        let found = |wide: f64, ribs: bool| widest_vessel_mm(&tube(wide, ribs), 0.5, f32::INFINITY);
        assert_eq!([found(8.0, false), found(8.0, true)], [6.0; 2], "a vessel of 4 mm, and ribs of 8 mm behind it");
        let wide = found(20.0, false);
        assert!(wide > 6.0, "a vessel of 10 mm: {wide}");
        let image = tube(20.0, false);
        let left = without_vessels(&image, vessel_pixels_of(wide, 0.5), f32::INFINITY);
        let middle = 30 * SIZE + 60;
        assert!(left.values[middle] < 2.1, "the vessel is removed: {}", left.values[middle]);
    }

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
