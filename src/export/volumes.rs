//! Volumes of a reconstruction for the tools people use: NRRD (3D Slicer plays phases as a sequence), NIfTI, MetaImage,
//! npy and VTK. Patient coordinates, mm; attenuation per mm; sampled and written slab by slab.

use crate::choice::Choice;
use crate::error::{Error, Result};
use crate::files;
use crate::geometry::MM_PER_UNIT;
use crate::model::component::Component;
use crate::model::scene::Scene;
use crate::render::grid::PatientGrid;
use crate::render::renderer::Renderer;
use glam::DVec3;
use std::io::Write;
use std::path::{Path, PathBuf};

/// File format of a volume.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Format {
    /// NRRD; phases as a list axis, which 3D Slicer loads as a sequence (`.seq.nrrd`).
    Nrrd,
    /// NIfTI-1; phases as the fourth axis.
    Nifti,
    /// MetaImage; phases as the fourth axis.
    Mha,
    /// numpy; (phases,) superior, posterior, left. Without geometry.
    Npy,
    /// Legacy VTK structured points; a file per phase, which ParaView groups.
    Vtk,
}

impl Choice for Format {
    const ALL: &'static [Format] = &[Format::Nrrd, Format::Nifti, Format::Mha, Format::Npy, Format::Vtk];

    fn name(self) -> &'static str {
        match self {
            Format::Nrrd => "nrrd",
            Format::Nifti => "nifti",
            Format::Mha => "mha",
            Format::Npy => "npy",
            Format::Vtk => "vtk",
        }
    }
}

impl Format {
    /// Format by the end of a file name.
    pub fn of(path: &Path) -> Option<Format> {
        let name = path.file_name()?.to_str()?.to_lowercase();
        Some(match name.rsplit('.').next()? {
            "nrrd" => Format::Nrrd,
            "nii" => Format::Nifti,
            "mha" => Format::Mha,
            "npy" => Format::Npy,
            "vtk" => Format::Vtk,
            _ => return None,
        })
    }
}

/// What to export.
#[derive(Debug, Clone)]
pub struct VolumeExport {
    /// The grid.
    pub grid: PatientGrid,
    /// Fields to export.
    pub component: Component,
    /// Phases to export, from 0.
    pub phases: Vec<u32>,
    /// Write a fourth axis, even for one phase.
    pub sequence: bool,
    /// Format.
    pub format: Format,
}

/// Cells of a slab.
const SLAB_CELLS: usize = 1 << 22;

/// The patient grid over the box of a scene's fields: points `spacing_mm` apart, one at each cell's middle.
///
/// # Errors
/// [`Error::Config`] for a spacing that gives no or too many points.
pub fn grid_over(scene: &Scene, component: Component, spacing_mm: f64) -> Result<PatientGrid> {
    if !(spacing_mm.is_finite() && spacing_mm > 0.0) {
        return Err(Error::config("spacing_mm", spacing_mm, "is not a positive length in mm"));
    }
    let (low, high) = match component {
        Component::Dynamic => (scene.dynamic_min, scene.dynamic_max),
        Component::Total | Component::Static => (scene.static_min, scene.static_max),
    };
    // World axes are (posterior, left, superior).
    let lps = |v: [f64; 3]| DVec3::new(v[1], v[0], v[2]) * MM_PER_UNIT;
    let (low, high) = (lps(low), lps(high));
    let size = ((high - low) / spacing_mm).ceil().max(DVec3::ONE);
    if size.max_element() > 4096.0 {
        let smallest = (high - low).max_element() / 4096.0;
        return Err(Error::config(
            "spacing_mm",
            spacing_mm,
            format!("gives too many points: at least {smallest:.3} mm"),
        ));
    }
    let origin_mm = 0.5 * (low + high) - 0.5 * (size - 1.0) * spacing_mm;
    let size = size.as_uvec3().to_array();
    Ok(PatientGrid { origin_mm, spacing_mm: DVec3::splat(spacing_mm), size })
}

impl VolumeExport {
    /// Slices of each slab.
    fn slabs(&self) -> impl Iterator<Item = std::ops::Range<u32>> + use<> {
        let [nx, ny, nz] = self.grid.size;
        let thick = (SLAB_CELLS / (nx as usize * ny as usize)).clamp(1, nz as usize) as u32;
        (0..nz.div_ceil(thick)).map(move |i| i * thick..((i + 1) * thick).min(nz))
    }

