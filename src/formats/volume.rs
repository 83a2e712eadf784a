//! Voxel volumes on disk: `.npy`, `.nii(.gz)`, `.nrrd`, `.mha` and raw binaries. Values are attenuation
//! per mm or Hounsfield units; positions are patient mm (LPS) with the isocentre at the origin.

use crate::error::{Error, Result};
use crate::files;
use crate::formats::images;
use crate::geometry::world_from_lps_mm;
use glam::{DAffine3, DMat3, DVec3};
use std::io::Read;
use std::path::Path;

/// Largest accepted volume, voxels (2 GiB of floats).
const MAX_VOXELS: u64 = 1 << 29;

/// A scalar volume.
#[derive(Debug, Clone)]
pub struct Volume {
    /// Voxels along the three index axes; the first is fastest in memory.
    pub size: [usize; 3],
    /// Values.
    pub values: Vec<f32>,
    /// Voxel index (centres at integers) to LPS mm.
    pub index_to_lps: DAffine3,
}

/// What a file cannot say of itself.
#[derive(Debug, Clone, Default)]
pub struct VolumeHints {
    /// Voxel spacing, mm, for `.npy` and raw files.
    pub spacing_mm: Option<[f64; 3]>,
    /// Size, for raw files.
    pub size: Option<[usize; 3]>,
    /// Element type of raw files: `f32`, `f64`, `i16`, `u16` or `u8`, little endian.
    pub raw_type: Option<String>,
    /// Put the volume's centre at the isocentre, whatever its header says.
    pub centre: bool,
}

impl Volume {
    /// A volume whose axes follow L, P, S, centred on `centre_mm`.
    pub fn centred(size: [usize; 3], spacing_mm: f64, centre_mm: DVec3, values: Vec<f32>) -> Volume {
        let half = DVec3::new(size[0] as f64 - 1.0, size[1] as f64 - 1.0, size[2] as f64 - 1.0) * 0.5;
        let index_to_lps = DAffine3::from_mat3_translation(
            DMat3::from_diagonal(DVec3::splat(spacing_mm)),
            centre_mm - half * spacing_mm,
        );
        Volume { size, values, index_to_lps }
    }

    /// World units to voxel index.
    pub fn world_to_index(&self) -> DAffine3 {
        let columns = [DVec3::X, DVec3::Y, DVec3::Z].map(|axis| world_from_lps_mm(self.index_to_lps.matrix3 * axis));
        let index_to_world = DAffine3::from_mat3_translation(
            DMat3::from_cols(columns[0], columns[1], columns[2]),
            world_from_lps_mm(self.index_to_lps.translation),
        );
        index_to_world.inverse()
    }

    /// Smallest voxel spacing, mm.
    pub fn spacing_mm(&self) -> f64 {
        let m = self.index_to_lps.matrix3;
        m.x_axis.length().min(m.y_axis.length()).min(m.z_axis.length())
    }

    /// Largest distance of a corner from the isocentre in the axial plane, mm.
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

    /// Reads a volume by its extension.
    ///
    /// # Errors
    /// [`Error::Data`] or [`Error::Io`] naming file and field.
    pub fn read(path: &Path, hints: &VolumeHints) -> Result<Volume> {
        let name = path.file_name().map(|n| n.to_string_lossy().to_lowercase()).unwrap_or_default();
        let mut volume = if name.ends_with(".npy") {
            read_npy(path, hints)?
        } else if name.ends_with(".nii") || name.ends_with(".nii.gz") {
            read_nifti(path)?
        } else if name.ends_with(".nrrd") {
            read_nrrd(path)?
        } else if name.ends_with(".mha") {
            read_mha(path)?
        } else if hints.size.is_some() {
            read_raw(path, hints)?
        } else {
            return Err(Error::data(
                path,
                "extension",
                "is none of .npy .nii .nii.gz .nrrd .mha; of a raw binary the size must be given",
            ));
        };
        let m = volume.index_to_lps.matrix3;
        if !m.determinant().is_finite() || m.determinant().abs() < 1e-12 || !volume.index_to_lps.translation.is_finite()
        {
            return Err(Error::data(path, "orientation", "spacing and directions cannot be inverted"));
        }
        if let Some(at) = volume.values.iter().position(|v| !v.is_finite()) {
            return Err(Error::data(path, format!("voxel {at}"), "is not a finite number"));
        }
        if hints.centre {
            let half = DVec3::new(volume.size[0] as f64, volume.size[1] as f64, volume.size[2] as f64) * 0.5 - 0.5;
            volume.index_to_lps.translation = -(m * half);
        }
        Ok(volume)
    }

