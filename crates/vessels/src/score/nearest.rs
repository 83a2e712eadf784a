//! Search for the place on lines that is nearest to a point.

use glam::DVec3;

/// Number of a line's steps that are searched or skipped together.
const STEPS: usize = 16;

/// A place on a line: the share of the distance from one point to the next.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct LinePlace {
    pub(super) line: usize,
    pub(super) from: usize,
    pub(super) share: f64,
}

impl LinePlace {
    pub(super) fn on<T, M>(&self, values: &[T], mix: M) -> T
    where
        T: Copy,
        M: Fn(T, T, f64) -> T,
    {
        mix(values[self.from], values[self.from + 1], self.share)
    }
}

/// A few steps of a line, and a ball that contains them.
struct Stretch {
    line: usize,
    first: usize,
    centre: DVec3,
    radius: f64,
}

/// Lines prepared for the search for nearest places.
pub(super) struct Lines<'a> {
    lines: &'a [&'a [DVec3]],
    stretches: Vec<Stretch>,
}

impl<'a> Lines<'a> {
    pub(super) fn new(lines: &'a [&'a [DVec3]]) -> Lines<'a> {
        let of_line = |(line, points): (usize, &&[DVec3])| {
            let firsts = (0..points.len().saturating_sub(1)).step_by(STEPS);
            let stretch = |first: usize| {
                let points = &points[first..points.len().min(first + STEPS + 1)];
                let centre = points.iter().sum::<DVec3>() / points.len() as f64;
                let radius = points.iter().map(|p| p.distance(centre)).fold(0.0, f64::max);
                Stretch { line, first, centre, radius }
            };
            firsts.map(stretch).collect::<Vec<_>>()
        };
        Lines { lines, stretches: lines.iter().enumerate().flat_map(of_line).collect() }
    }

    /// Returns the distance to the nearest place, and the place; `None` without lines.
    pub(super) fn nearest(&self, point: DVec3) -> (f64, Option<LinePlace>) {
        let mut best = (f64::INFINITY, None);
        for stretch in &self.stretches {
            if point.distance_squared(stretch.centre) > (best.0 + stretch.radius).powi(2) {
                continue;
            }
            let points = self.lines[stretch.line];
            for from in stretch.first..(stretch.first + STEPS).min(points.len() - 1) {
                let (share, away) = on_step([points[from], points[from + 1]], point);
                if away < best.0 {
                    best = (away, Some(LinePlace { line: stretch.line, from, share }));
                }
            }
        }
        best
    }
}

/// Share of the step at which it is nearest to a point, and the distance there.
fn on_step([begin, end]: [DVec3; 2], point: DVec3) -> (f64, f64) {
    let way = end - begin;
    let share = ((point - begin).dot(way) / way.length_squared().max(f64::MIN_POSITIVE)).clamp(0.0, 1.0);
    (share, point.distance(begin + share * way))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::random::uniform01;

    #[test]
    fn nothing_nearer_is_passed_over() {
        let place = |line: u32, i: u32| {
            let turn = 0.2 * f64::from(i);
            DVec3::new(turn.sin(), turn.cos(), 0.1 * turn) * (3.0 + f64::from(line)) + DVec3::X * f64::from(5 * line)
        };
        let lines: Vec<Vec<DVec3>> =
            [0, 1, 2, 17, 33, 150].map(|n| (0..n).map(|i| place(n / 10, i)).collect()).to_vec();
        let lines: Vec<&[DVec3]> = lines.iter().map(Vec::as_slice).collect();
        let index = Lines::new(&lines);
        for i in 0..500 {
            let point = DVec3::from_array([0, 1, 2].map(|k| 60.0 * uniform01(1, 2, i, k) - 20.0));
            let of_line = |points: &&[DVec3]| -> f64 {
                points.windows(2).map(|ends| on_step([ends[0], ends[1]], point).1).fold(f64::INFINITY, f64::min)
            };
            let min = lines.iter().map(of_line).fold(f64::INFINITY, f64::min);
            let (away, there) = index.nearest(point);
            let there = there.unwrap();
            assert_eq!(away, min);
            assert!((there.on(lines[there.line], DVec3::lerp).distance(point) - away).abs() < 1e-9);
        }
        assert_eq!(Lines::new(&[]).nearest(DVec3::ZERO), (f64::INFINITY, None));
    }
}
