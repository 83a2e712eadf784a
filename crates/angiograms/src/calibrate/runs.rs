//! Alignment of runs that were taken one after the other, from the vessels of single frames: which part of the beat each run shows at its
//! first frame, and by how much the patient was displaced between the runs.
//!
//! Vessels of two views have equal integrals over each plane through both sources (epipolar consistency, as in
//! [`profiles`](crate::calibrate::profiles)). A displacement of the patient along the normal of these planes moves the profile of a view, so
//! the correlation of two profiles is highest at the displacement that lies between them; it is also highest where both views show the
//! same part of the beat. A displacement along the planes changes no profile of a pair.

use crate::geometry::{MM_PER_UNIT, ViewRays};
use crate::linear::Symmetric;
use crate::raster::Image;
use glam::DVec3;
use rayon::prelude::*;

// Numbers of this file without another source: developed on simulated runs and on twelve clinical runs of two patients, which are
// therefore no independent test (docs/tried.md, runs without ECG).
/// Number of images of a beat, at equal distances in time.
pub const STEPS: usize = 20;
/// Width of a bin of profiles, mm at the isocentre.
const BIN_MM: f64 = 0.25;
/// Profiles reach to this distance from the isocentre, mm.
const REACH_MM: f64 = 90.0;
/// Largest displacement between two runs, mm.
const DISPLACED_MM: f64 = 25.0;
/// Standard deviations of the Gaussians whose difference smooths profiles, mm: as wide as thin vessels, and as the tree's branches are apart.
const BAND_MM: [f64; 2] = [0.5, 10.0];
/// Shortest overlap of two profiles, mm.
const MIN_OVERLAP_MM: f64 = 15.0;
/// Furthest displacement of a part of the beat from the whole run that is allowed while parts of beats are compared, mm.
const WITHIN_BEAT_MM: f64 = 3.0;
/// Distance from the best displacement of a pair beyond which another peak is an alternative to it, mm.
const OTHER_PEAK_MM: f64 = 4.0;
/// Lead of a peak over the next one that a pair without a lead is taken to have.
const MIN_LEAD: f64 = 0.01;
/// Penalty on displacements that no pair determines, as a share of the mean weight of the pairs.
const UNDETERMINED: f64 = 4e-4;
/// Penalty on the displacements of runs, in correlation per mm^2.
const SMALL_PER_MM2: f64 = 2e-4;
/// Ratio between neighbouring scales of a run that are tried, as a logarithm: 2 %.
const SCALE_STEP: f64 = 0.02;
/// Number of steps to larger and to smaller scales that are tried: distances that are assumed are wrong by up to 16 %.
const SCALE_REACH: i32 = 8;
/// Mean gain in correlation of the pairs from which runs are scaled. Right distances of two simulated sets and a clinical pair gain less;
/// distances that are wrong by 10 % lose .1 on that pair.
const SCALE_GAIN: f64 = 0.03;
/// Steps of the search for the displacements of three and more runs, mm.
const SEARCH_MM: [f64; 6] = [8.0, 4.0, 2.0, 1.0, 0.5, 0.25];

/// A run: the rays of its images, and the vessels at [`STEPS`] equally spaced times of a beat that begins anywhere.
pub struct Beating<'a> {
    /// Rays of the images.
    pub rays: &'a ViewRays,
    /// Line integrals of the vessels at each step.
    pub steps: Vec<&'a Image>,
}

/// Agreement of two runs.
#[derive(Debug, Clone, PartialEq)]
pub struct PairAgreement {
    /// The runs, by their place in the list.
    pub runs: [usize; 2],
    /// Correlation of their profiles at the stated geometry.
    pub stated: f64,
    /// Correlation of their profiles with the displacements of the runs.
    pub aligned: f64,
    /// Displacement between the runs along the normal of their planes, mm.
    pub displaced_mm: f64,
}

