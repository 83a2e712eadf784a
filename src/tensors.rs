//! Tensors of a checkpoint file: writing and reading.

use crate::error::{Error, Result};
use safetensors::tensor::{Dtype, SafeTensors};
use std::path::Path;

/// A tensor to be written: name, type, shape, bytes.
pub type FileTensor = (String, Dtype, Vec<usize>, Vec<u8>);

/// A checkpoint file being read.
pub struct File<'a> {
    /// Its tensors.
    pub tensors: &'a SafeTensors<'a>,
    /// Its path, for messages.
    pub path: &'a Path,
}

impl File<'_> {
    /// Returns the bytes of a tensor of a type and shape; `None` stands for any length.
    ///
    /// # Errors
    /// [`Error::Data`] naming the tensor that is missing or of another type or shape.
    pub fn bytes(&self, name: &str, dtype: Dtype, shape: &[Option<usize>]) -> Result<&[u8]> {
        let bad = |problem: String| Error::data(self.path, name, problem);
        let view = self.tensors.tensor(name).map_err(|e| bad(e.to_string()))?;
        let fits = view.shape().len() == shape.len()
            && view.shape().iter().zip(shape).all(|(is, wanted)| wanted.is_none_or(|wanted| *is == wanted));
        if view.dtype() != dtype || !fits {
            return Err(bad(format!("is {:?} {:?} where {dtype:?} {shape:?} is needed", view.dtype(), view.shape())));
        }
        Ok(view.data())
    }

    /// Returns the finite numbers of an f32 tensor of a shape; `None` stands for any length.
    ///
    /// # Errors
    /// [`Error::Data`] naming the tensor that is missing, of another type or shape, or not finite.
    pub fn floats(&self, name: &str, shape: &[Option<usize>]) -> Result<Vec<f32>> {
        let bytes = self.bytes(name, Dtype::F32, shape)?.chunks_exact(4);
        let values: Vec<f32> = bytes.map(|w| f32::from_le_bytes([w[0], w[1], w[2], w[3]])).collect();
        match values.iter().all(|v| v.is_finite()) {
            true => Ok(values),
            false => Err(Error::data(self.path, name, "contains a value that is not finite")),
        }
    }

    /// Returns the words of a u32 tensor of `n` elements.
    ///
    /// # Errors
    /// [`Error::Data`] naming the tensor that is missing or of another type or shape.
    pub fn words(&self, name: &str, n: usize) -> Result<Vec<u32>> {
        let bytes = self.bytes(name, Dtype::U32, &[Some(n)])?.chunks_exact(4);
        Ok(bytes.map(|w| u32::from_le_bytes([w[0], w[1], w[2], w[3]])).collect())
    }
}
