//! The engine against golden values of an independent PyTorch float64 implementation (`tools/reference.py`):
//! losses and gradients of three iterations and the parameters after ten updates, for each preset.
#![allow(missing_docs, clippy::unwrap_used, clippy::expect_used)]

mod common;
#[path = "common/golden_file.rs"]
mod golden_file;

use common::{expect_silence, gpu, relative_error, tuning};
use golden_file::Golden;
use nertca_vk::config::{Config, Preset};
use nertca_vk::geometry::{CArm, Geometry};
use nertca_vk::model::scene::Scene;
use nertca_vk::plan::Plan;
use nertca_vk::reference::field::Precision;
use nertca_vk::reference::{march, step};
use nertca_vk::scan::dataset::{Dataset, Frame, Layout, Split, View};
use nertca_vk::train::losses::StepLoss;
use nertca_vk::train::trainer::Trainer;

impl Golden {
    fn number(&self, key: &str) -> f64 {
        self.case[key].as_f64().unwrap_or_else(|| panic!("{key}"))
    }

    fn pair(&self, key: &str) -> [f64; 2] {
        [0, 1].map(|i| self.case[key][i].as_f64().unwrap())
    }

    fn dataset(&self) -> Dataset {
        let (width, height) = (self.number("width_px") as usize, self.number("height_px") as usize);
        let phases = self.number("phases") as u32;
        let arm = &self.case["arm"];
        let arm_pair = |key: &str| [0, 1].map(|i| arm[key][i].as_f64().unwrap());
        let mut views = Vec::new();
        let mut frames = Vec::new();
        let after = self.case["after_phases"].as_array().unwrap();
        let after: Vec<f64> = after.iter().map(|after| after.as_f64().unwrap()).collect();
        for (v, angles) in self.case["angles"].as_array().unwrap().iter().enumerate() {
            let geometry = Geometry::CArm(CArm {
                primary_deg: angles[0].as_f64().unwrap(),
                secondary_deg: angles[1].as_f64().unwrap(),
                sid_mm: arm["sid_mm"].as_f64().unwrap(),
                sod_mm: arm["sod_mm"].as_f64().unwrap(),
                pixel_mm: arm_pair("pixel_mm"),
                offset_mm: arm_pair("offset_mm"),
                table_mm: [0.0; 3],
            });
            views.push(View::new(geometry, [width, height]).unwrap());
            for phase in 0..phases {
                let image = self.get(&format!("image/{}", v * phases as usize + phase as usize));
                frames.push(Frame {
                    name: format!("{v}-{phase}"),
                    view: v,
                    phase,
                    split: Split::Train,
                    integrals: image.iter().map(|x| *x as f32).collect(),
                    mask: None,
                    after_phase: after[frames.len() % after.len()],
                    heart_shift_mm: [0.0; 3],
                });
            }
        }
        Dataset {
            path: "golden".into(),
            layout: Layout::Native,
            views,
            frames,
            width,
            height,
            n_phases: phases,
            depth_range: (-self.number("depth"), self.number("depth")),
            hidden: Default::default(),
            vessel_attenuation: None,
            notes: Vec::new(),
        }
    }

    fn config(&self, preset: Preset) -> Config {
        let n = |key: &str| self.number(key);
        let ([s0, s1], [d0, d1]) = (self.pair("static_lr"), self.pair("dynamic_lr"));
        let settings = [
            format!("seed={}", n("seed")),
            format!("train.rays={}", n("rays")),
            format!("train.iterations={}", n("iterations")),
            "train.chunk_samples=1024".into(),
            "train.iterations_per_submit=1".into(),
            format!("march.static_samples={}", n("static_samples")),
            format!("march.dynamic_samples={}", n("dynamic_samples")),
            "march.render_samples=16".into(),
            "march.fit_dynamic_range=false".into(),
            format!("static.grid={}", n("grid")),
            format!("static.ranks={}", n("ranks")),
            format!("static.lr={s0}"),
            format!("static.lr_end={s1}"),
            format!("static.tv={}", n("tv")),
            format!("dynamic.layers={}", n("layers")),
            format!("dynamic.width={}", n("mlp_width")),
            format!("dynamic.skip_layer={}", n("skip")),
            format!("dynamic.bands={}", n("bands")),
            format!("dynamic.window_start={}", n("window_start")),
            format!("dynamic.window_iterations={}", n("window_iterations")),
            format!("dynamic.delay={}", n("delay")),
            format!("dynamic.lr={d0}"),
            format!("dynamic.lr_end={d1}"),
            format!("dynamic.occlusion={}", n("occlusion")),
            format!("adam.epsilon={}", n("eps")),
            "hull.enabled=false".into(),
        ];
        Config::load(Some(preset), None, &settings).unwrap()
    }

