//! SAX-NeRF's field and the state of its fit behind the interfaces that all methods share.

use crate::error::{Error, Result};
use crate::fitting::fit::{FitState, SavedState};
use crate::gpu::device::Gpu;
use crate::methods::sax_nerf::drawing::SaxDrawing;
use crate::methods::sax_nerf::field::{SaxField, SaxState};
use crate::methods::sax_nerf::tensors;
use crate::model::Model;
use crate::model::field::{Field, FieldDrawing};

/// Key of the settings, and of the field in headers of checkpoints.
pub(super) const KEY: &str = "sax";

impl Field for SaxField {
    fn key(&self) -> &'static str {
        KEY
    }

    fn header(&self) -> Result<String> {
        serde_json::to_string(&tensors::header(self)).map_err(|e| Error::Internal(e.to_string()))
    }

    fn describe(&self) -> serde_json::Value {
        serde_json::json!({
            "fields": self.n_sets,
            "parameters": self.n_sets * self.shape.n_meant(),
            "grid": self.shape.n_grid(),
            "lineformer": self.shape.n_meant() - self.shape.n_grid(),
            "samples": self.samples,
        })
    }

    fn fact(&self) -> (String, String) {
        ("SAX-NeRF".into(), format!("{} fields of {} parameters each", self.n_sets, self.shape.n_meant()))
    }

    fn drawing(&self, gpu: &Gpu) -> Result<Box<dyn FieldDrawing>> {
        Ok(Box::new(SaxDrawing::new(gpu, self)?))
    }
}

impl FitState for SaxState {
    fn saved(&self, model: &Model) -> Result<SavedState> {
        match model.field.as_ref().and_then(|field| field.downcast::<SaxField>()) {
            Some(field) => Ok(SavedState::of_tensors(tensors::tensors(field, self))),
            None => {
                Err(Error::Internal("a training state of SAX-NeRF was combined with a field of another method".into()))
            }
        }
    }
}
