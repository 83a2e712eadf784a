//! A cine run: the background's displacement of each frame, the contrast of each frame, the length of a beat, and the vessels of each
//! frame. All of it comes from the images of the run.

mod displacement;
mod rhythm;

use crate::evidence::lines::{self as evidence, SteadyFrame, Thin, line_strength, over_frames, thin_structures};
use crate::raster::{Image, dilate, median, percentile};
use crate::scan::hidden::{at_border, flood};
use displacement::{displacements, moved, robust_deviation, shown_by_all};
use rayon::prelude::*;
pub use rhythm::Rhythm;
use rhythm::Similarity;
use std::ops::Range;

// Numbers of this file without another source: developed on simulated runs and on twelve clinical runs of two patients, which are
// therefore no independent test (docs/tried.md, runs without ECG).
/// Width of the rim of a frame that is not used, a share of its shorter side.
const RIM: f64 = 0.03;
/// Furthest displacement of the background, along columns or rows, of a frame that is used, mm.
const NEAR_MM: f64 = 4.0;
/// Percentile over all frames of a thin structure that stands for what is there without contrast agent.
const BASE: f64 = 0.1;
/// Percentile over the pixels of the contrast beyond that base that stands for a frame.
const CONTRAST: f64 = 0.98;
/// Value of noise alone at this percentile, in its standard deviations.
const CONTRAST_OF_NOISE: f32 = 2.05;
/// Percentile over the frames of the contrast that counts as 1.
const FULLEST: f64 = 0.95;
/// Contrast from which frames belong to the injection.
const ARRIVED: f64 = 0.3;
/// Minimum number of frames of an injection in which a beat is searched; with fewer, all frames are.
const MIN_FRAMES: usize = 18;
/// Penalty on a beat per mm that the background is displaced within it, in units of contrast.
const TRAVEL: f64 = 0.05;
/// Contrast of the emptiest frame of a beat below which the beat is penalised, and the penalty.
const EMPTIEST: [f64; 2] = [0.5, 0.3];

/// Analysis of the images of a run.
pub struct Cine {
    /// Displacement (columns, rows) of each frame that brings its background to that of the others, pixels.
    pub displacements: Vec<[f32; 2]>,
    /// Contrast of each frame, a share of that of the fullest ones; 0 for a frame that is not used, because the table was panned.
    pub contrast: Vec<f64>,
    /// Rhythm; none where frames do not return.
    pub rhythm: Option<Rhythm>,
    /// Columns and rows that all frames show.
    pub area: [Range<usize>; 2],
    /// Line integrals of the vessels of each frame, on the whole image.
    pub vessels: Vec<Image>,
}

impl Cine {
    /// Analyses the frames of a run, as line integrals. `dark` is the value of a pixel that shows a blade; `mm` is the size of a pixel at the
    /// isocentre.
    pub fn new(frames: &[Image], frames_per_s: f64, dark: f32, mm: f64) -> Cine {
        let size = [frames[0].width, frames[0].height];
        let shown = shown(frames, dark);
        let displacements = displacements(frames, &shown, mm);
        let near = near(&displacements, mm);
        let of_near = |images: &[Image]| -> Vec<Image> {
            near.par_iter().map(|frame| moved(&images[*frame], displacements[*frame])).collect()
        };
        let places: Vec<[f32; 2]> = near.iter().map(|frame| displacements[*frame]).collect();
        let all = shown_by_all(&shown, size, &places);
        let (unmoved, sharp): (Vec<Image>, Vec<Image>) = frames
            .par_iter()
            .map(|frame| {
                let Thin { smooth, sharp } = thin_structures(frame, mm);
                (smooth, sharp)
            })
            .unzip();
        let of_contrast = contrast(&of_near(&unmoved), &all);
        let mut contrast = vec![0.0; frames.len()];
        near.iter().zip(of_contrast).for_each(|(frame, of)| contrast[*frame] = of);
        let arrived = contrast.iter().position(|c| *c > ARRIVED).unwrap_or(0);
        let similarity = Similarity::of(&unmoved, &shown);
        let injected = if frames.len() - arrived > MIN_FRAMES { arrived..frames.len() } else { 0..frames.len() };
        let rhythm =
            similarity.rhythm(injected, frames_per_s).or_else(|| similarity.rhythm(0..frames.len(), frames_per_s));
        let lines = of_near(&frames.par_iter().map(|frame| line_strength(frame, mm)).collect::<Vec<_>>());
        let steady = near.iter().zip(lines.into_iter().zip(of_near(&sharp)));
        let steady: Vec<SteadyFrame> =
            steady.map(|(number, (lines, thin))| SteadyFrame { thin, lines, contrast: contrast[*number] }).collect();
        let found = evidence::vessels(&steady, &all, mm);
        let mut vessels = vec![Image::zeros(size[0], size[1]); frames.len()];
        near.iter().zip(found).for_each(|(frame, image)| vessels[*frame] = image);
        Cine { displacements, contrast, rhythm, area: bounds(&all, size[0]), vessels }
    }

