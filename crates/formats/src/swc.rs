//! SWC files: points with radii, each linked to its parent; an exchange format of neuron and vessel tracing tools.

use std::fmt::Write;

/// A point of a tree.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Point {
    /// Position of the point.
    pub position: [f64; 3],
    /// Radius at the point.
    pub radius: f64,
    /// Index of the parent point, always smaller than the point's own index; none for a root.
    pub parent: Option<usize>,
}

/// Formats points as a file whose first line is a comment. Their kind is 0, "undefined", because the format defines kinds for
/// parts of neurons only.
pub fn to_swc(comment: &str, points: &[Point]) -> String {
    let mut text = format!("# {comment}\n# number kind x y z radius parent\n");
    for (index, Point { position: [x, y, z], radius, parent }) in points.iter().enumerate() {
        // Numbers begin at 1; -1 means that there is no parent.
        let parent = parent.map_or(-1, |parent| parent as i64 + 1);
        // Writing to a string does not fail.
        let _ = writeln!(text, "{} 0 {x} {y} {z} {radius} {parent}", index + 1);
    }
    text
}
