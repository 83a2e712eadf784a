//! What moves in the angiograms, found without segmentation: each view's still background, its noise,
//! and the motion hull, the set of points whose projection changes over time in every view that sees them.

use super::dataset::Dataset;
use super::geometry::{MM_PER_UNIT, ViewRays};
use super::images::Image;
use super::volume::Volume;
use crate::config;
use glam::{DAffine3, DMat3, DVec3};
use rayon::prelude::*;

/// Temporal behaviour of one training view.
#[derive(Debug, Clone)]
pub struct ViewMotion {
    /// Index into [`Dataset::views`].
    pub view: usize,
    /// Upper bound of the still background: each pixel's smallest line integral over the phases, corrected for
    /// the bias that taking a minimum of noisy values has.
    pub background: Vec<f32>,
    /// Lower bound of the still background: what remains of it without structures as thin as vessels, since a
    /// vessel that covers a pixel at every phase is part of the minimum.
    pub background_low: Vec<f32>,
    /// Largest integral above the background over the phases.
    pub range: Vec<f32>,
    /// Standard deviation of a pixel's noise.
    pub noise: Vec<f32>,
    /// Pixels that move at some phase.
    pub moving: Vec<bool>,
    /// Pixels that stand out of the background at each phase of the dataset; empty for phases not seen.
    pub moving_at: Vec<Vec<bool>>,
    /// Training phases of this view.
    pub n_phases: usize,
}

/// Binary volumes on a regular grid, one for all phases or one per phase; world units, x fastest.
#[derive(Debug, Clone, PartialEq)]
pub struct Hull {
    /// Cells along x, y, z.
    pub size: [usize; 3],
    /// Lower corner.
    pub min: DVec3,
    /// Side of a cell.
    pub cell: f64,
    /// Volumes: 1, or one per phase.
    pub n_phases: usize,
    /// 32 cells to a word, lowest bit first; each phase starts a new word.
    pub bits: Vec<u32>,
}

/// How far the smallest of `n` standard normal draws lies below the mean, on average.
pub(crate) fn expected_minimum(n: usize) -> f64 {
    // Blom's approximation of the first normal order statistic.
    if n < 2 {
        return 0.0;
    }
    let p = (1.0 - 0.375) / (n as f64 + 0.25);
    // Inverse of the normal tail by bisection.
    let (mut low, mut high) = (0.0, 8.0);
    for _ in 0..60 {
        let mid = 0.5 * (low + high);
        if upper_tail(mid) > p { low = mid } else { high = mid }
    }
    0.5 * (low + high)
}

/// P(X > z) of a standard normal (Abramowitz and Stegun 26.2.17, error below 7.5e-8).
fn upper_tail(z: f64) -> f64 {
    let t = 1.0 / (1.0 + 0.231_641_9 * z);
    let poly =
        t * (0.319_381_530 + t * (-0.356_563_782 + t * (1.781_477_937 + t * (-1.821_255_978 + t * 1.330_274_429))));
    (-0.5 * z * z).exp() / std::f64::consts::TAU.sqrt() * poly
}

pub(crate) fn median(values: &mut [f32]) -> f32 {
    if values.is_empty() {
        return 0.0;
    }
    let middle = values.len() / 2;
    *values.select_nth_unstable_by(middle, f32::total_cmp).1
}

/// Noise of each pixel: successive phases of a still pixel differ by noise alone, and noise depends on
/// intensity; so pixels are grouped by intensity and each group's median temporal deviation is its noise. A group that
/// consists of moving vessels, as the darkest of an image with a plain background does, would pass them off as noise;
/// so none is noisier than a few times the image as a whole.
pub(crate) fn noise_by_intensity(mean: &[f32], deviation: &[f32]) -> Vec<f32> {
    const GROUPS: usize = 24;
    const NOISIEST: f32 = 6.0;
    let most = NOISIEST * median(&mut deviation.to_vec());
    let mut order: Vec<u32> = (0..mean.len() as u32).collect();
    order.sort_unstable_by(|a, b| mean[*a as usize].total_cmp(&mean[*b as usize]));
    let mut noise = vec![0.0; mean.len()];
    for group in order.chunks(mean.len().div_ceil(GROUPS)) {
        let level = median(&mut group.iter().map(|i| deviation[*i as usize]).collect::<Vec<_>>());
        for i in group {
            noise[*i as usize] = level.min(most);
        }
    }
    noise
}

