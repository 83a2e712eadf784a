//! `.mha` volumes (MetaImage with LOCAL data), in LPS mm; a sequence has a fourth axis.

use crate::error::{Error, Result};
use crate::files;
use crate::raw::{self, ByteOrder, Element};
use crate::volume::{MAX_BYTES, Volume, VolumeHeader, affine, length_mm, numbers};
use glam::DVec3;
use std::path::Path;

/// Key of the last header line; the values begin after it.
const DATA: &str = "ElementDataFile";

/// Returns the header of a file of little-endian floats whose values are then written phase by phase.
pub fn header_of(h: &VolumeHeader) -> Vec<u8> {
    let VolumeHeader { origin_mm: o, spacing_mm: s, size: [nx, ny, nz], .. } = h;
    let (dimensions, axis, point, step, turn) = match &h.phases {
        Some(phases) => (4, format!(" {}", phases.len()), " 0", " 1", "1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1"),
        None => (3, String::new(), "", "", "1 0 0 0 1 0 0 0 1"),
    };
    format!(
        "ObjectType = Image\nNDims = {dimensions}\nBinaryData = True\nBinaryDataByteOrderMSB = False\n\
         CompressedData = False\nTransformMatrix = {turn}\nOffset = {} {} {}{point}\n\
         ElementSpacing = {} {} {}{step}\nDimSize = {nx} {ny} {nz}{axis}\nElementType = MET_FLOAT\n\
         {DATA} = LOCAL\n",
        o.x, o.y, o.z, s.x, s.y, s.z
    )
    .into_bytes()
}

/// Reads a 3D volume.
///
/// # Errors
/// [`Error::Data`] or [`Error::Io`] naming file and field.
pub fn read(path: &Path) -> Result<Volume> {
    let bytes = files::read_limited(path, MAX_BYTES)?;
    let bad = |field: &str, problem: String| Error::data(path, field, problem);
    let key = DATA.as_bytes();
    let at = bytes.windows(key.len()).position(|w| w == key).ok_or_else(|| bad(DATA, "is missing".into()))?;
    let end = at + bytes[at..].iter().position(|b| *b == b'\n').ok_or_else(|| bad("header", "has no end".into()))?;
    let header = String::from_utf8_lossy(&bytes[..end]).replace('\r', "");
    let field = |name: &str| {
        header
            .lines()
            .find_map(|l| l.split_once('=').filter(|(k, _)| k.trim() == name).map(|(_, v)| v.trim().to_owned()))
    };
    let need = |name: &str| field(name).ok_or_else(|| bad(name, "is missing".into()));
    refuse_what_is_not_read(path, field)?;
    let says_true = |name: &str| field(name).is_some_and(|v| v.eq_ignore_ascii_case("true"));
    if need(DATA)? != "LOCAL" {
        return Err(bad(DATA, "data in a separate file are not supported; use .mha with LOCAL data".into()));
    }
    let sizes: Vec<u64> = numbers(path, "DimSize", &need("DimSize")?)?.iter().map(|v| *v as u64).collect();
    let size = Volume::check_size(path, "DimSize", &sizes)?;
    let kind = need("ElementType")?;
    let element = element_of(&kind).ok_or_else(|| bad("ElementType", format!("`{kind}` is not supported")))?;
    let voxels = size.iter().product::<usize>();
    let body = after_header(path, &bytes[end + 1..], field("HeaderSize").as_deref(), voxels * element.bytes())?;
    let data = match says_true("CompressedData") {
        true => raw::read_at_most(flate2::read::ZlibDecoder::new(body), voxels * element.bytes())
            .map_err(|e| bad("CompressedData", e.to_string()))?,
        false => body.to_vec(),
    };
    let big = says_true("BinaryDataByteOrderMSB") || says_true("ElementByteOrderMSB");
    let values = element.decode(path, if big { ByteOrder::Big } else { ByteOrder::Little }, &data, voxels)?;
    // Files that state the size of a voxel have no gaps between voxels.
    let spacing = match field("ElementSpacing").or_else(|| field("ElementSize")) {
        Some(text) => numbers(path, "ElementSpacing", &text)?,
        None => return Err(bad("ElementSpacing", "is missing".into())),
    };
    // MetaIO writes `?` for a unit that is not known.
    let unit = field("DistanceUnits").filter(|unit| unit != "?");
    let unit_mm = unit.map_or(Ok(1.0), |unit| length_mm(path, "DistanceUnits", &unit))?;
    let rotation = match field("TransformMatrix").or_else(|| field("Rotation")).or_else(|| field("Orientation")) {
        Some(text) => numbers(path, "TransformMatrix", &text)?,
        None => vec![1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0],
    };
    if spacing.len() != 3 || rotation.len() != 9 {
        return Err(bad("ElementSpacing", "three numbers are needed, and nine for TransformMatrix".into()));
    }
    let columns: Vec<f64> = (0..9).map(|i| rotation[i] * spacing[i / 3]).collect();
    let origin = match field("Offset").or_else(|| field("Position")).or_else(|| field("Origin")) {
        Some(text) => numbers(path, "Offset", &text)?,
        None => vec![0.0; 3],
    };
    Ok(Volume {
        size,
        values,
        index_to_lps: affine(path, "TransformMatrix", &columns, &origin, DVec3::splat(unit_mm))?,
    })
}