    /// Frames of one beat of `length` frames within a range: filled with contrast agent, over a background at rest.
    pub fn beat(&self, within: Range<usize>, length: f64, mm: f64) -> Range<usize> {
        let frames = (length.ceil() as usize).min(within.len());
        let rate = |first: usize| {
            let beat = first..first + frames;
            let contrast = &self.contrast[beat.clone()];
            let mean = contrast.iter().sum::<f64>() / frames as f64;
            let emptiest = contrast.iter().copied().fold(f64::MAX, f64::min);
            mean - TRAVEL * self.travel_mm(beat, mm) - EMPTIEST[1] * (EMPTIEST[0] - emptiest).max(0.0)
        };
        let firsts = within.start..=within.end - frames;
        let best = firsts.max_by(|a, b| rate(*a).total_cmp(&rate(*b))).unwrap_or(within.start);
        best..best + frames
    }

    /// Largest displacement between frames of a range along columns or rows, mm.
    pub fn travel_mm(&self, frames: Range<usize>, mm: f64) -> f64 {
        let along = |axis: usize| {
            let places = self.displacements[frames.clone()].iter().map(|d| d[axis]);
            let (low, high) = places.fold((f32::MAX, f32::MIN), |(low, high), d| (low.min(d), high.max(d)));
            f64::from(high - low) * mm
        };
        along(0).max(along(1))
    }
}

/// Frames whose background is near its usual place. Others, after the table was panned, are not used: the part of the image that all frames
/// show would become small.
fn near(displacements: &[[f32; 2]], mm: f64) -> Vec<usize> {
    let far = |frame: &usize| displacements[*frame].iter().any(|d| f64::from(d.abs()) * mm > NEAR_MM);
    let near: Vec<usize> = (0..displacements.len()).filter(|frame| !far(frame)).collect();
    if 2 * near.len() > displacements.len() { near } else { (0..displacements.len()).collect() }
}

/// Marks the pixels that show the patient: not a blade at the border, which is dark in the median of the frames, and not the rim.
fn shown(frames: &[Image], dark: f32) -> Vec<bool> {
    let usual = over_frames(frames.iter(), 0.5);
    let (width, height) = (usual.width, usual.height);
    let is_dark = |p: usize| usual.values[p] > dark;
    let border = (0..width * height).filter(|p| at_border(*p, width, height) && is_dark(*p));
    let blade = flood(border, width, height, is_dark);
    let rim = ((RIM * width.min(height) as f64) as usize).max(4);
    let wide = Image { width, height, values: blade.iter().map(|b| f32::from(u8::from(b.is_some()))).collect() };
    let blade = dilate(&wide, rim);
    let within = |at: usize, n: usize| (rim..n.saturating_sub(rim)).contains(&at);
    (0..width * height)
        .map(|p| blade.values[p] == 0.0 && within(p % width, width) && within(p / width, height))
        .collect()
}