    /// Samples and writes; returns the files made. `progress` hears of cells done and cells in all.
    ///
    /// # Errors
    /// [`Error::Config`] for a phase the model does not have; [`Error::Io`]; device errors.
    pub fn write(&self, renderer: &Renderer, path: &Path, mut progress: impl FnMut(u64, u64)) -> Result<Vec<PathBuf>> {
        self.grid.check()?;
        self.phases.iter().try_for_each(|phase| renderer.check_phase(*phase))?;
        let all = self.grid.size.iter().map(|n| u64::from(*n)).product::<u64>() * self.phases.len() as u64;
        let mut done = 0;
        let mut sample = |phase: u32, slices: std::ops::Range<u32>| -> Result<Vec<f32>> {
            let cells = renderer.sample_patient(self.component, phase, &self.grid.slices(slices))?;
            done += cells.len() as u64;
            progress(done, all);
            Ok(cells)
        };
        if self.format == Format::Vtk {
            return self.write_vtk(path, &mut sample);
        }
        // Errors of the device travel past the writer, which knows those of files only.
        let mut failed = None;
        let written = files::write_atomic_with(path, |file| {
            file.write_all(&self.header())?;
            let mut put = |cells: Result<Vec<f32>>| match cells {
                Ok(cells) => write_floats(file, &cells, f32::to_le_bytes),
                Err(error) => {
                    failed = Some(error);
                    Err(std::io::Error::other("sampling failed"))
                }
            };
            if self.format == Format::Nrrd && self.sequence {
                // The list axis comes first: all phases of a voxel follow each other.
                for slices in self.slabs() {
                    let phases: Result<Vec<_>> = self.phases.iter().map(|p| sample(*p, slices.clone())).collect();
                    put(phases.map(|phases| {
                        (0..phases[0].len()).flat_map(|i| phases.iter().map(move |cells| cells[i])).collect()
                    }))?;
                }
                return Ok(());
            }
            for phase in &self.phases {
                for slices in self.slabs() {
                    put(sample(*phase, slices))?;
                }
            }
            Ok(())
        });
        match failed {
            Some(error) => Err(error),
            None => written.map(|()| vec![path.to_path_buf()]),
        }
    }

    fn header(&self) -> Vec<u8> {
        let PatientGrid { origin_mm: o, spacing_mm: s, size: [nx, ny, nz] } = self.grid;
        let nt = self.phases.len();
        match self.format {
            Format::Nrrd => {
                let (dimension, sizes, none, list, names) = if self.sequence {
                    let names = "axis 0 index type:=numeric\naxis 0 index values:=";
                    let phases: Vec<_> = self.phases.iter().map(u32::to_string).collect();
                    (4, format!("{nt} "), "none ", "list ", format!("{names}{}\n", phases.join(" ")))
                } else {
                    (3, String::new(), "", "", String::new())
                };
                format!(
                    "NRRD0004\ntype: float\ndimension: {dimension}\nspace: left-posterior-superior\n\
                     sizes: {sizes}{nx} {ny} {nz}\nspace directions: {none}({},0,0) (0,{},0) (0,0,{})\n\
                     kinds: {list}domain domain domain\nendian: little\nencoding: raw\nspace origin: ({},{},{})\n\
                     space units: \"mm\" \"mm\" \"mm\"\nquantity:=attenuation per mm\n{names}\n",
                    s.x, s.y, s.z, o.x, o.y, o.z
                )
                .into_bytes()
            }
            Format::Mha => {
                let (dimensions, axis, point, step, turn) = if self.sequence {
                    (4, format!(" {nt}"), " 0", " 1", "1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1")
                } else {
                    (3, String::new(), "", "", "1 0 0 0 1 0 0 0 1")
                };
                // MetaImage speaks LPS.
                format!(
                    "ObjectType = Image\nNDims = {dimensions}\nBinaryData = True\nBinaryDataByteOrderMSB = False\n\
                     CompressedData = False\nTransformMatrix = {turn}\nOffset = {} {} {}{point}\n\
                     ElementSpacing = {} {} {}{step}\nDimSize = {nx} {ny} {nz}{axis}\nElementType = MET_FLOAT\n\
                     ElementDataFile = LOCAL\n",
                    o.x, o.y, o.z, s.x, s.y, s.z
                )
                .into_bytes()
            }
            Format::Npy => {
                let time = if self.sequence { format!("{nt}, ") } else { String::new() };
                let text = format!("{{'descr': '<f4', 'fortran_order': False, 'shape': ({time}{nz}, {ny}, {nx}), }}");
                // Magic, version and header together are a multiple of 64 bytes long, the last a line's end.
                let padded = (10 + text.len() + 1).next_multiple_of(64) - 10;
                let mut header = b"\x93NUMPY\x01\x00".to_vec();
                header.extend((padded as u16).to_le_bytes());
                header.extend(format!("{text:<width$}\n", width = padded - 1).bytes());
                header
            }
            Format::Nifti => self.nifti_header(),
            Format::Vtk => Vec::new(),
        }
    }

