//! Checks of a configuration.

use crate::choice::Choice;
use crate::config::section::check_range;
use crate::config::{Config, DynamicTarget, GaussianForm, StaticForm};
use crate::error::{Error, Result};

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
        self.check_forms()?;
        self.method().settings().check(self)?;
        if m.along_axis && self.gaussians.form != GaussianForm::None {
            let problem = "is not supported with Gaussians, which are integrated along rays; set it to false, or set \
                           gaussians.form = \"none\"";
            return Err(Error::config("march.along_axis", true, problem));
        }
        Ok(())
    }

    /// Refuses forms of fields that no method combines.
    fn check_forms(&self) -> Result<()> {
        let (static_form, gaussians) = (self.static_field.form, self.gaussians.form);
        if static_form == StaticForm::None && !self.method().is_alone() {
            let problem = "only methods without a static field accept it; set it to \"tensor\", or set \
                           gaussians.form = \"r2\" or \"x\" or dynamic.form = \"lineformer\"";
            return Err(Error::config("static.form", static_form.name(), problem));
        }
        if static_form == StaticForm::Network && gaussians != GaussianForm::None {
            let problem =
                "is not supported with static.form = \"network\": set it to \"none\", or set static.form = \"tensor\"";
            return Err(Error::config("gaussians.form", gaussians.name(), problem));
        }
        Ok(())
    }
}

/// Refuses settings that a method without a static field does not support.
///
/// # Errors
/// [`Error::Config`] naming the key.
pub(super) fn check_alone(config: &Config) -> Result<()> {
    let (method, form) = (config.method().name(), config.static_field.form);
    let refuse = |field: &str, value: &dyn std::fmt::Display, instead: &str| {
        Err(Error::config(field, value, format!("is not supported with {method}: {instead}")))
    };
    if form != StaticForm::None {
        return refuse("static.form", &form.name(), "its field represents the whole object; set it to \"none\"");
    }
    for (field, is_on) in [
        ("hull.enabled", config.hull.enabled),
        ("occupancy.enabled", config.occupancy.enabled),
        ("loss.normalise", config.loss.normalise),
        ("march.along_axis", config.march.along_axis),
    ] {
        if is_on {
            return refuse(field, &true, "this method does not use it; set it to false");
        }
    }
    if config.loss.dynamic_target != DynamicTarget::Absolute {
        let instead = "this method is fitted to whole images; set it to \"absolute\"";
        return refuse("loss.dynamic_target", &"temporal", instead);
    }
    Ok(())
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
