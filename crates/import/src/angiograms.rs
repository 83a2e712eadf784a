//! DICOM runs -> a dataset: selects frames, assigns phases and crops to the open area of the collimator.

use crate::dicom::{PixelRange, Relationship, Run};
use crate::error::{Error, Result};
use crate::geometry::CArm;
use crate::raster::Image;
use crate::scan::at_rest::{WIDEST_VESSEL_MM, vessel_pixels, without_vessels};
use crate::scan::gating::{BeatScaling, BeatTime, RPeaks};
use crate::scan::references::ReferencedRun;
use crate::stands::stands;
use crate::ungated::{BeatImage, OneBeat, Placed};
use crate::{beats, ungated};
use rayon::prelude::*;
use std::collections::{BTreeMap, BTreeSet};
use std::ops::RangeInclusive;

/// Share of the strongest contrast above which a frame counts as filled.
const FILLED_SHARE: f64 = 0.6;
/// Line integral that corresponds to the full range of display grey values.
const DISPLAY_SPAN: f64 = 3.0;
/// Line integral from which an area belongs to the collimator or the detector's rim.
const DARK: f32 = (0.85 * DISPLAY_SPAN) as f32;
/// Line integral behind a blade where pixels are linear in intensity: half a percent of the full range.
const DARK_LINEAR: f32 = 5.3;

/// Source of the phases.
#[derive(Debug, Clone)]
pub enum Gating {
    /// The ECG of each file.
    Ecg,
    /// R-peaks in seconds from the first frame, the same for all runs.
    RPeaks(RPeaks),
    /// A steady heart, with an R-peak at the first frame.
    HeartRate(f64),
    /// The images of each run, assuming a steady heart: frames that are alike are one beat apart. The images of the dataset are then the
    /// vessels of single frames, and runs are aligned with each other.
    Images,
    /// A list with a phase for each selected frame of each run, in order; a phase may lie between two whole phases.
    Phases(Vec<f64>),
    /// An object without motion: the frames of a run are averaged. Phase 0 is the object, phase 1 its estimated appearance
    /// without vessels, as in subtraction angiography, so that the rest of the engine sees vessels that appear and vanish.
    Still,
}

/// Options of an import.
#[derive(Debug, Clone)]
pub struct ImportOptions {
    /// Number of cardiac phases.
    pub phases: u32,
    /// Source of the phases.
    pub gating: Gating,
    /// Conversion of times between R-peaks to phases; not with [`Gating::Images`], where the R-peak is not known.
    pub scaling: BeatScaling,
    /// Frames of each run, counted from 1; without it, the frames filled with contrast.
    pub frames: Option<RangeInclusive<usize>>,
    /// Pixel pitch on the detector along columns and rows, mm, which overrides the pitch in the files.
    pub pixel_mm: Option<[f64; 2]>,
    /// Longest side of the images, pixels; larger images are reduced by averaging.
    pub size: Option<usize>,
    /// Whether frames of one phase from several beats are averaged; otherwise each phase is taken from one beat, as always with
    /// [`Gating::Images`].
    pub all_beats: bool,
    /// Depth searched before and behind the isocentre, mm.
    pub depth_half_extent_mm: f64,
    /// Whether the dataset keeps references to the runs' files, which name the patient (see [`crate::scan::references`]).
    pub keep_references: bool,
}

impl ImportOptions {
    /// Tells whether phases come from the images.
    fn is_ungated(&self) -> bool {
        matches!(self.gating, Gating::Images)
    }
}

/// An image of a run, ready for training.
#[derive(Clone)]
pub struct TakenFrame {
    /// C-arm that took it.
    pub c_arm: CArm,
    /// Time in the beat.
    pub taken: BeatTime,
    /// Line integrals.
    pub image: Image,
    /// Frames of the run whose mean the image is, from 0.
    pub frames: Vec<usize>,
}

