//! Runs without ECG: the beat of each run that is used, and its place in the common beat and in the room.

use crate::dicom::Run;
use crate::error::{Error, Result};
use crate::geometry::{CArm, Geometry, ViewRays, lps_mm_from_world};
use crate::raster::Image;
use crate::scan::gating::BeatTime;
use glam::DVec3;
use nertca_vk_angiograms::calibrate::runs::{Aligned, Beating, PairAgreement, STEPS, align};
use nertca_vk_angiograms::cine::Cine;
use std::ops::{Range, RangeInclusive};

/// Shorter side of the images in which vessels are found, pixels: about 0.4 mm per pixel at the isocentre.
pub(super) const SIDE: usize = 256;
/// Largest accepted number of frames of a run: 20 s at 15 per second.
const MAX_FRAMES: usize = 300;
/// Angle to a plane within which views count as looking along it, degrees: a displacement of 5 mm in the plane then moves profiles by less
/// than .5 mm, a pixel.
const ONE_PLANE_DEG: f64 = 5.0;

/// Place of a run in the common beat, and in the room.
pub(super) struct Placed {
    /// Step of the run's own beat that is step 0 of the common one.
    first_step: usize,
    /// Displacement of the patient, LPS, mm.
    table_mm: DVec3,
    /// Factor on the size of its pixels.
    scale: f64,
}

impl Default for Placed {
    fn default() -> Placed {
        Placed { first_step: 0, table_mm: DVec3::ZERO, scale: 1.0 }
    }
}

/// The beat of a run that is used.
pub(super) struct OneBeat {
    /// C-arm of all its images.
    c_arm: CArm,
    rays: ViewRays,
    /// Column and row at which the images begin.
    pub(super) first: [usize; 2],
    /// Frames of the beat, from 0.
    frames: Range<usize>,
    /// Length of the beat, frames.
    length: f64,
    /// Vessels of these frames.
    vessels: Vec<Image>,
}

/// Vessels of a frame of a beat.
pub(super) struct BeatImage {
    /// Time in the common beat.
    pub(super) taken: BeatTime,
    /// Frame of the run, from 0.
    pub(super) frame: usize,
    /// Line integrals of the vessels.
    pub(super) image: Image,
}

