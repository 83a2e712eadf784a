//! Values of a configuration as users write them: files and `key=value` settings on top of a preset, and whole configurations, as
//! checkpoints and run directories contain them.

use crate::choice::Choice;
use crate::config::common::{Calibrate, Render, Train};
use crate::config::section::Sections;
use crate::config::{Config, FORMS, Preset};
use crate::error::{Error, Result};
use crate::files;
use serde::de::Error as _;
use serde::{Deserialize, Deserializer, Serialize, Serializer};
use std::path::Path;
use toml::{Table, Value};

/// Largest accepted size of a configuration file, bytes.
const MAX_FILE_BYTES: u64 = 1 << 20;
/// Largest number below which a float represents every whole number: 2^53.
const MAX_WHOLE: f64 = 9_007_199_254_740_992.0;
/// Section that had another name in earlier versions, and that name.
const RENAMED: (&str, &str) = ("deformable", "tree");

impl Serialize for Config {
    fn serialize<S: Serializer>(&self, serializer: S) -> std::result::Result<S::Ok, S::Error> {
        self.table().map_err(serde::ser::Error::custom)?.serialize(serializer)
    }
}

impl<'de> Deserialize<'de> for Config {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> std::result::Result<Config, D::Error> {
        Config::whole(&Table::deserialize(deserializer)?).map_err(D::Error::custom)
    }
}

impl Config {
    /// Builds a configuration from a preset, an optional TOML file and `key=value` settings.
    ///
    /// # Errors
    /// [`Error::Config`] or [`Error::Io`] naming key or file.
    pub fn load(preset: Option<Preset>, file: Option<&Path>, settings: &[String]) -> Result<Config> {
        let Some(path) = file else { return Config::preset(preset.unwrap_or_default()).with(settings) };
        let text = files::read_text(path, MAX_FILE_BYTES)?;
        let table =
            text.parse::<Table>().map_err(|e| Error::config(path.display().to_string(), "TOML", e.message()))?;
        let config = Config::of_file(preset, table).map_err(|error| match error {
            Error::Config { field, value, problem } => {
                Error::Config { field: format!("{}: {field}", path.display()), value, problem }
            }
            error => error,
        })?;
        config.with(settings)
    }

    /// Returns this configuration with `key=value` settings.
    ///
    /// # Errors
    /// [`Error::Config`] naming the key.
    pub fn with(&self, settings: &[String]) -> Result<Config> {
        let read = |setting: &String| {
            let (key, value) = setting.split_once('=').ok_or_else(|| {
                Error::config("setting", setting, "is not of the form key=value, e.g. train.iterations=500")
            })?;
            Ok((key.trim().to_owned(), parse_value(value.trim())))
        };
        self.changed(settings.iter().map(read).collect::<Result<_>>()?)
    }

    /// Reads the table of a file. A file with all values of a configuration was written by a program: it is taken as it is. Any other
    /// file changes values of the preset.
    fn of_file(preset: Option<Preset>, mut table: Table) -> Result<Config> {
        let named = table.remove("preset").map(|value| {
            let read = value.clone().try_into::<Preset>();
            read.map_err(|e| Error::config("preset", &value, e.message().to_owned()))
        });
        let preset = preset.or(named.transpose()?).unwrap_or_default();
        let values = values(&table);
        values.iter().try_for_each(|(key, value)| check_form(preset, key, value))?;
        table.insert("preset".into(), Value::String(preset.name().into()));
        match Config::whole(&table) {
            Ok(config) => config.check().map(|()| config),
            Err(_) => Config::preset(preset).changed(values),
        }
    }

