//! `.nii` and `.nii.gz` volumes (NIfTI-1), in RAS mm; a sequence has a fourth axis. The `nifti` crate reads them. Its writer
//! needs all values at once, so the header is written here and volumes can be streamed.

use crate::error::{Error, Result};
use crate::volume::{Volume, VolumeHeader};
use glam::{DAffine3, DMat3, DVec3};
use std::path::Path;

/// Offsets of the fields of a NIfTI-1 header, bytes from its start.
mod offset {
    pub(super) const SIZEOF_HDR: usize = 0;
    pub(super) const DIM: usize = 40;
    pub(super) const DATATYPE_AND_BITPIX: usize = 70;
    pub(super) const PIXDIM: usize = 76;
    pub(super) const VOX_OFFSET_SLOPE_AND_INTER: usize = 108;
    pub(super) const XYZT_UNITS: usize = 123;
    pub(super) const DESCRIP: usize = 148;
    pub(super) const QFORM_AND_SFORM_CODE: usize = 252;
    pub(super) const QUATERN_AND_QOFFSET: usize = 256;
    pub(super) const SROW: usize = 280;
    pub(super) const MAGIC: usize = 344;
}

/// Length of the header itself, bytes.
const HEADER_BYTES: i32 = 348;
/// Offset of the values, bytes: they follow the header and four bytes that announce no extensions.
const DATA_AT: usize = 352;
/// Longest description, bytes.
const DESCRIP_BYTES: usize = 79;
const DT_FLOAT32: i16 = 16;
const SCANNER_COORDINATES: i16 = 1;
const UNITS_M: u8 = 1;
const UNITS_MM: u8 = 2;
const UNITS_MICROMETRES: u8 = 3;
/// Bits of `xyzt_units` that state the unit of lengths.
const UNITS_OF_LENGTH: u8 = 0b111;
const UNITS_S: u8 = 8;

/// A header under construction.
struct Header([u8; DATA_AT]);

impl Header {
    fn put<const N: usize>(&mut self, at: usize, values: impl IntoIterator<Item = [u8; N]>) {
        for (i, bytes) in values.into_iter().enumerate() {
            self.0[at + N * i..][..N].copy_from_slice(&bytes);
        }
    }

    fn put_i16(&mut self, at: usize, values: &[i16]) {
        self.put(at, values.iter().map(|v| v.to_le_bytes()));
    }

    fn put_f32(&mut self, at: usize, values: &[f64]) {
        self.put(at, values.iter().map(|v| (*v as f32).to_le_bytes()));
    }
}

/// Returns the header of a file of little-endian floats whose values are then written phase by phase.
pub fn header_of(h: &VolumeHeader) -> Vec<u8> {
    let VolumeHeader { origin_mm: o, spacing_mm: s, size, quantity, .. } = h;
    let mut out = Header([0; DATA_AT]);
    out.put(offset::SIZEOF_HDR, [HEADER_BYTES.to_le_bytes()]);
    let [nx, ny, nz] = size.map(|n| n as i16);
    let (axes, nt) = h.phases.as_ref().map_or((3, 1), |phases| (4, phases.len() as i16));
    out.put_i16(offset::DIM, &[axes, nx, ny, nz, nt, 1, 1, 1]);
    out.put_i16(offset::DATATYPE_AND_BITPIX, &[DT_FLOAT32, 32]);
    out.put_f32(offset::PIXDIM, &[1.0, s.x, s.y, s.z, 1.0]);
    out.put_f32(offset::VOX_OFFSET_SLOPE_AND_INTER, &[DATA_AT as f64, 1.0, 0.0]);
    out.put(offset::XYZT_UNITS, [[UNITS_MM | UNITS_S]]);
    out.put(offset::DESCRIP, quantity.bytes().take(DESCRIP_BYTES).map(|b| [b]));
    out.put_i16(offset::QFORM_AND_SFORM_CODE, &[SCANNER_COORDINATES; 2]);
    // NIfTI uses RAS: left and posterior change sign, which is half a turn about the superior axis as a quaternion.
    out.put_f32(offset::QUATERN_AND_QOFFSET, &[0.0, 0.0, 1.0, -o.x, -o.y, o.z]);
    out.put_f32(offset::SROW, &[-s.x, 0.0, 0.0, -o.x, 0.0, -s.y, 0.0, -o.y, 0.0, 0.0, s.z, o.z]);
    out.put(offset::MAGIC, [*b"n+1\0"]);
    out.0.to_vec()
}

