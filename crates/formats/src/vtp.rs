//! VTK's XML poly data (`.vtp`): lines with values at points and lines, and collections of such files over time (`.pvd`). Files
//! are written as text: centrelines are small, and every reader of VTK's formats accepts text. The code is our own: vtkio
//! brings a parser and three compressions, and a few arrays need none of these.

use crate::error::{Error, Result};
use crate::files;
use crate::vtk_arrays::{Arrays, SplitFile};
use roxmltree::{Document, Node, ParsingOptions};
use std::fmt::{Display, Write};
use std::path::{Path, PathBuf};

const MAX_FILE_BYTES: u64 = 1 << 30;
/// Largest accepted number of XML nodes: they may be nested to the same depth, and each level uses stack space.
const MAX_NODES: u32 = 2048;

/// Named values, one per point or line.
pub enum Values {
    /// Floating-point numbers.
    Float(&'static str, Vec<f64>),
    /// Integers.
    Int(&'static str, Vec<i64>),
}

/// Open lines through points.
pub struct Lines {
    /// Title of the lines, for a comment; it must not contain `--`.
    pub title: String,
    /// Time of the lines.
    pub time: f64,
    /// Points of all lines.
    pub points: Vec<[f64; 3]>,
    /// Number of points of each line; the lines follow each other in `points`.
    pub counts: Vec<usize>,
    /// Values at the points.
    pub of_points: Vec<Values>,
    /// Values of the lines.
    pub of_lines: Vec<Values>,
}

fn words<T: Display>(values: impl IntoIterator<Item = T>) -> String {
    let mut text = String::new();
    for value in values {
        // Writing to a string does not fail.
        let _ = write!(text, "{value} ");
    }
    text.trim_end().to_owned()
}

fn array(kind: &str, name: &str, more: &str, content: &str) -> String {
    format!("<DataArray type=\"{kind}\" Name=\"{name}\"{more} format=\"ascii\">{content}</DataArray>\n")
}

fn arrays(all: &[Values]) -> String {
    let one = |values: &Values| match values {
        Values::Float(name, values) => array("Float64", name, "", &words(values)),
        Values::Int(name, values) => array("Int64", name, "", &words(values)),
    };
    all.iter().map(one).collect()
}

impl Lines {
    /// Returns the text of a `.vtp` file with the lines.
    pub fn to_vtp(&self) -> String {
        let (n_points, n_lines) = (self.points.len(), self.counts.len());
        let ends = self.counts.iter().scan(0, |end, count| {
            *end += count;
            Some(*end)
        });
        let parts = [
            format!("<?xml version=\"1.0\"?>\n<!-- {} -->\n", self.title),
            "<VTKFile type=\"PolyData\" version=\"1.0\" byte_order=\"LittleEndian\">\n<PolyData>\n".to_owned(),
            "<FieldData>\n".to_owned(),
            array("Float64", "TimeValue", " NumberOfTuples=\"1\"", &self.time.to_string()),
            "</FieldData>\n".to_owned(),
            format!(
                "<Piece NumberOfPoints=\"{n_points}\" NumberOfVerts=\"0\" NumberOfLines=\"{n_lines}\" \
                 NumberOfStrips=\"0\" NumberOfPolys=\"0\">\n"
            ),
            format!("<PointData>\n{}</PointData>\n", arrays(&self.of_points)),
            format!("<CellData>\n{}</CellData>\n", arrays(&self.of_lines)),
            "<Points>\n".to_owned(),
            array("Float64", "Points", " NumberOfComponents=\"3\"", &words(self.points.as_flattened())),
            "</Points>\n<Lines>\n".to_owned(),
            array("Int64", "connectivity", "", &words(0..n_points)),
            array("Int64", "offsets", "", &words(ends)),
            "</Lines>\n</Piece>\n</PolyData>\n</VTKFile>\n".to_owned(),
        ];
        parts.concat()
    }
}

/// Escapes text for use in an attribute.
fn escaped(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('"', "&quot;")
}

/// Formats a collection of files in the same directory, each with its time.
pub fn collection(files: &[(f64, String)]) -> String {
    let entry = |(time, file): &(f64, String)| format!("<DataSet timestep=\"{time}\" file=\"{}\"/>\n", escaped(file));
    let entries: String = files.iter().map(entry).collect();
    format!(
        "<?xml version=\"1.0\"?>\n<VTKFile type=\"Collection\" version=\"1.0\" byte_order=\"LittleEndian\">\n\
         <Collection>\n{entries}</Collection>\n</VTKFile>\n"
    )
}

/// Lines read from a file.
#[derive(Debug, Default)]
pub struct ReadLines {
    /// All points.
    pub points: Vec<[f64; 3]>,
    /// Points of each line, as indices into `points`.
    pub lines: Vec<Vec<usize>>,
    /// Scalar values at all points, with their names.
    pub of_points: Vec<(String, Vec<f64>)>,
}

fn child<'a, 'input>(node: Node<'a, 'input>, name: &str) -> Option<Node<'a, 'input>> {
    node.children().find(|child| child.has_tag_name(name))
}

fn data_arrays<'a, 'input>(node: Option<Node<'a, 'input>>) -> impl Iterator<Item = Node<'a, 'input>> {
    node.into_iter().flat_map(|node| node.children().filter(|child| child.has_tag_name("DataArray")))
}

fn parsed<'a>(path: &Path, text: &'a str) -> Result<Document<'a>> {
    let options = ParsingOptions { nodes_limit: MAX_NODES, ..ParsingOptions::default() };
    Document::parse_with_options(text, options).map_err(|e| Error::data(path, "XML", e.to_string()))
}

