//! Displacement of the background in each frame of a run: a panned table, breathing of the chest, a patient who moves. Frames are compared
//! with the median of all frames after they were moved, so that vessels, which few frames show at one place, do not take part.

use crate::evidence::lines::{blurred, over_frames};
use crate::raster::{Image, median, percentile};
use rayon::prelude::*;

// Numbers of this file without another source: developed on simulated runs and on twelve clinical runs of two patients, which are
// therefore no independent test (docs/tried.md, runs without ECG).
/// Smallest and largest structures that are compared, standard deviations of Gaussians, mm at the isocentre.
const BAND_MM: [f64; 2] = [0.65, 5.2];
/// Robust standard deviations of the band at which values are cut off: each pixel then counts by area, so that a dark vessel is not stronger
/// than the texture around it.
const CUT: f32 = 1.5;
/// Furthest displacement of a frame from its neighbour, and from an earlier estimate, mm.
const REACH_MM: f64 = 10.0;
/// Correlation that a displacement by one pixel must gain, times the square of its length in pixels: where there is no texture, frames stay where
/// they are.
const NEARER: f32 = 1e-5;
/// Reduction of the images in which displacements are searched over the whole reach; the rest of the search is this far around the best one.
const REDUCTION: usize = 2;
/// Rounds of comparison with the median of the moved frames.
const ROUNDS: usize = 3;
/// Share of the pixels, those that vary least over the run, that are compared from the second round on: vessels and the border of the heart
/// are in the rest.
const STEADY_SHARE: f64 = 0.7;
/// Median of absolute values of a normal distribution, in standard deviations.
pub(super) const MEDIAN_OF_NORMAL: f32 = 0.6745;
/// Number of sums that are accumulated side by side.
const LANES: usize = 16;

/// An image with the weight of each pixel.
struct Weighted {
    width: usize,
    height: usize,
    /// Values times weights.
    values: Vec<f32>,
    /// Squared values times weights.
    squares: Vec<f32>,
    /// 1 where a pixel takes part, else 0.
    weights: Vec<f32>,
}

impl Weighted {
    fn new(image: &Image, weights: &[f32]) -> Weighted {
        let product = |f: fn(f32) -> f32| image.values.iter().zip(weights).map(|(v, w)| f(*v) * w).collect();
        Weighted {
            width: image.width,
            height: image.height,
            values: product(|v| v),
            squares: product(|v| v * v),
            weights: weights.to_vec(),
        }
    }

    /// Correlation with another image that is moved by whole pixels (columns, rows), over the pixels that take part in both. Means are not
    /// subtracted, since those of a band are near zero.
    fn correlation(&self, moved: &Weighted, [dx, dy]: [i32; 2]) -> f32 {
        let overlap = |d: i32, n: usize| (d.max(0) as usize, n.saturating_sub(d.unsigned_abs() as usize));
        let ((x, columns), (y, rows)) = (overlap(dx, self.width), overlap(dy, self.height));
        // Steps from frame to frame may add up to more than a small image.
        if columns == 0 || rows == 0 {
            return 0.0;
        }
        let mut sums = [0f32; 3];
        for row in 0..rows {
            let here = (y + row) * self.width + x;
            let there = (y + row).wrapping_add_signed(-dy as isize) * self.width + x.wrapping_add_signed(-dx as isize);
            let [a, b] = [here..here + columns, there..there + columns];
            sums[0] += product(&self.values[a.clone()], &moved.values[b.clone()]);
            sums[1] += product(&self.squares[a.clone()], &moved.weights[b.clone()]);
            sums[2] += product(&self.weights[a], &moved.squares[b]);
        }
        let [product, own, other] = sums;
        product / (own * other).sqrt().max(f32::MIN_POSITIVE)
    }

