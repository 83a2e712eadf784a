//! Output: views, volumes, scores, and buffers shared with other APIs.

use crate::boundary::call;
use crate::context::{Claim, Context, nertca_context, on_context};
use crate::handles::{self, Kind};
use crate::reconstruction::{Reconstruction, nertca_reconstruction, on_reconstruction};
use crate::shared_memory;
use crate::status::{Failure, NERTCA_ERROR_NOT_READY, NERTCA_OK, Outcome, nertca_status};
use crate::types::{
    NERTCA_COMPONENT_DYNAMIC, NERTCA_COMPONENT_STATIC, NERTCA_COMPONENT_TOTAL, NERTCA_PIXELS_F32, NERTCA_PIXELS_U8,
    NERTCA_PROJECTION_DRR, NERTCA_PROJECTION_MIP, NERTCA_QUALITY_EXACT, NERTCA_QUALITY_LIVE, nertca_drawn, nertca_grid,
    nertca_image, nertca_view, pixel_bytes, read, sides, stride, write,
};
use glam::DVec3;
use nertca_vk::geometry::{MM_PER_UNIT, ViewRays};
use nertca_vk::gpu::buffer::Buffer;
use nertca_vk::model::component::Component;
use nertca_vk::render::grid::PatientGrid;
use nertca_vk::render::quantity::{Projection, Quantity};
use nertca_vk_runs::session::Drawn;
use std::sync::Arc;

/// A buffer in device memory that other APIs and processes can import.
pub struct nertca_buffer {
    _opaque: [u8; 0],
}

/// Object behind [`nertca_buffer`].
pub(super) struct SharedBuffer {
    buffer: Buffer,
    memory: shared_memory::Memory,
    claim: Claim,
    process: u32,
}

impl Kind for SharedBuffer {
    const NAME: &'static str = "buffer";

    fn process(&self) -> u32 {
        self.process
    }
}

/// A view whose fields were checked.
struct CheckedView {
    rays: ViewRays,
    size: (usize, usize),
    /// Counted in phases; may lie between two.
    phase: f64,
    quantity: Quantity,
    exact: bool,
}

fn component_of(component: u32) -> Outcome<Component> {
    match component {
        NERTCA_COMPONENT_TOTAL => Ok(Component::Total),
        NERTCA_COMPONENT_STATIC => Ok(Component::Static),
        NERTCA_COMPONENT_DYNAMIC => Ok(Component::Dynamic),
        other => Err(Failure::argument("component", format!("{other} is not one of NERTCA_COMPONENT_*"))),
    }
}

/// # Safety
/// `view` must be null or as long as its `size` says, with a geometry whose matrix is null or has 12 numbers.
unsafe fn checked_view(view: *const nertca_view) -> Outcome<CheckedView> {
    // SAFETY: callers of this function guarantee that `view` is null or as long as its size says.
    let view = unsafe { read(view) }?;
    let size = sides(view.width, view.height)?;
    let component = component_of(view.component)?;
    let projection = match view.projection {
        NERTCA_PROJECTION_DRR => Projection::Drr,
        NERTCA_PROJECTION_MIP => Projection::Mip,
        other => return Err(Failure::argument("projection", format!("{other} is not one of NERTCA_PROJECTION_*"))),
    };
    let exact = match view.quality {
        NERTCA_QUALITY_LIVE => false,
        NERTCA_QUALITY_EXACT => true,
        other => return Err(Failure::argument("quality", format!("{other} is not one of NERTCA_QUALITY_*"))),
    };
    // SAFETY: callers of this function guarantee a matrix that is null or has 12 numbers.
    let geometry = unsafe { view.geometry.geometry() }?;
    let rays = geometry.rays(size.0, size.1).map_err(|(field, problem)| Failure::argument(&field, problem))?;
    let quantity = Quantity { component, projection };
    if !(0.0..1.0).contains(&view.after_phase) {
        let problem = format!("{} is not in the accepted range, 0 to below 1", view.after_phase);
        return Err(Failure::argument("after_phase", problem));
    }
    let phase = f64::from(view.phase) + view.after_phase;
    Ok(CheckedView { rays, size, phase, quantity, exact })
}

/// Draws a view: line integrals, or attenuation per mm.
fn draw(reconstruction: &Reconstruction, checked: &CheckedView) -> Outcome<Vec<f32>> {
    let session = &reconstruction.session;
    let image = if checked.exact {
        session.render_fields(&checked.rays, checked.size, checked.phase)?.show(checked.quantity)
    } else {
        session.render(&checked.rays, checked.size, checked.phase, checked.quantity)?
    };
    let per_mm = if checked.quantity.projection == Projection::Mip { 1.0 / MM_PER_UNIT as f32 } else { 1.0 };
    Ok(image.into_iter().map(|v| v * per_mm).collect())
}