    /// Reads a whole configuration. Sections of other methods and values that have become constants are ignored.
    fn whole(table: &Table) -> Result<Config> {
        let of = |key: &str| table.get(key).cloned().ok_or_else(|| Error::config(key, "", "is missing"));
        let bad = |e: toml::de::Error| Error::config("configuration", "", e.message().to_owned());
        let (preset, seed) = (of("preset")?.try_into().map_err(bad)?, of("seed")?.try_into().map_err(bad)?);
        values(table).iter().try_for_each(|(key, value)| check_form(preset, key, value))?;
        let mut table = table.clone();
        if let Some(section) = table.remove(RENAMED.1) {
            table.entry(RENAMED.0).or_insert(section);
        }
        Ok(Config {
            preset,
            seed,
            train: Train::read(&table)?,
            calibrate: Calibrate::read(&table)?,
            render: Render::read(&table)?,
            method: Config::preset(preset).method.read_alike(&table)?,
        })
    }

    /// Returns all values as a table.
    fn table(&self) -> Result<Table> {
        let mut table = Table::new();
        table.insert("preset".into(), Value::String(self.preset.name().into()));
        table.insert("seed".into(), Value::Integer(self.seed.into()));
        self.train.write(&mut table)?;
        self.calibrate.write(&mut table)?;
        self.render.write(&mut table)?;
        self.method.settings().write(&mut table)?;
        Ok(table)
    }

    /// Tells whether a user of this configuration's preset may change the value of a key.
    pub fn acts(&self, key: &str) -> bool {
        let sections: [&dyn Sections; 3] = [&self.train, &self.calibrate, &self.render];
        key == "seed" || sections.iter().any(|section| section.is_key(key)) || self.method.settings().is_key(key)
    }

    /// Returns this configuration with other values of keys; the preset is kept.
    fn changed(&self, values: Vec<(String, Value)>) -> Result<Config> {
        let before = self.table()?;
        let mut table = before.clone();
        for (key, value) in values {
            check_form(self.preset, &key, &value)?;
            let Some(old) = at(&before, &key) else { return Err(self.refusal(&key, &value)) };
            let new = converted(old, value.clone()).map_err(|problem| Error::config(&key, &value, problem))?;
            if new != *old && key != "preset" && !self.acts(&key) {
                let problem = format!("is a constant of the program, {old} with this preset; {}", self.see());
                return Err(Error::config(key, new, problem));
            }
            set(&mut table, &key, new);
            if let Err(Error::Config { problem, .. }) = Config::whole(&table) {
                return Err(Error::config(&key, &value, problem));
            }
        }
        table.insert("preset".into(), Value::String(self.preset.name().into()));
        let config = Config::whole(&table)?;
        config.check()?;
        Ok(config)
    }

    /// Returns the refusal of a key that this configuration does not have.
    fn refusal(&self, key: &str, value: &Value) -> Error {
        let of_another = |preset: &Preset| Config::preset(*preset).acts(key);
        let problem = match Preset::ALL.iter().any(of_another) {
            true => format!("has no effect with the preset `{}`; {}", self.preset.name(), self.see()),
            false => format!("unknown key; the known keys are: {}", self.known(key).join(", ")),
        };
        Error::config(key, value, problem)
    }

    /// Returns the keys of the section of a key, or all sections where there is no such section.
    fn known(&self, key: &str) -> Vec<String> {
        let Ok(table) = self.table() else { return Vec::new() };
        let section = key.split_once('.').map_or("", |(section, _)| section);
        match table.get(section).and_then(Value::as_table) {
            Some(values) => {
                let keys = values.keys().map(|name| format!("{section}.{name}"));
                keys.filter(|key| self.acts(key)).collect()
            }
            None => table.keys().cloned().collect(),
        }
    }

    fn see(&self) -> String {
        format!("`train --preset {} --print-config` prints the settings of this preset", self.preset.name())
    }

    /// Returns the configuration as TOML.
    ///
    /// # Errors
    /// [`Error::Internal`] when it cannot be written as TOML.
    pub fn to_toml(&self) -> Result<String> {
        toml::to_string_pretty(&self.table()?).map_err(|e| Error::Internal(e.to_string()))
    }

