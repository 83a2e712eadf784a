//! The examples are built as users would build them and run on the available device: with gcc and clang, under the address
//! and undefined-behaviour sanitizers, under valgrind; in C++ and in Python.

use crate::c_library::{compile, library, library_directory};
use crate::python::python;
use crate::root::root;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

fn example(name: &str) -> PathBuf {
    root().join("examples").join(name)
}

#[track_caller]
fn run(command: &mut Command) -> Output {
    let outcome = command.output().unwrap_or_else(|e| panic!("{command:?}: {e}"));
    assert!(
        outcome.status.success(),
        "{command:?}: {}\n{}\n{}",
        outcome.status,
        String::from_utf8_lossy(&outcome.stdout),
        String::from_utf8_lossy(&outcome.stderr)
    );
    outcome
}

fn number_after(text: &str, label: &str) -> f64 {
    let rest = text.split(label).nth(1).unwrap_or_else(|| panic!("no `{label}` in: {text}"));
    rest.trim_start().split(|c: char| !(c.is_ascii_digit() || c == '.')).next().unwrap().parse().unwrap()
}

#[test]
fn embed_reconstructs_what_it_was_given() {
    let dir = tempfile::tempdir().unwrap();
    for compiler in ["gcc", "clang"] {
        let binary = compile(compiler, &["-std=c99"], &example("c/embed.c"), dir.path());
        let picture = dir.path().join("embed.png");
        let outcome = run(Command::new(binary).args(["200", "validation = true"]).arg(&picture));
        assert_eq!(String::from_utf8_lossy(&outcome.stderr), "", "warnings and errors go to its log");
        let said = String::from_utf8(outcome.stdout).unwrap();
        let dice = number_after(&said, "Dice ");
        assert!(dice > 0.6, "{said}");
        let picture = image::open(&picture).unwrap().to_luma8();
        assert_eq!(picture.dimensions(), (200, 200));
        assert!(picture.pixels().any(|p| p.0[0] == 255) && picture.pixels().any(|p| p.0[0] == 0));
    }
}

#[test]
fn live_draws_while_it_trains() {
    let dir = tempfile::tempdir().unwrap();
    let binary = compile("gcc", &["-std=c99"], &example("c/live.c"), dir.path());
    // The example fails with a message if there are no pictures, if training stops, or if pictures do not follow training.
    let said = String::from_utf8(run(Command::new(binary).args(["12", "20", "validation = true"])).stdout).unwrap();
    assert!(said.contains("12 pictures of 200 x 200 while training"), "{said}");
    assert!(number_after(&said, "\ntraining: ") > 0.0 && number_after(&said, "median ") > 0.0, "{said}");
}

/// Manifest and library of lavapipe. Leaks are checked on this one driver only: a loader opens and closes every driver and
/// layer of a machine, and their leaks would be reported for an unknown module.
fn lavapipe() -> (PathBuf, PathBuf) {
    let directories = ["/usr/share/vulkan/icd.d", "/usr/local/share/vulkan/icd.d", "/etc/vulkan/icd.d"];
    let manifest = directories
        .iter()
        .filter_map(|directory| std::fs::read_dir(directory).ok())
        .flat_map(|entries| entries.map(|entry| entry.unwrap().path()))
        .find(|path| path.file_name().unwrap().to_string_lossy().starts_with("lvp_icd"))
        .unwrap_or_else(|| panic!("lavapipe (Debian: mesa-vulkan-drivers) is needed in one of {directories:?}"));
    let content: serde_json::Value = serde_json::from_slice(&std::fs::read(&manifest).unwrap()).unwrap();
    let library = Path::new(content["ICD"]["library_path"].as_str().unwrap());
    // A path with a directory is relative to the manifest; a bare name is searched in the library directories.
    let beside = library.components().count() > 1;
    let library = if beside { manifest.parent().unwrap().join(library) } else { library.to_path_buf() };
    (manifest, library)
}

/// The driver compiles at run time and keeps memory: leaks are checked in the allocations of the example and of the library
/// only.
fn run_sanitized(compiler: &str, dir: &Path) {
    let keep = root().join("tests/capi/keep_driver.c");
    let flags = ["-std=c99", "-fsanitize=address,undefined", "-fno-sanitize-recover=all", "-fno-omit-frame-pointer"];
    let binary = compile(compiler, &[&flags[..], &[keep.to_str().unwrap()]].concat(), &example("c/embed.c"), dir);
    let suppressions = dir.join("lsan.txt");
    std::fs::write(&suppressions, "leak:libvulkan\nleak:libLLVM\n").unwrap();
    let (manifest, library) = lavapipe();
    run(Command::new(binary)
        .args(["20", ""])
        .arg(dir.join("sanitized.png"))
        .env("VK_DRIVER_FILES", manifest)
        .env("VK_LOADER_LAYERS_DISABLE", "~implicit~")
        .env("KEEP_DRIVER", library)
        .env("LSAN_OPTIONS", format!("suppressions={}:print_suppressions=0", suppressions.display()))
        .env("ASAN_OPTIONS", "detect_leaks=1"));
}

