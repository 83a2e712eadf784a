//! The header agrees with the sources, compiles without warnings in C and C++, and changes of the ABI are detected:
//! `tests/capi/abi.txt` holds every exported symbol, constant and struct layout. `tools/bless` rewrites both files.

use crate::c_library::{compile, library};
use crate::root::root;
use std::fmt::Write as _;
use std::process::Command;

/// Compares a committed file with its expected content, or rewrites it on request.
fn expect_file(path: &str, wanted: &str) {
    let file = root().join(path);
    if std::env::var_os("NERTCA_BLESS").is_some() {
        std::fs::create_dir_all(file.parent().unwrap()).unwrap();
        std::fs::write(&file, wanted).unwrap();
    }
    let found = std::fs::read_to_string(&file).unwrap_or_default();
    if found != wanted {
        let line = found.lines().zip(wanted.lines()).position(|(a, b)| a != b).unwrap_or(0);
        panic!(
            "{path} is not what the sources say, from line {}: `{}` where `{}` is expected. If the change is meant, run \
             tools/bless, and raise NERTCA_ABI_VERSION when callers would break",
            line + 1,
            found.lines().nth(line).unwrap_or_default(),
            wanted.lines().nth(line).unwrap_or_default()
        );
    }
}

#[test]
fn the_header_is_generated() {
    let config = cbindgen::Config::from_file(root().join("cbindgen.toml")).unwrap();
    let mut header = Vec::new();
    let sources = [
        "boundary",
        "status",
        "types",
        "log",
        "context",
        "reconstruction",
        "calibration",
        "training",
        "output",
        "semaphores",
        "tree",
        "truth",
    ];
    let builder = sources.iter().fold(cbindgen::Builder::new().with_config(config), |builder, name| {
        builder.with_src(root().join(format!("crates/capi/src/{name}.rs")))
    });
    builder.generate().unwrap().write(&mut header);
    expect_file("include/nertca_vk.h", &String::from_utf8(header).unwrap());
}

#[test]
fn the_header_is_clean_in_c_and_cpp() {
    for (compiler, flags) in [
        ("gcc", vec!["-std=c99", "-xc"]),
        ("clang", vec!["-std=c99", "-xc"]),
        ("g++", vec!["-std=c++11", "-xc++"]),
        ("clang++", vec!["-std=c++11", "-xc++"]),
    ] {
        let strict = ["-Wall", "-Wextra", "-Wpedantic", "-Werror", "-fsyntax-only"];
        for header in ["nertca_vk.h", "nertca_vk.hpp"] {
            if header.ends_with("hpp") && !compiler.ends_with("++") {
                continue;
            }
            let outcome = Command::new(compiler)
                .args(strict)
                .args(&flags)
                .arg(root().join("include").join(header))
                .output()
                .unwrap_or_else(|e| panic!("{compiler}: {e}"));
            // The header is compiled as a main file on purpose.
            let said = String::from_utf8_lossy(&outcome.stderr).replace("#pragma once in main file", "");
            assert!(outcome.status.success(), "{compiler} {header}: {said}");
        }
    }
}

#[test]
fn the_abi_is_what_it_was() {
    let header = std::fs::read_to_string(root().join("include/nertca_vk.h")).unwrap();
    let mut abi = String::from("# Symbols\n");
    let symbols = Command::new("nm").args(["-D", "--defined-only"]).arg(library()).output().unwrap();
    let symbols = String::from_utf8(symbols.stdout).unwrap();
    let mut names: Vec<_> = symbols.lines().filter_map(|l| l.split_whitespace().nth(2)).collect();
    names.sort_unstable();
    assert!(names.iter().all(|n| n.starts_with("nertca_")), "foreign symbols are exported: {names:?}");
    names.iter().for_each(|n| writeln!(abi, "{n}").unwrap());
    let constants: Vec<_> = header
        .lines()
        .filter_map(|l| l.strip_prefix("#define NERTCA_")?.split(' ').next())
        .filter(|n| *n != "VK_H")
        .collect();
    // Sizes and offsets as computed by a C compiler.
    let mut program = String::from("#include \"nertca_vk.h\"\n#include <stdio.h>\nint main(void) {\n");
    for name in constants {
        writeln!(program, "printf(\"NERTCA_{name} %d\\n\", (int)NERTCA_{name});").unwrap();
    }
    let without_comments = strip_comments(&header);
    for part in without_comments.split("typedef struct {").skip(1) {
        let (fields, rest) = part.split_once('}').unwrap();
        let name = rest.split(';').next().unwrap().trim();
        writeln!(program, "printf(\"{name} %zu\\n\", sizeof({name}));").unwrap();
        for field in fields.split(';').map(str::trim).filter(|f| !f.is_empty()) {
            let field = match field.split_once("(*") {
                Some((_, rest)) => rest.split(')').next().unwrap(),
                None => field.rsplit([' ', '*']).next().unwrap().split('[').next().unwrap(),
            };
            writeln!(
                program,
                "printf(\"  {field} %zu %zu\\n\", offsetof({name}, {field}), sizeof((({name}*)0)->{field}));"
            )
            .unwrap();
        }
    }
    program.push_str("return 0; }\n");
    let dir = tempfile::tempdir().unwrap();
    std::fs::write(dir.path().join("layout.c"), program).unwrap();
    let binary = compile("gcc", &["-std=c99"], &dir.path().join("layout.c"), dir.path());
    let layout = Command::new(binary).output().unwrap();
    abi.push_str("\n# Constants; structs: size, then offset and size of each field, on 64-bit machines\n");
    abi.push_str(&String::from_utf8(layout.stdout).unwrap());
    assert!(abi.contains("nertca_frame "), "structs were not found in the header");
    expect_file("tests/capi/abi.txt", &abi);
}

fn strip_comments(text: &str) -> String {
    let mut parts = text.split("/*");
    let first = parts.next().unwrap_or_default().to_owned();
    parts.fold(first, |all, part| all + part.split_once("*/").map_or("", |(_, rest)| rest))
}
