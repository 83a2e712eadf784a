//! The structure of the library: rooms (modules of `src/lib.rs`) use only rooms that stand above them there, a method is named by few
//! files outside its own room, and doc comments are sentences.

use crate::root::root;
use std::collections::{BTreeMap, BTreeSet};
use std::path::PathBuf;

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

/// Returns the room of a file of `src`. The f64 twin and the self-test of a method stand in its folder; they belong to the rooms
/// `reference` and `selftest`, which nothing that computes a result uses.
fn room_of(path: &str) -> &str {
    let file = path.rsplit('/').next().unwrap();
    if path.starts_with("src/methods/") && file.starts_with("twin") {
        return "reference";
    }
    if path.starts_with("src/methods/") && file == "selftest.rs" {
        return "selftest";
    }
    path.trim_start_matches("src/").split('/').next().unwrap().trim_end_matches(".rs")
}

/// Lines of code of a file without comments and its own tests.
fn code(text: &str) -> impl Iterator<Item = &str> {
    let shipped = text.split("#[cfg(test)]\nmod tests").next().unwrap();
    shipped.lines().filter(|line| !line.trim_start().starts_with("//"))
}

/// Arrows to rooms that stand below: (from, to).
fn arrows_up(sources: &[(String, String)], rooms: &[String]) -> BTreeSet<(String, String)> {
    let place = |room: &str| rooms.iter().position(|known| known == room);
    let mut up = BTreeSet::new();
    for (path, text) in sources {
        let own = room_of(path);
        let Some(at) = place(own) else { continue };
        for to in code(text).flat_map(rooms_of_line).filter(|to| place(to).is_some_and(|place| place > at)) {
            up.insert((own.to_owned(), to.to_owned()));
        }
    }
    up
}

#[test]
fn rooms_use_only_rooms_above_them() {
    let (rooms, sources) = (rooms(), files("src"));
    assert!(rooms.len() > 30 && sources.len() > 200, "{} rooms, {} files", rooms.len(), sources.len());
    assert_eq!(arrows_up(&sources, &rooms), BTreeSet::new());
    // A new arrow is seen.
    let planted = [("src/scan/dataset.rs".to_owned(), "use crate::render::renderer::Renderer;\n".to_owned())];
    assert_eq!(arrows_up(&planted, &rooms).len(), 1);
}

/// Paths that a `use` names, without the keyword: `a::{b, c::d}` names `a::b` and `a::c::d`.
fn expanded(tree: &str) -> Vec<String> {
    let Some(open) = tree.find('{') else { return vec![tree.split(" as ").next().unwrap().to_owned()] };
    let (head, body) = (&tree[..open], &tree[open + 1..tree.rfind('}').unwrap()]);
    let (mut depth, mut parts) = (0, vec![String::new()]);
    for c in body.chars() {
        match c {
            ',' if depth == 0 => parts.push(String::new()),
            _ => {
                depth += i32::from(c == '{') - i32::from(c == '}');
                parts.last_mut().unwrap().push(c);
            }
        }
    }
    let parts = parts.iter().map(|part| part.trim()).filter(|part| !part.is_empty());
    parts.flat_map(|part| expanded(&format!("{head}{part}"))).collect()
}

/// Modules that each module of `src` uses.
fn uses(sources: &[(String, String)]) -> BTreeMap<String, BTreeSet<String>> {
    let name = |path: &str| path.trim_start_matches("src/").trim_end_matches(".rs").replace('/', "::");
    let known: BTreeSet<String> = sources.iter().map(|(path, _)| name(path)).collect();
    let module = |path: &str| {
        let mut parts: Vec<&str> = path.split("::").collect();
        while !parts.is_empty() && !known.contains(&parts.join("::")) {
            parts.pop();
        }
        (!parts.is_empty()).then(|| parts.join("::"))
    };
    let of_file = |(path, text): &(String, String)| {
        let (own, text) = (name(path), code(text).collect::<Vec<_>>().join(" "));
        let parent = own.rsplit_once("::").map_or(String::new(), |(parent, _)| format!("{parent}::"));
        let listed = |rest: &str| {
            let end = rest.find(|c: char| !(c.is_alphanumeric() || "_:".contains(c))).unwrap_or(rest.len());
            let is_list = rest[..end].ends_with("::") && rest[end..].starts_with('{');
            expanded(if is_list { rest.split(';').next().unwrap() } else { &rest[..end] })
        };
        let of = |marker: &str, prefix: &str| -> Vec<String> {
            text.split(marker).skip(1).flat_map(listed).map(|path| format!("{prefix}{path}")).collect()
        };
        // From the root, from the parent, and of a child.
        let paths = [of("crate::", ""), of("super::", &parent), of("use ", &format!("{own}::"))].concat();
        let used = paths.iter().filter_map(|path| module(path)).filter(|used| *used != own).collect();
        (own, used)
    };
    sources.iter().map(of_file).collect()
}

