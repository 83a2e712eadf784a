//! Selection among a model's fields.

use crate::choice::Choice;

/// Selection among the fields of a model.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
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

impl Choice for Component {
    const ALL: &'static [Component] = &[Component::Total, Component::Static, Component::Dynamic];

    fn name(self) -> &'static str {
        match self {
            Component::Total => "total",
            Component::Static => "static",
            Component::Dynamic => "dynamic",
        }
    }
}
