//! Interface of the settings of a method, and the declaration of the methods.

use crate::config::Method;
use crate::config::common::Train;
use crate::config::configuration::Shared;
use crate::config::fields::FieldSettings;
use crate::config::length::DRY_RUN;
use crate::config::section::Sections;
use crate::error::Result;

/// Share of a schedule's length that a run of another length has.
pub(crate) struct Scaled(pub(super) f64);

impl Scaled {
    /// Minimum number of iterations between two density controls of a shortened run: an iteration with density control learns
    /// nothing.
    const MIN_INTERVAL: u32 = 10;

    /// Changes a number of iterations to that of the run of another length.
    pub(super) fn apply(&self, iterations: &mut u32) {
        *iterations = (self.0 * f64::from(*iterations)).round() as u32;
    }

    /// Changes the number of iterations between two density controls to that of the run of another length; 0 stays 0.
    pub(super) fn apply_interval(&self, iterations: &mut u32) {
        if *iterations != 0 {
            self.apply(iterations);
            *iterations = (*iterations).max(Self::MIN_INTERVAL);
        }
    }
}

/// Settings of a method: the checks of their combinations, and the schedule.
pub(crate) trait MethodSettings: Sections {
    /// Returns the name of the method, for messages.
    fn name(&self) -> &'static str;

    /// Refuses settings that the method does not support, or that contradict each other.
    ///
    /// # Errors
    /// [`crate::error::Error::Config`] naming the key.
    fn check(&self, shared: &Shared<'_>) -> Result<()>;

    /// Returns the settings of fields that rays are marched through; none for a method without such fields.
    fn fields(&self, _shared: &Shared<'_>) -> Option<FieldSettings> {
        None
    }

    /// Changes the schedule to that of a run of another length.
    fn scale(&mut self, _scaled: &Scaled) {}

    /// Returns the iterations at which the method's own schedule changes something, in any order.
    fn events(&self) -> Vec<u32> {
        Vec::new()
    }

    /// Returns the iterations of a dry run.
    fn dry_run_length(&self) -> u32 {
        DRY_RUN
    }

    /// Makes room for events that the schedule of a dry run of so many `iterations` would leave out; the run has `whole` iterations.
    fn shorten(&mut self, _train: &mut Train, _iterations: u32, _whole: u32) {}

    /// Returns the number of iterations at the start of a run that fit Gaussians; the others fit a static field.
    fn gaussian_iterations(&self, _train: &Train) -> u32 {
        0
    }

    /// Returns the number of iterations of a fit of Gaussians, to change it; none for a method without Gaussians.
    fn gaussian_iterations_mut<'a>(&'a mut self, _train: &'a mut Train) -> Option<&'a mut u32> {
        None
    }

    /// Begins the network of the dynamic field after so many iterations.
    fn delay_network(&mut self, _iterations: u32) {}

    /// Tells whether pictures of the dynamic field are blended, from about 0 to 1, so that they show no attenuation.
    fn is_blended(&self) -> bool {
        false
    }

    /// Tells whether the dynamic field supports a displacement of the heart in each frame, and vessels that are known before.
    fn follows_breath(&self) -> bool {
        false
    }
}

/// Settings of a method by which a configuration of that method is found.
pub trait OfMethod: Clone {
    /// Returns the settings if they are of this method.
    fn of(method: &Method) -> Option<&Self>;
}

/// Declares the methods.
macro_rules! methods {
    ($($(#[$doc:meta])* $name:ident($settings:ident),)*) => {
        /// A method of reconstruction with its settings.
        #[derive(Debug, Clone, PartialEq)]
        pub enum Method {
            $($(#[$doc])* $name($settings),)*
        }

        impl Method {
            pub(crate) fn settings(&self) -> &dyn $crate::config::method::MethodSettings {
                match self {
                    $(Method::$name(settings) => settings,)*
                }
            }

            pub(crate) fn settings_mut(&mut self) -> &mut dyn $crate::config::method::MethodSettings {
                match self {
                    $(Method::$name(settings) => settings,)*
                }
            }

            /// Reads the settings of the same method from a table.
            pub(crate) fn read_alike(&self, table: &toml::Table) -> $crate::error::Result<Method> {
                Ok(match self {
                    $(Method::$name(_) => Method::$name($crate::config::section::Sections::read(table)?),)*
                })
            }
        }

        $(
            impl From<$settings> for Method {
                fn from(settings: $settings) -> Method {
                    Method::$name(settings)
                }
            }

            impl $crate::config::method::OfMethod for $settings {
                fn of(method: &Method) -> Option<&$settings> {
                    match method {
                        Method::$name(settings) => Some(settings),
                        _ => None,
                    }
                }
            }
        )*
    };
}

pub(super) use methods;