    /// Returns the settings that a user may change as TOML.
    ///
    /// # Errors
    /// [`Error::Internal`] when they cannot be written as TOML.
    pub fn acting_toml(&self) -> Result<String> {
        let mut table = self.table()?;
        for (section, value) in &mut table {
            if let Value::Table(settings) = value {
                settings.retain(|name, _| self.acts(&format!("{section}.{name}")));
            }
        }
        table.retain(|_, value| value.as_table().is_none_or(|settings| !settings.is_empty()));
        toml::to_string_pretty(&table).map_err(|e| Error::Internal(e.to_string()))
    }
}

/// Refuses a value that chose another method than that of the preset.
///
/// # Errors
/// [`Error::Config`] naming the presets to choose instead.
fn check_form(preset: Preset, key: &str, value: &toml::Value) -> Result<()> {
    let text = value.as_str().map_or_else(|| value.to_string(), str::to_owned);
    match FORMS.iter().find(|(of, form, _)| *of == key && *form == text) {
        Some((.., presets)) if !presets.contains(&preset) => {
            let names: Vec<String> = presets.iter().map(|preset| format!("`{}`", preset.name())).collect();
            let instead = names.join(" or ");
            let problem = format!("is not the method of the preset `{}`: choose the preset {instead}", preset.name());
            Err(Error::config(key, text, problem))
        }
        _ => Ok(()),
    }
}

/// Returns the keys of a table, such as `train.iterations`, with their values.
fn values(table: &Table) -> Vec<(String, Value)> {
    let below = |(key, value): (&String, &Value)| match value.as_table() {
        Some(inner) => values(inner).into_iter().map(|(name, value)| (format!("{key}.{name}"), value)).collect(),
        None => vec![(key.clone(), value.clone())],
    };
    table.iter().flat_map(below).collect()
}

/// Returns the value of a key; none for a section and for a key that the table lacks.
fn at<'a>(table: &'a Table, key: &str) -> Option<&'a Value> {
    let value = match key.split_once('.') {
        None => table.get(key),
        Some((section, name)) => table.get(section)?.as_table()?.get(name),
    };
    value.filter(|value| !value.is_table())
}

/// Sets the value of a key of a section that the table has.
fn set(table: &mut Table, key: &str, value: Value) {
    match key.split_once('.') {
        None => drop(table.insert(key.to_owned(), value)),
        Some((section, name)) => {
            if let Some(section) = table.get_mut(section).and_then(Value::as_table_mut) {
                section.insert(name.to_owned(), value);
            }
        }
    }
}

/// Returns a value in the type of the one that it replaces.
fn converted(before: &Value, value: Value) -> std::result::Result<Value, String> {
    match (before, value) {
        (Value::Float(_), Value::Integer(i)) => Ok(Value::Float(i as f64)),
        (Value::Integer(_), Value::Float(x)) if x.fract() == 0.0 && x.abs() <= MAX_WHOLE => {
            Ok(Value::Integer(x as i64))
        }
        (before, value) if before.type_str() == value.type_str() => Ok(value),
        (before, _) => Err(format!("expected {}", before.type_str())),
    }
}

/// Reads a value as TOML has it, or a number as people type it (`.003`, `5.`, `007`); all else is a string.
fn parse_value(text: &str) -> Value {
    let toml = format!("v = {text}").parse::<Table>().ok().and_then(|mut t| t.remove("v"));
    toml.or_else(|| number(text)).unwrap_or_else(|| Value::String(text.to_owned()))
}

/// Reads a number that TOML would write in another way.
fn number(text: &str) -> Option<Value> {
    let plain = text.replace('_', "");
    let whole = plain.parse::<i64>().ok().map(Value::Integer);
    let starts_as_number = plain.starts_with(|c: char| c.is_ascii_digit() || "+-.".contains(c));
    whole.or_else(|| plain.parse::<f64>().ok().filter(|_| starts_as_number).map(Value::Float))
}
