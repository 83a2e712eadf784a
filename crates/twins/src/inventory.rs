//! Lists every pipeline that runs of a configuration use on a device, with the statistics of its driver's compiler.

use crate::config::Config;
use crate::error::{Error, Result};
use crate::gpu::device::Gpu;
use crate::gpu::statistics::PipelineStatistics;
use crate::kernels::layout::Setup;
use crate::kernels::stages::Kernels;
use crate::kernels::tuning::Tuning;
use crate::methods;
use crate::model::params::ParamMap;
use crate::network::{Network, Purpose};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// Pipeline as the driver compiled it. Numbers that the driver does not report are none.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Compiled {
    /// Name of the kernel.
    pub kernel: String,
    /// Invocations of a workgroup.
    pub lanes: u32,
    /// Specialisation constants that were set.
    pub constants: BTreeMap<String, u32>,
    /// Invocations of a subgroup.
    pub subgroup_size: Option<u32>,
    /// Registers of an invocation; on Intel the maximum number that are live at once.
    pub registers: Option<f64>,
    /// Spilled registers in the driver's own units; the goal is 0.
    pub spills: Option<f64>,
    /// Shared memory of a workgroup, bytes.
    pub shared_bytes: Option<f64>,
    /// Number of subgroups that a processor holds at once, limited by registers, and on AMD also by shared memory and
    /// workgroups.
    pub resident: Option<f64>,
    /// Size of the code in bytes, or in instructions where the driver reports only those.
    pub code: Option<f64>,
    /// Compiler's estimate of cycles. It takes no account of memory or of how often loops run.
    pub cycles: Option<f64>,
}

