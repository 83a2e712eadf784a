//! Doubt about vessels: how far a point of a centreline may be from the true one, and whether there is a vessel at all.
//!
//! A view shows where a vessel is across its image, but neither its depth nor its motion along itself. The least certain direction of a
//! point follows from the directions of its rays. The scale of the error comes from the images (distance of the centreline from the ridges)
//! and from the calibration (how far the stated views disagreed), because corrections remove a part of an error only. The constants were
//! fitted to phantoms with known vessels (`docs/performance.md`).

use crate::calibrate::observed::binned_to;
use crate::evidence::background::Background;
use crate::evidence::series::Series;
use crate::geometry::{MM_PER_UNIT, ViewRays, world_from_lps_mm};
use crate::raster::percentile;
use crate::scan::dataset::Dataset;
use crate::trees::areas::measure_radii;
use crate::trees::information::Information;
use crate::trees::refine::tangents;
use crate::trees::ridges::ridge_offset;
use crate::trees::sight::TreeInView;
use crate::trees::tree::{BeatTree, CONFIDENCE, Doubt, PhaseTree, TreeView};
use glam::{DVec2, DVec3};

/// Error of a view's image of a centreline, as a share of the distance to the ridges that [`CONFIDENCE`] of the points have: a point
/// is the mean of several views, phases and neighbours.
const OF_RIDGES: f64 = 0.45;
/// Minimum smaller side, pixels, of the binned images whose ridges are compared.
const RIDGE_SIDE: usize = 128;
/// Error where there are no images to compare with, pixels.
const WITHOUT_IMAGES_PX: f64 = 0.1;
/// Exponent of the stated views' disagreement in the error that calibration leaves.
const LEFT_EXPONENT: f64 = 0.5;
/// Error that calibration leaves of a disagreement of 1 mm with three views, mm.
const LEFT_OF_THREE_MM: f64 = 0.15;
/// Error of the motion along a vessel: its share of the displacement since the reference phase, and its maximum, mm.
const ALONG_SHARE: f64 = 0.5;
const ALONG_MAX_MM: f64 = 1.0;

/// Decrease of the probability that a point exists where no other fit has a vessel there; it is proportional to their share. Line through the
/// shares of true points that degraded data had at five shares of agreement (`docs/performance.md`, doubt).
const ABSENCE: f64 = 0.25;
/// Probability that a point of a single fit exists.
const EXISTENCE_SINGLE: f64 = 0.997;
/// Minimum number of training views for which doubt is stated: two views are explained as well by vessels that have exchanged their depths
/// where they cross, and no length bounds that error.
pub const LEAST_VIEWS: usize = 3;

/// States in a tree what depends on the training views of its dataset: the views themselves, the radii that their images show, and, with
/// the disagreement of the views as stated, px, the doubt about each point. Returns why radii remain those of the field, where they do.
pub fn compare_with_views(
    beat: &mut BeatTree,
    dataset: &Dataset,
    disagreement_px: Option<f64>,
) -> Option<&'static str> {
    beat.views = TreeView::of(dataset);
    let reason = measure_radii(beat, dataset).err();
    if let Some(disagreement_px) = disagreement_px {
        state_doubt(beat, dataset, disagreement_px);
    }
    reason
}