impl OneBeat {
    /// Finds the beat of a run to use, within the frames that were `asked` for (from 1), and the vessels of its frames. `mm` is the size of a
    /// pixel at the isocentre, `dark` the line integral from which a pixel may show a blade.
    ///
    /// # Errors
    /// [`Error::Data`] for a run whose frames do not repeat; [`Error::Config`] for options that do not fit the run.
    pub(super) fn of(
        run: &Run,
        frames: &[Image],
        c_arms: &[CArm],
        mm: f64,
        asked: Option<&RangeInclusive<usize>>,
        dark: f32,
        notes: &mut Vec<String>,
    ) -> Result<OneBeat> {
        let refused = |problem: String| Error::data(&run.path, "phases", problem);
        let n = frames.len();
        let name = run.name();
        let within = match asked {
            None => 0..n,
            Some(asked) if *asked.start() > 0 && *asked.end() <= n && !asked.is_empty() => {
                asked.start() - 1..*asked.end()
            }
            Some(asked) => {
                let problem = format!("{name} has frames 1 to {n}");
                return Err(Error::config("frames", format!("{}-{}", asked.start(), asked.end()), problem));
            }
        };
        let other = "give R-peaks, a heart rate or the phases of the frames";
        let frame_s = match (run.times_s.first(), run.times_s.last()) {
            (Some(first), Some(last)) if run.times_s.len() == n && n > 2 && last > first => {
                (last - first) / (n - 1) as f64
            }
            _ if n <= 2 => return Err(refused(format!("{n} frames are too few to show a beat: {other}"))),
            _ => {
                return Err(refused(format!(
                    "the times of the frames are not known: state the frames per second, or {other}"
                )));
            }
        };
        if run.times_s.windows(2).any(|pair| (pair[1] - pair[0] - frame_s).abs() > 0.5 * frame_s) {
            return Err(refused(format!("the times of the frames are not equally spaced: {other}")));
        }
        if n > MAX_FRAMES {
            return Err(refused(format!(
                "{n} frames are given, of which all pairs are compared: at most {MAX_FRAMES} are accepted"
            )));
        }
        let found = Cine::new(frames, 1.0 / frame_s, dark, mm);
        let Some(rhythm) = found.rhythm else {
            return Err(refused(format!(
                "the {n} frames in {:.1} s do not repeat, as they would in one and a quarter beats of a regular rhythm: {other}",
                frame_s * (n - 1) as f64
            )));
        };
        let beat = found.beat(within, rhythm.frames, mm);
        if found.vessels[beat.clone()].iter().flat_map(|image| &image.values).all(|value| *value == 0.0) {
            return Err(refused(format!(
                "no vessels stand out in frames {} to {}: --frames chooses others, or {other}",
                beat.start + 1,
                beat.end
            )));
        }
        let contrast = &found.contrast[beat.clone()];
        notes.push(format!(
            "{name}: {:.0} beats per minute, found in the images (similarity of frames returns by {:.0} % after one beat); a regular \
             rhythm is assumed",
            60.0 / (rhythm.frames * frame_s),
            100.0 * rhythm.returns
        ));
        notes.push(format!(
            "{name}: the beat of frames {} to {} of {n} is used, which has {:.0} to {:.0} % of the strongest contrast; the background moved by \
             {:.1} mm within it and {:.1} mm in the run, which was removed; --frames restricts the choice",
            beat.start + 1,
            beat.end,
            100.0 * contrast.iter().copied().fold(f64::MAX, f64::min),
            100.0 * contrast.iter().copied().fold(0.0, f64::max),
            found.travel_mm(beat.clone(), mm),
            found.travel_mm(0..n, mm)
        ));
        let [columns, rows] = found.area.clone();
        let first = [columns.start, rows.start];
        let size = [columns.len(), rows.len()];
        let c_arm = cropped(&c_arms[beat.start + beat.len() / 2], [frames[0].width, frames[0].height], first, size);
        let rays = Geometry::CArm(c_arm.clone()).rays(size[0], size[1]).map_err(|(_, problem)| refused(problem))?;
        let vessels = found.vessels[beat.clone()].iter().map(|image| part(image, &columns, &rows)).collect();
        Ok(OneBeat { c_arm, rays, first, frames: beat, length: rhythm.frames, vessels })
    }

    /// C-arm of all images of a run at its place.
    pub(super) fn c_arm(&self, placed: &Placed) -> CArm {
        let sum: DVec3 = DVec3::from_array(self.c_arm.table_mm) + placed.table_mm;
        let scaled = |mm: [f64; 2]| mm.map(|mm| mm * placed.scale);
        let (pixel_mm, offset_mm) = (scaled(self.c_arm.pixel_mm), scaled(self.c_arm.offset_mm));
        CArm { table_mm: sum.to_array(), pixel_mm, offset_mm, ..self.c_arm.clone() }
    }

    /// Images at whole phases of the common beat, each the frame nearest to its phase.
    pub(super) fn images(&self, placed: &Placed, n_phases: u32) -> Vec<BeatImage> {
        let n = f64::from(n_phases);
        let start = n * placed.first_step as f64 / STEPS as f64;
        let mut nearest: Vec<Option<(BeatTime, usize)>> = vec![None; n_phases as usize];
        for frame in 0..self.vessels.len() {
            let taken = BeatTime::of((n * frame as f64 / self.length - start).rem_euclid(n), n_phases);
            let slot = &mut nearest[taken.phase as usize];
            if slot.is_none_or(|(before, _)| taken.after_phase.abs() < before.after_phase.abs()) {
                *slot = Some((taken, frame));
            }
        }
        let image = |(taken, frame): (BeatTime, usize)| BeatImage {
            taken,
            frame: self.frames.start + frame,
            image: self.vessels[frame].clone(),
        };
        nearest.into_iter().flatten().map(image).collect()
    }

    /// Images at equally spaced times of the run's own beat.
    fn steps(&self) -> Vec<&Image> {
        let frame = |step: usize| (step as f64 / STEPS as f64 * self.length).round() as usize;
        (0..STEPS).map(|step| &self.vessels[frame(step).min(self.vessels.len() - 1)]).collect()
    }
}

