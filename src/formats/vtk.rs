//! Legacy `.vtk` structured points, which ParaView groups by the numbers in their names.

use crate::formats::volume::VolumeHeader;

/// The header of a file of big-endian floats, one phase, that is written piece by piece.
pub fn header_of(h: &VolumeHeader, phase: u32) -> Vec<u8> {
    let VolumeHeader { origin_mm: o, spacing_mm: s, size: [nx, ny, nz], quantity, .. } = h;
    let points: usize = h.size.iter().map(|n| *n as usize).product();
    format!(
        "# vtk DataFile Version 3.0\n{quantity}, LPS mm, phase {phase}\nBINARY\n\
         DATASET STRUCTURED_POINTS\nDIMENSIONS {nx} {ny} {nz}\nORIGIN {} {} {}\nSPACING {} {} {}\n\
         POINT_DATA {points}\nSCALARS attenuation float 1\nLOOKUP_TABLE default\n",
        o.x, o.y, o.z, s.x, s.y, s.z
    )
    .into_bytes()
}
