//! Accepts runs, together or one after the other, and checks them against each other.

use crate::angiograms::{Gating, ImportOptions, Prepared, TakenFrame, frames_of};
use crate::dicom::Run;
use crate::error::{Error, Result};
use crate::geometry::{Geometry, MM_PER_UNIT};
use crate::pictures::{self, PictureView, PixelMeaning};
use crate::scan::at_rest;
use crate::scan::canvas::in_words;
use crate::scan::dataset::{Layout, Split};
use crate::scan::frame_checks::{check_values, checked_view};
use crate::scan::references::{REFERENCES, ReferencedImage, ReferencedRun, References};
use crate::scan::same_view::find_or_add;
use crate::scan::writer::{About, Writer};
use crate::stated::StatedGeometry;
use crate::ungated::{self, OneBeat};
use rayon::prelude::*;
use std::ops::Range;
use std::path::{Path, PathBuf};

/// Largest accepted number of runs.
pub const MAX_RUNS: usize = 64;
/// Difference of angles, in degrees, below which two views are almost the same.
const SAME_ANGLE_DEG: f64 = 5.0;

/// Properties of an accepted run with which other runs are compared.
#[derive(Clone)]
struct AcceptedRun {
    name: String,
    identity: [u64; 2],
    instance: Option<u64>,
    /// Table position of the first frame, as the file states it.
    table_mm: [f64; 3],
    angles_deg: [f64; 2],
}

impl AcceptedRun {
    fn of(run: &Run) -> AcceptedRun {
        let first = &run.c_arms[0];
        AcceptedRun {
            name: run.name(),
            identity: run.identity,
            instance: run.instance,
            table_mm: first.table_mm,
            angles_deg: [first.primary_deg, first.secondary_deg],
        }
    }
}

/// Properties of a run as the user states them.
#[derive(Debug, Clone, Default)]
pub struct StatedRun {
    /// Its geometry.
    pub geometry: StatedGeometry,
    /// Source of its phases, in place of that of all runs.
    pub gating: Option<Gating>,
}

/// Runs that were accepted, with the options of their import.
pub struct Intake {
    options: ImportOptions,
    taken: Vec<AcceptedRun>,
    runs: Vec<Prepared>,
}

impl Intake {
    /// Makes an intake without runs.
    pub fn new(options: ImportOptions) -> Intake {
        Intake { options, taken: Vec::new(), runs: Vec::new() }
    }

    /// Number of cardiac phases of the images.
    pub fn phases(&self) -> u32 {
        if self.is_still() { at_rest::PHASES } else { self.options.phases }
    }

    /// Tells whether the runs show an object at rest.
    pub fn is_still(&self) -> bool {
        matches!(self.options.gating, Gating::Still)
    }

    /// Number of runs accepted so far.
    pub fn runs(&self) -> usize {
        self.runs.len()
    }

    /// First image of the first run; none without runs.
    pub fn first(&self) -> Option<&TakenFrame> {
        self.runs.first().and_then(|run| run.frames.first())
    }

    /// Name of the accepted run that a run is a copy of.
    pub fn copy_of(&self, run: &Run) -> Option<&str> {
        let same = |taken: &&AcceptedRun| taken.instance.is_some() && taken.instance == run.instance;
        self.taken.iter().find(same).map(|taken| taken.name.as_str())
    }

    /// Accepts all of the runs or none, and returns notes for the user.
    ///
    /// # Errors
    /// [`Error::Data`] naming file and tag; [`Error::Config`] naming an option.
    pub fn take(&mut self, runs: Vec<Run>) -> Result<Vec<String>> {
        let gatings = vec![None; runs.len()];
        self.take_gated(runs, &gatings)
    }

    /// Accepts all of the runs or none, as [`Intake::take`] does, with a source of the phases for each run that has its own.
    ///
    /// # Errors
    /// Errors of [`Intake::take`].
    pub fn take_gated(&mut self, mut runs: Vec<Run>, gatings: &[Option<Gating>]) -> Result<Vec<String>> {
        if self.runs() + runs.len() > MAX_RUNS {
            return Err(Error::config(
                "FILE",
                self.runs() + runs.len(),
                format!("is out of range: 1 to {MAX_RUNS} runs are accepted"),
            ));
        }
        let mut notes: Vec<String> =
            runs.iter().flat_map(|run| run.notes.iter().map(|note| format!("{}: {note}", run.name()))).collect();
        let mut taken = self.taken.clone();
        for run in &mut runs {
            notes.extend(check(run, &taken));
            taken.push(AcceptedRun::of(run));
            let first_mm = taken[0].table_mm;
            for c_arm in &mut run.c_arms {
                c_arm.table_mm.iter_mut().zip(first_mm).for_each(|(now, first)| *now -= first);
            }
        }
        let options = &self.options;
        let prepare = |(index, run): (usize, &Run)| match gatings.get(index).cloned().flatten() {
            Some(gating) => Prepared::new(run, &ImportOptions { gating, ..options.clone() }),
            None => Prepared::new(run, options),
        };
        // The first run that is refused is named, whichever is prepared first.
        let prepared: Vec<Result<Prepared>> = runs.par_iter().enumerate().map(prepare).collect();
        let prepared = prepared.into_iter().collect::<Result<Vec<_>>>()?;
        runs.iter().zip(&prepared).try_for_each(|(run, prepared)| trainable(run, prepared, options))?;
        notes.extend(prepared.iter().flat_map(|prepared| prepared.notes.iter().cloned()));
        self.taken = taken;
        self.runs.extend(prepared);
        notes.extend(self.place());
        Ok(notes)
    }