    /// Settings of two networks, whose losses are delayed and not the field.
    fn networks(&self) -> Config {
        let n = |key: &str| self.number(key);
        let mut settings = vec![
            format!("seed={}", n("seed")),
            format!("train.rays={}", n("rays")),
            format!("train.motion_share={}", n("n_motion") / n("rays")),
            format!("train.iterations={}", n("iterations")),
            "train.chunk_samples=1024".into(),
            "train.iterations_per_submit=1".into(),
            format!("march.dynamic_samples={}", n("dynamic_samples")),
            "march.render_samples=16".into(),
            format!("dynamic.layers={}", n("layers")),
            format!("dynamic.width={}", n("mlp_width")),
            format!("dynamic.window_iterations={}", n("window_iterations")),
            format!("dynamic.occlusion_share={}", n("occlusion_share")),
            format!("adam.epsilon={}", n("eps")),
            format!("networks.delay={}", n("delay")),
        ];
        for (section, keys) in [
            ("static", &[("lr", "static_lr")][..]),
            ("dynamic", &[("lr", "dynamic_lr")]),
            ("networks", &["favour_static", "ray_entropy", "near_integral", "static_size"].map(|key| (key, key))),
        ] {
            for (key, golden) in keys {
                let [start, end] = self.pair(golden);
                settings.extend([format!("{section}.{key}={start}"), format!("{section}.{key}_end={end}")]);
            }
        }
        for key in ["gain", "ramp", "least_change", "least_integral", "change_weight"] {
            settings.push(format!("networks.{key}={}", n(key)));
        }
        Config::load(Some(Preset::NerfCa), None, &settings).unwrap()
    }

    fn scene(&self) -> Scene {
        let s = &self.case["scene"];
        let n = |key: &str| s[key].as_f64().unwrap();
        let depth = self.number("depth");
        Scene {
            static_min: [-n("static_half"); 3],
            static_max: [n("static_half"); 3],
            dynamic_min: [-n("dynamic_half"); 3],
            dynamic_max: [n("dynamic_half"); 3],
            static_depth: [-depth, depth],
            dynamic_depth: [-depth, depth],
            encode_centre: [0, 1, 2].map(|i| s["centre"][i].as_f64().unwrap()),
            encode_scale: n("scale"),
            static_gain: n("static_gain"),
            static_shift: n("static_shift"),
            dynamic_gain: n("dynamic_gain"),
            dynamic_shift: n("dynamic_shift"),
            static_weight: n("static_weight"),
            dynamic_weight: n("dynamic_weight"),
            robust_scale: n("robust_scale"),
            region: None,
        }
    }
}

/// Scatters golden tensors into the padded buffer.
fn gather(golden: &Golden, plan: &Plan, prefix: &str) -> Vec<f64> {
    let mut out = vec![0.0; plan.params.len];
    for tensor in plan.params.tensors() {
        let values = golden.get(&format!("{prefix}/{}", tensor.name));
        assert_eq!(values.len(), tensor.positions.len(), "{}", tensor.name);
        tensor.positions.iter().zip(values).for_each(|(at, v)| out[*at as usize] = v);
    }
    out
}

fn check(preset: Preset, name: &str) {
    let golden = Golden::open(name, "tools/reference.py");
    let (config, dataset) = (golden.config(preset), golden.dataset());
    let mut plan = Plan::new(&config, &dataset).unwrap().in_scene(golden.scene());
    plan.backgrounds = (0..dataset.views.len())
        .flat_map(|v| {
            let bound = |which: &str| golden.get(&format!("background/{v}/{which}"));
            bound("low").into_iter().zip(bound("high")).map(|(l, h)| [l as f32, h as f32]).collect::<Vec<_>>()
        })
        .collect();
    plan.listed_rays = (0..plan.setup.n_all_rays).step_by(3).collect();
    plan.setup.n_motion_list = plan.listed_rays.len() as u32;
    plan.setup.n_motion_rays = golden.number("n_motion") as u32;
    check_plan(&golden, plan, &dataset, name);
}

