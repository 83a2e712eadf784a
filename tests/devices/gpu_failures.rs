//! Every Vulkan call that can fail is made to fail, one after the other, in a session that uses each kind of device object:
//! the result is an error that names the call, and no objects are left.

use crate::shim;
use crate::shim::{Failing, Outcome};
use ash::vk;
use nertca_vk::error::{Error, Result};
use nertca_vk::gpu::buffer::{Buffer, Memory, Operands};
use nertca_vk::gpu::device::{DeviceOptions, Gpu};
use nertca_vk::gpu::image::Image3d;
use nertca_vk::gpu::pipeline::{BindingKind, KernelCode, Pipeline};
use nertca_vk::gpu::record::{Bound, Groups, Recording};
use nertca_vk::kernels::cache::save_pipeline_cache;
use nertca_vk::kernels::stages::kernel_code;
use std::path::Path;
use std::sync::{Arc, Mutex, PoisonError};
use tracing::field::{Field, Visit};
use tracing::{Event, Metadata, Subscriber};

/// Kernels with all kinds of bindings, recorded without a workgroup, because only their objects matter.
const IDLE_KERNELS: [&str; 3] = ["mlp_out_fwd_texel", "mlp_layer_fwd_address", "baked_march"];

/// Device objects of every kind.
struct Objects {
    numbers: Buffer,
    texels: Buffer,
    addressed: Buffer,
    image: Image3d,
}