    /// Writes a gzip-compressed NRRD in LPS mm.
    ///
    /// # Errors
    /// [`Error::Io`].
    pub fn write_nrrd(&self, path: &Path) -> Result<()> {
        use std::io::Write;
        let v = |p: DVec3| format!("({},{},{})", p.x, p.y, p.z);
        let m = self.index_to_lps.matrix3;
        let header = format!(
            "NRRD0004\ntype: float\ndimension: 3\nspace: left-posterior-superior\nsizes: {} {} {}\n\
             space directions: {} {} {}\nkinds: domain domain domain\nendian: little\nencoding: gzip\n\
             space origin: {}\n\n",
            self.size[0],
            self.size[1],
            self.size[2],
            v(m.x_axis),
            v(m.y_axis),
            v(m.z_axis),
            v(self.index_to_lps.translation)
        );
        files::write_atomic_with(path, |file| {
            file.write_all(header.as_bytes())?;
            let mut gzip = flate2::write::GzEncoder::new(file, flate2::Compression::fast());
            for block in self.values.chunks(1 << 16) {
                let bytes: Vec<u8> = block.iter().flat_map(|x| x.to_le_bytes()).collect();
                gzip.write_all(&bytes)?;
            }
            gzip.finish().map(|_| ())
        })
    }
}

