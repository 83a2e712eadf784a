//! Tests of configurations.

use crate::calibrate::settings::CalibrateMode;
use crate::choice::Choice;
use crate::config::sections::{GaussiansSettings, NertCaSettings, R2Settings, Rule, XSettings};
use crate::config::{AdjustMode, CatheterChoice, Config, GaussianForm, Preset};
use crate::error::Result;
use std::collections::BTreeSet;

fn load(preset: Preset, setting: &str) -> Result<Config> {
    Config::load(Some(preset), None, &[setting.to_owned()])
}

fn refusal(preset: Preset, setting: &str) -> String {
    load(preset, setting).err().unwrap_or_else(|| panic!("{preset:?} takes {setting}")).to_string()
}

fn of_text(text: &str) -> Result<Config> {
    let directory = tempfile::tempdir().unwrap();
    let file = directory.path().join("config.toml");
    std::fs::write(&file, text).unwrap();
    Config::load(None, Some(&file), &[])
}

fn keys(config: &Config) -> BTreeSet<String> {
    let printed: toml::Table = config.acting_toml().unwrap().parse().unwrap();
    let names = |(section, value): (&String, &toml::Value)| match value.as_table() {
        Some(inner) => inner.keys().map(|name| format!("{section}.{name}")).collect(),
        None => vec![section.clone()],
    };
    // A preset is chosen by --preset.
    printed.iter().flat_map(names).filter(|key| key != "preset").collect()
}

#[test]
fn settings_override_files_override_presets() {
    let dir = tempfile::tempdir().unwrap();
    let file = dir.path().join("c.toml");
    std::fs::write(&file, "preset = \"paper\"\n[train]\nrays = 100\niterations = 7\n").unwrap();
    let config = Config::load(None, Some(&file), &["train.rays=64".into(), "static.lr=1".into()]).unwrap();
    let config = config.of::<NertCaSettings>().unwrap();
    assert_eq!((config.batch.rays, config.train.iterations, config.network.width), (64, 7, 128));
    assert_eq!((config.preset, config.static_field.lr), (Preset::Paper, 1.0));
}

#[test]
fn numbers_are_read_as_people_type_them() {
    let of = |text: &str| load(Preset::Fast, text).unwrap().of::<GaussiansSettings>().unwrap();
    let lr = |text: &str| of(&format!("static.lr={text}")).static_field.lr;
    for text in ["0.003", ".003", "3e-3", "3E-3", "+.003", "+0.003", "0.003_0", "00.003"] {
        assert_eq!(lr(text), 0.003, "{text}");
    }
    assert_eq!((lr("5"), lr("5."), lr("+5"), lr("1_0")), (5.0, 5.0, 5.0, 10.0));
    let rays = |text: &str| of(&format!("train.rays={text}")).batch.rays;
    for text in ["1000", "1_000", "+1000", "1e3", "1000.0", "01000"] {
        assert_eq!(rays(text), 1000, "{text}");
    }
}

#[test]
fn what_does_not_fit_names_key_and_file() {
    for (text, parts) in [
        ("[train]\nrays = -1\n", &["config.toml", "train.rays = -1", "invalid value"][..]),
        ("[train]\nrays = 0.5\n", &["config.toml", "train.rays = 0.5", "expected integer"]),
        ("[train]\nray = 5\n", &["config.toml", "train.ray ", "unknown key"]),
        ("[gaussians]\nform = 'x y'\n", &["config.toml", "gaussians.form", "unknown variant"]),
        ("preset = 'quick'\n", &["config.toml", "preset", "quick"]),
    ] {
        let told = of_text(text).unwrap_err().to_string();
        assert!(parts.iter().all(|part| told.contains(part)), "{text}: {told}");
    }
    let told = refusal(Preset::Fast, "train.rays=-1");
    assert!(told.contains("train.rays = -1"), "{told}");
    assert_eq!(of_text("\u{feff}preset = 'paper'\n").unwrap().preset, Preset::Paper);
    let directory = tempfile::tempdir().unwrap();
    assert!(Config::load(None, Some(directory.path()), &[]).unwrap_err().to_string().contains("is a folder"));
}

