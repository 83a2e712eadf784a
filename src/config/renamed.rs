//! Keys that were renamed: settings of the baselines have the names that the publications' codes give them, others the words of the field.
//! Earlier names are still read.

/// Section, earlier key and present key.
const RENAMED: &[(&str, &str, &str)] = &[
    ("dynamic", "least_slope", "min_slope"),
    ("networks", "least_change", "min_change"),
    ("networks", "least_integral", "min_integral"),
    ("gaussians", "least_scale", "min_scale"),
    ("gaussians", "greatest_scale", "max_scale"),
    ("gaussians", "weakest", "prune_threshold"),
    ("r2", "count", "n_points"),
    ("r2", "density_share", "density_rescale"),
    ("r2", "candidate", "density_thresh"),
    ("r2", "least_scale", "scale_min"),
    ("r2", "greatest_scale", "scale_max"),
    ("r2", "position_rate", "position_lr_init"),
    ("r2", "position_rate_end", "position_lr_final"),
    ("r2", "density_rate", "density_lr_init"),
    ("r2", "density_rate_end", "density_lr_final"),
    ("r2", "scale_rate", "scaling_lr_init"),
    ("r2", "scale_rate_end", "scaling_lr_final"),
    ("r2", "rotation_rate", "rotation_lr_init"),
    ("r2", "rotation_rate_end", "rotation_lr_final"),
    ("r2", "ssim", "lambda_dssim"),
    ("r2", "tv", "lambda_tv"),
    ("r2", "tv_box", "tv_vol_size"),
    ("r2", "densify_every", "densification_interval"),
    ("r2", "densify_from", "densify_from_iter"),
    ("r2", "densify_until", "densify_until_iter"),
    ("r2", "densify_gradient", "densify_grad_threshold"),
    ("r2", "size_limit", "densify_scale_threshold"),
    ("r2", "most", "max_num_gaussians"),
    ("r2", "weakest", "density_min_threshold"),
    ("x", "position_rate", "position_lr_init"),
    ("x", "position_rate_end", "position_lr_final"),
    ("x", "intensity_rate", "feature_lr"),
    ("x", "opacity_rate", "opacity_lr"),
    ("x", "scale_rate", "scaling_lr"),
    ("x", "rotation_rate", "rotation_lr"),
    ("x", "ssim", "lambda_dssim"),
    ("x", "densify_every", "densification_interval"),
    ("x", "densify_from", "densify_from_iter"),
    ("x", "densify_until", "densify_until_iter"),
    ("x", "densify_gradient", "densify_grad_threshold"),
    ("x", "size_limit", "percent_dense"),
    ("x", "most", "max_gaussians"),
    ("x", "weakest", "min_opacity"),
    ("x", "greatest_scale", "max_scale"),
    ("x", "greatest_radius", "max_screen_size"),
    ("x", "reset_every", "opacity_reset_interval"),
    ("sax", "levels", "num_levels"),
    ("sax", "base", "base_resolution"),
    ("sax", "log2_table", "log2_hashmap_size"),
    ("sax", "windows", "window_num"),
    ("sax", "window", "window_size"),
    ("sax", "rays", "n_rays"),
    ("sax", "samples", "n_samples"),
    ("sax", "rate", "lrate"),
    ("sax", "rate_falls_at", "lrate_step"),
    ("sax", "rate_fall", "lrate_gamma"),
];

/// Returns the present name of a key such as `r2.most`.
pub fn current(key: &str) -> String {
    let Some((section, name)) = key.split_once('.') else { return key.to_owned() };
    let found = RENAMED.iter().find(|(of, earlier, _)| *of == section && *earlier == name);
    found.map_or(key.to_owned(), |(section, _, now)| format!("{section}.{now}"))
}

/// Renames the keys of the table of a file.
pub(super) fn rename(table: &mut toml::Table) {
    for (section, earlier, now) in RENAMED {
        let Some(settings) = table.get_mut(*section).and_then(toml::Value::as_table_mut) else { continue };
        if let Some(value) = settings.remove(*earlier) {
            settings.insert((*now).to_owned(), value);
        }
    }
}

/// Returns the earlier name of a key of a section; `None` for a key that was not renamed.
pub fn earlier(section: &str, key: &str) -> Option<&'static str> {
    RENAMED.iter().find(|(of, _, now)| *of == section && *now == key).map(|(_, earlier, _)| *earlier)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::{Config, Preset};

    #[test]
    fn earlier_keys_are_read_in_settings_files_and_checkpoints() {
        let load = |setting: &str| Config::load(Some(Preset::R2Gaussian), None, &[setting.to_owned()]).unwrap();
        assert_eq!(load("r2.most=60000"), load("r2.max_num_gaussians=60000"));
        let directory = tempfile::tempdir().unwrap();
        let file = directory.path().join("part.toml");
        std::fs::write(&file, "preset = \"sax-nerf\"\n[sax]\nlog2_table = 12\n").unwrap();
        assert_eq!(Config::load(None, Some(&file), &[]).unwrap().sax.log2_table, 12);
        // Headers of checkpoints have all settings under the names of their time.
        let config = Config::preset(Preset::XGaussian);
        let mut table = toml::Table::try_from(&config).unwrap();
        for (section, before, now) in RENAMED {
            let settings = table[*section].as_table_mut().unwrap();
            let value = settings.remove(*now).unwrap_or_else(|| panic!("{section}.{now} is no key"));
            settings.insert((*before).to_owned(), value);
        }
        assert_eq!(table.try_into::<Config>().unwrap(), config);
    }
}