    /// Displacement of `moved` around `centre` that fits best, with a parabola through the neighbours of the best whole pixel.
    fn best(&self, moved: &Weighted, centre: [i32; 2], reach: i32) -> [f32; 2] {
        let side = 2 * reach + 1;
        let at = |k: i32| [centre[0] + k % side - reach, centre[1] + k / side - reach];
        let far = |k: i32| (k % side - reach).pow(2) + (k / side - reach).pow(2);
        let rate = |k: i32| self.correlation(moved, at(k)) - NEARER * far(k) as f32;
        let rated: Vec<f32> = (0..side * side).map(rate).collect();
        let best =
            (0..side * side).max_by(|a, b| rated[*a as usize].total_cmp(&rated[*b as usize])).unwrap_or_default();
        let [x, y] = at(best);
        let fraction = |place: i32, step: i32| match place.abs() {
            end if end == reach => 0.0,
            _ => summit([best - step, best, best + step].map(|k| rated[k as usize])),
        };
        [x as f32 + fraction(best % side - reach, 1), y as f32 + fraction(best / side - reach, side)]
    }
}

/// Scalar product of two rows, in sums side by side that a compiler can process in one instruction.
pub(super) fn product(a: &[f32], b: &[f32]) -> f32 {
    let mut sums = [0f32; LANES];
    let ((a, end_of_a), (b, end_of_b)) = (a.as_chunks::<LANES>(), b.as_chunks::<LANES>());
    for (a, b) in a.iter().zip(b) {
        (0..LANES).for_each(|lane| sums[lane] += a[lane] * b[lane]);
    }
    sums.iter().sum::<f32>() + end_of_a.iter().zip(end_of_b).map(|(a, b)| a * b).sum::<f32>()
}

/// An image and its reduction, in which a search begins.
struct Searched {
    whole: Weighted,
    reduced: Weighted,
}

impl Searched {
    fn new(image: &Image, weights: &[f32]) -> Searched {
        let small = reduced(image, REDUCTION);
        let of_weights = Image { width: image.width, height: image.height, values: weights.to_vec() };
        let small_weights = reduced(&of_weights, REDUCTION).values;
        Searched { whole: Weighted::new(image, weights), reduced: Weighted::new(&small, &small_weights) }
    }

    /// Displacement of `moved` around `centre` that fits best within a reach, pixels.
    fn best(&self, moved: &Searched, centre: [f32; 2], reach: i32) -> [f32; 2] {
        let factor = REDUCTION as f32;
        let around = centre.map(|v| (v / factor).round() as i32);
        let coarse = self.reduced.best(&moved.reduced, around, (reach + 1) / REDUCTION as i32);
        self.whole.best(&moved.whole, coarse.map(|v| (v * factor).round() as i32), REDUCTION as i32)
    }
}

/// Means of squares of pixels.
pub(super) fn reduced(image: &Image, factor: usize) -> Image {
    let (width, height) = (image.width / factor, image.height / factor);
    let mut out = Image::zeros(width, height);
    for y in 0..height * factor {
        let row = &mut out.values[y / factor * width..][..width];
        let source = &image.values[y * image.width..][..width * factor];
        row.iter_mut().zip(source.chunks(factor)).for_each(|(out, of)| *out += of.iter().sum::<f32>());
    }
    out.values.iter_mut().for_each(|v| *v /= (factor * factor) as f32);
    out
}

/// Place of the maximum of a parabola through three neighbouring values, relative to the middle one: from -0.5 to 0.5.
pub(super) fn summit([before, here, after]: [f32; 3]) -> f32 {
    let bend = before - 2.0 * here + after;
    if bend < 0.0 { (0.5 * (before - after) / bend).clamp(-0.5, 0.5) } else { 0.0 }
}

/// Structures of middle size, without an influence of pixels that do not show the patient.
struct Band {
    weights: Vec<f32>,
    /// Weights, blurred as images are.
    blurred: [Image; 2],
    sigmas: [f64; 2],
}

