//! Line integrals of an image, which datasets with different geometry, and the data of a fit, share instead of copying them.

use std::ops::{Deref, DerefMut};
use std::sync::Arc;

/// Line integrals of an image in row-major order. Clones share them, until one of the clones is changed.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Pixels(Arc<Vec<f32>>);

impl Pixels {
    /// Returns the values; they are copied only where clones share them.
    pub fn into_vec(self) -> Vec<f32> {
        Arc::unwrap_or_clone(self.0)
    }
}

impl Deref for Pixels {
    type Target = Vec<f32>;

    fn deref(&self) -> &Vec<f32> {
        &self.0
    }
}

impl DerefMut for Pixels {
    fn deref_mut(&mut self) -> &mut Vec<f32> {
        Arc::make_mut(&mut self.0)
    }
}

impl From<Vec<f32>> for Pixels {
    fn from(values: Vec<f32>) -> Pixels {
        Pixels(Arc::new(values))
    }
}

impl FromIterator<f32> for Pixels {
    fn from_iter<I: IntoIterator<Item = f32>>(values: I) -> Pixels {
        Vec::from_iter(values).into()
    }
}

impl<'a> IntoIterator for &'a Pixels {
    type Item = &'a f32;
    type IntoIter = std::slice::Iter<'a, f32>;

    fn into_iter(self) -> Self::IntoIter {
        self.0.iter()
    }
}

impl<'a> IntoIterator for &'a mut Pixels {
    type Item = &'a mut f32;
    type IntoIter = std::slice::IterMut<'a, f32>;

    fn into_iter(self) -> Self::IntoIter {
        self.iter_mut()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn clones_share_their_values_until_one_is_changed() {
        let first = Pixels::from(vec![1.0, 2.0, 3.0]);
        let mut second = first.clone();
        assert_eq!(first.as_ptr(), second.as_ptr(), "no copy");
        second[1] = 5.0;
        assert_eq!((first.into_vec(), second.into_vec()), (vec![1.0, 2.0, 3.0], vec![1.0, 5.0, 3.0]));
    }
}
