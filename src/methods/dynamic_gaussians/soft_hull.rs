//! The soft hull: each view gives evidence for or against a vessel at each pixel and phase ([`crate::evidence`]), and cells are
//! kept by the evidence of all views together, so that no view alone can veto one.

pub mod carve;