/// Result of [`align`].
#[derive(Debug, Clone, PartialEq)]
pub struct Aligned {
    /// For each run, the step of its own that shows the state of the heart of step 0 of the first run.
    pub first_step: Vec<usize>,
    /// For each run, the factor on the size of its pixels that makes vessels as large as in the other runs; 1 where the stated sizes agree.
    pub scale: Vec<f64>,
    /// For each run, the displacement of the patient, world units.
    pub displaced: Vec<DVec3>,
    /// Pairs of runs that constrain each other.
    pub pairs: Vec<PairAgreement>,
}

/// Planes through two sources, with the profiles of both runs.
struct Pair {
    runs: [usize; 2],
    /// Normal of the plane through the isocentre.
    normal: DVec3,
    profiles: [Vec<Profile>; 2],
}

/// Integrals of a frame over planes, and the bins that its images cover.
#[derive(Clone)]
struct Profile {
    values: Vec<f64>,
    covered: std::ops::Range<usize>,
}

/// Correlations by displacement, from `-DISPLACED_MM` to `DISPLACED_MM` in bins.
type Curve = Vec<f64>;

fn reach() -> usize {
    (DISPLACED_MM / BIN_MM) as usize
}

/// Aligns runs; one run is as it is.
pub fn align(runs: &[Beating<'_>]) -> Aligned {
    let mut pairs: Vec<Pair> =
        (0..runs.len()).flat_map(|b| (0..b).map(move |a| [a, b])).filter_map(|pair| Pair::new(pair, runs)).collect();
    let scale = scales(runs.len(), &pairs);
    if scale.iter().any(|scale| *scale != 1.0) {
        pairs = pairs.into_iter().map(|pair| pair.scaled(&scale)).collect();
    }
    let first_step = first_steps(runs.len(), &pairs);
    let means: Vec<Curve> = pairs.par_iter().map(|pair| mean(&pair.curves(&first_step))).collect();
    let displaced = displacements(runs.len(), &pairs, &means);
    let agreement = |(pair, curve): (&Pair, &Curve)| PairAgreement {
        runs: pair.runs,
        stated: value_at(curve, 0.0),
        aligned: value_at(curve, pair.between(&displaced)),
        displaced_mm: pair.between(&displaced),
    };
    Aligned {
        first_step,
        scale,
        pairs: pairs.iter().zip(&means).map(agreement).collect(),
        displaced: displaced.into_iter().map(|d| d / MM_PER_UNIT).collect(),
    }
}

impl Pair {
    /// Computes the profiles of two runs; none where the line through both sources meets the heart, so that planes cannot be told apart.
    fn new(pair: [usize; 2], runs: &[Beating<'_>]) -> Option<Pair> {
        let sources = pair.map(|run| runs[run].rays.source());
        let baseline = (sources[1] - sources[0]).try_normalize()?;
        let towards = -(sources[0] - baseline * sources[0].dot(baseline));
        let distance_mm = towards.length() * MM_PER_UNIT;
        if distance_mm < 2.0 * REACH_MM {
            return None;
        }
        let (middle, normal) = (towards.normalize(), baseline.cross(towards.normalize()));
        let profiles = pair.map(|run| {
            let Beating { rays, steps } = &runs[run];
            let place = |column: f64, row: f64| {
                let direction = rays.pixel(column, row).1;
                (distance_mm * direction.dot(normal) / direction.dot(middle) + REACH_MM) / BIN_MM
            };
            steps.par_iter().map(|image| Profile::of(image, place)).collect()
        });
        Some(Pair { runs: pair, normal, profiles })
    }

    /// Component of the displacement between the runs that the pair sees, in the unit of the displacements.
    fn between(&self, displaced: &[DVec3]) -> f64 {
        self.normal.dot(displaced[self.runs[0]] - displaced[self.runs[1]])
    }

    /// Returns the pair with other scales of the runs.
    fn scaled(self, scale: &[f64]) -> Pair {
        let [a, b] = self.runs;
        let [of_a, of_b] = self.profiles;
        let all = |of: Vec<Profile>, by: f64| of.iter().map(|profile| profile.scaled(by)).collect();
        Pair { profiles: [all(of_a, scale[a]), all(of_b, scale[b])], ..self }
    }

    /// Mean over the beat of the highest correlations near a common displacement, where the runs begin at these steps.
    fn rate(&self, [a, b]: [usize; 2]) -> f64 {
        let window = (WITHIN_BEAT_MM / BIN_MM) as usize;
        let [of_a, of_b] = &self.profiles;
        let at = |step: usize| curve(&of_a[(step + a) % STEPS], &of_b[(step + b) % STEPS], 2);
        let curves: Vec<Curve> = (0..STEPS).map(at).collect();
        let total = mean(&curves);
        let best = (0..total.len()).max_by(|a, b| total[*a].total_cmp(&total[*b])).unwrap_or_default();
        let around = best.saturating_sub(window)..(best + window + 1).min(total.len());
        let highest = |curve: &Curve| curve[around.clone()].iter().copied().fold(-1.0, f64::max);
        curves.iter().map(highest).sum::<f64>() / STEPS as f64
    }

    /// Highest rate, at whichever steps the runs begin, with the second run scaled.
    fn peak(&self, by: f64) -> f64 {
        let [of_a, of_b] = &self.profiles;
        let of_b = of_b.iter().map(|profile| profile.scaled(by)).collect();
        let scaled = Pair { runs: self.runs, normal: self.normal, profiles: [of_a.clone(), of_b] };
        (0..STEPS).into_par_iter().map(|first| scaled.rate([0, first])).reduce(|| -1.0, f64::max)
    }

    /// Correlations at each step of the common beat.
    fn curves(&self, first_step: &[usize]) -> Vec<Curve> {
        let [a, b] = self.runs.map(|run| first_step[run]);
        let [of_a, of_b] = &self.profiles;
        (0..STEPS).map(|step| curve(&of_a[(step + a) % STEPS], &of_b[(step + b) % STEPS], 1)).collect()
    }
}

impl Profile {
    fn of(image: &Image, place: impl Fn(f64, f64) -> f64) -> Profile {
        let n = (2.0 * REACH_MM / BIN_MM) as usize;
        let (w, h) = (image.width as f64 - 1.0, image.height as f64 - 1.0);
        let corners = [(0.0, 0.0), (w, 0.0), (0.0, h), (w, h)].map(|(x, y)| place(x, y).clamp(0.0, n as f64));
        let covered = corners.iter().copied().fold(n as f64, f64::min) as usize
            ..corners.iter().copied().fold(0.0, f64::max) as usize;
        let mut values = vec![0.0; n];
        for (p, value) in image.values.iter().enumerate().filter(|(_, value)| **value > 0.0) {
            let at = place((p % image.width) as f64, (p / image.width) as f64);
            if (0.0..(n - 1) as f64).contains(&at) {
                let share = at.fract();
                values[at as usize] += (1.0 - share) * f64::from(*value);
                values[at as usize + 1] += share * f64::from(*value);
            }
        }
        let [fine, wide] = BAND_MM.map(|length| blurred(&values, length / BIN_MM));
        Profile { values: fine.iter().zip(&wide).map(|(fine, wide)| fine - wide).collect(), covered }
    }
}

impl Profile {
    /// Returns the profile of an image whose pixels are larger by a factor: it is stretched about the plane through the isocentre.
    fn scaled(&self, by: f64) -> Profile {
        let n = self.values.len();
        let middle = REACH_MM / BIN_MM;
        let value = |k: usize| {
            let from = (k as f64 - middle) / by + middle;
            if !(0.0..(n - 1) as f64).contains(&from) {
                return 0.0;
            }
            let low = from as usize;
            self.values[low] + from.fract() * (self.values[low + 1] - self.values[low])
        };
        let end = |at: usize| ((at as f64 - middle) * by + middle).clamp(0.0, n as f64) as usize;
        Profile { values: (0..n).map(value).collect(), covered: end(self.covered.start)..end(self.covered.end) }
    }
}

/// Blurs by a Gaussian of `sigma` bins; values outside are zero.
fn blurred(values: &[f64], sigma: f64) -> Vec<f64> {
    let reach = (3.0 * sigma).ceil() as usize;
    let kernel: Vec<f64> =
        (0..=2 * reach).map(|k| (-0.5 * ((k as f64 - reach as f64) / sigma).powi(2)).exp()).collect();
    let sum: f64 = kernel.iter().sum();
    let mut out = vec![0.0; values.len() + 2 * reach];
    for (at, value) in values.iter().enumerate().filter(|(_, value)| **value != 0.0) {
        out[at..at + kernel.len()].iter_mut().zip(&kernel).for_each(|(out, k)| *out += value * k / sum);
    }
    out[reach..reach + values.len()].to_vec()
}

/// Correlations of two profiles at displacements of the second one by multiples of `stride` bins; between these, the nearest one.
fn curve(a: &Profile, b: &Profile, stride: usize) -> Curve {
    let reach = reach() as isize;
    let min = (MIN_OVERLAP_MM / BIN_MM) as isize;
    let at = |shift: isize| {
        let first = (a.covered.start as isize).max(b.covered.start as isize + shift);
        let end = (a.covered.end as isize).min(b.covered.end as isize + shift);
        if end - first < min {
            return -1.0;
        }
        let (a, b) =
            (&a.values[first as usize..end as usize], &b.values[(first - shift) as usize..(end - shift) as usize]);
        let [ab, aa, bb] = a.iter().zip(b).fold([0.0; 3], |[ab, aa, bb], (a, b)| [ab + a * b, aa + a * a, bb + b * b]);
        ab / (aa * bb).sqrt().max(f64::MIN_POSITIVE)
    };
    let mut out = vec![0.0; 2 * reach as usize + 1];
    for (k, chunk) in out.chunks_mut(stride).enumerate() {
        chunk.fill(at((k * stride) as isize - reach));
    }
    out
}

fn mean(curves: &[Curve]) -> Curve {
    (0..curves[0].len()).map(|k| curves.iter().map(|curve| curve[k]).sum::<f64>() / curves.len() as f64).collect()
}

/// Value of a curve at a displacement in mm; the lowest one beyond its ends.
fn value_at(curve: &Curve, mm: f64) -> f64 {
    let place = mm / BIN_MM + reach() as f64;
    if !(0.0..=(curve.len() - 1) as f64).contains(&place) {
        return -1.0;
    }
    let low = (place as usize).min(curve.len() - 2);
    curve[low] + (place - low as f64) * (curve[low + 1] - curve[low])
}

/// Highest correlation of a curve.
struct Peak {
    mm: f64,
    /// Lead over the next peak.
    lead: f64,
}

impl Peak {
    fn of(curve: &Curve) -> Peak {
        let mm = |k: usize| (k as f64 - reach() as f64) * BIN_MM;
        let best = (0..curve.len()).max_by(|a, b| curve[*a].total_cmp(&curve[*b])).unwrap_or_default();
        let others = (0..curve.len()).filter(|k| (mm(*k) - mm(best)).abs() > OTHER_PEAK_MM).map(|k| curve[k]);
        Peak { mm: mm(best), lead: (curve[best] - others.fold(-1.0, f64::max)).max(0.0) + MIN_LEAD }
    }
}

/// Finds the first step of each run, one after the other.
fn first_steps(n: usize, pairs: &[Pair]) -> Vec<usize> {
    let mut first_step = vec![0; n];
    for run in 1..n {
        first_step[run] = best_first_step(run, pairs, &first_step);
    }
    first_step
}

/// Finds the scales of the runs at which the pairs together correlate best; 1 for all where the gain is small. The mean of their logarithms is
/// 0, because pairs of runs tell ratios alone.
fn scales(n: usize, pairs: &[Pair]) -> Vec<f64> {
    let factor = |steps: f64| (SCALE_STEP * steps).exp();
    // `[pair][step]`: highest correlation by the ratio of the scales.
    let table: Vec<Vec<f64>> = pairs
        .iter()
        .map(|pair| {
            let ratios = -SCALE_REACH..=SCALE_REACH;
            ratios.map(|step| pair.peak(factor(f64::from(step)))).collect()
        })
        .collect();
    let agreement = |steps: &[i32]| -> f64 {
        let of_pair = |(pair, peaks): (&Pair, &Vec<f64>)| {
            let ratio = steps[pair.runs[1]] - steps[pair.runs[0]];
            peaks.get((ratio + SCALE_REACH) as usize).copied().unwrap_or(-1.0)
        };
        pairs.iter().zip(&table).map(of_pair).sum()
    };
    // Pairs compare ratios, so the first run keeps its scale.
    let mut steps = vec![0; n];
    loop {
        let before = steps.clone();
        for run in 1..n {
            let with = |step: i32| steps.iter().enumerate().map(|(k, s)| if k == run { step } else { *s }).collect();
            let tried: Vec<Vec<i32>> = (-SCALE_REACH..=SCALE_REACH).map(with).collect();
            let better = tried.into_iter().filter(|tried| agreement(tried) > agreement(&steps) + 1e-12);
            steps = better.max_by(|a, b| agreement(a).total_cmp(&agreement(b))).unwrap_or(steps);
        }
        if steps == before {
            break;
        }
    }
    if agreement(&steps) - agreement(&vec![0; n]) < SCALE_GAIN * pairs.len() as f64 {
        return vec![1.0; n];
    }
    let mean = f64::from(steps.iter().sum::<i32>()) / n as f64;
    steps.into_iter().map(|step| factor(f64::from(step) - mean)).collect()
}

/// Step of a run at which it agrees best with the runs before it, each at its own step.
fn best_first_step(run: usize, pairs: &[Pair], first_step: &[usize]) -> usize {
    if !pairs.iter().any(|pair| pair.runs[1] == run) {
        return 0;
    }
    let rate = |first: usize| -> f64 {
        let with = pairs.iter().filter(|pair| pair.runs[1] == run);
        with.map(|pair| pair.rate([first_step[pair.runs[0]], first])).sum()
    };
    let rated: Vec<f64> = (0..STEPS).into_par_iter().map(rate).collect();
    (0..STEPS).max_by(|a, b| rated[*a].total_cmp(&rated[*b])).unwrap_or_default()
}

/// Displacements of all runs, mm, world axes: those at which the pairs together correlate best.
fn displacements(n: usize, pairs: &[Pair], means: &[Curve]) -> Vec<DVec3> {
    let peaks: Vec<Peak> = means.iter().map(Peak::of).collect();
    let wanted: Vec<f64> = peaks.iter().map(|peak| peak.mm).collect();
    let weights: Vec<f64> = peaks.iter().map(|peak| peak.lead).collect();
    if pairs.len() < 2 {
        return least_squares(n, pairs, &wanted, &weights);
    }
    let rate = |at: &[DVec3]| {
        let agreement = pairs.iter().zip(means).map(|(pair, curve)| value_at(curve, pair.between(at)));
        agreement.sum::<f64>() - SMALL_PER_MM2 * at.iter().map(|d| d.length_squared()).sum::<f64>()
    };
    // One pair may have its peak at a wrong place: each is left out of one start.
    let without = |left_out: usize| {
        let weights: Vec<f64> = (0..pairs.len()).map(|k| if k == left_out { 0.0 } else { weights[k] }).collect();
        least_squares(n, pairs, &wanted, &weights)
    };
    let starts = (0..=pairs.len()).map(without).chain([vec![DVec3::ZERO; n]]);
    let climbed = starts.collect::<Vec<_>>().into_par_iter().map(|start| climb(start, &rate)).collect::<Vec<_>>();
    let best = climbed.into_iter().max_by(|a, b| a.0.total_cmp(&b.0)).map_or(vec![DVec3::ZERO; n], |best| best.1);
    let middle = best.iter().sum::<DVec3>() / n as f64;
    best.into_iter().map(|d| d - middle).collect()
}

/// Climbs from a start by steps along the axes of each run that fall from the longest to the shortest.
fn climb(mut at: Vec<DVec3>, rate: &impl Fn(&[DVec3]) -> f64) -> (f64, Vec<DVec3>) {
    let mut best = rate(&at);
    for length in SEARCH_MM {
        loop {
            let before = best;
            for run in 0..at.len() {
                for step in [DVec3::X, -DVec3::X, DVec3::Y, -DVec3::Y, DVec3::Z, -DVec3::Z] {
                    let old = at[run];
                    at[run] += length * step;
                    let now = rate(&at);
                    if now > best {
                        best = now;
                    } else {
                        at[run] = old;
                    }
                }
            }
            if best <= before {
                break;
            }
        }
    }
    (best, at)
}

/// Smallest displacements of all runs between which the pairs see the wanted ones, mm.
fn least_squares(n: usize, pairs: &[Pair], wanted: &[f64], weights: &[f64]) -> Vec<DVec3> {
    let usual = weights.iter().sum::<f64>() / weights.len().max(1) as f64;
    let (mut normal, mut right) = (Symmetric::zeros(3 * n), vec![0.0; 3 * n]);
    (0..3 * n).for_each(|i| normal.add(i, i, UNDETERMINED * usual.max(MIN_LEAD)));
    for ((pair, wanted), weight) in pairs.iter().zip(wanted).zip(weights) {
        let [a, b] = pair.runs;
        let row: Vec<(usize, f64)> = [(a, 1.0), (b, -1.0)]
            .into_iter()
            .flat_map(|(run, sign)| {
                pair.normal.to_array().into_iter().enumerate().map(move |(k, v)| (3 * run + k, sign * v))
            })
            .collect();
        for (i, v) in &row {
            right[*i] += weight * v * wanted;
            row.iter().filter(|(j, _)| j <= i).for_each(|(j, u)| normal.add(*i, *j, weight * v * u));
        }
    }
    let found = normal.solve(&right).unwrap_or_else(|| vec![0.0; 3 * n]);
    found.chunks(3).map(DVec3::from_slice).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::{CArm, Geometry, world_from_lps_mm};

    const SIZE: usize = 96;

    fn c_arm(primary_deg: f64, secondary_deg: f64) -> CArm {
        CArm {
            primary_deg,
            secondary_deg,
            sid_mm: 1000.0,
            sod_mm: 700.0,
            pixel_mm: [1.4; 2],
            offset_mm: [0.0; 2],
            table_mm: [0.0; 3],
        }
    }

    fn rays(primary_deg: f64, secondary_deg: f64) -> ViewRays {
        Geometry::CArm(c_arm(primary_deg, secondary_deg)).rays(SIZE, SIZE).unwrap()
    }

    /// Vessels as rows of points on three arcs that beat, LPS mm.
    fn points(fraction: f64) -> Vec<DVec3> {
        let beat = (std::f64::consts::TAU * fraction).sin();
        let twist = (std::f64::consts::TAU * fraction).cos();
        let point = |arc: usize, i: usize| {
            let (along, arc) = (i as f64 / 60.0, arc as f64);
            let angle = 0.4 + 2.0 * arc + (1.2 + 0.2 * arc) * along;
            let radius = 28.0 + 4.0 * arc - 4.0 * beat;
            DVec3::new(radius * angle.cos(), radius * angle.sin(), 25.0 - 60.0 * along + 9.0 * arc + 3.0 * twist)
        };
        (0..3).flat_map(|arc| (0..60).map(move |i| point(arc, i))).collect()
    }

    #[test]
    fn runs_of_wrong_distances_are_scaled() {
        let views = [(-30.0, 20.0), (50.0, 0.0), (5.0, 40.0)].map(|(primary, secondary)| rays(primary, secondary));
        let taken: Vec<Vec<Image>> =
            views.iter().zip([0.0, 0.35, 0.8]).map(|(rays, begins)| images(rays, begins, DVec3::ZERO)).collect();
        // The stated pixels of the second run are too small by a tenth.
        let small = CArm { pixel_mm: [1.4 / 1.1; 2], ..c_arm(50.0, 0.0) };
        let small = Geometry::CArm(small).rays(SIZE, SIZE).unwrap();
        let aligned = |second: &ViewRays| {
            let rays = [&views[0], second, &views[2]];
            let beating = rays.into_iter().zip(&taken);
            align(&beating.map(|(rays, images)| Beating { rays, steps: images.iter().collect() }).collect::<Vec<_>>())
        };
        assert_eq!(aligned(&views[1]).scale, [1.0; 3], "right distances");
        let found = aligned(&small).scale;
        for other in [0, 2] {
            let ratio = found[1] / found[other];
            assert!((ratio - 1.1).abs() < 0.025, "{found:?}");
        }
    }

    /// Images of a beat that begins at a fraction of it, of a patient who is displaced, LPS mm.
    fn images(rays: &ViewRays, begins: f64, displaced_mm: DVec3) -> Vec<Image> {
        let image = |step: usize| {
            let mut image = Image::zeros(SIZE, SIZE);
            for point in points(begins + step as f64 / STEPS as f64) {
                let Some((x, y)) = rays.project(world_from_lps_mm(point + displaced_mm)) else { continue };
                for (dx, dy) in (-2..=2).flat_map(|dy| (-2..=2).map(move |dx| (dx, dy))) {
                    let (column, row) = (x.round() as isize + dx, y.round() as isize + dy);
                    if (0..SIZE as isize).contains(&column) && (0..SIZE as isize).contains(&row) {
                        let squared = (x - column as f64).powi(2) + (y - row as f64).powi(2);
                        image.values[row as usize * SIZE + column as usize] += (-0.7 * squared).exp() as f32;
                    }
                }
            }
            image
        };
        (0..STEPS).map(image).collect()
    }

    #[test]
    fn runs_are_brought_together_in_time_and_space() {
        let runs = [
            (rays(-30.0, 20.0), 0.0, DVec3::new(2.0, -1.0, 4.0)),
            (rays(50.0, 0.0), 0.35, DVec3::new(-3.0, 2.0, -6.0)),
            (rays(5.0, 40.0), 0.8, DVec3::new(1.0, -4.0, 1.0)),
        ];
        let taken: Vec<Vec<Image>> = runs.iter().map(|(rays, begins, by)| images(rays, *begins, *by)).collect();
        for n in [2, 3] {
            let beating = runs.iter().zip(&taken).take(n);
            let beating: Vec<Beating<'_>> =
                beating.map(|((rays, ..), images)| Beating { rays, steps: images.iter().collect() }).collect();
            let aligned = align(&beating);
            for (run, (_, begins, _)) in runs.iter().enumerate().take(n) {
                let wanted = (-begins).rem_euclid(1.0) * STEPS as f64;
                let off = (aligned.first_step[run] as f64 - wanted + 0.5 * STEPS as f64).rem_euclid(STEPS as f64);
                assert!(
                    (off - 0.5 * STEPS as f64).abs() <= 1.0,
                    "{n} runs: {run} at {} for {wanted}",
                    aligned.first_step[run]
                );
            }
            assert_eq!(aligned.pairs.len(), n * (n - 1) / 2);
            for pair in &aligned.pairs {
                let [a, b] = pair.runs;
                let [from, to] = pair.runs.map(|run| runs[run].0.source());
                let baseline = (to - from).normalize();
                let normal = baseline.cross(-(from - baseline * from.dot(baseline)).normalize());
                let wanted = normal.dot(world_from_lps_mm(runs[a].2 - runs[b].2)) * MM_PER_UNIT;
                assert!((pair.displaced_mm - wanted).abs() < 0.6, "{n} runs: {pair:?} for {wanted} mm");
                assert!(pair.aligned > 0.8 && pair.aligned > pair.stated + 0.2, "{n} runs: {pair:?}");
                let found = normal.dot(aligned.displaced[a] - aligned.displaced[b]) * MM_PER_UNIT;
                assert!((found - pair.displaced_mm).abs() < 1e-9);
            }
        }
    }

    #[test]
    fn opposite_and_single_runs_are_left_where_they_are() {
        let [a, b] = [rays(0.0, 0.0), rays(180.0, 0.0)];
        let (of_a, of_b) = (images(&a, 0.0, DVec3::ZERO), images(&b, 0.5, DVec3::ZERO));
        let opposite =
            [Beating { rays: &a, steps: of_a.iter().collect() }, Beating { rays: &b, steps: of_b.iter().collect() }];
        for runs in [&opposite[..], &opposite[..1]] {
            let aligned = align(runs);
            assert_eq!((aligned.first_step, aligned.pairs), (vec![0; runs.len()], Vec::new()));
            assert!(aligned.displaced.iter().all(|by| by.length() < 1e-12));
        }
    }
}
