//! Choices that users make by name: on a command line, in a query or in a file.

use strum::VariantArray;

/// An enumeration whose values have names. Every enumeration has it that derives `VariantArray` and `IntoStaticStr` of strum;
/// `#[strum(serialize_all = "kebab-case")]` makes the names from those of the variants.
pub trait Choice: VariantArray + Into<&'static str> + Copy + Send + Sync {
    /// All values.
    const ALL: &'static [Self] = Self::VARIANTS;

    /// Name that a user writes for the value.
    fn name(self) -> &'static str {
        self.into()
    }

    /// Returns the value with a name.
    fn named(name: &str) -> Option<Self> {
        Self::ALL.iter().copied().find(|choice| choice.name() == name)
    }

    /// All names, separated by commas, for messages.
    fn names() -> String {
        Self::ALL.iter().map(|choice| choice.name()).collect::<Vec<_>>().join(", ")
    }
}

impl<T: VariantArray + Into<&'static str> + Copy + Send + Sync> Choice for T {}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::calibrate::settings::CalibrateMode;
    use crate::config::{GaussianForm, OcclusionRegion, Preset, R2Integral, R2Start, StaticData};
    use crate::export::volumes::Format;
    use crate::formats::raw::Element;
    use crate::kernels::tuning::Layers;
    use crate::model::component::Component;
    use crate::render::quantity::Projection;
    use crate::scan::dataset::Layout;
    use crate::scan::gating::BeatScaling;
    use serde::Serialize;

    fn check_names_in_files<T: Choice + Serialize>() {
        for &choice in T::ALL {
            assert_eq!(serde_json::to_value(choice).unwrap(), choice.name());
        }
    }

    #[test]
    fn names_are_those_in_files() {
        check_names_in_files::<Preset>();
        check_names_in_files::<GaussianForm>();
        check_names_in_files::<OcclusionRegion>();
        check_names_in_files::<StaticData>();
        check_names_in_files::<R2Start>();
        check_names_in_files::<R2Integral>();
        check_names_in_files::<CalibrateMode>();
        check_names_in_files::<BeatScaling>();
        check_names_in_files::<Layers>();
        check_names_in_files::<Layout>();
    }

    #[test]
    fn names_that_no_file_has_stay() {
        assert_eq!(Component::names(), "total, static, dynamic");
        assert_eq!(Projection::names(), "drr, mip");
        assert_eq!(Format::names(), "nrrd, nifti, mha, npy, vtk");
        assert_eq!(Element::names(), "f32, f64, i8, u8, i16, u16, i32, u32");
    }
}
