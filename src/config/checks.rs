//! Checks of a configuration.

use crate::choice::Choice;
use crate::config::method::MethodKind;
use crate::config::sections::check_range;
use crate::config::{Config, DynamicForm, DynamicTarget, GaussianForm, OcclusionRegion, StaticForm};
use crate::error::{Error, Result};

/// Maximum number of cells along a side of the hash grid's box that f32 coordinates can resolve.
const MOST_CELLS: u64 = 1 << 20;

impl Config {
    /// Refuses values no run could use.
    ///
    /// # Errors
    /// [`Error::Config`] naming the key.
    pub fn check(&self) -> Result<()> {
        let (t, m, d) = (&self.train, &self.march, &self.dynamic);
        self.train.check_ranges()?;
        self.calibrate.check_ranges()?;
        self.march.check_ranges()?;
        self.static_field.check_ranges()?;
        self.dynamic.check_ranges()?;
        self.loss.check_ranges()?;
        self.hull.check_ranges()?;
        self.occupancy.check_ranges()?;
        self.networks.check_ranges()?;
        self.adam.check_ranges()?;
        self.gaussians.check_ranges()?;
        self.deformable.check_ranges()?;
        self.r2.check_ranges()?;
        self.x.check_ranges()?;
        self.sax.check_ranges()?;
        if self.gaussians.least_scale > self.gaussians.greatest_scale {
            let problem = format!("exceeds gaussians.greatest_scale = {}", self.gaussians.greatest_scale);
            return Err(Error::config("gaussians.least_scale", self.gaussians.least_scale, problem));
        }
        check_range("dynamic.skip_layer", d.skip_layer.into(), 0.0, d.layers.into())?;
        check_range("dynamic.window_start", d.window_start, 0.0, d.bands.into())?;
        if d.width % 16 != 0 {
            return Err(Error::config("dynamic.width", d.width, "is not a multiple of 16"));
        }
        if d.latent % 4 != 0 {
            return Err(Error::config("dynamic.latent", d.latent, "is not a multiple of 4"));
        }
        if d.skip_layer == 1 {
            return Err(Error::config(
                "dynamic.skip_layer",
                1,
                "the first layer always receives the input; accepted are 0 (no skip connection) and layers from 2 on",
            ));
        }
        if m.static_samples.max(m.dynamic_samples).max(m.render_samples) > t.chunk_samples {
            return Err(Error::config(
                "train.chunk_samples",
                t.chunk_samples,
                "is less than the number of samples of one ray (march.static_samples, dynamic_samples, render_samples)",
            ));
        }
        if u64::from(t.iterations) * u64::from(t.rays) > u64::from(u32::MAX) {
            return Err(Error::config("train.iterations", t.iterations, "iterations x rays must stay below 2^32"));
        }
        if self.static_field.form == StaticForm::Network {
            self.check_two_networks()?;
        }
        self.check_gaussians_alone()?;
        self.check_r2()?;
        self.check_x()?;
        self.check_sax()?;
        if m.along_axis && self.gaussians.form != GaussianForm::None {
            let problem = "is not supported with Gaussians, which are integrated along rays; set it to false, or set \
                           gaussians.form = \"none\"";
            return Err(Error::config("march.along_axis", true, problem));
        }
        Ok(())
    }

