//! Clean-up of a forest of centrelines: bridging of gaps, pruning of spurs and removal of specks.

use crate::trees::extract::graph::Forest;
use glam::DVec3;

/// Length of the last part of a line that defines an end's direction, in units of the field's resolution.
const DIRECTION: f64 = 3.0;
/// Maximum width of a bridged gap, in units of the field's resolution.
const GAP: f64 = 5.0;
/// Maximum angle between an end's direction and its bridge. With 30 degrees, two branches are lost (docs/tried.md).
const GAP_DEG: f64 = 45.0;
/// Maximum width of the gap between two ends that face each other, in units of the field's resolution. Of 13 such gaps in trees with and without
/// stenoses, 12 were gaps of one vessel, but only 1 of 8 as wide between an end and the side of a vessel.
const STENOSIS: f64 = 10.0;
/// Minimum length of a line whose end faces another, in units of the field's resolution: shorter ones have no direction.
const STUB: f64 = 2.0;
/// Maximum length of a speck, as a share of the longest tree's length. A limit of six pixels instead leaves ghosts at seven of ten phases
/// (docs/tried.md).
const SPECK: f64 = 0.05;

/// A bridge from the end of one tree to a node of another.
#[derive(Debug, Clone, Copy)]
struct Bridge {
    end: usize,
    node: usize,
    width_mm: f64,
}

/// Direction of an end: away from the tree, along its last few millimetres.
fn direction(forest: &Forest, end: usize, along_mm: f64) -> Option<DVec3> {
    let chain = forest.chain(end, *forest.nodes[end].links.first()?);
    let tip = forest.nodes[end].place_mm;
    let far = forest.places_mm(&chain).into_iter().find(|place| place.distance(tip) >= along_mm);
    (tip - far.unwrap_or(forest.nodes[*chain.last()?].place_mm)).try_normalize()
}

/// Links ends of trees with a node of another tree ahead of them, the narrowest gap first, each end once. Two lines that
/// end in one place are linked whatever their direction.
pub(super) fn bridge_gaps(forest: &mut Forest, resolution_mm: f64) {
    let bridges = forest.ends().flat_map(|end| bridges_from(forest, end, resolution_mm)).collect();
    link_narrowest_first(forest, bridges, |forest, bridge| forest.is_end(bridge.end));
}

/// Links trees across gaps, the narrowest first, where that is still possible; no cycle is made.
fn link_narrowest_first(forest: &mut Forest, mut bridges: Vec<Bridge>, is_open: impl Fn(&Forest, &Bridge) -> bool) {
    bridges.sort_by(|a, b| a.width_mm.total_cmp(&b.width_mm));
    let mut trees = forest.trees();
    for bridge in bridges {
        if is_open(forest, &bridge) && trees.join(bridge.end, bridge.node) {
            forest.link(bridge.end, bridge.node);
        }
    }
}

/// Possible bridges from an end.
fn bridges_from(forest: &Forest, end: usize, resolution_mm: f64) -> Vec<Bridge> {
    let Some(ahead) = direction(forest, end, DIRECTION * resolution_mm) else { return Vec::new() };
    let tip = forest.nodes[end].place_mm;
    let bridge = |node: usize| {
        let to = forest.nodes[node].place_mm - tip;
        let width_mm = to.length();
        let is_ahead = width_mm <= resolution_mm || ahead.angle_between(to).to_degrees() <= GAP_DEG;
        let narrow = width_mm <= GAP * resolution_mm;
        (narrow && is_ahead && !forest.nodes[node].links.is_empty()).then_some(Bridge { end, node, width_mm })
    };
    (0..forest.nodes.len()).filter_map(bridge).collect()
}

/// Links ends of two trees that face each other across a wider gap: a field may show nothing of a vessel in a severe stenosis, while the vessel
/// behind it is there.
pub(super) fn bridge_stenoses(forest: &mut Forest, resolution_mm: f64) {
    let long_enough = |end: &usize| {
        let chain = forest.nodes[*end].links.first().map(|link| forest.chain(*end, *link));
        chain.is_some_and(|chain| forest.length_mm(&chain) >= STUB * resolution_mm)
    };
    let with_direction = |end| Some((end, direction(forest, end, DIRECTION * resolution_mm)?));
    let ends: Vec<(usize, DVec3)> = forest.ends().filter(long_enough).filter_map(with_direction).collect();
    let mut bridges = Vec::new();
    for (i, (end, ahead)) in ends.iter().enumerate() {
        for (node, back) in &ends[i + 1..] {
            let to = forest.nodes[*node].place_mm - forest.nodes[*end].place_mm;
            let width_mm = to.length();
            let faces = |ahead: &DVec3, to: DVec3| ahead.angle_between(to).to_degrees() <= GAP_DEG;
            if width_mm <= STENOSIS * resolution_mm && faces(ahead, to) && faces(back, -to) {
                bridges.push(Bridge { end: *end, node: *node, width_mm });
            }
        }
    }
    link_narrowest_first(forest, bridges, |forest, bridge| forest.is_end(bridge.end) && forest.is_end(bridge.node));
}

