//! Exports the motion of a reconstruction for common tools: displacements of the grid that moves the Gaussians as NRRD or VTK,
//! and the trajectory of each Gaussian as lines. Patient coordinates, mm.
//!
//! Projections do not show motion along a vessel; that part of the exported motion comes from the smoothness of the grid alone.
//! So no strain is exported, and none should be derived.

use crate::error::{Error, Result};
use crate::files;
use crate::formats::nrrd::{self, Encoding};
use crate::formats::raw::{self, ByteOrder};
use crate::formats::volume::VolumeHeader;
use crate::formats::vtk::{self, Lines, PointValues};
use crate::gaussians::field::{GaussianField, MovingGaussians, scales};
use crate::geometry::MM_PER_UNIT;
use crate::kernels::layout::Gaussian;
use crate::model::Model;
use flate2::write::GzEncoder;
use glam::DVec3;
use std::io::Write;
use std::path::{Path, PathBuf};

/// Limitation that is stated in every file.
const CAVEAT: &str = "motion along a vessel is not observed in projections";

/// File format of displacements.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum MotionFormat {
    /// NRRD, with a vector axis first and a list axis of phases last.
    Nrrd,
    /// Legacy VTK structured points with a vector array; one file per phase, which ParaView groups.
    Vtk,
}

impl MotionFormat {
    /// Returns the format for the end of a file name.
    pub fn of(path: &Path) -> Option<MotionFormat> {
        match path.extension()?.to_str()?.to_lowercase().as_str() {
            "nrrd" => Some(MotionFormat::Nrrd),
            "vtk" => Some(MotionFormat::Vtk),
            _ => None,
        }
    }
}

/// Returns the set of Gaussians that moves over the beat, of a model that has one.
///
/// # Errors
/// [`Error::Config`] where the dynamic field is one set of Gaussians per phase or a network, because neither follows a point
/// over time.
pub fn moving_set(model: &Model) -> Result<&MovingGaussians> {
    model.gaussians.as_ref().and_then(GaussianField::moving).ok_or_else(|| {
        let made_of = if model.gaussians.is_some() { "a set of Gaussians per phase" } else { "a network" };
        Error::config(
            "dynamic field",
            made_of,
            "it does not track points from phase to phase: train one deformable set of Gaussians (preset fast with \
             gaussians.form = \"deformable\")",
        )
    })
}

/// Converts a length or position along (posterior, left, superior) in the Gaussians' pixels to LPS mm.
fn lps_mm(moving: &MovingGaussians, x: DVec3) -> DVec3 {
    DVec3::new(x.y, x.x, x.z) * moving.rest.units.pixel * MM_PER_UNIT
}

/// Export of the displacements on a deformable set's grid.
pub struct MotionExport<'a> {
    /// The deformable set of Gaussians.
    pub moving: &'a MovingGaussians,
    /// Phases to export, from 0.
    pub phases: Vec<u32>,
    /// Whether a phase axis, or a number in each file name, is also written for a single phase.
    pub sequence: bool,
    /// File format.
    pub format: MotionFormat,
    /// Encoding of the data in NRRD.
    pub encoding: Encoding,
}

