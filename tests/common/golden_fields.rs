//! Cases of `tools/reference.py` and `tools/reference_training.py`: their data, configuration and parameters, and the loss
//! terms by the scripts' names.
#![allow(dead_code, reason = "each test file uses its part")]

use crate::golden_file::Golden;
use nertca_vk::config::{Config, Preset};
use nertca_vk::fitting::losses::StepLoss;
use nertca_vk::geometry::{CArm, Geometry};
use nertca_vk::model::scene::Scene;
use nertca_vk::plan::Plan;
use nertca_vk::scan::dataset::{Dataset, Frame, Layout, Split, View};
use nertca_vk_twins::selftest::problems::with_values;

impl Golden {
    pub fn number(&self, key: &str) -> f64 {
        self.case[key].as_f64().unwrap_or_else(|| panic!("{key}"))
    }

    pub fn pair(&self, key: &str) -> [f64; 2] {
        [0, 1].map(|i| self.case[key][i].as_f64().unwrap())
    }

    pub fn dataset(&self) -> Dataset {
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
                    contrast: 1.0,
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
            still: false,
            vessels_alone: false,
            views_adjusted: false,
            prior: None,
            depth_range: (-self.number("depth"), self.number("depth")),
            hidden: Default::default(),
            vessel_attenuation: None,
            notes: Vec::new(),
        }
    }

    pub fn config(&self, preset: Preset) -> Config {
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
            format!("dynamic.occlusion_region={}", self.case["occlusion_region"].as_str().unwrap()),
            format!("adam.epsilon={}", n("eps")),
            "hull.enabled=false".into(),
        ];
        with_values(&Config::preset(preset), settings.iter().map(String::as_str)).unwrap()
    }

    /// Settings of two networks, whose losses are delayed instead of the field.
    pub fn networks(&self) -> Config {
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
        // The script has the earlier names of two settings.
        for (key, golden) in [
            ("gain", "gain"),
            ("ramp", "ramp"),
            ("min_change", "least_change"),
            ("min_integral", "least_integral"),
            ("change_weight", "change_weight"),
        ] {
            settings.push(format!("networks.{key}={}", n(golden)));
        }
        with_values(&Config::preset(Preset::NerfCa), settings.iter().map(String::as_str)).unwrap()
    }

    pub fn scene(&self) -> Scene {
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
            still: false,
        }
    }
}

/// Scatters golden tensors into the padded buffer.
pub fn gather(golden: &Golden, plan: &Plan, prefix: &str) -> Vec<f64> {
    let mut out = vec![0.0; plan.params.len];
    for tensor in plan.params.tensors() {
        let values = golden.get(&format!("{prefix}/{}", tensor.name));
        assert_eq!(values.len(), tensor.positions.len(), "{}", tensor.name);
        tensor.positions.iter().zip(values).for_each(|(at, v)| out[*at as usize] = v);
    }
    out
}

/// Terms of a loss by the scripts' names.
pub type Terms = Vec<(&'static str, f64)>;

pub fn terms_of_engine(loss: &StepLoss) -> Terms {
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
