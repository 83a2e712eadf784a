//! Problems small enough for f64 twins: configurations and Gaussians that need no file.

use crate::config::sections::LeftOut;
use crate::config::{Config, Preset};
use crate::error::{Error, Result};
use crate::gaussians::field::{GaussianField, Gaussians, MovingGaussians, Units};
use crate::gaussians::view::SplatView;
use crate::geometry::{CArm, Geometry};
use crate::kernels::layout::{Gaussian, GaussianSetup, MotionGridSetup};
use crate::methods::dynamic_gaussians::rules::{DeformableRules, GaussianRules, Rules};
use crate::methods::dynamic_gaussians::targets::lengths::Lengths;
use crate::methods::dynamic_gaussians::targets::shared_images::SharedImages;
use crate::methods::dynamic_gaussians::targets::{PossibleVessel, Targets};
use crate::random::{STREAM_JITTER, normal};
use crate::reference::dynamic_gaussians::DeformableParams;
use crate::reference::gaussians::params;
use crate::scan::small::rays;
use glam::DVec3;

/// Preset with a network of tuned settings.
pub const FAST_NETWORK: Preset = Preset::FastMlp;
/// Preset with a network as the paper states it.
pub const PAPER_NETWORK: Preset = Preset::Paper;
/// Preset with a network as the authors' public code has it.
pub const PUBLIC_NETWORK: Preset = Preset::PublicCode;
/// Preset whose static field is a network as well.
pub const TWO_NETWORKS: Preset = Preset::NerfCa;

/// A configuration small enough for f64 twins, on top of a preset.
///
/// # Errors
/// [`crate::error::Error::Config`] for a setting that is not usable.
pub fn small_config(preset: Preset, settings: &[&str]) -> Result<Config> {
    let small = [
        "train.rays=21",
        "train.chunk_samples=1024",
        "train.iterations=40",
        "train.iterations_per_submit=4",
        "march.static_samples=24",
        "march.dynamic_samples=40",
        "march.render_samples=32",
        "static.grid=9",
        "dynamic.width=32",
        "dynamic.delay=0",
        "dynamic.window_iterations=20",
        "hull.enabled=false",
    ];
    let config = Config::preset(preset);
    let acts = |setting: &&&str| setting.split_once('=').is_some_and(|(key, _)| config.acts(key));
    with_values(&config, small.iter().filter(acts).chain(settings).copied())
}

/// Returns a configuration with other recorded values, whether users may change them or not: `section.name=value`, as TOML writes them.
///
/// # Errors
/// [`Error::Config`] for a value that is not usable.
pub fn with_values<'a>(config: &Config, values: impl IntoIterator<Item = &'a str>) -> Result<Config> {
    let internal = |e: &dyn std::fmt::Display| Error::Internal(e.to_string());
    let mut table = toml::Table::try_from(config).map_err(|e| internal(&e))?;
    for text in values {
        let unknown = || Error::config("setting", text, "is not `section.name=value` with a recorded value");
        let (key, value) = text.split_once('=').ok_or_else(unknown)?;
        let slot = match key.split_once('.') {
            None => table.get_mut(key),
            Some((section, name)) => table.get_mut(section).and_then(|section| section.get_mut(name)),
        };
        let slot = slot.ok_or_else(unknown)?;
        *slot = match slot {
            toml::Value::String(_) => value.into(),
            toml::Value::Float(_) => value.parse::<f64>().map_err(|e| internal(&e))?.into(),
            toml::Value::Integer(_) => value.parse::<i64>().map_err(|e| internal(&e))?.into(),
            _ => (value == "true").into(),
        };
    }
    let config: Config = table.try_into().map_err(|e: toml::de::Error| internal(&e))?;
    config.check()?;
    Ok(config)
}

/// Gaussians of all shapes within `reach` pixels of the isocentre.
pub fn random_gaussians(n: usize, n_phases: u32, reach: f64, seed: u32) -> Vec<Gaussian> {
    let value = |i: usize, k: u32| normal(seed, STREAM_JITTER, i as u32, k);
    (0..n)
        .map(|i| Gaussian {
            position: [0, 1, 2].map(|k| (0.5 * reach * value(i, k)) as f32),
            log_density: (-1.5 + 0.4 * value(i, 3)) as f32,
            log_scale: [4, 5, 6].map(|k| (0.3 * value(i, k)) as f32),
            phase: i as u32 % n_phases,
            rotation: [7, 8, 9, 10].map(|k| value(i, k) as f32),
        })
        .collect()
}

