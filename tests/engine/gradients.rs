//! Comparison of the f64 twins with finite differences, and adjoint identities. Together with `kernels_vs_cpu.rs` this
//! closes the chain from the shaders to the definition of a derivative.

use crate::common::{small_config, uneven_dataset};
use glam::DVec3;
use nertca_vk::fields::data::FieldData;
use nertca_vk::plan::Plan;
use nertca_vk::random;
use nertca_vk_twins::reference::field::{self, Precision};
use nertca_vk_twins::reference::losses::Losses;
use nertca_vk_twins::reference::{march, step};
use nertca_vk_twins::selftest::networks::LARGE;

fn plan(preset: &str, settings: &[&str]) -> FieldData {
    let plan = Plan::new(&small_config(preset, settings), &uneven_dataset(9, 8)).unwrap();
    plan.data::<FieldData>().unwrap().clone()
}

fn start(plan: &FieldData) -> Vec<f64> {
    let mut params: Vec<f64> = plan.params.initial(plan.settings.seed).iter().map(|v| f64::from(*v)).collect();
    if plan.params.static_network.is_none() {
        params[..plan.params.static_len].iter_mut().for_each(|p| *p *= 30.0);
    }
    params
}

/// A field that has vanished reacts to rays that require more attenuation, and not more strongly to those that require
/// less.
#[test]
fn a_sleeping_field_is_called_back() {
    let asleep = ["dynamic.best_start=false", "dynamic.normalised_shift=-14"];
    let of = |min_slope: &str, more: bool| {
        let slope = format!("dynamic.min_slope={min_slope}");
        let mut plan = plan("fast-mlp", &[asleep[0], asleep[1], &slope]);
        if !more {
            // No ray requires positive attenuation.
            plan.images.iter_mut().flatten().for_each(|value| *value = -1.0);
        }
        let rays = march::batch(&plan, 0);
        let (_, gradient) = step::loss_and_gradient(&plan, &start(&plan), 0, &rays, Precision::Exact);
        gradient[plan.params.dynamic_network.as_ref().unwrap().out_bias]
    };
    let (deaf, hears) = (of("0", true), of("1e-3", true));
    assert!(deaf < 0.0 && hears < 0.0, "rays ask for more: {deaf}, {hears}");
    // The softplus's own slope at -14 is 8.3e-7.
    assert!((hears / deaf / 1.2e3 - 1.0).abs() < 0.2, "{deaf}, {hears}");
    let less = of("1e-3", false);
    assert!(less > 0.0 && less == of("0", false), "{less}");
}

#[test]
#[ignore = "long: tools/test --all"]
fn twin_gradient_is_the_derivative_of_the_twin_loss() {
    for (preset, settings) in [
        ("paper", &["dynamic.occlusion=1e-3", "loss.normalise=true"][..]),
        ("public-code", &["dynamic.occlusion=1e-3", "loss.normalise=true"]),
        // A minimum slope differs from that of the loss, so it is switched off.
        ("fast-mlp", &["dynamic.min_slope=0", "loss.dynamic_target=absolute"]),
        ("fast-mlp", &["dynamic.min_slope=0", "loss.robust=0"]),
        ("fast-mlp", &["dynamic.min_slope=0", "loss.robust=0.3"]),
        ("nerf-ca", LARGE),
        // Almost vanishing fields whose entropies still count; the near part of rays alone.
        (
            "nerf-ca",
            &[
                "networks.gain=1e-4",
                "networks.min_integral=0",
                "networks.ray_entropy=1",
                "networks.favour_static=1",
                "networks.delay=0",
                "networks.ramp=1",
                "dynamic.occlusion_share=0.3",
                "networks.near_integral_end=1",
            ],
        ),
    ] {
        let plan = plan(preset, settings);
        let params = start(&plan);
        let rays = march::batch(&plan, 3);
        let (losses, gradient) = step::loss_and_gradient(&plan, &params, 3, &rays, Precision::Exact);
        let temporal = plan.setup.temporal_target != 0;
        for tensor in plan.params.tensors() {
            // With a temporal target S is fitted to the residual of D, with D taken as constant: the two fields minimise
            // different objectives, and each is checked against its own.
            let is_static = tensor.name.starts_with("static");
            let of = |losses: &Losses| if temporal && !is_static { losses.dynamic } else { losses.total() };
            // Rounding errors of the loss, divided by the step.
            let rounding = 1e-8 * (1.0 + of(&losses));
            // A few elements of each tensor, with the largest gradient among a stride.
            let mut at: Vec<usize> = tensor.positions.iter().map(|p| *p as usize).collect();
            at.sort_by(|a, b| gradient[*b].abs().total_cmp(&gradient[*a].abs()));
            for &i in at.iter().step_by((at.len() / 3).max(1)).take(3) {
                let loss = |value: f64| {
                    let mut moved = params.clone();
                    moved[i] = value;
                    of(&step::loss_and_gradient(&plan, &moved, 3, &rays, Precision::Exact).0)
                };
                // Small enough to stay between ReLU kinks, large enough for f64 differences.
                let h = 1e-7;
                let difference = (loss(params[i] + h) - loss(params[i] - h)) / (2.0 * h);
                let error = (difference - gradient[i]).abs();
                assert!(
                    error <= 1e-4 * gradient[i].abs() + rounding,
                    "{preset} {}: {difference} against {}",
                    tensor.name,
                    gradient[i]
                );
            }
        }
    }
}

