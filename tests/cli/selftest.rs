//! The self-test of the program and its list of kernels.

use crate::program::program;
use serde_json::Value;
use std::path::Path;
use std::sync::OnceLock;

const OF_MATRICES: [&str; 4] = ["mlp_fused_bwd", "mlp_fused_bwd_first", "mlp_fused_fwd", "mlp_pack"];

fn printed(arguments: &[&str]) -> Vec<u8> {
    let output = program().args(arguments).output().unwrap();
    let words = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(output.status.success(), "{words}");
    output.stdout
}

/// Output of the self-test, which is run once.
pub fn of_all_stages() -> &'static [u8] {
    static PRINTED: OnceLock<Vec<u8>> = OnceLock::new();
    PRINTED.get_or_init(|| printed(&["selftest", "--json"]))
}

#[test]
fn the_program_compares_every_stage_and_passes() {
    let answer: Value = serde_json::from_slice(of_all_stages()).unwrap();
    let rows = answer["rows"].as_array().unwrap();
    for row in rows {
        assert!(row["deviation"].as_f64().unwrap() <= row["tolerance"].as_f64().unwrap(), "{row}");
    }
    assert_eq!((&answer["ok"], rows.len() > 40), (&Value::Bool(true), true));
    let has_matrices = !answer["device"]["matrices"].as_array().unwrap().is_empty();
    let untested: Vec<&str> = answer["untested"].as_array().unwrap().iter().map(|s| s.as_str().unwrap()).collect();
    assert_eq!(untested, if has_matrices { &[] } else { &OF_MATRICES[..] }, "a stage without a comparison");
}

#[test]
fn kernels_are_listed_and_compared() {
    let listed: Value = serde_json::from_slice(&printed(&["kernels", "--preset", "fast-mlp", "--json"])).unwrap();
    let kernels = listed["kernels"].as_array().unwrap();
    let named = |name: &str| kernels.iter().any(|k| k["kernel"].as_str().unwrap().starts_with(name));
    assert!(named("march_loss") && named("adam") && !named("gaussian_splat"), "{listed}");
    let directory = tempfile::tempdir().unwrap();
    let file = directory.path().join("before.json");
    let compare = |before: &Value, file: &Path| {
        std::fs::write(file, before.to_string()).unwrap();
        program().args(["kernels", "--preset", "fast-mlp", "--compare", file.to_str().unwrap()]).output().unwrap()
    };
    let same = compare(&listed, &file);
    assert!(same.status.success() && same.stderr.is_empty(), "{}", String::from_utf8_lossy(&same.stderr));
    // A changed constant gives another build.
    let mut other = listed.clone();
    other["kernels"][0]["lanes"] = 7.into();
    let words = String::from_utf8(compare(&other, &file).stderr).unwrap();
    assert!(words.contains(": new") && words.contains(": gone"), "{words}");
    let broken = compare(&Value::from(3), &file);
    assert_eq!(broken.status.code(), Some(1));
    assert!(String::from_utf8_lossy(&broken.stderr).contains("kernels --json"));
}
