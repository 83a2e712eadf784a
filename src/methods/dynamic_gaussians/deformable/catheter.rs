//! Catheter in a deformable set: its tip moves with the ostium, and the motion ends along it, as that of no vessel does. Catheters are found
//! by their motion, because other thin structures that rest, such as edges of bones, look the same in the images; a part that is thinner than
//! the vessels is none.

use crate::gaussians::field::{MovingGaussians, mass};
use crate::geometry::MM_PER_UNIT;
use crate::methods::dynamic_gaussians::deformable::linked::{extent, groups, grown};
use crate::methods::dynamic_gaussians::remainder::level;
use crate::methods::dynamic_gaussians::targets::Targets;
use crate::raster::{Image, opening};
use glam::DVec3;
use std::collections::BinaryHeap;

// Numbers of this file without another source: chosen on one anatomy (docs/methods/gaussians.md, Schedule).
/// Motion, as a share of that of the median Gaussian, below which a Gaussian is slow.
const SLOW: f64 = 0.4;
/// Motion of the slowest Gaussian of a catheter, in the same unit. The vessels of 40 data sets with the motion of a healthy heart have no
/// slower Gaussian than 0.35, and those of six with a catheter have 0.23 to 0.28.
const SLOWEST: f64 = 0.31;
/// Motion up to which neighbours of the slow part belong to a catheter, in the same unit. Vessels begin at the ostium with 0.58 to 0.79.
const UP_TO: f64 = 0.6;
/// Minimum number of slow Gaussians of a catheter.
const MIN_COUNT: usize = 8;
/// Minimum extent of the slow part of a catheter, pixels of the settings.
const MIN_EXTENT: f64 = 14.0;
/// Minimum mass of the median Gaussian of a catheter, in units of the median of all. Four data sets with a catheter have 1.6 to 2.6; a septal
/// branch, which is thin and moves little, has 0.7.
const LEAST_MASS: f64 = 1.0;
/// Maximum share of a catheter in all Gaussians: where more is slow, it is the heart that hardly moves.
const MAX_SHARE: f64 = 0.4;
/// Distance within which slow Gaussians belong to one part, pixels of the settings.
const LINK: f64 = 6.0;
/// Distance within which other Gaussians are neighbours of a catheter, pixels of the settings.
const NEXT: f64 = 4.0;

/// Width up to which a structure is taken for a catheter, mm: twice that of the widest one for coronary arteries, 8 French.
const MAX_WIDTH_MM: f64 = 5.4;
/// Contrast that a catheter has at least on its way to the border, as a share of its contrast at the end that rests: three data sets with a
/// catheter have .52 to 1 in their eleven views. Without a catheter, the slowest Gaussians of three data sets have less, but for one view.
const CONTRAST_ON_THE_WAY: f32 = 0.5;

/// Catheter in a deformable set.
#[derive(Debug, Clone, PartialEq)]
pub struct Catheter {
    /// Whether each Gaussian belongs to the catheter.
    pub members: Vec<bool>,
    /// Extent of the part that was found, mm.
    pub extent_mm: f64,
    /// Motion of its slowest Gaussian, as a share of the motion of the median Gaussian.
    pub slowest: f64,
    /// Index of its slowest Gaussian, where what can be seen of its motion ends.
    pub slowest_member: usize,
}

impl Catheter {
    /// Finds the catheter of a deformable set with `factor` pixels of the images per pixel of the settings; none without one.
    pub fn find(set: &MovingGaussians, factor: f64) -> Option<Catheter> {
        let points = Points::new(set);
        let slow: Vec<usize> = (0..points.places.len()).filter(|i| points.motion[*i] < SLOW).collect();
        let is_catheter = |part: &Vec<usize>| {
            let slowest = part.iter().map(|i| points.motion[*i]).fold(f64::INFINITY, f64::min);
            let is_thick = || median(part.iter().map(|i| points.mass[*i])) >= LEAST_MASS;
            part.len() >= MIN_COUNT && slowest < SLOWEST && points.extent(part) >= MIN_EXTENT * factor && is_thick()
        };
        let parts = groups(slow, points.near(LINK * factor));
        let part = parts.into_iter().filter(is_catheter).max_by_key(Vec::len)?;
        let slowest_member = part.iter().copied().min_by(|a, b| points.motion[*a].total_cmp(&points.motion[*b]))?;
        let slowest = points.motion[slowest_member];
        let part = points.with_neighbours(part, NEXT * factor);
        if part.len() as f64 > MAX_SHARE * points.places.len() as f64 {
            return None;
        }
        let mut members = vec![false; points.places.len()];
        part.iter().for_each(|i| members[*i] = true);
        let extent_mm = points.extent(&part) * set.rest.units.pixel * MM_PER_UNIT;
        Some(Catheter { members, extent_mm, slowest, slowest_member })
    }

