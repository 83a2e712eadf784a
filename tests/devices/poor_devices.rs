//! Devices that offer only what Vulkan 1.2 requires: no extensions, no timestamps, minimum limits. The driver is real, and
//! a loader in between hides its features.

use crate::common;
use crate::common::{expect_agreement, expect_silence, run, small_config, small_dataset, tuning};
use crate::shim;
use crate::shim::Poor;
use ash::vk;
use nertca_vk::bench::peaks::peaks;
use nertca_vk::config::Preset;
use nertca_vk::error::Error;
use nertca_vk::gaussians::particles::Particles;
use nertca_vk::gpu::device::{Adoption, DeviceOptions, Gpu};
use nertca_vk::gpu::record::{Groups, Recording};
use nertca_vk::kernels::dispatch::{Binding, dispatch};
use nertca_vk::kernels::push;
use nertca_vk::kernels::stages::{Build, Stage};
use nertca_vk::kernels::tuning::Tuning;
use nertca_vk::methods::dynamic_gaussians::deformable::DeformableTrainer;
use nertca_vk::plan::Plan;
use nertca_vk::render::renderer::Renderer;
use nertca_vk::scan::small;
use nertca_vk::train::trainer::Trainer;
use nertca_vk_twins::selftest::dynamic_gaussians as deformable;
use nertca_vk_twins::selftest::sax_nerf as sax;
use nertca_vk_twins::selftest::{drawing, gaussians, problems, repeats};

/// Minimum requirements of Vulkan 1.2, except for the storage buffers of a kernel.
const LEAST: Poor = Poor {
    extensions: false,
    features: false,
    timestamps: false,
    limits: |limits| {
        limits.max_compute_work_group_invocations = 128;
        limits.max_compute_work_group_count = [65_535; 3];
        limits.max_compute_shared_memory_size = 16 << 10;
        limits.max_push_constants_size = 128;
        limits.max_storage_buffer_range = 1 << 27;
        limits.max_texel_buffer_elements = 1 << 16;
    },
    free_memory: None,
};

fn open(poor: Poor) -> Result<Gpu, Error> {
    shim::impoverish(poor);
    let loader = Some(shim::loader());
    Ok(Gpu::open(&DeviceOptions { loader, validation: true, ..DeviceOptions::default() })?)
}

#[test]
fn the_least_of_devices_computes_what_others_do() {
    let gpu = open(LEAST).unwrap();
    let info = gpu.info();
    assert!(info.full_subgroups.is_none() && info.matrices.is_empty() && !info.buffer_device_address);
    assert_eq!((info.timestamp_bits, info.max_workgroup_invocations), (0, 128));
    let dataset = small_dataset(13, 11);
    let path = Tuning::for_device(info);
    expect_agreement(|findings| gaussians::compare(&gpu, findings));
    expect_agreement(|findings| deformable::compare(&gpu, findings));
    expect_agreement(|findings| repeats::compare_network(&gpu, &dataset, &path, findings));
    expect_agreement(|findings| drawing::compare_views(&gpu, Preset::FastMlp, &path, findings));
    // Passes are not timed, and peaks are timed by the host.
    let config = small_config("fast-mlp", &[]);
    let mut trainer = Trainer::new(&gpu, Plan::new(&config, &dataset).unwrap(), &dataset, path).unwrap();
    assert!(trainer.profile_step().unwrap().is_empty());
    let peaks = peaks(&gpu).unwrap();
    assert!(!peaks.by_timestamps && peaks.f32_tflops > 0.0 && peaks.copy_gb_per_s > 0.0);
    drop(trainer);
    expect_silence(gpu);
}

/// A device with all features, whose buffers have at most `MAX_BUFFER` bytes.
const SMALL_BUFFERS: Poor = Poor {
    extensions: true,
    features: true,
    timestamps: true,
    limits: |limits| limits.max_storage_buffer_range = MAX_BUFFER,
    free_memory: None,
};
const MAX_BUFFER: u32 = 256 << 10;
/// Side of images, of which such a buffer holds sixteen.
const SIDE: usize = 64;

#[test]
fn images_larger_than_a_buffer_are_fitted_alike() {
    const ITERATIONS: u32 = 44;
    let targets = problems::targets(SIDE, SIDE, 10).unwrap();
    assert!(targets.n_images > 16, "{} images", targets.n_images);
    let rows = problems::random_gaussians(60, 1, 20.0, 4);
    // The background is renewed after 40 iterations.
    let config = problems::default_rules().unwrap();
    let fitted = |gpu: &Gpu| {
        let particles = Particles::fresh(rows.clone());
        let mut trainer = DeformableTrainer::with(gpu, targets.clone(), &config, &particles).unwrap();
        let mut losses = Vec::new();
        while trainer.step() < ITERATIONS {
            losses.extend(trainer.advance(ITERATIONS).unwrap());
        }
        (losses, trainer.deformable().unwrap(), trainer.images().unwrap())
    };
    let whole = fitted(&common::gpu());
    let gpu = open(SMALL_BUFFERS).unwrap();
    assert_eq!(gpu.info().max_storage_buffer_range, MAX_BUFFER);
    let parts = fitted(&gpu);
    assert_eq!(parts.0, whole.0, "losses");
    assert_eq!(parts.1, whole.1, "the deformable set");
    assert_eq!(parts.2, whole.2, "its images");
    expect_silence(gpu);
}