/// Groups of modules that use each other, directly or through others.
fn circles(uses: &BTreeMap<String, BTreeSet<String>>) -> BTreeSet<BTreeSet<String>> {
    let reach = |from: &String| {
        let (mut open, mut seen) = (vec![from], BTreeSet::new());
        while let Some(at) = open.pop() {
            open.extend(uses[at].iter().filter(|to| uses.contains_key(*to) && seen.insert((*to).clone())));
        }
        seen
    };
    let reached: BTreeMap<&String, BTreeSet<String>> = uses.keys().map(|module| (module, reach(module))).collect();
    let circle = |module: &&String| -> BTreeSet<String> {
        reached[*module].iter().filter(|other| reached[*other].contains(*module)).cloned().collect()
    };
    uses.keys().collect::<Vec<_>>().iter().map(circle).filter(|circle| circle.len() > 1).collect()
}

#[test]
fn few_rooms_have_circles_inside() {
    let sources = files("src");
    let found: Vec<String> = circles(&uses(&sources))
        .iter()
        .map(|circle| circle.first().unwrap().split("::").next().unwrap().to_owned())
        .collect();
    // A preset of a method is a whole configuration, which contains the settings of the method.
    assert_eq!(found, ["config", "kernels", "network"]);
    // The crate of Vulkan compute has one, of device, memory and recordings.
    for (name, expected) in [("gpu", 1), ("formats", 0), ("study", 0), ("cli", 0)] {
        let folder = format!("crates/{name}/src");
        let sources: Vec<_> =
            files(&folder).into_iter().map(|(path, text)| (path.replace(&folder, "src"), text)).collect();
        assert!(!sources.is_empty() && circles(&uses(&sources)).len() == expected, "{name}");
    }
    // A new circle is seen.
    let planted =
        [("src/a/b.rs", "use crate::a::{c::D, e};"), ("src/a/c.rs", "use crate::a::b::F;"), ("src/a/e.rs", "")];
    let planted = planted.map(|(path, text)| (path.to_owned(), text.to_owned()));
    assert_eq!(circles(&uses(&planted)).len(), 1);
}

/// Methods, and words that name each in code.
const METHODS: [(&str, &[&str]); 6] = [
    ("nert_ca", &["methods::nert_ca", "nertcasettings", "method::nertca"]),
    ("nerf_ca", &["methods::nerf_ca", "nerfcasettings", "method::nerfca"]),
    ("dynamic_gaussians", &["methods::dynamic_gaussians", "gaussianssettings", "method::dynamicgaussians"]),
    ("r2_gaussian", &["methods::r2_gaussian", "r2settings", "method::r2gaussian", "config.r2"]),
    // Stages with an `x_` draw all Gaussians of which nearer ones hide those behind them.
    ("x_gaussian", &["methods::x_gaussian", "xsettings", "method::xgaussian", "config.x."]),
    ("sax_nerf", &["sax", "lineformer"]),
];

/// Whether a line of code names a method.
fn names(line: &str, words: &[&str]) -> bool {
    let line = line.to_lowercase();
    words.iter().any(|word| line.contains(word))
}

#[test]
fn no_method_uses_another() {
    for (method, _) in METHODS {
        let room = [files(&format!("src/methods/{method}")), files(&format!("src/methods/{method}.rs"))].concat();
        assert!(!room.is_empty(), "{method}");
        for (path, text) in room {
            let other = |line: &&str| {
                METHODS.iter().any(|(name, _)| *name != method && line.contains(&format!("methods::{name}")))
            };
            let used: Vec<&str> = code(&text).filter(other).collect();
            assert!(used.is_empty(), "{path} uses another method: {used:?}");
        }
    }
}

#[test]
fn a_method_is_named_by_few_files_outside_its_room() {
    // Registry and library root, configuration, and the runner of self-tests are where a method is named.
    let allowed = ["src/methods", "src/config", "src/lib.rs", "src/selftest"];
    for (method, words) in METHODS {
        let outside: Vec<String> = files("src")
            .into_iter()
            .filter(|(path, text)| {
                !allowed.iter().any(|room| path.starts_with(room)) && code(text).any(|line| names(line, words))
            })
            .map(|(path, _)| path)
            .collect();
        // The constants that the build makes from shaders.
        let known: &[&str] = if method == "sax_nerf" { &["src/kernels/constants.rs"] } else { &[] };
        assert_eq!(outside, known, "{method}");
    }
}

#[test]
fn settings_of_a_method_name_no_other_method() {
    for (method, _) in METHODS {
        let own = format!("src/config/{method}.rs");
        let uses = |line: &str| line.contains(&format!("::{method}")) || line.contains(&format!("mod {method};"));
        let named: Vec<String> = files("src/config")
            .into_iter()
            .filter(|(path, text)| *path != own && code(text).any(uses))
            .map(|(path, _)| path)
            .filter(|path| !path.ends_with("/tests.rs"))
            .collect();
        assert!(named.is_empty(), "settings of {method} are named by {named:?}");
    }
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
    for (path, text) in ["src", "crates", "tests", "build", "benches"].into_iter().flat_map(files) {
        let lines = text.lines().enumerate().filter(|(_, line)| fragment(line));
        found.extend(lines.map(|(number, line)| format!("{path}:{}: {}", number + 1, line.trim())));
    }
    assert!(found.is_empty(), "{} doc comments begin with a fragment:\n{}", found.len(), found.join("\n"));
}
