//! Degradations: properties of clinical angiograms that a perfect phantom lacks. Holds their options and their random numbers.
//!
//! Only training views are degraded, except for photon noise. Validation views show the heart without displacement by
//! breathing, from the geometry that the dataset states.

use crate::error::{Error, Result};
use crate::geometry::CArm;
use crate::noise::Photons;
use crate::random::{STREAM_ACQUISITION, normal, uniform01};
use crate::scan::dataset::Layout;
use crate::scan::gating::BeatScaling;
use serde::{Deserialize, Serialize};

/// Length of a breath at rest, seconds; the default.
pub const USUAL_BREATH_S: f64 = 4.0;
/// Images per second of a typical run; the default.
pub const USUAL_FRAMES_PER_S: f64 = 15.0;
/// Length of a typical run, beats: contrast fills the vessels for about this time.
pub const USUAL_BEATS: u32 = 3;
/// Longest accepted time for contrast to reach the ends of the vessels, seconds; slower contrast is not useful for angiograms.
const LONGEST_INFLOW_S: f64 = 10.0;
/// Largest accepted share of the vessels that blades hide.
const LARGEST_CUT: f64 = 0.9;

/// Degradations of the training views; none by default.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Degradations {
    /// Errors of the geometry that the dataset states; the images are made with the true geometry.
    pub geometry_error: Option<GeometryError>,
    /// Breathing during and between runs.
    pub breathing: Option<Breathing>,
    /// Photon noise, also of validation views; no noise if it is none.
    pub photons: Option<Photons>,
    /// Standard deviation of a run's contrast density, as a share of it; the variation within a run is half as large.
    pub contrast_variation: f64,
    /// Time after which contrast reaches the ends of the vessels, seconds from the first image of a run; 0 if the vessels are
    /// full from the start.
    pub inflow_s: f64,
    /// Heart rates of the views and the frame rate of the images; none for images exactly at the phases.
    pub rhythm: Option<Rhythm>,
    /// Share of the moving vessels that a blade hides in each view, 0 to 0.9.
    pub collimated_share: f64,
    /// Whether there is a catheter in the aorta with its tip in the ostium.
    pub catheter: bool,
}

/// Standard deviations of the errors of a stated geometry.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct GeometryError {
    /// Standard deviation of primary and secondary angle, degrees.
    pub angle_deg: f64,
    /// Standard deviation of the patient's position along each axis, mm.
    pub position_mm: f64,
}

/// A breathing patient.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Breathing {
    /// Displacement of the heart along the body, peak to peak, mm.
    pub peak_to_peak_mm: f64,
    /// Length of a breath, seconds.
    #[serde(default = "usual_breath_s")]
    pub period_s: f64,
    /// Whether diaphragm and lower chest also move.
    #[serde(default)]
    pub background: bool,
}

fn usual_breath_s() -> f64 {
    USUAL_BREATH_S
}

/// Times of the images and their conversion to phases.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Rhythm {
    /// Beats per minute: one value for all training views, or one for each.
    pub beats_per_min: Vec<f64>,
    /// Images per second.
    #[serde(default = "usual_frames_per_s")]
    pub frames_per_s: f64,
    /// Length of a run, beats.
    #[serde(default = "usual_beats")]
    pub beats: u32,
    /// Conversion of time to phase.
    #[serde(default = "usual_gating")]
    pub gating: BeatScaling,
}

fn usual_frames_per_s() -> f64 {
    USUAL_FRAMES_PER_S
}

fn usual_beats() -> u32 {
    USUAL_BEATS
}

fn usual_gating() -> BeatScaling {
    BeatScaling::TwoSegment
}

fn within(field: &str, value: f64, accepted: std::ops::RangeInclusive<f64>, unit: &str) -> Result<()> {
    match accepted.contains(&value) {
        true => Ok(()),
        false => {
            let problem = format!("is not in the accepted range, {} to {}{unit}", accepted.start(), accepted.end());
            Err(Error::config(field, value, problem))
        }
    }
}