/// Share of the radius of a vessel that a branch must reach beyond its lumen: a bump of a thick vessel is no branch.
const BUMP: f64 = 1.0;

/// Prunes branches with an end that reach less than `least_mm` beyond the lumen of the vessel they leave, or less than a share of its
/// radius, the shortest first.
pub(super) fn prune_spurs(forest: &mut Forest, least_mm: f64) {
    loop {
        let spurs = forest.ends().filter_map(|end| {
            let chain = forest.chain(end, *forest.nodes[end].links.first()?);
            let leaves = &forest.nodes[*chain.last()?];
            let reach_mm = forest.length_mm(&chain) - leaves.inside_mm;
            (leaves.links.len() > 2 && reach_mm < least_mm.max(BUMP * leaves.inside_mm)).then_some((reach_mm, chain))
        });
        match spurs.min_by(|a, b| a.0.total_cmp(&b.0)) {
            Some((_, mut chain)) => {
                chain.pop();
                forest.unlink(&chain);
            }
            None => return,
        }
    }
}

/// Removes trees whose total length is below a share of the longest tree's, or below the minimum length of a branch.
pub(super) fn drop_specks(forest: &mut Forest, least_mm: f64) {
    let trees = forest.trees().all();
    let mut lengths_mm = vec![0.0; trees.len()];
    for (a, node) in forest.nodes.iter().enumerate() {
        // Each link is visited from both sides.
        let away = |b: &usize| node.place_mm.distance(forest.nodes[*b].place_mm);
        lengths_mm[trees[a]] += 0.5 * node.links.iter().map(away).sum::<f64>();
    }
    let longest_mm = lengths_mm.iter().copied().fold(0.0, f64::max);
    let enough_mm = least_mm.max(SPECK * longest_mm);
    let specks: Vec<usize> = (0..trees.len()).filter(|a| lengths_mm[trees[*a]] < enough_mm).collect();
    forest.unlink(&specks);
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::trees::extract::graph::Node;

    /// Lines of points at distances of a millimetre, each a tree of its own.
    fn forest(lines: &[(DVec3, DVec3)]) -> Forest {
        let mut forest = Forest::default();
        for (from, to) in lines {
            let first = forest.nodes.len();
            let n = from.distance(*to).round() as usize;
            for i in 0..=n {
                let place_mm = from.lerp(*to, i as f64 / n as f64);
                forest.nodes.push(Node { place_mm, inside_mm: 1.0, links: Vec::new() });
                if i > 0 {
                    forest.link(first + i - 1, first + i);
                }
            }
        }
        forest
    }

    fn n_trees(forest: &Forest) -> usize {
        let trees = forest.trees().all();
        let mut linked: Vec<usize> =
            (0..trees.len()).filter(|node| !forest.nodes[*node].links.is_empty()).map(|node| trees[node]).collect();
        linked.sort_unstable();
        linked.dedup();
        linked.len()
    }

    #[test]
    fn gaps_ahead_are_bridged_and_others_are_not() {
        let line = (DVec3::ZERO, DVec3::X * 20.0);
        for (other, trees, why) in [
            ((DVec3::X * 24.0, DVec3::X * 40.0), 1, "a collinear line"),
            ((DVec3::X * 26.0, DVec3::X * 40.0), 2, "one that is too far away"),
            ((DVec3::new(10.0, 4.0, 0.0), DVec3::new(30.0, 4.0, 0.0)), 2, "one beside it"),
            ((DVec3::new(10.0, 3.0, 0.0), DVec3::new(10.0, 20.0, 0.0)), 1, "one that points at its middle"),
            ((DVec3::new(20.5, 0.5, 0.0), DVec3::new(10.0, 15.0, 0.0)), 1, "one that begins where it ends"),
        ] {
            let mut forest = forest(&[line, other]);
            bridge_gaps(&mut forest, 1.0);
            assert_eq!(n_trees(&forest), trees, "{why}");
        }
    }

    #[test]
    fn a_tree_behind_a_stenosis_is_linked_and_one_that_turns_away_is_not() {
        let line = (DVec3::ZERO, DVec3::X * 20.0);
        for (other, trees, why) in [
            ((DVec3::new(29.0, 1.0, 0.0), DVec3::new(40.0, 6.0, 0.0)), 1, "a vessel that goes on"),
            ((DVec3::X * 31.0, DVec3::X * 40.0), 2, "one that is too far away"),
            ((DVec3::new(29.0, 1.0, 0.0), DVec3::new(25.0, 12.0, 0.0)), 2, "an end that points elsewhere"),
            ((DVec3::new(27.0, -9.0, 0.0), DVec3::new(27.0, 9.0, 0.0)), 2, "the side of a vessel"),
            ((DVec3::X * 28.0, DVec3::X * 29.0), 2, "a stub"),
        ] {
            let mut forest = forest(&[line, other]);
            bridge_gaps(&mut forest, 1.0);
            assert_eq!(n_trees(&forest), 2, "{why}: the gap is wider than those that fields have elsewhere");
            bridge_stenoses(&mut forest, 1.0);
            assert_eq!(n_trees(&forest), trees, "{why}");
        }
    }

    #[test]
    fn the_narrowest_gap_is_bridged_and_no_cycle_made() {
        let mut forest = forest(&[
            (DVec3::ZERO, DVec3::X * 20.0),
            (DVec3::X * 24.0, DVec3::X * 40.0),
            (DVec3::new(22.0, 1.0, 0.0), DVec3::new(30.0, 9.0, 0.0)),
        ]);
        bridge_gaps(&mut forest, 1.0);
        assert_eq!(n_trees(&forest), 1);
        let links: usize = forest.nodes.iter().map(|node| node.links.len()).sum();
        assert_eq!(links, 2 * (forest.nodes.len() - 1));
        let tip = forest.nodes.iter().position(|node| node.place_mm == DVec3::X * 20.0).unwrap();
        let near = forest.nodes.iter().position(|node| node.place_mm == DVec3::new(22.0, 1.0, 0.0)).unwrap();
        assert!(forest.nodes[tip].links.contains(&near), "{:?}", forest.nodes[tip]);
    }

    #[test]
    fn spurs_go_by_how_far_they_leave_the_lumen() {
        // The lumen covers 1 mm of each side branch: 2 mm remain of the first, 4 mm of the second.
        let line = (DVec3::ZERO, DVec3::X * 20.0);
        let side = |x: f64, length: f64| (DVec3::new(x, 0.0, 0.0), DVec3::new(x, length, 0.0));
        let with = |least_mm: f64| {
            let mut forest = forest(&[line, side(5.0, 3.0), side(12.0, 5.0)]);
            // The first point of a side branch is a point of the line.
            for (twin, at) in [(21, 5), (25, 12)] {
                let next = forest.nodes[twin].links[0];
                forest.unlink(&[twin]);
                forest.link(at, next);
            }
            prune_spurs(&mut forest, least_mm);
            forest.ends().map(|end| forest.nodes[end].place_mm.to_array()).collect::<Vec<_>>()
        };
        let (left, right) = ([0.0; 3], [20.0, 0.0, 0.0]);
        assert_eq!(with(1.9), [left, right, [5.0, 3.0, 0.0], [12.0, 5.0, 0.0]]);
        assert_eq!(with(2.1), [left, right, [12.0, 5.0, 0.0]]);
        assert_eq!(with(4.1), [left, right], "a line without bifurcations has no spurs, however short");
    }

    #[test]
    fn specks_are_dropped() {
        let long = (DVec3::ZERO, DVec3::X * 100.0);
        let other = |length: f64| (DVec3::Y * 50.0, DVec3::new(length, 50.0, 0.0));
        for (length, least_mm, trees) in [(4.0, 1.0, 1), (6.0, 1.0, 2), (6.0, 7.0, 1)] {
            let mut forest = forest(&[long, other(length)]);
            drop_specks(&mut forest, least_mm);
            assert_eq!(n_trees(&forest), trees, "{length} mm where {least_mm} count");
        }
    }
}
