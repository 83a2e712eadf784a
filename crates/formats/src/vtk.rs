//! Legacy `.vtk` files with structured points, which ParaView groups by the numbers in their names, or lines. Floats are
//! big-endian.

use crate::raw::{self, ByteOrder};
use crate::volume::VolumeHeader;
use std::io::{Result, Write};

/// Header of a grid with `title`, up to the point data.
fn grid_of(h: &VolumeHeader, title: &str) -> String {
    let VolumeHeader { origin_mm: o, spacing_mm: s, size: [nx, ny, nz], .. } = h;
    let points: usize = h.size.iter().map(|n| *n as usize).product();
    format!(
        "# vtk DataFile Version 3.0\n{title}\nBINARY\n\
         DATASET STRUCTURED_POINTS\nDIMENSIONS {nx} {ny} {nz}\nORIGIN {} {} {}\nSPACING {} {} {}\n\
         POINT_DATA {points}\n",
        o.x, o.y, o.z, s.x, s.y, s.z
    )
}

/// Returns the header of a file of big-endian floats at one phase, whose values are then written in pieces.
pub fn header_of(h: &VolumeHeader, phase: u32) -> Vec<u8> {
    let grid = grid_of(h, &format!("{}, LPS mm, phase {phase}", h.quantity));
    format!("{grid}SCALARS attenuation float 1\nLOOKUP_TABLE default\n").into_bytes()
}

/// Returns the header of a file of vectors called `name`, with three big-endian floats per point at one phase; the values are
/// then written in pieces. `title` has a line of its own.
pub fn vector_header_of(h: &VolumeHeader, name: &str, title: &str) -> Vec<u8> {
    format!("{}VECTORS {name} float\n", grid_of(h, title)).into_bytes()
}

/// Values at every point of [`Lines`].
pub struct PointValues {
    /// Name of the values, without blanks.
    pub name: &'static str,
    /// Number of values per point, 1 to 4.
    pub width: usize,
    /// Values, point by point.
    pub values: Vec<f32>,
}

/// Closed lines with the same number of points each.
pub struct Lines {
    /// Title of the data, in one line.
    pub title: String,
    /// Number of points of each line.
    pub points_per_line: usize,
    /// Points of all lines in order, LPS mm.
    pub points: Vec<[f32; 3]>,
    /// Values at the points.
    pub values: Vec<PointValues>,
}

impl Lines {
    /// Writes the lines as poly data.
    ///
    /// # Errors
    /// Errors of `out`.
    pub fn write(&self, out: &mut impl Write) -> Result<()> {
        let (n, each) = (self.points.len(), self.points_per_line.max(1));
        let n_lines = n / each;
        let title = &self.title;
        write!(out, "# vtk DataFile Version 3.0\n{title}\nBINARY\nDATASET POLYDATA\nPOINTS {n} float\n")?;
        raw::write_floats(&mut *out, self.points.as_flattened(), ByteOrder::Big)?;
        // A line is stored as its number of points and their indices; the first index is repeated to close the line.
        write!(out, "\nLINES {n_lines} {}\n", n_lines * (each + 2))?;
        for first in (0..n).step_by(each) {
            let places = (first..first + each).chain([first]);
            for word in [each + 1].into_iter().chain(places) {
                out.write_all(&(word as u32).to_be_bytes())?;
            }
        }
        write!(out, "\nPOINT_DATA {n}\n")?;
        for PointValues { name, width, values } in &self.values {
            write!(out, "SCALARS {name} float {width}\nLOOKUP_TABLE default\n")?;
            raw::write_floats(&mut *out, values, ByteOrder::Big)?;
            writeln!(out)?;
        }
        Ok(())
    }
}
