//! The soft hull: each view says for and against a vessel at each pixel and phase ([`crate::evidence`]), and cells are kept by
//! what all views say together, so that no view alone can veto one.

pub mod carve;