    /// Returns a sentence on a catheter that `n_entered` views show up to the border of their images.
    pub fn sentence(&self, n_entered: usize, is_left_out: bool) -> String {
        let seen = format!(
            "a catheter seems to be in the dynamic field: {:.0} mm whose motion falls to {:.0} % of that of the vessels; \
             views that show it up to the border of their images: {n_entered}",
            self.extent_mm,
            100.0 * self.slowest
        );
        match is_left_out {
            true => format!("{seen}; it is left out: --set gaussians.catheter=keep keeps it"),
            false => format!("{seen}; --set gaussians.catheter=leave-out leaves it out of field, tree and scores"),
        }
    }
}

/// Counts the views whose median image shows that a catheter goes on from its `slowest` Gaussian to the border of the image or
/// of what is hidden: a thin dark line, as no vessel leaves the image at the end that rests.
pub(super) fn views_entered(targets: &Targets, field: &MovingGaussians, slowest: usize) -> usize {
    let at = field.position(slowest, targets.rest_phase as f64);
    let enters = |view: usize| {
        let images: Vec<usize> =
            targets.image_of.iter().skip(view).step_by(targets.n_views).flatten().copied().collect();
        let Some(first) = images.first() else { return false };
        let image = |image: &usize| Image {
            width: targets.width,
            height: targets.height,
            values: targets.images[image * targets.n_pixels()..(image + 1) * targets.n_pixels()].to_vec(),
        };
        let values = level(&images.iter().map(image).collect::<Vec<_>>());
        let median = Image { width: targets.width, height: targets.height, values };
        let (_, column, row) = targets.views[*first].project(at);
        let radius = (MAX_WIDTH_MM / (2.0 * targets.units.pixel * MM_PER_UNIT)).ceil() as usize;
        let contrast = contrast_of_the_way(&median, targets.weight.image(*first), [column, row], radius);
        contrast.is_some_and(|[end, way]| way >= CONTRAST_ON_THE_WAY * end)
    };
    (0..targets.n_views).filter(|view| enters(*view)).count()
}

/// Follows structures up to `2 radius` wide from a place (column, row) to the border of an image or of pixels of `weight` 0.
/// Returns their contrast at the place and the lowest one on the way, which is the way whose lowest contrast is the highest;
/// none where the place lies outside of the image.
fn contrast_of_the_way(image: &Image, weight: &[f32], [column, row]: [f64; 2], radius: usize) -> Option<[f32; 2]> {
    let (width, height) = (image.width, image.height);
    let wide = opening(image, radius);
    let contrast: Vec<f32> = image.values.iter().zip(&wide.values).map(|(value, wide)| value - wide).collect();
    let is_inside = |x: f64, n: usize| x >= 0.0 && x < n as f64;
    if !is_inside(column, width) || !is_inside(row, height) {
        return None;
    }
    let near = |x: f64, n: usize| (x as usize).saturating_sub(radius)..=(x as usize + radius).min(n - 1);
    let around = near(row, height).flat_map(|y| near(column, width).map(move |x| y * width + x));
    let start = around.max_by(|a, b| contrast[*a].total_cmp(&contrast[*b]))?;
    let mut seen = vec![false; contrast.len()];
    let mut open = BinaryHeap::from([(Contrast(contrast[start]), start)]);
    let mut lowest = contrast[start];
    while let Some((Contrast(here), pixel)) = open.pop() {
        if std::mem::replace(&mut seen[pixel], true) {
            continue;
        }
        lowest = lowest.min(here);
        let (x, y) = (pixel % width, pixel / width);
        if weight[pixel] == 0.0 || x == 0 || y == 0 || x + 1 == width || y + 1 == height {
            return Some([contrast[start], lowest]);
        }
        for next in [pixel - 1, pixel + 1, pixel - width, pixel + width] {
            open.push((Contrast(contrast[next]), next));
        }
    }
    None
}

