//! The archive of `tools/package` works in any directory: for pkg-config, for CMake, and as a program.

use crate::root::root;
use std::path::{Path, PathBuf};
use std::process::Command;

#[track_caller]
fn run(command: &mut Command) -> String {
    let outcome = command.output().unwrap_or_else(|e| panic!("{command:?}: {e}"));
    let said = String::from_utf8_lossy(&outcome.stdout).into_owned();
    let complained = String::from_utf8_lossy(&outcome.stderr);
    assert!(outcome.status.success(), "{command:?}: {}\n{said}\n{complained}", outcome.status);
    said
}

/// Unpacks the archive into a directory that was unknown when it was made.
fn unpacked(scratch: &Path) -> PathBuf {
    // Directory of this test's build: target/release/deps/package-0123456789abcdef.
    let target = std::env::current_exe().unwrap().ancestors().nth(3).unwrap().to_path_buf();
    let tool = root().join("tools/package");
    let said = run(Command::new(tool).arg(scratch.join("made")).env("CARGO_TARGET_DIR", target));
    let archive = PathBuf::from(said.lines().last().unwrap());
    let elsewhere = scratch.join("else where");
    std::fs::create_dir(&elsewhere).unwrap();
    run(Command::new("tar").arg("--extract").arg("--file").arg(&archive).arg("--directory").arg(&elsewhere));
    let name = archive.file_name().unwrap().to_str().unwrap().trim_end_matches(".tar.gz");
    let place = elsewhere.join("nertca");
    std::fs::rename(elsewhere.join(name), &place).unwrap();
    place
}

fn embeds(program: &Path, place: &Path) {
    let picture = program.with_extension("png");
    let said = run(Command::new(program).args(["20", ""]).arg(&picture).env("LD_LIBRARY_PATH", place.join("lib")));
    assert!(said.contains("Dice "), "{said}");
}

#[test]
#[ignore = "builds everything once more, for any Linux: tools/test --packages"]
fn the_archive_works_wherever_it_is_unpacked() {
    let scratch = tempfile::tempdir().unwrap();
    let place = unpacked(scratch.path());
    for file in ["include/nertca_vk.hpp", "share/licenses/nertca-vk/THIRD-PARTY-LICENCES.txt", "README.md"] {
        assert!(place.join(file).is_file(), "{file}");
    }
    let version = run(Command::new(place.join("bin/nertca-vk")).arg("--version"));
    assert_eq!(version.trim(), concat!("nertca-vk ", env!("CARGO_PKG_VERSION")));
    for binary in ["bin/nertca-vk", "lib/libnertca_vk.so"] {
        let sections = run(Command::new("readelf").args(["--wide", "--section-headers"]).arg(place.join(binary)));
        assert!(!sections.contains(".debug_info") && !sections.contains(".symtab"), "{binary}: {sections}");
    }

    // With pkg-config, a shell splits the flags and keeps escaped characters.
    let program = scratch.path().join("by-pkg-config");
    let script = r#"eval "cc '$1' -o '$2' $(pkg-config --cflags --libs nertca_vk) -lm""#;
    let source = root().join("examples/c/embed.c");
    let mut compile = Command::new("sh");
    compile.args(["-c", script, "sh"]).arg(source).arg(&program).env("PKG_CONFIG_PATH", place.join("lib/pkgconfig"));
    run(&mut compile);
    embeds(&program, &place);

    let build = scratch.path().join("by-cmake");
    let prefix = format!("-DCMAKE_PREFIX_PATH={}", place.display());
    run(Command::new("cmake").arg("-S").arg(root().join("examples/cmake")).arg("-B").arg(&build).arg(prefix));
    run(Command::new("cmake").arg("--build").arg(&build));
    embeds(&build.join("embed"), &place);
}
