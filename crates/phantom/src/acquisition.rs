//! Runs as a cath lab makes them: frames of several beats, in which contrast agent arrives and leaves, the table is panned, and the tube needs
//! some frames to reach its dose. They have no ECG. Each run is written as a DICOM file and as a folder of pictures.

use crate::camera::{Camera, Exposure, Shooting, Stage};
use crate::degradations::{Chance, Degradations, Draw, USUAL_FRAMES_PER_S};
use crate::error::{Error, Result};
use crate::formats::png;
use crate::geometry::{CArm, Geometry};
use crate::noise::add_noise;
use crate::projector::Projector;
use crate::runs::{SYSTOLE_S, Shot, USUAL_BEAT_S, contrast_gain};
use crate::scan::dataset::Split;
use crate::scan::gating::{BeatTime, two_segment_fraction};
use crate::scan::truth::{TrueFrame, Truth};
use crate::subjects::Placed;
use crate::voxels::Breath;
use glam::DVec3;
use nertca_vk::export::dicom::{DicomView, write};
use nertca_vk::files;
use std::fmt::Write;
use std::path::{Path, PathBuf};

/// Time at which contrast agent enters the vessels, seconds.
const ARRIVAL_S: f64 = 0.6;
/// Time in which it reaches the ends of the vessels where no other is given, seconds.
const INFLOW_S: f64 = 0.5;
/// Share of the run after which contrast agent leaves, and what is left at the end of the run.
const WASHOUT: [f64; 2] = [0.8, 0.35];
/// Shares of the run between which the table is panned.
const PANNED: [f64; 2] = [0.6, 0.95];
/// Panning to the side, a share of that along the patient.
const ASIDE: f64 = 0.6;
/// Dose of the first frame as a share of the full one, and the number of frames in which it is reached.
const RAMP: (f64, f64) = (0.3, 3.0);
/// Share of the pixels that a frame's exposure makes white.
const WHITE_SHARE: f64 = 0.005;
/// File that states the runs' geometry for an import of their pictures.
pub const VIEWS: &str = "views.toml";

/// Options of runs.
#[derive(Debug, Clone)]
pub struct Acquisition {
    /// Directory to write: `viewN.dcm`, folders `viewN` of pictures, [`VIEWS`] and `truth.json`.
    pub directory: PathBuf,
    /// Frames of each run.
    pub frames: u32,
    /// Panning of the table within each run, mm along the patient.
    pub panning_mm: f64,
    /// Number of bits of a pixel.
    pub bits: u32,
}

impl Acquisition {
    /// Rejects impossible runs.
    pub(super) fn check(&self, degradations: &Degradations) -> Result<()> {
        if !(1..=500).contains(&self.frames) {
            return Err(Error::config("frames", self.frames, "is not in the accepted range, 1 to 500"));
        }
        if !(0.0..=100.0).contains(&self.panning_mm) {
            return Err(Error::config("panning", self.panning_mm, "is not in the accepted range, 0 to 100 mm"));
        }
        if !(8..=16).contains(&self.bits) {
            return Err(Error::config("bits", self.bits, "is not in the accepted range, 8 to 16"));
        }
        if degradations.collimated_share > 0.0 {
            let problem = "is not supported in runs; make a dataset without them";
            return Err(Error::config("collimated_share", degradations.collimated_share, problem));
        }
        if self.directory.exists() && std::fs::read_dir(&self.directory).is_ok_and(|mut files| files.next().is_some()) {
            let problem = "already contains files; choose another directory";
            return Err(Error::config("runs", self.directory.display(), problem));
        }
        Ok(())
    }

