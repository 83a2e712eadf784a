//! SAX-NeRF's field as plain data: a hash grid and a Lineformer for each phase, or one of each for all phases.

use crate::config::sections::Sax;
use crate::error::{Error, Result};
use crate::kernels::constants::LINEFORMER_INPUT;
use crate::kernels::layout::SaxLevel;

/// Width of the Lineformer's layers.
pub const WIDTH: usize = 32;
/// Features of a level of the grid.
pub const FEATURES: usize = 2;
/// Width inside its feed-forward part.
const WIDE: usize = 4 * WIDTH;
/// Heads of its attention.
const HEADS: usize = 8;
/// Number of samples that attend to each other.
const PAIR: usize = 2;

/// Group of parameters of a field that form one tensor.
#[derive(Debug, Clone, PartialEq)]
pub struct ParamGroup {
    /// Name of the group in files.
    pub name: &'static str,
    /// Shape of the group: outputs before inputs.
    pub shape: Vec<usize>,
    /// Index of the first one among the field's parameters.
    pub first: usize,
}

impl ParamGroup {
    /// Returns the number of parameters of the group.
    pub fn len(&self) -> usize {
        self.shape.iter().product()
    }

    /// Tells whether the group is empty.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }
}

/// Sizes of a field.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct SaxShape {
    /// Levels of the hash grid.
    pub levels: u32,
    /// Cells along each side of the box in the first level; each further one has twice as many.
    pub base: u32,
    /// Logarithm to base 2 of the maximum number of entries of a level.
    pub log2_table: u32,
}

impl SaxShape {
    /// Returns the sizes for a configuration.
    pub fn of(settings: &Sax) -> SaxShape {
        SaxShape { levels: settings.levels, base: settings.base, log2_table: settings.log2_table }
    }

    /// Returns the number of features of a point.
    pub fn n_features(&self) -> usize {
        FEATURES * self.levels as usize
    }

    /// Returns the levels: cells, entries, and whether each corner has its own entry.
    pub fn grid(&self) -> Vec<SaxLevel> {
        let (table, mut first) = (1u64 << self.log2_table, 0);
        let level = |l: u32| {
            let cells = self.base << l;
            let corners = (u64::from(cells) + 1).pow(3);
            let level =
                SaxLevel { cells, first, entries: corners.min(table) as u32, dense: u32::from(corners <= table) };
            first += level.entries;
            level
        };
        (0..self.levels).map(level).collect()
    }

    /// Returns the number of parameters of the grid.
    pub fn n_grid(&self) -> usize {
        FEATURES * self.grid().iter().map(|level| level.entries as usize).sum::<usize>()
    }

    /// Returns the number of parameters of the Lineformer, padding included.
    pub fn n_weights(&self) -> usize {
        let input = self.n_features();
        4 * LINEFORMER_INPUT as usize + WIDTH * input + WIDTH * (input + WIDTH)
    }

    /// Returns the number of parameters of the field, padding included.
    pub fn n_params(&self) -> usize {
        self.n_weights() + self.n_grid()
    }

    /// Returns the number of parameters of the field without padding.
    pub fn n_meant(&self) -> usize {
        self.parts().iter().map(ParamGroup::len).sum()
    }

    /// Returns the groups of parameters in their order.
    pub fn parts(&self) -> Vec<ParamGroup> {
        let input = self.n_features();
        let parts = [
            ("norm1.weight", vec![WIDTH]),
            ("norm1.bias", vec![WIDTH]),
            ("attention.query", vec![WIDTH, WIDTH]),
            ("attention.key_value", vec![2 * WIDTH, WIDTH]),
            ("attention.position", vec![HEADS, PAIR, PAIR]),
            ("attention.out.weight", vec![WIDTH, WIDTH]),
            ("attention.out.bias", vec![WIDTH]),
            ("norm2.weight", vec![WIDTH]),
            ("norm2.bias", vec![WIDTH]),
            ("feed_forward.expand", vec![WIDE, WIDTH]),
            ("feed_forward.mix", vec![WIDE, WIDE]),
            ("feed_forward.contract", vec![WIDTH, WIDE]),
            ("input.bias", vec![WIDTH]),
            ("joint.bias", vec![WIDTH]),
            ("density.weight", vec![1, WIDTH]),
            ("density.bias", vec![1]),
            ("input.weight", vec![WIDTH, input]),
            ("joint.weight", vec![WIDTH, input + WIDTH]),
            ("grid", vec![self.n_grid() / FEATURES, FEATURES]),
        ];
        let mut first = 0;
        let place = |(name, shape): (&'static str, Vec<usize>)| {
            let part = ParamGroup { name, shape, first };
            // A single number is padded to a row.
            first += part.len().max(WIDTH);
            part
        };
        parts.into_iter().map(place).collect()
    }
}

