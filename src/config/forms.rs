//! What a field may be made of.

use crate::choice::Choice;
use serde::{Deserialize, Serialize};

/// What the dynamic field is where no Gaussians are.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum DynamicForm {
    /// A network on encoded coordinates and latents.
    #[default]
    Network,
    /// A hash grid and a Lineformer as SAX-NeRF fits them to whole images, for each phase or for all: no still field
    /// beside them.
    Lineformer,
}

impl Choice for DynamicForm {
    const ALL: &'static [DynamicForm] = &[DynamicForm::Network, DynamicForm::Lineformer];

    fn name(self) -> &'static str {
        match self {
            DynamicForm::Network => "network",
            DynamicForm::Lineformer => "lineformer",
        }
    }
}
