//! Exports volumes of a reconstruction for common tools: NRRD (3D Slicer plays phases as a sequence), NIfTI, MetaImage, npy and
//! VTK. Patient coordinates, mm; attenuation per mm; sampled and written slab by slab.

use crate::error::{Error, Result};
use crate::files;
use crate::formats::nrrd::Encoding;
use crate::formats::raw::{self, ByteOrder};
use crate::formats::volume::VolumeHeader;
use crate::formats::{metaimage, nifti, npy, nrrd, vtk};
use crate::geometry::MM_PER_UNIT;
use crate::model::component::Component;
use crate::model::scene::Scene;
use crate::render::grid::PatientGrid;
use crate::render::renderer::Renderer;
use flate2::write::GzEncoder;
use glam::DVec3;
use std::io::Write;
use std::ops::Range;
use std::path::{Path, PathBuf};
use strum::{IntoStaticStr, VariantArray};

/// File format of a volume.
#[derive(Debug, Clone, Copy, PartialEq, Eq, IntoStaticStr, VariantArray)]
#[strum(serialize_all = "kebab-case")]
pub enum Format {
    /// NRRD with phases as a list axis, which 3D Slicer loads as a sequence (`.seq.nrrd`).
    Nrrd,
    /// NIfTI-1 with phases as the fourth axis.
    Nifti,
    /// MetaImage with phases as the fourth axis.
    Mha,
    /// NumPy array with axes (phases,) superior, posterior, left; without geometry.
    Npy,
    /// Legacy VTK structured points; one file per phase, which ParaView groups.
    Vtk,
}

impl Format {
    /// Returns format and compression for the end of a file name.
    pub fn of(path: &Path) -> Option<(Format, Compression)> {
        let name = path.file_name()?.to_string_lossy().to_lowercase();
        if name.ends_with(".nii.gz") {
            return Some((Format::Nifti, Compression::Gzip));
        }
        let format = match name.rsplit('.').next()? {
            "nrrd" => Format::Nrrd,
            "nii" => Format::Nifti,
            "mha" => Format::Mha,
            "npy" => Format::Npy,
            "vtk" => Format::Vtk,
            _ => return None,
        };
        Some((format, Compression::None))
    }

    /// Rejects a compression that the format does not have or that the file name contradicts.
    ///
    /// # Errors
    /// [`Error::Config`].
    fn check(self, compression: Compression, path: &Path) -> Result<()> {
        let name = path.file_name().unwrap_or_default().to_string_lossy().to_lowercase();
        let problem = match (self, compression, name.ends_with(".gz")) {
            (Format::Nifti, Compression::Gzip, false) => "the name of a compressed NIfTI file must end in .nii.gz",
            (Format::Nifti, Compression::None, true) => "a file whose name ends in .nii.gz must be compressed",
            (Format::Nifti | Format::Nrrd, _, false) | (Format::Nifti, Compression::Gzip, true) => return Ok(()),
            (_, _, true) => "only the name of a compressed NIfTI file can end in .gz",
            (_, Compression::None, false) => return Ok(()),
            (_, Compression::Gzip, false) => "only NIfTI and NRRD can be compressed",
        };
        Err(Error::config("compression", path.display(), problem))
    }
}

/// Compression of the values of a volume.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Compression {
    /// No compression.
    None,
    /// One gzip stream: the whole NIfTI file, or the values of an NRRD file.
    Gzip,
}

/// Options of a volume export.
#[derive(Debug, Clone)]
pub struct VolumeExport {
    /// Grid on which the fields are sampled.
    pub grid: PatientGrid,
    /// Fields to export.
    pub component: Component,
    /// Phases to export, from 0.
    pub phases: Vec<u32>,
    /// Whether the phase axis is also written for a single phase.
    pub sequence: bool,
    /// File format.
    pub format: Format,
    /// Compression, for NIfTI and NRRD.
    pub compression: Compression,
}

/// Quantity of the values.
const QUANTITY: &str = "attenuation per mm";
/// Number of cells of a slab.
const SLAB_CELLS: usize = 1 << 22;