    fn nifti_header(&self) -> Vec<u8> {
        let PatientGrid { origin_mm: o, spacing_mm: s, size } = self.grid;
        let nt = self.phases.len();
        let mut h = vec![0u8; 352];
        let mut i16s = |at: usize, values: &[i16]| {
            values.iter().enumerate().for_each(|(i, v)| h[at + 2 * i..][..2].copy_from_slice(&v.to_le_bytes()));
        };
        let time = if self.sequence { (4, nt as i16) } else { (3, 1) };
        i16s(40, &[time.0, size[0] as i16, size[1] as i16, size[2] as i16, time.1, 1, 1, 1]);
        i16s(70, &[16, 32]); // float, of 32 bits
        i16s(252, &[1, 1]); // both transforms in scanner coordinates
        let mut f32s = |at: usize, values: &[f64]| {
            values
                .iter()
                .enumerate()
                .for_each(|(i, v)| h[at + 4 * i..][..4].copy_from_slice(&(*v as f32).to_le_bytes()));
        };
        f32s(76, &[1.0, s.x, s.y, s.z, 1.0]);
        f32s(108, &[352.0, 1.0, 0.0]);
        // NIfTI speaks RAS: left and posterior change sign. As a quaternion, half a turn about superior.
        f32s(256, &[0.0, 0.0, 1.0, -o.x, -o.y, o.z]);
        f32s(280, &[-s.x, 0.0, 0.0, -o.x, 0.0, -s.y, 0.0, -o.y, 0.0, 0.0, s.z, o.z]);
        h[..4].copy_from_slice(&348i32.to_le_bytes());
        h[123] = 2 | 8; // mm, seconds
        let about = b"attenuation per mm";
        h[148..][..about.len()].copy_from_slice(about);
        h[344..348].copy_from_slice(b"n+1\0");
        h
    }

    /// One file per phase: `name.vtk`, or `name_0000.vtk` and so on.
    fn write_vtk(
        &self,
        path: &Path,
        sample: &mut dyn FnMut(u32, std::ops::Range<u32>) -> Result<Vec<f32>>,
    ) -> Result<Vec<PathBuf>> {
        let PatientGrid { origin_mm: o, spacing_mm: s, size: [nx, ny, nz] } = self.grid;
        let stem = path.file_stem().unwrap_or_default().to_string_lossy().into_owned();
        let mut made = Vec::new();
        for phase in &self.phases {
            let file =
                if self.sequence { path.with_file_name(format!("{stem}_{phase:04}.vtk")) } else { path.to_path_buf() };
            let mut failed = None;
            let written = files::write_atomic_with(&file, |out| {
                write!(
                    out,
                    "# vtk DataFile Version 3.0\nattenuation per mm, LPS mm, phase {phase}\nBINARY\n\
                     DATASET STRUCTURED_POINTS\nDIMENSIONS {nx} {ny} {nz}\nORIGIN {} {} {}\nSPACING {} {} {}\n\
                     POINT_DATA {}\nSCALARS attenuation float 1\nLOOKUP_TABLE default\n",
                    o.x,
                    o.y,
                    o.z,
                    s.x,
                    s.y,
                    s.z,
                    nx as usize * ny as usize * nz as usize
                )?;
                for slices in self.slabs() {
                    match sample(*phase, slices) {
                        Ok(cells) => write_floats(out, &cells, f32::to_be_bytes)?,
                        Err(error) => {
                            failed = Some(error);
                            return Err(std::io::Error::other("sampling failed"));
                        }
                    }
                }
                Ok(())
            });
            if let Some(error) = failed {
                return Err(error);
            }
            written?;
            made.push(file);
        }
        Ok(made)
    }
}

fn write_floats(out: &mut impl Write, cells: &[f32], bytes: fn(f32) -> [u8; 4]) -> std::io::Result<()> {
    for block in cells.chunks(1 << 16) {
        let block: Vec<u8> = block.iter().flat_map(|v| bytes(*v)).collect();
        out.write_all(&block)?;
    }
    Ok(())
}