/// States the doubt about all points of a tree with [`LEAST_VIEWS`] training views or more. The dataset has the geometry that the reconstruction used, and
/// `disagreement_px` is the disagreement of its views as stated ([`crate::calibrate::correction::Calibration::disagreement_px`]). A phase
/// that the dataset does not have is compared with no image. Large images are binned: in small pixels, noise moves the ridges.
fn state_doubt(beat: &mut BeatTree, dataset: &Dataset, disagreement_px: f64) {
    let views = dataset.training_views();
    let [first, ..] = views[..] else { return };
    if views.len() < LEAST_VIEWS {
        return;
    }
    let pixel_mm = |dataset: &Dataset| dataset.views[first].rays.anchor[1].length() * MM_PER_UNIT;
    let left_mm = left_by_calibration_mm(views.len(), disagreement_px * pixel_mm(dataset));
    let dataset = &binned_to(dataset, RIDGE_SIDE);
    let backgrounds: Vec<Background> = Series::each(dataset).map(Background::new).collect();
    let shown: Vec<Vec<FrameView<'_>>> =
        beat.phases.iter().map(|tree| frame_views(tree, dataset, &backgrounds, beat.resolution_mm)).collect();
    let from_images_mm = pixel_mm(dataset) * image_error_px(&beat.phases, &shown);
    let scale = Scale { image_mm: from_images_mm.hypot(left_mm) };
    let reference = beat.phases.iter().find(|tree| Some(tree.phase) == beat.reference_phase).cloned();
    for (tree, shown) in beat.phases.iter_mut().zip(&shown) {
        for b in 0..tree.branches.len() {
            let rest = reference.as_ref().map(|reference| &reference.branches[b].points_mm);
            let doubt = |(i, tangent): (usize, DVec3)| {
                let moved_mm = rest.map(|rest| rest[i].distance(tree.branches[b].points_mm[i]));
                let agreement = tree.branches[b].agreement.get(i).copied();
                let rays = shown.iter().filter(|view| view.shows(b, i)).map(|view| view.sight.ray(b, i));
                scale.doubt(rays, tangent, moved_mm, agreement)
            };
            let doubts = tangents(&tree.branches[b].points_mm).into_iter().enumerate().map(doubt).collect();
            tree.branches[b].doubt = doubts;
        }
    }
}

/// A tree as the training image of a view shows it.
struct FrameView<'a> {
    sight: TreeInView,
    rays: ViewRays,
    dataset: &'a Dataset,
    view: usize,
    /// Places of the points in the image, `[branch][point]`; `None` behind the source.
    pixels: Vec<Vec<Option<DVec2>>>,
    background: Option<&'a Background>,
}

impl FrameView<'_> {
    /// Tells whether a point lies in a part of the image that is not hidden.
    fn shows(&self, branch: usize, point: usize) -> bool {
        let [width, height] = self.dataset.views[self.view].size;
        self.pixels[branch][point].is_some_and(|pixel| {
            let [x, y] = [pixel.x.round(), pixel.y.round()];
            let inside = x >= 0.0 && y >= 0.0 && x < width as f64 && y < height as f64;
            inside && self.dataset.shows(self.view, y as usize * self.dataset.width + x as usize)
        })
    }

    /// Returns the distance of a point from the ridge of the vessel in the image, pixels.
    fn ridge_px(&self, tree: &PhaseTree, branch: usize, point: usize, tangent: DVec3) -> Option<f32> {
        let background = self.background?;
        if self.sight.is_covered(branch, point) || !self.shows(branch, point) {
            return None;
        }
        let here = self.pixels[branch][point]?;
        let ahead = projected(&self.rays, tree.branches[branch].points_mm[point] + tangent)?;
        let across = (ahead - here).perp().try_normalize()?;
        let change = background.changes.get(tree.phase as usize)?.as_ref()?;
        ridge_offset(change, background.strongest, here, across).map(|offset| offset.abs() as f32)
    }
}

fn projected(rays: &ViewRays, point_mm: DVec3) -> Option<DVec2> {
    rays.project(world_from_lps_mm(point_mm)).map(|(column, row)| DVec2::new(column, row))
}

fn frame_views<'a>(
    tree: &PhaseTree,
    dataset: &'a Dataset,
    backgrounds: &'a [Background],
    resolution_mm: f64,
) -> Vec<FrameView<'a>> {
    let of_view = |view: usize| {
        let rays = dataset.heart_rays_at(view, tree.phase);
        let pixels = tree.branches.iter().map(|b| b.points_mm.iter().map(|p| projected(&rays, *p)).collect()).collect();
        FrameView {
            sight: TreeInView::new(tree, &rays, resolution_mm),
            rays,
            dataset,
            view,
            pixels,
            background: backgrounds.iter().find(|background| background.stilled.view == view),
        }
    };
    dataset.training_views().into_iter().map(of_view).collect()
}

