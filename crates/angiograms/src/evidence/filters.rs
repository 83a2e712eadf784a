//! Filters of images with non-uniform noise: Gaussians, and matched filters for straight pieces of vessel.

use crate::raster::Image;
use rayon::prelude::*;

/// Taps of lines below this share of the middle one are dropped.
const MIN_TAP: f32 = 0.01;

/// Weights of a Gaussian of `sigma` pixels; their sum is 1.
pub(super) fn gaussian(sigma: f32) -> Vec<f32> {
    let radius = (3.0 * sigma) as i32 + 1;
    let weights: Vec<f32> = (-radius..=radius).map(|i| (-0.5 * (i as f32 / sigma).powi(2)).exp()).collect();
    let sum: f32 = weights.iter().sum();
    weights.iter().map(|w| w / sum).collect()
}

/// Correlates rows and columns with `kernel` (odd length); outside, the border's pixels are continued.
pub(super) fn separable(image: &Image, kernel: &[f32]) -> Image {
    rows_and_columns(image, kernel, kernel)
}

/// Correlates rows with one kernel and columns with another one, both of the same odd length, as [`separable`] does.
pub(super) fn rows_and_columns(image: &Image, of_rows: &[f32], of_columns: &[f32]) -> Image {
    let (w, h) = (image.width, image.height);
    let radius = of_rows.len() / 2;
    let at = |centre: usize, k: usize, end: usize| (centre + k).saturating_sub(radius).min(end - 1);
    let mut rows = Image::zeros(w, h);
    let mut continued = vec![0f32; w + 2 * radius];
    for (source, row) in image.values.chunks(w).zip(rows.values.chunks_mut(w)) {
        continued.iter_mut().enumerate().for_each(|(x, value)| *value = source[at(x, 0, w)]);
        for (k, weight) in of_rows.iter().enumerate() {
            row.iter_mut().zip(&continued[k..]).for_each(|(out, v)| *out += weight * v);
        }
    }
    let mut out = Image::zeros(w, h);
    for (y, row) in out.values.chunks_mut(w).enumerate() {
        for (k, weight) in of_columns.iter().enumerate() {
            let source = &rows.values[at(y, k, h) * w..][..w];
            row.iter_mut().zip(source).for_each(|(out, v)| *out += weight * v);
        }
    }
    out
}

/// An estimate of each pixel's line integral and its standard deviation.
#[derive(Debug, Clone)]
pub(super) struct Estimate {
    pub(super) amplitude: Image,
    pub(super) deviation: Image,
}

/// Gaussian mean of the neighbourhood over `sigma` pixels, with pixels weighted by `weight` (inverse variance).
pub(super) fn blob(values: &Image, weight: &Image, sigma: f32) -> Estimate {
    let kernel = gaussian(sigma);
    let squared: Vec<f32> = kernel.iter().map(|k| k * k).collect();
    let weighted = map2(values, weight, |v, w| v * w);
    let mass = separable(weight, &kernel);
    Estimate {
        amplitude: map2(&separable(&weighted, &kernel), &mass, |sum, mass| sum / mass),
        deviation: map2(&separable(weight, &squared), &mass, |square, mass| square.sqrt() / mass),
    }
}

pub(super) fn map2(a: &Image, b: &Image, f: impl Fn(f32, f32) -> f32) -> Image {
    let values = a.values.iter().zip(&b.values).map(|(a, b)| f(*a, *b)).collect();
    Image { width: a.width, height: a.height, values }
}

/// A straight piece of vessel in several orientations.
pub(super) struct LineFilter {
    radius: usize,
    /// Taps of each orientation: offsets along x and y, weight.
    orientations: Vec<Vec<(i32, i32, f32)>>,
}

impl LineFilter {
    /// Creates pieces of about `length` pixels, `width` pixels (standard deviation) across.
    pub(super) fn new(length: f32, width: f32) -> LineFilter {
        let count = if length < 10.0 { 12 } else { 16 };
        let radius = (0.75 * length).max(3.0 * width).ceil() as i32 + 1;
        let taps = |angle: f32| {
            let (sin, cos) = angle.sin_cos();
            let offsets = (-radius..=radius).flat_map(|y| (-radius..=radius).map(move |x| (x, y)));
            let weigh = |(x, y): (i32, i32)| {
                let (fx, fy) = (x as f32, y as f32);
                let (along, across) = (fx * cos + fy * sin, fy * cos - fx * sin);
                let weight = (-0.5 * (along / (length / 2.5)).powi(2) - 0.5 * (across / width).powi(2)).exp();
                (x, y, weight)
            };
            offsets.map(weigh).filter(|(_, _, weight)| *weight > MIN_TAP).collect()
        };
        let orientations = (0..count).map(|k| taps(k as f32 * std::f32::consts::PI / count as f32)).collect();
        LineFilter { radius: radius as usize, orientations }
    }

