//! Quantities that pixels show.

use crate::choice::Choice;
use crate::model::component::Component;

/// How attenuation along a ray becomes a pixel.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Projection {
    /// The line integral: a digitally reconstructed radiograph.
    Drr,
    /// The largest attenuation per world unit along the ray.
    Mip,
}

impl Choice for Projection {
    const ALL: &'static [Projection] = &[Projection::Drr, Projection::Mip];

    fn name(self) -> &'static str {
        match self {
            Projection::Drr => "drr",
            Projection::Mip => "mip",
        }
    }
}

/// Quantity that the pixels of a view show.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct Quantity {
    /// Which fields are shown.
    pub component: Component,
    /// How the fields are projected.
    pub projection: Projection,
}