    /// Places runs without ECG in a common beat and in the room; returns notes.
    fn place(&mut self) -> Vec<String> {
        let ungated = || (0..self.runs.len()).filter(|run| self.runs[*run].beat.is_some());
        let names: Vec<String> = ungated().map(|run| self.taken[run].name.clone()).collect();
        let beats: Vec<&OneBeat> = self.runs.iter().filter_map(|run| run.beat.as_ref()).collect();
        if beats.len() < 2 {
            return Vec::new();
        }
        let (placed, notes) = ungated::place(&beats, &names);
        let phases = self.options.phases;
        let placed_runs = self.runs.iter_mut().filter(|run| run.beat.is_some()).zip(placed);
        for (run, placed) in placed_runs {
            run.frames = run.beat.as_ref().map(|beat| frames_of(beat, &placed, phases)).unwrap_or_default();
        }
        notes
    }

    /// Images of a run; runs are counted from 0.
    pub fn frames(&self, run: usize) -> &[TakenFrame] {
        self.runs.get(run).map_or(&[], |run| &run.frames)
    }

    /// Writes the runs as a dataset and returns a summary with the numbers of views, pixels and phases.
    ///
    /// # Errors
    /// [`Error::NotReady`] without runs; [`Error::Io`].
    pub fn write(&self, out: &Path) -> Result<String> {
        self.write_first(self.runs(), out)
    }

    /// Writes the first `runs` runs, as [`Intake::write`] does for all.
    ///
    /// # Errors
    /// Errors of [`Intake::write`].
    pub fn write_first(&self, runs: usize, out: &Path) -> Result<String> {
        let none = || Error::NotReady("no run was imported".into());
        let runs = runs.min(self.runs());
        let first = self.first().ok_or_else(none)?;
        let about = About {
            description: format!("{runs} X-ray angiography runs"),
            phases: self.phases(),
            depth_half_extent_mm: self.options.depth_half_extent_mm,
            vessel_attenuation_per_mm: None,
            still: self.is_still(),
            vessels_alone: self.runs.iter().take(runs).all(|run| run.beat.is_some()),
            size: [first.image.width, first.image.height],
            c_arm: first.c_arm.clone(),
        };
        let mut writer = Writer::new(out, Layout::Native, about)?;
        let (mut views, mut sizes) = (Vec::new(), Vec::new());
        let mut referenced = Vec::new();
        let numbered = self.runs.iter().take(runs).enumerate();
        for (run, TakenFrame { c_arm, taken, image, frames }) in
            numbered.flat_map(|(number, run)| run.frames.iter().map(move |frame| (number, frame)))
        {
            let size = [image.width, image.height];
            if !sizes.contains(&size) {
                sizes.push(size);
            }
            // A dataset that is read has the same views.
            let geometry = Geometry::CArm(c_arm.clone());
            let depth_before = self.options.depth_half_extent_mm / MM_PER_UNIT;
            let view = find_or_add(&mut views, geometry.clone(), size, depth_before)
                .map_err(|found| Error::config(found.field, found.value, found.problem))?;
            let file = writer.frame(&geometry, Split::Train, view, *taken, image, None)?;
            let frames = frames.iter().map(|frame| *frame as u32 + 1).collect();
            referenced.push(ReferencedImage { image: file, run, frames });
        }
        // Runs of one intake have references all or none.
        let sources: Vec<ReferencedRun> = self.runs.iter().take(runs).filter_map(|run| run.reference.clone()).collect();
        if sources.len() == runs {
            References::new(sources, referenced).write(out)?;
        }
        writer.finish()?;
        let times = if self.is_still() { "at rest".to_owned() } else { format!("at {} phases", self.phases()) };
        Ok(format!("{} views of {} pixels {times}", views.len(), in_words(&sizes)))
    }
}

/// Rejects a run that training could not use, by the same checks as on reading a dataset.
fn trainable(run: &Run, prepared: &Prepared, options: &ImportOptions) -> Result<()> {
    prepared
        .frames
        .iter()
        .try_for_each(|TakenFrame { c_arm, image, .. }| {
            check_values(&image.values, image.width)?;
            let depth_before = options.depth_half_extent_mm / MM_PER_UNIT;
            checked_view(Geometry::CArm(c_arm.clone()), [image.width, image.height], depth_before).map(drop)
        })
        .map_err(|found| Error::data(&run.path, found.field, format!("{}: {}", found.value, found.problem)))
}

/// Fields of view at the isocentre that a C-arm shows, mm: its detector is 100 to 600 mm wide, and it magnifies by 1 to 2.
const FIELDS_MM: Range<f64> = 30.0..600.0;