/// Angles of the views of [`targets`], degrees.
pub const ANGLES_DEG: [[f64; 2]; 3] = [[-30.0, 30.0], [55.0, -20.0], [5.0, 8.0]];

/// A C-arm at such angles.
pub fn c_arm(angles_deg: [f64; 2]) -> Geometry {
    Geometry::CArm(CArm {
        primary_deg: angles_deg[0],
        secondary_deg: angles_deg[1],
        sid_mm: 1000.0,
        sod_mm: 620.0,
        pixel_mm: [1.5, 1.8],
        offset_mm: [1.0, -2.0],
        table_mm: [0.0; 3],
    })
}

/// The pixel of [`c_arm`] at the isocentre, world units.
pub fn units() -> Units {
    Units { pixel: 0.5 * (1.5 + 1.8) * 620.0 / 1000.0 / 100.0, strongest: 0.2 }
}

/// Targets of Gaussians: images that no vessel explains; the last view has no image of the last phase.
///
/// # Errors
/// [`crate::error::Error::Config`] for an impossible size.
pub fn targets(width: usize, height: usize, n_phases: usize) -> Result<Targets> {
    let view = |angles: &[f64; 2]| Ok(SplatView::new(&rays(&c_arm(*angles), width, height)?, units()));
    let views = ANGLES_DEG.iter().map(view).collect::<Result<Vec<SplatView>>>()?;
    let n_images = n_phases * views.len() - 1;
    let n_views = views.len();
    let views: Vec<SplatView> = views.iter().cycle().take(n_images).cloned().collect();
    let image_of = (0..n_images).map(Some).chain([None]).collect();
    let wave = |i: usize, k: f64| (0.5 + 0.5 * (k * i as f64).sin()) as f32;
    let all = 0..n_images * width * height;
    Ok(Targets {
        units: units(),
        width,
        height,
        n_phases,
        n_views,
        views,
        image_of,
        n_images,
        low: all.clone().map(|i| wave(i, 0.37) - 0.1).collect(),
        high: all.clone().map(|i| wave(i, 0.37) - 0.1 + 0.3 * wave(i, 0.71)).collect(),
        weight: SharedImages::of_each(all.clone().map(|i| 0.5 + 0.5 * wave(i, 0.13)).collect(), width * height),
        noise: SharedImages::of_each(vec![0.01; n_images * width * height], width * height),
        contrast: vec![1.0; n_images],
        lengths: Lengths { factor: 1.0, smoothing: 1.0 },
        rest_phase: 0,
        images: all.clone().map(|i| 1.0 + wave(i, 0.37)).collect(),
        max: Some(all.clone().map(|i| 1.0 + wave(i, 0.37)).collect()),
        contrast_comes_and_goes: false,
        views_adjusted: false,
        left_out: LeftOut::default(),
        places: vec![Vec::new(); n_phases],
        cell: 1.0,
    })
}

/// Problem that kernels are compared on: sizes that are no multiples of anything, Gaussians outside the image and behind the
/// source, a phase that a view lacks.
///
/// # Errors
/// As [`targets`].
pub fn hard_case() -> Result<(Targets, Vec<Gaussian>)> {
    let targets = targets(33, 27, 3)?;
    let mut rows = random_gaussians(77, 3, 12.0, 4);
    rows[5].position = [300.0, 0.0, 0.0];
    let behind = targets.views[0].source - targets.views[0].ray(16.0, 13.0) * 50.0;
    rows[6].position = behind.as_vec3().to_array();
    rows[7].log_scale = [2.0, -3.0, 0.1];
    Ok((targets, rows))
}

/// Numbers of the default fit of Gaussians.
///
/// # Errors
/// [`Error::Internal`] where the default preset fits no Gaussians.
pub fn default_rules() -> Result<Rules> {
    Ok(Rules::of(&Config::preset(Preset::default()).of()?))
}

/// A deformable set's targets, Gaussians and settings.
///
/// # Errors
/// As [`targets`].
pub fn deformable_case() -> Result<(Targets, Vec<Gaussian>, Rules)> {
    let mut targets = targets(33, 27, 5)?;
    // Some images were taken between two phases.
    targets
        .views
        .iter_mut()
        .zip([0.0, 0.3, -0.45].into_iter().cycle())
        .for_each(|(view, after)| view.after_phase = after);
    targets.rest_phase = 3;
    // The grid covers the places.
    let corner = PossibleVessel { position: DVec3::splat(14.0), evidence: 18.0, far_from_prior: 0.0 };
    targets.places[0].push(corner);
    let mut rows = random_gaussians(31, 1, 11.0, 8);
    rows[3].position = [300.0, 0.0, 0.0];
    let preset = default_rules()?;
    let deformable = DeformableRules { node: 12.0, smoothness: 0.5, own_penalty: 0.7, ..preset.deformable };
    let gaussians = GaussianRules { grow_at: 0, ..preset.gaussians.clone() };
    Ok((targets, rows, Rules { deformable, gaussians, ..preset }))
}