#[test]
fn bad_settings_name_the_key() {
    for (preset, setting, part) in [
        (Preset::Fast, "train.rayz=3", "train.rayz"),
        (Preset::Fast, "train.rays=hello", "train.rays"),
        (Preset::Fast, "train.rays=0", "train.rays"),
        (Preset::Fast, "gaussians.count=0", "gaussians.count"),
        (Preset::Fast, "static.lr=nan", "static.lr"),
        (Preset::Fast, "train", "setting"),
        (Preset::Paper, "dynamic.width=20", "dynamic.width"),
        (Preset::Paper, "dynamic.window_start=11", "frequency bands"),
        (Preset::Paper, "march.static_samples=4096", ""),
        (Preset::R2Gaussian, "r2.n_points=0", "r2.n_points"),
        (Preset::R2Gaussian, "r2.tv_vol_size=300", "r2.tv_vol_size"),
        (Preset::R2Gaussian, "r2.scale_max=0.0001", "r2.scale_max"),
        (Preset::R2Gaussian, "r2.max_num_gaussians=10", "r2.n_points"),
        (Preset::R2Gaussian, "r2.static_data=both", "both"),
        (Preset::XGaussian, "x.interval=300", "x.interval"),
        (Preset::XGaussian, "x.max_gaussians=10", "x.max_gaussians"),
        (Preset::XGaussian, "x.min_opacity=0.2", "x.min_opacity"),
        (Preset::SaxNerf, "sax.num_levels=3", "sax.num_levels"),
        (Preset::SaxNerf, "sax.n_samples=7", "sax.n_samples"),
        (Preset::SaxNerf, "sax.log2_hashmap_size=30", "sax.log2_hashmap_size"),
        (Preset::SaxNerf, "sax.window_size=0", "sax.window_size"),
    ] {
        if part.is_empty() {
            load(preset, setting).unwrap();
            continue;
        }
        let message = refusal(preset, setting);
        assert!(message.contains(part), "{setting}: {message}");
    }
}

#[test]
fn more_first_gaussians_than_there_is_room_for_are_refused_however_many() {
    let mut config = Config::preset(Preset::XGaussian).of::<XSettings>().unwrap();
    (config.x.voxels, config.x.interval) = (2048, 1);
    assert!(config.into_any().check().unwrap_err().to_string().contains("x.max_gaussians"));
}

#[test]
fn settings_of_other_methods_are_refused_with_the_reason() {
    for (preset, setting) in [
        (Preset::SaxNerf, "dynamic.lr=0.5"),
        (Preset::SaxNerf, "train.rays=7"),
        (Preset::R2Gaussian, "sax.lrate=0.5"),
        (Preset::XGaussian, "r2.n_points=3"),
        (Preset::Fast, "dynamic.width=64"),
        (Preset::Paper, "gaussians.count=9"),
        (Preset::NerfCa, "static.grid=12"),
        (Preset::FastMlp, "calibrate.adjust=auto"),
    ] {
        let (message, key) = (refusal(preset, setting), setting.split('=').next().unwrap());
        assert!(message.contains(key) && message.contains("has no effect with the preset"), "{setting}: {message}");
        assert!(message.contains("--print-config"), "{message}");
    }
}

#[test]
fn constants_are_refused_with_their_value() {
    let message = refusal(Preset::Fast, "gaussians.grow_at=3");
    assert!(message.contains("is a constant of the program, 50"), "{message}");
    // A value that changes nothing is no mistake.
    load(Preset::Fast, "gaussians.grow_at=50").unwrap();
    let message = refusal(Preset::Fast, "gaussians.cut=3");
    assert!(message.contains("unknown key") && message.contains("gaussians.count"), "{message}");
    let message = refusal(Preset::Fast, "gauss.count=3");
    assert!(message.contains("unknown key") && message.contains("gaussians"), "{message}");
}

#[test]
fn values_that_chose_a_method_name_the_preset_to_choose() {
    for (preset, setting, instead) in [
        (Preset::Fast, "gaussians.form=none", "`fast-mlp` or `paper`"),
        (Preset::Fast, "gaussians.form=r2", "`r2-gaussian`"),
        (Preset::Fast, "gaussians.form=x", "`x-gaussian`"),
        (Preset::Fast, "static.form=network", "`nerf-ca`"),
        (Preset::Fast, "dynamic.form=lineformer", "`sax-nerf`"),
        (Preset::Paper, "gaussians.form=phase", "`fast`"),
        (Preset::Paper, "march.along_axis=true", "`nerf-ca`"),
        (Preset::NerfCa, "gaussians.form=deformable", "`fast`"),
        (Preset::R2Gaussian, "static.form=tensor", "`fast`"),
    ] {
        let message = refusal(preset, setting);
        assert!(message.contains(&format!("choose the preset {instead}")), "{setting}: {message}");
    }
    let form = |setting: &str| load(Preset::Fast, setting).unwrap().of::<GaussiansSettings>().unwrap().gaussians.form;
    assert_eq!(form("gaussians.form=tree"), GaussianForm::Deformable);
}

