//! Pictures of Gaussians of which nearer ones hide those behind them: alpha blending from front to back (Kerbl et al. 2023), with an
//! intensity in place of a colour. Other Gaussians have line integrals, which add up.

pub mod opacity;
pub mod particles;
pub mod picture;
pub mod stages;

/// Bits behind the point of pictures.
pub const FIXED_POINT_BITS: i32 = 22;
/// Depth up to which nothing is seen, mm.
pub const NEAREST_MM: f64 = 0.2;
/// Pixels along each side of a tile.
pub const TILE: u32 = 16;
