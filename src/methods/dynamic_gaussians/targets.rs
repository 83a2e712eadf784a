//! Targets of Gaussians: views, bounds of the dynamic field's images, weights, and where vessels may be.

pub mod coarse;
pub mod lengths;
pub mod shared_images;
pub(in crate::methods::dynamic_gaussians) mod stiffness;
#[cfg(test)]
pub(in crate::methods::dynamic_gaussians) mod test_targets;

use crate::config::GaussianForm;
use crate::config::sections::{LeftOut, Rule};
use crate::error::{Error, Result};
use crate::evidence::ratios::ViewEvidence;
use crate::evidence::series::Series;
use crate::gaussians::field::Units;
use crate::gaussians::view::SplatView;
use crate::methods::dynamic_gaussians::rules::{GaussianRules, NOISE_SCALE};
use crate::methods::dynamic_gaussians::soft_hull::carve::{HullCell, SoftMotion};
use crate::methods::dynamic_gaussians::targets::lengths::{Lengths, vessel_width};
use crate::methods::dynamic_gaussians::targets::shared_images::SharedImages;
use crate::raster::Image;
use crate::scan::dataset::Dataset;
use glam::DVec3;

/// Share of the vessels of the best phase that the first phase must show to be the rest phase.
const MUCH: f64 = 0.75;
/// Share of its views' maximum below which a phase lacks contrast: the beat and noise alone have been seen to take a third.
const LITTLE: f64 = 0.5;
/// Minimum number of views that tell where along a ray a vessel is.
const MIN_VIEWS: usize = 2;
/// Standard deviations of the noise from which on a line integral stands out.
const STANDS_OUT: f32 = 4.0;

/// A place where a vessel may be.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PossibleVessel {
    /// Centre of a hull cell, pixels at the isocentre.
    pub position: DVec3,
    /// Evidence of all views for it: a log-likelihood ratio.
    pub evidence: f64,
    /// Distance from the vessels of a prior: 0 near them or without a prior, 1 far from them.
    pub far_from_prior: f64,
}

/// Data in the Gaussians' units.
#[derive(Debug, Clone)]
pub struct Targets {
    /// Units of the Gaussians.
    pub units: Units,
    /// Columns of an image.
    pub width: usize,
    /// Rows of an image.
    pub height: usize,
    /// Cardiac phases.
    pub n_phases: usize,
    /// Training views with at least two phases.
    pub n_views: usize,
    /// View of each image, moved against the heart's displacement in that frame.
    pub views: Vec<SplatView>,
    /// `[phase][view]`: index of the image, where there is one.
    pub image_of: Vec<Option<usize>>,
    /// Number of images.
    pub n_images: usize,
    /// `[image][pixel]`: line integrals of the images, shares of the strongest change.
    pub images: Vec<f32>,
    /// `[image][pixel]`: maximum line integral of the dynamic field that is known before the fit, where [`Targets::high`] has been
    /// replaced by lower ones; none where it is equal to [`Targets::high`].
    pub max: Option<Vec<f32>>,
    /// `[image][pixel]`: minimum line integral of the dynamic field that explains the pixel.
    pub low: Vec<f32>,
    /// `[image][pixel]`: maximum line integral of the dynamic field that explains the pixel.
    pub high: Vec<f32>,
    /// `[image][pixel]`: factor on the residual, from the pixel's noise; equal for all images of a view.
    pub weight: SharedImages,
    /// `[image][pixel]`: standard deviation of the noise, share of the strongest change; equal for all images of a view.
    pub noise: SharedImages,
    /// `[image]`: contrast of the vessels, by which the field's line integrals are multiplied where it is compared with the image.
    pub contrast: Vec<f32>,
    /// Lengths of the settings on these images.
    pub lengths: Lengths,
    /// Phase at which the Gaussians of a deformable set rest.
    pub rest_phase: usize,
    /// True where some phase shows so much less than others that contrast must have come or gone meanwhile.
    pub contrast_comes_and_goes: bool,
    /// Whether the geometry of the views was adjusted with the vessels in the loop.
    pub views_adjusted: bool,
    /// Rules that are left out.
    pub left_out: LeftOut,
    /// Cells of the hull, per phase.
    pub places: Vec<Vec<PossibleVessel>>,
    /// Side of a cell, pixels at the isocentre.
    pub cell: f64,
}