impl MotionExport<'_> {
    /// Writes the displacement of every node of the grid from the rest phase to each phase, mm along (left, posterior,
    /// superior), with left varying fastest. The Gaussians' individual motion is not included. Returns the files that were
    /// written.
    ///
    /// # Errors
    /// [`Error::Config`] for a phase the model does not have, and for gzip in VTK; [`Error::Io`].
    pub fn write(&self, path: &Path) -> Result<Vec<PathBuf>> {
        let n_phases = self.moving.rest.n_phases;
        if let Some(bad) = self.phases.iter().find(|phase| **phase as usize >= n_phases) {
            return Err(Error::config("phase", bad, format!("is out of range: phases go from 0 to {}", n_phases - 1)));
        }
        match (self.format, self.encoding) {
            (MotionFormat::Nrrd, _) => self.write_nrrd(path).map(|()| vec![path.to_path_buf()]),
            (MotionFormat::Vtk, Encoding::Raw) => self.write_vtk(path),
            (MotionFormat::Vtk, Encoding::Gzip) => {
                Err(Error::config("compression", path.display(), "only NRRD files of motion can be compressed"))
            }
        }
    }

    /// Header of a file with vectors on the grid.
    fn header(&self) -> VolumeHeader {
        let setup = &self.moving.setup;
        let (first, step) = (-f64::from(setup.half_side), 1.0 / f64::from(setup.inverse_step));
        VolumeHeader {
            origin_mm: lps_mm(self.moving, DVec3::splat(first)),
            spacing_mm: lps_mm(self.moving, DVec3::splat(step)),
            size: [setup.n_nodes; 3],
            phases: self.sequence.then(|| self.phases.clone()),
            quantity: format!("displacement from phase {}, mm", setup.rest_phase),
        }
    }

    /// Displacements at a phase in the order of the files.
    fn vectors(&self, phase: u32) -> Vec<f32> {
        let n = self.moving.setup.n_nodes as usize;
        let nodes = &self.moving.grid[phase as usize * n.pow(3)..][..n.pow(3)];
        // The grid's axes are (posterior, left, superior); the first varies fastest.
        let node = |i: usize| nodes[(i / (n * n) * n + i % n) * n + i / n % n];
        let vector = |[x, y, z, _]: [f32; 4]| lps_mm(self.moving, DVec3::new(x.into(), y.into(), z.into()));
        (0..n.pow(3)).flat_map(|i| vector(node(i)).as_vec3().to_array()).collect()
    }

    fn write_nrrd(&self, path: &Path) -> Result<()> {
        Ok(files::write_atomic_with(path, |file| {
            file.write_all(&nrrd::vector_header_of(&self.header(), self.encoding, &[CAVEAT]))?;
            match self.encoding {
                Encoding::Raw => self.write_phases(file),
                Encoding::Gzip => {
                    let mut gzip = GzEncoder::new(file, flate2::Compression::default());
                    self.write_phases(&mut gzip)?;
                    gzip.finish().map(drop)
                }
            }
        })?)
    }

    fn write_phases(&self, out: &mut dyn Write) -> std::io::Result<()> {
        self.phases.iter().try_for_each(|p| raw::write_floats(&mut *out, &self.vectors(*p), ByteOrder::Little))
    }

    /// Writes one file per phase: `name.vtk`, or `name_0000.vtk` and so on.
    fn write_vtk(&self, path: &Path) -> Result<Vec<PathBuf>> {
        let one = |phase: &u32| {
            let file = if self.sequence { files::of_phase(path, *phase) } else { path.to_path_buf() };
            let title = format!("{}, LPS, phase {phase}; {CAVEAT}", self.header().quantity);
            files::write_atomic_with(&file, |out| {
                out.write_all(&vtk::vector_header_of(&self.header(), "displacement_mm", &title))?;
                raw::write_floats(out, &self.vectors(*phase), ByteOrder::Big)
            })?;
            Ok(file)
        };
        self.phases.iter().map(one).collect()
    }
}

/// Writes the trajectory of each Gaussian over the beat, including its individual motion, as a closed line in a legacy VTK
/// file. A line has a point per phase, with its `phase`, the Gaussian's standard deviations in ascending order (`scale_mm`),
/// and its attenuation at the centre (`attenuation_per_mm`).
///
/// # Errors
/// [`Error::Io`].
pub fn write_trajectories(moving: &MovingGaussians, path: &Path) -> Result<()> {
    let n_phases = moving.rest.n_phases;
    let units = moving.rest.units;
    let mut lines = Lines {
        title: format!("trajectories of Gaussians over a closed beat, LPS mm; {CAVEAT}"),
        points_per_line: n_phases,
        points: Vec::new(),
        values: Vec::new(),
    };
    let (mut phases, mut scale_mm, mut attenuation) = (Vec::new(), Vec::new(), Vec::new());
    let deviations_mm = |g: &Gaussian| {
        let mut sorted = (scales(g, &moving.rest.setup) * units.pixel * MM_PER_UNIT).to_array();
        sorted.sort_by(f64::total_cmp);
        sorted.map(|v| v as f32)
    };
    for (index, g) in moving.rest.rows.iter().enumerate() {
        let scale = deviations_mm(g);
        let per_mm = f64::from(g.log_density).exp() * units.attenuation() / MM_PER_UNIT;
        for phase in 0..n_phases {
            lines.points.push(lps_mm(moving, moving.position(index, phase as f64)).as_vec3().to_array());
            phases.push(phase as f32);
            scale_mm.extend(scale);
            attenuation.push(per_mm as f32);
        }
    }
    lines.values = vec![
        PointValues { name: "phase", width: 1, values: phases },
        PointValues { name: "scale_mm", width: 3, values: scale_mm },
        PointValues { name: "attenuation_per_mm", width: 1, values: attenuation },
    ];
    Ok(files::write_atomic_with(path, |out| lines.write(out))?)
}
