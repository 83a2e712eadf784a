//! Quantities that pixels show.

use crate::model::component::Component;
use strum::{IntoStaticStr, VariantArray};

/// How attenuation along a ray becomes a pixel.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, IntoStaticStr, VariantArray)]
#[strum(serialize_all = "kebab-case")]
pub enum Projection {
    /// The line integral: a digitally reconstructed radiograph.
    Drr,
    /// The largest attenuation per world unit along the ray.
    Mip,
}

/// Quantity that the pixels of a view show.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct Quantity {
    /// Which fields are shown.
    pub component: Component,
    /// How the fields are projected.
    pub projection: Projection,
}

/// Parts of a rendering that are wanted; the rest is undefined.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub(super) struct RenderedParts {
    /// The static field.
    pub(super) static_field: bool,
    /// Maxima along rays.
    pub(super) maxima: bool,
}