/// Refuses a line integral that is not a number, naming its image.
fn check_finite(dataset: &Dataset, series: &Series) -> Result<()> {
    for (phase, image) in series.images.iter().enumerate() {
        let Some((width, pixel)) =
            image.as_ref().and_then(|i| Some((i.width, i.values.iter().position(|v| !v.is_finite())?)))
        else {
            continue;
        };
        let (column, row) = (pixel % width, pixel / width);
        let at = format!("{}, view {}, phase {phase}", dataset.path.display(), series.view);
        let problem =
            format!("the line integral at column {column}, row {row} is not finite: remove or correct the image");
        return Err(Error::config("dataset", at, problem));
    }
    Ok(())
}

fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    let n = values.len();
    0.5 * (values[(n - 1) / 2] + values[n / 2])
}

impl Targets {
    /// Brings a dataset and its motion into the Gaussians' units.
    ///
    /// # Errors
    /// [`Error::Unmet`] when nothing moves, or too little is known to tell; [`Error::Config`] when a pixel is not a number.
    pub fn new(dataset: &Dataset, motion: &SoftMotion, settings: &GaussianRules) -> Result<Targets> {
        if motion.views.is_empty() {
            let problem = "no training view has two phases, e.g. because the C-arm or the table moves from image to \
                           image, so the static background behind the vessels is not known. Try the preset paper, \
                           which trains on whole images, or the preset fast-mlp with loss.dynamic_target = absolute, \
                           which also suits static objects";
            return Err(Error::unmet("dataset", dataset.path.display(), problem));
        }
        if motion.views.len() == 1 {
            let problem = "only one training view has two phases; two such views are needed to locate a vessel along a \
                           ray";
            return Err(Error::unmet("dataset", dataset.path.display(), problem));
        }
        Series::each(dataset).try_for_each(|s| check_finite(dataset, &s))?;
        let strongest = median(motion.views.iter().map(|v| f64::from(v.background.strongest)).collect());
        if strongest.is_nan() || strongest <= 0.0 || motion.hull.share() == 0.0 {
            return Err(Error::unmet("dataset", dataset.path.display(), no_common_motion(motion)));
        }
        let pixel = |v: usize| {
            let rays = &dataset.views[v].rays;
            0.5 * (rays.direction[1].length() + rays.direction[2].length()) * rays.sod
        };
        let units = Units { pixel: median(motion.views.iter().map(|v| pixel(v.view)).collect()), strongest };
        let n_phases = dataset.n_phases as usize;
        let mut targets = Targets {
            units,
            width: dataset.width,
            height: dataset.height,
            n_phases,
            n_views: motion.views.len(),
            views: Vec::new(),
            image_of: vec![None; n_phases * motion.views.len()],
            n_images: 0,
            images: Vec::new(),
            max: None,
            low: Vec::new(),
            high: Vec::new(),
            weight: SharedImages::of_each(Vec::new(), dataset.n_pixels()),
            noise: SharedImages::of_each(Vec::new(), dataset.n_pixels()),
            contrast: Vec::new(),
            lengths: Lengths { factor: 1.0, smoothing: 1.0 },
            rest_phase: 0,
            contrast_comes_and_goes: false,
            views_adjusted: dataset.views_adjusted,
            left_out: settings.left_out.clone(),
            places: Vec::new(),
            cell: motion.hull.cell / units.pixel,
        };
        let share = |change: f32| (f64::from(change) / strongest) as f32;
        let n_images: usize = motion.views.iter().map(|v| v.background.changes.iter().flatten().count()).sum();
        // Vectors that grow would take up to three times the room.
        for values in [&mut targets.images, &mut targets.low, &mut targets.high] {
            values.reserve_exact(n_images * dataset.n_pixels());
        }
        let mut slots = Vec::new();
        // Images of a phase follow each other.
        for phase in 0..n_phases {
            for (slot, view) in motion.views.iter().enumerate() {
                let seen = (&view.background.stilled.images[phase], &view.background.changes[phase]);
                let (Some(image), Some(change)) = seen else {
                    continue;
                };
                let above = image.values.iter().zip(&view.background.low.values).map(|(y, b)| y - b);
                let contrast = dataset.contrast_at(view.view, phase as u32);
                let of_field = |change: f32| (f64::from(change) / (contrast * strongest)) as f32;
                targets.contrast.push(contrast as f32);
                targets.image_of[phase * motion.views.len() + slot] = Some(targets.n_images);
                targets.n_images += 1;
                let seen_by = SplatView::new(&dataset.heart_rays_at(view.view, phase as u32), units);
                let after_phase = dataset.after_phase(view.view, phase as u32);
                targets.views.push(SplatView { after_phase, ..seen_by });
                targets.images.extend(image.values.iter().map(|y| share(*y)));
                targets.low.extend(change.values.iter().map(|d| of_field(*d)));
                targets.high.extend(above.map(of_field));
                slots.push(slot);
            }
        }
        let weights = motion.views.iter().flat_map(|v| weights(dataset, v, strongest, NOISE_SCALE));
        targets.weight = SharedImages::new(weights.collect(), slots.clone(), dataset.n_pixels());
        let noise = motion.views.iter().flat_map(|v| v.background.noise.values.iter().map(|s| share(*s)));
        targets.noise = SharedImages::new(noise.collect(), slots, dataset.n_pixels());
        targets.rest_phase = targets.phase_that_shows_most();
        targets.contrast_comes_and_goes = targets.left_out.keeps(Rule::Fillings) && targets.some_phase_lacks_contrast();
        let own = |view: usize, change: &Image| {
            let [width, height] = dataset.views[view].size;
            Image { width, height, values: dataset.own(view, &change.values).into_owned() }
        };
        let changes = motion.views.iter().flat_map(|v| v.background.changes.iter().flatten().map(|c| own(v.view, c)));
        let width = vessel_width(changes, strongest as f32);
        let mut sides: Vec<usize> =
            motion.views.iter().map(|v| dataset.views[v.view].size).map(|s| s[0].min(s[1])).collect();
        sides.sort_unstable();
        targets.lengths = Lengths::new(sides[sides.len() / 2], width, targets.noise.median(), settings.min_scale);
        let place = |c: &HullCell| PossibleVessel {
            position: motion.hull.centre(c.index) / units.pixel,
            evidence: f64::from(c.evidence),
            far_from_prior: 0.0,
        };
        targets.places = motion.hull.cells.iter().map(|cells| cells.iter().map(place).collect()).collect();
        Ok(targets)
    }

