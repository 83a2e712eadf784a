//! The Python wheel is built, installed into an empty virtual environment like by its users, without access to a compiler,
//! and used: the example of docs/python.md, and the tests of tests/python/wheel.

use crate::python::python;
use crate::root::root;
use std::ffi::OsStr;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};
use std::sync::OnceLock;

const PLATFORM: &str = "manylinux_2_17_x86_64";
const MAX_WHEEL_BYTES: u64 = 25 << 20;

#[track_caller]
fn run(command: &mut Command) -> String {
    let outcome: Output = command.output().unwrap_or_else(|e| panic!("{command:?}: {e}"));
    let said = String::from_utf8_lossy(&outcome.stdout).into_owned();
    let complained = String::from_utf8_lossy(&outcome.stderr);
    assert!(outcome.status.success(), "{command:?}: {}\n{said}\n{complained}", outcome.status);
    said
}

/// A virtual environment with the wheel and its dependencies.
struct Installed {
    wheel: PathBuf,
    environment: PathBuf,
}

impl Installed {
    /// Command for a program of the environment, with nothing else on the PATH: neither compilers nor this checkout's
    /// tools.
    fn command(&self, name: impl AsRef<OsStr>) -> Command {
        let binaries = self.environment.join("bin");
        let mut command = Command::new(binaries.join(name.as_ref()));
        command.env("PATH", binaries).env("PYTHONDONTWRITEBYTECODE", "1").env_remove("PYTHONPATH");
        command.current_dir(&self.environment);
        command
    }

    fn add(&self, package: &str) {
        run(self.command("pip").args(["install", "--quiet", "--no-input", package]));
    }

    fn packages(&self) -> PathBuf {
        let script = "import sysconfig; print(sysconfig.get_path('purelib'))";
        PathBuf::from(run(self.command("python3").args(["-c", script])).trim())
    }
}

fn installed() -> &'static Installed {
    static INSTALLED: OnceLock<Installed> = OnceLock::new();
    INSTALLED.get_or_init(|| {
        let scratch = Path::new(env!("CARGO_TARGET_TMPDIR")).join("wheel");
        if scratch.exists() {
            std::fs::remove_dir_all(&scratch).unwrap();
        }
        // Cargo's lock is free, since it is held only while tests are built.
        let said =
            run(Command::new(root().join("tools/wheel")).arg(&scratch).env("CARGO_TARGET_DIR", target_directory()));
        let wheel = PathBuf::from(said.lines().last().unwrap());
        let environment = scratch.join("environment");
        run(python().args(["-m", "venv"]).arg(&environment));
        let installed = Installed { wheel, environment };
        run(installed.command("pip").args(["install", "--quiet", "--no-input"]).arg(&installed.wheel));
        installed
    })
}

/// Directory of this test's build: target/release/deps/wheel-0123456789abcdef.
fn target_directory() -> PathBuf {
    std::env::current_exe().unwrap().ancestors().nth(3).unwrap().to_path_buf()
}

fn megabytes(bytes: u64) -> f64 {
    bytes as f64 / 1e6
}

#[test]
#[ignore = "builds everything once more, for any Linux: tools/test --packages"]
fn the_wheel_is_small_stripped_and_whole() {
    let installed = installed();
    let name = installed.wheel.file_name().unwrap().to_str().unwrap();
    assert!(name.starts_with(concat!("nertca_vk-", env!("CARGO_PKG_VERSION"), "-py3-none-")), "{name}");
    assert!(name.contains(PLATFORM), "{name}");
    let bytes = installed.wheel.metadata().unwrap().len();
    assert!(bytes <= MAX_WHEEL_BYTES, "{:.1} MB", megabytes(bytes));
    let package = installed.packages().join("nertca_vk");
    for file in ["py.typed", "nertca_vk.h", "libnertca_vk.so", "reconstruction.py"] {
        assert!(package.join(file).is_file(), "{file}");
    }
    assert_eq!(
        std::fs::read(package.join("nertca_vk.h")).unwrap(),
        std::fs::read(root().join("include/nertca_vk.h")).unwrap()
    );
    for binary in [package.join("libnertca_vk.so"), installed.environment.join("bin/nertca-vk")] {
        let sections = run(Command::new("readelf").args(["--wide", "--section-headers"]).arg(&binary));
        assert!(!sections.contains(".debug_info") && !sections.contains(".symtab"), "{}: {sections}", binary.display());
    }
    // maturin checks the program's use of the C library, and auditwheel that of the library as well.
    let auditwheel = root().join(".cache/python/bin/auditwheel");
    let audited = run(Command::new(auditwheel).arg("show").arg(&installed.wheel));
    assert!(audited.contains("is consistent with") && audited.contains(PLATFORM), "{audited}");
}

#[test]
#[ignore = "builds everything once more, for any Linux: tools/test --packages"]
fn licences_of_everything_linked_come_along() {
    let information = installed().packages().join(format!("nertca_vk-{}.dist-info", env!("CARGO_PKG_VERSION")));
    let texts = std::fs::read_to_string(information.join("licenses/THIRD-PARTY-LICENCES.txt")).unwrap();
    let root = root();
    let tree = ["tree", "--locked", "--edges", "normal", "--prefix", "none", "--format", "{p}"];
    let tree = run(Command::new("cargo").args(tree).current_dir(&root));
    let crates: Vec<String> = tree
        .lines()
        .map(|line| line.split_whitespace().take(2).collect::<Vec<_>>().join(" ").replace(" v", " "))
        .filter(|krate| !krate.starts_with("nertca-vk"))
        .collect();
    assert!(crates.len() > 100, "{tree}");
    for krate in crates {
        assert!(texts.contains(&format!("\n{krate}: ")), "{krate}");
    }
    assert!(texts.contains("Permission is hereby granted") && texts.contains("Apache License"));
}

