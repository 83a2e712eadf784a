//! Choosing scales and boxes for a dataset.

use crate::config::DynamicTarget;
use crate::config::fields::FieldSettings;
use crate::error::{Error, Result};
use crate::fields::motion::ViewMotion;
use crate::fitting::extent::{box_half, field_of_view, seen_half};
use crate::geometry::MM_PER_UNIT;
use crate::model::hull::Hull;
use crate::model::scene::Scene;
use crate::raster::percentile;
use crate::scan::dataset::Dataset;
use glam::DVec3;

/// Volume that a field fills.
#[derive(Debug, Clone, Copy)]
pub struct FieldVolume {
    /// Half side of a cube around the isocentre, world units.
    pub half: f64,
    /// Attenuation per world unit that is the unit of the field's volumes; none where the images decide.
    pub attenuation: Option<f64>,
}

impl Scene {
    /// Chooses scales and boxes for a dataset.
    ///
    /// # Errors
    /// [`Error::Data`] when the images cannot be normalised.
    pub fn new(
        settings: &FieldSettings,
        dataset: &Dataset,
        motion: &[ViewMotion],
        hull: Option<&Hull>,
    ) -> Result<Scene> {
        let (near, far) = dataset.depth_range;
        let static_half = static_half(settings, dataset);
        let static_reach = static_half * 3f64.sqrt();
        let half = dynamic_half(settings.dynamic.half_extent_mm, dataset);
        let (dynamic_min, dynamic_max) =
            hull.and_then(Hull::bounds).unwrap_or((DVec3::splat(-half), DVec3::splat(half)));
        let corner = dynamic_min.abs().max(dynamic_max.abs()).length();
        let dynamic_depth =
            if settings.march.fit_dynamic_range { [near.max(-corner), far.min(corner)] } else { [near, far] };
        let (encode_centre, encode_scale) = if settings.dynamic.encode_box {
            let centre = 0.5 * (dynamic_min + dynamic_max);
            (centre, std::f64::consts::PI / (0.5 * (dynamic_max - dynamic_min)).max_element())
        } else {
            (DVec3::ZERO, 1.0)
        };
        let mut scene = Scene {
            static_min: [-static_half; 3],
            static_max: [static_half; 3],
            static_depth: if settings.march.fit_static_range {
                [near.max(-static_reach), far.min(static_reach)]
            } else {
                [near, far]
            },
            encode_centre: encode_centre.to_array(),
            encode_scale,
            ..Scene::of_boxes(dynamic_min.to_array(), dynamic_max.to_array(), dynamic_depth, dataset)
        };
        if settings.loss.normalise {
            scene.normalise(settings, dataset, motion, static_half)?;
        }
        if let Some(networks) = &settings.networks {
            scene.hold_all_rays(networks.gain, dataset);
        }
        Ok(scene)
    }

    /// Returns scales and boxes of a static field that fills a volume by itself, and the region to look for vessels: the part of
    /// the volume that the views see.
    pub fn of_volume(dataset: &Dataset, volume: FieldVolume) -> Scene {
        let (half, seen) = (volume.half, seen_half(dataset).min(volume.half));
        let corner = half * 3f64.sqrt();
        Scene {
            static_gain: 0.0,
            dynamic_gain: volume.attenuation.unwrap_or(1.0),
            region: Some([[-seen; 3], [seen; 3]]),
            ..Scene::of_boxes([-half; 3], [half; 3], [-corner, corner], dataset)
        }
    }

    /// Returns a scene whose fields have the same box, from `min` to `max`, and the same depths, with scales of 1.
    fn of_boxes(min: [f64; 3], max: [f64; 3], depth: [f64; 2], dataset: &Dataset) -> Scene {
        Scene {
            static_min: min,
            static_max: max,
            dynamic_min: min,
            dynamic_max: max,
            static_depth: depth,
            dynamic_depth: depth,
            encode_centre: [0.0; 3],
            encode_scale: 1.0,
            static_gain: 1.0,
            static_shift: -10.0,
            dynamic_gain: 1.0,
            dynamic_shift: -10.0,
            static_weight: 1.0,
            dynamic_weight: 1.0,
            robust_scale: 0.0,
            region: None,
            still: dataset.still,
        }
    }

