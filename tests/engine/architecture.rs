//! The structure of the code: crates use only crates below them, rooms (modules of a crate's `lib.rs`) use only rooms that stand above
//! them there, a method is named by few files outside its own room, and doc comments are sentences.

use crate::root::root;
use std::collections::{BTreeMap, BTreeSet};
use std::path::PathBuf;

/// Rust files below a folder of the project, with their paths from its root.
pub(crate) fn files(folder: &str) -> Vec<(String, String)> {
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

/// Crates from the lowest to the highest: each uses only crates that stand before it. The one without a folder is the engine.
const CRATES: [&str; 13] = [
    "crates/gpu",
    "crates/formats",
    "crates/angiograms",
    "crates/import",
    "",
    "crates/vessels",
    "crates/phantom",
    "crates/twins",
    "crates/runs",
    "crates/study",
    "crates/capi",
    "crates/capi/library",
    "crates/cli",
];
/// Crates with rooms, which stand in the order of their `lib.rs`; the modules of the other crates are files in the order of the alphabet.
const WITH_ROOMS: [&str; 5] = ["", "crates/angiograms", "crates/vessels", "crates/twins", "crates/runs"];

/// Returns the file of a crate.
fn of_crate(folder: &str, file: &str) -> String {
    std::fs::read_to_string(root().join(folder).join(file)).unwrap()
}

/// Rust files of a crate, with their paths from its folder.
fn sources(folder: &str) -> Vec<(String, String)> {
    let from = if folder.is_empty() { String::new() } else { format!("{folder}/") };
    let of = files(&format!("{from}src")).into_iter();
    of.map(|(path, text)| (path.strip_prefix(&from).unwrap().to_owned(), text)).collect()
}

/// Rooms in the order of the `lib.rs` of a crate.
fn rooms(folder: &str) -> Vec<String> {
    let text = of_crate(folder, "src/lib.rs");
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

/// Returns the room of a file of `src`.
fn room_of(path: &str) -> &str {
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
    let mut count = 0;
    for folder in WITH_ROOMS {
        let rooms = rooms(folder);
        assert_eq!(arrows_up(&sources(folder), &rooms), BTreeSet::new(), "{folder}");
        count += rooms.len();
    }
    assert!(count > 30, "{count} rooms");
    // A new arrow is seen.
    let planted = [("src/model/scene.rs".to_owned(), "use crate::render::renderer::Renderer;\n".to_owned())];
    assert_eq!(arrows_up(&planted, &rooms("")).len(), 1);
}

/// Crates of the project that a manifest uses, tests aside, by the ends of their names.
fn used_crates(manifest: &str) -> BTreeSet<&str> {
    let after = manifest.split("\n[dependencies]\n").nth(1).unwrap_or("");
    let used = after.split("\n[").next().unwrap().lines().filter(|line| line.starts_with("nertca-vk"));
    used.map(|line| line.split(['.', ' ']).next().unwrap().trim_start_matches("nertca-vk").trim_start_matches('-'))
        .collect()
}

#[test]
fn crates_use_only_crates_below_them() {
    let name = |folder: &str| {
        let manifest = of_crate(folder, "Cargo.toml");
        let named = manifest.split("\n[package]\n").last().unwrap().split("name = \"nertca-vk").nth(1).unwrap();
        named.split('"').next().unwrap().trim_start_matches('-').to_owned()
    };
    let names: Vec<String> = CRATES.iter().map(|folder| name(folder)).collect();
    for (at, folder) in CRATES.iter().enumerate() {
        let manifest = of_crate(folder, "Cargo.toml");
        for used in used_crates(&manifest) {
            assert!(names[..at].iter().any(|below| below == used), "{folder} uses {used}, which is not below it");
        }
    }
    let mut all: BTreeSet<String> = files("crates").into_iter().map(|(path, _)| path).collect();
    all.retain(|path| !CRATES.iter().any(|folder| path.starts_with(&format!("{folder}/src/")) && !folder.is_empty()));
    all.retain(|path| !path.ends_with("/build.rs") && !path.contains("/benches/"));
    assert!(all.is_empty(), "files of crates without a place: {all:?}");
    assert_eq!(used_crates("a\n[dependencies]\nnertca-vk = { }\nnertca-vk-gpu.workspace = true\n").len(), 2);
}

#[test]
fn angiograms_need_no_device() {
    for folder in ["crates/angiograms", "crates/import"] {
        let of_a_device: Vec<String> = sources(folder)
            .into_iter()
            .filter(|(_, text)| code(text).any(|line| line.contains("nertca_vk_gpu") || line.contains("ash::")))
            .map(|(path, _)| path)
            .collect();
        // The error type has the errors of a device, if the feature `gpu` asks for them.
        let expected: &[&str] = if folder == "crates/angiograms" { &["src/error.rs"] } else { &[] };
        assert_eq!(of_a_device, expected, "{folder}");
    }
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
        // The module to which an item is visible is not one that is used.
        let (own, text) = (name(path), code(text).collect::<Vec<_>>().join(" ").replace("pub(in crate::", ""));
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
    let rooms_with_one = |folder: &str| -> Vec<String> {
        let room = |circle: &BTreeSet<String>| circle.first().unwrap().split("::").next().unwrap().to_owned();
        circles(&uses(&sources(folder))).iter().map(room).collect()
    };
    for folder in CRATES {
        let expected: &[&str] = match folder {
            // A preset of a method is a whole configuration, which contains the settings of the method.
            "" => &["config", "kernels", "network"],
            // Device, memory and recordings.
            "crates/gpu" => &["capabilities"],
            _ => &[],
        };
        assert_eq!(rooms_with_one(folder), expected, "{folder}");
    }
    // A new circle is seen.
    let planted =
        [("src/a/b.rs", "use crate::a::{c::D, e};"), ("src/a/c.rs", "use crate::a::b::F;"), ("src/a/e.rs", "")];
    let planted = planted.map(|(path, text)| (path.to_owned(), text.to_owned()));
    assert_eq!(circles(&uses(&planted)).len(), 1);
}

/// A method, and the words by which code names it.
struct Named {
    /// Name of its room, its configuration file and its folder of shaders.
    room: &'static str,
    /// Words: names of types and modules, variants of enums, sections of the configuration, stages and structures of shaders. A word that
    /// ends with `*` is the beginning of others.
    words: &'static [&'static str],
    /// Maximum number of other files that name it.
    limit: usize,
}

const METHODS: [Named; 6] = [
    Named { room: "nert_ca", words: &["nert_ca", "NertCa*", "FastMlp", "Paper", "PublicCode"], limit: 3 },
    Named { room: "nerf_ca", words: &["nerf_ca", "NerfCa*"], limit: 3 },
    Named {
        room: "dynamic_gaussians",
        words: &[
            "dynamic_gaussians",
            "DynamicGaussians",
            "GaussiansSettings",
            "Preset::Fast",
            "Deformable*",
            "deformable*",
        ],
        limit: 6,
    },
    Named { room: "r2_gaussian", words: &["r2_gaussian", "R2*", "r2", "r2_*"], limit: 5 },
    Named {
        room: "x_gaussian",
        words: &[
            "x_gaussian",
            "XGaussian",
            "XSettings",
            "config.x",
            "sections::X",
            "x_update",
            "x_report",
            "x_blend_back",
            "x_entries",
            "x_status",
            "x_statistics",
            "x_schedule",
            "XUpdate",
            "XReport",
            "XBlendBack",
            "XStatus",
            "XStatistics",
            "XSchedule",
        ],
        limit: 3,
    },
    Named {
        room: "sax_nerf",
        words: &["sax*", "Sax*", "SAX_*", "Lineformer*", "lineformer*", "LINEFORMER_*"],
        limit: 4,
    },
];

/// Code of a file without comments, texts and its own tests.
fn bare(text: &str) -> String {
    // A quotation mark between apostrophes begins no text.
    let code = code(text).collect::<Vec<_>>().join("\n").replace("'\"'", "' '");
    let (mut bare, mut is_text, mut letters) = (String::new(), false, code.chars());
    while let Some(letter) = letters.next() {
        match letter {
            '\\' if is_text => drop(letters.next()),
            '"' => is_text = !is_text,
            _ if is_text => {}
            _ => bare.push(letter),
        }
    }
    bare
}

/// Whether code has a word, which is not a part of another one.
fn names(code: &str, word: &str) -> bool {
    let (word, is_beginning) = word.strip_suffix('*').map_or((word, false), |word| (word, true));
    let is_part = |letter: Option<char>| letter.is_some_and(|c| c.is_alphanumeric() || c == '_');
    code.match_indices(word).any(|(at, _)| {
        let (before, after) = (code[..at].chars().next_back(), code[at + word.len()..].chars().next());
        !is_part(before) && (is_beginning || !is_part(after))
    })
}

/// Files of library, crates and build script that name a method, other than those of its room and its configuration.
fn named_by(method: &Named, sources: &[(String, String)]) -> Vec<String> {
    let room = method.room;
    let own = [
        format!("src/methods/{room}/"),
        format!("src/methods/{room}.rs"),
        format!("src/config/{room}.rs"),
        // Its f64 twin and its self-test.
        format!("crates/twins/src/reference/{room}"),
        format!("crates/twins/src/selftest/{room}"),
    ];
    let others = sources.iter().filter(|(path, _)| !own.iter().any(|own| path.starts_with(own.as_str())));
    let named = others.filter(|(_, code)| method.words.iter().any(|word| names(code, word)));
    named.map(|(path, _)| path.clone()).collect()
}

#[test]
fn no_method_uses_another() {
    for Named { room: method, .. } in METHODS {
        let room = [files(&format!("src/methods/{method}")), files(&format!("src/methods/{method}.rs"))].concat();
        assert!(!room.is_empty(), "{method}");
        for (path, text) in room {
            let other = |line: &&str| {
                METHODS.iter().any(|other| other.room != method && line.contains(&format!("methods::{}", other.room)))
            };
            let used: Vec<&str> = code(&text).filter(other).collect();
            assert!(used.is_empty(), "{path} uses another method: {used:?}");
        }
    }
}

#[test]
fn a_method_is_named_by_few_files_outside_its_room() {
    let build = ("build.rs".to_owned(), std::fs::read_to_string(root().join("build.rs")).unwrap());
    let shipped = |(path, _): &(String, String)| {
        !["/tests/", "/benches/"].iter().any(|folder| path.contains(folder)) && !path.ends_with("/tests.rs")
    };
    let all = ["src", "crates", "build"].into_iter().flat_map(files).filter(shipped).chain([build]);
    let mut sources: Vec<(String, String)> = all.map(|(path, text)| (path, bare(&text))).collect();
    for method in &METHODS {
        let shared = named_by(method, &sources);
        assert!(shared.len() <= method.limit, "{} is named by {shared:#?}", method.room);
    }
    // A new name is seen, by each of the words.
    for method in &METHODS {
        let before = named_by(method, &sources).len();
        for word in method.words {
            let word = word.replace('*', if word.ends_with("_*") { "a" } else { "" });
            sources.push(("src/render/planted.rs".into(), format!("let a = {word};")));
            assert_eq!(named_by(method, &sources).len(), before + 1, "{}: {word}", method.room);
            sources.pop();
        }
    }
    assert_eq!(bare("let a = \"config.x \\\" b\"; // Sax\n// sax\nlet c = 1;"), "let a = ; // Sax\nlet c = 1;");
}

#[test]
fn settings_of_a_method_name_no_other_method() {
    for Named { room: method, .. } in METHODS {
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