    /// Returns the form of the dynamic field that suits the data where `asked` leaves it open. A deformable set shares one set of
    /// Gaussians over the beat; it needs enough phases to be followed from one to the next, and a rest phase that two views show.
    pub fn form(&self, asked: GaussianForm) -> GaussianForm {
        const MIN_PHASES: usize = 4;
        let rests = self.views_at(self.rest_phase).count() >= MIN_VIEWS;
        match asked {
            GaussianForm::Auto if self.n_phases >= MIN_PHASES && rests => GaussianForm::Deformable,
            GaussianForm::Auto => GaussianForm::Phase,
            asked => asked,
        }
    }

    /// Phase whose images show most of the vessels, among the phases that two views show; the first one unless it lacks much of
    /// that, for example before contrast has arrived.
    fn phase_that_shows_most(&self) -> usize {
        let seen: Vec<usize> = (0..self.n_phases).filter(|phase| self.views_at(*phase).count() >= MIN_VIEWS).collect();
        let max = seen.iter().copied().max_by(|a, b| self.shown_at(*a).total_cmp(&self.shown_at(*b))).unwrap_or(0);
        let first_shows_much = seen.contains(&0) && self.shown_at(0) >= MUCH * self.shown_at(max);
        if first_shows_much { 0 } else { max }
    }

