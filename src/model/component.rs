//! Which of a model's fields.

use crate::choice::Choice;

/// The fields of a model that something is about.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Component {
    /// The sum of both fields.
    Total,
    /// The still background.
    Static,
    /// The moving vessels.
    Dynamic,
}

impl Component {
    /// The single fields it is made of.
    pub fn fields(self) -> &'static [Component] {
        match self {
            Component::Total => &[Component::Dynamic, Component::Static],
            Component::Static => &[Component::Static],
            Component::Dynamic => &[Component::Dynamic],
        }
    }

    /// Whether the still background is part of it.
    pub fn has_static(self) -> bool {
        self != Component::Dynamic
    }

    /// Whether the moving vessels are part of it.
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
