//! Choices about the fields: their representation, and the regions in which they are penalised.

use crate::choice::Choice;
use serde::{Deserialize, Serialize};

/// Representation of the dynamic field where it does not consist of Gaussians.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum DynamicForm {
    /// A network on encoded coordinates and latents.
    #[default]
    Network,
    /// A hash grid and a Lineformer as SAX-NeRF fits them to whole images, for each phase or for all phases, without a static
    /// field.
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

/// Region of the rays in which occlusion minimisation penalises the dynamic field.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum OcclusionRegion {
    /// Depths within the stated share of the depth range, counted from the source.
    #[default]
    DepthRange,
    /// Samples whose path length from the first depth, their own included, is less than the stated share of the path length of
    /// the batch's last ray, as NerT-CA's public code has it (`compute_occl_loss`).
    LastRay,
}

impl Choice for OcclusionRegion {
    const ALL: &'static [OcclusionRegion] = &[OcclusionRegion::DepthRange, OcclusionRegion::LastRay];

    fn name(self) -> &'static str {
        match self {
            OcclusionRegion::DepthRange => "depth-range",
            OcclusionRegion::LastRay => "last-ray",
        }
    }
}
