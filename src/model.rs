//! A reconstruction: parameters with everything needed to evaluate them, independent of any dataset.

pub mod component;
pub mod field;
pub mod hull;
pub mod params;
pub mod scene;

use crate::config::Config;
use crate::gaussians::field::GaussianField;
use crate::geometry::CArm;
use crate::model::field::Field;
use crate::model::hull::Hull;
use crate::model::params::ParamMap;
use crate::model::scene::Scene;
use std::sync::Arc;

/// The fields at one moment of training.
#[derive(Debug, Clone)]
pub struct Model {
    /// Hyper-parameters of the run.
    pub config: Config,
    /// Scales and boxes.
    pub scene: Scene,
    /// Positions of the parameters in `params`.
    pub param_map: ParamMap,
    /// Motion hull, when the run uses one.
    pub hull: Option<Hull>,
    /// Gaussians, where they are the dynamic field; none where it is the network.
    pub gaussians: Option<GaussianField>,
    /// Field of a method with a module of its own ([`crate::methods`]); the model then has no other field.
    pub field: Option<Arc<dyn Field>>,
    /// Parameters, padded as [`ParamMap`] says.
    pub params: Vec<f32>,
    /// Iterations done.
    pub step: u32,
    /// Vessel attenuation per world unit, where the dataset states it.
    pub vessel_attenuation: Option<f64>,
    /// A C-arm like that of the training views, for rendering from other angles.
    pub c_arm: CArm,
    /// Columns and rows of the training images.
    pub image_size: [usize; 2],
}

impl Model {
    /// Number of phases to show: those of the beat, or only the first for an object at rest.
    pub fn shown_phases(&self) -> u32 {
        if self.scene.still { 1 } else { self.param_map.phases as u32 }
    }

    /// Tells whether the dynamic field has values between phases, as a network or one moving set of Gaussians has. Sets per
    /// phase and fields of methods with a module of their own have none.
    pub fn is_continuous(&self) -> bool {
        self.field.is_none() && self.gaussians.as_ref().is_none_or(|field| field.moving().is_some())
    }
}