/// Contrast by which pixels are put in order.
#[derive(Clone, Copy, PartialEq)]
struct Contrast(f32);

impl Eq for Contrast {}

impl Ord for Contrast {
    fn cmp(&self, other: &Contrast) -> std::cmp::Ordering {
        self.0.total_cmp(&other.0)
    }
}

impl PartialOrd for Contrast {
    fn partial_cmp(&self, other: &Contrast) -> Option<std::cmp::Ordering> {
        Some(self.cmp(other))
    }
}

/// Gaussians as points that move.
struct Points {
    /// Positions at rest, pixels.
    places: Vec<DVec3>,
    /// Root mean square distances from the mean position over the beat, in units of the median.
    motion: Vec<f64>,
    /// Masses, in units of the median.
    mass: Vec<f64>,
}

/// Median of values, the upper one of two; 0 without values.
fn median(values: impl Iterator<Item = f64>) -> f64 {
    let mut sorted: Vec<f64> = values.collect();
    sorted.sort_unstable_by(f64::total_cmp);
    sorted.get(sorted.len() / 2).copied().unwrap_or(0.0)
}

/// Divides values by their median.
fn by_median(values: Vec<f64>) -> Vec<f64> {
    let median = median(values.iter().copied()).max(f64::MIN_POSITIVE);
    values.into_iter().map(|value| value / median).collect()
}

impl Points {
    fn new(set: &MovingGaussians) -> Points {
        let phases = set.rest.n_phases;
        let of = |i: usize| {
            let places: Vec<DVec3> = (0..phases).map(|phase| set.position(i, phase as f64)).collect();
            let mean = places.iter().sum::<DVec3>() / phases as f64;
            (places.iter().map(|place| place.distance_squared(mean)).sum::<f64>() / phases as f64).sqrt()
        };
        let motion = by_median((0..set.rest.rows.len()).map(of).collect());
        let mass = by_median(set.rest.rows.iter().map(|g| mass(g, &set.rest.setup)).collect());
        let places = set.rest.rows.iter().map(|g| DVec3::from_array(g.position.map(f64::from))).collect();
        Points { places, motion, mass }
    }

    fn extent(&self, part: &[usize]) -> f64 {
        extent(part.iter().map(|i| self.places[*i]))
    }

    /// Tells whether two points are less than `link` apart.
    fn near(&self, link: f64) -> impl Fn(usize, usize) -> bool {
        move |a, b| self.places[a].distance(self.places[b]) < link
    }