    /// Sets the boxes of two networks, which hold every point of the views' rays however a C-arm turns them about the
    /// isocentre, so that new poses lose none either. Sets the networks' activations, too.
    fn hold_all_rays(&mut self, gain: f64, dataset: &Dataset) {
        let half = reach(dataset);
        (self.static_min, self.static_max) = ([-half; 3], [half; 3]);
        (self.dynamic_min, self.dynamic_max) = ([-half; 3], [half; 3]);
        // Most of that box is seen by one view or by none, and is no place to look for vessels.
        let seen = seen_half(dataset);
        self.region = Some([[-seen; 3], [seen; 3]]);
        (self.static_gain, self.dynamic_gain) = (gain, gain);
        (self.static_shift, self.dynamic_shift) = (0.0, 0.0);
    }

    /// Chooses gains, shifts and weights so that features, integrals and losses are near 1.
    fn normalise(
        &mut self,
        settings: &FieldSettings,
        dataset: &Dataset,
        motion: &[ViewMotion],
        static_half: f64,
    ) -> Result<()> {
        let training = dataset.training();
        let (mut count, mut sum) = (0, 0.0);
        for frame in training {
            let image = dataset.own(frame.view, &frame.integrals);
            count += image.len();
            image.iter().for_each(|v| sum += f64::from(*v));
        }
        let mean = sum / count as f64;
        if !(mean.is_finite() && mean > 0.0) {
            return Err(Error::data(
                &dataset.path,
                "images",
                format!(
                    "their mean line integral is {mean}, but it must be positive: check the kind of intensities that \
                     was stated"
                ),
            ));
        }
        // softplus(ln(e - 1)) = 1: a feature of zero is the mean attenuation.
        self.static_gain = mean / (2.0 * static_half);
        self.static_shift = (std::f64::consts::E - 1.0).ln();
        self.static_weight = 1.0 / (mean * mean);
        let moving: Vec<f32> = motion
            .iter()
            .flat_map(|m| m.range.iter().zip(&m.moving).filter(|(_, moving)| **moving).map(|(r, _)| *r))
            .collect();
        let change = f64::from(percentile(&moving, 0.9));
        let change = if change > 0.0 { change } else { mean };
        // A vessel fills a few percent of the field of view.
        let vessel = 0.05 * field_of_view(dataset);
        self.dynamic_gain = change / vessel;
        (self.dynamic_weight, self.robust_scale) = match settings.loss.dynamic_target {
            DynamicTarget::Temporal => (1.0 / (change * change), settings.loss.robust * change),
            // Both fields share one squared residual.
            DynamicTarget::Absolute => (self.static_weight, 0.0),
        };
        self.dynamic_shift = settings.dynamic.normalised_shift;
        Ok(())
    }
}

/// Half side of the static field's box, world units. Points far outside the field of view are seen by one view at a time, and a
/// box that held them would spend the field on them.
fn static_half(settings: &FieldSettings, dataset: &Dataset) -> f64 {
    box_half(settings.static_field.tensor().map_or(0.0, |tensor| tensor.half_extent_mm), dataset)
}

/// Radius of the smallest ball around the isocentre that holds all rays of the views over the depth range, with a margin
/// against rounding. The largest coordinates would not do: they depend on the views' own directions, and would leave out ends
/// of rays from other directions.
fn reach(dataset: &Dataset) -> f64 {
    let mut reach = 0f64;
    for view in &dataset.views {
        let [w, h] = view.size.map(|n| n as f64 - 0.5);
        for (i, j) in [(-0.5, -0.5), (w, -0.5), (-0.5, h), (w, h)] {
            let (anchor, direction) = view.rays.pixel(i, j);
            for depth in [dataset.depth_range.0, dataset.depth_range.1] {
                reach = reach.max((anchor + depth * direction).length());
            }
        }
    }
    reach * (1.0 + 1e-5)
}