#[test]
fn a_preset_has_at_most_thirty_settings_and_all_have_at_most_a_hundred() {
    let mut all = BTreeSet::new();
    for preset in Preset::ALL.iter().copied() {
        let keys = keys(&Config::preset(preset));
        assert!(keys.len() <= 30, "{preset:?}: {} settings {keys:?}", keys.len());
        all.extend(keys);
    }
    assert!(all.len() <= 100, "{} settings", all.len());
}

#[test]
fn printed_settings_are_those_that_act_and_read_back() {
    for preset in Preset::ALL.iter().copied() {
        let config = Config::preset(preset);
        config.check().unwrap();
        assert!(keys(&config).iter().all(|key| config.acts(key)), "{preset:?}");
        assert_eq!(of_text(&config.acting_toml().unwrap()).unwrap(), config, "{preset:?}");
        assert_eq!(of_text(&config.to_toml().unwrap()).unwrap(), config, "{preset:?}");
        let header = serde_json::to_string(&config).unwrap();
        assert_eq!(serde_json::from_str::<Config>(&header).unwrap(), config, "{preset:?}");
    }
    let printed = |preset| Config::preset(preset).acting_toml().unwrap();
    assert!(!printed(Preset::SaxNerf).contains("[dynamic]") && printed(Preset::SaxNerf).contains("[sax]"));
    assert!(printed(Preset::Paper).contains("[dynamic]") && !printed(Preset::Paper).contains("[sax]"));
}

#[test]
fn a_whole_file_is_taken_as_it_is_and_a_part_is_checked() {
    let mut config = Config::preset(Preset::SaxNerf).of::<crate::config::sections::SaxSettings>().unwrap();
    // A program with other constants may have written such a file.
    config.sax.base = 12;
    let config = config.into_any();
    assert_eq!(of_text(&config.to_toml().unwrap()).unwrap(), config);
    let message = of_text("preset = \"sax-nerf\"\n[sax]\nbase_resolution = 12\n").unwrap_err().to_string();
    assert!(message.contains("sax.base_resolution"), "{message}");
}

/// A whole configuration as version 0.3.0 recorded it in run directories and, as JSON, in checkpoints: with the sections of all methods.
const OLD: &str = include_str!("old_configuration.toml");

/// Returns the old configuration with other lines, `[section] line` instead of the line with the same name.
fn old(changes: &[&str]) -> toml::Table {
    let mut table: toml::Table = OLD.parse().unwrap();
    for change in changes {
        let (section, line) = change.split_once("] ").unwrap();
        let change: toml::Table = line.parse().unwrap();
        match section.trim_start_matches('[') {
            "" => table.extend(change),
            section => table[section].as_table_mut().unwrap().extend(change),
        }
    }
    table
}

#[test]
fn whole_configurations_of_earlier_versions_are_read() {
    let read = |changes: &[&str]| old(changes).try_into::<Config>();
    let fast = read(&["[gaussians] count = 321", "[tree] warm_iterations = 59"]).unwrap();
    assert_eq!(
        of_text(&toml::to_string(&old(&["[gaussians] count = 321", "[tree] warm_iterations = 59"])).unwrap()).unwrap(),
        fast
    );
    let fast = fast.of::<GaussiansSettings>().unwrap();
    assert_eq!((fast.gaussians.count, fast.deformable.warm_iterations), (321, 59));
    assert_eq!((fast.adjustment.adjust, fast.calibrate.mode), (AdjustMode::Auto, CalibrateMode::Auto));
    let same = read(&[]).unwrap();
    assert_eq!(same, load(Preset::Fast, "gaussians.catheter=keep").unwrap());
    let of_paper = [
        "[] preset = \"paper\"",
        "[gaussians] form = \"none\"",
        "[static] ranks = 5",
        "[dynamic] skip_layer = 3",
        "[dynamic] layers = 4",
    ];
    let paper = read(&of_paper).unwrap().of::<NertCaSettings>().unwrap();
    assert_eq!((paper.static_field.ranks, paper.network.skip_layer, paper.static_field.tv), (5, 3, 100.0));
    let of_r2 = [
        "[] preset = \"r2-gaussian\"",
        "[gaussians] form = \"r2\"",
        "[static] form = \"none\"",
        "[r2] scale_min = 0.001",
    ];
    let r2 = read(&of_r2).unwrap().of::<R2Settings>().unwrap();
    assert_eq!((r2.r2.min_scale, r2.r2.count, r2.train.iterations), (0.001, 50_000, 300));
    for (changes, part) in [
        (&["[gaussians] form = \"none\""][..], "gaussians.form = none"),
        (&["[] preset = \"paper\""], "gaussians.form = auto"),
        (&["[static] form = \"network\""], "static.form = network"),
        (&["[march] along_axis = true"], "march.along_axis = true"),
    ] {
        let message = read(changes).unwrap_err().to_string();
        assert!(message.contains(part) && message.contains("choose the preset"), "{changes:?}: {message}");
    }
    let mut table = old(&[]);
    table["train"].as_table_mut().unwrap().remove("rays");
    assert!(table.try_into::<Config>().unwrap_err().to_string().contains("rays"));
}