impl Band {
    fn new(weights: &Image, mm: f64) -> Band {
        let sigmas = BAND_MM.map(|length| length / mm);
        Band { weights: weights.values.clone(), blurred: sigmas.map(|sigma| blurred(weights, sigma)), sigmas }
    }

    /// Structures of an image in units of their robust deviation, cut off at [`CUT`].
    fn of(&self, image: &Image) -> Image {
        let product = |values: &[f32]| values.iter().zip(&self.weights).map(|(v, w)| v * w).collect();
        let seen = Image { values: product(&image.values), ..*image };
        let means = [0, 1].map(|k| {
            let sums = blurred(&seen, self.sigmas[k]);
            sums.values
                .iter()
                .zip(&self.blurred[k].values)
                .map(|(sum, weight)| sum / weight.max(1e-3))
                .collect::<Vec<f32>>()
        });
        let mut values: Vec<f32> = means[0].iter().zip(&means[1]).map(|(small, large)| small - large).collect();
        let deviation = robust_deviation(&values).max(f32::MIN_POSITIVE);
        values.iter_mut().for_each(|v| *v = (*v / deviation).clamp(-CUT, CUT));
        Image { values: product(&values), ..*image }
    }
}

/// Standard deviation of a normal distribution with the same median of distances from the median.
pub(super) fn robust_deviation(values: &[f32]) -> f32 {
    let middle = percentile(values, 0.5);
    let mut distances: Vec<f32> = values.iter().map(|v| (v - middle).abs()).collect();
    median(&mut distances) / MEDIAN_OF_NORMAL
}

/// Returns, for each frame, the displacement (columns, rows), pixels, that moves its background onto that of the other frames. `shown` marks
/// pixels that show the patient; `mm` is the size of a pixel at the isocentre.
pub(super) fn displacements(frames: &[Image], shown: &[bool], mm: f64) -> Vec<[f32; 2]> {
    let weights: Vec<f32> = shown.iter().map(|shown| f32::from(u8::from(*shown))).collect();
    let band = Band::new(&Image { values: weights.clone(), ..frames[0] }, mm);
    let bands: Vec<Image> = frames.par_iter().map(|frame| band.of(frame)).collect();
    let reach = (REACH_MM / mm).ceil() as i32;
    let compared: Vec<Searched> = bands.par_iter().map(|band| Searched::new(band, &weights)).collect();
    let steps: Vec<[f32; 2]> = compared.par_windows(2).map(|pair| pair[0].best(&pair[1], [0.0; 2], reach)).collect();
    let mut now = [0.0; 2];
    let mut places: Vec<[f32; 2]> = std::iter::once([0.0; 2])
        .chain(steps.into_iter().map(|step| {
            now = [now[0] + step[0], now[1] + step[1]];
            now
        }))
        .collect();
    let mut steady = weights.clone();
    for round in 0..ROUNDS {
        let middle = [0, 1].map(|axis| median(&mut places.iter().map(|place| place[axis]).collect::<Vec<f32>>()));
        places.iter_mut().for_each(|place| [0, 1].into_iter().for_each(|axis| place[axis] -= middle[axis]));
        let still: Vec<Image> = bands.par_iter().zip(&places).map(|(band, place)| moved(band, *place)).collect();
        let usual = over_frames(still.iter(), 0.5);
        if round > 0 {
            steady = steadiest(&still, &usual, shown);
        }
        let reference = Searched::new(&usual, &steady);
        let again = |(moved, place): (&Searched, &[f32; 2])| reference.best(moved, *place, reach);
        places = compared.par_iter().zip(&places).map(again).collect();
    }
    places
}