/// Returns the patient grid over the region of a scene's fields ([`Scene::region_of`]): points at cell centres, `spacing_mm`
/// apart.
///
/// # Errors
/// [`Error::Config`] for a spacing that is not positive or gives too many points.
pub fn grid_over(scene: &Scene, component: Component, spacing_mm: f64) -> Result<PatientGrid> {
    if !(spacing_mm.is_finite() && spacing_mm > 0.0) {
        return Err(Error::config("spacing_mm", spacing_mm, "is not a positive length in mm"));
    }
    // World axes are (posterior, left, superior).
    let [low, high] = scene.region_of(component).map(|v| DVec3::new(v[1], v[0], v[2]) * MM_PER_UNIT);
    let size = ((high - low) / spacing_mm).ceil().max(DVec3::ONE);
    if size.max_element() > 4096.0 {
        let smallest = (high - low).max_element() / 4096.0;
        return Err(Error::config(
            "spacing_mm",
            spacing_mm,
            format!("gives too many points: at least {smallest:.3} mm are needed"),
        ));
    }
    let origin_mm = 0.5 * (low + high) - 0.5 * (size - 1.0) * spacing_mm;
    let size = size.as_uvec3().to_array();
    Ok(PatientGrid { origin_mm, spacing_mm: DVec3::splat(spacing_mm), size })
}

impl VolumeExport {
    /// Ranges of slices, one for each slab.
    fn slabs(&self) -> impl Iterator<Item = Range<u32>> + use<> {
        let [nx, ny, nz] = self.grid.size;
        let thick = (SLAB_CELLS / (nx as usize * ny as usize)).clamp(1, nz as usize) as u32;
        (0..nz.div_ceil(thick)).map(move |i| i * thick..((i + 1) * thick).min(nz))
    }

    /// Samples the fields and writes them; returns the files that were written. `progress` receives the cells done and the
    /// total.
    ///
    /// # Errors
    /// [`Error::Config`] for a phase the model does not have, and for a compression that does not fit the format or the
    /// name; [`Error::Io`]; device errors.
    pub fn write(&self, renderer: &Renderer, path: &Path, mut progress: impl FnMut(u64, u64)) -> Result<Vec<PathBuf>> {
        self.format.check(self.compression, path)?;
        self.grid.check()?;
        self.phases.iter().try_for_each(|phase| renderer.check_phase(*phase))?;
        let all = self.grid.size.iter().map(|n| u64::from(*n)).product::<u64>() * self.phases.len() as u64;
        let mut done = 0;
        let mut sample = |phase: u32, slices: Range<u32>| -> Result<Vec<f32>> {
            let cells = renderer.sample_patient(self.component, phase, &self.grid.slices(slices))?;
            done += cells.len() as u64;
            progress(done, all);
            Ok(cells)
        };
        if self.format == Format::Vtk {
            return self.write_vtk(path, &mut sample);
        }
        files::write_atomic_by(path, |file| self.write_file(path, file, &mut sample))?;
        Ok(vec![path.to_path_buf()])
    }

    fn header(&self) -> VolumeHeader {
        VolumeHeader {
            origin_mm: self.grid.origin_mm,
            spacing_mm: self.grid.spacing_mm,
            size: self.grid.size,
            phases: self.sequence.then(|| self.phases.clone()),
            quantity: QUANTITY.to_owned(),
        }
    }