#[test]
fn sections_and_values_that_older_checkpoints_lack_have_their_defaults() {
    let mut table = old(&["[] preset = \"fast-mlp\"", "[gaussians] form = \"none\""]);
    let whole = table.clone().try_into::<Config>().unwrap();
    for section in ["calibrate", "networks", "gaussians", "tree", "r2", "x", "sax"] {
        assert!(table.remove(section).is_some());
    }
    for (section, key) in [
        ("static", "form"),
        ("dynamic", "form"),
        ("dynamic", "occlusion_region"),
        ("march", "along_axis"),
        ("adam", "decay_share"),
        ("train", "stop_at_loss_ratio"),
    ] {
        assert!(table[section].as_table_mut().unwrap().remove(key).is_some());
    }
    let mut expected = whole;
    expected.calibrate.mode = CalibrateMode::Off;
    assert_eq!(table.try_into::<Config>().unwrap(), expected);
    let mut fast = old(&[]);
    for key in ["fits", "without_catheter", "link"] {
        assert!(fast["gaussians"].as_table_mut().unwrap().remove(key).is_some());
    }
    let fast = fast.try_into::<Config>().unwrap().of::<GaussiansSettings>().unwrap();
    assert_eq!((fast.gaussians.fits, fast.gaussians.catheter), (1, CatheterChoice::Keep));
}

#[test]
fn the_treatment_of_a_catheter_is_chosen() {
    let choice =
        |setting: &str| load(Preset::Fast, setting).unwrap().of::<GaussiansSettings>().unwrap().gaussians.catheter;
    assert_eq!(choice("gaussians.iterations=120"), CatheterChoice::Auto);
    assert_eq!(choice("gaussians.catheter=leave-out"), CatheterChoice::LeaveOut);
    let earlier = old(&["[gaussians] without_catheter = true"]).try_into::<Config>().unwrap();
    assert_eq!(earlier.of::<GaussiansSettings>().unwrap().gaussians.catheter, CatheterChoice::LeaveOut);
    let message = refusal(Preset::Fast, "gaussians.catheter=gone");
    assert!(message.contains("keep, leave-out or auto"), "{message}");
}

#[test]
fn earlier_names_are_read_in_whole_configurations() {
    let mut table = old(&["[] preset = \"r2-gaussian\"", "[gaussians] form = \"r2\"", "[static] form = \"none\""]);
    let section = table["r2"].as_table_mut().unwrap();
    for (now, before) in [("n_points", "count"), ("lambda_tv", "tv"), ("max_num_gaussians", "most")] {
        let value = section.remove(now).unwrap();
        section.insert(before.to_owned(), value);
    }
    assert_eq!(table.try_into::<Config>().unwrap().of::<R2Settings>().unwrap().r2.count, 50_000);
}

#[test]
fn rules_are_left_out_by_name() {
    let fast = load(Preset::Fast, "gaussians.without_rules=[\"fillings\", \"stiff-motion\"]").unwrap();
    let left_out = fast.of::<GaussiansSettings>().unwrap().gaussians.without_rules.clone();
    assert_eq!(left_out.0, [Rule::Fillings, Rule::StiffMotion]);
    let message = refusal(Preset::Fast, "gaussians.without_rules=[\"luck\"]");
    assert!(message.contains("luck") && message.contains("fits-in-noise"), "{message}");
    let message = refusal(Preset::Fast, "gaussians.without_rules=fillings");
    assert!(message.contains("expected array"), "{message}");
}