impl Degradations {
    /// Rejects degradations that are impossible for this number of training views or in a layout.
    ///
    /// # Errors
    /// [`Error::Config`] naming the field.
    pub fn check(&self, training_views: usize, layout: Layout) -> Result<()> {
        if let Some(GeometryError { angle_deg, position_mm }) = self.geometry_error {
            within("geometry_error.angle_deg", angle_deg, 0.0..=45.0, " degrees")?;
            within("geometry_error.position_mm", position_mm, 0.0..=100.0, " mm")?;
            if layout == Layout::Nerfca && position_mm > 0.0 {
                let problem = "the layout `nerfca` cannot store the position of the patient; use 0, or the native \
                               layout";
                return Err(Error::config("geometry_error.position_mm", position_mm, problem));
            }
        }
        if let Some(breathing) = self.breathing {
            within("breathing.peak_to_peak_mm", breathing.peak_to_peak_mm, 0.0..=100.0, " mm")?;
            within("breathing.period_s", breathing.period_s, 0.5..=60.0, " s")?;
        }
        if let Some(photons) = self.photons {
            let (field, value) = match photons {
                Photons::Unattenuated(value) => ("photons", value),
                Photons::Detector(value) => ("detector_photons", value),
            };
            within(field, value, 1.0..=1e15, "")?;
        }
        within("contrast_variation", self.contrast_variation, 0.0..=1.0, "")?;
        within("inflow_s", self.inflow_s, 0.0..=LONGEST_INFLOW_S, " s")?;
        within("collimated_share", self.collimated_share, 0.0..=LARGEST_CUT, "")?;
        self.rhythm.as_ref().map_or(Ok(()), |rhythm| rhythm.check(training_views))
    }
}

impl Rhythm {
    fn check(&self, training_views: usize) -> Result<()> {
        let rates = self.beats_per_min.len();
        if rates != 1 && rates != training_views {
            let problem = format!(
                "is the number of rates, but one or {training_views} are needed: one for all training views, or one \
                 for each"
            );
            return Err(Error::config("heart_rate", rates, problem));
        }
        for rate in &self.beats_per_min {
            within("heart_rate", *rate, 20.0..=300.0, " beats per minute")?;
        }
        within("frames_per_s", self.frames_per_s, 0.1..=1000.0, " per second")?;
        within("beats", f64::from(self.beats), 1.0..=100.0, "")
    }
}

/// Quantities that are drawn at random for a run.
#[derive(Debug, Clone, Copy)]
pub(super) enum Draw {
    Geometry,
    Breath,
    RunStart,
    Systole,
    Contrast,
    ContrastCourse,
    Blade,
    Panning,
}

/// Random numbers of one training view. Each [`Draw`] has its own numbers, so that one degradation does not change another.
#[derive(Debug, Clone, Copy)]
pub(super) struct Chance {
    pub(super) seed: u32,
    pub(super) view: u32,
}

impl Chance {
    /// Uniform number in [0, 1).
    pub(super) fn uniform(self, draw: Draw) -> f64 {
        uniform01(self.seed, STREAM_ACQUISITION, draw as u32, self.view)
    }

    /// Standard normal number with an index within a draw.
    fn normal_at(self, draw: Draw, index: u32) -> f64 {
        normal(self.seed, STREAM_ACQUISITION, index << 16 | draw as u32, self.view)
    }

    /// Standard normal number.
    pub(super) fn normal(self, draw: Draw) -> f64 {
        self.normal_at(draw, 0)
    }
}