/// A run, ready to be written.
pub(super) struct Prepared {
    pub(super) frames: Vec<TakenFrame>,
    /// Reference to the run's file; none where it is not to be kept.
    pub(super) reference: Option<ReferencedRun>,
    /// The beat that was found in the images of a run without ECG.
    pub(super) beat: Option<OneBeat>,
    pub(super) notes: Vec<String>,
}

impl Prepared {
    pub(super) fn new(run: &Run, options: &ImportOptions) -> Result<Prepared> {
        let mut notes = Vec::new();
        let (columns, rows) = run.open.clone();
        if (columns.len(), rows.len()) != (run.width, run.height) {
            notes.push(format!("{}: {} x {} pixels inside the shutters", run.name(), columns.len(), rows.len()));
        }
        let factor = match options.size {
            Some(size) => columns.len().max(rows.len()).div_ceil(size.max(1)),
            None if options.is_ungated() => {
                (columns.len().min(rows.len()) as f64 / ungated::SIDE as f64).round().max(1.0) as usize
            }
            None => 1,
        };
        let (width, height) = (columns.len() / factor, rows.len() / factor);
        if let Some(size) = options.size.filter(|size| factor > 1 && *size != width.max(height)) {
            notes.push(format!(
                "{}: the images have {width} x {height} pixels, each the mean of {factor} x {factor}: only whole numbers of pixels \
                 are averaged, so that the longest side is not {size}",
                run.name()
            ));
        }
        if width < 16 || height < 16 {
            let problem = format!("is too small: {width} x {height} pixels would be left of {}", run.name());
            return Err(Error::config("size", options.size.unwrap_or_default(), problem));
        }
        let text = burnt_in_text(run);
        if !text.is_empty() {
            notes.push(format!(
                "{}: {} pixels of burnt-in text were replaced by values of neighbouring pixels",
                run.name(),
                text.len()
            ));
        }
        let integral = intensity(run);
        let frames: Vec<Image> = run
            .frames
            .iter()
            .map(|frame| {
                let frame = without_text(frame, run.width, &text);
                let mut image = Image::zeros(width, height);
                for (p, value) in image.values.iter_mut().enumerate() {
                    let (x, y) = (columns.start + p % width * factor, rows.start + p / width * factor);
                    let cells = (0..factor * factor).map(|k| frame[(y + k / factor) * run.width + x + k % factor]);
                    *value = integral(cells.sum::<f32>() / (factor * factor) as f32);
                }
                image
            })
            .collect();
        // Cropping moves the centre of the image.
        let middle = |range: &std::ops::Range<usize>, kept: usize, all: usize| {
            range.start as f64 + 0.5 * (kept * factor) as f64 - 0.5 * all as f64
        };
        let (x, y) = (middle(&columns, width, run.width), middle(&rows, height, run.height));
        let kept = |of: &CArm| CArm {
            pixel_mm: of.pixel_mm.map(|p| p * factor as f64),
            offset_mm: [of.offset_mm[0] + x * of.pixel_mm[0], of.offset_mm[1] + y * of.pixel_mm[1]],
            ..of.clone()
        };
        let c_arms: Vec<CArm> = run.c_arms.iter().map(kept).collect();
        let at_isocentre = c_arms[0].pixel_mm[0] * c_arms[0].sod_mm / c_arms[0].sid_mm;
        let referenced = |first: [usize; 2]| match &run.source {
            _ if !options.keep_references => Ok(None),
            Some(source) => Ok(Some(ReferencedRun {
                source: source.clone(),
                first_px: [columns.start + factor * first[0], rows.start + factor * first[1]],
                pixels_per_pixel: factor,
            })),
            None => {
                let problem = "are missing or are no UIDs, or the images are stored turned or mirrored, so that no references to this file can be \
                               kept";
                Err(Error::data(&run.path, "UIDs of study, series, class and image", problem))
            }
        };
        if options.is_ungated() {
            let dark = if run.relationship == Relationship::Linear { DARK_LINEAR } else { DARK };
            let asked = options.frames.as_ref();
            let beat = OneBeat::of(run, &frames, &c_arms, at_isocentre, asked, dark, &mut notes)?;
            let frames = frames_of(&beat, &Placed::default(), options.phases);
            return Ok(Prepared { frames, reference: referenced(beat.first)?, beat: Some(beat), notes });
        }
        let stands = stands(&c_arms, [width, height]);
        let vessel = vessel_pixels(at_isocentre);
        let selected = select(run, &frames, vessel, options, &mut notes)?;
        let chosen = Chosen { run, frames: &frames, stands: &stands, selected: &selected, vessel };
        let views = chosen.stands_of(&selected).len();
        if views > 1 {
            notes.push(format!(
                "{}: the C-arm or the table moves, so its {} frames belong to {views} views",
                run.name(),
                selected.len()
            ));
        }
        let images = chosen.phases(options, &mut notes)?;
        let taken = |PhaseImage { taken, stand, frames, image }: PhaseImage| TakenFrame {
            c_arm: c_arms[stand].clone(),
            taken,
            image,
            frames,
        };
        Ok(Prepared {
            frames: images.into_iter().map(taken).collect(),
            reference: referenced([0, 0])?,
            beat: None,
            notes,
        })
    }
}

