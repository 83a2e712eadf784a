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
        self.tree.check_ranges()?;
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
            return Err(Error::config("dynamic.width", d.width, "a multiple of 16 is needed"));
        }
        if d.latent % 4 != 0 {
            return Err(Error::config("dynamic.latent", d.latent, "a multiple of 4 is needed"));
        }
        if d.skip_layer == 1 {
            return Err(Error::config(
                "dynamic.skip_layer",
                1,
                "the first layer sees the input anyway; 0 or 2.. is accepted",
            ));
        }
        if m.static_samples.max(m.dynamic_samples).max(m.render_samples) > t.chunk_samples {
            return Err(Error::config(
                "train.chunk_samples",
                t.chunk_samples,
                "at least the samples of one ray are needed",
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
            let problem = "Gaussians are counted along rays; take false, or gaussians.form = \"none\"";
            return Err(Error::config("march.along_axis", true, problem));
        }
        Ok(())
    }

    /// Refuses settings that two networks do not support.
    fn check_two_networks(&self) -> Result<()> {
        let form = "does not go with static.form = \"network\"";
        let refuse = |field: &str, value: &dyn std::fmt::Display, instead: &str| {
            Err(Error::config(field, value, format!("{form}: {instead}")))
        };
        if self.gaussians.form != GaussianForm::None {
            return refuse("gaussians.form", &self.gaussians.form.name(), "take \"none\", or static.form = \"tensor\"");
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
                return refuse(field, &true, "both fields are asked everywhere, in world units; take false");
            }
        }
        if self.loss.dynamic_target != DynamicTarget::Absolute {
            return refuse("loss.dynamic_target", &"temporal", "one residual drives both fields; take \"absolute\"");
        }
        for (field, value) in [
            ("dynamic.delay", f64::from(self.dynamic.delay)),
            ("dynamic.least_slope", self.dynamic.least_slope),
            ("dynamic.occlusion", self.dynamic.occlusion),
        ] {
            if value != 0.0 {
                let instead = "take 0 (networks.near_integral weighs what is near, networks.delay and ramp say when)";
                return refuse(field, &value, instead);
            }
        }
        if self.dynamic.occlusion_region != OcclusionRegion::DepthRange {
            return refuse(
                "dynamic.occlusion_region",
                &"last-ray",
                "it is that of dynamic.occlusion; take \"depth-range\"",
            );
        }
        let preset = Config::preset(self.preset);
        for (field, value, unused) in [
            ("dynamic.half_extent_mm", self.dynamic.half_extent_mm, preset.dynamic.half_extent_mm),
            ("dynamic.normalised_shift", self.dynamic.normalised_shift, preset.dynamic.normalised_shift),
            ("march.static_samples", self.march.static_samples.into(), preset.march.static_samples.into()),
        ] {
            if value != unused {
                let instead = format!("it has no effect there; leave it at the preset's {unused}");
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
                let problem = "all other methods have a still field: take \"tensor\", or gaussians.form = \"r2\" or dynamic.form = \
                               \"lineformer\"";
                return Err(Error::config("static.form", form.name(), problem));
            }
            return Ok(());
        }
        let refuse = |field: &str, value: &dyn std::fmt::Display, instead: &str| {
            let form = self.gaussians.form.name();
            Err(Error::config(field, value, format!("does not go with gaussians.form = \"{form}\": {instead}")))
        };
        if form != StaticForm::None {
            return refuse("static.form", &form.name(), "its Gaussians are the whole object; take \"none\"");
        }
        for (field, is_on) in [
            ("hull.enabled", self.hull.enabled),
            ("occupancy.enabled", self.occupancy.enabled),
            ("loss.normalise", self.loss.normalise),
        ] {
            if is_on {
                return refuse(field, &true, "it knows none; take false");
            }
        }
        if self.loss.dynamic_target != DynamicTarget::Absolute {
            return refuse("loss.dynamic_target", &"temporal", "it is fitted to whole images; take \"absolute\"");
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
            return Err(Error::config("r2.tv_box", r2.tv_box, format!("exceeds r2.voxels = {}", r2.voxels)));
        }
        if r2.least_scale >= r2.greatest_scale {
            let problem = format!("is not below r2.greatest_scale = {}", r2.greatest_scale);
            return Err(Error::config("r2.least_scale", r2.least_scale, problem));
        }
        if r2.count > r2.most {
            return Err(Error::config("r2.count", r2.count, format!("exceeds r2.most = {}", r2.most)));
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
            let problem =
                format!("x.voxels = {} and x.interval = {} begin with {count} Gaussians", x.voxels, x.interval);
            return Err(Error::config("x.most", x.most, problem));
        }
        if x.first_opacity < x.weakest {
            let problem = format!("is below x.weakest = {}: none would stay", x.weakest);
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
            Err(Error::config(field, value, format!("does not go with dynamic.form = \"lineformer\": {instead}")))
        };
        if self.static_field.form != StaticForm::None {
            return refuse(
                "static.form",
                &self.static_field.form.name(),
                "its field is the whole object; take \"none\"",
            );
        }
        if self.gaussians.form != GaussianForm::None {
            return refuse("gaussians.form", &self.gaussians.form.name(), "one of both is the field; take \"none\"");
        }
        for (field, is_on) in [
            ("hull.enabled", self.hull.enabled),
            ("occupancy.enabled", self.occupancy.enabled),
            ("loss.normalise", self.loss.normalise),
            ("march.along_axis", self.march.along_axis),
        ] {
            if is_on {
                return refuse(field, &true, "it knows none; take false");
            }
        }
        if self.loss.dynamic_target != DynamicTarget::Absolute {
            return refuse("loss.dynamic_target", &"temporal", "it is fitted to whole images; take \"absolute\"");
        }
        let sax = &self.sax;
        for (field, value) in [("sax.levels", sax.levels), ("sax.samples", sax.samples)] {
            if value % 2 != 0 {
                return Err(Error::config(field, value, "an even number is needed"));
            }
        }
        let finest = u64::from(sax.base) << (sax.levels - 1);
        if finest > MOST_CELLS {
            let problem = format!(
                "the finest of {} levels has {finest} cells a side, at most {MOST_CELLS} are told apart",
                sax.levels
            );
            return Err(Error::config("sax.base", sax.base, problem));
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
            ("sax.levels=3", "sax.levels"),
            ("sax.samples=7", "sax.samples"),
            ("sax.base=65536", "sax.base"),
            ("sax.log2_table=30", "sax.log2_table"),
            ("sax.window=0", "sax.window"),
            ("sax.static_data=both", "both"),
        ] {
            let message = Config::load(Some(Preset::SaxNerf), None, &[setting.into()]).unwrap_err().to_string();
            assert!(message.contains(part), "{setting}: {message}");
        }
    }
}