    /// Writes a file that holds all phases.
    fn write_file(&self, path: &Path, file: &mut impl Write, sample: Sampler<'_>) -> Result<()> {
        let header = self.header();
        let failed = |e| Error::io("write", path)(e);
        let floats = |out: &mut dyn Write, cells: &[f32]| raw::write_floats(out, cells, ByteOrder::Little);
        match (self.format, self.compression) {
            (Format::Npy, _) => {
                let [nx, ny, nz] = self.grid.size.map(|n| n as usize);
                let shape = if self.sequence { vec![self.phases.len(), nz, ny, nx] } else { vec![nz, ny, nx] };
                let mut npy = npy::begin(file, &shape).map_err(failed)?;
                self.each_slab(sample, |cells| npy.extend(cells.iter().copied()).map_err(failed))?;
                npy.finish().map_err(failed)
            }
            (Format::Nifti, Compression::Gzip) => {
                let mut gzip = GzEncoder::new(file, flate2::Compression::default());
                gzip.write_all(&nifti::header_of(&header)).map_err(failed)?;
                self.each_slab(sample, |cells| floats(&mut gzip, cells).map_err(failed))?;
                gzip.finish().map(drop).map_err(failed)
            }
            (Format::Nrrd, Compression::Gzip) => {
                file.write_all(&nrrd::header_of(&header, Encoding::Gzip)).map_err(failed)?;
                let mut gzip = GzEncoder::new(file, flate2::Compression::default());
                self.each_slab(sample, |cells| floats(&mut gzip, cells).map_err(failed))?;
                gzip.finish().map(drop).map_err(failed)
            }
            (format, Compression::None | Compression::Gzip) => {
                let header = match format {
                    Format::Nrrd => nrrd::header_of(&header, Encoding::Raw),
                    Format::Nifti => nifti::header_of(&header),
                    _ => metaimage::header_of(&header),
                };
                file.write_all(&header).map_err(failed)?;
                self.each_slab(sample, |cells| floats(file, cells).map_err(failed))
            }
        }
    }

    /// Passes all values to `put`, slab by slab, in the order of the file.
    fn each_slab(&self, sample: Sampler<'_>, mut put: impl FnMut(&[f32]) -> Result<()>) -> Result<()> {
        if self.format == Format::Nrrd && self.sequence {
            // The list axis comes first, so all phases of a voxel are adjacent.
            for slices in self.slabs() {
                let phases = self.phases.iter().map(|p| sample(*p, slices.clone())).collect::<Result<Vec<_>>>()?;
                let voxels = 0..phases[0].len();
                put(&voxels.flat_map(|i| phases.iter().map(move |cells| cells[i])).collect::<Vec<_>>())?;
            }
            return Ok(());
        }
        for phase in &self.phases {
            for slices in self.slabs() {
                put(&sample(*phase, slices)?)?;
            }
        }
        Ok(())
    }

    /// Writes one file per phase: `name.vtk`, or `name_0000.vtk` and so on.
    fn write_vtk(&self, path: &Path, sample: Sampler<'_>) -> Result<Vec<PathBuf>> {
        let mut made = Vec::new();
        for phase in &self.phases {
            let file = if self.sequence { files::of_phase(path, *phase) } else { path.to_path_buf() };
            files::write_atomic_by(&file, |out| {
                let failed = |e| Error::io("write", &file)(e);
                out.write_all(&vtk::header_of(&self.header(), *phase)).map_err(failed)?;
                self.slabs().try_for_each(|slices| {
                    raw::write_floats(&mut *out, &sample(*phase, slices)?, ByteOrder::Big).map_err(failed)
                })
            })?;
            made.push(file);
        }
        Ok(made)
    }
}

/// Function that returns the values of some slices at a phase.
type Sampler<'a> = &'a mut dyn FnMut(u32, Range<u32>) -> Result<Vec<f32>>;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_tell_format_and_compression() {
        let of = |name: &str| Format::of(Path::new(name));
        assert_eq!(of("x.nii.gz"), Some((Format::Nifti, Compression::Gzip)));
        assert_eq!(of("x.NII"), Some((Format::Nifti, Compression::None)));
        assert_eq!(of("x.seq.nrrd"), Some((Format::Nrrd, Compression::None)));
        assert_eq!((of("x.gz"), of("x.nrrd.gz"), of("x")), (None, None, None));
        let fits = |format: Format, compression, name: &str| format.check(compression, Path::new(name)).is_ok();
        for (format, name, raw, gzip) in [
            (Format::Nifti, "x.nii", true, false),
            (Format::Nifti, "x.nii.gz", false, true),
            (Format::Nrrd, "x.nrrd", true, true),
            (Format::Nrrd, "x.nrrd.gz", false, false),
            (Format::Mha, "x.mha", true, false),
            (Format::Npy, "x.npy.gz", false, false),
        ] {
            assert_eq!(
                (fits(format, Compression::None, name), fits(format, Compression::Gzip, name)),
                (raw, gzip),
                "{name}"
            );
        }
    }
}