impl GeometryError {
    /// C-arm as the dataset states it.
    pub(super) fn stated(self, truth: &CArm, chance: Chance) -> CArm {
        let error = |index| chance.normal_at(Draw::Geometry, index);
        CArm {
            primary_deg: truth.primary_deg + self.angle_deg * error(0),
            secondary_deg: truth.secondary_deg + self.angle_deg * error(1),
            table_mm: std::array::from_fn(|axis| truth.table_mm[axis] + self.position_mm * error(2 + axis as u32)),
            ..truth.clone()
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_cannot_be_done_is_named() {
        let none = Degradations::default();
        assert!(none.check(4, Layout::Native).is_ok());
        let rhythm = |beats_per_min: &[f64], frames_per_s| {
            let gating = BeatScaling::Linear;
            Some(Rhythm { beats_per_min: beats_per_min.to_vec(), frames_per_s, beats: 3, gating })
        };
        let error = |angle_deg, position_mm| Some(GeometryError { angle_deg, position_mm });
        let breathing = |peak_to_peak_mm, period_s| Some(Breathing { peak_to_peak_mm, period_s, background: false });
        let refused = [
            (Degradations { geometry_error: error(-0.1, 0.0), ..none.clone() }, "angle_deg = -0.1"),
            (Degradations { geometry_error: error(0.0, f64::NAN), ..none.clone() }, "position_mm = NaN"),
            (Degradations { breathing: breathing(-1.0, 4.0), ..none.clone() }, "peak_to_peak_mm = -1"),
            (Degradations { breathing: breathing(1.0, 0.0), ..none.clone() }, "period_s = 0"),
            (Degradations { photons: Some(Photons::Unattenuated(0.0)), ..none.clone() }, "photons = 0"),
            (Degradations { photons: Some(Photons::Detector(f64::NAN)), ..none.clone() }, "detector_photons = NaN"),
            (Degradations { contrast_variation: f64::INFINITY, ..none.clone() }, "contrast_variation = inf"),
            (Degradations { collimated_share: 1.0, ..none.clone() }, "collimated_share = 1"),
            (Degradations { rhythm: rhythm(&[60.0, 70.0], 15.0), ..none.clone() }, "one or 4"),
            (Degradations { rhythm: rhythm(&[], 15.0), ..none.clone() }, "one or 4"),
            (Degradations { rhythm: rhythm(&[10.0], 15.0), ..none.clone() }, "heart_rate = 10"),
            (Degradations { rhythm: rhythm(&[60.0], 0.0), ..none.clone() }, "frames_per_s = 0"),
        ];
        for (degradations, part) in refused {
            let message = degradations.check(4, Layout::Native).unwrap_err().to_string();
            assert!(message.contains(part), "`{message}` does not say `{part}`");
        }
        let shifted = Degradations { geometry_error: error(0.5, 1.0), ..none };
        assert!(shifted.check(4, Layout::Native).is_ok());
        assert!(shifted.check(4, Layout::Nerfca).unwrap_err().to_string().contains("native"));
    }

    #[test]
    fn errors_of_geometry_have_the_deviation_asked_for() {
        let truth = CArm {
            primary_deg: -30.0,
            secondary_deg: 30.0,
            sid_mm: 1100.0,
            sod_mm: 750.0,
            pixel_mm: [1.0; 2],
            offset_mm: [0.0; 2],
            table_mm: [1.0, 2.0, 3.0],
        };
        let error = GeometryError { angle_deg: 0.5, position_mm: 2.0 };
        let stated: Vec<CArm> = (0..2000).map(|view| error.stated(&truth, Chance { seed: 3, view })).collect();
        let spread = |of: &dyn Fn(&CArm) -> f64| {
            let n = stated.len() as f64;
            let mean = stated.iter().map(of).sum::<f64>() / n;
            (mean, (stated.iter().map(|c| (of(c) - mean).powi(2)).sum::<f64>() / n).sqrt())
        };
        let near = |(mean, sd): (f64, f64), true_mean: f64, true_sd: f64| {
            assert!((mean - true_mean).abs() < 0.1 * true_sd && (sd / true_sd - 1.0).abs() < 0.05, "{mean} +- {sd}");
        };
        near(spread(&|c| c.primary_deg), -30.0, 0.5);
        near(spread(&|c| c.secondary_deg), 30.0, 0.5);
        for axis in 0..3 {
            near(spread(&move |c| c.table_mm[axis]), truth.table_mm[axis], 2.0);
        }
        let both = stated.iter().map(|c| (c.primary_deg + 30.0) * (c.table_mm[0] - 1.0)).sum::<f64>();
        assert!(both.abs() < 0.1 * 0.5 * 2.0 * 2000.0, "errors depend on each other: {both}");
    }
}
