//! Gaussians as PLY in the layout of 3D Gaussian Splatting (Kerbl et al. 2023), which splat viewers read.

use std::fmt::Write as _;

/// Value of the spherical harmonic of degree 0.
const HARMONIC_0: f32 = 0.282_094_8;
/// Names of the values of a Gaussian, in their order.
const PROPERTIES: [&str; 17] = [
    "x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1", "scale_2", "rot_0",
    "rot_1", "rot_2", "rot_3",
];

/// A Gaussian that a splat viewer draws.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Splat {
    /// Centre, mm.
    pub position_mm: [f32; 3],
    /// Standard deviations along its own axes, mm.
    pub deviations_mm: [f32; 3],
    /// Unit quaternion (w, x, y, z) that turns its own axes into those of the position.
    pub rotation: [f32; 4],
    /// Opacity at its centre, above 0 and below 1.
    pub opacity: f32,
    /// Colour (red, green, blue), 0 to 1.
    pub colour: [f32; 3],
}

impl Splat {
    /// Returns the values of the file.
    fn values(&self) -> [f32; 17] {
        let Splat { position_mm: [x, y, z], deviations_mm, rotation: [w, i, j, k], opacity, colour } = *self;
        let [red, green, blue] = colour.map(|value| (value - 0.5) / HARMONIC_0);
        let [a, b, c] = deviations_mm.map(f32::ln);
        let logit = (opacity / (1.0 - opacity)).ln();
        [x, y, z, 0.0, 0.0, 0.0, red, green, blue, logit, a, b, c, w, i, j, k]
    }
}

/// Returns Gaussians as a binary PLY; `comments` are lines of its header.
pub fn to_ply(splats: &[Splat], comments: &[&str]) -> Vec<u8> {
    let mut header = "ply\nformat binary_little_endian 1.0\n".to_owned();
    // Writing to a string cannot fail.
    let _ = comments.iter().try_for_each(|comment| writeln!(header, "comment {comment}"));
    let _ = writeln!(header, "element vertex {}", splats.len());
    let _ = PROPERTIES.iter().try_for_each(|name| writeln!(header, "property float {name}"));
    header.push_str("end_header\n");
    let mut out = header.into_bytes();
    out.extend(splats.iter().flat_map(Splat::values).flat_map(f32::to_le_bytes));
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn values_are_as_viewers_undo_them() {
        let splat = Splat {
            position_mm: [1.0, -2.0, 3.0],
            deviations_mm: [0.5, 1.0, 2.0],
            rotation: [1.0, 0.0, 0.0, 0.0],
            opacity: 0.8,
            colour: [0.9, 0.5, 0.1],
        };
        let bytes = to_ply(&[splat, splat], &["LPS mm"]);
        let end = b"end_header\n";
        let body = bytes.windows(end.len()).position(|part| part == end).unwrap() + end.len();
        assert!(bytes.starts_with(b"ply\nformat binary_little_endian 1.0\ncomment LPS mm\nelement vertex 2\n"));
        assert_eq!(bytes.len() - body, 2 * 17 * 4);
        let value = |i: usize| f32::from_le_bytes(bytes[body + 4 * i..][..4].try_into().unwrap());
        assert_eq!([0, 1, 2].map(value), splat.position_mm);
        assert!((1.0 / (1.0 + (-value(9)).exp()) - 0.8).abs() < 1e-6, "the opacity is behind a sigmoid");
        assert!((value(12).exp() - 2.0).abs() < 1e-6, "deviations are logarithms");
        assert!((0.5 + HARMONIC_0 * value(6) - 0.9).abs() < 1e-6, "the colour is that of a constant harmonic");
    }
}