#[test]
fn rays_of_images_larger_than_a_buffer_are_drawn_alike() {
    const STEPS: u32 = 8;
    // Seventeen images: a buffer holds all but one.
    let dataset = small::small_dataset(SIDE, SIDE, 6).unwrap();
    assert!(dataset.training().len() > 16, "{} images", dataset.training().len());
    let config = small_config("fast-mlp", &["occupancy.enabled=false"]);
    let trained = |gpu: &Gpu| {
        let plan = Plan::new(&config, &dataset).unwrap();
        let mut trainer = Trainer::new(gpu, plan, &dataset, tuning(gpu)).unwrap();
        while trainer.step() < STEPS {
            trainer.advance(STEPS).unwrap();
        }
        trainer.checkpoint().unwrap().model.params
    };
    let whole = trained(&common::gpu());
    let gpu = open(SMALL_BUFFERS).unwrap();
    assert_eq!(trained(&gpu), whole);
    expect_silence(gpu);
}

#[test]
fn what_cannot_be_done_without_is_said() {
    let few = Poor { limits: |limits| limits.max_per_stage_descriptor_storage_buffers = 4, ..LEAST };
    let gpu = open(few).unwrap();
    let dataset = small_dataset(13, 11);
    let plan = Plan::new(&small_config("fast-mlp", &[]), &dataset).unwrap();
    let Err(Error::NoDevice(why)) = Trainer::new(&gpu, plan, &dataset, Tuning::for_device(gpu.info())) else {
        panic!("kernels bind more than four")
    };
    assert!(why.contains("storage buffers, but the device allows 4"), "{why}");
}

/// Adopts a device created from `poor` with only timeline semaphores, which claims to have features.
fn adopt(poor: Poor, subgroup_size_control: bool, cooperative_matrix: bool) -> Result<(), Error> {
    shim::impoverish(poor);
    let entry = shim::entry();
    let application = vk::ApplicationInfo::default().api_version(vk::API_VERSION_1_2);
    let queues = [vk::DeviceQueueCreateInfo::default().queue_priorities(&[1.0])];
    let mut features = vk::PhysicalDeviceVulkan12Features::default().timeline_semaphore(true);
    let instance = vk::InstanceCreateInfo::default().application_info(&application);
    let device = vk::DeviceCreateInfo::default().queue_create_infos(&queues).push_next(&mut features);
    // SAFETY: the create infos live until the calls return; device and instance are destroyed last, and once.
    unsafe {
        let instance = entry.create_instance(&instance, None).unwrap();
        let physical_device = instance.enumerate_physical_devices().unwrap()[0];
        let device = instance.create_device(physical_device, &device, None).unwrap();
        let adoption = Adoption {
            get_instance_proc_addr: Some(entry.static_fn().get_instance_proc_addr),
            instance: instance.handle(),
            physical_device,
            device: device.handle(),
            queue: device.get_device_queue(0, 0),
            queue_family: 0,
            buffer_device_address: false,
            external_memory_fd: false,
            external_semaphore_fd: false,
            subgroup_size_control,
            cooperative_matrix,
            queue_lock: None,
        };
        let adopted = Gpu::adopt(adoption, &DeviceOptions::default()).map(drop);
        device.destroy_device(None);
        instance.destroy_instance(None);
        Ok(adopted?)
    }
}

#[test]
fn features_that_a_device_cannot_have_been_made_with_are_refused() {
    adopt(LEAST, false, false).unwrap();
    let refused = |poor, claims: (bool, bool)| match adopt(poor, claims.0, claims.1) {
        Err(Error::Config { field, problem, .. }) => format!("{field}: {problem}"),
        other => panic!("{other:?}"),
    };
    let said = refused(LEAST, (true, false));
    assert!(said.starts_with("subgroup_size_control: ") && said.contains("subgroupSizeControl, comp"), "{said}");
    // Devices that lack one of the features needed for matrices, or several.
    let said = refused(Poor { extensions: true, ..LEAST }, (true, true));
    assert!(said.starts_with("cooperative_matrix: ") && said.contains("shaderFloat16"), "{said}");
    let said = refused(LEAST, (false, true));
    assert!(said.contains("needs subgroup_size_control"), "{said}");
}