/// Half side of the box the dynamic field is searched in, world units; `half_extent_mm` is the setting, 0 = the field of view.
pub fn dynamic_half(half_extent_mm: f64, dataset: &Dataset) -> f64 {
    if half_extent_mm > 0.0 { half_extent_mm / MM_PER_UNIT } else { seen_half(dataset) }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::fields::Loss;
    use crate::config::{Config, DynamicTarget, Preset};
    use crate::fields::motion::{Thresholds, analyse};
    use crate::geometry::Geometry;
    use crate::model::component::Component;
    use crate::scan::dataset::{Frame, Layout, Split, View};

    const SIZE: usize = 8;

    fn view(primary_deg: f64, secondary_deg: f64) -> View {
        let geometry = Geometry::CArm(crate::geometry::CArm {
            primary_deg,
            secondary_deg,
            sid_mm: 1000.0,
            sod_mm: 600.0,
            pixel_mm: [15.0; 2],
            offset_mm: [0.0; 2],
            table_mm: [0.0; 3],
        });
        View::new(geometry, [SIZE; 2]).unwrap()
    }

    /// Two views at two phases, whose pixels have the value `still` except for the middle ones, which gain `change` at the
    /// second.
    fn dataset(still: f32, change: f32) -> Dataset {
        let views: Vec<View> = [-30.0, 60.0].map(|primary_deg| view(primary_deg, 0.0)).into();
        let middle = |p: usize| (2..6).contains(&(p % SIZE)) && (2..6).contains(&(p / SIZE));
        let frame = |view, phase| Frame {
            name: format!("v{view}p{phase}"),
            view,
            phase,
            split: Split::Train,
            integrals: (0..SIZE * SIZE).map(|p| if phase == 1 && middle(p) { still + change } else { still }).collect(),
            mask: None,
            after_phase: 0.0,
            heart_shift_mm: [0.0; 3],
            contrast: 1.0,
        };
        Dataset {
            path: "test".into(),
            layout: Layout::Native,
            frames: vec![frame(0, 0), frame(0, 1), frame(1, 0), frame(1, 1)],
            views,
            width: SIZE,
            height: SIZE,
            n_phases: 2,
            notes: Vec::new(),
            depth_range: (-0.9, 0.9),
            hidden: Default::default(),
            vessel_attenuation: None,
            still: false,
            vessels_alone: false,
            views_adjusted: false,
            prior: None,
        }
    }

    /// Loss of a shared residual.
    const ABSOLUTE: Loss = Loss { normalise: true, dynamic_target: DynamicTarget::Absolute, robust: 0.0 };
    /// Loss of what changes over the beat.
    const TEMPORAL: Loss = Loss { dynamic_target: DynamicTarget::Temporal, robust: 0.3, ..ABSOLUTE };

    fn normalised(dataset: &Dataset, loss: Loss) -> Result<Scene> {
        let settings = FieldSettings { loss, ..Config::preset(Preset::Paper).fields().unwrap() };
        Scene::new(&settings, dataset, &analyse(dataset, Thresholds::default()), None)
    }

    fn softplus(x: f64) -> f64 {
        x.exp().ln_1p()
    }

    #[test]
    fn a_feature_of_zero_is_the_mean_integral_of_the_images() {
        // A quarter of the pixels gains 0.4 in half the frames.
        let scene = normalised(&dataset(2.0, 0.4), ABSOLUTE).unwrap();
        let mean = 2.0 + 0.4 / 8.0;
        let across = scene.static_gain * softplus(scene.static_shift) * (scene.static_max[0] - scene.static_min[0]);
        assert!((across - mean).abs() < 1e-6, "{across}");
        assert!((scene.static_weight * mean * mean - 1.0).abs() < 1e-6, "a residual as large as the mean costs 1");
    }

    #[test]
    fn a_vessel_explains_the_largest_change_over_the_beat() {
        let data = dataset(2.0, 0.4);
        let scene = normalised(&data, TEMPORAL).unwrap();
        let vessel = 0.05 * field_of_view(&data);
        assert!((scene.dynamic_gain * vessel - 0.4).abs() < 1e-5, "{}", scene.dynamic_gain * vessel);
        assert!((scene.dynamic_weight * 0.4 * 0.4 - 1.0).abs() < 1e-4);
        assert!((scene.robust_scale - 0.3 * 0.4).abs() < 1e-5);
        // Twice the change: twice the gain, and residuals weigh a quarter.
        let strong = normalised(&dataset(2.0, 0.8), TEMPORAL).unwrap();
        assert!((strong.dynamic_gain / scene.dynamic_gain - 2.0).abs() < 1e-4);
        assert!((strong.dynamic_weight / scene.dynamic_weight - 0.25).abs() < 1e-4);
        // Fields that share one residual share its weight, and there is nothing to be robust against.
        let absolute = normalised(&data, Loss { robust: 0.3, ..ABSOLUTE }).unwrap();
        assert_eq!((absolute.dynamic_weight, absolute.robust_scale), (absolute.static_weight, 0.0));
    }

    /// Ends of the rays at the corners of a view.
    fn corners(view: &View) -> Vec<DVec3> {
        let edges = [-0.5, SIZE as f64 - 0.5];
        let rays = edges.into_iter().flat_map(|i| edges.map(|j| view.rays.pixel(i, j)));
        rays.flat_map(|(anchor, direction)| [-0.9f64, 0.9].map(|depth| anchor + depth * direction)).collect()
    }

    #[test]
    fn boxes_of_two_networks_hold_every_ray_of_any_pose() {
        let data = dataset(2.0, 0.4);
        let settings = Config::preset(Preset::NerfCa).fields().unwrap();
        let scene = Scene::new(&settings, &data, &analyse(&data, Thresholds::default()), None).unwrap();
        let half = scene.dynamic_max[0];
        let coordinate = |view: &View| corners(view).iter().fold(0f64, |m, x| m.max(x.abs().max_element()));
        let own = data.views.iter().map(coordinate).fold(0.0, f64::max);
        assert!(own <= half, "{own} {half}");
        // The corners of this one lie along an axis.
        let other = coordinate(&view(24.0, 24.0));
        assert!(other > 1.05 * own && other <= half, "{other} {own} {half}");
        for pose in [view(0.0, 0.0), view(30.0, -25.0), view(-80.0, 40.0)] {
            assert!(coordinate(&pose) <= half);
        }
        let longest = corners(&data.views[0]).iter().fold(0f64, |m, x| m.max(x.length()));
        assert!(half < 1.001 * longest, "{half} {longest}");
        assert_eq!((scene.static_max, scene.dynamic_min), ([half; 3], [-half; 3]));
        // Vessels are looked for in the field of view.
        let [low, high] = scene.region_of(Component::Dynamic);
        assert_eq!((low, high), ([-field_of_view(&data); 3], [field_of_view(&data); 3]));
        assert!(high[0] < 0.6 * half && scene.region_of(Component::Total) == [low, high]);
        assert_eq!(
            (scene.static_gain, scene.dynamic_gain, scene.static_shift, scene.dynamic_shift),
            (0.01, 0.01, 0.0, 0.0)
        );
    }

    #[test]
    fn images_without_attenuation_are_refused() {
        for still in [0.0, -1.0] {
            let error = normalised(&dataset(still, 0.0), ABSOLUTE).unwrap_err().to_string();
            assert!(error.contains("images") && error.contains("must be positive"), "{error}");
        }
        // Nothing moves: the dynamic field is scaled to the images themselves.
        let still = normalised(&dataset(2.0, 0.0), ABSOLUTE).unwrap();
        assert!(still.dynamic_gain.is_finite() && still.dynamic_gain > 0.0);
    }
}
