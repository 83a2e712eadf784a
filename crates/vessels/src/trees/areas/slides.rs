//! Errors of the places of a tree's points along their vessels.
//!
//! A point that is followed over the beat is to stay at one place of its vessel, but nothing tells where along a smooth vessel it is. Where the
//! vessel is narrowed, images do tell: the narrowing appears at other points of the tree at some phases. Where this is ignored, each phase
//! shows it at another place, and the areas that suit all phases are those of a wider, longer narrowing.

use crate::linear::conjugate_gradients;
use crate::trees::areas::shadowed::ShadowedView;
use crate::trees::tree::PhaseTree;

// Numbers of this file without another source: developed on five draws of stenoses in five trees; a sixth draw took no part
// (docs/performance.md, Stenoses; docs/tried.md).
/// Expected standard deviation of a slide, mm: points of followed trees are off by 0.7 to 1.2 mm on phantoms at the scale of a heart.
const SLIDE_MM: f64 = 1.0;
/// Expected standard deviation of the difference between the slides of successive points, as a share of their distance.
const CHANGE: f64 = 0.1;
/// Largest slide, mm.
const MAX_SLIDE_MM: f64 = 3.0;
/// Minimum distance of successive points, mm: points may coincide.
const MIN_STEP_MM: f64 = 0.1;

/// Slides of all points of a tree: where along its vessel a point really is at a phase.
pub(super) struct Slides {
    /// Slides toward the end of the branch, in points, `[phase][point]`.
    of_phase: Vec<Vec<f64>>,
    /// Branch of each point.
    branches: Vec<BranchPoints>,
}

/// Points of a branch among all points of the tree.
#[derive(Clone, Copy)]
struct BranchPoints {
    first: usize,
    last: usize,
    /// Mean distance of successive points, mm.
    step_mm: f64,
}

/// A place between two successive points of a branch, or at one of them.
#[derive(Clone, Copy)]
struct Place {
    before: usize,
    behind: usize,
    /// Distance from the point before, as a share of that between both.
    share: f64,
}

impl Slides {
    /// Returns slides of zero for a tree that is followed over phases.
    pub fn none(phases: &[PhaseTree]) -> Slides {
        let mut branches = Vec::new();
        for branch in phases.first().into_iter().flat_map(|tree| &tree.branches) {
            let (first, n) = (branches.len(), branch.points_mm.len());
            let length_mm: f64 = branch.points_mm.windows(2).map(|pair| pair[0].distance(pair[1])).sum();
            let step_mm = (length_mm / n.saturating_sub(1).max(1) as f64).max(MIN_STEP_MM);
            branches.extend(std::iter::repeat_n(BranchPoints { first, last: first + n.max(1) - 1, step_mm }, n));
        }
        Slides { of_phase: vec![vec![0.0; branches.len()]; phases.len()], branches }
    }

    fn place(&self, phase: usize, point: usize) -> Place {
        let BranchPoints { first, last, .. } = self.branches[point];
        let at = (point as f64 + self.of_phase[phase][point]).clamp(first as f64, last as f64);
        let before = at as usize;
        Place { before, behind: (before + 1).min(last), share: at - before as f64 }
    }

    /// Returns the areas at the places where the points are at each phase, `[phase][point]`.
    pub fn at_phases(&self, areas: &[f64]) -> Vec<Vec<f64>> {
        let area = |phase: usize, point: usize| {
            let Place { before, behind, share } = self.place(phase, point);
            areas[before] + share * (areas[behind] - areas[before])
        };
        (0..self.of_phase.len()).map(|phase| (0..areas.len()).map(|point| area(phase, point)).collect()).collect()
    }

    /// Adds values at the places where the points are at a phase to the points of the tree: the transpose of [`Slides::at_phases`].
    pub fn add_transposed(&self, phase: usize, of_phase: &[f64], sums: &mut [f64]) {
        for (point, value) in of_phase.iter().enumerate() {
            let Place { before, behind, share } = self.place(phase, point);
            sums[before] += (1.0 - share) * value;
            sums[behind] += share * value;
        }
    }

    /// Returns the slopes of the areas at the places where the points are at each phase, per point, `[phase][point]`.
    fn slopes(&self, areas: &[f64]) -> Vec<Vec<f64>> {
        let slope = |phase: usize, point: usize| {
            let BranchPoints { first, last, .. } = self.branches[point];
            let before = self.place(phase, point).before.min(last.saturating_sub(1)).max(first);
            areas[(before + 1).min(last)] - areas[before]
        };
        (0..self.of_phase.len()).map(|phase| (0..areas.len()).map(|point| slope(phase, point)).collect()).collect()
    }

    /// Returns the gradient of half the squared, weighted slides and differences of successive ones, `[phase][point]`.
    fn expected(&self, slides: &[Vec<f64>]) -> Vec<Vec<f64>> {
        let of_phase = |slides: &Vec<f64>| {
            let mut out = vec![0.0; slides.len()];
            for (point, branch) in self.branches.iter().enumerate() {
                out[point] += (branch.step_mm / SLIDE_MM).powi(2) * slides[point];
                if point < branch.last {
                    let force = CHANGE.powi(-2) * (slides[point] - slides[point + 1]);
                    out[point] += force;
                    out[point + 1] -= force;
                }
            }
            out
        };
        slides.iter().map(of_phase).collect()
    }

