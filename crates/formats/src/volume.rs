//! Voxel volumes, and headers of their files. Values are attenuation per mm or Hounsfield units; positions are patient mm (LPS)
//! with the isocentre at the origin.

use crate::error::{Error, Result};
use glam::{DAffine3, DMat3, DVec3};
use rayon::prelude::*;
use std::path::Path;

/// Largest accepted volume, voxels (2 GiB of floats).
const MAX_VOXELS: u64 = 1 << 29;
/// Largest accepted file, bytes: the largest volume with 8-byte numbers.
pub(super) const MAX_BYTES: u64 = 8 * MAX_VOXELS;

/// A scalar volume.
#[derive(Debug, Clone)]
pub struct Volume {
    /// Voxels along the three index axes; the first axis varies fastest in memory.
    pub size: [usize; 3],
    /// Values.
    pub values: Vec<f32>,
    /// Transform from voxel index (centres at integers) to LPS mm.
    pub index_to_lps: DAffine3,
}

/// Properties of a volume that its file may not state.
#[derive(Debug, Clone, Default)]
pub struct VolumeHints {
    /// Voxel spacing, mm, for `.npy` and raw files.
    pub spacing_mm: Option<[f64; 3]>,
    /// Size, for raw files.
    pub size: Option<[usize; 3]>,
    /// Element type of raw files: `f32`, `f64`, `i16`, `u16` or `u8`, little endian.
    pub raw_type: Option<String>,
    /// Whether the volume's centre is put at the isocentre, overriding the position in its header.
    pub centre: bool,
}

impl Volume {
    /// Makes a volume whose axes follow L, P and S, centred on `centre_mm`.
    pub fn centred(size: [usize; 3], spacing_mm: f64, centre_mm: DVec3, values: Vec<f32>) -> Volume {
        let half = DVec3::new(size[0] as f64 - 1.0, size[1] as f64 - 1.0, size[2] as f64 - 1.0) * 0.5;
        let index_to_lps = DAffine3::from_mat3_translation(
            DMat3::from_diagonal(DVec3::splat(spacing_mm)),
            centre_mm - half * spacing_mm,
        );
        Volume { size, values, index_to_lps }
    }

    /// Smallest voxel spacing, mm.
    pub fn spacing_mm(&self) -> f64 {
        let m = self.index_to_lps.matrix3;
        m.x_axis.length().min(m.y_axis.length()).min(m.z_axis.length())
    }

    /// Value at a voxel index, by trilinear interpolation between voxel centres; outside the volume, the value of the nearest
    /// border point.
    pub fn interpolated(&self, index: DVec3) -> f32 {
        let [nx, ny, _] = self.size;
        let last = DVec3::from_array(self.size.map(|n| n as f64 - 1.0));
        let index = index.clamp(DVec3::ZERO, last);
        let (low, share) = (index.floor().as_usizevec3(), index.fract().as_vec3());
        let at = |x: usize, y: usize, z: usize| {
            let [x, y, z] =
                [(low.x + x, 0), (low.y + y, 1), (low.z + z, 2)].map(|(i, axis)| i.min(self.size[axis] - 1));
            self.values[(z * ny + y) * nx + x]
        };
        let mix = |a: f32, b: f32, t: f32| a + (b - a) * t;
        let row = |y, z| mix(at(0, y, z), at(1, y, z), share.x);
        let plane = |z| mix(row(0, z), row(1, z), share.y);
        mix(plane(0), plane(1), share.z)
    }

    /// Returns the volume moved by `carry` (patient mm to patient mm, rigid), resampled on a grid with the same spacings along
    /// the patient's axes. Values are interpolated linearly; points outside the original volume are 0.
    pub fn carried(&self, carry: &DAffine3) -> Volume {
        let spacing_mm =
            DVec3::from_array(self.index_to_lps.matrix3.to_cols_array_2d().map(|axis| DVec3::from(axis).length()));
        let last = DVec3::from_array(self.size.map(|n| n as f64 - 1.0));
        let place = *carry * self.index_to_lps;
        let corner = |k: usize| DVec3::from_array([0, 1, 2].map(|axis| (k >> axis & 1) as f64)) * last;
        let corners = [0, 1, 2, 3, 4, 5, 6, 7].map(|k| place.transform_point3(corner(k)));
        let low_mm = corners.into_iter().fold(DVec3::INFINITY, DVec3::min);
        let high_mm = corners.into_iter().fold(DVec3::NEG_INFINITY, DVec3::max);
        let size = ((high_mm - low_mm) / spacing_mm).ceil().as_usizevec3().to_array().map(|n| n + 1);
        let index_to_lps = DAffine3::from_mat3_translation(DMat3::from_diagonal(spacing_mm), low_mm);
        let to_index = place.inverse() * index_to_lps;
        let mut values = vec![0f32; size.iter().product()];
        values.par_chunks_mut(size[0]).enumerate().for_each(|(row, values)| {
            let (y, z) = ((row % size[1]) as f64, (row / size[1]) as f64);
            for (x, value) in values.iter_mut().enumerate() {
                let index = to_index.transform_point3(DVec3::new(x as f64, y, z));
                if index.cmpge(DVec3::splat(-0.5)).all() && index.cmple(last + 0.5).all() {
                    *value = self.interpolated(index);
                }
            }
        });
        Volume { size, values, index_to_lps }
    }