/// Analyses each training view.
pub fn analyse(dataset: &Dataset, config: &config::Hull) -> Vec<ViewMotion> {
    let views = dataset.training_views();
    let min_share = if views.len() < 4 { config.min_share_few_views } else { config.min_share } as f32;
    views
        .into_par_iter()
        .map(|view| {
            let mut frames: Vec<_> = dataset.training().iter().filter(|f| f.view == view).collect();
            frames.sort_by_key(|f| f.phase);
            let n = frames.len();
            let pixels = dataset.n_pixels();
            let at = |p: usize| frames.iter().map(move |f| f.integrals[p]);
            let mean: Vec<f32> = (0..pixels).map(|p| at(p).sum::<f32>() / n as f32).collect();
            // Successive differences over sqrt 2: slow change over the beat counts little.
            let deviation: Vec<f32> = (0..pixels)
                .map(|p| {
                    let mut steps: Vec<f32> =
                        frames.windows(2).map(|w| (w[1].integrals[p] - w[0].integrals[p]).abs()).collect();
                    median(&mut steps) * (1.4826 / std::f32::consts::SQRT_2)
                })
                .collect();
            let noise = noise_by_intensity(&mean, &deviation);
            let bias = expected_minimum(n) as f32;
            let lowest: Vec<f32> = (0..pixels).map(|p| at(p).fold(f32::INFINITY, f32::min)).collect();
            let highest: Vec<f32> = (0..pixels).map(|p| at(p).fold(f32::NEG_INFINITY, f32::max)).collect();
            let background: Vec<f32> =
                lowest.iter().zip(&noise).map(|(l, s)| if n > 1 { l + bias * s } else { 0.0 }).collect();
            let image = |values: Vec<f32>| Image { width: dataset.width, height: dataset.height, values };
            let vessel = config.vessel_pixels as usize;
            let background_low = if vessel > 0 && n > 1 {
                opening(&image(background.clone()), vessel).values
            } else {
                background.clone()
            };
            let range: Vec<f32> = highest.iter().zip(&background).map(|(h, b)| (h - b).max(0.0)).collect();
            let strongest = percentile(&range, 0.995);
            let threshold = |p: usize| (config.noise_sigmas as f32 * noise[p]).max(min_share * strongest);
            let grow = |marked: &dyn Fn(usize) -> bool| -> Vec<bool> {
                let marked = (0..pixels).map(|p| f32::from(u8::from(n > 1 && marked(p))));
                let grown = dilate(&image(marked.collect()), config.dilate_pixels as usize);
                grown.values.iter().map(|v| *v > 0.0).collect()
            };
            let mut moving_at = vec![Vec::new(); dataset.n_phases as usize];
            for frame in &frames {
                let stands_out = |p: usize| frame.integrals[p] - background_low[p] > threshold(p);
                moving_at[frame.phase as usize] = grow(&|p| range[p] > threshold(p) && stands_out(p));
            }
            let moving = grow(&|p| range[p] > threshold(p));
            ViewMotion { view, moving, moving_at, background, background_low, range, noise, n_phases: n }
        })
        .collect()
}

/// The value below which `share` of the values lie.
pub fn percentile(values: &[f32], share: f64) -> f32 {
    let mut sorted = values.to_vec();
    if sorted.is_empty() {
        return 0.0;
    }
    let index = ((sorted.len() - 1) as f64 * share) as usize;
    *sorted.select_nth_unstable_by(index, f32::total_cmp).1
}

