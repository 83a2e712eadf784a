//! `.nrrd` volumes with attached data, raw or gzip; a sequence has a list axis, which 3D Slicer plays (`.seq.nrrd`).

use crate::error::{Error, Result};
use crate::files;
use crate::raw::{self, ByteOrder, Element};
use crate::volume::{MAX_BYTES, Volume, VolumeHeader, affine, length_mm, numbers};
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

/// Fields of the format (teem.sourceforge.net/nrrd/format.html, section 4) that decide where values are and what they mean.
const USED: [&str; 12] = [
    "dimension",
    "sizes",
    "type",
    "encoding",
    "endian",
    "line skip",
    "byte skip",
    "space",
    "space directions",
    "space origin",
    "space units",
    "kinds",
];
/// Fields that say nothing about the place or the value of a voxel beside the fields that are used.
const HARMLESS: [&str; 18] = [
    "space dimension",
    "content",
    "number",
    "block size",
    "min",
    "max",
    "old min",
    "old max",
    "sample units",
    "centers",
    "centerings",
    "labels",
    "units",
    "spacings",
    "thicknesses",
    "axis mins",
    "axis maxs",
    "measurement frame",
];

/// Fields of a header, by their names without spaces.
struct Fields<'a> {
    path: &'a Path,
    values: Vec<(String, String)>,
}

impl Fields<'_> {
    /// Reads a header.
    ///
    /// # Errors
    /// [`Error::Data`] naming the field, for one that may move or turn the data and is not known.
    fn of<'a>(path: &'a Path, header: &str) -> Result<Fields<'a>> {
        let mut values = Vec::new();
        let lines = header.lines().skip(1).filter(|line| !line.starts_with('#') && !line.is_empty());
        for line in lines.filter(|line| !line.contains(":=")) {
            let (name, value) = line
                .split_once(':')
                .ok_or_else(|| Error::data(path, "header", format!("`{line}` is neither a field nor a comment")))?;
            let (name, value) = (name.trim().to_lowercase(), value.trim().to_owned());
            match &*name {
                "data file" | "datafile" => {
                    let problem = "data in a separate file are not supported; put them into this file";
                    return Err(Error::data(path, "data file", problem));
                }
                known if is_among(known, &USED) => values.push((compact(known), value)),
                known if is_among(known, &HARMLESS) => {}
                other => return Err(Error::data(path, other, "is no field of an NRRD volume that is known here")),
            }
        }
        Ok(Fields { path, values })
    }

    fn get(&self, name: &str) -> Option<&str> {
        let name = compact(name);
        self.values.iter().find(|(other, _)| *other == name).map(|(_, value)| value.as_str())
    }

    fn need(&self, name: &'static str) -> Result<&str> {
        self.get(name).ok_or_else(|| Error::data(self.path, name, "is missing"))
    }

    fn number(&self, name: &'static str) -> Result<i64> {
        let Some(text) = self.get(name) else { return Ok(0) };
        text.parse().map_err(|_| Error::data(self.path, name, format!("`{text}` is no whole number")))
    }

    /// Sizes of the three axes in space, and the vectors of these axes. A list of one volume, as 3D Slicer writes it, has one more axis.
    fn axes(&self) -> Result<(Vec<u64>, Vec<f64>)> {
        let sizes = numbers(self.path, "sizes", self.need("sizes")?)?;
        let directions = self.need("space directions")?.replace(')', ") ");
        let directions: Vec<&str> = directions.split_inclusive([')']).flat_map(words_outside).collect();
        let is_list = |axis: usize| directions.get(axis).is_some_and(|vector| *vector == "none");
        let (mut kept, mut vectors) = (Vec::new(), Vec::new());
        for (axis, size) in sizes.iter().enumerate() {
            if is_list(axis) && *size == 1.0 {
                continue;
            }
            kept.push(*size as u64);
            if let Some(vector) = directions.get(axis).filter(|_| !is_list(axis)) {
                vectors.extend(numbers(self.path, "space directions", vector)?);
            }
        }
        Ok((kept, vectors))
    }

    /// Signs that lead from the file's space to LPS.
    fn signs(&self) -> Result<DVec3> {
        match &*self.need("space")?.to_lowercase() {
            "left-posterior-superior" | "lps" => Ok(DVec3::ONE),
            "right-anterior-superior" | "ras" => Ok(DVec3::new(-1.0, -1.0, 1.0)),
            "left-anterior-superior" | "las" => Ok(DVec3::new(1.0, -1.0, 1.0)),
            other => Err(Error::data(self.path, "space", format!("`{other}` is not supported; LPS, RAS and LAS are"))),
        }
    }

    /// Length of the unit along each axis of space, mm.
    fn units_mm(&self) -> Result<DVec3> {
        let Some(text) = self.get("space units") else { return Ok(DVec3::ONE) };
        let units: Vec<&str> = text.split(['"', ' ']).filter(|unit| !unit.is_empty()).collect();
        let mm = |unit: &&str| length_mm(self.path, "space units", unit);
        match units.iter().map(mm).collect::<Result<Vec<f64>>>()?[..] {
            [x, y, z] => Ok(DVec3::new(x, y, z)),
            // Empty texts state no unit.
            [] => Ok(DVec3::ONE),
            _ => Err(Error::data(self.path, "space units", format!("`{text}` does not have three units"))),
        }
    }

    /// Returns the stored data after the lines and bytes that are to be skipped; `expected` is their number without a compression.
    fn data(&self, body: &[u8], expected: usize) -> Result<Vec<u8>> {
        let bad = |field: &str, problem: String| Error::data(self.path, field, problem);
        let (lines, bytes) = (self.number("line skip")?, self.number("byte skip")?);
        if lines < 0 || bytes < -1 {
            return Err(bad("line skip", format!("{lines} lines and {bytes} bytes cannot be skipped")));
        }
        let mut body = body;
        for _ in 0..lines {
            let end = body.iter().position(|byte| *byte == b'\n');
            body = &body[end.ok_or_else(|| bad("line skip", format!("there are no {lines} lines")))? + 1..];
        }
        let after = |data: &[u8]| {
            let rest = data.get(bytes as usize..).map(<[u8]>::to_vec);
            rest.ok_or_else(|| bad("byte skip", format!("there are no {bytes} bytes to skip")))
        };
        match self.need("encoding")? {
            "raw" if bytes == -1 => {
                let first = body.len().checked_sub(expected);
                first.map(|first| body[first..].to_vec()).ok_or_else(|| bad("data", "are too short".into()))
            }
            "raw" => after(body),
            "gzip" | "gz" if bytes == -1 => Err(bad("byte skip", "of -1 is for raw data alone".into())),
            "gzip" | "gz" => {
                let all = expected.saturating_add(bytes as usize);
                let data = raw::read_at_most(flate2::read::MultiGzDecoder::new(body), all);
                after(&data.map_err(|e| bad("gzip", e.to_string()))?)
            }
            other => Err(bad("encoding", format!("`{other}` is not supported; raw and gzip are"))),
        }
    }
}