/// Returns a warning on a field of view that no C-arm has.
fn implausible_field(run: &Run) -> Option<String> {
    let c_arm = run.c_arms.first()?;
    let field_mm = run.width as f64 * c_arm.pixel_mm[0] * c_arm.sod_mm / c_arm.sid_mm;
    (!FIELDS_MM.contains(&field_mm)).then(|| {
        format!(
            "warning: {}: its {} columns of {} mm are {field_mm:.3} mm wide at the isocentre, and C-arms show {} to {} mm: is the pixel size \
             stated in mm, at the detector?",
            run.name(),
            run.width,
            c_arm.pixel_mm[0],
            FIELDS_MM.start,
            FIELDS_MM.end
        )
    })
}

/// Notes and warnings on a run alone and on differences between it and the earlier runs.
fn check(run: &Run, before: &[AcceptedRun]) -> Vec<String> {
    let (name, this) = (run.name(), AcceptedRun::of(run));
    let mut notes: Vec<String> = implausible_field(run).into_iter().collect();
    let Some(first) = before.first() else { return notes };
    if this.identity[0] != first.identity[0] {
        notes.push(format!("warning: {name} belongs to another patient than {}", first.name));
    } else if this.identity[1] != first.identity[1] {
        notes.push(format!("warning: {name} belongs to another study than {}", first.name));
    }
    let [left, down, along] = [0, 1, 2].map(|k| this.table_mm[k] - first.table_mm[k]);
    if [left, down, along] != [0.0; 3] {
        let lengthwise = if along == 0.0 {
            "; XA objects do not store a motion along the patient in public tags".to_owned()
        } else {
            format!(", including {along} mm towards the head")
        };
        notes.push(format!(
            "{name}: the table moved by {left} mm to the left and {down} mm down since {}, which was corrected{lengthwise}",
            first.name
        ));
    }
    let near = |other: &&AcceptedRun| (0..2).all(|k| (other.angles_deg[k] - this.angles_deg[k]).abs() < SAME_ANGLE_DEG);
    let near = before.iter().filter(near);
    notes.extend(near.map(|other| format!("warning: {} and {name} have almost the same viewing angle", other.name)));
    notes
}

/// Imports runs as a dataset and returns notes for the user.
///
/// # Errors
/// [`Error::Data`] naming file and tag; [`Error::Config`] naming an option; [`Error::Io`]. In these cases no dataset is
/// written.
pub fn import_dicom(files: &[PathBuf], options: &ImportOptions, out: &Path) -> Result<Vec<String>> {
    import_dicom_as_stated(files, &vec![StatedRun::default(); files.len()], options, out)
}

/// Imports runs like [`import_dicom`], with what the user states of each; `stated` has one entry for each file.
///
/// # Errors
/// Errors of [`import_dicom`].
pub fn import_dicom_as_stated(
    files: &[PathBuf],
    stated: &[StatedRun],
    options: &ImportOptions,
    out: &Path,
) -> Result<Vec<String>> {
    check_number(files.len())?;
    let read = |(file, stated): (&PathBuf, &StatedRun)| {
        let pixel_mm = stated.geometry.pixel_mm.or(options.pixel_mm);
        Run::read_as_stated(file, &StatedGeometry { pixel_mm, ..stated.geometry })
    };
    let runs = files.iter().zip(stated).map(read).collect::<Result<Vec<_>>>()?;
    write_runs(runs, &stated.iter().map(|stated| stated.gating.clone()).collect::<Vec<_>>(), options, out)
}

/// Imports pictures as a dataset, one run per view, and returns notes for the user; `gatings` has one entry for each view.
///
/// # Errors
/// Errors of [`import_dicom`].
pub fn import_pictures(
    views: &[PictureView],
    gatings: &[Option<Gating>],
    meaning: &PixelMeaning,
    options: &ImportOptions,
    out: &Path,
) -> Result<Vec<String>> {
    check_number(views.len())?;
    let runs = views.iter().map(|view| pictures::read(view, meaning)).collect::<Result<Vec<_>>>()?;
    write_runs(runs, gatings, options, out)
}

fn check_number(runs: usize) -> Result<()> {
    if (1..=MAX_RUNS).contains(&runs) {
        return Ok(());
    }
    Err(Error::config("FILE", runs, format!("is out of range: 1 to {MAX_RUNS} runs are accepted")))
}

fn write_runs(runs: Vec<Run>, gatings: &[Option<Gating>], options: &ImportOptions, out: &Path) -> Result<Vec<String>> {
    let mut intake = Intake::new(options.clone());
    let mut notes = intake.take_gated(runs, gatings)?;
    notes.push(intake.write(out)?);
    if options.keep_references {
        notes.push(format!(
            "{REFERENCES} keeps, for results that an archive can file with the runs: name, identifier, birth date and sex of the patient, \
             date, time, identifier, accession number and referring physician of the study, the UIDs of study, series and images, and \
             the numbers of the frames. Delete it before the dataset is passed on"
        ));
    }
    Ok(notes)
}
