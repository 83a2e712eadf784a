//! Prepares a run from a dataset and a configuration: the method chooses scales and boxes and collects its data. Pure host code.

use crate::config::Config;
use crate::error::{Error, Result};
use crate::fitting::fit::{FitData, PlannedFit};
use crate::methods;
use crate::model::hull::Hull;
use crate::model::params::ParamMap;
use crate::model::scene::Scene;
use crate::scan::dataset::Dataset;
use std::any::Any;

/// Maximum number of training pixels, which shaders number in 32 bits with two bits to spare.
const MAX_PIXELS: usize = 1 << 30;

/// Prepared run, ready to start.
pub struct Plan {
    /// Configuration that it came from.
    pub config: Config,
    /// Scales and boxes.
    pub scene: Scene,
    /// Location of each parameter.
    pub params: ParamMap,
    /// Motion hull, if it is used.
    pub hull: Option<Hull>,
    /// Weighted loss of an empty dynamic field, where it is known.
    pub empty_loss: Option<f64>,
    /// Smallest and largest line integral of the training images.
    pub image_range: [f32; 2],
    /// Decisions that the user should know.
    pub notes: Vec<String>,
    /// Data of the fit; a trainer takes them.
    pub(crate) data: Option<Box<dyn FitData>>,
}

impl Plan {
    /// Prepares a run.
    ///
    /// # Errors
    /// [`Error::Config`] when the dataset and the configuration do not fit.
    pub fn new(config: &Config, dataset: &Dataset) -> Result<Plan> {
        let n_pixels = dataset.training().len() * dataset.n_pixels();
        if n_pixels > MAX_PIXELS {
            return Err(Error::config("dataset", n_pixels, "at most 2^30 training pixels are supported"));
        }
        let mut notes = Vec::new();
        let PlannedFit { scene, hull, empty_loss, data } = (methods::of(config).plan)(config, dataset, &mut notes)?;
        let values = dataset.training().iter().flat_map(|frame| &frame.integrals);
        let range = |[low, high]: [f32; 2], value: &f32| [low.min(*value), high.max(*value)];
        Ok(Plan {
            config: config.clone(),
            scene,
            params: ParamMap::new(config, dataset.n_phases as usize),
            hull,
            empty_loss,
            image_range: values.fold([f32::INFINITY, f32::NEG_INFINITY], range),
            notes,
            data: Some(data),
        })
    }

    /// Returns the number of fits whose mean the field of a configuration is, for the data of this plan.
    pub fn fits(&self, config: &Config) -> u32 {
        let repeats = methods::of(config).abilities.repeat_fits;
        repeats.zip(self.data.as_ref()).map_or(1, |(repeats, data)| (repeats.count)(&**data, config))
    }

    /// Returns this plan in a known scene, for example when resuming.
    pub fn in_scene(mut self, scene: Scene) -> Plan {
        if let Some(data) = &mut self.data {
            data.set_scene(&scene);
        }
        Plan { scene, ..self }
    }

    /// Returns the data of the fit as the type of their method, for tests and measurements.
    ///
    /// # Errors
    /// [`Error::Internal`] for data of another method.
    pub fn data<T: Any>(&self) -> Result<&T> {
        let data: Option<&dyn Any> = self.data.as_deref().map(|data| data as &dyn Any);
        data.and_then(|data| data.downcast_ref()).ok_or_else(other_method)
    }

    /// Returns the data of the fit as the type of their method, to change them.
    ///
    /// # Errors
    /// [`Error::Internal`] for data of another method.
    pub fn data_mut<T: Any>(&mut self) -> Result<&mut T> {
        let data: Option<&mut dyn Any> = self.data.as_deref_mut().map(|data| data as &mut dyn Any);
        data.and_then(|data| data.downcast_mut()).ok_or_else(other_method)
    }
}

fn other_method() -> Error {
    Error::Internal("the data of the fit are those of another method, or a fit has begun with them".into())
}
