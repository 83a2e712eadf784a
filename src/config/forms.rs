//! Choices about the fields: their representation, and the regions in which they are penalised.

use serde::{Deserialize, Serialize};
use strum::{IntoStaticStr, VariantArray};

/// Representation of the dynamic field where it does not consist of Gaussians.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, IntoStaticStr, VariantArray)]
#[serde(rename_all = "kebab-case")]
#[strum(serialize_all = "kebab-case")]
pub enum DynamicForm {
    /// A network on encoded coordinates and latents.
    #[default]
    Network,
    /// A hash grid and a Lineformer as SAX-NeRF fits them to whole images, for each phase or for all phases, without a static
    /// field.
    Lineformer,
}

/// Region of the rays in which occlusion minimisation penalises the dynamic field.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, IntoStaticStr, VariantArray)]
#[serde(rename_all = "kebab-case")]
#[strum(serialize_all = "kebab-case")]
pub enum OcclusionRegion {
    /// Depths within the stated share of the depth range, counted from the source.
    #[default]
    DepthRange,
    /// Samples whose path length from the first depth, their own included, is less than the stated share of the path length of
    /// the batch's last ray, as NerT-CA's public code has it (`compute_occl_loss`).
    LastRay,
}