fn filter(image: &Image, radius: usize, pick: impl Fn(f32, f32) -> f32 + Sync) -> Image {
    let (w, h) = (image.width, image.height);
    let window = |centre: usize, end: usize| centre.saturating_sub(radius)..(centre + radius + 1).min(end);
    let mut rows = Image::zeros(w, h);
    for y in 0..h {
        for x in 0..w {
            rows.values[y * w + x] = window(x, w).map(|k| image.values[y * w + k]).reduce(&pick).unwrap_or(0.0);
        }
    }
    let mut out = Image::zeros(w, h);
    for y in 0..h {
        for x in 0..w {
            out.values[y * w + x] = window(y, h).map(|k| rows.values[k * w + x]).reduce(&pick).unwrap_or(0.0);
        }
    }
    out
}

/// Grey dilation by a square of `2 radius + 1` pixels.
pub(crate) fn dilate(image: &Image, radius: usize) -> Image {
    filter(image, radius, f32::max)
}

/// Grey opening: what is narrower than `2 radius + 1` pixels is cut down to its surroundings.
pub(crate) fn opening(image: &Image, radius: usize) -> Image {
    dilate(&filter(image, radius, f32::min), radius)
}

impl Hull {
    /// Cells of a cube of half side `half` (world units) that every view seeing them shows moving; at least
    /// two views (or the only one) must see them. With `per_phase`, cells are kept for the phases at which
    /// every view that has the phase shows something there.
    pub fn carve(dataset: &Dataset, motion: &[ViewMotion], half: f64, resolution: usize, per_phase: bool) -> Hull {
        let n = resolution;
        let cells = n * n * n;
        let cell = 2.0 * half / n as f64;
        let min = DVec3::splat(-half);
        let projectors: Vec<_> =
            motion.iter().map(|m| Projector::new(&dataset.views[m.view].rays, dataset.width, dataset.height)).collect();
        let needed = motion.len().min(2);
        // For each kept cell, the pixel it falls on in each view.
        let kept: Vec<(usize, Vec<Option<usize>>)> = (0..cells)
            .into_par_iter()
            .filter_map(|index| {
                let (x, y, z) = (index % n, index / n % n, index / (n * n));
                let centre = min + (DVec3::new(x as f64, y as f64, z as f64) + 0.5) * cell;
                let mut pixels = Vec::with_capacity(projectors.len());
                for (projector, m) in projectors.iter().zip(motion) {
                    let pixel = projector.pixel(centre);
                    if pixel.is_some_and(|p| !m.moving[p]) {
                        return None;
                    }
                    pixels.push(pixel);
                }
                (pixels.iter().flatten().count() >= needed).then_some((index, pixels))
            })
            .collect();
        let n_phases = if per_phase { dataset.n_phases as usize } else { 1 };
        let words = cells.div_ceil(32);
        let mut bits = vec![0u32; words * n_phases];
        for (phase, bits) in bits.chunks_mut(words).enumerate() {
            for (index, pixels) in &kept {
                let shown = |(pixel, m): (&Option<usize>, &ViewMotion)| {
                    let at = &m.moving_at[phase];
                    pixel.is_none_or(|p| !per_phase || at.is_empty() || at[p])
                };
                if pixels.iter().zip(motion).all(shown) {
                    bits[index / 32] |= 1 << (index % 32);
                }
            }
        }
        Hull { size: [n; 3], min, cell, n_phases, bits }
    }

    /// Words of one phase's volume.
    pub fn words(&self) -> usize {
        self.bits.len() / self.n_phases
    }

    /// The hull as a volume, to look at: the number of phases at which a cell is kept.
    pub fn to_volume(&self) -> Volume {
        let cell_mm = self.cell * MM_PER_UNIT;
        // Index axes follow the world's (posterior, left, superior); LPS swaps the first two.
        let axes = DMat3::from_cols(DVec3::Y * cell_mm, DVec3::X * cell_mm, DVec3::Z * cell_mm);
        let first = (self.min + 0.5 * self.cell) * MM_PER_UNIT;
        let count = |i: usize| self.bits.chunks(self.words()).filter(|w| w[i / 32] >> (i % 32) & 1 == 1).count();
        Volume {
            size: self.size,
            values: (0..self.size.iter().product()).map(|i| count(i) as f32).collect(),
            index_to_lps: DAffine3::from_mat3_translation(axes, DVec3::new(first.y, first.x, first.z)),
        }
    }

