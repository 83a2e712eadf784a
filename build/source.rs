//! Reads from the shaders' text what SPIR-V does not keep: comments, integer constants and defines.

use crate::Failure;
use crate::compile::Define;
use std::collections::BTreeMap;

/// Comments of structures (`"Ray"`) and their fields (`"Ray.anchor"`).
pub type Comments = BTreeMap<String, String>;

/// Reads the comment lines above each structure and the comments behind its fields.
pub fn comments(source: &str) -> Comments {
    let mut comments = Comments::new();
    let (mut above, mut within) = (String::new(), None);
    for line in source.lines() {
        let (code, comment) = line.split_once("//").map_or((line, ""), |(code, comment)| (code, comment.trim()));
        let code = code.trim();
        if let Some(name) = code.strip_prefix("struct ").and_then(|rest| rest.strip_suffix(" {")) {
            comments.insert(name.to_owned(), above.trim().to_owned());
            within = Some(name.to_owned());
        } else if code == "};" {
            within = None;
        } else if let (Some(structure), Some((_, field))) = (&within, code.trim_end_matches(';').split_once(' ')) {
            comments.insert(format!("{structure}.{}", field.trim()), comment.to_owned());
        }
        above = if code.is_empty() { format!("{above} {comment}") } else { String::new() };
    }
    comments
}

/// Integer constant that shaders and host use.
pub struct Constant {
    pub name: String,
    /// Value as written, without the suffix.
    pub value: String,
    pub comment: String,
}

/// Reads the lines `const uint NAME = LITERAL; // comment`.
pub fn constants(source: &str) -> Vec<Constant> {
    let constant = |line: &str| {
        let (code, comment) = line.split_once("//").unwrap_or((line, ""));
        let (name, value) = code.trim().strip_prefix("const uint ")?.strip_suffix(';')?.split_once(" = ")?;
        let value = value.strip_suffix('u')?;
        parse(value)?;
        Some(Constant { name: name.into(), value: value.into(), comment: comment.trim().into() })
    };
    source.lines().filter_map(constant).collect()
}

/// Reads the numbers defined under `#ifndef NAME`; the defines of a variant take precedence.
pub fn numbers(source: &str, defines: &[Define]) -> Result<BTreeMap<String, u32>, Failure> {
    let mut numbers = BTreeMap::new();
    for line in source.lines() {
        let Some(name) = line.strip_prefix("#ifndef ") else { continue };
        let default = source.lines().find_map(|l| l.strip_prefix("#define ")?.strip_prefix(name)?.strip_prefix(' '));
        let value = defines.iter().find(|(n, _)| n == name).map(|(_, v)| v.as_str()).or(default);
        let value = value.and_then(|v| parse(v.strip_suffix('u')?));
        numbers.insert(name.to_owned(), value.ok_or_else(|| format!("{name} is no number like 8u"))?);
    }
    Ok(numbers)
}

fn parse(literal: &str) -> Option<u32> {
    match literal.strip_prefix("0x") {
        Some(digits) => u32::from_str_radix(digits, 16).ok(),
        None => literal.parse().ok(),
    }
}