/// Refuses fields that change the meaning of the values in a way that is not read. Other fields, and those that a program adds, say nothing
/// about the place or the value of a voxel: ITK passes over them, too.
fn refuse_what_is_not_read(path: &Path, field: impl Fn(&str) -> Option<String>) -> Result<()> {
    let refused = |name: &str, stated: &str, read: &str| {
        Err(Error::data(path, name, format!("`{stated}` is not supported; {read} is")))
    };
    if let Some(stated) = field("BinaryData").filter(|stated| !stated.eq_ignore_ascii_case("true")) {
        return refused("BinaryData", &stated, "True");
    }
    let numbers = [
        ("ElementNumberOfChannels", 1.0),
        ("ElementToIntensityFunctionSlope", 1.0),
        ("ElementToIntensityFunctionOffset", 0.0),
    ];
    for (name, read) in numbers {
        if let Some(stated) = field(name).filter(|stated| stated.parse() != Ok(read)) {
            return refused(name, &stated, &read.to_string());
        }
    }
    Ok(())
}

/// Returns the data after what `HeaderSize` states: so many bytes, or, with -1, all but the last `expected` ones.
fn after_header<'a>(path: &Path, body: &'a [u8], stated: Option<&str>, expected: usize) -> Result<&'a [u8]> {
    let Some(text) = stated else { return Ok(body) };
    let first = match text.parse::<i64>() {
        Ok(-1) => body.len().checked_sub(expected),
        Ok(bytes) => usize::try_from(bytes).ok(),
        Err(_) => None,
    };
    let rest = first.and_then(|first| body.get(first..));
    rest.ok_or_else(|| Error::data(path, "HeaderSize", format!("`{text}` bytes cannot be passed over")))
}

fn element_of(kind: &str) -> Option<Element> {
    Some(match kind {
        "MET_FLOAT" => Element::F32,
        "MET_DOUBLE" => Element::F64,
        "MET_SHORT" => Element::I16,
        "MET_USHORT" => Element::U16,
        "MET_UCHAR" => Element::U8,
        "MET_CHAR" => Element::I8,
        "MET_INT" => Element::I32,
        "MET_UINT" => Element::U32,
        _ => return None,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn big_endian_and_anisotropic() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("v.mha");
        let mut bytes = b"ObjectType = Image\nNDims = 3\nBinaryDataByteOrderMSB = True\nDimSize = 2 1 2\n\
            ElementSpacing = 1 2 3\nOffset = 4 5 6\nElementType = MET_SHORT\nElementDataFile = LOCAL\n"
            .to_vec();
        for v in [1i16, -2, 300, 4] {
            bytes.extend(v.to_be_bytes());
        }
        std::fs::write(&path, bytes).unwrap();
        let volume = read(&path).unwrap();
        assert_eq!(volume.values, [1.0, -2.0, 300.0, 4.0]);
        let corner = volume.index_to_lps.transform_point3(DVec3::new(1.0, 0.0, 1.0));
        assert_eq!(corner, DVec3::new(5.0, 5.0, 9.0));
    }
}
