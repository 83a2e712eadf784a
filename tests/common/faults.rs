//! Faults planted in the shader code that the driver receives, to be found by comparisons with the f64 twins.
#![allow(dead_code, missing_docs, clippy::unwrap_used, clippy::expect_used, reason = "each test file uses its part")]

use crate::common::tuning;
use crate::shim;
use nertca_vk::error::Result;
use nertca_vk::gpu::buffer::Operands;
use nertca_vk::gpu::device::{DeviceOptions, Gpu};
use nertca_vk::kernels::stages::kernel_code;
use nertca_vk_twins::selftest::compare::Findings;

const CONSTANT: u32 = 43;
const STORE: u32 = 62;
const ADD: u32 = 129;
const SUBTRACT: u32 = 131;
const MULTIPLY: u32 = 133;
const GREATER: u32 = 186;
const SMALLER: u32 = 184;
const WHOLE_ADD: u32 = 128;
const WHOLE_SUBTRACT: u32 = 130;
const SHIFT_RIGHT: u32 = 194;
const SHIFT_LEFT: u32 = 196;
const LESS: u32 = 176;
const LESS_OR_EQUAL: u32 = 178;

/// Instructions of SPIR-V by position: operation and length in words.
pub fn instructions(words: &[u32]) -> Vec<(usize, u32, usize)> {
    const HEADER: usize = 5;
    let (mut at, mut found) = (HEADER, Vec::new());
    while at < words.len() {
        let length = (words[at] >> 16) as usize;
        found.push((at, words[at] & 0xffff, length));
        at += length;
    }
    found
}

/// Replaces an operation by another of the same shape, everywhere.
fn replace(words: &mut [u32], from: u32, to: u32) {
    for (at, ..) in instructions(words).into_iter().filter(|(_, operation, _)| *operation == from) {
        words[at] = words[at] & 0xffff_0000 | to;
    }
}

pub fn wrong_sign(words: &mut [u32]) {
    replace(words, SUBTRACT, ADD);
}

pub fn sum_for_product(words: &mut [u32]) {
    replace(words, MULTIPLY, ADD);
}

pub fn less_for_greater(words: &mut [u32]) {
    replace(words, GREATER, SMALLER);
}

pub fn differences(words: &mut [u32]) {
    replace(words, WHOLE_ADD, WHOLE_SUBTRACT);
}

pub fn other_digits(words: &mut [u32]) {
    replace(words, SHIFT_RIGHT, SHIFT_LEFT);
}

/// Unsuitable for stages that sum over a workgroup: they would read shared memory that was never written, sometimes NaN.
pub fn one_too_many(words: &mut [u32]) {
    replace(words, LESS, LESS_OR_EQUAL);
}

pub fn difference_for_sum(words: &mut [u32]) {
    replace(words, ADD, SUBTRACT);
}

/// Removes stores of zero.
pub fn missing_clear(words: &mut [u32]) {
    const NOTHING: u32 = 1 << 16;
    let all = instructions(words);
    let zeros: Vec<u32> =
        all.iter().filter(|i| i.1 == CONSTANT && words[i.0 + 3] == 0).map(|i| words[i.0 + 2]).collect();
    for (at, _, length) in all.into_iter().filter(|(_, operation, _)| *operation == STORE) {
        if zeros.contains(&words[at + 2]) {
            words[at..at + length].fill(NOTHING);
        }
    }
}

/// Removes all stores.
pub fn no_stores(words: &mut [u32]) {
    const NOTHING: u32 = 1 << 16;
    for (at, _, length) in instructions(words).into_iter().filter(|(_, operation, _)| *operation == STORE) {
        words[at..at + length].fill(NOTHING);
    }
}

/// The comparison that must find a fault.
pub type Compare = fn(&Gpu, &mut Findings) -> Result<()>;

/// A fault in the code of a stage.
pub struct Fault {
    stage: &'static str,
    variant: Option<&'static str>,
    plant: fn(&mut [u32]),
    compare: Compare,
}

pub fn fault(stage: &'static str, plant: fn(&mut [u32]), compare: Compare) -> Fault {
    Fault { stage, variant: None, plant, compare }
}

impl Fault {
    /// Returns the fault for another variant of the shader than the device's default.
    pub fn in_variant(self, name: &'static str) -> Fault {
        Fault { variant: Some(name), ..self }
    }
}

/// Code of a stage that the device receives, in a given variant if one is requested.
pub fn code(gpu: &Gpu, stage: &str, variant_asked: Option<&str>) -> Vec<u32> {
    let named = |variant: &str| kernel_code(&format!("{stage}{variant}"));
    if let Some(name) = variant_asked {
        return bytemuck::pod_collect_to_vec(named(&format!("_{name}")).unwrap().spirv);
    }
    let (exchanges, int64) = (gpu.info().full_subgroups.is_some(), gpu.info().int64_atomics);
    let variants = [
        ("_texel", tuning(gpu).operands == Operands::Texel),
        ("_subgroup_int64", exchanges && int64),
        ("_subgroup", exchanges),
        ("_int64", int64),
        ("", true),
    ];
    let taken = variants.iter().filter(|(_, taken)| *taken).find_map(|(variant, _)| named(variant).ok());
    bytemuck::pod_collect_to_vec(taken.unwrap().spirv)
}

/// Expects that nothing is found without a fault, and that each fault is found first in the row of its stage.
pub fn expect_found(faults: &[Fault]) {
    // Comparisons that found nothing without a fault.
    let mut silent: Vec<Compare> = Vec::new();
    for Fault { stage, variant, plant, compare } in faults {
        shim::begin(shim::Failing::None);
        let open = || Gpu::open(&DeviceOptions { loader: Some(shim::loader()), ..DeviceOptions::default() }).unwrap();
        let first_failure = || {
            let mut findings = Findings::default();
            let outcome = compare(&open(), &mut findings);
            let found = findings.rows().iter().find(|row| !row.is_ok()).map(|row| row.stages.clone());
            // A fault may end the following comparisons with an error.
            assert!(found.is_some() || outcome.is_ok(), "{stage}: {outcome:?}");
            found
        };
        if !silent.iter().any(|known| std::ptr::fn_addr_eq(*known, *compare)) {
            assert_eq!(first_failure(), None, "without a fault");
            silent.push(*compare);
        }
        let words = code(&open(), stage, *variant);
        let mut faulty = words.clone();
        plant(&mut faulty);
        assert!(words != faulty, "{stage} has no such instruction");
        shim::plant(words, faulty);
        let found = first_failure().unwrap_or_else(|| panic!("the fault in {stage} was not seen"));
        println!("{stage}: {found:?}");
        assert!(found.contains(stage), "the fault in {stage} was seen in {found:?}");
    }
    shim::begin(shim::Failing::None);
}