/// Contrast of each frame, a share of that of the fullest frames: thin structures beyond those that are always there, less what noise alone
/// gives.
fn contrast(thin: &[Image], shown: &[bool]) -> Vec<f64> {
    let base = dilate(&over_frames(thin.iter(), BASE), 1);
    let of_frame = |frame: &Image| {
        let pixels = frame.values.iter().zip(&base.values).zip(shown).filter(|(_, shown)| **shown);
        let beyond: Vec<f32> = pixels.map(|((value, base), _)| value - base).collect();
        f64::from((percentile(&beyond, CONTRAST) - CONTRAST_OF_NOISE * robust_deviation(&beyond)).max(0.0))
    };
    let raw: Vec<f64> = thin.par_iter().map(of_frame).collect();
    let n = raw.len();
    let smooth = |i: usize| {
        let mut around: Vec<f32> = (i.saturating_sub(2)..(i + 3).min(n)).map(|j| raw[j] as f32).collect();
        f64::from(median(&mut around))
    };
    let smooth: Vec<f64> = (0..n).map(smooth).collect();
    let fullest = percentile(&smooth.iter().map(|c| *c as f32).collect::<Vec<_>>(), FULLEST);
    smooth.iter().map(|c| c / f64::from(fullest.max(f32::MIN_POSITIVE))).collect()
}

/// Columns and rows of the smallest rectangle that holds the marked pixels; the whole image where there are none.
fn bounds(marked: &[bool], width: usize) -> [Range<usize>; 2] {
    let range = |places: &mut dyn Iterator<Item = usize>| {
        let (first, last) = places.fold((usize::MAX, 0), |(first, last), at| (first.min(at), last.max(at)));
        first..last + 1
    };
    if !marked.contains(&true) {
        return [0..width, 0..marked.len() / width];
    }
    let of = |f: fn(usize, usize) -> usize| range(&mut (0..marked.len()).filter(|p| marked[*p]).map(|p| f(p, width)));
    [of(|p, width| p % width), of(|p, width| p / width)]
}

#[cfg(test)]
mod tests {
    use super::*;

    const SIZE: usize = 160;
    /// Size of a pixel, mm.
    const MM: f64 = 0.5;
    const FRAMES: usize = 52;
    /// Length of a beat, frames.
    const BEAT: f64 = 11.3;
    /// Frame at which contrast agent arrives.
    const ARRIVAL: usize = 9;
    /// Half width of a vessel, pixels.
    const RADIUS: f32 = 2.0;

    /// Number from 0 to 1 that depends on all bits of its argument (Wang's hash).
    fn hash(at: u32) -> f32 {
        let mut x = (at ^ 61) ^ (at >> 16);
        x = x.wrapping_mul(9);
        x = (x ^ (x >> 4)).wrapping_mul(0x27d4_eb2d);
        (x ^ (x >> 15)) as f32 / u32::MAX as f32
    }

    /// A chest without vessels: textures of several sizes.
    fn chest(x: f32, y: f32) -> f32 {
        let wave = |k: u32| {
            let [angle, phase, length] = [hash(3 * k) * 3.2, hash(3 * k + 1) * 6.3, 9.0 + 30.0 * hash(3 * k + 2)];
            (std::f32::consts::TAU * (x * angle.cos() + y * angle.sin()) / length + phase).sin()
        };
        1.2 + 0.004 * x + (0..14).map(|k| 0.02 * wave(k)).sum::<f32>()
    }

    /// Displacement of the background in a frame (columns, rows), pixels: the table is panned at the end.
    fn table(frame: usize) -> [f32; 2] {
        let course = ((frame as f32 - 38.0) / 12.0).clamp(0.0, 1.0);
        [9.0 * course, -14.0 * course]
    }

    /// Distances of the vessels' axes from a pixel.
    fn vessel_distance(frame: usize, x: f32, y: f32) -> f32 {
        let beat = (std::f64::consts::TAU * frame as f64 / BEAT) as f32;
        let [swing, lift] = [7.0 * beat.sin(), 5.0 * beat.cos()];
        let line = |x0: f32, slope: f32, bow: f32| {
            let v = (y - 80.0 - lift) / 80.0;
            let at = x0 + swing + slope * v + bow * v * v;
            let in_range = (30.0..130.0).contains(&(y - lift));
            if in_range { (x - at).abs() / (1.0 + ((slope + 2.0 * bow * v) / 80.0).powi(2)).sqrt() } else { f32::MAX }
        };
        line(55.0, 20.0, -12.0).min(line(85.0, -25.0, 15.0)).min(line(112.0, 8.0, 20.0))
    }