/// Draws a view into the caller's memory: line integrals, or attenuation per mm for a maximum projection. It also works during
/// training, from the current parameters: `NERTCA_QUALITY_LIVE` at display rates, from volumes whose refreshing takes at most a
/// fifth of the time; `NERTCA_QUALITY_EXACT` from the fields themselves.
///
/// Callable from any thread; live pictures of one reconstruction are drawn one after the other. They wait for no long work: exact
/// pictures, `_sample`, `_evaluate` and `_tree` are done in slices of some hundredths of a second, one call after the other, and live
/// pictures pass between slices. During training in another thread a live picture shows the volumes there are, which that thread
/// keeps up to date; `nertca_reconstruction_drawn` tells their age.
///
/// @return NERTCA_ERROR_CANCELLED for an exact picture that `nertca_reconstruction_cancel` ended; NERTCA_ERROR_NOT_READY before
/// anything was trained or loaded; NERTCA_ERROR_ARGUMENT naming what is wrong.
///
/// # Safety
/// `view` and `image` must be as long as their `size` says, and their pointers valid for the stated lengths.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn nertca_reconstruction_render(
    reconstruction: *mut nertca_reconstruction,
    view: *const nertca_view,
    image: *const nertca_image,
) -> nertca_status {
    on_reconstruction(reconstruction, |reconstruction| {
        // SAFETY: the header requires the same of `view` as `checked_view` does.
        let checked = unsafe { checked_view(view) }?;
        // SAFETY: the header requires that `image` is null or as long as its size says.
        let image = unsafe { read(image) }?;
        let (width, height) = checked.size;
        if ![NERTCA_PIXELS_F32, NERTCA_PIXELS_U8].contains(&image.format) {
            return Err(Failure::argument(
                "format",
                format!("{} is neither NERTCA_PIXELS_F32 nor NERTCA_PIXELS_U8", image.format),
            ));
        }
        let bytes = pixel_bytes(image.format)?;
        if image.pixels.is_null() {
            return Err(Failure::argument("pixels", "is null"));
        }
        let apart = stride("pixels", width * bytes, height, image.stride_bytes, image.pixels_bytes)?;
        if !(image.low.is_finite() && image.high.is_finite() && image.low <= image.high) {
            return Err(Failure::argument(
                "low, high",
                format!("{} to {} is not a valid window of intensities", image.low, image.high),
            ));
        }
        let values = draw(reconstruction, &checked)?;
        let rows: Vec<u8> = if image.format == NERTCA_PIXELS_F32 {
            values.iter().flat_map(|v| v.to_ne_bytes()).collect()
        } else {
            let (low, high) = if image.low < image.high {
                (image.low as f32, image.high as f32)
            } else {
                values.iter().fold((f32::MAX, f32::MIN), |(low, high), v| (low.min(*v), high.max(*v)))
            };
            // An image whose pixels all have one value becomes black.
            let scale = if low < high { 255.0 / (high - low) } else { 0.0 };
            values.iter().map(|v| ((v - low) * scale).round() as u8).collect()
        };
        for (row, content) in rows.chunks_exact(width * bytes).enumerate() {
            // SAFETY: `stride` checked that every row lies within the bytes that the caller guarantees.
            unsafe {
                let to = image.pixels.cast::<u8>().add(row * apart);
                std::ptr::copy_nonoverlapping(content.as_ptr(), to, content.len());
            }
        }
        Ok(())
    })
}

/// Draws a view like `nertca_reconstruction_render`, into a buffer of the same context: `width * height` floats, row by row. At
/// live quality the device writes them itself, without a copy; maxima are then per 100 mm (divide by 100). The buffer is
/// complete when the call returns.
///
/// # Safety
/// `view` must be as long as its `size` says.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn nertca_reconstruction_render_buffer(
    reconstruction: *mut nertca_reconstruction,
    view: *const nertca_view,
    buffer: *mut nertca_buffer,
) -> nertca_status {
    on_reconstruction(reconstruction, |reconstruction| {
        // SAFETY: the header requires the same of `view` as `checked_view` does.
        let checked = unsafe { checked_view(view) }?;
        let target = handles::get::<SharedBuffer, _>(buffer)?;
        check_target(reconstruction, &target, checked.size.0 * checked.size.1)?;
        if checked.exact {
            let per_unit = if checked.quantity.projection == Projection::Mip { MM_PER_UNIT as f32 } else { 1.0 };
            let image: Vec<f32> = draw(reconstruction, &checked)?.into_iter().map(|v| v * per_unit).collect();
            return Ok(reconstruction.claim.context.device()?.upload(&target.buffer, 0, &image)?);
        }
        let CheckedView { rays, size, phase, quantity, .. } = &checked;
        Ok(reconstruction.session.render_into(&target.buffer, rays, *size, *phase, *quantity)?)
    })
}

