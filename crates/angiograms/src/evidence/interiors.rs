//! Interiors of wide vessels. A vessel that is wider than it moves covers its middle at every phase. No phase shows the background there,
//! and an opening that removes usual vessels keeps it. Its edges distinguish it from the background: they move on all sides.

use crate::evidence::filters::map2;
use crate::evidence::series::opening_radius;
use crate::raster::{Image, opening, widened};

// With the numbers of this file, the inside of a straight tube of 20 mm is found, and no interior in the data sets of degradations and
// stenoses of docs/performance.md.
/// Radius of the opening that removes the widest vessels, as a share of the image's smaller side.
const WIDEST_SHARE: f64 = 0.1;
/// Minimum height of an interior above the background around it, as a share of the strongest change.
const MIN_HEIGHT: f32 = 0.5;
/// Minimum change of an edge that moves, as a share of the strongest change.
const MIN_CHANGE: f32 = 0.25;
/// Minimum change of an edge that moves, in standard deviations of the noise: the largest of several changes is blurred.
const MIN_CHANGE_SIGMAS: f32 = 3.0;
/// Minimum share of the outline of an interior along which the edge moves. The spine, ribs and the heart's border meet vessels along a
/// part of their outlines only.
const MIN_MOVING_OUTLINE: f64 = 0.9;

/// Interiors of the wide vessels of a view.
pub(super) struct Interiors {
    /// Pixels of the interiors and of a margin around them.
    pub(super) inside: Vec<bool>,
    /// The level without structures as wide as the widest vessels.
    pub(super) background: Image,
}

/// The level of a background, and the changes above it.
pub(super) struct Levels<'a> {
    /// The level after an opening that removes usual vessels.
    pub(super) low: &'a Image,
    /// Radius of that opening, pixels.
    pub(super) radius: usize,
    /// The largest change of each pixel over the phases.
    pub(super) largest: &'a Image,
    /// The strongest change of the view.
    pub(super) strongest: f32,
    /// Standard deviation of each pixel's noise.
    pub(super) noise: &'a [f32],
    /// Bound of rounding errors, which images that do not change have instead of noise.
    pub(super) rounding: f32,
}

/// Finds the interiors of the wide vessels; `None` where no vessel is wide.
pub(super) fn interiors(levels: &Levels<'_>) -> Option<Interiors> {
    let Levels { low, radius, largest, strongest, noise, rounding } = *levels;
    let size = [low.width, low.height];
    let background = opening(low, opening_radius(WIDEST_SHARE, low.width, low.height));
    let above = map2(low, &background, |low, background| low - background);
    let high: Vec<bool> = above.values.iter().map(|above| *above > MIN_HEIGHT * strongest).collect();
    let least_change = |noise: &f32| (MIN_CHANGE * strongest).max(MIN_CHANGE_SIGMAS * noise.max(rounding));
    let moves: Vec<bool> =
        largest.values.iter().zip(noise).map(|(change, noise)| *change > least_change(noise)).collect();
    // An edge lies where the opening of the level ends, or beside it.
    let edges = widened(&moves, size, radius);
    let min_pixels = (2 * radius + 1) * (2 * radius + 1);
    let mut inside = vec![false; high.len()];
    // Small regions are left out first: noise has many, and each of the others costs several filters of the whole image.
    for region in regions(&high, size).into_iter().filter(|region| region.len() >= min_pixels) {
        let mut part = vec![false; high.len()];
        region.iter().for_each(|pixel| part[*pixel] = true);
        let around = widened(&part, size, 1);
        let outline: Vec<usize> = (0..part.len()).filter(|pixel| around[*pixel] && !part[*pixel]).collect();
        let moving = outline.iter().filter(|pixel| edges[**pixel]).count() as f64;
        if !outline.is_empty() && moving >= MIN_MOVING_OUTLINE * outline.len() as f64 {
            let margin = widened(&part, size, radius);
            inside.iter_mut().zip(margin).for_each(|(inside, margin)| *inside |= margin);
        }
    }
    inside.contains(&true).then_some(Interiors { inside, background })
}