    /// Frames of a run, and where their vessels are once the background is at rest.
    fn run() -> (Vec<Image>, Vec<Vec<bool>>) {
        let frame = |number: usize| {
            let [dx, dy] = table(number);
            let contrast = 0.25 * ((number as f32 - ARRIVAL as f32) / 4.0).clamp(0.0, 1.0);
            let place = |p: usize| ((p % SIZE) as f32 - dx, (p / SIZE) as f32 - dy);
            let value = |p: usize| {
                let (x, y) = place(p);
                let noise = 0.02 * (hash((number * SIZE * SIZE + p) as u32) + hash((p * 977 + number) as u32) - 1.0);
                let vessel = (1.0 - (vessel_distance(number, x, y) / RADIUS).powi(2)).max(0.0).sqrt();
                let blade = if p % SIZE < 6 { 3.0 } else { 0.0 };
                chest(x, y) + contrast * vessel + noise + blade
            };
            let image = Image { width: SIZE, height: SIZE, values: (0..SIZE * SIZE).map(value).collect() };
            let there = |p: usize| vessel_distance(number, (p % SIZE) as f32, (p / SIZE) as f32) < RADIUS - 0.5;
            (image, (0..SIZE * SIZE).map(there).collect())
        };
        (0..FRAMES).map(frame).unzip()
    }

    #[test]
    fn a_run_shows_its_table_its_beat_and_its_vessels() {
        let (frames, vessels) = run();
        let found = Cine::new(&frames, 15.0, 2.55, MM);
        // Displacements bring a frame back, to the middle of all frames.
        let worst = (0..FRAMES).map(|frame| {
            let [dx, dy] = [0, 1].map(|axis| {
                let moved = found.displacements[frame][axis] - found.displacements[0][axis];
                (moved + table(frame)[axis]).abs()
            });
            dx.max(dy)
        });
        let worst = worst.fold(0.0, f32::max);
        assert!(worst < 0.5, "displacements are wrong by {worst} pixels: {:?}", found.displacements);
        let rhythm = found.rhythm.unwrap();
        assert!((rhythm.frames - BEAT).abs() < 0.15 && rhythm.returns > 0.7, "{rhythm:?}");
        let beat = found.beat(0..FRAMES, rhythm.frames, MM);
        assert!(beat.len() == 12 && beat.start >= ARRIVAL + 2 && beat.end <= 43, "{beat:?} of {:?}", found.contrast);
        assert!(found.contrast[..ARRIVAL].iter().all(|c| *c < 0.25), "{:?}", found.contrast);
        let [columns, rows] = &found.area;
        assert!(columns.start >= 6 && columns.len() > 130 && rows.len() > 130, "{:?}", found.area);
        let near = |mask: &[bool], p: usize| {
            let (x, y) = (p % SIZE, p / SIZE);
            (y.saturating_sub(2)..(y + 3).min(SIZE))
                .any(|y| (x.saturating_sub(2)..(x + 3).min(SIZE)).any(|x| mask[y * SIZE + x]))
        };
        let (mut right, mut marked, mut seen, mut all) = (0, 0, 0, 0);
        for frame in beat {
            let is_marked: Vec<bool> = found.vessels[frame].values.iter().map(|v| *v > 0.0).collect();
            for p in (0..SIZE * SIZE).filter(|p| columns.contains(&(p % SIZE)) && rows.contains(&(p / SIZE))) {
                marked += usize::from(is_marked[p]);
                right += usize::from(is_marked[p] && near(&vessels[frame], p));
                all += usize::from(vessels[frame][p]);
                seen += usize::from(vessels[frame][p] && near(&is_marked, p));
            }
        }
        let [precision, recall] = [right as f64 / marked as f64, seen as f64 / all as f64];
        assert!(precision > 0.95 && recall > 0.9, "precision {precision}, recall {recall}");
    }

    #[test]
    fn frames_without_a_beat_have_no_rhythm() {
        let (frames, _) = run();
        assert!(Cine::new(&frames[..13], 15.0, 2.55, MM).rhythm.is_none(), "one beat");
        let still = vec![frames[20].clone(); 30];
        assert!(Cine::new(&still, 15.0, 2.55, MM).rhythm.is_none(), "nothing moves");
    }
}