/// A field as it is drawn and stored.
#[derive(Debug, Clone, PartialEq)]
pub struct SaxField {
    /// Its sizes.
    pub shape: SaxShape,
    /// Half side of the box of the grid, world units.
    pub bound: f64,
    /// First and last depth along rays, world units from the isocentre.
    pub depths: [f64; 2],
    /// Samples of a ray.
    pub samples: u32,
    /// Attenuation per world unit where its density is 1.
    pub attenuation: f64,
    /// Fields: one for each phase, or one for all.
    pub n_sets: usize,
    /// `[set]`: parameters in the order of [`SaxShape::parts`]; empty for a run whose parameters are on the device.
    pub params: Vec<Vec<f32>>,
    /// Iterations done.
    pub step: u32,
}

impl SaxField {
    /// Returns the index of the set that represents a phase.
    pub fn set_of(&self, phase: u32) -> usize {
        (phase as usize).min(self.n_sets - 1)
    }
}

/// State that a resumed fit needs beside the field.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct SaxState {
    /// `[set]`: first and second moment of Adam of each number.
    pub moments: Vec<Vec<[f32; 2]>>,
}

/// Settings that make the steps of a fit smaller.
pub const SMALLER_STEPS: &str = "a lower sax.lrate";

/// Refuses parameters that are not finite.
///
/// # Errors
/// [`Error::Diverged`] with the first such parameter.
pub fn check_params(params: &[Vec<f32>], step: u32) -> Result<()> {
    match params.iter().flatten().find(|v| !v.is_finite()) {
        Some(bad) => Err(Error::Diverged {
            step: step.into(),
            quantity: "a parameter of SAX-NeRF",
            value: f64::from(*bad),
            advice: SMALLER_STEPS,
        }),
        None => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::kernels::constants as at;

    const CHEST: SaxShape = SaxShape { levels: 16, base: 16, log2_table: 19 };

    #[test]
    fn sizes_are_those_of_the_published_field() {
        assert_eq!(CHEST.n_grid(), 14_262_438);
        let lineformer: usize = CHEST.parts().iter().filter(|part| part.name != "grid").map(ParamGroup::len).sum();
        assert_eq!(lineformer, 32_033);
        let levels = CHEST.grid();
        assert_eq!(
            levels[..4].iter().map(|l| l.entries).collect::<Vec<_>>(),
            [17u32.pow(3), 33u32.pow(3), 65u32.pow(3), 1 << 19]
        );
        assert_eq!((levels[15].cells, levels[2].dense, levels[3].dense), (524_288, 1, 0));
    }

    #[test]
    fn parts_lie_where_the_shaders_look_for_them() {
        for shape in [CHEST, SaxShape { levels: 4, base: 5, log2_table: 9 }] {
            let parts = shape.parts();
            let first = |name: &str| parts.iter().find(|part| part.name == name).unwrap().first;
            for (name, vec4) in [
                ("norm1.weight", at::LINEFORMER_NORM1),
                ("attention.query", at::LINEFORMER_QUERY),
                ("attention.key_value", at::LINEFORMER_KEY),
                ("attention.position", at::LINEFORMER_POSITION),
                ("attention.out.weight", at::LINEFORMER_OUT),
                ("norm2.weight", at::LINEFORMER_NORM2),
                ("feed_forward.expand", at::LINEFORMER_EXPAND),
                ("feed_forward.mix", at::LINEFORMER_MIX),
                ("feed_forward.contract", at::LINEFORMER_CONTRACT),
                ("input.bias", at::LINEFORMER_INPUT_BIAS),
                ("joint.bias", at::LINEFORMER_JOINT_BIAS),
                ("density.weight", at::LINEFORMER_DENSITY),
                ("input.weight", at::LINEFORMER_INPUT),
            ] {
                assert_eq!(first(name), 4 * vec4 as usize, "{name}");
            }
            assert_eq!(at::LINEFORMER_VALUE, at::LINEFORMER_KEY + 256);
            assert_eq!(first("grid"), shape.n_weights());
            assert_eq!(first("grid") + shape.n_grid(), shape.n_params());
        }
    }
}
