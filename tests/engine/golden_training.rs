//! Comparison of whole trainings with those of an independent PyTorch implementation in float64
//! (`tools/reference_training.py`): losses and all parameters after some of 300 iterations, across the delay of the dynamic
//! field.

use crate::common::{expect_silence, gpu, tuning};
use crate::golden_fields::{gather, terms_of_engine};
use crate::golden_file::Golden;
use nertca_vk::config::Preset;
use nertca_vk::fields::data::FieldData;
use nertca_vk::gpu::device::Gpu;
use nertca_vk::kernels::layout::Schedule;
use nertca_vk::kernels::tuning::{Layers, Tuning};
use nertca_vk::plan::Plan;
use nertca_vk::train::trainer::Trainer;

/// Maximum difference, in multiples of the spread of the script's own float32 runs. The engine sums in other orders, and
/// has other sines and exponentials.
const SPREADS: f64 = 4.0;

/// Maximum difference so far, in spreads, and its key.
#[derive(Default)]
struct Worst {
    spreads: f64,
    key: String,
}

impl Worst {
    /// Compares two vectors as a whole.
    fn compare(&mut self, key: &str, spread: f64, got: &[f64], want: &[f64]) {
        assert_eq!(got.len(), want.len(), "{key}");
        let length = |values: &mut dyn Iterator<Item = f64>| values.map(|v| v * v).sum::<f64>().sqrt();
        let off = length(&mut got.iter().zip(want).map(|(g, w)| g - w)) / length(&mut want.iter().copied()).max(1e-300);
        // A difference that is not a number counts as the maximum.
        let spreads = off / spread;
        if spreads.is_nan() || spreads > self.spreads {
            *self = Worst { spreads, key: key.into() };
        }
    }

    /// Compares the parameters of each field, or of two networks together.
    fn compare_parameters(&mut self, golden: &Golden, iteration: u32, params: &[f32], plan: &Plan) {
        let fields: &[(&str, &str)] = match plan.params.static_network {
            Some(_) => &[("fields", "")],
            None => &[("static", "static"), ("dynamic", "dynamic")],
        };
        for (name, prefix) in fields {
            let (mut got, mut want) = (Vec::new(), Vec::new());
            for tensor in plan.params.tensors().iter().filter(|tensor| tensor.name.starts_with(prefix)) {
                want.extend(golden.get(&format!("{iteration}/{}", tensor.name)));
                got.extend(tensor.positions.iter().map(|at| f64::from(params[*at as usize])));
            }
            assert!(!got.is_empty(), "{name}");
            let key = format!("{iteration}/{name}");
            self.compare(&key, golden.get(&format!("spread/{key}"))[0], &got, &want);
        }
    }
}

/// Trains like the golden case, with the plan's schedule.
fn train(gpu: &Gpu, golden: &Golden, plan: Plan) -> Worst {
    let tuning = Tuning { layers: Layers::F32, ..tuning(gpu) };
    let mut trainer = Trainer::new(gpu, plan, &golden.dataset(), tuning).unwrap();
    let initial: Vec<f32> = gather(golden, trainer.plan(), "initial").iter().map(|v| *v as f32).collect();
    gpu.upload(&trainer.fields().unwrap().forward().params, 0, &initial).unwrap();
    let compared = golden.case["compared"].as_array().unwrap().iter().map(|n| n.as_u64().unwrap() as u32);
    let mut worst = Worst::default();
    for iteration in compared {
        let mut last = None;
        while trainer.step() < iteration {
            last = trainer.advance(iteration).unwrap().pop();
        }
        let last = last.unwrap();
        assert_eq!(last.step, iteration);
        assert_eq!(last.live_samples as f64, golden.get(&format!("{iteration}/loss/live"))[0], "{iteration}");
        let spread = golden.get(&format!("spread/{iteration}/loss"))[0];
        // Two networks have no total variation.
        for (term, got) in terms_of_engine(&last).into_iter().filter(|(term, _)| has_term(golden, iteration, term)) {
            let key = format!("{iteration}/loss/{term}");
            worst.compare(&key, spread, &[got], &golden.get(&key));
        }
        let params = trainer.model().unwrap().params;
        worst.compare_parameters(golden, iteration, &params, trainer.plan());
    }
    worst
}

fn has_term(golden: &Golden, iteration: u32, term: &str) -> bool {
    term != "tv" || golden.has(&format!("{iteration}/loss/tv"))
}

/// Fails unless the engine trains like the script, and unless each fault in the schedule is detected.
fn check(golden: &Golden, plan: impl Fn() -> Plan, faults: &[(&str, Fault)]) {
    let gpu = gpu();
    let Worst { spreads, key } = train(&gpu, golden, plan());
    assert!(spreads <= SPREADS, "{key}: off by {spreads:.1} spreads");
    for (fault, plant) in faults {
        let mut plan = plan();
        plant(&mut plan.data_mut::<FieldData>().unwrap().schedule, golden.number("delay") as usize);
        let Worst { spreads, key } = train(&gpu, golden, plan);
        assert!(spreads > 100.0 * SPREADS, "{fault}: seen by {spreads:.1} spreads at most, in {key}");
    }
    expect_silence(gpu);
}

/// Changes the schedule of a run with a delay.
type Fault = fn(&mut [Schedule], usize);

/// Fault: rates continue after the delay instead of restarting.
fn rates_go_on(schedule: &mut [Schedule], delay: usize) {
    let before = schedule[delay].static_update.rate / schedule[delay + 1].static_update.rate;
    for row in &mut schedule[delay + 1..] {
        row.static_update.rate *= before;
        row.dynamic_update.rate *= before;
    }
}

/// Fault: moments from before the delay are kept.
fn moments_are_kept(schedule: &mut [Schedule], delay: usize) {
    schedule[delay + 1].static_update.restart = 0;
    schedule[delay + 1].dynamic_update.restart = 0;
}

/// Fault: the dynamic field takes no step before moments and rates restart.
fn a_step_is_missing(schedule: &mut [Schedule], delay: usize) {
    schedule[delay].dynamic_update.rate = 0.0;
}

/// Fault: weights of losses are an iteration late.
fn weights_come_late(schedule: &mut [Schedule], _: usize) {
    for step in (1..schedule.len()).rev() {
        schedule[step].favour_static = schedule[step - 1].favour_static;
        schedule[step].near_integral = schedule[step - 1].near_integral;
    }
}

fn nert_ca(preset: Preset, name: &str) {
    let golden = Golden::open(name, "tools/reference_training.py");
    let plan = || Plan::new(&golden.config(preset), &golden.dataset()).unwrap().in_scene(golden.scene());
    check(
        &golden,
        plan,
        &[
            ("rates go on", rates_go_on),
            ("moments are kept", moments_are_kept),
            ("a step is missing", a_step_is_missing),
        ],
    );
}

#[test]
fn paper() {
    nert_ca(Preset::Paper, "training-paper");
}

#[test]
fn public_code() {
    nert_ca(Preset::PublicCode, "training-public-code");
}

#[test]
fn nerf_ca() {
    let golden = Golden::open("training-nerf-ca", "tools/reference_training.py");
    let plan = || Plan::new(&golden.networks(), &golden.dataset()).unwrap();
    check(&golden, plan, &[("weights come late", weights_come_late)]);
}