/// A deformable set that already moves: Gaussians at rest, own motion, and a grid filled with waves where it does not rest.
pub fn moving_set(rows: &[Gaussian], deformable: &MotionGridSetup, n_phases: usize) -> DeformableParams {
    let wave = |i: usize, k: f64| {
        let at = |c: f64| f64::from((0.4 * (k * (i as f64 + c)).sin()) as f32);
        DVec3::new(at(0.0), at(0.3), at(0.9))
    };
    let nodes = deformable.nodes();
    let rests = |i: usize| i / nodes == deformable.rest_phase as usize;
    let grid = (0..n_phases * nodes).map(|i| if rests(i) { DVec3::ZERO } else { wave(i, 0.61) }).collect();
    let own = (0..rows.len() * deformable.n_basis as usize).map(|i| 0.5 * wave(i, 0.47)).collect();
    DeformableParams { rows: rows.iter().map(params).collect(), own, grid, filling: Vec::new() }
}

/// Fillings of `n` Gaussians, `[Gaussian][phase]`, full at the rest phase.
pub fn fillings(n: usize, n_phases: usize, rest_phase: usize) -> Vec<f64> {
    let value = |i: usize| if i % n_phases == rest_phase { 1.0 } else { 0.5 + 0.45 * (0.83 * i as f64).sin() };
    (0..n * n_phases).map(|i| f64::from(value(i) as f32)).collect()
}

/// Pixel at the isocentre and strongest change of [`drawn_fields`], world units.
const DRAWN_UNITS: Units = Units { pixel: 0.006, strongest: 0.3 };

/// Sets of Gaussians per phase, to be drawn.
fn drawn_set(n: usize, n_phases: u32) -> Gaussians {
    let value = |i: usize, k: u32| normal(5, 0, i as u32, k);
    let rows = (0..n).map(|i| Gaussian {
        position: [0, 1, 2].map(|k| (11.0 * value(i, k)) as f32),
        log_density: (-1.5 + 0.4 * value(i, 3)) as f32,
        log_scale: [4, 5, 6].map(|k| (0.2 + 0.4 * value(i, k)) as f32),
        phase: i as u32 % n_phases,
        rotation: [7, 8, 9, 10].map(|k| value(i, k) as f32),
    });
    let setup = GaussianSetup { n_phases, cut: 3.2, min_scale: 0.4, max_scale: 3.0, ..GaussianSetup::default() };
    Gaussians {
        units: DRAWN_UNITS,
        n_phases: n_phases as usize,
        setup,
        rows: rows.collect(),
        step: 7,
        is_crowd: false,
        agreement: None,
        intensities: None,
    }
}

/// One set of Gaussians that moves, to be drawn.
fn drawn_deformable(n: usize, n_phases: u32) -> MovingGaussians {
    const REST_PHASE: u32 = 1;
    let setup = MotionGridSetup {
        n_nodes: 4,
        half_side: 30.0,
        inverse_step: 0.05,
        n_basis: 4,
        rest_phase: REST_PHASE,
        ..MotionGridSetup::default()
    };
    let wave = |i: usize| [0.7, 1.1, 1.9].map(|k| (1.5 * (k * i as f64).sin()) as f32);
    let vector = |i: usize| [wave(i)[0], wave(i)[1], wave(i)[2], 0.0];
    let rests = |i: usize| i / 64 == REST_PHASE as usize;
    let grid = (0..n_phases as usize * 64).map(|i| if rests(i) { [0.0; 4] } else { vector(i) }).collect();
    let mut rest = drawn_set(n, 1);
    (rest.n_phases, rest.setup.n_phases) = (n_phases as usize, n_phases);
    MovingGaussians { rest, setup, grid, own: (0..n * 4).map(vector).collect(), filling: None }
}

/// Dynamic fields of three phases to be drawn, one of each form.
pub fn drawn_fields() -> [GaussianField; 2] {
    [GaussianField::PerPhase(drawn_set(231, 3)), GaussianField::Moving(drawn_deformable(77, 3))]
}
