//! The declaration of a section of a configuration, with the ranges of its numbers.

use crate::config::renamed;
use crate::error::{Error, Result};

/// Declares a section; `in LOW to HIGH` after a number's type is the range that [`Config::check`](super::Config::check)
/// accepts.
macro_rules! section {
    ($(#[$about:meta])* $name:ident, $prefix:literal {
        $($(#[$doc:meta])* $field:ident: $ty:ident $(in $low:literal to $high:literal)?,)*
    }) => {
        $(#[$about])*
        #[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
        #[serde(deny_unknown_fields)]
        pub struct $name {
            $($(#[$doc])* pub $field: $ty,)*
        }

        impl $name {
            pub(super) fn check_ranges(&self) -> $crate::error::Result<()> {
                $($($crate::config::section::check_range(concat!($prefix, ".", stringify!($field)), f64::from(self.$field), $low, $high)?;)?)*
                Ok(())
            }
        }
    };
}

pub(super) fn check_range(field: &str, value: f64, low: f64, high: f64) -> Result<()> {
    // A value that is not a number (NaN) is in no range.
    if value >= low && value <= high {
        return Ok(());
    }
    Err(Error::config(renamed::current(field), value, format!("is not in the accepted range, {low} to {high}")))
}

pub(super) use section;
