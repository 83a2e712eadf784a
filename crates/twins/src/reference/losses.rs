//! Losses of an iteration, as both kinds of fields report them.

/// Losses of an iteration; see `report`.
#[derive(Debug, Clone, Copy, Default)]
pub struct Losses {
    /// Weighted data terms.
    pub data: f64,
    /// Weighted data term of the dynamic field.
    pub dynamic: f64,
    /// Total variation.
    pub tv: f64,
    /// Occlusion, weighted.
    pub occlusion: f64,
    /// Entropy of two networks' shares at samples, weighted.
    pub favour_static: f64,
    /// Entropy of the dynamic field along rays, weighted; of two networks.
    pub ray_entropy: f64,
    /// Integrals of the static field over intervals and their squares, weighted; of two networks.
    pub static_size: f64,
    /// Live dynamic samples.
    pub live: usize,
}

impl Losses {
    /// The objective.
    pub fn total(&self) -> f64 {
        self.data + self.tv + self.occlusion + self.favour_static + self.ray_entropy + self.static_size
    }
}