    /// Makes a Gauss-Newton step toward the slides by which areas explain the images of the views best.
    pub fn improve(&mut self, views: &[ShadowedView], areas: &[f64]) {
        let (n_points, slopes) = (areas.len(), self.slopes(areas));
        let split = |all: &[f64]| -> Vec<Vec<f64>> { all.chunks(n_points).map(<[f64]>::to_vec).collect() };
        // Derivatives by the slides, summed over the frames of each phase.
        let summed = |images: &dyn Fn(&ShadowedView) -> Vec<Vec<f64>>| {
            let mut all = vec![vec![0.0; n_points]; slopes.len()];
            for view in views {
                for (frame, sums) in view.frames.iter().zip(view.sums(&images(view), n_points)) {
                    let by_slope = sums.iter().zip(&slopes[frame.phase]).map(|(sum, slope)| sum * slope);
                    all[frame.phase].iter_mut().zip(by_slope).for_each(|(all, value)| *all += value);
                }
            }
            all
        };
        let models = self.at_phases(areas);
        let left = |view: &ShadowedView| {
            let without = |(image, model): (&Vec<f64>, Vec<f64>)| image.iter().zip(model).map(|(y, m)| y - m).collect();
            view.frames.iter().map(|frame| &frame.image).zip(view.images(&models)).map(without).collect()
        };
        let mut right = summed(&left).concat();
        right.iter_mut().zip(self.expected(&self.of_phase).concat()).for_each(|(right, force)| *right -= force);
        let applied = |steps: &[f64]| {
            let steps = split(steps);
            let by_slope =
                |(steps, slopes): (&Vec<f64>, &Vec<f64>)| steps.iter().zip(slopes).map(|(a, b)| a * b).collect();
            let changes: Vec<Vec<f64>> = steps.iter().zip(&slopes).map(by_slope).collect();
            let of_images = summed(&|view| view.images(&changes)).concat();
            self.expected(&steps).concat().iter().zip(of_images).map(|(a, b)| a + b).collect()
        };
        let steps = split(&conjugate_gradients(applied, &right, &vec![0.0; right.len()]));
        for (slides, steps) in self.of_phase.iter_mut().zip(steps) {
            for ((slide, step), branch) in slides.iter_mut().zip(steps).zip(&self.branches) {
                let limit = MAX_SLIDE_MM / branch.step_mm;
                *slide = (*slide + step).clamp(-limit, limit);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::trees::tree::Branch;
    use glam::DVec3;

    /// Two branches of four points and of one point, over two phases.
    fn slides() -> Slides {
        let branch = |n: usize| Branch {
            parent: None,
            points_mm: (0..n).map(|i| DVec3::X * 0.5 * i as f64).collect(),
            radius_mm: vec![1.0; n],
            agreement: Vec::new(),
            doubt: Vec::new(),
            gap_mm: 0.0,
        };
        let phase = |phase: u32| PhaseTree { phase, branches: vec![branch(4), branch(1)] };
        let mut slides = Slides::none(&[phase(0), phase(1)]);
        assert_eq!(slides.at_phases(&[1.0, 2.0, 4.0, 8.0, 3.0]), [[1.0, 2.0, 4.0, 8.0, 3.0]; 2]);
        slides.of_phase[1] = vec![-0.5, 0.5, -1.25, 2.0, 0.7];
        slides
    }

    #[test]
    fn points_slide_within_their_branch() {
        let slides = slides();
        let areas = [1.0, 2.0, 4.0, 8.0, 3.0];
        assert_eq!(slides.at_phases(&areas)[1], [1.0, 3.0, 1.75, 8.0, 3.0]);
        assert_eq!(slides.slopes(&areas), [[1.0, 2.0, 4.0, 4.0, 0.0], [1.0, 2.0, 1.0, 4.0, 0.0]]);
        // (P a) . v = a . (P^T v)
        let values = [0.3, -1.0, 2.5, 0.4, 1.1];
        let mut sums = [0.0; 5];
        slides.add_transposed(1, &values, &mut sums);
        let product = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
        let (left, right) = (product(&slides.at_phases(&areas)[1], &values), product(&areas, &sums));
        assert!((left - right).abs() < 1e-12, "{left} {right}");
    }

    #[test]
    fn the_expectation_is_the_gradient_of_its_squares() {
        let slides = slides();
        let half_squares = |at: &[Vec<f64>]| {
            let own = |at: &Vec<f64>| {
                let from_zero: f64 =
                    at.iter().zip(&slides.branches).map(|(x, b)| (x * b.step_mm / SLIDE_MM).powi(2)).sum();
                let steps: f64 = at[..4].windows(2).map(|pair| ((pair[0] - pair[1]) / CHANGE).powi(2)).sum();
                0.5 * (from_zero + steps)
            };
            at.iter().map(own).sum::<f64>()
        };
        let gradient = slides.expected(&slides.of_phase);
        for (phase, point) in (0..2).flat_map(|phase| (0..5).map(move |point| (phase, point))) {
            let moved = |by: f64| {
                let mut at = slides.of_phase.clone();
                at[phase][point] += by;
                half_squares(&at)
            };
            let expected = (moved(1e-4) - moved(-1e-4)) / 2e-4;
            assert!((gradient[phase][point] - expected).abs() < 1e-5, "{phase}, {point}: {gradient:?}");
        }
    }
}
