//! The configuration of a run.

use crate::calibrate::settings::CalibrateSettings;
use crate::choice::Choice;
use crate::config::choices::DynamicTarget;
use crate::config::common::{Calibrate, Render, Train};
use crate::config::fields::FieldSettings;
use crate::config::method::OfMethod;
use crate::config::section::Sections;
use crate::config::{Method, Preset};
use crate::error::{Error, Result};
use std::ops::{Deref, DerefMut};

/// All settings of a run of a method; of any method without a type. The settings of the method read like fields of the configuration.
#[derive(Debug, Clone, PartialEq)]
pub struct Config<M = Method> {
    /// Preset that the defaults came from.
    pub preset: Preset,
    /// Seed of initialisation, ray order and depths.
    pub seed: u32,
    /// The training loop.
    pub train: Train,
    /// Self-calibration of the views.
    pub calibrate: Calibrate,
    /// Rendering.
    pub render: Render,
    /// The method, with its settings.
    pub method: M,
}

/// Settings that all methods share, for a method.
pub(crate) struct Shared<'a> {
    /// Seed of initialisation, ray order and depths.
    pub(crate) seed: u32,
    /// The training loop.
    pub(crate) train: &'a Train,
    /// Rendering.
    pub(crate) render: &'a Render,
}

impl<M: OfMethod> Deref for Config<M> {
    type Target = M;

    fn deref(&self) -> &M {
        &self.method
    }
}

impl<M: OfMethod> DerefMut for Config<M> {
    fn deref_mut(&mut self) -> &mut M {
        &mut self.method
    }
}

impl<M: OfMethod + Into<Method>> Config<M> {
    /// Returns this configuration where a configuration of any method is needed.
    pub fn into_any(self) -> Config {
        let Config { preset, seed, train, calibrate, render, method } = self;
        Config { preset, seed, train, calibrate, render, method: method.into() }
    }
}

impl<M> Config<M> {
    fn shared(&self) -> Shared<'_> {
        Shared { seed: self.seed, train: &self.train, render: &self.render }
    }
}

impl Config {
    /// Returns this configuration as one of a method.
    ///
    /// # Errors
    /// [`Error::Internal`] for a configuration of another method.
    pub fn of<M: OfMethod>(&self) -> Result<Config<M>> {
        let method = M::of(&self.method).ok_or_else(|| {
            Error::Internal(format!("a configuration of {} was given to another method", self.method_name()))
        })?;
        let Config { preset, seed, train, calibrate, render, .. } = self.clone();
        Ok(Config { preset, seed, train, calibrate, render, method: method.clone() })
    }

    /// Returns the settings of fields that rays are marched through; none for a method without such fields.
    pub fn fields(&self) -> Option<FieldSettings> {
        self.method.settings().fields(&self.shared())
    }

    /// Refuses values no run could use.
    ///
    /// # Errors
    /// [`Error::Config`] naming the key.
    pub fn check(&self) -> Result<()> {
        Sections::check_ranges(&self.train)?;
        Sections::check_ranges(&self.calibrate)?;
        Sections::check_ranges(&self.render)?;
        self.method.settings().check_ranges()?;
        self.method.settings().check(&self.shared())
    }

    /// Returns the name of the method, for messages.
    pub fn method_name(&self) -> &'static str {
        self.method.settings().name()
    }

    /// Tells whether two configurations are of the same method.
    pub fn is_alike(&self, other: &Config) -> bool {
        std::mem::discriminant(&self.method) == std::mem::discriminant(&other.method)
    }

    /// Tells whether the dynamic field is a network on encoded coordinates.
    pub fn has_network(&self) -> bool {
        self.fields().is_some_and(|fields| fields.network.is_some())
    }

    /// Tells whether pictures of the dynamic field are blended, from about 0 to 1, so that they show no attenuation.
    pub fn is_blended(&self) -> bool {
        self.method.settings().is_blended()
    }

    /// Tells whether the dynamic field is found by what changes over the beat, so that a view needs two phases.
    pub fn is_temporal(&self) -> bool {
        self.fields().is_some_and(|fields| fields.loss.dynamic_target == DynamicTarget::Temporal)
    }

    /// Tells whether the dynamic field supports a displacement of the heart in each frame; methods fitted to whole images do
    /// not.
    pub fn follows_breath(&self) -> bool {
        self.method.settings().follows_breath()
    }

    /// Returns the settings of the calibration before the fit.
    pub fn calibration(&self) -> CalibrateSettings {
        CalibrateSettings { mode: self.calibrate.mode, follows_breath: self.follows_breath() }
    }

    /// Checks that the method uses vessels that are known before; `field` and `value` tell where they come from.
    ///
    /// # Errors
    /// [`Error::Config`].
    pub fn takes_prior(&self, field: &str, value: &str) -> Result<()> {
        if self.follows_breath() {
            return Ok(());
        }
        let problem = format!("is used by the preset `fast` only, and the preset is `{}`", self.preset.name());
        Err(Error::config(field, value, problem))
    }

    /// Returns the number of iterations at the start of the run that fit Gaussians; the others fit the static field.
    pub fn gaussian_iterations(&self) -> u32 {
        self.method.settings().gaussian_iterations(&self.train)
    }

    /// Returns the number of iterations of a fit of Gaussians, to change it; none for a method without Gaussians.
    pub fn gaussian_iterations_mut(&mut self) -> Option<&mut u32> {
        self.method.settings_mut().gaussian_iterations_mut(&mut self.train)
    }

    /// Begins the network of the dynamic field after so many iterations, where a method can do so.
    pub fn delay_network(&mut self, iterations: u32) {
        self.method.settings_mut().delay_network(iterations);
    }
}
