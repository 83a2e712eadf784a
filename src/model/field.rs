//! Traits of the fields of methods, for checkpoints and renderers.

use crate::error::Result;
use crate::gpu::buffer::Buffer;
use crate::gpu::device::Gpu;
use crate::gpu::record::Recording;
use std::any::Any;
use std::fmt::Debug;

/// The field of a method that uses neither the tensor field nor the network nor the Gaussians of other methods.
pub trait Field: Any + Debug + Send + Sync {
    /// Returns the key of the method, under which headers of checkpoints and `info` have this field.
    fn key(&self) -> &'static str;

    /// Returns the properties that tensors and configuration do not contain, as JSON for the header of a checkpoint.
    ///
    /// # Errors
    /// [`crate::error::Error::Internal`] when it cannot be written as JSON.
    fn header(&self) -> Result<String>;

    /// Describes the field for `info`.
    fn describe(&self) -> serde_json::Value;

    /// Returns a name and a line of text for the report page of a run.
    fn fact(&self) -> (String, String);

    /// Uploads the field to a device for drawing.
    ///
    /// # Errors
    /// [`crate::error::Error::OutOfMemory`]; other device errors.
    fn drawing(&self, gpu: &Gpu) -> Result<Box<dyn FieldDrawing>>;
}

impl dyn Field {
    /// Returns the field as the type of its method.
    pub fn downcast<T: Field>(&self) -> Option<&T> {
        let field: &dyn Any = self;
        field.downcast_ref()
    }
}

/// Cells of a volume along rays of its rows.
#[derive(Debug, Clone, Copy)]
pub struct Row {
    /// Depth of the first cell, world units.
    pub near: f32,
    /// Depth of the last cell, world units.
    pub far: f32,
    /// Cells of a row.
    pub cells: u32,
}

/// A field on a device.
pub trait FieldDrawing: Send + Sync {
    /// Draws another field of the same sizes from now on. Commands that were recorded before draw the old one. A field without
    /// numbers changes nothing.
    ///
    /// # Errors
    /// [`crate::error::Error::Internal`] for a field of another method or of other sizes; device errors.
    fn replace(&self, field: &dyn Field) -> Result<()>;

    /// Draws numbers that are on the device, as a [`crate::fitting::fit::FieldFeed`] has them.
    fn follow(&self, params: Vec<Buffer>);

    /// Records the rendering of `n_rays` of `rays` at a phase into `ray_out`.
    ///
    /// # Errors
    /// [`crate::error::Error::Internal`] when stages and buffers do not fit, or there are no numbers yet.
    fn record_rays(
        &self,
        recording: &mut Recording,
        rays: &Buffer,
        ray_out: &Buffer,
        phase: u32,
        n_rays: u32,
    ) -> Result<()>;

    /// Records attenuation per world unit at the cells of `n_rows` rows along `rays` at a phase, into `volume`.
    ///
    /// # Errors
    /// Errors of [`FieldDrawing::record_rays`]; [`crate::error::Error::Config`] for rows that are too long.
    fn record_cells(
        &self,
        recording: &mut Recording,
        rays: &Buffer,
        row: Row,
        phase: u32,
        n_rows: u32,
        volume: &Buffer,
    ) -> Result<()>;
}
