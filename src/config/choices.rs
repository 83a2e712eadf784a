//! Choices of a configuration by name: data of a fit, regions of losses, corrections.

use serde::{Deserialize, Serialize};
use strum::{IntoStaticStr, VariantArray};

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

/// Course of a learning rate from its start value to its end value.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Decay {
    /// A straight line that ends with the run.
    Linear,
    /// A constant factor per iteration, chosen so that the rate reaches its end value with the end of the run.
    Exponential,
}

/// Images of a moving object to which a static method is fitted.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, IntoStaticStr, VariantArray)]
#[serde(rename_all = "kebab-case")]
#[strum(serialize_all = "kebab-case")]
pub enum StaticData {
    /// A set of parameters for each phase, fitted to the images of that phase.
    PerPhase,
    /// One set of parameters, fitted to all images and rendered at every phase.
    Pooled,
}

/// Initial positions of the Gaussians in a fit of R2-Gaussian.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, IntoStaticStr, VariantArray)]
#[serde(rename_all = "kebab-case")]
#[strum(serialize_all = "kebab-case")]
pub enum R2Start {
    /// Voxels of a filtered back-projection.
    Fdk,
    /// Random positions in the volume.
    Random,
}

/// Line integral of one Gaussian at a pixel, for R2-Gaussian.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, IntoStaticStr, VariantArray)]
#[serde(rename_all = "kebab-case")]
#[strum(serialize_all = "kebab-case")]
pub enum R2Integral {
    /// The line integral of the Gaussian under a projection linearised around its centre, as published.
    #[default]
    Affine,
    /// The line integral along the pixel's own ray.
    Exact,
}

/// Adjustment of the calibrated geometry with the field in the loop.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, IntoStaticStr, VariantArray)]
#[serde(rename_all = "kebab-case")]
#[strum(serialize_all = "kebab-case")]
pub enum AdjustMode {
    /// Adjustment where calibration is automatic and the field of a fit does not explain the images, if it explains them clearly
    /// better afterwards.
    Auto,
    /// No adjustment.
    #[default]
    Off,
}

/// Data that the dynamic field is fitted to.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum DynamicTarget {
    /// The shared residual of both fields (paper).
    Absolute,
    /// The line integral minus that of the pixel's static background; everything that does not move cancels.
    Temporal,
}