/// Reads a 3D volume, compressed or not.
///
/// # Errors
/// [`Error::Data`] or [`Error::Io`] naming file and field.
pub fn read(path: &Path) -> Result<Volume> {
    use nifti::{InMemNiftiVolume, NiftiHeader, NiftiObject, NiftiVolume, RandomAccessNiftiVolume, ReaderOptions};
    let bad = |field: &str, problem: String| Error::data(path, field, problem);
    if !path.is_file() {
        return Err(Error::io("read", path)(std::io::ErrorKind::NotFound.into()));
    }
    let header = NiftiHeader::from_file(path).map_err(|e| bad("header", e.to_string()))?;
    let axes = header.dim[0] as usize;
    if !(3..=7).contains(&axes) || header.dim[4..=axes.max(4)].iter().any(|n| *n > 1) && axes > 3 {
        return Err(bad("dim", format!("{:?} is not supported: a file must have one 3D volume", header.dim)));
    }
    let size = Volume::check_size(path, "dim", &[header.dim[1].into(), header.dim[2].into(), header.dim[3].into()])?;
    let object = ReaderOptions::new().read_file(path).map_err(|e| bad("data", e.to_string()))?;
    let volume: InMemNiftiVolume = object.into_volume();
    if volume.dim().len() != axes {
        return Err(bad("dim", format!("{:?} does not agree with the header", volume.dim())));
    }
    let (slope, intercept) = scaling(&header).map_err(|problem| bad("scl_inter", problem))?;
    let (kind, raw) = (volume.data_type(), volume.into_raw_data());
    let volume = InMemNiftiVolume::from_raw_fields(header.dim, kind, slope, intercept, raw, header.endianness)
        .map_err(|e| bad("data", e.to_string()))?;
    // Nothing is reserved: a header can state a size and no bits per value, so that the file is complete without values.
    let mut values = Vec::new();
    let mut index = vec![0u16; axes];
    for z in 0..header.dim[3] {
        for y in 0..header.dim[2] {
            for x in 0..header.dim[1] {
                index[..3].copy_from_slice(&[x, y, z]);
                values.push(volume.get_f32(&index).map_err(|e| bad("data", e.to_string()))?);
            }
        }
    }
    let mm_per_unit = mm_per_unit(header.xyzt_units).ok_or_else(|| {
        let problem = format!(
            "{} is no unit of length: 1 (m), 2 (mm), 3 (micrometres) and 0 (unknown, read as mm) are",
            header.xyzt_units
        );
        bad("xyzt_units", problem)
    })?;
    let ras = affine_of(&header).ok_or_else(|| bad("sform", "neither sform nor qform is set".into()))?;
    let flip = DMat3::from_diagonal(mm_per_unit * DVec3::new(-1.0, -1.0, 1.0));
    let index_to_lps = DAffine3::from_mat3_translation(flip * ras.matrix3, flip * ras.translation);
    Ok(Volume { size, values, index_to_lps })
}

/// Slope and intercept of the values. A slope that is zero or not finite means that values are not scaled, as to other readers.
fn scaling(header: &nifti::NiftiHeader) -> std::result::Result<(f32, f32), String> {
    let (slope, intercept) = (header.scl_slope, header.scl_inter);
    if slope == 0.0 || !slope.is_finite() {
        return Ok((1.0, 0.0));
    }
    if !intercept.is_finite() {
        return Err(format!("{intercept} is not finite, but scl_slope is {slope}"));
    }
    Ok((slope, intercept))
}

/// Length of the unit that a header states, mm; files that state none have mm, as other readers assume.
fn mm_per_unit(xyzt_units: u8) -> Option<f64> {
    match xyzt_units & UNITS_OF_LENGTH {
        0 | UNITS_MM => Some(1.0),
        UNITS_M => Some(1e3),
        UNITS_MICROMETRES => Some(1e-3),
        _ => None,
    }
}

fn affine_of(header: &nifti::NiftiHeader) -> Option<DAffine3> {
    let row = |r: [f32; 4]| r.map(f64::from);
    if header.sform_code > 0 {
        let rows = [row(header.srow_x), row(header.srow_y), row(header.srow_z)];
        let column = |c: usize| DVec3::new(rows[0][c], rows[1][c], rows[2][c]);
        return Some(DAffine3::from_cols(column(0), column(1), column(2), column(3)));
    }
    if header.qform_code <= 0 {
        return None;
    }
    let [b, c, d] = [header.quatern_b, header.quatern_c, header.quatern_d].map(f64::from);
    let a = (1.0 - b * b - c * c - d * d).max(0.0).sqrt();
    let p = header.pixdim.map(f64::from);
    let handed = if p[0] < 0.0 { -1.0 } else { 1.0 };
    let rotation = DMat3::from_quat(glam::DQuat::from_xyzw(b, c, d, a).normalize());
    let scale = DMat3::from_diagonal(DVec3::new(p[1], p[2], p[3] * handed));
    let offset = DVec3::new(header.quatern_x.into(), header.quatern_y.into(), header.quatern_z.into());
    Some(DAffine3::from_mat3_translation(rotation * scale, offset))
}