/// Images of a run without ECG at its place.
pub(super) fn frames_of(beat: &OneBeat, placed: &Placed, phases: u32) -> Vec<TakenFrame> {
    let c_arm = beat.c_arm(placed);
    let taken = |BeatImage { taken, frame, image }: BeatImage| TakenFrame {
        c_arm: c_arm.clone(),
        taken,
        image,
        frames: vec![frame],
    };
    beat.images(placed, phases).into_iter().map(taken).collect()
}

/// Image of a phase.
struct PhaseImage {
    taken: BeatTime,
    /// Index of the first frame with its pose.
    stand: usize,
    /// Frames whose mean it is, from 0.
    frames: Vec<usize>,
    image: Image,
}

/// Selected frames of a run.
struct Chosen<'a> {
    run: &'a Run,
    /// All frames, as line integrals.
    frames: &'a [Image],
    /// For each frame, the index of the first frame with the same pose.
    stands: &'a [usize],
    /// Indices of the selected frames, from 0.
    selected: &'a [usize],
    /// Radius of the widest vessel that is searched, pixels.
    vessel: usize,
}

impl Chosen<'_> {
    /// Distinct poses of frames, each as the index of its first frame.
    fn stands_of(&self, frames: &[usize]) -> BTreeSet<usize> {
        frames.iter().map(|frame| self.stands[*frame]).collect()
    }

    /// Averages the frames of each phase and pose.
    fn phases(&self, options: &ImportOptions, notes: &mut Vec<String>) -> Result<Vec<PhaseImage>> {
        let (run, selected, n_phases) = (self.run, self.selected, options.phases);
        let none = |problem: &str| Error::data(&run.path, "phases", problem.to_owned());
        let from =
            |stand: usize, of: &[usize]| of.iter().copied().filter(|i| self.stands[*i] == stand).collect::<Vec<_>>();
        let beat_of;
        let taken: Vec<Option<BeatTime>> = match &options.gating {
            Gating::Still => {
                notes.push(format!(
                    "{}: {} frames were averaged; phase 1 is the image without structures up to {WIDEST_VESSEL_MM} mm \
                     wide",
                    run.name(),
                    selected.len()
                ));
                let of_stand = |stand: usize| {
                    let frames = from(stand, selected);
                    let mean = mean(self.frames, &frames);
                    let background = without_vessels(&mean, self.vessel, DARK);
                    let image = |phase: u32, image: Image| PhaseImage {
                        taken: BeatTime::at_phase(phase),
                        stand,
                        frames: frames.clone(),
                        image,
                    };
                    [image(0, mean), image(1, background)]
                };
                return Ok(self.stands_of(selected).into_iter().flat_map(of_stand).collect());
            }
            Gating::Phases(list) if list.len() == selected.len() => {
                if let Some(bad) = list.iter().find(|p| !(0.0..f64::from(n_phases)).contains(*p)) {
                    return Err(none(&format!("phase {bad} is given, but phases go from 0 to {}", n_phases - 1)));
                }
                beat_of = beats::numbers_of_list(list);
                list.iter().map(|p| Some(BeatTime::of(*p, n_phases))).collect()
            }
            Gating::Phases(list) => {
                return Err(none(&format!("{} phases are given for {} selected frames", list.len(), selected.len())));
            }
            timed => {
                if run.times_s.len() != run.frames.len() {
                    return Err(none(
                        "the times of the frames are not known: state the frames per second, or a list of phases",
                    ));
                }
                let peaks = self.r_peaks(timed)?;
                let times_s: Vec<f64> = selected.iter().map(|i| run.times_s[*i]).collect();
                beat_of = beats::numbers(&times_s, &peaks);
                times_s.iter().map(|time| peaks.beat_time(*time, n_phases, options.scaling)).collect()
            }
        };
        let taken = if options.all_beats { taken } else { self.of_one_beat(taken, &beat_of, notes) };
        let (mut images, mut seen) = (Vec::new(), 0);
        for phase in 0..n_phases {
            let timed = selected.iter().zip(&taken).filter_map(|(i, taken)| Some((*i, (*taken)?)));
            let of_phase: BTreeMap<usize, BeatTime> = timed.filter(|(_, t)| t.phase == phase).collect();
            let frames: Vec<usize> = of_phase.keys().copied().collect();
            seen += usize::from(!frames.is_empty());
            for stand in self.stands_of(&frames) {
                // A phase may have several frames, also of several beats where those are averaged.
                let frames = from(stand, &frames);
                let after_phase = frames.iter().map(|i| of_phase[i].after_phase).sum::<f64>() / frames.len() as f64;
                let image = mean(self.frames, &frames);
                images.push(PhaseImage { taken: BeatTime { phase, after_phase }, stand, frames, image });
            }
        }
        if seen < 2 {
            return Err(none(&format!("only {seen} of {n_phases} phases are seen; at least two are needed")));
        }
        notes.push(format!(
            "{}: {seen} of {n_phases} phases from {} frames",
            run.name(),
            taken.iter().flatten().count()
        ));
        Ok(images)
    }

    /// Forgets the times of frames whose phase is taken from another beat, so that they are not used.
    fn of_one_beat(
        &self,
        taken: Vec<Option<BeatTime>>,
        beat_of: &[usize],
        notes: &mut Vec<String>,
    ) -> Vec<Option<BeatTime>> {
        let mut taken = taken;
        // Frames of different poses are never averaged, so each pose has a choice of its own.
        for stand in self.stands_of(self.selected) {
            let of_stand: Vec<usize> =
                (0..self.selected.len()).filter(|i| self.stands[self.selected[*i]] == stand).collect();
            let beating = |i: &usize| beats::Beating {
                image: &self.frames[self.selected[*i]],
                time_s: self.run.times_s.get(self.selected[*i]).copied().unwrap_or(*i as f64),
                taken: taken[*i],
                beat: beat_of[*i],
            };
            let (used, note) = beats::choose(&of_stand.iter().map(beating).collect::<Vec<_>>(), self.vessel);
            notes.extend(note.map(|note| format!("{}: {note}", self.run.name())));
            of_stand.iter().zip(used).filter(|(_, used)| !used).for_each(|(i, _)| taken[*i] = None);
        }
        taken
    }

    /// Returns the R-peaks of the run from the requested source.
    fn r_peaks(&self, gating: &Gating) -> Result<RPeaks> {
        let run = self.run;
        match gating {
            Gating::RPeaks(peaks) => Ok(peaks.clone()),
            Gating::HeartRate(rate) => RPeaks::steady(*rate, 0.0, run.times_s.last().copied().unwrap_or(0.0)),
            _ => run.r_peaks.clone().ok_or_else(|| {
                let problem = "there is no ECG: give R-peaks, a heart rate or a list of phases, find the beat in \
                               the images, or state that the object is static";
                Error::data(&run.path, "phases", problem)
            }),
        }
    }
}

