//! Messages name only settings that a user may change.

use crate::architecture::files;
use nertca_vk::choice::Choice;
use nertca_vk::config::{Config, Preset};
use std::collections::BTreeSet;

/// Sections of a configuration.
fn sections() -> BTreeSet<String> {
    let whole = |preset| toml::Table::try_from(Config::preset(preset)).unwrap();
    Preset::ALL
        .iter()
        .flat_map(|preset| whole(*preset))
        .filter(|(_, value)| value.is_table())
        .map(|(key, _)| key)
        .collect()
}

/// String literals of a source text without its own tests.
fn literals(text: &str) -> Vec<String> {
    let shipped = text.split("#[cfg(test)]").next().unwrap();
    let code: String =
        shipped.lines().filter(|line| !line.trim_start().starts_with("//")).collect::<Vec<_>>().join("\n");
    let (mut found, mut open, mut escaped) = (Vec::new(), None::<String>, false);
    for c in code.replace("'\"'", "''").chars() {
        match (&mut open, c) {
            (None, '"') => open = Some(String::new()),
            (Some(literal), '"') if !escaped => {
                found.push(std::mem::take(literal));
                open = None;
            }
            (Some(literal), c) => literal.push(c),
            (None, _) => (),
        }
        escaped = c == '\\' && !escaped;
    }
    found
}

/// Words of a sentence such as `static.lr`.
fn keys_in<'a>(sentence: &'a str, sections: &BTreeSet<String>) -> Vec<&'a str> {
    let words = sentence.split(|c: char| !(c.is_ascii_alphanumeric() || c == '_' || c == '.'));
    // Files have such names as well.
    let words =
        words.map(|word| word.trim_matches('.')).filter(|word| !word.ends_with(".json") && !word.ends_with(".lock"));
    words
        .filter(|word| {
            word.split_once('.').is_some_and(|(section, name)| sections.contains(section) && !name.contains('.'))
        })
        .collect()
}

#[test]
fn sentences_name_only_settings_that_a_preset_has() {
    let sections = sections();
    assert_eq!(keys_in("a lower static.lr, or hull.x of net.rs", &sections), ["static.lr", "hull.x"]);
    assert_eq!(literals("a(\"b \\\"c\\\" d\", e) // \"f\"\n//! \"g\"")[0], "b \\\"c\\\" d");
    let mut wrong = Vec::new();
    let shipped = |(path, _): &(String, String)| !path.ends_with("/tests.rs");
    for (path, text) in ["src", "crates"].into_iter().flat_map(files).filter(shipped) {
        for sentence in literals(&text).iter().filter(|literal| literal.contains(' ')) {
            let known = |key: &str| Preset::ALL.iter().any(|preset| Config::preset(*preset).acts(key));
            wrong.extend(
                keys_in(sentence, &sections)
                    .into_iter()
                    .filter(|key| !known(key))
                    .map(|key| format!("{path}: {key}: {sentence}")),
            );
        }
    }
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
}

#[test]
fn advice_against_divergence_names_only_settings_of_its_own_method() {
    let sections = sections();
    for preset in Preset::ALL.iter().copied() {
        let config = Config::preset(preset);
        let advice = nertca_vk::methods::of(&config).smaller_steps;
        let unknown: Vec<_> = keys_in(advice, &sections).into_iter().filter(|key| !config.acts(key)).collect();
        assert!(unknown.is_empty(), "{}: {advice}: {unknown:?}", preset.name());
    }
}