    /// Sums of h h w per orientation, which depend on the weights only and are shared by all phases.
    pub(super) fn energies(&self, weight: &Image) -> Vec<Image> {
        let padded = Padded::new(weight, self.radius);
        self.orientations
            .par_iter()
            .map(|taps| {
                let mut energy = Image::zeros(weight.width, weight.height);
                for (y, row) in energy.values.chunks_mut(weight.width).enumerate() {
                    padded.add_row(y, taps.iter().map(|(dx, dy, h)| (*dx, *dy, h * h)), row);
                }
                energy
            })
            .collect()
    }

    /// Amplitude of the best orientation, the one with the maximum ratio to its standard deviation, minus `bias` standard
    /// deviations, and that standard deviation, in the rows marked `wanted`. `weighted` is the image times its weights.
    pub(super) fn best(&self, weighted: &Image, energies: &[Image], bias: f32, wanted: &[bool]) -> Estimate {
        let (w, h) = (weighted.width, weighted.height);
        let padded = Padded::new(weighted, self.radius);
        let mut amplitude = Image::zeros(w, h);
        let mut deviation = Image::zeros(w, h);
        let rows = amplitude.values.chunks_mut(w).zip(deviation.values.chunks_mut(w)).enumerate();
        for (y, (amplitude, deviation)) in rows.filter(|(y, _)| wanted[*y]) {
            let mut best = vec![f32::MIN; w];
            let mut sums = vec![0f32; w];
            for (taps, energy) in self.orientations.iter().zip(energies) {
                sums.fill(0.0);
                padded.add_row(y, taps.iter().copied(), &mut sums);
                let energy = &energy.values[y * w..][..w];
                for x in 0..w {
                    let tau = 1.0 / energy[x].max(1e-30).sqrt();
                    let ratio = sums[x] * tau;
                    if ratio > best[x] {
                        best[x] = ratio;
                        deviation[x] = tau;
                    }
                }
            }
            for x in 0..w {
                amplitude[x] = (best[x] - bias) * deviation[x];
            }
        }
        Estimate { amplitude, deviation }
    }
}

/// An image with a border of zeros: outside, there is no measurement.
struct Padded {
    border: usize,
    stride: usize,
    values: Vec<f32>,
}

impl Padded {
    fn new(image: &Image, border: usize) -> Padded {
        let stride = image.width + 2 * border;
        let mut values = vec![0.0; stride * (image.height + 2 * border)];
        for (y, row) in image.values.chunks(image.width).enumerate() {
            values[(y + border) * stride + border..][..image.width].copy_from_slice(row);
        }
        Padded { border, stride, values }
    }

    /// Adds the neighbours at the taps' offsets, weighted, to a row.
    fn add_row(&self, y: usize, taps: impl Iterator<Item = (i32, i32, f32)>, row: &mut [f32]) {
        for (dx, dy, weight) in taps {
            let line = (y + self.border).wrapping_add_signed(dy as isize) * self.stride;
            let source = &self.values[line + self.border.wrapping_add_signed(dx as isize)..][..row.len()];
            row.iter_mut().zip(source).for_each(|(sum, v)| *sum += weight * v);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_blob_of_equal_weights_keeps_the_mean_and_quietens_noise() {
        let (values, weight) = (
            Image { width: 9, height: 9, values: vec![2.0; 81] },
            Image { width: 9, height: 9, values: vec![4.0; 81] },
        );
        let seen = blob(&values, &weight, 0.9);
        let kernel = gaussian(0.9);
        let square: f32 = kernel.iter().map(|k| k * k).sum();
        assert!(seen.amplitude.values.iter().all(|v| (v - 2.0).abs() < 1e-5));
        // The standard deviation of a weighted mean is the noise (1 / 2) times the kernel's norm along both axes.
        assert!((seen.deviation.values[40] - 0.5 * square).abs() < 1e-5, "{}", seen.deviation.values[40]);
    }

    #[test]
    fn a_line_is_measured_along_its_own_orientation() {
        let filter = LineFilter::new(9.0, 1.0);
        let (w, h) = (41, 41);
        let angle = 2.0 * std::f32::consts::PI / 12.0;
        let profile = |p: usize| {
            let (x, y) = ((p % w) as f32 - 20.0, (p / w) as f32 - 20.0);
            0.3 * (-0.5 * (y * angle.cos() - x * angle.sin()).powi(2)).exp()
        };
        let line = Image { width: w, height: h, values: (0..w * h).map(profile).collect() };
        let weight = Image { width: w, height: h, values: vec![100.0; w * h] };
        let energies = filter.energies(&weight);
        let seen = filter.best(&map2(&line, &weight, |v, w| v * w), &energies, 0.0, &vec![true; h]);
        let middle = seen.amplitude.values[20 * w + 20];
        // The filter's ends fade while the line continues, so the amplitude slightly exceeds the line's height.
        assert!((0.3..0.45).contains(&middle), "{middle}");
        let tau = seen.deviation.values[20 * w + 20];
        assert!(tau < 0.1 / 3.0, "quieter than a pixel (0.1): {tau}");
        assert!(seen.amplitude.values[5 * w + 35] < 0.05, "nothing beside the line");
    }
}
