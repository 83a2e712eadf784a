//! The f64 twins against finite differences, and adjoint identities. Together with `kernels_vs_cpu.rs` this
//! closes the chain from the shaders to the definition of a derivative.
#![allow(missing_docs, clippy::unwrap_used, clippy::expect_used)]

mod common;

use common::{small_config, small_dataset};
use glam::DVec3;
use nertca_vk::plan::Plan;
use nertca_vk::random;
use nertca_vk::reference::field::{self, Precision};
use nertca_vk::reference::{march, step};

fn plan(preset: &str, settings: &[&str]) -> Plan {
    Plan::new(&small_config(preset, settings), &small_dataset(9, 8)).unwrap()
}

fn start(plan: &Plan) -> Vec<f64> {
    let mut params: Vec<f64> = plan.params.initial(&plan.config).iter().map(|v| f64::from(*v)).collect();
    params[..plan.params.static_len].iter_mut().for_each(|p| *p *= 30.0);
    params
}

#[test]
fn twin_gradient_is_the_derivative_of_the_twin_loss() {
    for (preset, settings) in [
        ("paper", &["dynamic.occlusion=1e-3", "loss.normalise=true"][..]),
        ("public-code", &["dynamic.occlusion=1e-3", "loss.normalise=true"]),
        ("fast", &["loss.dynamic_target=absolute"]),
        ("fast", &["loss.robust=0"]),
        ("fast", &["loss.robust=0.3"]),
    ] {
        let plan = plan(preset, settings);
        let params = start(&plan);
        let rays = march::batch(&plan, 3);
        let (_, gradient) = step::loss_and_gradient(&plan, &params, 3, &rays, Precision::Exact);
        let temporal = plan.setup.temporal_target != 0;
        for tensor in plan.params.tensors() {
            // With a temporal target S learns from what D leaves, D taken as given: the two fields descend
            // different objectives, and each is checked against its own.
            let is_static = tensor.name.starts_with("static");
            // A few elements of each tensor, those with the largest gradient among a stride.
            let mut at: Vec<usize> = tensor.positions.iter().map(|p| *p as usize).collect();
            at.sort_by(|a, b| gradient[*b].abs().total_cmp(&gradient[*a].abs()));
            for &i in at.iter().step_by((at.len() / 3).max(1)).take(3) {
                let loss = |value: f64| {
                    let mut moved = params.clone();
                    moved[i] = value;
                    let losses = step::loss_and_gradient(&plan, &moved, 3, &rays, Precision::Exact).0;
                    if temporal && !is_static { losses.dynamic } else { losses.total() }
                };
                // Small enough to stay between ReLU kinks, large enough for f64 differences.
                let h = 1e-7;
                let difference = (loss(params[i] + h) - loss(params[i] - h)) / (2.0 * h);
                let error = (difference - gradient[i]).abs();
                // The loss's own last digits over the step.
                let rounding = 1e-8 * (1.0 + loss(params[i]));
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
    let plan = plan("fast", &["loss.robust=0"]);
    let params = start(&plan);
    let mut ray = march::ray(&plan, 40);
    let seen = march::fwd(&plan, &params, 0, &ray, true, Precision::Exact).dynamic_integral;
    let gradient_with = |ray: &march::Ray| {
        let (_, g) = step::loss_and_gradient(&plan, &params, 0, std::slice::from_ref(ray), Precision::Exact);
        g[plan.params.out_bias]
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
        // Direction only in one factor, so that the feature is linear along it.
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

/// <A sigma, r> = <sigma, A' r> for the ray sum: the integral is linear in attenuation.
#[test]
fn ray_sum_and_its_adjoint_agree() {
    let plan = plan("paper", &["loss.normalise=true"]);
    let params = start(&plan);
    let rays = march::batch(&plan, 1);
    let (mut left, mut right) = (0.0, 0.0);
    for (index, ray) in rays.iter().enumerate() {
        let seen = march::fwd(&plan, &params, 1, ray, true, Precision::Exact);
        let r = 0.3 + index as f64;
        left += r * seen.static_integral;
        for sample in &seen.statics {
            right += field::static_attenuation(&plan.setup, &plan.params, &params, sample.x) * (r * sample.dl);
        }
    }
    assert!((left - right).abs() < 1e-10 * left.abs() && left > 0.0, "{left} against {right}");
}