    /// Tells whether some phase shows so much less than others that contrast must have come or gone meanwhile. Each view is
    /// compared with itself: not every view has every phase, and some see more of the vessels than others.
    fn some_phase_lacks_contrast(&self) -> bool {
        let shown = |phase: usize, view: usize| Some(self.shown_in(self.image_of[phase * self.n_views + view]?));
        let max_in = |view: usize| (0..self.n_phases).filter_map(|phase| shown(phase, view)).fold(0.0, f64::max);
        let max: Vec<f64> = (0..self.n_views).map(max_in).collect();
        let lacks = |phase: usize| {
            let views = (0..self.n_views).filter(|view| max[*view] > 0.0);
            let shares: Vec<f64> = views.filter_map(|view| Some(shown(phase, view)? / max[view])).collect();
            shares.len() >= MIN_VIEWS && shares.iter().sum::<f64>() < LITTLE * shares.len() as f64
        };
        (0..self.n_phases).any(lacks)
    }

    /// Sum of the line integrals that stand out, over all images of a phase.
    fn shown_at(&self, phase: usize) -> f64 {
        self.views_at(phase).map(|(image, _)| self.shown_in(image)).sum()
    }

    /// Sum over an image of the line integrals that stand out from noise, shares of the strongest change.
    fn shown_in(&self, image: usize) -> f64 {
        self.pixels_that_stand_out(image).map(|p| f64::from(self.low[p])).sum()
    }

    /// Pixels of an image whose change stands out from noise, as indices over all images.
    pub fn pixels_that_stand_out(&self, image: usize) -> impl Iterator<Item = usize> {
        let pixels = image * self.n_pixels()..(image + 1) * self.n_pixels();
        pixels.filter(|p| self.weight[*p] > 0.0 && self.low[*p] > STANDS_OUT * self.noise[*p])
    }

    /// Number of phases that some view has.
    pub fn phases_seen(&self) -> usize {
        self.image_of.chunks(self.n_views).filter(|row| row.iter().any(Option::is_some)).count()
    }

    /// Number of phases of the view that has the fewest.
    pub fn fewest_phases(&self) -> usize {
        let phases = |view: usize| self.image_of.iter().skip(view).step_by(self.n_views).flatten().count();
        (0..self.n_views).map(phases).min().unwrap_or(0)
    }

    /// Pixels of an image.
    pub fn n_pixels(&self) -> usize {
        self.width * self.height
    }

    /// Images of a phase, and their views.
    pub fn views_at(&self, phase: usize) -> impl Iterator<Item = (usize, &SplatView)> {
        let row = &self.image_of[phase * self.n_views..][..self.n_views];
        row.iter().flatten().map(|image| (*image, &self.views[*image]))
    }
}

/// Says why no vessel was found, and names the views that show nothing.
fn no_common_motion(motion: &SoftMotion) -> String {
    let shows = |v: &&ViewEvidence| v.background.strongest > 0.0;
    let blank: Vec<usize> = motion.views.iter().filter(|v| !shows(v)).map(|v| v.view).collect();
    if blank.is_empty() {
        return "no motion is consistent between several views: check geometry, phases and noise".into();
    }
    format!(
        "no vessel was found that several views show, because nothing changes over the beat in views {blank:?}: all training \
         images of such a view are alike. Correct its images, or leave the view out"
    )
}

/// Weights of residuals: lower where pixels are noisy, so that the loss bends later there, and 0 where pixels are hidden.
fn weights(dataset: &Dataset, view: &ViewEvidence, strongest: f64, scale: f64) -> Vec<f32> {
    let weight = |(pixel, noise): (usize, &f32)| match dataset.shows(view.view, pixel) {
        true => weight_of_noise(f64::from(*noise) / strongest, scale),
        false => 0.0,
    };
    view.background.noise.values.iter().enumerate().map(weight).collect()
}

/// Weight of a pixel with a standard deviation of noise, a share of the strongest change; `scale` is that at which weights fall, 0 for
/// equal weights.
pub(super) fn weight_of_noise(noise: f64, scale: f64) -> f32 {
    if scale > 0.0 { (1.0 / (1.0 + (noise / scale).powi(2)).sqrt()) as f32 } else { 1.0 }
}
