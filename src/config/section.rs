//! Declaration of the sections of a configuration, with the ranges of their numbers.

use crate::error::{Error, Result};
use serde::Serialize;
use serde::de::DeserializeOwned;
use toml::{Table, Value};

/// Values under one heading of a configuration file.
pub trait Section: Serialize + DeserializeOwned {
    /// Heading in a file. Several sections of a method may have the same heading.
    const NAME: &'static str;
    /// Names of the values that a user may change.
    const KEYS: &'static [&'static str];

    /// Refuses numbers outside of their ranges.
    ///
    /// # Errors
    /// [`Error::Config`] naming the key.
    fn check_ranges(&self) -> Result<()>;
}

/// Sections of which a configuration consists: one, or several.
pub trait Sections {
    /// Writes all values into a table.
    ///
    /// # Errors
    /// [`Error::Internal`] for a value that TOML does not have.
    fn write(&self, table: &mut Table) -> Result<()>;

    /// Reads all values from a table, which may contain others.
    ///
    /// # Errors
    /// [`Error::Config`] naming the section.
    fn read(table: &Table) -> Result<Self>
    where
        Self: Sized;

    /// Tells whether a user may change the value of a key such as `train.iterations`.
    fn is_key(&self, key: &str) -> bool;

    /// Refuses numbers outside of their ranges.
    ///
    /// # Errors
    /// [`Error::Config`] naming the key.
    fn check_ranges(&self) -> Result<()>;
}

impl<S: Section> Sections for S {
    fn write(&self, table: &mut Table) -> Result<()> {
        let values = Table::try_from(self).map_err(|e| Error::Internal(e.to_string()))?;
        let section = table.entry(S::NAME).or_insert_with(|| Value::Table(Table::new()));
        section.as_table_mut().into_iter().for_each(|section| section.extend(values.clone()));
        Ok(())
    }

    fn read(table: &Table) -> Result<S> {
        // Older files lack some sections; each of their values then has the default that it was given when it was added.
        let values = table.get(S::NAME).cloned().unwrap_or_else(|| Value::Table(Table::new()));
        values.try_into().map_err(|e| Error::config("section", S::NAME, e.message().to_owned()))
    }

    fn is_key(&self, key: &str) -> bool {
        key.split_once('.').is_some_and(|(section, name)| section == S::NAME && S::KEYS.contains(&name))
    }

    fn check_ranges(&self) -> Result<()> {
        Section::check_ranges(self)
    }
}

/// Declares a section. `in LOW to HIGH` after a number's type is the range that [`Config::check`](super::Config::check) accepts;
/// `= "name"` after a field is its name in files. Fields in `fixed` are no keys of users: presets of one method differ in them, the
/// model depends on them, or tests change them. They are recorded with the others.
macro_rules! section {
    ($(#[$about:meta])* $name:ident, $section:literal {
        $($(#[$doc:meta])* $field:ident $(= $toml:literal)?: $ty:ident $(in $low:literal to $high:literal)?,)*
    } $(fixed {
        $($(#[$fixed_doc:meta])* $fixed:ident $(= $fixed_toml:literal)?: $fixed_ty:ident
            $(in $fixed_low:literal to $fixed_high:literal)?,)*
    })?) => {
        $(#[$about])*
        #[derive(Debug, Clone, PartialEq, serde::Serialize, serde::Deserialize)]
        pub struct $name {
            $($(#[$doc])* $(#[serde(rename = $toml)])? pub $field: $ty,)*
            $($($(#[$fixed_doc])* $(#[serde(rename = $fixed_toml)])? pub $fixed: $fixed_ty,)*)?
        }

        impl $crate::config::section::Section for $name {
            const NAME: &'static str = $section;
            const KEYS: &'static [&'static str] = &[$($crate::config::section::toml_name!($field $($toml)?),)*];

            fn check_ranges(&self) -> $crate::error::Result<()> {
                $({
                    let _name = $crate::config::section::toml_name!($field $($toml)?);
                    $($crate::config::section::check_range($section, _name, f64::from(self.$field), $low, $high)?;)?
                })*
                $($({
                    let _name = $crate::config::section::toml_name!($fixed $($fixed_toml)?);
                    $($crate::config::section::check_range(
                        $section,
                        _name,
                        f64::from(self.$fixed),
                        $fixed_low,
                        $fixed_high,
                    )?;)?
                })*)?
                Ok(())
            }
        }
    };
}

/// Returns the name of a field in files.
macro_rules! toml_name {
    ($field:ident) => {
        stringify!($field)
    };
    ($field:ident $toml:literal) => {
        $toml
    };
}

/// Declares a struct of several sections.
macro_rules! sections {
    ($(#[$about:meta])* $name:ident { $($(#[$doc:meta])* $field:ident: $section:ty,)* }) => {
        $(#[$about])*
        #[derive(Debug, Clone, PartialEq)]
        pub struct $name {
            $($(#[$doc])* pub $field: $section,)*
        }

        impl $crate::config::section::Sections for $name {
            fn write(&self, table: &mut toml::Table) -> $crate::error::Result<()> {
                $($crate::config::section::Sections::write(&self.$field, table)?;)*
                Ok(())
            }

            fn read(table: &toml::Table) -> $crate::error::Result<$name> {
                Ok($name { $($field: $crate::config::section::Sections::read(table)?,)* })
            }

            fn is_key(&self, key: &str) -> bool {
                $($crate::config::section::Sections::is_key(&self.$field, key))||*
            }

            fn check_ranges(&self) -> $crate::error::Result<()> {
                $($crate::config::section::Sections::check_ranges(&self.$field)?;)*
                Ok(())
            }
        }
    };
}

pub(super) fn check_range(section: &str, name: &str, value: f64, low: f64, high: f64) -> Result<()> {
    // A value that is not a number (NaN) is in no range.
    if value >= low && value <= high {
        return Ok(());
    }
    Err(Error::config(format!("{section}.{name}"), value, format!("is not in the accepted range, {low} to {high}")))
}

pub(super) use {section, sections, toml_name};
