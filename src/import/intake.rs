//! Runs that are taken in, together or one after the other, checked against one another, and brought to one size.

use crate::error::{Error, Result};
use crate::geometry::{CArm, Geometry, MM_PER_UNIT};
use crate::import::angiograms::{Gating, ImportOptions, View};
use crate::import::dicom::Run;
use crate::raster::Image;
use crate::scan::dataset::{Layout, Split};
use crate::scan::frame_checks::{check_values, checked_rays};
use crate::scan::gating::BeatTime;
use crate::scan::writer::{About, Writer};
use rayon::prelude::*;
use std::path::Path;

/// Runs at most.
pub const MOST_RUNS: usize = 64;
/// Angles within so many degrees are almost the same.
const SAME_ANGLE_DEG: f64 = 5.0;

/// What other runs are compared with.
#[derive(Clone)]
struct Taken {
    name: String,
    identity: [u64; 2],
    instance: Option<u64>,
    /// Of the first frame, as the file says.
    table_mm: [f64; 3],
    angles_deg: [f64; 2],
}

impl Taken {
    fn of(run: &Run) -> Taken {
        let first = &run.c_arms[0];
        Taken {
            name: run.name(),
            identity: run.identity,
            instance: run.instance,
            table_mm: first.table_mm,
            angles_deg: [first.primary_deg, first.secondary_deg],
        }
    }
}

/// An image of a run as it is trained on.
pub struct TakenFrame {
    /// How it was taken.
    pub geometry: Geometry,
    /// When in the beat.
    pub taken: BeatTime,
    /// Line integrals.
    pub image: Image,
}

/// Runs that were taken in.
pub struct Intake {
    options: ImportOptions,
    taken: Vec<Taken>,
    views: Vec<View>,
}

impl Intake {
    /// No runs yet.
    pub fn new(options: ImportOptions) -> Intake {
        Intake { options, taken: Vec::new(), views: Vec::new() }
    }

    /// Cardiac phases of the images.
    pub fn phases(&self) -> u32 {
        if matches!(self.options.gating, Gating::Still) { 2 } else { self.options.phases }
    }

    /// Runs taken in so far.
    pub fn runs(&self) -> usize {
        self.views.len()
    }

    /// How the first run was taken.
    pub fn c_arm(&self) -> Option<&CArm> {
        self.views.first().map(|view| &view.c_arm)
    }

    /// Name of the run taken in that a run is a copy of.
    pub fn copy_of(&self, run: &Run) -> Option<&str> {
        let same = |taken: &&Taken| taken.instance.is_some() && taken.instance == run.instance;
        self.taken.iter().find(same).map(|taken| taken.name.as_str())
    }

    /// Takes runs in, all or none, and returns what a user should know.
    ///
    /// # Errors
    /// [`Error::Data`] naming file and tag; [`Error::Config`] naming an option.
    pub fn take(&mut self, mut runs: Vec<Run>) -> Result<Vec<String>> {
        if self.runs() + runs.len() > MOST_RUNS {
            return Err(Error::config("FILE", self.runs() + runs.len(), format!("1 to {MOST_RUNS} runs are accepted")));
        }
        let mut notes: Vec<String> =
            runs.iter().flat_map(|run| run.notes.iter().map(|note| format!("{}: {note}", run.name()))).collect();
        let mut taken = self.taken.clone();
        for run in &mut runs {
            notes.extend(check(run, &taken));
            taken.push(Taken::of(run));
            let first_mm = taken[0].table_mm;
            for c_arm in &mut run.c_arms {
                c_arm.table_mm.iter_mut().zip(first_mm).for_each(|(now, first)| *now -= first);
            }
        }
        let options = &self.options;
        let views = runs.par_iter().map(|run| View::prepare(run, options)).collect::<Result<Vec<_>>>()?;
        runs.iter().zip(&views).try_for_each(|(run, view)| trainable(run, view, options))?;
        notes.extend(views.iter().flat_map(|view| view.notes.iter().cloned()));
        self.taken = taken;
        self.views.extend(views);
        Ok(notes)
    }

    /// Columns and rows that all runs have: the smallest open area, around the middle of each. None without runs.
    pub fn size(&self) -> Option<[usize; 2]> {
        self.size_of(self.runs())
    }

    /// Columns and rows that the first `runs` have.
    fn size_of(&self, runs: usize) -> Option<[usize; 2]> {
        let image = |view: &View| [view.images[0].1.width, view.images[0].1.height];
        self.views.iter().take(runs).map(image).reduce(|a, b| [a[0].min(b[0]), a[1].min(b[1])])
    }