/// Returns the regions of a mask: sets of pixels that touch along a side.
fn regions(mask: &[bool], [width, height]: [usize; 2]) -> Vec<Vec<usize>> {
    let mut left = mask.to_vec();
    let mut regions = Vec::new();
    for first in 0..mask.len() {
        let (mut region, mut waiting) = (Vec::new(), vec![first]);
        while let Some(pixel) = waiting.pop() {
            if !std::mem::replace(&mut left[pixel], false) {
                continue;
            }
            region.push(pixel);
            let (x, y) = (pixel % width, pixel / width);
            waiting.extend([(x > 0).then(|| pixel - 1), (y > 0).then(|| pixel - width)].into_iter().flatten());
            waiting.extend(
                [(x + 1 < width).then_some(pixel + 1), (y + 1 < height).then_some(pixel + width)].into_iter().flatten(),
            );
        }
        if !region.is_empty() {
            regions.push(region);
        }
    }
    regions
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::evidence::background::Background;
    use crate::evidence::series::Series;
    use std::f64::consts::TAU;

    const SIDE: usize = 100;
    const PHASES: usize = 10;
    /// First pixel of the row in the middle.
    const ROW: usize = 50 * SIDE;

    /// A bar with soft edges across rows 20 to 80.
    fn bar(x: f64, y: f64, middle: f64, width: f64) -> f32 {
        let inside = |at: f64, middle: f64, width: f64| (0.5 + 0.5 * width - (at - middle).abs()).clamp(0.0, 1.0);
        (inside(x, middle, width) * inside(y, 50.0, 60.0)) as f32
    }

    /// A view of a static bar and of one that moves by half of `motion` pixels to each side, both `width` pixels wide.
    fn view(width: f64, motion: f64) -> Background {
        let image = |phase: usize| {
            let moved = 70.0 + 0.5 * motion * (TAU * phase as f64 / PHASES as f64).cos();
            let value = |p: usize| {
                let (x, y) = ((p % SIDE) as f64, (p / SIDE) as f64);
                1.0 + bar(x, y, 25.0, width) + bar(x, y, moved, width)
            };
            Some(Image { width: SIDE, height: SIDE, values: (0..SIDE * SIDE).map(value).collect() })
        };
        Background::new(Series { view: 0, images: (0..PHASES).map(image).collect(), vessels_alone: false })
    }

    #[test]
    fn the_inside_of_a_wide_vessel_is_no_background() {
        let background = view(14.0, 3.0);
        for (image, name) in [(&background.level, "level"), (&background.low, "low")] {
            assert!(
                (image.values[ROW + 70] - 1.0).abs() < 1e-5,
                "{name}: the background of a vessel is that around it"
            );
            assert!((image.values[ROW + 25] - 2.0).abs() < 1e-5, "{name}: a static structure is background");
        }
        let change = background.changes[0].as_ref().unwrap().values[ROW + 70];
        assert!((change - 1.0).abs() < 1e-5, "the vessel stands out as a whole, not by {change}");
        assert!((background.strongest - 1.0).abs() < 0.01, "{}", background.strongest);
    }

    #[test]
    fn vessels_alone_have_no_background() {
        let mut series = view(14.0, 3.0).stilled;
        series.vessels_alone = true;
        series.images.iter_mut().flatten().flat_map(|image| &mut image.values).for_each(|value| *value -= 1.0);
        let background = Background::new(series);
        assert!(background.level.values.iter().chain(&background.low.values).all(|value| *value == 0.0));
        let change = background.changes[0].as_ref().unwrap().values[ROW + 25];
        assert!((change - 1.0).abs() < 1e-6, "a vessel at rest stands out by {change}");
    }

    #[test]
    fn what_moves_along_a_part_of_its_outline_is_background() {
        // One side of the static bar touches a thin vessel that moves.
        let mut series = view(14.0, 0.0).stilled;
        for (phase, image) in series.images.iter_mut().flatten().enumerate() {
            for pixel in 0..SIDE * SIDE {
                let middle = 36.0 + (TAU * phase as f64 / PHASES as f64).cos();
                image.values[pixel] += bar((pixel % SIDE) as f64, (pixel / SIDE) as f64, middle, 2.0);
            }
        }
        let background = Background::new(series);
        assert!(background.strongest > 0.5, "the thin vessel moves");
        assert!((background.low.values[ROW + 25] - 2.0).abs() < 1e-5);
    }

    #[test]
    fn without_motion_there_are_no_interiors() {
        let background = view(14.0, 0.0);
        for x in [25, 70] {
            assert!((background.level.values[ROW + x] - 2.0).abs() < 1e-5, "the bar at column {x} is background");
        }
    }

    #[test]
    fn regions_touch_along_sides() {
        let mask = [true, true, false, false, false, true, true, false, true];
        let mut found = regions(&mask, [3, 3]);
        found.iter_mut().for_each(|region| region.sort_unstable());
        assert_eq!(found, [vec![0, 1], vec![5, 8], vec![6]]);
    }
}
