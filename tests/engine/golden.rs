//! Comparison of the engine with golden values of an independent PyTorch float64 implementation (`tools/reference.py`):
//! losses and gradients of three iterations and the parameters after ten updates, for each preset.

use crate::common::{expect_silence, gpu, relative_error, tuning};
use crate::golden_fields::{Terms, gather, terms_of_engine};
use crate::golden_file::Golden;
use nertca_vk::config::Preset;
use nertca_vk::fields::data::FieldData;
use nertca_vk::plan::Plan;
use nertca_vk::scan::dataset::Dataset;
use nertca_vk::train::trainer::Trainer;
use nertca_vk_twins::reference::field::Precision;
use nertca_vk_twins::reference::{losses, march, step};

fn check(preset: Preset, name: &str) {
    let golden = Golden::open(name, "tools/reference.py");
    let (config, dataset) = (golden.config(preset), golden.dataset());
    let mut plan = Plan::new(&config, &dataset).unwrap().in_scene(golden.scene());
    let data = plan.data_mut::<FieldData>().unwrap();
    data.backgrounds = (0..dataset.views.len())
        .flat_map(|v| {
            let bound = |which: &str| golden.get(&format!("background/{v}/{which}"));
            bound("low").into_iter().zip(bound("high")).map(|(l, h)| [l as f32, h as f32]).collect::<Vec<_>>()
        })
        .collect();
    data.listed_rays = (0..data.setup.n_all_rays).step_by(3).collect();
    data.setup.n_motion_list = data.listed_rays.len() as u32;
    data.setup.n_motion_rays = golden.number("n_motion") as u32;
    check_plan(&golden, plan, &dataset, name);
}

fn terms_of_twin(losses: &losses::Losses) -> Terms {
    vec![
        ("data", losses.data),
        ("tv", losses.tv),
        ("occlusion", losses.occlusion),
        ("favour_static", losses.favour_static),
        ("ray_entropy", losses.ray_entropy),
        ("static_size", losses.static_size),
    ]
}

fn check_plan(golden: &Golden, plan: Plan, dataset: &Dataset, name: &str) {
    let two_networks = plan.params.static_network.is_some();
    let gpu = gpu();
    let mut trainer = Trainer::new(&gpu, plan, dataset, tuning(&gpu)).unwrap();
    let initial: Vec<f32> = gather(golden, trainer.plan(), "initial").iter().map(|v| *v as f32).collect();
    gpu.upload(&trainer.fields().unwrap().forward().params, 0, &initial).unwrap();
    let compared = [0u32, golden.number("delay") as u32, golden.number("delay") as u32 + 3];
    for step in 0..10 {
        // At parameters that already differ by rounding, a comparison of gradients would mix two effects, so the
        // reference's parameters are loaded where gradients are compared.
        if compared.contains(&step) {
            let params = gather(golden, trainer.plan(), &format!("params{step}"));
            let data = trainer.fields().unwrap().data();
            let (losses, gradient) =
                step::loss_and_gradient(data, &params, step, &march::batch(data, step), Precision::Exact);
            let reference = gather(golden, trainer.plan(), &format!("gradient{step}"));
            assert_eq!(losses.live as f64, golden.get(&format!("loss{step}/live"))[0], "{name} step {step}");
            for (term, value) in terms_of_twin(&losses).into_iter().take(if two_networks { 6 } else { 3 }) {
                let want = golden.get(&format!("loss{step}/{term}"))[0];
                // Setup constants are f32 in twin and engine; the reference's are f64.
                assert!((value - want).abs() <= 2e-6 * want.abs() + 1e-15, "twin {name} {step} {term}: {value} {want}");
            }
            compare(&gradient.iter().map(|v| *v as f32).collect::<Vec<_>>(), &reference, trainer.plan(), 2e-5, name);
            let uploaded: Vec<f32> = params.iter().map(|v| *v as f32).collect();
            gpu.upload(&trainer.fields().unwrap().forward().params, 0, &uploaded).unwrap();
        }
        let loss = trainer.advance(step + 1).unwrap()[0];
        if compared.contains(&step) {
            for (term, value) in terms_of_engine(&loss) {
                let want = golden.get(&format!("loss{step}/{term}"))[0];
                assert!((value - want).abs() <= 1e-4 * want.abs() + 1e-12, "{name} {step} {term}: {value} {want}");
            }
            let len = trainer.plan().params.len;
            let got: Vec<f32> = gpu.download(&trainer.fields().unwrap().training().gradient, 0, len).unwrap();
            let want = gather(golden, trainer.plan(), &format!("gradient{step}"));
            compare(&got, &want, trainer.plan(), 1e-4, name);
        }
    }
    let got = trainer.model().unwrap().params;
    let want = gather(golden, trainer.plan(), "final");
    compare(&got, &want, trainer.plan(), 1e-3, name);
    drop(trainer);
    expect_silence(gpu);
}

fn compare(got: &[f32], want: &[f64], plan: &Plan, tolerance: f64, name: &str) {
    for tensor in plan.params.tensors() {
        let w: Vec<f64> = tensor.positions.iter().map(|p| want[*p as usize]).collect();
        let g: Vec<f32> = tensor.positions.iter().map(|p| got[*p as usize]).collect();
        let (error, at) = relative_error(&g, &w);
        assert!(error < tolerance, "{name} {}[{at}]: {} against {} ({error:.1e})", tensor.name, g[at], w[at]);
    }
}

#[test]
fn paper() {
    check(Preset::Paper, "paper");
}

#[test]
fn public_code() {
    check(Preset::PublicCode, "public-code");
}

#[test]
fn fast_mlp() {
    check(Preset::FastMlp, "fast");
}

/// NeRF-CA, with its own plan: the changing rays, their weights, and boxes that include all points of a ray are checked as
/// well.
#[test]
fn nerf_ca() {
    let golden = Golden::open("nerf-ca", "tools/reference.py");
    let dataset = golden.dataset();
    let plan = Plan::new(&golden.networks(), &dataset).unwrap();
    check_plan(&golden, plan, &dataset, "nerf-ca");
}