    /// Refuses settings that two networks do not support.
    fn check_two_networks(&self) -> Result<()> {
        let form = "is not supported with static.form = \"network\"";
        let refuse = |field: &str, value: &dyn std::fmt::Display, instead: &str| {
            Err(Error::config(field, value, format!("{form}: {instead}")))
        };
        if self.gaussians.form != GaussianForm::None {
            return refuse(
                "gaussians.form",
                &self.gaussians.form.name(),
                "set it to \"none\", or set static.form = \"tensor\"",
            );
        }
        for (field, is_on) in [
            ("hull.enabled", self.hull.enabled),
            ("occupancy.enabled", self.occupancy.enabled),
            ("loss.normalise", self.loss.normalise),
            ("dynamic.encode_box", self.dynamic.encode_box),
            ("march.fit_dynamic_range", self.march.fit_dynamic_range),
            ("march.fit_static_range", self.march.fit_static_range),
        ] {
            if is_on {
                return refuse(field, &true, "both fields are evaluated everywhere, in world units; set it to false");
            }
        }
        if self.loss.dynamic_target != DynamicTarget::Absolute {
            return refuse(
                "loss.dynamic_target",
                &"temporal",
                "both fields are trained on the same residual; set it to \"absolute\"",
            );
        }
        for (field, value) in [
            ("dynamic.delay", f64::from(self.dynamic.delay)),
            ("dynamic.least_slope", self.dynamic.least_slope),
            ("dynamic.occlusion", self.dynamic.occlusion),
        ] {
            if value != 0.0 {
                let instead = "set it to 0 (networks.near_integral is the weight near the source; networks.delay and \
                               networks.ramp are its times)";
                return refuse(field, &value, instead);
            }
        }
        if self.dynamic.occlusion_region != OcclusionRegion::DepthRange {
            return refuse(
                "dynamic.occlusion_region",
                &"last-ray",
                "it belongs to dynamic.occlusion, which is not used; set it to \"depth-range\"",
            );
        }
        let preset = Config::preset(self.preset);
        for (field, value, unused) in [
            ("dynamic.half_extent_mm", self.dynamic.half_extent_mm, preset.dynamic.half_extent_mm),
            ("dynamic.normalised_shift", self.dynamic.normalised_shift, preset.dynamic.normalised_shift),
            ("march.static_samples", self.march.static_samples.into(), preset.march.static_samples.into()),
        ] {
            if value != unused {
                let instead = format!("it has no effect there; leave it at the preset's value, {unused}");
                return refuse(field, &value, &instead);
            }
        }
        Ok(())
    }

    /// Refuses settings that R2-Gaussian and X-Gaussian do not support, and a run of another method without a static field.
    fn check_gaussians_alone(&self) -> Result<()> {
        let form = self.static_field.form;
        let is_alone = matches!(self.method(), MethodKind::R2Gaussian | MethodKind::XGaussian);
        if !is_alone {
            if form == StaticForm::None && self.dynamic.form != DynamicForm::Lineformer {
                let problem = "only methods without a static field accept it; set it to \"tensor\", or set \
                               gaussians.form = \"r2\" or \"x\" or dynamic.form = \"lineformer\"";
                return Err(Error::config("static.form", form.name(), problem));
            }
            return Ok(());
        }
        let refuse = |field: &str, value: &dyn std::fmt::Display, instead: &str| {
            let form = self.gaussians.form.name();
            Err(Error::config(field, value, format!("is not supported with gaussians.form = \"{form}\": {instead}")))
        };
        if form != StaticForm::None {
            return refuse("static.form", &form.name(), "its Gaussians represent the whole object; set it to \"none\"");
        }
        for (field, is_on) in [
            ("hull.enabled", self.hull.enabled),
            ("occupancy.enabled", self.occupancy.enabled),
            ("loss.normalise", self.loss.normalise),
        ] {
            if is_on {
                return refuse(field, &true, "this method does not use it; set it to false");
            }
        }
        if self.loss.dynamic_target != DynamicTarget::Absolute {
            return refuse(
                "loss.dynamic_target",
                &"temporal",
                "this method is fitted to whole images; set it to \"absolute\"",
            );
        }
        Ok(())
    }

    /// Refuses settings of R2-Gaussian that contradict each other.
    fn check_r2(&self) -> Result<()> {
        if self.method() != MethodKind::R2Gaussian {
            return Ok(());
        }
        let r2 = &self.r2;
        if r2.tv_box > r2.voxels {
            return Err(Error::config("r2.tv_vol_size", r2.tv_box, format!("exceeds r2.voxels = {}", r2.voxels)));
        }
        if r2.least_scale >= r2.greatest_scale {
            let problem = format!("is not below r2.scale_max = {}", r2.greatest_scale);
            return Err(Error::config("r2.scale_min", r2.least_scale, problem));
        }
        if r2.count > r2.most {
            return Err(Error::config("r2.n_points", r2.count, format!("exceeds r2.max_num_gaussians = {}", r2.most)));
        }
        Ok(())
    }