    /// Largest distance of a corner from the isocentre, projected onto the axial plane, mm.
    pub fn axial_radius_mm(&self) -> f64 {
        let mut radius = 0f64;
        for corner in 0..8 {
            let at = |axis: usize| {
                if corner >> axis & 1 == 1 { self.size[axis] as f64 } else { -1.0 }
            };
            let p = self.index_to_lps.transform_point3(DVec3::new(at(0), at(1), at(2)));
            radius = radius.max(p.truncate().length());
        }
        radius
    }

    /// Checks that there are three axes and an accepted number of voxels.
    pub(super) fn check_size(path: &Path, field: &str, size: &[u64]) -> Result<[usize; 3]> {
        let bad = || {
            Error::data(
                path,
                field,
                format!(
                    "{size:?} is not supported: three axes of at least one voxel, with at most {MAX_VOXELS} voxels in \
                     total, are accepted"
                ),
            )
        };
        let [x, y, z] = size[..] else {
            return Err(bad());
        };
        let voxels = x.checked_mul(y).and_then(|n| n.checked_mul(z)).ok_or_else(bad)?;
        if voxels == 0 || voxels > MAX_VOXELS {
            return Err(bad());
        }
        Ok([x as usize, y as usize, z as usize])
    }

    /// Transform of a grid along the patient's axes, centred at the isocentre.
    pub(super) fn axis_aligned(size: [usize; 3], spacing: [f64; 3]) -> DAffine3 {
        let spacing = DVec3::from_array(spacing);
        let half = DVec3::new(size[0] as f64, size[1] as f64, size[2] as f64) * 0.5 - 0.5;
        DAffine3::from_mat3_translation(DMat3::from_diagonal(spacing), -(spacing * half))
    }
}

impl VolumeHints {
    /// Stated spacing, for a file format without spacing.
    pub(super) fn spacing(&self, path: &Path) -> Result<[f64; 3]> {
        match self.spacing_mm {
            Some(s) if s.iter().all(|v| v.is_finite() && *v > 0.0) => Ok(s),
            Some(s) => Err(Error::data(path, "spacing", format!("{s:?} is not positive"))),
            None => Err(Error::data(path, "spacing", "this format does not store it; it must be given, in mm")),
        }
    }
}

/// Header of a volume file whose values are then written in pieces: floats on a grid along the patient's axes (LPS).
#[derive(Debug, Clone)]
pub struct VolumeHeader {
    /// Position of the first point, mm.
    pub origin_mm: DVec3,
    /// Distance between neighbours along each axis, mm.
    pub spacing_mm: DVec3,
    /// Number of points along left, posterior and superior.
    pub size: [u32; 3],
    /// Phases of a sequence; none for a single volume.
    pub phases: Option<Vec<u32>>,
    /// Meaning of the values.
    pub quantity: String,
}

/// Parses the numbers of a header field, with or without brackets and commas.
pub(super) fn numbers(path: &Path, field: &str, text: &str) -> Result<Vec<f64>> {
    text.split(|c: char| c.is_whitespace() || "(),".contains(c))
        .filter(|w| !w.is_empty())
        .map(|w| w.parse::<f64>().map_err(|_| Error::data(path, field, format!("`{w}` is not a number"))))
        .collect()
}

/// Returns the length of a unit that a header names, mm.
pub(super) fn length_mm(path: &Path, field: &str, unit: &str) -> Result<f64> {
    match unit {
        "m" | "meter" | "metre" => Ok(1e3),
        "cm" => Ok(10.0),
        "mm" | "millimeter" | "millimetre" => Ok(1.0),
        "um" | "\u{b5}m" | "\u{3bc}m" | "micron" | "micrometer" => Ok(1e-3),
        _ => {
            let problem = format!("`{unit}` is no unit of length that is known: m, cm, mm and um are");
            Err(Error::data(path, field, problem))
        }
    }
}

/// Transform from voxel index to LPS mm, from the columns and the origin in a header whose axes differ from LPS only by signs.
pub(super) fn affine(path: &Path, field: &str, columns: &[f64], origin: &[f64], flip: DVec3) -> Result<DAffine3> {
    let (Ok(c), Ok(o)) = (<[f64; 9]>::try_from(columns), <[f64; 3]>::try_from(origin)) else {
        return Err(Error::data(path, field, "needs three directions and an origin of three numbers"));
    };
    let flip = DMat3::from_diagonal(flip);
    Ok(DAffine3::from_mat3_translation(flip * DMat3::from_cols_array(&c), flip * DVec3::from_array(o)))
}