#[test]
fn temporal_residual_is_flat_between_its_bounds() {
    let plan = plan("fast-mlp", &["loss.robust=0"]);
    let params = start(&plan);
    let mut ray = march::ray(&plan, 40);
    let seen =
        march::fwd(&plan, &params, 0, &ray, march::NearPart::Depth(0.0), true, Precision::Exact).dynamic_integral;
    let gradient_with = |ray: &march::Ray| {
        let (_, g) = step::loss_and_gradient(&plan, &params, 0, std::slice::from_ref(ray), Precision::Exact);
        g[plan.params.dynamic_network.as_ref().unwrap().out_bias]
    };
    ray.temporal = [seen - 1.0, seen + 1.0];
    assert_eq!(gradient_with(&ray), 0.0);
    ray.temporal = [seen + 0.5, seen + 1.0];
    assert!(gradient_with(&ray) < 0.0, "too little attenuation must grow");
    ray.temporal = [seen - 1.0, seen - 0.5];
    assert!(gradient_with(&ray) > 0.0, "too much attenuation must shrink");
}

/// <A p, r> = <p, A' r> for the lookup: planes are linear in the feature when lines are fixed, and vice versa.
#[test]
fn lookup_and_scatter_are_adjoint() {
    let plan = plan("paper", &[]);
    let (s, p) = (&plan.setup, &plan.params);
    let random = |a: u32, b: u32| random::uniform01(9, 77, a, b) - 0.5;
    let mut fixed = vec![0.0; p.len];
    (0..p.static_len).for_each(|i| fixed[i] = random(0, i as u32));
    let lines = p.line(0, 0, 0)..p.static_len;
    for part in [0..lines.start, lines] {
        // The direction changes one factor only, so that the feature is linear along it.
        let mut direction = vec![0.0; p.len];
        part.clone().for_each(|i| direction[i] = random(1, i as u32));
        let mut moved = fixed.clone();
        part.clone().for_each(|i| moved[i] += direction[i]);
        let (mut left, mut scattered) = (0.0, vec![0.0; p.len]);
        for sample in 0..50u32 {
            let x = DVec3::new(random(2, sample), random(3, sample), random(4, sample)) * 0.98;
            let r = random(5, sample);
            left += r * (field::vm_feature(s, p, &moved, x) - field::vm_feature(s, p, &fixed, x));
            field::vm_feature_bwd(s, p, &fixed, x, r, &mut scattered);
        }
        let right: f64 = part.map(|i| direction[i] * scattered[i]).sum();
        assert!((left - right).abs() < 1e-11 * left.abs().max(1.0), "{left} against {right}");
        assert!(left.abs() > 1e-3, "the identity must not be trivial");
    }
}

/// <J p, r> = <p, J' r> for the line integrals of both fields and their backward pass, along directions in which features
/// are linear: planes with fixed lines, and the output neuron with fixed layers.
#[test]
fn line_integrals_and_their_backward_pass_are_adjoint() {
    let plan = plan("paper", &["loss.normalise=true", "dynamic.occlusion=0"]);
    let (s, p) = (&plan.setup, &plan.params);
    let params = start(&plan);
    let rays = march::batch(&plan, 1);
    let random = |a: u32, b: usize| random::uniform01(11, 78, a, b as u32) - 0.5;
    let planes = 0..p.line(0, 0, 0);
    let network = p.dynamic_network.as_ref().unwrap();
    let out_neuron = (network.out_weights..network.out_weights + network.width).chain([network.out_bias]);
    let mut direction = vec![0.0; p.len];
    planes.chain(out_neuron).for_each(|i| direction[i] = random(0, i));
    let moved: Vec<f64> = params.iter().zip(&direction).map(|(p, d)| p + d).collect();
    let (mut left, mut gradient) = ([0.0; 2], vec![0.0; p.len]);
    for (index, ray) in rays.iter().enumerate() {
        let near = march::NearPart::of(&plan, 1, &rays);
        let seen = march::fwd(&plan, &params, 1, ray, near, true, Precision::Exact);
        let then = march::fwd(&plan, &moved, 1, ray, near, true, Precision::Exact);
        let r = [random(1, index), random(2, index)];
        for (a, b) in seen.statics.iter().zip(&then.statics) {
            let slope = f64::from(s.static_gain) * field::sigmoid(a.feature + f64::from(s.static_shift));
            left[0] += r[0] * a.dl * slope * (b.feature - a.feature);
        }
        for (a, b) in seen.dynamics.iter().zip(&then.dynamics) {
            let slope = f64::from(s.dynamic_gain) * field::sigmoid(a.trace.feature + f64::from(s.dynamic_shift));
            left[1] += r[1] * a.dl * slope * (b.trace.feature - a.trace.feature);
        }
        march::bwd(&plan, &params, ray, &seen, r, Precision::Exact, &mut gradient);
    }
    let dot = |range: std::ops::Range<usize>| -> f64 { range.map(|i| direction[i] * gradient[i]).sum() };
    for (left, right) in left.into_iter().zip([dot(0..p.static_len), dot(p.static_len..p.len)]) {
        assert!((left - right).abs() < 1e-10 * left.abs(), "{left} against {right}");
        assert!(left.abs() > 1e-3, "the identity must not be trivial");
    }
}
