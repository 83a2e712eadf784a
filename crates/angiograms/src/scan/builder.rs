//! Collects the frames of a dataset that is read, and checks each one.

use crate::error::{Error, Result};
use crate::geometry::Geometry;
use crate::raster::Image;
use crate::scan::at_rest;
use crate::scan::canvas::onto_canvas;
use crate::scan::dataset::{Dataset, Frame, Layout, Split, View};
use crate::scan::frame_checks::{Complaint, check_phase, check_values};
use crate::scan::gating::BeatTime;
use crate::scan::same_view::find_or_add;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

const MAX_FRAMES: usize = 100_000;
/// Largest accepted number of cardiac phases.
pub(super) const MAX_PHASES: u32 = 4096;

/// Collects frames and checks each one.
pub(super) struct Builder {
    file: PathBuf,
    n_phases: u32,
    depth_range: (f64, f64),
    vessel_attenuation: Option<f64>,
    still: bool,
    /// Whether the images show vessels and nothing else.
    pub(super) vessels_alone: bool,
    views: Vec<View>,
    frames: Vec<Frame>,
    pub(super) notes: Vec<String>,
}

pub(super) struct NewFrame<'a, F: Fn(f32) -> f32> {
    pub index: usize,
    pub source: &'a Path,
    pub geometry: Geometry,
    pub time_phases: f64,
    pub split: Split,
    pub image: Image,
    pub to_integral: F,
    pub mask: Option<Vec<bool>>,
    pub heart_shift_mm: [f64; 3],
}

impl Builder {
    pub(super) fn new(
        file: &Path,
        n_phases: u32,
        depth_range: (f64, f64),
        vessel_attenuation: Option<f64>,
    ) -> Result<Builder> {
        if n_phases == 0 || n_phases > MAX_PHASES {
            return Err(Error::data(
                file,
                "phases",
                format!("{n_phases} is not in the accepted range, 1 to {MAX_PHASES}"),
            ));
        }
        if vessel_attenuation.is_some_and(|a| !(a.is_finite() && a > 0.0)) {
            return Err(Error::data(file, "vessel_attenuation_per_mm", "is not a positive number"));
        }
        Ok(Builder {
            file: file.to_path_buf(),
            n_phases,
            depth_range,
            vessel_attenuation,
            still: false,
            vessels_alone: false,
            views: Vec::new(),
            frames: Vec::new(),
            notes: Vec::new(),
        })
    }

    /// States that the object is at rest.
    ///
    /// # Errors
    /// [`Error::Data`] for more phases than an object at rest has.
    pub(super) fn at_rest(&mut self) -> Result<()> {
        if self.n_phases > at_rest::PHASES {
            let problem = format!(
                "is {}, but an object at rest has phase 0 and, where they are known, images without vessels as phase 1",
                self.n_phases
            );
            return Err(Error::data(&self.file, "phases", problem));
        }
        (self.still, self.n_phases) = (true, at_rest::PHASES);
        Ok(())
    }

    pub(super) fn add<F: Fn(f32) -> f32>(&mut self, new: NewFrame<'_, F>) -> Result<()> {
        let field = |name: &str| format!("frames[{}].{name}", new.index);
        if self.frames.len() >= MAX_FRAMES {
            return Err(Error::data(&self.file, "frames", format!("has more than {MAX_FRAMES} frames")));
        }
        if !new.heart_shift_mm.iter().all(|s| s.is_finite() && s.abs() < 1e3) {
            return Err(Error::data(&self.file, field("heart_shift_mm"), "is not a displacement in mm"));
        }
        let told = |file: &Path, Complaint { field: name, value, problem }: Complaint| {
            Error::data(file, field(&name), format!("{value} {problem}").trim_start())
        };
        check_phase(new.time_phases, self.n_phases).map_err(|c| told(&self.file, c))?;
        let taken = BeatTime::of(new.time_phases, self.n_phases);
        if self.still && taken.after_phase != 0.0 {
            return Err(Error::data(
                &self.file,
                field("phase"),
                "lies between two phases, which an object at rest does not",
            ));
        }
        let size = [new.image.width, new.image.height];
        check_values(&new.image.values, size[0]).map_err(|c| told(new.source, c))?;
        let of_geometry = |c: Complaint| Complaint { field: format!("geometry.{}", c.field), ..c };
        let view = find_or_add(&mut self.views, new.geometry, size, -self.depth_range.0)
            .map_err(|c| told(&self.file, of_geometry(c)))?;
        self.frames.push(Frame {
            name: new
                .source
                .file_stem()
                .map_or_else(|| format!("frame-{}", new.index), |s| s.to_string_lossy().into_owned()),
            view,
            phase: taken.phase,
            after_phase: taken.after_phase,
            split: new.split,
            integrals: new.image.values.iter().map(|v| (new.to_integral)(*v)).collect(),
            mask: new.mask,
            heart_shift_mm: new.heart_shift_mm,
            contrast: 1.0,
        });
        Ok(())
    }

    pub(super) fn finish(mut self, path: &Path, layout: Layout) -> Result<Dataset> {
        if self.still {
            self.notes.extend(at_rest::add_appearance_without_vessels(&self.views, &mut self.frames));
        }
        let canvas = onto_canvas(&self.views, &mut self.frames);
        let canvas = canvas.map_err(|c| Error::data(&self.file, "frames", format!("{}: {}", c.value, c.problem)))?;
        let Some([width, height]) = canvas else {
            return Err(Error::data(&self.file, "frames", "is empty"));
        };
        if !self.frames.iter().any(|f| f.split == Split::Train) {
            return Err(Error::data(&self.file, "frames", "has no training frame"));
        }
        self.frames.sort_by_key(|f| f.split);
        self.notes.extend(untrained_phases(&self.frames, self.n_phases));
        let mut dataset = Dataset {
            path: path.to_path_buf(),
            layout,
            views: self.views,
            frames: self.frames,
            hidden: BTreeMap::new(),
            width,
            height,
            n_phases: self.n_phases,
            depth_range: self.depth_range,
            vessel_attenuation: self.vessel_attenuation,
            still: self.still,
            vessels_alone: self.vessels_alone,
            views_adjusted: false,
            prior: None,
            notes: self.notes,
        };
        dataset.hide();
        Ok(dataset)
    }
}

/// Note on the phases that no training frame shows.
fn untrained_phases(frames: &[Frame], n_phases: u32) -> Option<String> {
    let mut seen = vec![false; n_phases as usize];
    frames.iter().filter(|f| f.split == Split::Train).for_each(|f| seen[f.phase as usize] = true);
    let unseen: Vec<u32> = (0..n_phases).filter(|p| !seen[*p as usize]).collect();
    (!unseen.is_empty()).then(|| {
        format!(
            "no training frame shows phase {}, so the dynamic field is not determined by images there",
            list_of(&unseen)
        )
    })
}

/// Formats numbers as a list in which consecutive numbers are written as first-last.
pub(super) fn list_of(numbers: &[u32]) -> String {
    let runs = numbers.chunk_by(|a, b| a + 1 == *b).map(|run| match run {
        [first, .., last] => format!("{first}-{last}"),
        [one] => one.to_string(),
        [] => String::new(),
    });
    runs.collect::<Vec<_>>().join(", ")
}