/// Returns the conversion from a pixel value, brighter for less absorption, to a line integral.
fn intensity(run: &Run) -> impl Fn(f32) -> f32 + use<> {
    let PixelRange { black, low, white } = run.range;
    let [black, low, white] = [black, low, white].map(f64::from);
    let relationship = run.relationship;
    move |value: f32| {
        let v = f64::from(value);
        (match relationship {
            Relationship::Linear => -(((v - black) / (white - black)).max(1e-4)).ln(),
            Relationship::Log | Relationship::Display => (white - v) / (white - low) * DISPLAY_SPAN,
        }) as f32
    }
}

/// Selects the requested frames, or else the frames filled with contrast; returns indices from 0.
fn select(
    run: &Run,
    frames: &[Image],
    vessel: usize,
    options: &ImportOptions,
    notes: &mut Vec<String>,
) -> Result<Vec<usize>> {
    let n = frames.len();
    if let Some(asked) = &options.frames {
        if *asked.start() == 0 || *asked.end() > n || asked.is_empty() {
            let problem = format!("{} has frames 1 to {n}", run.name());
            return Err(Error::config("frames", format!("{}-{}", asked.start(), asked.end()), problem));
        }
        return Ok((asked.start() - 1..*asked.end()).collect());
    }
    // Contrast of thin dark structures in each frame.
    let contrast: Vec<f64> = frames.par_iter().map(|frame| beats::contrast(frame, vessel)).collect();
    let max = contrast.iter().copied().fold(0.0, f64::max);
    // A frame that is not filled is appended to end a sequence that lasts to the last frame.
    let filled = contrast.iter().map(|c| *c >= FILLED_SHARE * max).chain([false]);
    // Find the longest sequence.
    let mut best = 0..0;
    let mut start = 0;
    for (i, filled) in filled.enumerate() {
        if !filled {
            if i - start > best.len() {
                best = start..i;
            }
            start = i + 1;
        }
    }
    notes.push(format!(
        "{}: frames {} to {} of {n} are filled with contrast agent and are used; --frames chooses others",
        run.name(),
        best.start + 1,
        best.end
    ));
    Ok(best.collect())
}