/// Reads the lines of a `.vtp` in any of VTK's encodings except LZ4 and LZMA compression.
///
/// # Errors
/// [`Error::Io`], and [`Error::Data`] naming the field.
pub fn read(path: &Path) -> Result<ReadLines> {
    let bytes = files::read_limited(path, MAX_FILE_BYTES)?;
    let parts = SplitFile::of(&bytes);
    let document = parsed(path, &parts.text)?;
    let arrays = Arrays::of(path, &document, &parts, "PolyData")?;
    let data = child(document.root_element(), "PolyData");
    let mut pieces = data.into_iter().flat_map(|data| data.children().filter(|piece| piece.has_tag_name("Piece")));
    let (Some(piece), None) = (pieces.next(), pieces.next()) else {
        return Err(Error::data(path, "Piece", "does not occur exactly once: only files of one piece are supported"));
    };
    let points = data_arrays(child(piece, "Points")).next().map_or(Ok(Vec::new()), |points| arrays.values(points))?;
    let (points, []) = points.as_chunks::<3>() else {
        return Err(Error::data(path, "Points", "do not have three numbers each"));
    };
    let sign = match stated_space(data, &arrays)?.as_deref() {
        None | Some("LPS") => 1.0,
        Some("RAS") => -1.0,
        Some(other) => {
            let problem = format!("`{other}` is not supported: LPS and RAS are");
            return Err(Error::data(path, "FieldData SPACE", problem));
        }
    };
    let points: Vec<[f64; 3]> = points.iter().map(|[x, y, z]| [sign * x, sign * y, *z]).collect();
    let of_lines = |name: &str| -> Result<Vec<f64>> {
        let mut found = data_arrays(child(piece, "Lines")).filter(|array| array.attribute("Name") == Some(name));
        found.next().map_or(Ok(Vec::new()), |array| arrays.values(array))
    };
    let lines = lines(&of_lines("connectivity")?, &of_lines("offsets")?, points.len());
    let mut of_points = Vec::new();
    for array in data_arrays(child(piece, "PointData")) {
        let single = array.attribute("NumberOfComponents").is_none_or(|n| n == "1");
        let name = array.attribute("Name").unwrap_or_default();
        if !single {
            continue;
        }
        let values = arrays.values(array)?;
        if values.len() != points.len() {
            let problem = format!("has {} values for {} points", values.len(), points.len());
            return Err(Error::data(path, format!("DataArray {name}"), problem));
        }
        of_points.push((name.to_owned(), values));
    }
    let lines = lines
        .ok_or_else(|| Error::data(path, "Lines", "refer to points that do not exist, or exceed their own list"))?;
    Ok(ReadLines { points, lines, of_points })
}

/// Returns the space of the points, which 3D Slicer states in the field data: `LPS` or `RAS`; none where a file states nothing.
fn stated_space(data: Option<Node<'_, '_>>, arrays: &Arrays<'_>) -> Result<Option<String>> {
    let fields = data.and_then(|data| child(data, "FieldData")).into_iter().flat_map(|fields| fields.children());
    let mut spaces = fields.filter(|array| array.attribute("Name") == Some("SPACE"));
    let Some(space) = spaces.next() else { return Ok(None) };
    let codes = arrays.values(space)?;
    Ok(Some(codes.iter().map(|code| *code as u8 as char).take_while(|letter| *letter != '\0').collect()))
}

/// Splits the point indices of all lines (`connectivity`) at the end of each line (`ends`); none if an index or an end is out
/// of range.
fn lines(connectivity: &[f64], ends: &[f64], n_points: usize) -> Option<Vec<Vec<usize>>> {
    let whole = |value: &f64| (*value >= 0.0 && value.fract() == 0.0).then_some(*value as usize);
    let mut start = 0;
    let line = |end: &f64| {
        let end = whole(end)?;
        let line = connectivity.get(start..end)?.iter().map(|point| whole(point).filter(|point| *point < n_points));
        start = end;
        line.collect()
    };
    ends.iter().map(line).collect()
}

/// Reads the list of files in a `.pvd`, in the order of their times.
///
/// # Errors
/// [`Error::Io`]; [`Error::Data`] for a file that is not a collection, and for two files with the same time.
pub fn read_collection(path: &Path) -> Result<Vec<PathBuf>> {
    let bytes = files::read_limited(path, MAX_FILE_BYTES)?;
    let parts = SplitFile::of(&bytes);
    let document = parsed(path, &parts.text)?;
    Arrays::of(path, &document, &parts, "Collection")?;
    let sets = child(document.root_element(), "Collection");
    let sets = sets.into_iter().flat_map(|all| all.children().filter(|set| set.has_tag_name("DataSet")));
    let mut files = Vec::new();
    for set in sets {
        let time = set.attribute("timestep").and_then(|time| time.parse::<f64>().ok()).filter(|time| time.is_finite());
        let (Some(time), Some(file)) = (time, set.attribute("file")) else {
            return Err(Error::data(path, "DataSet", "has no timestep or no file"));
        };
        files.push((time, path.with_file_name("").join(file)));
    }
    files.sort_by(|a, b| a.0.total_cmp(&b.0));
    match files.windows(2).find(|pair| pair[0].0 == pair[1].0) {
        Some(pair) => Err(Error::data(path, "timestep", format!("two files have the timestep {}", pair[0].0))),
        None if files.is_empty() => Err(Error::data(path, "Collection", "has no file")),
        None => Ok(files.into_iter().map(|(_, file)| file).collect()),
    }
}