    /// Takes a run of each training view and writes them.
    pub(super) fn take(
        &self,
        projector: &Projector,
        stage: &Stage,
        shooting: &Shooting<'_>,
        mut progress: impl FnMut(&str, u64, u64),
    ) -> Result<()> {
        files::create_directory(&self.directory)?;
        let mut camera = Camera::new(projector, stage, shooting.size)?;
        let still = stage.subject.still(projector, DVec3::ZERO)?.map(Placed::at_rest);
        let mut truth = Truth::new(shooting.seed, stage.phases);
        let mut views = String::new();
        let runs = shooting.views.training.len();
        for view in 0..runs {
            let chance = shooting.chance(view);
            let rate = frames_per_s(shooting.degradations);
            // A file does not state that the patient moved between the runs.
            let in_error = shooting.stated(&stage.c_arms[view], view, Split::Train);
            let stated = CArm { table_mm: stage.c_arms[view].table_mm, ..in_error.clone() };
            let taken = CArm { table_mm: in_error.table_mm, ..stage.c_arms[view].clone() };
            let mut frames = Vec::new();
            for frame in 0..self.frames {
                progress(
                    "runs",
                    view as u64 * u64::from(self.frames) + u64::from(frame),
                    runs as u64 * u64::from(self.frames),
                );
                let time_s = f64::from(frame) / rate;
                let shot = self.shot(shooting.degradations, stage, chance, time_s);
                let c_arm = self.panned(&taken, chance, frame);
                let rays = Geometry::CArm(c_arm.clone())
                    .rays(shooting.size, shooting.size)
                    .map_err(|(field, problem)| Error::config(field, "", problem))?;
                let background = camera.still_through(still.as_ref(), &rays)?;
                let Exposure { mut image, .. } =
                    camera.expose_through(&rays, background, &shot, shooting.degradations.catheter)?;
                if let Some(photons) = shooting.degradations.photons {
                    let stream = (view as u32) << 16 | 0x8000 | frame;
                    add_noise(&mut image, photons.scaled(dose(frame)), shooting.seed, stream);
                }
                truth.frames.push(true_frame(view, frame, &c_arm, &shot, stage.phases));
                frames.push(image);
            }
            self.expose(&mut frames);
            self.write(view, &stated, shooting.size, rate, &frames)?;
            describe(&mut views, view, &stated, rate);
        }
        files::write_atomic(&self.directory.join(VIEWS), views.as_bytes())?;
        truth.write(&self.directory)
    }

    /// State of the patient at a time of a run.
    fn shot(&self, degradations: &Degradations, stage: &Stage, chance: Chance, time_s: f64) -> Shot {
        let rates = degradations.rhythm.as_ref().map(|rhythm| &rhythm.beats_per_min);
        let beat_s = rates.map_or(USUAL_BEAT_S, |rates| 60.0 / rates[chance.view as usize % rates.len()]);
        let systole_s = SYSTOLE_S.start + (SYSTOLE_S.end - SYSTOLE_S.start) * chance.uniform(Draw::Systole);
        let since_r_s = (beat_s * chance.uniform(Draw::RunStart) + time_s).rem_euclid(beat_s);
        let fraction = two_segment_fraction(since_r_s, beat_s, systole_s).rem_euclid(1.0);
        let inflow_s = if degradations.inflow_s > 0.0 { degradations.inflow_s } else { INFLOW_S };
        let course = time_s * frames_per_s(degradations) / f64::from(self.frames);
        let washed = ((course - WASHOUT[0]) / (1.0 - WASHOUT[0])).clamp(0.0, 1.0);
        let varied = match degradations.contrast_variation {
            0.0 => 1.0,
            variation => contrast_gain(variation, time_s, chance),
        };
        let fraction = stage.subject.nearest_fraction(fraction);
        Shot {
            stated: BeatTime::of(fraction * f64::from(stage.phases), stage.phases),
            time_s,
            fraction,
            breath: degradations.breathing.map_or_else(Breath::default, |breathing| breathing.at(time_s, chance)),
            contrast_gain: varied * (1.0 - washed * (1.0 - WASHOUT[1])),
            filled_to: ((time_s - ARRIVAL_S) / inflow_s).clamp(0.0, 1.0),
        }
    }