/// Weights of the pixels that vary least around their usual values.
fn steadiest(frames: &[Image], usual: &Image, shown: &[bool]) -> Vec<f32> {
    let distance = |frame: &Image| Image {
        values: frame.values.iter().zip(&usual.values).map(|(v, usual)| (v - usual).abs()).collect(),
        ..*usual
    };
    let spread = over_frames(frames.iter().map(distance).collect::<Vec<_>>().iter(), 0.5);
    let within: Vec<f32> = spread.values.iter().zip(shown).filter(|(_, shown)| **shown).map(|(v, _)| *v).collect();
    let limit = percentile(&within, STEADY_SHARE);
    spread.values.iter().zip(shown).map(|(v, shown)| f32::from(u8::from(*shown && *v <= limit))).collect()
}

/// Moves an image by a displacement (columns, rows) in pixels, with bilinear interpolation; outside, the border is continued.
pub(super) fn moved(image: &Image, [dx, dy]: [f32; 2]) -> Image {
    let (width, height) = (image.width, image.height);
    let ([fx, fy], [x0, y0]) = ([-dx, -dy].map(|d| d - d.floor()), [-dx, -dy].map(|d| d.floor() as isize));
    let clamped = |at: usize, by: isize, n: usize| (at as isize + by).clamp(0, n as isize - 1) as usize;
    let mut out = Image::zeros(width, height);
    for (y, row) in out.values.chunks_mut(width).enumerate() {
        let line = |by: isize| &image.values[clamped(y, by, height) * width..][..width];
        let (upper, lower) = (line(y0), line(y0 + 1));
        for (x, out) in row.iter_mut().enumerate() {
            let [left, right] = [x0, x0 + 1].map(|by| clamped(x, by, width));
            let [top, bottom] = [upper, lower].map(|line| line[left] + fx * (line[right] - line[left]));
            *out = top + fy * (bottom - top);
        }
    }
    out
}

/// Marks the pixels that every frame shows after it was moved.
pub(super) fn shown_by_all(shown: &[bool], [width, height]: [usize; 2], places: &[[f32; 2]]) -> Vec<bool> {
    let mut all = shown.to_vec();
    for place in places {
        let [dx, dy] = place.map(|d| d.round() as isize);
        for (p, all) in all.iter_mut().enumerate().filter(|(_, all)| **all) {
            let (x, y) = ((p % width) as isize - dx, (p / width) as isize - dy);
            let inside = (0..width as isize).contains(&x) && (0..height as isize).contains(&y);
            *all = inside && shown[y as usize * width + x as usize];
        }
    }
    all
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn images_without_a_common_pixel_are_not_alike() {
        let [width, height] = [9, 7];
        let image = Image { width, height, values: vec![1.0; width * height] };
        let weighted = Weighted::new(&image, &vec![1.0; width * height]);
        for displacement in [[9, 0], [-40, 2], [3, 7], [2, -30], [60, -60]] {
            assert_eq!(weighted.correlation(&weighted, displacement), 0.0, "{displacement:?}");
        }
        assert!((weighted.correlation(&weighted, [8, -6]) - 1.0).abs() < 1e-6);
    }

    #[test]
    fn an_image_moves_by_its_displacement() {
        let (width, height) = (9, 7);
        let mut image = Image::zeros(width, height);
        image.values[3 * width + 4] = 1.0;
        let at = |image: &Image, x: usize, y: usize| image.values[y * width + x];
        let whole = moved(&image, [2.0, -1.0]);
        assert_eq!((at(&whole, 6, 2), whole.values.iter().sum::<f32>()), (1.0, 1.0));
        let half = moved(&image, [-0.5, 0.0]);
        assert_eq!([3, 4, 5].map(|x| at(&half, x, 3)), [0.5, 0.5, 0.0]);
        let shown = vec![true; width * height];
        let all = shown_by_all(&shown, [width, height], &[[2.0, 0.0], [0.0, -1.0]]);
        let marked: Vec<usize> = (0..all.len()).filter(|p| all[*p]).collect();
        assert_eq!((marked[0], marked[marked.len() - 1], marked.len()), (2, 5 * width + 8, 7 * 6));
    }
}