fn check_target(reconstruction: &Reconstruction, target: &SharedBuffer, floats: usize) -> Outcome<()> {
    if !Arc::ptr_eq(&reconstruction.claim.context, &target.claim.context) {
        return Err(Failure::argument("buffer", "belongs to another context"));
    }
    let needed = floats as u64 * 4;
    if target.buffer.bytes() < needed {
        return Err(Failure::argument(
            "buffer",
            format!("has {} bytes where {needed} are needed", target.buffer.bytes()),
        ));
    }
    Ok(())
}

/// # Safety
/// `grid` must be null or as long as its `size` says.
pub(super) unsafe fn grid_of(grid: *const nertca_grid) -> Outcome<(PatientGrid, Component, u32)> {
    // SAFETY: callers of this function guarantee that `grid` is null or as long as its size says.
    let grid = unsafe { read(grid) }?;
    let component = component_of(grid.component)?;
    let patient = PatientGrid {
        origin_mm: DVec3::from_array(grid.origin_mm),
        spacing_mm: DVec3::from_array(grid.spacing_mm),
        size: grid.points,
    };
    patient.check()?;
    if patient.size.iter().map(|n| u64::from(*n)).product::<u64>() > 1 << 30 {
        return Err(Failure::argument("points", "more than 2^30 points in total"));
    }
    Ok((patient, component, grid.phase))
}

/// Returns which field the last live picture showed. Callable from any thread.
///
/// @return NERTCA_ERROR_NOT_READY before the first live picture.
///
/// # Safety
/// `drawn` must be writable, with its size set.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn nertca_reconstruction_drawn(
    reconstruction: *mut nertca_reconstruction,
    drawn: *mut nertca_drawn,
) -> nertca_status {
    on_reconstruction(reconstruction, |reconstruction| {
        let none = || Failure::new(NERTCA_ERROR_NOT_READY, "no live picture was drawn yet");
        let Drawn { frames, step } = reconstruction.session.drawn().ok_or_else(none)?;
        // SAFETY: the header requires that `drawn` is null or as long as its size says.
        unsafe { write(drawn, |size| nertca_drawn { size, frames, step }) }
    })
}

/// Cancels the long calls that are under way on a reconstruction in other threads: `_evaluate`, `_tree`, `_sample` and exact
/// pictures return NERTCA_ERROR_CANCELLED before their next slice. Calls that begin later are not affected, nor is training. Callable
/// from any thread.
#[unsafe(no_mangle)]
pub extern "C" fn nertca_reconstruction_cancel(reconstruction: *mut nertca_reconstruction) -> nertca_status {
    on_reconstruction(reconstruction, |reconstruction| {
        reconstruction.session.cancel();
        Ok(())
    })
}

/// Samples a volume into the caller's memory: attenuation per mm at each point of a grid, left fastest. Values outside the
/// reconstructed region are zero. Callable from any thread, also during training; live pictures pass.
///
/// @return NERTCA_ERROR_CANCELLED when `nertca_reconstruction_cancel` ended the call.
///
/// # Safety
/// `grid` must be as long as its `size` says; `values` must be writable for `count` floats.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn nertca_reconstruction_sample(
    reconstruction: *mut nertca_reconstruction,
    grid: *const nertca_grid,
    values: *mut f32,
    count: usize,
) -> nertca_status {
    on_reconstruction(reconstruction, |reconstruction| {
        // SAFETY: the header requires the same of `grid` as `grid_of` does.
        let (grid, component, phase) = unsafe { grid_of(grid) }?;
        if values.is_null() {
            return Err(Failure::argument("values", "is null"));
        }
        let needed = grid.size.iter().map(|n| *n as usize).product::<usize>();
        if count < needed {
            return Err(Failure::argument("count", format!("is {count} where {needed} are needed")));
        }
        let cells = reconstruction.session.sample(component, phase, &grid)?;
        // SAFETY: the caller guarantees room for `count` numbers, which was checked to be enough; bytes need no alignment.
        unsafe { std::ptr::copy_nonoverlapping(cells.as_ptr().cast::<u8>(), values.cast::<u8>(), 4 * cells.len()) };
        Ok(())
    })
}

/// Samples the fields like `nertca_reconstruction_sample`, into a buffer of the same context.
///
/// # Safety
/// `grid` must be as long as its `size` says.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn nertca_reconstruction_sample_buffer(
    reconstruction: *mut nertca_reconstruction,
    grid: *const nertca_grid,
    buffer: *mut nertca_buffer,
) -> nertca_status {
    on_reconstruction(reconstruction, |reconstruction| {
        // SAFETY: the header requires the same of `grid` as `grid_of` does.
        let (grid, component, phase) = unsafe { grid_of(grid) }?;
        let target = handles::get::<SharedBuffer, _>(buffer)?;
        check_target(reconstruction, &target, grid.size.iter().map(|n| *n as usize).product())?;
        let cells = reconstruction.session.sample(component, phase, &grid)?;
        Ok(reconstruction.claim.context.device()?.upload(&target.buffer, 0, &cells)?)
    })
}

