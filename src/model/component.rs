//! Selection among a model's fields.

use strum::{IntoStaticStr, VariantArray};

/// Selection among the fields of a model.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, IntoStaticStr, VariantArray)]
#[strum(serialize_all = "kebab-case")]
pub enum Component {
    /// The sum of both fields.
    Total,
    /// The static field.
    Static,
    /// The dynamic field.
    Dynamic,
}

impl Component {
    /// Returns the single fields of the selection.
    pub fn fields(self) -> &'static [Component] {
        match self {
            Component::Total => &[Component::Dynamic, Component::Static],
            Component::Static => &[Component::Static],
            Component::Dynamic => &[Component::Dynamic],
        }
    }

    /// Tells whether the static field is part of the selection.
    pub fn has_static(self) -> bool {
        self != Component::Dynamic
    }

    /// Tells whether the dynamic field is part of the selection.
    pub fn has_dynamic(self) -> bool {
        self != Component::Static
    }
}
