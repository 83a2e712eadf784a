//! `.nrrd` volumes with attached data, raw or gzip; a sequence has a list axis, which 3D Slicer plays (`.seq.nrrd`).

use crate::error::{Error, Result};
use crate::files;
use crate::raw::{self, ByteOrder, Element};
use crate::volume::{MAX_BYTES, Volume, VolumeHeader, affine, numbers};
use glam::{DAffine3, DMat3, DVec3};
use std::io::Write;
use std::path::Path;

/// Encoding of the data after the header.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Encoding {
    /// Uncompressed.
    Raw,
    /// One gzip stream.
    Gzip,
}

/// Axes of a file in addition to its three spatial axes.
#[derive(Clone, Copy)]
enum ExtraAxes<'a> {
    /// No further axis: a single volume.
    Nothing,
    /// An axis of phases before the spatial axes.
    Phases(&'a [u32]),
    /// An axis of three components before the spatial axes and, for several phases, an axis of phases after them.
    Vectors(Option<&'a [u32]>),
}

/// Header entries of the additional axes: before the spatial axes and after them.
struct MoreAxes {
    sizes: [String; 2],
    directions: [&'static str; 2],
    kinds: [&'static str; 2],
    /// Lines that name the phases.
    names: String,
    dimension: usize,
}

impl MoreAxes {
    fn of(beside: ExtraAxes<'_>) -> MoreAxes {
        let names = |axis: usize, phases: &[u32]| {
            let values: Vec<_> = phases.iter().map(u32::to_string).collect();
            format!("axis {axis} index type:=numeric\naxis {axis} index values:={}\n", values.join(" "))
        };
        let none = String::new;
        match beside {
            ExtraAxes::Nothing => {
                MoreAxes { sizes: [none(), none()], directions: ["", ""], kinds: ["", ""], names: none(), dimension: 3 }
            }
            ExtraAxes::Phases(phases) => MoreAxes {
                sizes: [format!("{} ", phases.len()), none()],
                directions: ["none ", ""],
                kinds: ["list ", ""],
                names: names(0, phases),
                dimension: 4,
            },
            ExtraAxes::Vectors(None) => MoreAxes {
                sizes: ["3 ".into(), none()],
                directions: ["none ", ""],
                kinds: ["vector ", ""],
                names: none(),
                dimension: 4,
            },
            ExtraAxes::Vectors(Some(phases)) => MoreAxes {
                sizes: ["3 ".into(), format!(" {}", phases.len())],
                directions: ["none ", " none"],
                kinds: ["vector ", " list"],
                names: names(4, phases),
                dimension: 5,
            },
        }
    }
}

/// Returns the header of a file of floats, including the empty line at its end.
fn header(
    size: &str,
    index_to_lps: &DAffine3,
    beside: ExtraAxes<'_>,
    encoding: Encoding,
    quantity: &str,
    comments: &[&str],
) -> String {
    let v = |p: DVec3| format!("({},{},{})", p.x, p.y, p.z);
    let m = index_to_lps.matrix3;
    let encoding = match encoding {
        Encoding::Raw => "raw",
        Encoding::Gzip => "gzip",
    };
    let comments: String = comments.iter().map(|comment| format!("# {comment}\n")).collect();
    let MoreAxes { sizes, directions, kinds, names, dimension } = MoreAxes::of(beside);
    format!(
        "NRRD0004\n{comments}type: float\ndimension: {dimension}\nspace: left-posterior-superior\n\
         sizes: {}{size}{}\nspace directions: {}{} {} {}{}\nkinds: {}domain domain domain{}\n\
         endian: little\nencoding: {encoding}\nspace origin: {}\nspace units: \"mm\" \"mm\" \"mm\"\n\
         quantity:={quantity}\n{names}\n",
        sizes[0],
        sizes[1],
        directions[0],
        v(m.x_axis),
        v(m.y_axis),
        v(m.z_axis),
        directions[1],
        kinds[0],
        kinds[1],
        v(index_to_lps.translation)
    )
}

/// Returns the header of a grid along the patient's axes.
fn header_on_grid(h: &VolumeHeader, beside: ExtraAxes<'_>, encoding: Encoding, comments: &[&str]) -> Vec<u8> {
    let [nx, ny, nz] = h.size;
    let axes = DMat3::from_diagonal(h.spacing_mm);
    let index_to_lps = DAffine3::from_mat3_translation(axes, h.origin_mm);
    header(&format!("{nx} {ny} {nz}"), &index_to_lps, beside, encoding, &h.quantity, comments).into_bytes()
}

/// Returns the header of a file whose values are then written in pieces. In a sequence, the values of all phases of a voxel are
/// adjacent.
pub fn header_of(h: &VolumeHeader, encoding: Encoding) -> Vec<u8> {
    header_on_grid(h, h.phases.as_deref().map_or(ExtraAxes::Nothing, ExtraAxes::Phases), encoding, &[])
}

/// Returns the header of a file of vectors with `comments`, whose values are then written in pieces. Values follow phase by
/// phase, with the components of a vector adjacent. The list axis comes last, as in files that 3D Slicer writes itself.
pub fn vector_header_of(h: &VolumeHeader, encoding: Encoding, comments: &[&str]) -> Vec<u8> {
    header_on_grid(h, ExtraAxes::Vectors(h.phases.as_deref()), encoding, comments)
}

/// Writes a gzip-compressed volume in LPS mm; `quantity` names the meaning of its values.
///
/// # Errors
/// [`Error::Io`].
pub fn write(path: &Path, volume: &Volume, quantity: &str) -> Result<()> {
    let [nx, ny, nz] = volume.size;
    let size = format!("{nx} {ny} {nz}");
    let header = header(&size, &volume.index_to_lps, ExtraAxes::Nothing, Encoding::Gzip, quantity, &[]);
    files::write_atomic_with(path, |file| {
        file.write_all(header.as_bytes())?;
        let mut gzip = flate2::write::GzEncoder::new(file, flate2::Compression::fast());
        raw::write_floats(&mut gzip, &volume.values, ByteOrder::Little)?;
        gzip.finish().map(|_| ())
    })
}

/// Reads a 3D volume.
///
/// # Errors
/// [`Error::Data`] or [`Error::Io`] naming file and field.
pub fn read(path: &Path) -> Result<Volume> {
    let bytes = files::read_limited(path, MAX_BYTES)?;
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
        return Err(bad("data file", "data in a separate file are not supported; put them into this file".into()));
    }
    let sizes: Vec<u64> = numbers(path, "sizes", &need("sizes")?)?.iter().map(|v| *v as u64).collect();
    let size = Volume::check_size(path, "sizes", &sizes)?;
    let kind = need("type")?;
    let element = element_of(&kind).ok_or_else(|| bad("type", format!("`{kind}` is not supported")))?;
    let voxels = size.iter().product::<usize>();
    let body = &bytes[end + 2..];
    let data = match need("encoding")?.as_str() {
        "raw" => body.to_vec(),
        "gzip" | "gz" => raw::read_at_most(flate2::read::MultiGzDecoder::new(body), voxels * element.bytes())
            .map_err(|e| bad("gzip", e.to_string()))?,
        other => return Err(bad("encoding", format!("`{other}` is not supported; raw and gzip are"))),
    };
    let order = if field("endian").as_deref() == Some("big") { ByteOrder::Big } else { ByteOrder::Little };
    let values = element.decode(path, order, &data, voxels)?;
    let flip = match need("space")?.to_lowercase().as_str() {
        "left-posterior-superior" | "lps" => DVec3::ONE,
        "right-anterior-superior" | "ras" => DVec3::new(-1.0, -1.0, 1.0),
        "left-anterior-superior" | "las" => DVec3::new(1.0, -1.0, 1.0),
        other => {
            return Err(bad("space", format!("`{other}` is not supported; LPS, RAS and LAS are")));
        }
    };
    let directions = numbers(path, "space directions", &need("space directions")?)?;
    let origin = numbers(path, "space origin", &need("space origin")?)?;
    Ok(Volume { size, values, index_to_lps: affine(path, "space directions", &directions, &origin, flip)? })
}

fn element_of(kind: &str) -> Option<Element> {
    Some(match kind {
        "float" => Element::F32,
        "double" => Element::F64,
        "short" | "int16" | "int16_t" | "signed short" => Element::I16,
        "unsigned short" | "ushort" | "uint16" | "uint16_t" => Element::U16,
        "unsigned char" | "uchar" | "uint8" | "uint8_t" => Element::U8,
        "signed char" | "int8" | "int8_t" => Element::I8,
        "int" | "int32" | "int32_t" | "signed int" => Element::I32,
        "unsigned int" | "uint" | "uint32" | "uint32_t" => Element::U32,
        _ => return None,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn round_trip_and_truncation() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("v.nrrd");
        let values = (0..24).map(|i| i as f32).collect();
        let volume = Volume::centred([2, 3, 4], 1.5, DVec3::new(1.0, -2.0, 3.0), values);
        write(&path, &volume, "a ramp").unwrap();
        let back = read(&path).unwrap();
        assert_eq!((back.size, &back.values), (volume.size, &volume.values));
        assert!(back.index_to_lps.abs_diff_eq(volume.index_to_lps, 1e-12));
        let bytes = std::fs::read(&path).unwrap();
        for keep in [0, 4, 100, bytes.len() - 12] {
            std::fs::write(&path, &bytes[..keep]).unwrap();
            assert!(read(&path).unwrap_err().to_string().contains("v.nrrd"));
        }
    }
}
