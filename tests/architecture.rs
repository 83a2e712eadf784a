//! The structure of the library: rooms (modules of `src/lib.rs`) use only rooms that stand above them there, a method is named by few
//! files outside its own room, and doc comments are sentences.
#![allow(missing_docs, clippy::unwrap_used)]

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

fn root() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
}

/// Rust files below a folder of the project, with their paths from its root.
fn files(folder: &str) -> Vec<(String, String)> {
    let (mut open, mut found) = (vec![root().join(folder)], Vec::new());
    while let Some(path) = open.pop() {
        if path.is_dir() {
            open.extend(path.read_dir().unwrap().map(|entry| entry.unwrap().path()));
        } else if path.extension().is_some_and(|extension| extension == "rs") {
            found.push(path);
        }
    }
    found.sort();
    let name = |path: &PathBuf| path.strip_prefix(root()).unwrap().to_str().unwrap().replace('\\', "/");
    found.iter().map(|path| (name(path), std::fs::read_to_string(path).unwrap())).collect()
}

/// Rooms in the order of `src/lib.rs`.
fn rooms() -> Vec<String> {
    let text = std::fs::read_to_string(root().join("src/lib.rs")).unwrap();
    let name = |line: &str| {
        let rest = line.strip_prefix("pub mod ").or(line.strip_prefix("pub(crate) mod "))?;
        Some(rest.trim_end_matches([';', ' ', '{']).to_owned())
    };
    text.lines().filter_map(name).collect()
}

/// Rooms that a line of code names by `crate::ROOM`.
fn rooms_of_line(line: &str) -> impl Iterator<Item = &str> {
    line.split("crate::")
        .skip(1)
        .map(|rest| rest.split(|c: char| !c.is_alphanumeric() && c != '_').next().unwrap_or(""))
}

/// Arrows to rooms that stand below: (from, to).
fn arrows_up(sources: &[(String, String)], rooms: &[String]) -> BTreeSet<(String, String)> {
    let place = |room: &str| rooms.iter().position(|known| known == room);
    let mut up = BTreeSet::new();
    for (path, text) in sources {
        let own = path.trim_start_matches("src/").split('/').next().unwrap().trim_end_matches(".rs");
        let Some(at) = place(own) else { continue };
        let shipped = text.split("#[cfg(test)]\nmod tests").next().unwrap();
        let code = shipped.lines().filter(|line| !line.trim_start().starts_with("//"));
        for to in code.flat_map(rooms_of_line).filter(|to| place(to).is_some_and(|place| place > at)) {
            up.insert((own.to_owned(), to.to_owned()));
        }
    }
    up
}

#[test]
fn rooms_use_only_rooms_above_them() {
    let (rooms, sources) = (rooms(), files("src"));
    assert!(rooms.len() > 30 && sources.len() > 200, "{} rooms, {} files", rooms.len(), sources.len());
    // X-Gaussian's pictures are drawn by the pictures of all Gaussians until it has a room behind the traits of `fitting`.
    let known = [("gaussians", "x_gaussian")].map(|(from, to)| (from.to_owned(), to.to_owned()));
    assert_eq!(arrows_up(&sources, &rooms), BTreeSet::from(known));
    // A new arrow is seen.
    let planted = [("src/scan/dataset.rs".to_owned(), "use crate::render::renderer::Renderer;\n".to_owned())];
    assert_eq!(arrows_up(&planted, &rooms).len(), 1);
}

#[test]
fn a_method_with_a_room_of_its_own_is_named_by_few_files_outside() {
    // Registry and library root, configuration, and texts for users are where a method is named. Its f64 twin and its self-test
    // have rooms of their own.
    let allowed = ["src/methods", "src/config", "src/lib.rs", "src/reference/sax.rs", "src/selftest"];
    let in_code = |text: &str| {
        let named = |line: &str| {
            let line = line.to_lowercase();
            line.contains("sax") || line.contains("lineformer")
        };
        text.lines().filter(|line| !line.trim_start().starts_with("//")).any(named)
    };
    let outside: Vec<String> = files("src")
        .into_iter()
        .filter(|(path, text)| !allowed.iter().any(|room| path.starts_with(room)) && in_code(text))
        .map(|(path, _)| path)
        .collect();
    // A refusal for users, and the constants that the build makes from its shaders.
    assert_eq!(outside, ["src/calibrate.rs", "src/kernels/constants.rs"]);
}

#[test]
fn doc_comments_begin_with_a_verb_or_a_noun() {
    let fragment = |line: &str| {
        let text = line.trim_start();
        let text = text.strip_prefix("/// ").or(text.strip_prefix("//! "));
        text.is_some_and(|text| ["What ", "Those ", "The same ", "Of "].iter().any(|start| text.starts_with(start)))
    };
    assert!(fragment("    /// What a ray sees.") && !fragment("/// Contribution of a ray."));
    let mut found = Vec::new();
    for (path, text) in ["src", "tests", "build", "benches"].into_iter().flat_map(files) {
        let lines = text.lines().enumerate().filter(|(_, line)| fragment(line));
        found.extend(lines.map(|(number, line)| format!("{path}:{}: {}", number + 1, line.trim())));
    }
    assert!(found.is_empty(), "{} doc comments begin with a fragment:\n{}", found.len(), found.join("\n"));
}