/// Records a kernel with as many zero `push` bytes as it needs.
fn record_idle(
    recording: &mut Recording,
    pipeline: &Arc<Pipeline>,
    code: &KernelCode,
    objects: &Objects,
) -> Result<()> {
    let given: Vec<(&str, Bound<'_>)> = code
        .bindings
        .iter()
        .map(|b| {
            let bound = match b.kind {
                BindingKind::Storage | BindingKind::Uniform => Bound::Buffer(&objects.addressed),
                BindingKind::Texel => Bound::Buffer(&objects.texels),
                BindingKind::Volume => Bound::Image(&objects.image),
            };
            (b.name, bound)
        })
        .collect();
    let none = || Groups::Direct([0, 1, 1]);
    macro_rules! with_words {
        ($($words:literal)*) => {
            match code.push_bytes / 4 {
                $($words => Ok(recording.dispatch(pipeline, none(), &given, &[0u32; $words])?),)*
                more => panic!("{more} words of push constants"),
            }
        };
    }
    with_words!(0 1 2 3 4 5 6 7 8 9 10 11 12 13 14 15 16 17 18 19 20 21 22 23 24 25 26 27 28)
}

/// Number of waits whose failure [`use_device`] reports: those of the upload, of its own submit and of the download.
const TELLING_WAITS: usize = 3;

/// Uses every kind of device object, and destroys all of them.
fn use_device(gpu: &Gpu) -> Result<()> {
    let numbers: Vec<u32> = (0..64).collect();
    let info = gpu.info();
    let objects = Objects {
        numbers: gpu.buffer_with("numbers", &numbers)?,
        texels: gpu.operand_buffer("texels", 256, Operands::Texel)?,
        addressed: gpu.operand_buffer("addressed", 512, Operands::Address)?,
        image: gpu.image_3d("image", [4, 3, 2])?,
    };
    drop(objects.image.fill(&[half::f16::ONE; 24])?);
    if info.external_memory_fd {
        drop(gpu.exported_buffer("exported", 256)?);
    }
    if info.external_semaphore_fd {
        gpu.wait(gpu.exported_semaphore()?.signal()?)?;
    }
    if let Some(shape) = info.matrices.first() {
        let spec = [("m", shape.m), ("n", shape.n), ("k", shape.k), ("subgroups", 1)];
        drop(gpu.matrix_pipeline(kernel_code("peak_matrix")?, info.subgroup_size, &spec)?);
    }
    let copy = gpu.pipeline(kernel_code("peak_copy")?, 64, &[])?;
    let copied = gpu.buffer("copied", 256, Memory::Device)?;
    let mut recording = Recording::timed(gpu, "session", 8)?;
    let given = [("from", Bound::Buffer(&objects.numbers)), ("to", Bound::Buffer(&copied))];
    recording.dispatch(&copy, Groups::Direct([1, 1, 1]), &given, &16u32)?;
    for name in IDLE_KERNELS {
        let code = kernel_code(name)?;
        record_idle(&mut recording, &gpu.pipeline(code, 32, &[])?, code, &objects)?;
    }
    let commands = recording.finish()?;
    gpu.wait(commands.submit()?)?;
    assert_eq!(commands.pass_times()?.len(), 1 + IDLE_KERNELS.len());
    assert_eq!(gpu.download::<u32>(&copied, 0, 64)?, numbers);
    save_pipeline_cache(gpu)
}

/// Runs a session on its own device; `cache` is the directory of its pipelines.
fn session(cache: &Path) -> Result<()> {
    let options = DeviceOptions {
        validation: true,
        cache_dir: Some(cache.to_path_buf()),
        loader: Some(shim::loader()),
        ..DeviceOptions::default()
    };
    let gpu = Gpu::open(&options)?;
    let outcome = use_device(&gpu);
    assert_eq!((gpu.live_objects(), gpu.memory_in_use()), (0, 0), "objects and bytes after {outcome:?}");
    outcome
}

/// Messages of the validation layer, including those during the destruction of the device.
#[derive(Clone, Default)]
struct Heard(Arc<Mutex<Vec<String>>>);

struct Text(String);

impl Visit for Text {
    fn record_debug(&mut self, _: &Field, value: &dyn std::fmt::Debug) {
        self.0 += &format!("{value:?} ");
    }
}

impl Subscriber for Heard {
    fn enabled(&self, metadata: &Metadata<'_>) -> bool {
        metadata.is_event() && metadata.target() == "vulkan"
    }

    fn new_span(&self, _: &tracing::span::Attributes<'_>) -> tracing::span::Id {
        tracing::span::Id::from_u64(1)
    }

    fn record(&self, _: &tracing::span::Id, _: &tracing::span::Record<'_>) {}

    fn record_follows_from(&self, _: &tracing::span::Id, _: &tracing::span::Id) {}

    fn event(&self, event: &Event<'_>) {
        let mut text = Text(String::new());
        event.record(&mut text);
        self.0.lock().unwrap_or_else(PoisonError::into_inner).push(text.0);
    }

    fn enter(&self, _: &tracing::span::Id) {}

    fn exit(&self, _: &tracing::span::Id) {}
}

/// Runs a session in which calls fail; returns its result, the remaining objects and the messages.
fn run(cache: &Path, heard: &Heard, failing: Failing) -> (Result<()>, Outcome, Vec<String>) {
    shim::begin(failing);
    let outcome = session(cache);
    let seen = shim::end();
    let mut faults = std::mem::take(&mut *heard.0.lock().unwrap_or_else(PoisonError::into_inner));
    faults.extend(seen.left.iter().map(|(kind, n)| format!("{n} {kind} left")));
    (outcome, seen, faults)
}

/// Tells whether an error names the call that failed, or is an error of the allocator or of the device selection, which
/// have their own texts.
fn tells(error: &Error, call: &str) -> bool {
    let text = error.to_string();
    match call {
        "vkAllocateMemory" | "vkMapMemory" if matches!(error, Error::OutOfMemory { .. }) => true,
        "vkEnumerateDeviceExtensionProperties" | "vkGetPhysicalDeviceCooperativeMatrixPropertiesKHR" => {
            matches!(error, Error::NoDevice(_)) && text.contains(call)
        }
        _ => text.contains(call) || matches!(error, Error::DeviceLost { .. }),
    }
}

#[test]
fn nothing_is_left_when_a_call_fails() {
    let (cache, heard) = (tempfile::tempdir().unwrap(), Heard::default());
    let _listening = tracing::subscriber::set_default(heard.clone());
    let mut calls = 0;
    // The first session compiles its pipelines; with the cache, all following sessions are equal.
    for _ in 0..2 {
        let (outcome, seen, faults) = run(cache.path(), &heard, Failing::None);
        outcome.unwrap();
        assert_eq!(faults, Vec::<String>::new());
        calls = seen.calls;
    }
    println!("{calls} calls can fail");
    assert!(calls > 80, "{calls} calls");
    let (mut faults, mut told_waits) = (Vec::new(), 0);
    for n in 1..=calls {
        for failing in [
            Failing::Once(n, vk::Result::ERROR_OUT_OF_DEVICE_MEMORY),
            Failing::Once(n, vk::Result::ERROR_INITIALIZATION_FAILED),
            Failing::From(n, vk::Result::ERROR_DEVICE_LOST),
        ] {
            let (outcome, seen, found) = run(cache.path(), &heard, failing);
            let call = seen.failed[0];
            faults.extend(found.into_iter().map(|fault| format!("{call}, {failing:?}: {fault}")));
            match outcome {
                Err(error) if tells(&error, call) => {
                    told_waits += usize::from(call == "vkWaitSemaphores" && matches!(failing, Failing::Once(..)));
                }
                Err(error) => faults.push(format!("{call}, {failing:?}: {error}")),
                // The allocator tries another memory type where one is full.
                Ok(()) if ["vkAllocateMemory", "vkMapMemory"].contains(&call) => {}
                // Destructors wait once more and cannot report an error.
                Ok(()) if call == "vkWaitSemaphores" => {}
                Ok(()) => faults.push(format!("{call}, {failing:?}: no error")),
            }
        }
    }
    assert!(faults.is_empty(), "{}", faults.join("\n"));
    assert_eq!(told_waits, 2 * TELLING_WAITS, "failed waits, for two codes each");
}

#[test]
fn memory_that_could_not_be_bound_is_used_again() {
    shim::begin(Failing::None);
    // Limits memory blocks to a few MiB.
    let options =
        DeviceOptions { memory_limit: Some(64 << 20), loader: Some(shim::loader()), ..DeviceOptions::default() };
    let gpu = Gpu::open(&options).unwrap();
    for (function, what) in [("vkBindBufferMemory", "buffers"), ("vkBindImageMemory", "images")] {
        shim::fail(Failing::Every(function, vk::Result::ERROR_OUT_OF_DEVICE_MEMORY));
        for _ in 0..20 {
            let error = match what {
                "buffers" => gpu.buffer("buffer", 1 << 20, Memory::Device).err(),
                _ => gpu.image_3d("image", [128, 128, 32]).err(),
            };
            assert!(error.unwrap().to_string().contains(function));
        }
        assert!(shim::pieces_of_memory() <= 2, "{} blocks for {what} of 1 MiB", shim::pieces_of_memory());
        assert_eq!((gpu.live_objects(), gpu.memory_in_use()), (0, 0));
    }
    drop(gpu);
    assert!(shim::end().left.is_empty());
}