fn check_size(path: &Path, field: &str, size: &[u64]) -> Result<[usize; 3]> {
    let bad = || {
        Error::data(
            path,
            field,
            format!("{size:?}; three axes of at least one voxel, {MAX_VOXELS} in all, are accepted"),
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

fn axis_aligned(size: [usize; 3], spacing: [f64; 3]) -> DAffine3 {
    let spacing = DVec3::from_array(spacing);
    let half = DVec3::new(size[0] as f64, size[1] as f64, size[2] as f64) * 0.5 - 0.5;
    DAffine3::from_mat3_translation(DMat3::from_diagonal(spacing), -(spacing * half))
}

fn spacing_hint(path: &Path, hints: &VolumeHints) -> Result<[f64; 3]> {
    match hints.spacing_mm {
        Some(s) if s.iter().all(|v| v.is_finite() && *v > 0.0) => Ok(s),
        Some(s) => Err(Error::data(path, "spacing", format!("{s:?} is not positive"))),
        None => Err(Error::data(path, "spacing", "this format does not carry it; it must be given, in mm")),
    }
}

fn read_npy(path: &Path, hints: &VolumeHints) -> Result<Volume> {
    let (shape, values) = images::read_npy_limited(path, 8 * MAX_VOXELS)?;
    let reversed: Vec<u64> = shape.iter().rev().map(|n| *n as u64).collect();
    let size = check_size(path, "shape", &reversed)?;
    Ok(Volume { size, values, index_to_lps: axis_aligned(size, spacing_hint(path, hints)?) })
}

fn read_raw(path: &Path, hints: &VolumeHints) -> Result<Volume> {
    let stated = hints.size.unwrap_or_default();
    let size = check_size(path, "size", &stated.map(|n| n as u64))?;
    let bytes = files::read_limited(path, 8 * MAX_VOXELS)?;
    let values = decode(path, hints.raw_type.as_deref().unwrap_or("f32"), true, &bytes, size)?;
    Ok(Volume { size, values, index_to_lps: axis_aligned(size, spacing_hint(path, hints)?) })
}

/// Turns raw bytes into floats.
fn decode(path: &Path, kind: &str, little: bool, bytes: &[u8], size: [usize; 3]) -> Result<Vec<f32>> {
    let voxels = size.iter().product::<usize>();
    macro_rules! convert {
        ($ty:ty) => {{
            const N: usize = size_of::<$ty>();
            if bytes.len() < voxels * N {
                return Err(Error::data(
                    path,
                    "data",
                    format!("{} bytes where {} voxels of {kind} need {}: truncated?", bytes.len(), voxels, voxels * N),
                ));
            }
            bytes[..voxels * N]
                .chunks_exact(N)
                .map(|c| {
                    let mut word = [0u8; N];
                    word.copy_from_slice(c);
                    (if little { <$ty>::from_le_bytes(word) } else { <$ty>::from_be_bytes(word) }) as f32
                })
                .collect()
        }};
    }
    Ok(match kind {
        "f32" => convert!(f32),
        "f64" => convert!(f64),
        "i16" => convert!(i16),
        "u16" => convert!(u16),
        "u8" => convert!(u8),
        "i8" => convert!(i8),
        "i32" => convert!(i32),
        "u32" => convert!(u32),
        other => {
            return Err(Error::data(path, "type", format!("`{other}`; f32, f64, i8, u8, i16, u16, i32, u32 are read")));
        }
    })
}

fn read_nifti(path: &Path) -> Result<Volume> {
    use nifti::{InMemNiftiVolume, NiftiHeader, NiftiObject, NiftiVolume, RandomAccessNiftiVolume, ReaderOptions};
    let bad = |field: &str, problem: String| Error::data(path, field, problem);
    if !path.is_file() {
        return Err(Error::io("read", path)(std::io::ErrorKind::NotFound.into()));
    }
    let header = NiftiHeader::from_file(path).map_err(|e| bad("header", e.to_string()))?;
    let axes = header.dim[0] as usize;
    if !(3..=7).contains(&axes) || header.dim[4..=axes.max(4)].iter().any(|n| *n > 1) && axes > 3 {
        return Err(bad("dim", format!("{:?}; one 3D volume per file is read", header.dim)));
    }
    let size = check_size(path, "dim", &[header.dim[1].into(), header.dim[2].into(), header.dim[3].into()])?;
    let object = ReaderOptions::new().read_file(path).map_err(|e| bad("data", e.to_string()))?;
    let volume: InMemNiftiVolume = object.into_volume();
    if volume.dim().len() != axes {
        return Err(bad("dim", format!("{:?} disagrees with the header", volume.dim())));
    }
    let mut values = Vec::with_capacity(size.iter().product());
    let mut index = vec![0u16; axes];
    for z in 0..header.dim[3] {
        for y in 0..header.dim[2] {
            for x in 0..header.dim[1] {
                index[..3].copy_from_slice(&[x, y, z]);
                values.push(volume.get_f32(&index).map_err(|e| bad("data", e.to_string()))?);
            }
        }
    }
    let ras = nifti_affine(&header).ok_or_else(|| bad("sform", "neither sform nor qform is set".into()))?;
    let flip = DMat3::from_diagonal(DVec3::new(-1.0, -1.0, 1.0));
    let index_to_lps = DAffine3::from_mat3_translation(flip * ras.matrix3, flip * ras.translation);
    Ok(Volume { size, values, index_to_lps })
}

fn nifti_affine(header: &nifti::NiftiHeader) -> Option<DAffine3> {
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

fn gunzip(path: &Path, bytes: &[u8], expected: usize) -> Result<Vec<u8>> {
    let mut out = Vec::new();
    // Never more than the header promises: a bomb stops there.
    flate2::read::MultiGzDecoder::new(bytes)
        .take(expected as u64)
        .read_to_end(&mut out)
        .map_err(|e| Error::data(path, "gzip", e.to_string()))?;
    Ok(out)
}

fn type_bytes(kind: &str) -> usize {
    match kind {
        "f64" => 8,
        "f32" | "i32" | "u32" => 4,
        "i16" | "u16" => 2,
        _ => 1,
    }
}

fn numbers(path: &Path, field: &str, text: &str) -> Result<Vec<f64>> {
    text.split(|c: char| c.is_whitespace() || "(),".contains(c))
        .filter(|w| !w.is_empty())
        .map(|w| w.parse::<f64>().map_err(|_| Error::data(path, field, format!("`{w}` is not a number"))))
        .collect()
}

fn affine(path: &Path, field: &str, columns: &[f64], origin: &[f64], flip: DVec3) -> Result<DAffine3> {
    let (Ok(c), Ok(o)) = (<[f64; 9]>::try_from(columns), <[f64; 3]>::try_from(origin)) else {
        return Err(Error::data(path, field, "needs three directions and an origin of three numbers"));
    };
    let flip = DMat3::from_diagonal(flip);
    Ok(DAffine3::from_mat3_translation(flip * DMat3::from_cols_array(&c), flip * DVec3::from_array(o)))
}

fn read_nrrd(path: &Path) -> Result<Volume> {
    let bytes = files::read_limited(path, 8 * MAX_VOXELS)?;
    let bad = |field: &str, problem: String| Error::data(path, field, problem);
    let end = bytes.windows(2).position(|w| w == b"\n\n").ok_or_else(|| bad("header", "has no end".into()))?;
    let header = String::from_utf8_lossy(&bytes[..end]).replace('\r', "");
    if !header.starts_with("NRRD") {
        return Err(bad("header", "does not start with NRRD".into()));
    }
    let field = |name: &str| {
        header.lines().find_map(|l| l.split_once(':').filter(|(k, _)| *k == name).map(|(_, v)| v.trim().to_owned()))
    };
    let need = |name: &str| field(name).ok_or_else(|| bad(name, "is missing".into()));
    if field("data file").is_some() || field("datafile").is_some() {
        return Err(bad("data file", "detached data is not read; attach it".into()));
    }
    let sizes: Vec<u64> = numbers(path, "sizes", &need("sizes")?)?.iter().map(|v| *v as u64).collect();
    let size = check_size(path, "sizes", &sizes)?;
    let kind = match need("type")?.as_str() {
        "float" => "f32",
        "double" => "f64",
        "short" | "int16" | "int16_t" | "signed short" => "i16",
        "unsigned short" | "ushort" | "uint16" | "uint16_t" => "u16",
        "unsigned char" | "uchar" | "uint8" | "uint8_t" => "u8",
        "signed char" | "int8" | "int8_t" => "i8",
        "int" | "int32" | "int32_t" | "signed int" => "i32",
        "unsigned int" | "uint" | "uint32" | "uint32_t" => "u32",
        other => return Err(bad("type", format!("`{other}` is not read"))),
    };
    let expected = size.iter().product::<usize>() * type_bytes(kind);
    let body = &bytes[end + 2..];
    let data = match need("encoding")?.as_str() {
        "raw" => body.to_vec(),
        "gzip" | "gz" => gunzip(path, body, expected)?,
        other => return Err(bad("encoding", format!("`{other}`; raw and gzip are read"))),
    };
    let values = decode(path, kind, field("endian").as_deref() != Some("big"), &data, size)?;
    let flip = match need("space")?.to_lowercase().as_str() {
        "left-posterior-superior" | "lps" => DVec3::ONE,
        "right-anterior-superior" | "ras" => DVec3::new(-1.0, -1.0, 1.0),
        "left-anterior-superior" | "las" => DVec3::new(1.0, -1.0, 1.0),
        other => {
            return Err(bad("space", format!("`{other}`; LPS, RAS and LAS are read")));
        }
    };
    let directions = numbers(path, "space directions", &need("space directions")?)?;
    let origin = numbers(path, "space origin", &need("space origin")?)?;
    Ok(Volume { size, values, index_to_lps: affine(path, "space directions", &directions, &origin, flip)? })
}

fn read_mha(path: &Path) -> Result<Volume> {
    let bytes = files::read_limited(path, 8 * MAX_VOXELS)?;
    let bad = |field: &str, problem: String| Error::data(path, field, problem);
    let key = b"ElementDataFile";
    let at =
        bytes.windows(key.len()).position(|w| w == key).ok_or_else(|| bad("ElementDataFile", "is missing".into()))?;
    let end = at + bytes[at..].iter().position(|b| *b == b'\n').ok_or_else(|| bad("header", "has no end".into()))?;
    let header = String::from_utf8_lossy(&bytes[..end]).replace('\r', "");
    let field = |name: &str| {
        header
            .lines()
            .find_map(|l| l.split_once('=').filter(|(k, _)| k.trim() == name).map(|(_, v)| v.trim().to_owned()))
    };
    let need = |name: &str| field(name).ok_or_else(|| bad(name, "is missing".into()));
    if need("ElementDataFile")? != "LOCAL" {
        return Err(bad("ElementDataFile", "detached data is not read; use .mha with LOCAL data".into()));
    }
    let sizes: Vec<u64> = numbers(path, "DimSize", &need("DimSize")?)?.iter().map(|v| *v as u64).collect();
    let size = check_size(path, "DimSize", &sizes)?;
    let kind = match need("ElementType")?.as_str() {
        "MET_FLOAT" => "f32",
        "MET_DOUBLE" => "f64",
        "MET_SHORT" => "i16",
        "MET_USHORT" => "u16",
        "MET_UCHAR" => "u8",
        "MET_CHAR" => "i8",
        "MET_INT" => "i32",
        "MET_UINT" => "u32",
        other => return Err(bad("ElementType", format!("`{other}` is not read"))),
    };
    let body = &bytes[end + 1..];
    let expected = size.iter().product::<usize>() * type_bytes(kind);
    let data = if field("CompressedData").is_some_and(|v| v.eq_ignore_ascii_case("true")) {
        let mut out = Vec::new();
        flate2::read::ZlibDecoder::new(body)
            .take(expected as u64)
            .read_to_end(&mut out)
            .map_err(|e| bad("CompressedData", e.to_string()))?;
        out
    } else {
        body.to_vec()
    };
    let big = ["BinaryDataByteOrderMSB", "ElementByteOrderMSB"]
        .iter()
        .any(|name| field(name).is_some_and(|v| v.eq_ignore_ascii_case("true")));
    let values = decode(path, kind, !big, &data, size)?;
    let spacing = numbers(path, "ElementSpacing", &need("ElementSpacing")?)?;
    let rotation = match field("TransformMatrix") {
        Some(text) => numbers(path, "TransformMatrix", &text)?,
        None => vec![1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0],
    };
    if spacing.len() != 3 || rotation.len() != 9 {
        return Err(bad("ElementSpacing", "needs three numbers and TransformMatrix nine".into()));
    }
    let columns: Vec<f64> = (0..9).map(|i| rotation[i] * spacing[i / 3]).collect();
    let origin = match field("Offset").or_else(|| field("Position")) {
        Some(text) => numbers(path, "Offset", &text)?,
        None => vec![0.0; 3],
    };
    Ok(Volume { size, values, index_to_lps: affine(path, "TransformMatrix", &columns, &origin, DVec3::ONE)? })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn ramp() -> Volume {
        let values = (0..24).map(|i| i as f32).collect();
        Volume::centred([2, 3, 4], 1.5, DVec3::new(1.0, -2.0, 3.0), values)
    }

    #[test]
    fn nrrd_round_trip() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("v.nrrd");
        ramp().write_nrrd(&path).unwrap();
        let back = Volume::read(&path, &VolumeHints::default()).unwrap();
        assert_eq!((back.size, &back.values), (ramp().size, &ramp().values));
        assert!(back.index_to_lps.abs_diff_eq(ramp().index_to_lps, 1e-12));
        let bytes = std::fs::read(&path).unwrap();
        for keep in [0, 4, 100, bytes.len() - 12] {
            std::fs::write(&path, &bytes[..keep]).unwrap();
            assert!(Volume::read(&path, &VolumeHints::default()).unwrap_err().to_string().contains("v.nrrd"));
        }
    }

    #[test]
    fn mha_big_endian_and_anisotropic() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("v.mha");
        let mut bytes = b"ObjectType = Image\nNDims = 3\nBinaryDataByteOrderMSB = True\nDimSize = 2 1 2\n\
            ElementSpacing = 1 2 3\nOffset = 4 5 6\nElementType = MET_SHORT\nElementDataFile = LOCAL\n"
            .to_vec();
        for v in [1i16, -2, 300, 4] {
            bytes.extend(v.to_be_bytes());
        }
        std::fs::write(&path, bytes).unwrap();
        let volume = Volume::read(&path, &VolumeHints::default()).unwrap();
        assert_eq!(volume.values, [1.0, -2.0, 300.0, 4.0]);
        let corner = volume.index_to_lps.transform_point3(DVec3::new(1.0, 0.0, 1.0));
        assert_eq!(corner, DVec3::new(5.0, 5.0, 9.0));
    }

    #[test]
    fn world_axes_are_posterior_left_superior() {
        let volume = ramp();
        // Voxel (0,0,0) sits at LPS (0.25, -3.5, 0.75): world = (P, L, S) / 100.
        let index = volume.world_to_index().transform_point3(DVec3::new(-0.035, 0.0025, 0.0075));
        assert!(index.length() < 1e-9, "{index}");
    }
}