/// The library turns panics into errors, so unwinding must work in binaries linked by zig.
#[test]
#[ignore = "builds everything once more, for any Linux: tools/test --packages"]
fn panics_are_caught_in_what_zig_links() {
    let scratch = tempfile::tempdir().unwrap();
    let source = scratch.path().join("panics.rs");
    let program = "fn main() {
        let caught = std::panic::catch_unwind(|| [1, 2, 3][std::env::args().count() + 5]);
        println!(\"{}\", caught.is_err());
    }";
    std::fs::write(&source, program).unwrap();
    // Only binaries named like the distributed ones are linked by zig.
    let binary = scratch.path().join("deps/nertca_vk-panics");
    std::fs::create_dir(scratch.path().join("deps")).unwrap();
    let linker = format!("linker={}", root().join("tools/zig-linker").display());
    run(Command::new("rustc").args(["--edition", "2024", "-C", &linker, "-o"]).arg(&binary).arg(&source));
    let needed = run(Command::new("objdump").arg("-p").arg(&binary));
    assert!(!needed.contains("libgcc_s"), "cc linked it: {needed}");
    assert_eq!(run(&mut Command::new(&binary)), "true\n");
}

/// Returns the code block of docs/python.md in a language.
fn documented(language: &str) -> String {
    let text = std::fs::read_to_string(root().join("docs/python.md")).unwrap();
    let section = text.split("\n## From Python\n").nth(1).expect("docs/python.md has the section of the example");
    let section = section.split("\n## ").next().unwrap();
    let block =
        section.split(&format!("```{language}\n")).nth(1).unwrap_or_else(|| panic!("no {language} in docs/python.md"));
    block.split("```").next().unwrap().to_owned()
}

#[test]
#[ignore = "builds everything once more, for any Linux: tools/test --packages"]
fn readmes_example_runs_with_nothing_but_the_wheel() {
    let installed = installed();
    let scratch = tempfile::tempdir().unwrap();
    let phantom = documented("sh").lines().find(|line| line.starts_with("nertca-vk ")).expect("a phantom").to_owned();
    let phantom = phantom.split('#').next().unwrap().trim();
    let mut words = phantom.split_whitespace();
    run(installed.command(words.next().unwrap()).args(words).current_dir(scratch.path()));
    let example = scratch.path().join("example.py");
    std::fs::write(&example, documented("python")).unwrap();
    let said = run(installed.command("python3").arg(&example).current_dir(scratch.path()));
    assert!(said.contains("Scores(") && said.contains("images=40"), "{said}");
    let beat = "import numpy
beat = numpy.load('beat.npy')
print(beat.shape, beat.dtype, beat.std(0).max() > 0.1 * beat.max())";
    let said = run(installed.command("python3").args(["-c", beat]).current_dir(scratch.path()));
    assert_eq!(said.trim(), "(10, 100, 100) float32 True", "it beats");

    installed.add("matplotlib");
    let plots = root().join("examples/python/beat.py");
    let said = run(installed.command("python3").arg(plots).args(["phantom", "beat.png"]).current_dir(scratch.path()));
    assert!(said.contains("wrote beat.png"), "{said}");
    assert!(image::open(scratch.path().join("beat.png")).unwrap().width() > 1000);
}

#[test]
#[ignore = "builds everything once more, for any Linux: tools/test --packages"]
fn types_are_strict_inside_and_for_users() {
    let installed = installed();
    let scratch = tempfile::tempdir().unwrap();
    let example = scratch.path().join("example.py");
    std::fs::write(&example, documented("python")).unwrap();
    let wrong = scratch.path().join("wrong.py");
    std::fs::write(&wrong, "import nertca_vk\nnertca_vk.Reconstruction(phases=\"three\").render(5)\n").unwrap();
    let mypy = || {
        let mut command = python();
        command.args(["-m", "mypy", "--strict", "--no-error-summary"]);
        command.arg("--cache-dir").arg(scratch.path()).arg("--config-file").arg(root().join("pyproject.toml"));
        command
    };
    run(mypy().arg(root().join("python/nertca_vk")));
    // The package as users see it, through its installed types.
    let of_users = || {
        let mut command = mypy();
        command.arg("--python-executable").arg(installed.environment.join("bin/python3"));
        command
    };
    installed.add("matplotlib");
    run(of_users().arg(&example).arg(root().join("examples/python/beat.py")));
    installed.add("pytest");
    let tests = std::fs::read_dir(root().join("tests/python/wheel")).unwrap().map(|entry| entry.unwrap().path());
    let tests: Vec<PathBuf> =
        tests.filter(|path| path.extension().is_some_and(|extension| extension == "py")).collect();
    run(of_users().env("MYPYPATH", root().join("tests/python/wheel")).args(&tests));
    let refused = of_users().arg(&wrong).output().unwrap();
    let said = String::from_utf8_lossy(&refused.stdout);
    assert!(!refused.status.success() && said.contains("\"phases\"") && said.contains("\"shape\""), "{said}");
}

#[test]
#[ignore = "builds everything once more, for any Linux: tools/test --packages"]
fn the_package_keeps_what_it_promises() {
    let installed = installed();
    installed.add("pytest");
    let tests = root().join("tests/python/wheel");
    let pytest = ["-m", "pytest", "--quiet", "-p", "no:cacheprovider"];
    run(installed.command("python3").args(pytest).arg(tests));
}
