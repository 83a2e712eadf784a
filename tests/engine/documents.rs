//! Documents say what is: the pages of figures stay short, no document tells history, and links lead somewhere.

use crate::architecture::files;
use crate::root::root;
use nertca_vk::choice::Choice;
use nertca_vk::config::sections::Rule;
use std::collections::BTreeSet;
use std::path::PathBuf;

/// Documents of the project, with their paths and texts. Tables that a study made name the commits of their results.
fn documents() -> Vec<(PathBuf, String)> {
    let (mut open, mut found) =
        (["docs", "examples", "studies"].map(|folder| root().join(folder)).to_vec(), Vec::new());
    open.extend(["README.md", "CONTRIBUTING.md", "CHANGELOG.md"].map(|file| root().join(file)));
    while let Some(path) = open.pop() {
        if path.is_dir() && !path.ends_with("studies/measured") {
            open.extend(path.read_dir().unwrap().map(|entry| entry.unwrap().path()));
        } else if path.extension().is_some_and(|extension| extension == "md") {
            found.push((path.clone(), std::fs::read_to_string(&path).unwrap()));
        }
    }
    found
}

/// Parts of a text that tell history: commits, and changes by their place among the commits.
fn history(text: &str) -> Vec<&str> {
    let is_commit = |word: &&str| {
        let has = |of: fn(&char) -> bool| word.chars().any(|c| of(&c));
        (7..=40).contains(&word.len())
            && word.chars().all(|c| c.is_ascii_digit() || ('a'..='f').contains(&c))
            && has(char::is_ascii_digit)
            && has(char::is_ascii_lowercase)
    };
    let words = text.split(|c: char| !c.is_alphanumeric()).filter(is_commit);
    let phrases = ["the change that follows", "the changes that follow", "which the next change"];
    let one_line = text.split_whitespace().collect::<Vec<_>>().join(" ");
    words.chain(phrases.into_iter().filter(|phrase| one_line.contains(phrase))).collect()
}

#[test]
fn documents_state_no_history() {
    let documents = documents();
    assert!(documents.len() > 15);
    for (path, text) in &documents {
        assert_eq!(history(text), Vec::<&str>::new(), "{} tells history", path.display());
    }
    assert_eq!(history("0.944 at 2e4 photons in 1600000 of 9.0e10"), Vec::<&str>::new());
    assert_eq!(history("Dice is .944 (50b6b1c, the change\nthat follows it)"), ["50b6b1c", "the change that follows"]);
}

#[test]
fn pages_of_figures_are_short() {
    for (page, limit) in
        [("docs/performance.md", 180), ("docs/tried.md", 200), ("docs/glossary.md", 60), ("README.md", 90)]
    {
        let lines = std::fs::read_to_string(root().join(page)).unwrap().lines().count();
        assert!(
            lines <= limit,
            "{page} has {lines} lines, but {limit} are allowed: replace figures instead of adding some"
        );
    }
}

/// Anchors of the headings of a document, as web pages make them.
fn anchors(text: &str) -> BTreeSet<String> {
    let anchor = |line: &str| -> String {
        let heading = line.trim_start_matches('#').trim().to_lowercase();
        let kept = heading.chars().filter(|c| c.is_alphanumeric() || "-_ ".contains(*c));
        kept.map(|c| if c == ' ' { '-' } else { c }).collect()
    };
    text.lines().filter(|line| line.starts_with('#')).map(anchor).collect()
}

#[test]
fn links_lead_somewhere() {
    let (mut links, mut broken) = (0, Vec::new());
    for (path, text) in &documents() {
        let targets = text.split("](").skip(1).filter_map(|rest| rest.split_once(')')).map(|(target, _)| target);
        for target in targets.filter(|target| !target.contains("://")) {
            let (file, anchor) = target.split_once('#').unwrap_or((target, ""));
            let file = if file.is_empty() { path.clone() } else { path.parent().unwrap().join(file) };
            let has = |anchor: &str| std::fs::read_to_string(&file).is_ok_and(|text| anchors(&text).contains(anchor));
            links += 1;
            if !file.exists() || !(anchor.is_empty() || has(anchor)) {
                broken.push(format!("{}: {target}", path.display()));
            }
        }
    }
    assert!(links > 100 && broken.is_empty(), "{links} links, broken:\n{}", broken.join("\n"));
    assert!(anchors("## Scores in 3D, `x`").contains("scores-in-3d-x"));
}

/// A rule that no study leaves out is a rule without evidence.
#[test]
fn each_rule_can_be_left_out_and_a_study_does_so() {
    let study = std::fs::read_to_string(root().join("studies/rules.toml")).unwrap();
    let room = files("src/methods/dynamic_gaussians");
    let sources: String = room.into_iter().map(|(_, text)| text).collect();
    for rule in Rule::ALL {
        let method = format!("set = ['gaussians.without_rules=[\"{}\"]']", rule.name());
        assert!(study.contains(&method), "studies/rules.toml has no method with {method}");
        assert!(sources.contains(&format!("keeps(Rule::{rule:?})")), "nothing asks whether {rule:?} applies");
    }
}
