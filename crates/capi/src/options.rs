//! Options as text, so that new options never change the ABI: lines of `key = value`, or a JSON object.

use crate::status::{Failure, Outcome};
use std::ffi::{CStr, c_char};

/// Options in the order in which they were given.
#[derive(Debug, Default, PartialEq)]
pub(super) struct Options {
    pairs: Vec<(String, String)>,
}

/// Reads a text of the caller; `None` for null.
///
/// # Safety
/// `text` must be null or end with a zero.
pub(super) unsafe fn text<'a>(name: &str, text: *const c_char) -> Outcome<Option<&'a str>> {
    if text.is_null() {
        return Ok(None);
    }
    // SAFETY: the pointer is not null, and callers of this function guarantee a text that ends with a zero.
    let text = unsafe { CStr::from_ptr(text) };
    text.to_str().map(Some).map_err(|e| Failure::argument(name, format!("is not UTF-8: {e}")))
}

impl Options {
    /// Parses either notation.
    pub fn parse(text: &str) -> Outcome<Options> {
        let text = text.trim();
        let mut options = Options::default();
        if text.starts_with('{') {
            let value = serde_json::from_str::<serde_json::Value>(text)
                .map_err(|e| Failure::argument("options", format!("JSON: {e}")))?;
            options.flatten("", &value)?;
            return Ok(options);
        }
        for (number, line) in text.lines().enumerate() {
            let line = line.split('#').next().unwrap_or_default().trim();
            if line.is_empty() {
                continue;
            }
            let (key, value) = line.split_once('=').ok_or_else(|| {
                Failure::argument("options", format!("line {}: `{line}` is not of the form key = value", number + 1))
            })?;
            options.push(key.trim().to_owned(), value.trim().to_owned())?;
        }
        Ok(options)
    }

    fn push(&mut self, key: String, value: String) -> Outcome<()> {
        if self.pairs.iter().any(|(k, _)| *k == key) {
            return Err(Failure::argument("options", format!("{key} is given twice")));
        }
        self.pairs.push((key, value));
        Ok(())
    }

    fn flatten(&mut self, prefix: &str, value: &serde_json::Value) -> Outcome<()> {
        match value {
            serde_json::Value::Object(map) => map.iter().try_for_each(|(key, value)| {
                let key = if prefix.is_empty() { key.clone() } else { format!("{prefix}.{key}") };
                self.flatten(&key, value)
            }),
            serde_json::Value::String(text) => self.push(prefix.to_owned(), text.clone()),
            serde_json::Value::Bool(_) | serde_json::Value::Number(_) => {
                self.push(prefix.to_owned(), value.to_string())
            }
            _ => Err(Failure::argument("options", format!("{prefix}: {value} is not a text, a number or a Boolean"))),
        }
    }

    /// Removes an option and returns its value.
    pub fn take(&mut self, key: &str) -> Option<String> {
        let at = self.pairs.iter().position(|(k, _)| k == key)?;
        Some(self.pairs.remove(at).1)
    }

    /// Removes an option and parses its value as a `T`.
    pub fn take_as<T: std::str::FromStr>(&mut self, key: &str, wanted: &str) -> Outcome<Option<T>> {
        let Some(value) = self.take(key) else { return Ok(None) };
        let parsed = value.parse().map_err(|_| Failure::argument(key, format!("`{value}` is not {wanted}")))?;
        Ok(Some(parsed))
    }

    /// Returns the remaining options, as `key=value`.
    pub fn settings(self) -> Vec<String> {
        self.pairs.into_iter().map(|(key, value)| format!("{key}={value}")).collect()
    }

    /// Returns an error if any option remains.
    pub fn finish(self, known: &str) -> Outcome<()> {
        match self.pairs.first() {
            None => Ok(()),
            Some((key, _)) => {
                Err(Failure::argument("options", format!("unknown key `{key}`; the known keys are: {known}")))
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn both_notations_say_the_same() {
        let lines = Options::parse("phases = 4\n# a comment\n train.rays=64 # short\n").unwrap();
        let json = Options::parse(r#"{"phases": 4, "train": {"rays": 64}}"#).unwrap();
        assert_eq!(lines, json);
    }

    #[test]
    fn bad_options_are_told() {
        for (text, part) in
            [("phases", "key = value"), ("a=1\na=2", "twice"), ("{\"a\": [1]}", "a:"), ("{\"a\": ", "JSON")]
        {
            assert!(Options::parse(text).unwrap_err().text.contains(part), "{text}");
        }
        let mut options = Options::parse("phases=x").unwrap();
        assert!(options.take_as::<u32>("phases", "a number").unwrap_err().text.contains("`x`"));
    }
}
