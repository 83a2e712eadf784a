//! Distance between a projected centreline and the ridge of the vessel in an image.

use crate::raster::Image;
use glam::DVec2;

/// Step of a profile across a vessel, pixels.
const STEP_PX: f64 = 0.5;
/// Number of steps of a profile to each side: a ridge farther away belongs to another vessel.
const STEPS: usize = 12;
/// Minimum height of a ridge, as a share of the strongest change of the view.
const MIN_RIDGE: f32 = 0.1;
/// A ridge reaches to both sides down to this share of its height.
const FOOT: f32 = 0.5;
/// Weight of the foot in the centre of a ridge, as a share of its height: the pixels at the foot count little.
const CENTRE_ABOVE: f32 = 0.45;

/// Returns the offset of the nearest ridge from a point along a direction across the vessel, pixels; `None` where the image has no ridge
/// nearby or ends there. `strongest` is the strongest change of the view.
pub(super) fn ridge_offset(change: &Image, strongest: f32, point: DVec2, across: DVec2) -> Option<f64> {
    let mut profile = [0.0; 2 * STEPS + 1];
    for (k, value) in profile.iter_mut().enumerate() {
        *value = interpolated(change, point + across * offset_px(k))?;
    }
    let is_ridge = |k: &usize| {
        profile[*k] >= profile[k - 1] && profile[*k] > profile[k + 1] && profile[*k] > MIN_RIDGE * strongest
    };
    let top = (1..2 * STEPS).filter(is_ridge).min_by_key(|k| k.abs_diff(STEPS))?;
    let goes_on = |from: usize, to: usize| profile[to] > FOOT * profile[top] && profile[to] <= profile[from];
    let first = (1..=top).rev().find(|k| !goes_on(*k, k - 1)).unwrap_or(0);
    let last = (top..2 * STEPS).find(|k| !goes_on(*k, k + 1)).unwrap_or(2 * STEPS);
    let (mut sum, mut weights) = (0.0, 0.0);
    for k in first..=last {
        let weight = f64::from(profile[k] - CENTRE_ABOVE * profile[top]);
        sum += weight * offset_px(k);
        weights += weight;
    }
    Some(sum / weights)
}

fn offset_px(k: usize) -> f64 {
    STEP_PX * (k as f64 - STEPS as f64)
}

/// Returns the value between pixels, whose centres are at integers; `None` outside the image.
fn interpolated(image: &Image, at: DVec2) -> Option<f32> {
    let inside = at.cmpge(DVec2::ZERO).all() && at.x < (image.width - 1) as f64 && at.y < (image.height - 1) as f64;
    if !inside {
        return None;
    }
    let (x, y) = (at.x as usize, at.y as usize);
    let (right, down) = (at.x.fract() as f32, at.y.fract() as f32);
    let row = |y: usize| {
        let row = &image.values[y * image.width + x..][..2];
        row[0] + right * (row[1] - row[0])
    };
    let (above, below) = (row(y), row(y + 1));
    Some(above + down * (below - above))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// An image of straight vessels along the rows, at columns and with heights.
    fn image(vessels: &[(f64, f64)]) -> Image {
        let value = |p: usize| {
            let x = (p % 40) as f64;
            vessels.iter().map(|(at, height)| height * (-0.5 * ((x - at) / 1.2f64).powi(2)).exp()).sum::<f64>() as f32
        };
        Image { width: 40, height: 30, values: (0..40 * 30).map(value).collect() }
    }

    #[test]
    fn the_nearest_ridge_is_found_to_a_fraction_of_a_pixel() {
        let one = image(&[(20.3, 1.0)]);
        let offset = |image: &Image, x: f64| ridge_offset(image, 1.0, DVec2::new(x, 14.7), DVec2::X);
        for x in [18.0, 19.6, 20.3, 22.9] {
            assert!((offset(&one, x).unwrap() - (20.3 - x)).abs() < 0.08, "{:?} at {x}", offset(&one, x));
        }
        let against = ridge_offset(&one, 1.0, DVec2::new(19.0, 14.0), -DVec2::X).unwrap();
        assert!((against + 1.3).abs() < 0.08, "the direction has a sign: {against}");
        let two = image(&[(20.0, 0.5), (25.0, 1.0)]);
        assert!((offset(&two, 21.0).unwrap() + 1.0).abs() < 0.2, "the nearer one, though it is lower");
    }

    #[test]
    fn no_ridge_nearby_is_none() {
        let faint = image(&[(20.0, 0.05)]);
        assert_eq!(ridge_offset(&faint, 1.0, DVec2::new(20.0, 15.0), DVec2::X), None);
        let far = image(&[(30.0, 1.0)]);
        assert_eq!(ridge_offset(&far, 1.0, DVec2::new(18.0, 15.0), DVec2::X), None);
        assert_eq!(ridge_offset(&far, 1.0, DVec2::new(36.0, 15.0), DVec2::X), None, "the image ends");
    }
}
