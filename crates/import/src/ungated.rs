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

/// Displacement of the table across a view, mm, from which the images are compared with it: those of images are right to half a millimetre.
const MIN_TABLE_MM: f64 = 2.0;
/// Largest difference between the displacement of images and that of the table, as a share of the latter: a
/// wrong axis, sign or unit makes it 1 or more, and noise of three simulated runs with 6 mm up to .1.
const TABLE_DIFFERS: f64 = 0.5;

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
        let seen: Vec<[f64; 2]> = found.displacements.iter().map(|d| d.map(|pixels| -f64::from(pixels) * mm)).collect();
        notes.extend(
            table_note(&stated_mm(c_arms, [frames[0].width, frames[0].height], mm), &seen)
                .map(|note| format!("{name}: {note}")),
        );
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

/// Places in the images of what lies at the isocentre at the first frame and is carried by the table, mm at the isocentre along columns and
/// rows; empty where a C-arm has no rays.
fn stated_mm(c_arms: &[CArm], size: [usize; 2], mm: f64) -> Vec<[f64; 2]> {
    let place = |c_arm: &CArm| {
        let rays = Geometry::CArm(c_arm.clone()).rays(size[0], size[1]).ok()?;
        rays.project(DVec3::ZERO).map(|(column, row)| [column * mm, row * mm])
    };
    c_arms.iter().map(place).collect::<Option<Vec<_>>>().unwrap_or_default()
}

/// Compares the displacements of the table that a file states with those of the background of its images, mm; returns a note where the
/// table moves.
fn table_note(stated: &[[f64; 2]], seen: &[[f64; 2]]) -> Option<String> {
    let from_first = |places: &[[f64; 2]], k: usize, axis: usize| places[k][axis] - places[0][axis];
    let largest = |of: &dyn Fn(usize, usize) -> f64| {
        (0..stated.len().min(seen.len())).flat_map(|k| [of(k, 0), of(k, 1)]).map(f64::abs).fold(0.0, f64::max)
    };
    let table = largest(&|k, axis| from_first(stated, k, axis));
    if table < MIN_TABLE_MM {
        return None;
    }
    let background = largest(&|k, axis| from_first(seen, k, axis));
    let apart = largest(&|k, axis| from_first(stated, k, axis) - from_first(seen, k, axis));
    Some(if apart <= TABLE_DIFFERS * table {
        format!(
            "the table moves by {table:.1} mm across the view as the file states it, which the images confirm to {apart:.1} mm"
        )
    } else {
        format!(
            "the table moves by {table:.1} mm across the view as the file states it, but the background of the images by {background:.1} mm, \
             {apart:.1} mm from there at most: the displacement of the images is used. Compare the table positions with their source"
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
    fn table_positions_are_compared_with_the_images() {
        let c_arm = |along_mm: f64| CArm {
            primary_deg: 20.0,
            secondary_deg: 0.0,
            sid_mm: 1000.0,
            sod_mm: 700.0,
            pixel_mm: [0.5; 2],
            offset_mm: [0.0; 2],
            table_mm: [0.0, 0.0, along_mm],
        };
        let at_isocentre = 0.5 * 700.0 / 1000.0;
        let panned: Vec<CArm> = [0.0, 0.0, 4.0, 9.0].map(c_arm).to_vec();
        let stated = stated_mm(&panned, [64, 64], at_isocentre);
        // Rows count from the head's side, so that a patient who is moved towards the head moves up.
        assert!((stated[3][1] - stated[0][1] + 9.0).abs() < 1e-6, "{stated:?}");
        let seen: Vec<[f64; 2]> = stated.iter().map(|[column, row]| [column - 31.5, 0.9 * row]).collect();
        assert!(table_note(&stated, &seen).is_some_and(|note| note.contains("confirm")));
        let other: Vec<[f64; 2]> = stated.iter().map(|[column, row]| [*column, 2.0 * stated[0][1] - row]).collect();
        assert!(table_note(&stated, &other).is_some_and(|note| note.contains("18.0 mm from there")));
        assert_eq!(table_note(&stated_mm(&[c_arm(0.0), c_arm(0.0)], [64, 64], at_isocentre), &seen), None);
    }

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