    /// The images of a run, counted from 0, cut to the size of all.
    pub fn frames(&self, run: usize) -> Vec<TakenFrame> {
        self.size().map_or_else(Vec::new, |size| self.frames_of_size(run, size))
    }

    fn frames_of_size(&self, run: usize, [width, height]: [usize; 2]) -> Vec<TakenFrame> {
        let Some(view) = self.views.get(run) else { return Vec::new() };
        let frame = |(taken, image): &(BeatTime, Image)| {
            let (image, offset) = cut(image, width, height);
            let moved = |k: usize| view.c_arm.offset_mm[k] + offset[k] * view.c_arm.pixel_mm[k];
            let geometry = Geometry::CArm(CArm { offset_mm: [moved(0), moved(1)], ..view.c_arm.clone() });
            TakenFrame { geometry, taken: *taken, image }
        };
        view.images.iter().map(frame).collect()
    }

    /// Writes the runs as a dataset; how many views of which size there are.
    ///
    /// # Errors
    /// [`Error::NotReady`] without runs; [`Error::Io`].
    pub fn write(&self, out: &Path) -> Result<String> {
        self.write_first(self.runs(), out)
    }

    /// Writes the first `runs` as [`Intake::write`] would have before others came.
    ///
    /// # Errors
    /// As [`Intake::write`].
    pub fn write_first(&self, runs: usize, out: &Path) -> Result<String> {
        let none = || Error::NotReady("no run was taken in".into());
        let runs = runs.min(self.runs());
        let ([width, height], c_arm) = self.size_of(runs).zip(self.c_arm()).ok_or_else(none)?;
        let about = About {
            description: format!("{runs} X-ray angiography runs"),
            phases: self.phases(),
            depth_half_extent_mm: self.options.depth_half_extent_mm,
            vessel_attenuation_per_mm: None,
            size: [width, height],
            c_arm: c_arm.clone(),
        };
        let mut writer = Writer::new(out, Layout::Native, about)?;
        for run in 0..runs {
            for TakenFrame { geometry, taken, image } in self.frames_of_size(run, [width, height]) {
                writer.frame(&geometry, Split::Train, run, taken, &image.values, None)?;
            }
        }
        writer.finish()?;
        Ok(format!("{runs} views of {width} x {height} pixels at {} phases", self.phases()))
    }
}

/// Refuses a run that no training could use, as those who read its dataset would.
fn trainable(run: &Run, view: &View, options: &ImportOptions) -> Result<()> {
    let geometry = Geometry::CArm(view.c_arm.clone());
    view.images
        .iter()
        .try_for_each(|(_, image)| {
            check_values(&image.values, image.width)?;
            let depth_before = options.depth_half_extent_mm / MM_PER_UNIT;
            checked_rays(&geometry, (image.width, image.height), depth_before).map(drop)
        })
        .map_err(|found| Error::data(&run.path, found.field, format!("{}: {}", found.value, found.problem)))
}

/// What does not fit to the runs before.
fn check(run: &Run, before: &[Taken]) -> Vec<String> {
    let (mut notes, name, this) = (Vec::new(), run.name(), Taken::of(run));
    let Some(first) = before.first() else { return notes };
    if this.identity[0] != first.identity[0] {
        notes.push(format!("warning: {name} is of another patient than {}", first.name));
    } else if this.identity[1] != first.identity[1] {
        notes.push(format!("warning: {name} is of another study than {}", first.name));
    }
    let [left, down, along] = [0, 1, 2].map(|k| this.table_mm[k] - first.table_mm[k]);
    if [left, down, along] != [0.0; 3] {
        notes.push(format!(
            "{name}: the table moved by {left} mm to the left and {down} mm down since {}, which was taken into account; a move \
             along the patient is not in public tags",
            first.name
        ));
    }
    let near = |other: &&Taken| (0..2).all(|k| (other.angles_deg[k] - this.angles_deg[k]).abs() < SAME_ANGLE_DEG);
    let near = before.iter().filter(near);
    notes.extend(near.map(|other| format!("warning: {} and {name} look from almost the same angle", other.name)));
    notes
}

/// The middle `width` x `height` pixels, and by how many pixels the middle moved.
fn cut(image: &Image, width: usize, height: usize) -> (Image, [f64; 2]) {
    let (x, y) = ((image.width - width) / 2, (image.height - height) / 2);
    let values = (0..height).flat_map(|j| image.values[(y + j) * image.width + x..][..width].iter().copied()).collect();
    let moved = |start: usize, kept: usize, all: usize| start as f64 + 0.5 * kept as f64 - 0.5 * all as f64;
    (Image { width, height, values }, [moved(x, width, image.width), moved(y, height, image.height)])
}