    /// Whether a point lies in a cell kept at a phase.
    pub fn contains_point(&self, point: DVec3, phase: usize) -> bool {
        let c = ((point - self.min) / self.cell).floor();
        let inside = |v: f64, n: usize| v >= 0.0 && v < n as f64;
        if !(inside(c.x, self.size[0]) && inside(c.y, self.size[1]) && inside(c.z, self.size[2])) {
            return false;
        }
        let index = (c.z as usize * self.size[1] + c.y as usize) * self.size[0] + c.x as usize;
        let start = if self.n_phases > 1 { phase * self.words() } else { 0 };
        self.bits[start + index / 32] >> (index % 32) & 1 == 1
    }

    /// Kept share of all cells, averaged over phases.
    pub fn share(&self) -> f64 {
        let kept: u64 = self.bits.iter().map(|w| u64::from(w.count_ones())).sum();
        kept as f64 / (self.size.iter().product::<usize>() * self.n_phases) as f64
    }

    /// Lower and upper corner of the cells kept at any phase; `None` when nothing is kept.
    pub fn bounds(&self) -> Option<(DVec3, DVec3)> {
        let (mut low, mut high) = (DVec3::INFINITY, DVec3::NEG_INFINITY);
        let [nx, ny, _] = self.size;
        for (word, bits) in self.bits.iter().enumerate().filter(|(_, bits)| **bits != 0) {
            for bit in (0..32).filter(|bit| bits >> bit & 1 == 1) {
                let index = word % self.words() * 32 + bit;
                let cell = DVec3::new((index % nx) as f64, (index / nx % ny) as f64, (index / (nx * ny)) as f64);
                let corner = self.min + cell * self.cell;
                low = low.min(corner);
                high = high.max(corner + self.cell);
            }
        }
        low.is_finite().then_some((low, high))
    }
}

/// World point to pixel.
pub(crate) struct Projector {
    source: DVec3,
    inverse: DMat3,
    width: i64,
    height: i64,
}

impl Projector {
    pub(crate) fn new(rays: &ViewRays, width: usize, height: usize) -> Self {
        let basis = DMat3::from_cols(rays.direction[1], rays.direction[2], rays.direction[0]);
        Projector { source: rays.source(), inverse: basis.inverse(), width: width as i64, height: height as i64 }
    }

    /// Index of the pixel a point falls on; `None` when the view does not see it.
    pub(crate) fn pixel(&self, point: DVec3) -> Option<usize> {
        let h = self.inverse * (point - self.source);
        if h.z <= 0.0 {
            return None;
        }
        let (i, j) = ((h.x / h.z).round() as i64, (h.y / h.z).round() as i64);
        (i >= 0 && j >= 0 && i < self.width && j < self.height).then_some((j * self.width + i) as usize)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn expected_minimum_of_ten_normals() {
        assert!((expected_minimum(10) - 1.5388).abs() < 0.01, "{}", expected_minimum(10));
        assert_eq!(expected_minimum(1), 0.0);
    }

    #[test]
    fn moving_vessels_are_not_taken_for_noise() {
        // The brightest tenth moves; all else is still but for noise of 0.01.
        let mean: Vec<f32> = (0..1000).map(|i| i as f32).collect();
        let deviation: Vec<f32> = (0..1000).map(|i| if i >= 900 { 0.5 } else { 0.01 }).collect();
        let noise = noise_by_intensity(&mean, &deviation);
        assert!((noise[0] - 0.01).abs() < 1e-6 && noise[999] <= 0.06 + 1e-6, "{}", noise[999]);
    }

    #[test]
    fn opening_cuts_thin_and_keeps_wide() {
        let mut image = Image::zeros(20, 20);
        for y in 0..20 {
            image.values[y * 20 + 3] = 1.0;
            for x in 8..20 {
                image.values[y * 20 + x] = 1.0;
            }
        }
        let opened = opening(&image, 2);
        assert_eq!((opened.values[5 * 20 + 3], opened.values[5 * 20 + 14]), (0.0, 1.0));
    }
}