fn mean(frames: &[Image], which: &[usize]) -> Image {
    let mut sum = Image::zeros(frames[0].width, frames[0].height);
    for i in which {
        sum.values.iter_mut().zip(&frames[*i].values).for_each(|(s, v)| *s += v / which.len() as f32);
    }
    sum
}

/// Finds pixels that have the brightest or the darkest value in every frame, such as those of burnt-in letters. They are only
/// searched where the file states that there is burnt-in text.
fn burnt_in_text(run: &Run) -> Vec<usize> {
    if !run.burnt_in || run.frames.len() < 2 {
        return Vec::new();
    }
    let darkest = run.frames.iter().flatten().copied().fold(f32::MAX, f32::min);
    let fixed = |p: usize, value: f32| run.frames.iter().all(|f| f[p] == value);
    (0..run.width * run.height).filter(|p| fixed(*p, run.range.white) || fixed(*p, darkest)).collect()
}

fn without_text(frame: &[f32], width: usize, text: &[usize]) -> Vec<f32> {
    let mut out = frame.to_vec();
    let marked: std::collections::HashSet<usize> = text.iter().copied().collect();
    for p in text {
        // Nearest pixels to the left and right that are not text.
        let row = p / width * width;
        let left = (row..*p).rev().find(|q| !marked.contains(q));
        let right = (*p + 1..row + width).find(|q| !marked.contains(q));
        let beside: Vec<f32> = left.into_iter().chain(right).map(|q| frame[q]).collect();
        if !beside.is_empty() {
            out[*p] = beside.iter().sum::<f32>() / beside.len() as f32;
        }
    }
    out
}