/// Returns the error of the images of centrelines, pixels.
fn image_error_px(phases: &[PhaseTree], shown: &[Vec<FrameView<'_>>]) -> f64 {
    let mut distances = Vec::new();
    for (tree, views) in phases.iter().zip(shown) {
        for (b, branch) in tree.branches.iter().enumerate() {
            for (i, tangent) in tangents(&branch.points_mm).into_iter().enumerate() {
                distances.extend(views.iter().filter_map(|view| view.ridge_px(tree, b, i, tangent)));
            }
        }
    }
    match distances.is_empty() {
        true => WITHOUT_IMAGES_PX,
        false => OF_RIDGES * f64::from(percentile(&distances, CONFIDENCE)),
    }
}

/// Returns the error that calibration leaves of a disagreement of the stated views, mm. Each further view constrains the others.
fn left_by_calibration_mm(n_views: usize, disagreement_mm: f64) -> f64 {
    LEFT_OF_THREE_MM * (2.0 / (n_views as f64 - 1.0)).powi(2) * disagreement_mm.powf(LEFT_EXPONENT)
}

/// Scale of the errors of a reconstruction.
struct Scale {
    /// Error of the images of centrelines, mm at the isocentre.
    image_mm: f64,
}

impl Scale {
    /// Returns the doubt about a point, from the directions of the rays that show it, the direction of the vessel, the distance that the point
    /// has moved since the reference phase, and the share of the other fits that have a vessel there.
    fn doubt(
        &self,
        rays: impl Iterator<Item = DVec3>,
        tangent: DVec3,
        moved_mm: Option<f64>,
        agreement: Option<f64>,
    ) -> Doubt {
        let information = rays.fold(Information::none(tangent), |sum, ray| sum.with(ray));
        let (direction, dilution) = information.least_certain();
        // Where few of the other fits have a vessel, errors were seen to be up to twice as large.
        let absence = 1.0 - agreement.unwrap_or(1.0);
        let across_mm = self.image_mm * dilution * (1.0 + absence);
        let existence = EXISTENCE_SINGLE - ABSENCE * absence;
        let with_motion_mm = moved_mm.map(|moved_mm| across_mm.max((ALONG_SHARE * moved_mm).min(ALONG_MAX_MM)));
        Doubt { across_mm, direction, with_motion_mm, existence }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn along(degrees: f64) -> DVec3 {
        DVec3::new(degrees.to_radians().cos(), degrees.to_radians().sin(), 0.0)
    }

    #[test]
    fn errors_of_images_and_calibration_add_up() {
        let doubt = |image_mm: f64, moved_mm: Option<f64>, agreement: Option<f64>| {
            let rays = [along(0.0), along(90.0)].into_iter();
            Scale { image_mm }.doubt(rays, DVec3::Z, moved_mm, agreement)
        };
        assert!((doubt(0.2, None, None).across_mm - 0.2).abs() < 1e-9);
        assert!((doubt(0.2, None, Some(0.5)).across_mm - 0.3).abs() < 1e-9);
        let across = doubt(0.2, Some(0.2), None);
        assert_eq!(across.with_motion_mm, Some(across.across_mm), "an error across the vessel is larger");
        assert_eq!(doubt(0.2, Some(1.0), None).with_motion_mm, Some(0.5));
        assert_eq!(doubt(0.2, Some(20.0), None).with_motion_mm, Some(ALONG_MAX_MM));
        let existence = [Some(0.0), Some(0.5), None].map(|share| doubt(0.2, None, share).existence);
        assert!(existence.windows(2).all(|pair| pair[0] < pair[1]), "{existence:?}");
        // More views leave less of an error, and no disagreement leaves none.
        let left = [3, 4, 9].map(|n| left_by_calibration_mm(n, 2.0));
        assert!(left.windows(2).all(|pair| pair[1] < 0.6 * pair[0]), "{left:?}");
        assert_eq!(left_by_calibration_mm(3, 0.0), 0.0);
    }
}