    /// Refuses settings of X-Gaussian that contradict each other.
    fn check_x(&self) -> Result<()> {
        if self.method() != MethodKind::XGaussian {
            return Ok(());
        }
        let x = &self.x;
        if x.interval > x.voxels {
            return Err(Error::config("x.interval", x.interval, format!("exceeds x.voxels = {}", x.voxels)));
        }
        let count = u64::from(x.voxels.div_ceil(x.interval)).pow(3);
        if count > u64::from(x.most) {
            let problem = format!(
                "is less than the {count} initial Gaussians that x.voxels = {} and x.interval = {} give",
                x.voxels, x.interval
            );
            return Err(Error::config("x.max_gaussians", x.most, problem));
        }
        if x.first_opacity < x.weakest {
            let problem = format!("is below x.min_opacity = {}: all Gaussians would be pruned", x.weakest);
            return Err(Error::config("x.first_opacity", x.first_opacity, problem));
        }
        Ok(())
    }

    /// Refuses settings that SAX-NeRF does not support.
    fn check_sax(&self) -> Result<()> {
        if self.dynamic.form != DynamicForm::Lineformer {
            return Ok(());
        }
        let refuse = |field: &str, value: &dyn std::fmt::Display, instead: &str| {
            Err(Error::config(field, value, format!("is not supported with dynamic.form = \"lineformer\": {instead}")))
        };
        if self.static_field.form != StaticForm::None {
            return refuse(
                "static.form",
                &self.static_field.form.name(),
                "its field represents the whole object; set it to \"none\"",
            );
        }
        if self.gaussians.form != GaussianForm::None {
            return refuse(
                "gaussians.form",
                &self.gaussians.form.name(),
                "only one of the two settings can choose the field; set it to \"none\"",
            );
        }
        for (field, is_on) in [
            ("hull.enabled", self.hull.enabled),
            ("occupancy.enabled", self.occupancy.enabled),
            ("loss.normalise", self.loss.normalise),
            ("march.along_axis", self.march.along_axis),
        ] {
            if is_on {
                return refuse(field, &true, "this method does not use it; set it to false");
            }
        }
        if self.loss.dynamic_target != DynamicTarget::Absolute {
            return refuse(
                "loss.dynamic_target",
                &"temporal",
                "this method is fitted to whole images; set it to \"absolute\"",
            );
        }
        let sax = &self.sax;
        for (field, value) in [("sax.num_levels", sax.levels), ("sax.n_samples", sax.samples)] {
            if value % 2 != 0 {
                return Err(Error::config(field, value, "is not an even number"));
            }
        }
        let finest = u64::from(sax.base) << (sax.levels - 1);
        if finest > MOST_CELLS {
            let problem = format!(
                "the finest of {} levels would have {finest} cells along a side; at most {MOST_CELLS} are supported: \
                 lower sax.base_resolution or sax.num_levels",
                sax.levels
            );
            return Err(Error::config("sax.base_resolution", sax.base, problem));
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use crate::config::{Config, Preset};

    #[test]
    fn what_does_not_go_with_sax_nerf_is_named() {
        for (setting, part) in [
            ("static.form=tensor", "static.form"),
            ("dynamic.form=network", "static.form"),
            ("gaussians.form=r2", "gaussians.form"),
            ("hull.enabled=true", "hull.enabled"),
            ("occupancy.enabled=true", "occupancy.enabled"),
            ("loss.normalise=true", "loss.normalise"),
            ("loss.dynamic_target=temporal", "loss.dynamic_target"),
            ("march.along_axis=true", "march.along_axis"),
            ("sax.num_levels=3", "sax.num_levels"),
            ("sax.n_samples=7", "sax.n_samples"),
            ("sax.base_resolution=65536", "sax.base_resolution"),
            ("sax.log2_hashmap_size=30", "sax.log2_hashmap_size"),
            ("sax.window_size=0", "sax.window_size"),
            ("sax.static_data=both", "both"),
        ] {
            let message = Config::load(Some(Preset::SaxNerf), None, &[setting.into()]).unwrap_err().to_string();
            assert!(message.contains(part), "{setting}: {message}");
        }
    }
}
