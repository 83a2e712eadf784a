//! SWC: points with radii, each linked to the one it comes from; what neuron and vessel tracing tools exchange.

use std::fmt::Write;

/// A point of a tree.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Point {
    /// Place of the point.
    pub position: [f64; 3],
    /// Radius there.
    pub radius: f64,
    /// The point it comes from, by its place among the points, always before its own; none for a root.
    pub parent: Option<usize>,
}

/// Points as a file whose first line is a comment. Their kind is 0, "undefined": the format knows parts of neurons alone.
pub fn to_swc(comment: &str, points: &[Point]) -> String {
    let mut text = format!("# {comment}\n# number kind x y z radius parent\n");
    for (index, Point { position: [x, y, z], radius, parent }) in points.iter().enumerate() {
        // Numbers begin at 1, and -1 is no parent.
        let parent = parent.map_or(-1, |parent| parent as i64 + 1);
        // Writing to a string does not fail.
        let _ = writeln!(text, "{} 0 {x} {y} {z} {radius} {parent}", index + 1);
    }
    text
}