/// Places runs in a common beat and in the room; returns notes for the user as well. `names` are those of the runs.
pub(super) fn place(runs: &[&OneBeat], names: &[String]) -> (Vec<Placed>, Vec<String>) {
    let beating: Vec<Beating<'_>> = runs.iter().map(|run| Beating { rays: &run.rays, steps: run.steps() }).collect();
    let Aligned { first_step, scale, displaced, pairs } = align(&beating);
    let placed = |run: usize| Placed {
        first_step: first_step[run],
        table_mm: lps_mm_from_world(displaced[run]),
        scale: scale[run],
    };
    let scaled = (0..runs.len()).filter(|run| (scale[*run] - 1.0).abs() > 1e-9).map(|run| {
        format!(
            "{}: its vessels are {:.0} % {} than in the other runs, so that its distances or its pixel size are wrong; the pixel size was \
             corrected. The mean size of the runs stays as stated",
            names[run],
            100.0 * (scale[run] - 1.0).abs(),
            if scale[run] > 1.0 { "smaller" } else { "larger" }
        )
    });
    let mut first_notes: Vec<String> = scaled.collect();
    first_notes.extend(in_one_plane(&runs.iter().map(|run| run.rays.axis()).collect::<Vec<_>>()));
    let note = |pair: &PairAgreement| {
        let [a, b] = pair.runs;
        format!(
            "{} and {}: displaced by {:.1} mm across their common planes; vessels in these planes have a correlation of {:.2} (as stated: {:.2}), \
             {:.0} % of a beat apart",
            names[a],
            names[b],
            pair.displaced_mm,
            pair.aligned,
            pair.stated,
            100.0 * (first_step[b] as f64 - first_step[a] as f64).rem_euclid(STEPS as f64) / STEPS as f64
        )
    };
    ((0..runs.len()).map(placed).collect(), first_notes.into_iter().chain(pairs.iter().map(note)).collect())
}

/// Returns a note where three or more views look along directions in one plane.
fn in_one_plane(directions: &[DVec3]) -> Option<String> {
    let pairs = directions.iter().enumerate().flat_map(|(k, b)| directions[..k].iter().map(|a| a.cross(*b)));
    let normal = pairs.max_by(|a, b| a.length().total_cmp(&b.length()))?.try_normalize()?;
    let out_deg = directions.iter().map(|d| d.dot(normal).abs().asin().to_degrees()).fold(0.0, f64::max);
    (directions.len() > 2 && out_deg < ONE_PLANE_DEG).then(|| {
        format!(
            "all views look along directions within {out_deg:.1} degrees of one plane: no pair of them shows a displacement of the patient \
             within this plane between the runs. A run from outside of the plane, such as a steep cranial or caudal one, shows it"
        )
    })
}

/// C-arm of a part of an image.
fn cropped(c_arm: &CArm, whole: [usize; 2], first: [usize; 2], size: [usize; 2]) -> CArm {
    let offset = [0, 1].map(|k| {
        let middle = first[k] as f64 + 0.5 * size[k] as f64 - 0.5 * whole[k] as f64;
        c_arm.offset_mm[k] + middle * c_arm.pixel_mm[k]
    });
    CArm { offset_mm: offset, ..c_arm.clone() }
}

fn part(image: &Image, columns: &Range<usize>, rows: &Range<usize>) -> Image {
    let values = rows.clone().flat_map(|y| &image.values[y * image.width..][columns.clone()]).copied().collect();
    Image { width: columns.len(), height: rows.len(), values }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn views_in_one_plane_are_told() {
        let at = |degrees: f64, above: f64| {
            let (sin, cos) = degrees.to_radians().sin_cos();
            DVec3::new(cos, sin, above).normalize()
        };
        let note = |last: DVec3| in_one_plane(&[at(-40.0, 0.0), at(20.0, 0.0), last]);
        assert!(note(at(50.0, 0.03)).is_some_and(|note| note.contains("of one plane")));
        assert_eq!(note(at(50.0, 0.4)), None);
        assert_eq!(in_one_plane(&[at(-40.0, 0.0), at(20.0, 0.0)]), None, "two views always do");
    }
}
