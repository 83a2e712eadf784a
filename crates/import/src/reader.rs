//! Values of a data set by their tags, with errors that name file and tag.

use crate::elements::{DataSet, Element, Value};
use crate::error::{Error, Result};
use dicom_core::Tag;
use std::path::Path;

/// Elements of a data set, or of an item of one of its sequences.
#[derive(Clone, Copy)]
pub(super) struct Reader<'a> {
    pub(super) data: &'a DataSet,
    pub(super) path: &'a Path,
}

impl<'a> Reader<'a> {
    pub(super) fn bad(&self, tag: Tag, name: &str, problem: impl Into<String>) -> Error {
        Error::data(self.path, format!("({:04X},{:04X}) {name}", tag.group(), tag.element()), problem)
    }

    pub(super) fn get(&self, tag: Tag) -> Option<&'a Element> {
        self.data.get(tag)
    }

    pub(super) fn text(&self, tag: Tag) -> Option<String> {
        self.get(tag)?.text().filter(|text| !text.is_empty())
    }

    pub(super) fn numbers(&self, tag: Tag, name: &str) -> Result<Option<Vec<f64>>> {
        let Some(element) = self.get(tag) else { return Ok(None) };
        let numbers = element.numbers().map_err(|problem| self.bad(tag, name, problem))?;
        match numbers.iter().find(|v| !v.is_finite()) {
            Some(bad) => Err(self.bad(tag, name, format!("{bad} is not finite"))),
            None => Ok(Some(numbers).filter(|n| !n.is_empty())),
        }
    }

    pub(super) fn number(&self, tag: Tag, name: &str) -> Result<Option<f64>> {
        Ok(self.numbers(tag, name)?.map(|n| n[0]))
    }

    pub(super) fn needed(&self, tag: Tag, name: &str) -> Result<f64> {
        self.number(tag, name)?.ok_or_else(|| self.bad(tag, name, "is missing"))
    }

    /// Like [`Reader::needed`], for a value that an option can state.
    pub(super) fn needed_or(&self, tag: Tag, name: &str, option: &str) -> Result<f64> {
        self.number(tag, name)?.ok_or_else(|| self.bad(tag, name, format!("is missing; state it by {option}")))
    }

    /// Returns the items of a sequence; none where it is missing.
    pub(super) fn items(&self, tag: Tag, name: &str) -> Result<Vec<Reader<'a>>> {
        match self.get(tag).map(|element| &element.value) {
            None => Ok(Vec::new()),
            Some(Value::Items(items)) => Ok(items.iter().map(|data| Reader { data, path: self.path }).collect()),
            Some(Value::Broken(problem)) => Err(self.bad(tag, name, problem.clone())),
            // An empty element whose type nobody stated.
            Some(Value::Bytes { bytes, .. }) if bytes.is_empty() => Ok(Vec::new()),
            Some(_) => Err(self.bad(tag, name, "is no sequence")),
        }
    }

    /// Returns the first item of a sequence.
    pub(super) fn item(&self, tag: Tag, name: &str) -> Result<Option<Reader<'a>>> {
        Ok(self.items(tag, name)?.first().copied())
    }
}
