//! VTK's XML poly data (`.vtp`): lines with values at points and lines, and collections of such files over time (`.pvd`).
//! As text: centrelines are small, and every reader of VTK's formats takes it. By hand: vtkio brings a parser and three
//! compressions, none of which a few arrays need.

use std::fmt::{Display, Write};

/// Values by a name, one per point or line.
pub enum Values {
    /// Numbers.
    Float(&'static str, Vec<f64>),
    /// Whole numbers.
    Int(&'static str, Vec<i64>),
}

/// Open lines through points.
pub struct Lines {
    /// What the lines are, for a comment; without `--`.
    pub title: String,
    /// When they are so.
    pub time: f64,
    /// Points of all lines.
    pub points: Vec<[f64; 3]>,
    /// How many points each line has; lines follow each other in `points`.
    pub counts: Vec<usize>,
    /// What points have.
    pub of_points: Vec<Values>,
    /// What lines have.
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
    /// Text of a `.vtp` file with the lines.
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

/// Text as it may stand in an attribute.
fn escaped(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('"', "&quot;")
}

/// A collection of files beside it, each with its time.
pub fn collection(files: &[(f64, String)]) -> String {
    let entry = |(time, file): &(f64, String)| format!("<DataSet timestep=\"{time}\" file=\"{}\"/>\n", escaped(file));
    let entries: String = files.iter().map(entry).collect();
    format!(
        "<?xml version=\"1.0\"?>\n<VTKFile type=\"Collection\" version=\"1.0\" byte_order=\"LittleEndian\">\n\
         <Collection>\n{entries}</Collection>\n</VTKFile>\n"
    )
}
