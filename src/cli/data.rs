//! `phantom` and `project`.

use super::args::{Cli, LayoutArg, PhantomArgs, ProjectArgs};
use indicatif::{ProgressBar, ProgressStyle};
use nertca_vk::data::dataset::Layout;
use nertca_vk::data::volume::VolumeHints;
use nertca_vk::error::Result;
use nertca_vk::phantom::dataset::{Anatomy, CArmOptions, PhantomOptions, VolumeOptions, make, project_volumes};

impl From<LayoutArg> for Layout {
    fn from(layout: LayoutArg) -> Layout {
        match layout {
            LayoutArg::Native => Layout::Native,
            LayoutArg::Nerfca => Layout::Nerfca,
        }
    }
}

fn bar() -> impl FnMut(&str, u64, u64) {
    let bar = ProgressBar::new(1);
    if let Ok(style) = ProgressStyle::with_template("{msg:12} [{bar:30}] {pos}/{len} {elapsed}") {
        bar.set_style(style);
    }
    move |what, done, total| {
        bar.set_message(what.to_owned());
        bar.set_length(total);
        bar.set_position(done);
    }
}

/// Makes a phantom.
pub fn phantom(cli: &Cli, args: &PhantomArgs) -> Result<()> {
    let gpu = cli.open_device()?;
    let options = PhantomOptions {
        setting: args.geometry,
        size: args.size,
        phases: args.phases,
        views: args.views,
        seed: args.seed,
        photons: args.photons,
        respiration_mm: args.respiration,
        layout: args.layout.into(),
        anatomy: args.tree.as_ref().map(|tree| Anatomy {
            tree: tree.clone(),
            background: args.background.clone(),
            c_arm: CArmOptions { sod_mm: args.sod, sid_mm: args.sid, field_mm: args.fov },
            iodine_per_mm: args.iodine,
        }),
        volumes: !args.no_volumes,
    };
    make(&gpu, &options, &args.out, bar())?;
    out!("{}", args.out.display());
    cli.close_device(&gpu)
}

/// Projects volumes.
pub fn project(cli: &Cli, args: &ProjectArgs) -> Result<()> {
    let gpu = cli.open_device()?;
    let options = VolumeOptions {
        volumes: args.volumes.clone(),
        hints: VolumeHints {
            spacing_mm: args.spacing,
            size: args.raw_size,
            raw_type: args.raw_type.clone(),
            centre: args.centre,
        },
        hounsfield: args.hounsfield,
        scale: args.scale,
        vessel_per_mm: args.vessel,
        c_arm: CArmOptions { sod_mm: args.sod, sid_mm: args.sid, field_mm: args.fov },
        size: args.size,
        views: args.views,
        layout: args.layout.into(),
    };
    project_volumes(&gpu, &options, &args.out, bar())?;
    out!("{}", args.out.display());
    cli.close_device(&gpu)
}