/// Makes a buffer on the device that can be shared through `VK_KHR_external_memory_fd`. `*buffer` is null on failure. Callable
/// from any thread.
///
/// @return NERTCA_ERROR_DEVICE where the device lacks the extension (`external_memory_fd` of `nertca_context_describe`).
///
/// # Safety
/// `buffer` must be writable.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn nertca_buffer_create(
    context: *mut nertca_context,
    bytes: u64,
    buffer: *mut *mut nertca_buffer,
) -> nertca_status {
    on_context(context, |context: &Arc<Context>| {
        if buffer.is_null() {
            return Err(Failure::argument("buffer", "is null"));
        }
        // SAFETY: `buffer` is not null, and the header requires that it can be written.
        unsafe { buffer.write_unaligned(std::ptr::null_mut()) };
        if bytes == 0 || bytes > 1 << 40 {
            return Err(Failure::argument("bytes", format!("{bytes} is not in the accepted range, 1 to 2^40")));
        }
        let (made, memory) = shared_memory::make(context.device()?, bytes)?;
        let shared = SharedBuffer { buffer: made, memory, claim: Claim::new(context), process: std::process::id() };
        let handle = handles::insert(Arc::new(shared))?;
        // SAFETY: `buffer` was checked and written above, and the caller's memory is still valid.
        unsafe { buffer.write_unaligned(std::ptr::without_provenance_mut(handle)) };
        Ok(())
    })
}

/// Returns a new file descriptor of the buffer's memory (`VK_EXTERNAL_MEMORY_HANDLE_TYPE_OPAQUE_FD_BIT`), which the caller must
/// import or close, and the size of the exported buffer in bytes. Callable from any thread.
///
/// # Safety
/// `fd` must be writable; `bytes` must be writable or null.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn nertca_buffer_export_fd(
    buffer: *mut nertca_buffer,
    fd: *mut i32,
    bytes: *mut u64,
) -> nertca_status {
    call(buffer, || {
        let shared = handles::get::<SharedBuffer, _>(buffer)?;
        if fd.is_null() {
            return Err(Failure::argument("fd", "is null"));
        }
        let copy = shared.memory.descriptor()?;
        // SAFETY: `fd` is not null, and the header requires that both can be written unless null.
        unsafe {
            if !bytes.is_null() {
                bytes.write_unaligned(shared.buffer.bytes());
            }
            fd.write_unaligned(copy);
        }
        Ok(())
    })
}

/// Returns the type and the size of the buffer's memory, with which others import it: the index of the type in
/// `VkPhysicalDeviceMemoryProperties`, and the size of the allocation in bytes, at least that of the buffer. A Vulkan device must
/// import the memory with both, with `VkMemoryDedicatedAllocateInfo`, for a buffer of the size of `nertca_buffer_export_fd` with
/// the usages storage buffer, transfer source and transfer destination; CUDA and OpenGL need the size of the allocation. The type
/// may be one that the host cannot read. Callable from any thread.
///
/// # Safety
/// `memory_type` and `bytes` must be writable.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn nertca_buffer_memory(
    buffer: *mut nertca_buffer,
    memory_type: *mut u32,
    bytes: *mut u64,
) -> nertca_status {
    call(buffer, || {
        let shared = handles::get::<SharedBuffer, _>(buffer)?;
        if memory_type.is_null() {
            return Err(Failure::argument("memory_type", "is null"));
        }
        if bytes.is_null() {
            return Err(Failure::argument("bytes", "is null"));
        }
        let (index, allocated) = shared.memory.type_and_bytes();
        // SAFETY: neither is null, and the header requires that both can be written.
        unsafe {
            memory_type.write_unaligned(index);
            bytes.write_unaligned(allocated);
        }
        Ok(())
    })
}

/// Destroys a buffer; memory that others imported stays valid for them. Null is allowed, and does nothing. Waits for calls on
/// the buffer in other threads.
#[unsafe(no_mangle)]
pub extern "C" fn nertca_buffer_destroy(buffer: *mut nertca_buffer) -> nertca_status {
    if buffer.is_null() {
        return NERTCA_OK;
    }
    call(buffer, || {
        if handles::is_active(buffer) {
            return Err(Failure::new(
                super::status::NERTCA_ERROR_BUSY,
                "buffer: it is in use by a call in this thread",
            ));
        }
        handles::remove::<SharedBuffer, _>(buffer).map(drop)
    })
}