/// Driver names of one quantity. The values of all names of one list are added up.
struct DriverNames(&'static [&'static [&'static str]]);

/// Names used by Mesa's drivers NVK, RADV and ANV, compared without regard to case. The first list of which a driver has any
/// name counts.
const REGISTERS: DriverNames = DriverNames(&[&["Number of GPRs"], &["VGPRs"], &["Max live registers"]]);
const SPILLS: DriverNames = DriverNames(&[
    &["Spills to memory", "Fills from memory"],
    &["Spilled VGPRs", "Spilled SGPRs"],
    &["Spills", "Fills"],
]);
const SHARED: DriverNames = DriverNames(&[&["LDS size"], &["Workgroup memory size"]]);
const RESIDENT: DriverNames = DriverNames(&[&["Max warps/SM"], &["Subgroups per SIMD"]]);
const CODE: DriverNames = DriverNames(&[&["Code size"], &["Instruction count", "Instructions"]]);
const CYCLES: DriverNames = DriverNames(&[&["Static cycle count"], &["Inverse Throughput"], &["Cycles"]]);

impl DriverNames {
    fn of(&self, numbers: &BTreeMap<String, f64>) -> Option<f64> {
        let number = |name: &&str| numbers.iter().find(|(n, _)| n.eq_ignore_ascii_case(name)).map(|(_, value)| *value);
        let sum = |names: &&[&str]| names.iter().filter_map(number).reduce(|a, b| a + b);
        self.0.iter().find_map(sum)
    }
}

impl Compiled {
    /// Maps the driver's numbers to the names used here.
    pub fn of(found: &PipelineStatistics) -> Compiled {
        let PipelineStatistics { kernel, lanes, constants, subgroup_size, numbers } = found;
        Compiled {
            kernel: (*kernel).to_owned(),
            lanes: *lanes,
            constants: constants.clone(),
            subgroup_size: *subgroup_size,
            registers: REGISTERS.of(numbers),
            spills: SPILLS.of(numbers),
            shared_bytes: SHARED.of(numbers),
            resident: RESIDENT.of(numbers),
            code: CODE.of(numbers),
            cycles: CYCLES.of(numbers),
        }
    }

    /// Tells whether both are builds of the same kernel with the same options.
    fn is_build_of(&self, other: &Compiled) -> bool {
        (&self.kernel, self.lanes, &self.constants) == (&other.kernel, other.lanes, &other.constants)
    }

    /// Returns the kernel's name and constants, for messages.
    pub fn name(&self) -> String {
        let constants: Vec<String> = self.constants.iter().map(|(name, value)| format!("{name}={value}")).collect();
        [std::slice::from_ref(&self.kernel), &constants[..]].concat().join(" ")
    }
}

/// Samples of a chunk that buffers are made for; pipelines do not depend on it.
const CAPACITY: u32 = 1024;

/// Builds every pipeline that training and rendering of a configuration use on `gpu`, through the same functions that they use.
/// The device must have been opened to keep statistics. Each build of a kernel is listed once, in the order of names.
///
/// # Errors
/// [`Error::Config`] where the network does not fit the device; [`Error::Internal`] for a device without statistics; errors of
/// [`Gpu::pipeline`].
pub fn compile(gpu: &Gpu, config: &Config, n_phases: usize, tuning: &Tuning) -> Result<Vec<Compiled>> {
    let tuning = tuning.clone().for_network(config.has_network());
    let params = ParamMap::new(config, n_phases);
    let setup = Setup { sample_capacity: CAPACITY, n_rays: 1, n_dynamic_samples: 1, ..Setup::default() };
    for purpose in [Purpose::Train, Purpose::Render] {
        params.networks().try_for_each(|map| Network::new(gpu, &tuning, &setup, map, purpose).map(|_| ()))?;
    }
    let training = config.fields().map(|settings| settings.march.static_samples);
    for samples in training.into_iter().chain([config.render.render_samples]) {
        Kernels::new(gpu, tuning.clone(), params.line_len() as u32, samples)?;
    }
    (methods::of(config).make_pipelines)(gpu, config, &tuning)?;
    let mut all: Vec<Compiled> = gpu.pipeline_statistics().iter().map(Compiled::of).collect();
    if all.is_empty() {
        return Err(Error::Internal("the device was not opened with pipeline statistics".into()));
    }
    all.sort_by_key(|c| (c.kernel.clone(), c.lanes, c.constants.clone()));
    all.dedup_by(|a, b| a.is_build_of(b));
    Ok(all)
}

/// Relative growth that a comparison tolerates, because compilers differ slightly between versions.
pub const GROWTH: f64 = 0.15;

/// Differences between two lists of pipelines: what got worse by more than [`GROWTH`], or spills; and all other differences.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Differences {
    /// Spills, growth, fewer subgroups at once; one sentence each.
    pub worse: Vec<String>,
    /// All other differences; one sentence each.
    pub other: Vec<String>,
}

/// Compares pipelines with those of `before`.
pub fn differences(before: &[Compiled], now: &[Compiled]) -> Differences {
    let mut found = Differences::default();
    for new in now {
        match before.iter().find(|old| old.is_build_of(new)) {
            Some(old) => found.compare(old, new),
            None => {
                found.other.push(format!("{}: new", new.name()));
                if new.spills.is_some_and(|spills| spills > 0.0) {
                    found.worse.push(format!("{}: spills {}", new.name(), new.spills.unwrap_or(0.0)));
                }
            }
        }
    }
    let gone = before.iter().filter(|old| !now.iter().any(|new| old.is_build_of(new)));
    found.other.extend(gone.map(|old| format!("{}: gone", old.name())));
    found
}

impl Differences {
    fn compare(&mut self, old: &Compiled, new: &Compiled) {
        for (what, before, now, allowed) in [
            ("spills", old.spills, new.spills, 0.0),
            ("registers", old.registers, new.registers, GROWTH),
            ("shared memory", old.shared_bytes, new.shared_bytes, GROWTH),
            ("code", old.code, new.code, GROWTH),
            ("cycles", old.cycles, new.cycles, GROWTH),
        ] {
            self.compare_number(new, what, before.zip(now), |before, now| now > before * (1.0 + allowed));
        }
        let resident = old.resident.zip(new.resident);
        self.compare_number(new, "resident subgroups", resident, |before, now| now < before / (1.0 + GROWTH));
    }

    fn compare_number(
        &mut self,
        of: &Compiled,
        what: &str,
        numbers: Option<(f64, f64)>,
        is_worse: impl Fn(f64, f64) -> bool,
    ) {
        let Some((before, now)) = numbers.filter(|(before, now)| before != now) else { return };
        let sentence = format!("{}: {what} {before} -> {now}", of.name());
        if is_worse(before, now) { self.worse.push(sentence) } else { self.other.push(sentence) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn compiled(kernel: &str, spills: f64, registers: f64, resident: f64) -> Compiled {
        Compiled {
            kernel: kernel.into(),
            lanes: 64,
            constants: BTreeMap::new(),
            subgroup_size: Some(32),
            registers: Some(registers),
            spills: Some(spills),
            shared_bytes: None,
            resident: Some(resident),
            code: None,
            cycles: None,
        }
    }

    #[test]
    fn spills_and_growth_are_worse_and_the_rest_is_told() {
        let before =
            [compiled("a", 0.0, 100.0, 16.0), compiled("b", 4.0, 100.0, 16.0), compiled("gone", 0.0, 1.0, 1.0)];
        let same = differences(&before, &before);
        assert_eq!(same, Differences::default());
        for (now, worse) in [
            (compiled("a", 1.0, 100.0, 16.0), Some("a: spills 0 -> 1")),
            (compiled("a", 0.0, 116.0, 16.0), Some("a: registers 100 -> 116")),
            (compiled("a", 0.0, 114.0, 16.0), None),
            (compiled("a", 0.0, 100.0, 12.0), Some("a: resident subgroups 16 -> 12")),
            (compiled("b", 3.0, 100.0, 16.0), None),
            (compiled("new", 2.0, 1.0, 1.0), Some("new: spills 2")),
        ] {
            let found = differences(&before, std::slice::from_ref(&now));
            assert_eq!(found.worse, worse.map(String::from).into_iter().collect::<Vec<_>>(), "{now:?}");
            assert!(found.other.iter().any(|other| other == "gone: gone"), "{found:?}");
        }
    }

    #[test]
    fn drivers_name_numbers_in_their_own_ways() {
        let of = |numbers: &[(&str, f64)], names: &DriverNames| {
            names.of(&numbers.iter().map(|(name, value)| ((*name).to_owned(), *value)).collect())
        };
        assert_eq!(of(&[("Spilled VGPRs", 2.0), ("Spilled SGPRs", 1.0)], &SPILLS), Some(3.0));
        assert_eq!(of(&[("Instruction Count", 7.0), ("Code Size", 112.0)], &CODE), Some(112.0));
        assert_eq!(of(&[("Hash", 1.0)], &CYCLES), None);
    }
}
