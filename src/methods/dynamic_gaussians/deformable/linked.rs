//! Groups of Gaussians that are linked with each other, directly or through others.

use glam::DVec3;

/// Divides indices into groups: two that are `near` belong to one.
pub(super) fn groups(mut left: Vec<usize>, near: impl Fn(usize, usize) -> bool) -> Vec<Vec<usize>> {
    let mut groups = Vec::new();
    while let Some(first) = left.pop() {
        groups.push(grown(vec![first], &mut left, &near));
    }
    groups
}

/// Moves into a group all that is left near one of its members, and what is near that.
pub(super) fn grown(mut group: Vec<usize>, left: &mut Vec<usize>, near: impl Fn(usize, usize) -> bool) -> Vec<usize> {
    let mut looked_at = 0;
    while looked_at < group.len() {
        let from = group[looked_at];
        group.extend(left.extract_if(.., |other| near(from, *other)));
        looked_at += 1;
    }
    group
}

/// Returns the length of the diagonal of a box around points; 0 without any.
pub(super) fn extent(points: impl Iterator<Item = DVec3>) -> f64 {
    let [low, high] = points.fold([DVec3::MAX, DVec3::MIN], |[low, high], x| [low.min(x), high.max(x)]);
    (high - low).max(DVec3::ZERO).length()
}
