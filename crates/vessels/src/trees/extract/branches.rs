//! Decomposition of a forest of centrelines into branches, from the roots.

use crate::trees::extract::graph::Forest;

/// Nodes of a branch, in order from the root.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Chain {
    /// Index of the parent branch, always smaller than the branch's own.
    pub(super) parent: Option<usize>,
    pub(super) nodes: Vec<usize>,
}

/// Width of a vessel at one of its ends: the mean over the nearer half of the branch that ends there, mm.
fn width_mm(forest: &Forest, end: usize) -> f64 {
    let chain = forest.chain(end, forest.nodes[end].links[0]);
    let half = &chain[..chain.len().div_ceil(2)];
    half.iter().map(|node| forest.nodes[*node].inside_mm).sum::<f64>() / half.len() as f64
}

/// Branches of all trees; the root of each tree is its widest end, as in coronary arteries.
pub(super) fn chains(forest: &Forest) -> Vec<Chain> {
    let trees = forest.trees().all();
    let mut roots: Vec<(usize, f64)> = Vec::new();
    for end in forest.ends() {
        let width = width_mm(forest, end);
        match roots.iter_mut().find(|(root, _)| trees[*root] == trees[end]) {
            Some(root) if root.1 < width => *root = (end, width),
            Some(_) => {}
            None => roots.push((end, width)),
        }
    }
    let mut chains: Vec<Chain> = Vec::new();
    for (root, _) in roots {
        let mut waiting = vec![(None, root, forest.nodes[root].links[0])];
        while let Some((parent, from, link)) = waiting.pop() {
            let nodes = forest.chain(from, link);
            let (before, last) = (nodes[nodes.len() - 2], nodes[nodes.len() - 1]);
            let branch = chains.len();
            chains.push(Chain { parent, nodes });
            let onwards = forest.nodes[last].links.iter().filter(|next| **next != before);
            waiting.extend(onwards.map(|next| (Some(branch), last, *next)));
        }
    }
    chains
}