/// Returns the name of a field without spaces: most fields have a spelling with and one without.
fn compact(name: &str) -> String {
    name.replace(' ', "")
}

fn is_among(name: &str, fields: &[&str]) -> bool {
    fields.iter().any(|field| compact(field) == compact(name))
}

/// Splits a text into a vector in brackets and the words `none` before it.
fn words_outside(text: &str) -> Vec<&str> {
    let (before, vector) = text.split_at(text.find('(').unwrap_or(text.len()));
    before.split_whitespace().chain(Some(vector.trim()).filter(|vector| !vector.is_empty())).collect()
}

/// Reads a 3D volume.
///
/// # Errors
/// [`Error::Data`] or [`Error::Io`] naming file and field.
pub fn read(path: &Path) -> Result<Volume> {
    let bytes = files::read_limited(path, MAX_BYTES)?;
    let bad = |field: &str, problem: String| Error::data(path, field, problem);
    // Lines may end with a carriage return as well.
    let ends = [&b"\n\n"[..], b"\n\r\n"].map(|end| Some((bytes.windows(end.len()).position(|w| w == end)?, end.len())));
    let (end, length) = ends.into_iter().flatten().min().ok_or_else(|| bad("header", "has no end".into()))?;
    let header = String::from_utf8_lossy(&bytes[..end]).replace('\r', "");
    if !header.starts_with("NRRD") {
        return Err(bad("header", "does not start with NRRD".into()));
    }
    let fields = Fields::of(path, &header)?;
    let (sizes, directions) = fields.axes()?;
    let size = Volume::check_size(path, "sizes", &sizes)?;
    let kind = fields.need("type")?;
    let element = element_of(kind).ok_or_else(|| bad("type", format!("`{kind}` is not supported")))?;
    let voxels = size.iter().product::<usize>();
    let data = fields.data(&bytes[end + length..], voxels * element.bytes())?;
    let order = if fields.get("endian") == Some("big") { ByteOrder::Big } else { ByteOrder::Little };
    let values = element.decode(path, order, &data, voxels)?;
    let origin = numbers(path, "space origin", fields.need("space origin")?)?;
    let to_lps = fields.signs()? * fields.units_mm()?;
    Ok(Volume { size, values, index_to_lps: affine(path, "space directions", &directions, &origin, to_lps)? })
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