    /// C-arm of a frame, with the table where it is then.
    fn panned(&self, c_arm: &CArm, chance: Chance, frame: u32) -> CArm {
        let course = (f64::from(frame) / f64::from(self.frames) - PANNED[0]) / (PANNED[1] - PANNED[0]);
        let way = 0.5 - 0.5 * (std::f64::consts::PI * course.clamp(0.0, 1.0)).cos();
        let side = if chance.uniform(Draw::Panning) < 0.5 { -1.0 } else { 1.0 };
        let [left, posterior, superior] = c_arm.table_mm;
        let along = self.panning_mm * way;
        CArm { table_mm: [left + side * ASIDE * along, posterior, superior + along], ..c_arm.clone() }
    }

    /// Exposes a run: line integrals become those above its brightest pixels, with the steps of the pixels' bits.
    fn expose(&self, frames: &mut [Vec<f32>]) {
        let mut all: Vec<f32> = frames.iter().flatten().copied().collect();
        let place = (WHITE_SHARE * all.len() as f64) as usize;
        let brightest = *all.select_nth_unstable_by(place, f32::total_cmp).1;
        let steps = (1u32 << self.bits) as f32 - 1.0;
        for value in frames.iter_mut().flatten() {
            let stored = ((brightest - *value).exp().min(1.0) * steps).round().max(1.0);
            *value = -(stored / steps).ln();
        }
    }

    fn write(&self, view: usize, stated: &CArm, size: usize, rate: f64, frames: &[Vec<f32>]) -> Result<()> {
        let folder = self.directory.join(format!("view{view}"));
        files::create_directory(&folder)?;
        for (frame, values) in frames.iter().enumerate() {
            let codes = values.iter().map(|v| (f32::from(u16::MAX) * (-v).exp()).round() as u16).collect();
            png::write_grey16(&self.directory.join(picture(view, frame as u32)), size, size, codes)?;
        }
        let view_of = DicomView {
            c_arm: stated,
            size: [size; 2],
            frames,
            frame_ms: 1e3 / rate,
            description: "A simulated run",
            seeds: [1, 2, 3].map(|k| u128::from(k + 8 * view as u64)),
        };
        write(&folder.with_extension("dcm"), &view_of)
    }
}

fn frames_per_s(degradations: &Degradations) -> f64 {
    degradations.rhythm.as_ref().map_or(USUAL_FRAMES_PER_S, |rhythm| rhythm.frames_per_s)
}

/// Dose of a frame as a share of the full one.
fn dose(frame: u32) -> f64 {
    let (first, frames) = RAMP;
    (first + (1.0 - first) * f64::from(frame) / frames).min(1.0)
}

/// Picture of a frame, relative to the directory of the runs.
fn picture(view: usize, frame: u32) -> PathBuf {
    Path::new(&format!("view{view}")).join(format!("frame-{:03}.png", frame + 1))
}

fn true_frame(view: usize, frame: u32, c_arm: &CArm, shot: &Shot, phases: u32) -> TrueFrame {
    let DVec3 { x: left, y: posterior, z: superior } = shot.breath.heart_mm;
    TrueFrame {
        image: picture(view, frame),
        view,
        split: Split::Train,
        phase: shot.stated.phase,
        geometry: c_arm.clone(),
        heart_shift_mm: [posterior, left, superior],
        beat_phase: shot.fraction * f64::from(phases),
        time_s: shot.time_s,
        contrast_gain: shot.contrast_gain,
        filled_to: shot.filled_to,
        cut_share: 0.0,
    }
}

/// Adds a view to the file that states the geometry of the pictures.
fn describe(views: &mut String, view: usize, c_arm: &CArm, rate: f64) {
    let CArm { primary_deg, secondary_deg, sid_mm, sod_mm, pixel_mm: [across, down], .. } = c_arm;
    // Writing to a string cannot fail.
    let _ = write!(
        views,
        "[[view]]\npath = \"view{view}\"\nangles_deg = [{primary_deg:?}, {secondary_deg:?}]\nsid_mm = {sid_mm:?}\nsod_mm = {sod_mm:?}\n\
         pixel_mm = [{across:?}, {down:?}]\nfps = {rate:?}\n\n"
    );
}