    /// Adds the neighbours of a part that move up to [`UP_TO`], and theirs.
    fn with_neighbours(&self, part: Vec<usize>, next: f64) -> Vec<usize> {
        let mut left: Vec<usize> =
            (0..self.places.len()).filter(|i| self.motion[*i] < UP_TO && !part.contains(i)).collect();
        grown(part, &mut left, self.near(next))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gaussians::field::{Gaussians, Units};
    use crate::kernels::layout::{Gaussian, GaussianSetup, MotionGridSetup};

    const PHASES: usize = 8;
    /// Number of Gaussians of the vessel, one per pixel along x.
    const VESSEL: usize = 80;

    /// A vessel along x, which moves along y by `motion` of its position, in front of a `line` of Gaussians with their motions.
    fn set(motion: impl Fn(f64) -> f64, line: &[(DVec3, f64)]) -> MovingGaussians {
        let vessel = (0..VESSEL).map(|i| (DVec3::X * i as f64, motion(i as f64 / VESSEL as f64)));
        let all: Vec<(DVec3, f64)> = vessel.chain(line.iter().copied()).collect();
        let row = |(place, _): &(DVec3, f64)| Gaussian { position: place.as_vec3().to_array(), ..Gaussian::default() };
        let rest = Gaussians {
            units: Units { pixel: 0.01, strongest: 1.0 },
            n_phases: PHASES,
            setup: GaussianSetup { min_scale: 0.1, max_scale: 9.0, ..GaussianSetup::default() },
            rows: all.iter().map(row).collect(),
            step: 1,
            is_crowd: false,
            agreement: None,
            intensities: None,
        };
        let setup = MotionGridSetup {
            n_nodes: 2,
            half_side: 100.0,
            inverse_step: 0.005,
            n_basis: 2,
            ..MotionGridSetup::default()
        };
        // Own motion with one harmonic: its cosine and its sine.
        let own = all.iter().flat_map(|(_, motion)| [[0.0; 4], [0.0, *motion as f32, 0.0, 0.0]]).collect();
        MovingGaussians { filling: None, grid: vec![[0.0; 4]; PHASES * setup.nodes()], rest, setup, own }
    }

    /// A line from the ostium, the first Gaussian of the vessel, whose motion ends along it.
    fn line(motion: impl Fn(f64) -> f64) -> Vec<(DVec3, f64)> {
        (1..=25).map(|i| (DVec3::new(0.0, 0.0, 1.2 * f64::from(i)), motion(f64::from(i) / 25.0))).collect()
    }

    #[test]
    fn a_line_whose_motion_ends_is_a_catheter() {
        let vessel = |along: f64| 2.0 + 2.0 * along;
        let found = Catheter::find(&set(vessel, &line(|along| 2.0 * (1.0 - along).powi(3))), 1.0).unwrap();
        assert!(!found.members[..VESSEL].contains(&true), "no part of the vessel");
        let taken = found.members[VESSEL..].iter().filter(|member| **member).count();
        assert!(taken >= 23, "{taken} of 25");
        assert!((25.0..31.0).contains(&found.extent_mm) && found.slowest < 0.05, "{found:?}");
        assert_eq!(
            Catheter::find(&set(vessel, &line(|along| 2.0 * (1.0 - along).powi(3))), 4.0),
            None,
            "a short line in large images"
        );
    }

    #[test]
    fn a_thin_branch_that_hardly_moves_is_no_catheter() {
        let mut field = set(|along| 2.0 + 2.0 * along, &line(|along| 2.0 * (1.0 - along).powi(3)));
        field.rest.rows[VESSEL..].iter_mut().for_each(|g| g.log_density = 0.7f32.ln());
        assert_eq!(Catheter::find(&field, 1.0), None);
    }

    /// An image with a line along x, of contrast 1, from the middle to column `end`, on a background that changes slowly.
    fn image_of_a_line(end: usize, gap: Option<usize>) -> Image {
        let (width, height) = (40, 30);
        let is_line = |x: usize, y: usize| (20..=end).contains(&x) && (14..=15).contains(&y) && Some(x) != gap;
        let value = |p: usize| 0.02 * (p % width) as f32 + f32::from(u8::from(is_line(p % width, p / width)));
        Image { width, height, values: (0..width * height).map(value).collect() }
    }

    #[test]
    fn a_line_is_followed_to_the_border_or_to_a_blade() {
        let share = |image: &Image, weight: &[f32]| {
            let [end, way] = contrast_of_the_way(image, weight, [21.0, 14.5], 3).unwrap();
            way / end
        };
        let [seen, mut blade] = [(); 2].map(|()| vec![1.0; 40 * 30]);
        assert!(share(&image_of_a_line(39, None), &seen) > 0.9);
        assert!(share(&image_of_a_line(34, None), &seen) < 0.2, "a line that ends within the image");
        assert!(share(&image_of_a_line(39, Some(30)), &seen) < 0.2, "a line with a gap");
        (0..30).for_each(|y| blade[y * 40 + 33] = 0.0);
        assert!(share(&image_of_a_line(34, None), &blade) > 0.9);
        assert_eq!(contrast_of_the_way(&image_of_a_line(39, None), &seen, [41.0, 3.0], 3), None);
    }

    #[test]
    fn vessels_are_no_catheters() {
        let none = |motion: &dyn Fn(f64) -> f64, line: &[(DVec3, f64)]| {
            assert_eq!(Catheter::find(&set(motion, line), 1.0), None)
        };
        none(&|along| 2.0 + 2.0 * along, &[]);
        // A side branch that moves by half, and a short one that rests.
        none(&|along| 2.0 + 2.0 * along, &line(|along| 2.0 - 0.5 * along));
        none(&|along| 2.0 + 2.0 * along, &line(|along| 2.0 - 0.5 * along)[..6]);
        none(&|_| 0.0, &line(|_| 0.0));
        // Half of the heart hardly moves.
        none(&|along| if along < 0.45 { 0.3 } else { 4.0 }, &[]);
    }
}
