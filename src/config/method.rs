//! Methods of reconstruction, as a configuration chooses them.

/// A method of reconstruction. Each has settings of its own beside those that all methods share.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum MethodKind {
    /// A static tensor field and a dynamic network, as in NerT-CA.
    Fields,
    /// Two networks, as in NeRF-CA.
    TwoNetworks,
    /// Gaussians as the dynamic field in front of a static tensor field.
    Gaussians,
    /// Static Gaussians with line integrals.
    R2Gaussian,
    /// Static Gaussians of which nearer ones hide those behind them.
    XGaussian,
    /// A hash grid and a Lineformer.
    SaxNerf,
}

impl MethodKind {
    /// Returns the name of the method, for messages.
    pub fn name(self) -> &'static str {
        match self {
            MethodKind::Fields => "a tensor field and a network",
            MethodKind::TwoNetworks => "two networks (static.form = \"network\")",
            MethodKind::Gaussians => "Gaussians in front of a tensor field (gaussians.form)",
            MethodKind::R2Gaussian => "R2-Gaussian",
            MethodKind::XGaussian => "X-Gaussian",
            MethodKind::SaxNerf => "SAX-NeRF",
        }
    }

    /// Tells whether the method is fitted to whole images by itself, without a static field.
    pub fn is_alone(self) -> bool {
        matches!(self, MethodKind::R2Gaussian | MethodKind::XGaussian | MethodKind::SaxNerf)
    }

    /// Tells whether pictures of the dynamic field are blended, from about 0 to 1, so that they show no attenuation.
    pub fn is_blended(self) -> bool {
        self == MethodKind::XGaussian
    }

    /// Tells whether the dynamic field is a network on encoded coordinates.
    pub fn has_network(self) -> bool {
        matches!(self, MethodKind::Fields | MethodKind::TwoNetworks)
    }
}