#[test]
#[ignore = "long: tools/test --all"]
fn embed_is_clean_under_sanitizers() {
    let dir = tempfile::tempdir().unwrap();
    run_sanitized("gcc", dir.path());
    run_sanitized("clang", dir.path());
}

#[test]
fn embed_is_clean_under_valgrind() {
    let dir = tempfile::tempdir().unwrap();
    // valgrind cannot run every instruction that a driver may compile for this machine, so this program uses no device.
    let source = dir.path().join("without_device.c");
    std::fs::write(
        &source,
        "#include \"nertca_vk.h\"\n#include \"phantom.h\"\nint main(void) {\n\
         nertca_context *c; nertca_reconstruction *r; static float p[32 * 32]; char t[256];\n\
         if (nertca_context_create(\"device = none\", NULL, &c)) return 1;\n\
         for (int n = 0; n < 3; n++) {\n\
         if (nertca_reconstruction_create(c, \"phases = 8\", &r)) return 2;\n\
         for (int phase = 0; phase < 9; phase++) {\n\
         nertca_geometry g = phantom_geometry(phantom_views[0][0], phantom_views[0][1], 32);\n\
         phantom_image(&g, 32, phase, p, NULL);\n\
         nertca_frame f = phantom_frame(&g, 32, phase, p, NULL);\n\
         if (nertca_reconstruction_add_frame(r, &f) != (phase < 8 ? NERTCA_OK : NERTCA_ERROR_ARGUMENT)) return 3; }\n\
         if (nertca_reconstruction_train(r, 1, NULL, NULL, NULL) != NERTCA_ERROR_DEVICE) return 4;\n\
         nertca_last_error(r, t, sizeof t, NULL);\n\
         if (nertca_reconstruction_destroy(r)) return 5;\n\
         if (nertca_reconstruction_stop(r) != NERTCA_ERROR_HANDLE) return 6; }\n\
         return nertca_context_destroy(c); }\n",
    )
    .unwrap();
    let include = root().join("examples/c");
    let binary = compile("gcc", &["-std=c99", "-I", include.to_str().unwrap()], &source, dir.path());
    let checks = ["--quiet", "--error-exitcode=9", "--leak-check=full", "--errors-for-leak-kinds=definite"];
    run(Command::new("valgrind").args(checks).arg(binary));
}

#[test]
#[ignore = "long: tools/test --all"]
fn a_process_may_load_close_and_fork() {
    let dir = tempfile::tempdir().unwrap();
    let binary = compile("gcc", &["-std=c99", "-Wno-pedantic"], &root().join("tests/capi/process.c"), dir.path());
    let outcome = run(Command::new(binary).arg(library()));
    assert_eq!((outcome.stdout, outcome.stderr), (Vec::new(), Vec::new()), "the library prints nothing");
}

#[test]
fn the_cpp_wrapper_works() {
    let dir = tempfile::tempdir().unwrap();
    for compiler in ["g++", "clang++"] {
        let binary = compile(compiler, &["-std=c++11"], &example("cpp/embed.cpp"), dir.path());
        let said = String::from_utf8(run(Command::new(binary).args(["60", "validation = true"])).stdout).unwrap();
        assert!(number_after(&said, "vessels:") > 0.05 && said.contains("phases go from 0 to 7"), "{said}");
    }
}

#[test]
fn python_loads_a_checkpoint() {
    let dir = tempfile::tempdir().unwrap();
    let source = dir.path().join("save.c");
    let program = std::fs::read_to_string(example("c/embed.c")).unwrap();
    let saving = program.replace(
        "  /* The moving vessels in 3D. */",
        "  check(nertca_reconstruction_save(reconstruction, \"checkpoint.safetensors\"), reconstruction, \"save\");\n",
    );
    std::fs::write(&source, saving).unwrap();
    let include = example("c");
    let binary = compile("gcc", &["-std=c99", "-I", include.to_str().unwrap()], &source, dir.path());
    run(Command::new(binary).arg("40").current_dir(dir.path()));
    let soname = library_directory(dir.path()).join("libnertca_vk.so.0");
    let said = run(python()
        .arg(example("python/embed.py"))
        .args(["checkpoint.safetensors", "beat.png"])
        .arg(soname)
        .current_dir(dir.path()));
    let said = String::from_utf8(said.stdout).unwrap();
    assert!(said.contains("8 phases"), "{said}");
    assert!(image::open(dir.path().join("beat.png")).unwrap().width() > 500);
}