#[test]
fn memory_that_others_hold_is_told_before_a_fit_takes_any() {
    let free = 8 << 20;
    let taken = Poor { extensions: true, features: true, timestamps: true, limits: |_| (), free_memory: Some(free) };
    let gpu = open(taken).unwrap();
    let info = gpu.info();
    let Some(told) = info.free_memory else {
        assert!(info.mesa_major.is_none_or(|version| version < 24), "newer lavapipe tells of its memory's budget");
        println!("{} does not tell how much of its memory is free: nothing was tried", info.name);
        return;
    };
    assert_eq!((told, gpu.memory().free), (free, Some(free)));
    let dataset = small_dataset(13, 11);
    let begin = |settings: &[&str]| {
        let plan = Plan::new(&sax::small_config(settings).unwrap().into_any(), &dataset).unwrap();
        Trainer::new(&gpu, plan, &dataset, Tuning::for_device(gpu.info())).map(|_| ())
    };
    let error = begin(&["sax.num_levels=8", "sax.base_resolution=16", "sax.log2_hashmap_size=16"]).unwrap_err();
    assert!(matches!(error, Error::OutOfMemory { may_pass: true, .. }), "{error}");
    let (text, whole) =
        (error.to_string(), format!("{} MiB, of which 8 MiB are currently free", info.device_memory >> 20));
    assert!(text.contains("3 fields") && text.contains(&whole) && text.contains("sax.log2_hashmap_size"), "{text}");
    begin(&[]).unwrap();
    expect_silence(gpu);
}

#[test]
fn more_workgroups_than_an_axis_takes_lie_along_two() {
    let gpu = open(LEAST).unwrap();
    let n = 70_001u32;
    // One invocation per workgroup gives many workgroups for few values.
    let stage: Stage<push::GaussianPicture> = Build { lanes: Some(1), ..Build::default() }.stage(&gpu).unwrap();
    let sums: Vec<i32> = (0..n as i32).collect();
    let splat_images = gpu.buffer_with("sums", &sums).unwrap();
    let image = gpu.buffer_with("image", &vec![-1f32; n as usize + 8]).unwrap();
    let bound = [(Binding::splat_images, (&splat_images).into()), (Binding::image, (&image).into())];
    let push = push::GaussianPicture { n_pixels: n, unit: 0.5, in_front: 0 };
    let mut recording = Recording::new(&gpu, "large picture").unwrap();
    dispatch(&mut recording, &stage, stage.groups_over(n), &bound, push).unwrap();
    gpu.wait(recording.finish().unwrap().submit().unwrap()).unwrap();
    let seen: Vec<f32> = gpu.download(&image, 0, n as usize + 8).unwrap();
    let wanted = |i: usize| if i < n as usize { 0.5 * i as f32 } else { -1.0 };
    assert!(seen.iter().enumerate().all(|(i, v)| *v == wanted(i)));
    // Along one axis they are refused before the driver receives them.
    let mut recording = Recording::new(&gpu, "too large").unwrap();
    let refused = dispatch(&mut recording, &stage, Groups::Direct([n, 1, 1]), &bound, push).unwrap_err();
    assert!(refused.to_string().contains("70001 x 1 x 1 workgroups"), "{refused}");
    drop((recording, stage, splat_images, image));
    expect_silence(gpu);
}

#[test]
fn short_submits_change_nothing_but_their_length() {
    let gpu = common::gpu();
    let dataset = small_dataset(13, 11);
    let config = small_config("fast-mlp", &["train.iterations_per_submit=4", "train.iterations=24"]);
    let train = |longest_submit_s: Option<f64>| {
        let path = Tuning { longest_submit_s, ..tuning(&gpu) };
        let mut trainer = Trainer::new(&gpu, Plan::new(&config, &dataset).unwrap(), &dataset, path.clone()).unwrap();
        // One call returns as many losses as a submit had iterations.
        let at_once: Vec<usize> = (0..5).map(|_| trainer.advance(20).unwrap().len()).collect();
        let losses = run(&mut trainer, 24);
        let model = trainer.model().unwrap();
        let renderer = Renderer::new(&gpu, &model, path).unwrap();
        let view = &dataset.views[0];
        let seen = renderer.render(&view.rays, 13, 11, 1).unwrap().total_integral();
        (at_once, losses.len(), model.params, seen)
    };
    let (at_once, n, params, seen) = train(None);
    assert_eq!((at_once, n), (vec![4; 5], 4));
    let (at_once, n, again, same) = train(Some(0.0));
    assert_eq!((at_once, n), (vec![1; 5], 19), "a device that takes longer than it may for one gets one");
    assert_eq!((again, same), (params.clone(), seen.clone()));
    let (at_once, n, again, same) = train(Some(1e9));
    assert_eq!((at_once, n), (vec![1, 1, 1, 4, 4], 13), "three are tried, then there is time for all");
    assert_eq!((&again, &same), (&params, &seen));
    // With an observer, the number of iterations per submit depends on the device's speed, but the results do not.
    gpu.looks().note();
    let (_, _, again, same) = train(Some(1e9));
    assert_eq!((again, same), (params, seen));
    expect_silence(gpu);
}