/// What a loss came to, by the names that the reference gives.
type Terms = Vec<(&'static str, f64)>;

fn terms_of_twin(losses: &step::Losses) -> Terms {
    vec![
        ("data", losses.data),
        ("tv", losses.tv),
        ("occlusion", losses.occlusion),
        ("favour_static", losses.favour_static),
        ("ray_entropy", losses.ray_entropy),
        ("static_size", losses.static_size),
    ]
}

fn terms_of_engine(loss: &StepLoss) -> Terms {
    let mut terms = vec![("data", loss.data), ("tv", loss.tv), ("occlusion", loss.occlusion)];
    if let Some(networks) = &loss.networks {
        terms.extend([
            ("favour_static", networks.favour_static),
            ("ray_entropy", networks.ray_entropy),
            ("static_size", networks.static_size),
        ]);
    }
    terms
}

fn check_plan(golden: &Golden, plan: Plan, dataset: &Dataset, name: &str) {
    let two_networks = plan.params.still.is_some();
    let gpu = gpu();
    let mut trainer = Trainer::new(&gpu, plan, dataset, tuning(&gpu)).unwrap();
    let initial: Vec<f32> = gather(golden, trainer.plan(), "initial").iter().map(|v| *v as f32).collect();
    gpu.upload(&trainer.forward().params, 0, &initial).unwrap();
    let compared = [0u32, golden.number("delay") as u32, golden.number("delay") as u32 + 3];
    for step in 0..10 {
        // Comparing a gradient at parameters that already differ by rounding would mix two things, so the
        // reference's parameters are loaded where gradients are compared.
        if compared.contains(&step) {
            let params = gather(golden, trainer.plan(), &format!("params{step}"));
            let (losses, gradient) = step::loss_and_gradient(
                trainer.plan(),
                &params,
                step,
                &march::batch(trainer.plan(), step),
                Precision::Exact,
            );
            let reference = gather(golden, trainer.plan(), &format!("gradient{step}"));
            assert_eq!(losses.live as f64, golden.get(&format!("loss{step}/live"))[0], "{name} step {step}");
            for (term, value) in terms_of_twin(&losses).into_iter().take(if two_networks { 6 } else { 3 }) {
                let want = golden.get(&format!("loss{step}/{term}"))[0];
                // Set-up constants are f32 in twin and engine alike; the reference's are f64.
                assert!((value - want).abs() <= 2e-6 * want.abs() + 1e-15, "twin {name} {step} {term}: {value} {want}");
            }
            compare(&gradient.iter().map(|v| *v as f32).collect::<Vec<_>>(), &reference, trainer.plan(), 2e-5, name);
            let uploaded: Vec<f32> = params.iter().map(|v| *v as f32).collect();
            gpu.upload(&trainer.forward().params, 0, &uploaded).unwrap();
        }
        let loss = trainer.advance(step + 1).unwrap()[0];
        if compared.contains(&step) {
            for (term, value) in terms_of_engine(&loss) {
                let want = golden.get(&format!("loss{step}/{term}"))[0];
                assert!((value - want).abs() <= 1e-4 * want.abs() + 1e-12, "{name} {step} {term}: {value} {want}");
            }
            let len = trainer.plan().params.len;
            let got: Vec<f32> = gpu.download(&trainer.training().gradient, 0, len).unwrap();
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

/// NeRF-CA. Its plan is taken as it is: the rays that change, their weights, and boxes that leave no point of a ray out are checked
/// as well.
#[test]
fn nerf_ca() {
    let golden = Golden::open("nerf-ca", "tools/reference.py");
    let dataset = golden.dataset();
    let plan = Plan::new(&golden.networks(), &dataset).unwrap();
    check_plan(&golden, plan, &dataset, "nerf-ca");
}
