//! The commands `export` and `convert`.

use crate::args::options::{GlobalOptions, choice};
use crate::command::data::bar;
use crate::output::{Earlier, KeptReferences, numbers_of_checkpoint, random_numbers, write_dataset};
use clap::Args;
use nertca_vk::checkpoint::newest_model;
use nertca_vk::choice::Choice;
use nertca_vk::error::{Error, Result};
use nertca_vk::export::motion::{MotionExport, MotionFormat, moving_set, write_trajectories};
use nertca_vk::export::segmentation::{self, Segmentation, SegmentationSeeds};
use nertca_vk::export::splats::write_splats;
use nertca_vk::export::surfaces::{MeshFormat, write_meshes};
use nertca_vk::export::volumes::{Compression, Format, VolumeExport, grid_over};
use nertca_vk::files;
use nertca_vk::formats::nrrd::Encoding;
use nertca_vk::model::Model;
use nertca_vk::model::component::Component;
use nertca_vk::render::grid::PatientGrid;
use nertca_vk::render::renderer::Renderer;
use nertca_vk::scan::dataset::{Dataset, Layout};
use nertca_vk::scan::writer::convert as convert_dataset;
use nertca_vk_vessels::vessels::threshold::vessel_threshold_per_mm;
use std::path::{Path, PathBuf};

/// Arguments of `export`.
#[derive(Debug, Args)]
pub struct ExportArgs {
    /// Run directory or checkpoint file.
    pub run: PathBuf,
    /// Field to export: both, the static background or the dynamic vessels.
    #[arg(long, value_parser = choice::<Component>(), default_value = Component::Dynamic.name())]
    pub component: Component,
    /// Phase from 0, or `all`: as a fourth axis, or one file per phase.
    #[arg(long, default_value = "all")]
    pub phase: String,
    /// Distance between points, mm.
    #[arg(long, default_value_t = 0.5, value_name = "MM")]
    pub spacing: f64,
    /// Format; determined by the extension of --out if not given.
    #[arg(long, value_parser = choice::<Format>())]
    pub format: Option<Format>,
    /// Compress the values of an .nrrd (a .nii.gz is compressed by its name).
    #[arg(long, conflicts_with = "mesh")]
    pub compress: bool,
    /// Export surfaces of the vessels instead of volumes: --out ends in .stl, .ply, .obj (one file per phase) or .glb
    /// (animated).
    #[arg(long, conflicts_with = "format")]
    pub mesh: bool,
    /// Attenuation of the surface, or from which on a voxel of a segmentation is vessel, 1/mm; by default the Dice threshold.
    #[arg(long, value_name = "PER_MM")]
    pub iso: Option<f64>,
    /// Export motion instead of volumes: displacements from the reference phase (mostly 0) at the nodes of the motion
    /// grid, mm, for one deformable set of Gaussians (gaussians.form = "deformable"); --out ends in .nrrd or .vtk. Motion
    /// along a vessel is not observed in projections: displacements along vessels come from the smoothness of the
    /// motion only, and no strain can be derived from them.
    #[arg(long, conflicts_with_all = ["mesh", "format", "component", "spacing"])]
    pub motion: bool,
    /// With --motion: write the path of each Gaussian over the beat, including its own motion, as lines in a .vtk.
    #[arg(long, requires = "motion", conflicts_with_all = ["compress", "phase"])]
    pub trajectories: bool,
    /// Export the Gaussians of the dynamic field for splat viewers (SuperSplat, gsplat and others): --out ends in .ply, one file per
    /// phase, LPS mm. Opacity is the density as a share of that of the vessels.
    #[arg(long, conflicts_with_all = ["mesh", "motion", "format", "component", "spacing", "compress"])]
    pub splats: bool,
    /// Export the vessels as DICOM segmentations: --out ends in .dcm, one file per phase, all in one series and one frame of reference,
    /// without names, dates and references to the source runs.
    #[arg(long, conflicts_with_all = ["mesh", "motion", "splats", "format", "compress"])]
    pub segmentation: bool,
    /// Replace the files of an earlier series (`NAME_0000.EXT` and so on), all of them.
    #[arg(short, long)]
    pub force: bool,
    /// Output: .nrrd (.seq.nrrd for 3D Slicer's sequences), .nii, .nii.gz, .mha, .npy or .vtk; .ply with --splats, .dcm with --segmentation.
    #[arg(short, long, value_name = "FILE")]
    pub out: PathBuf,
}

/// Arguments of `convert`.
#[derive(Debug, Args)]
pub struct ConvertArgs {
    /// Dataset directory in either layout.
    pub data: PathBuf,
    /// Layout to write: `native` (`dataset.json`), or `nerfca`, the layout of the NeRF-CA and NerT-CA authors.
    #[arg(long, value_parser = choice::<Layout>())]
    pub layout: Layout,
    /// Directory to write.
    #[arg(short, long)]
    pub out: PathBuf,
    /// Replace a dataset that the directory already contains.
    #[arg(short, long)]
    pub force: bool,
    /// Keep the references to the runs that `import dicom --keep-references` has written, which name the patient.
    #[arg(long)]
    pub keep_references: bool,
}

/// Returns the phases of a model that `--phase` names, and whether they are a sequence: all phases of an object that moves.
pub fn phases(text: &str, model: &Model) -> Result<(Vec<u32>, bool)> {
    let n_phases = model.shown_phases();
    match text {
        "all" => Ok(((0..n_phases).collect(), !model.scene.still)),
        text => match text.parse() {
            Ok(phase) if phase < n_phases => Ok((vec![phase], false)),
            _ => {
                Err(Error::config("--phase", text, format!("is neither `all` nor a phase from 0 to {}", n_phases - 1)))
            }
        },
    }
}

/// Exports volumes or surfaces.
pub fn export(global: &GlobalOptions, args: &ExportArgs) -> Result<()> {
    let model = newest_model(&args.run)?;
    let (phases, all) = phases(&args.phase, &model)?;
    if args.motion {
        return export_motion(args, &model, phases, all);
    }
    if args.splats {
        return export_splats(args, &model, &phases);
    }
    let of_vessels = args.mesh || args.segmentation;
    if of_vessels && args.component.has_static() {
        let problem = "surfaces and segmentations are made of the dynamic field only: use --component dynamic";
        return Err(Error::config("--component", args.component.name(), problem));
    }
    if args.iso.is_some() && !of_vessels {
        let problem = "is the threshold of surfaces and segmentations: add --mesh or --segmentation";
        return Err(Error::config("--iso", args.iso.unwrap_or_default(), problem));
    }
    let unknown = |known: &str| Error::config("--out", args.out.display(), format!("does not end in one of {known}"));
    let grid = grid_over(&model.scene, args.component, args.spacing)?;
    let gpu = global.open_device()?;
    let renderer = Renderer::new(&gpu, &model, global.tuning(&gpu, &model.config))?;
    let mut progress = bar();
    let made = if args.segmentation {
        write_segmentations(args, (&renderer, &model), &grid, &phases, &mut progress)?
    } else if args.mesh {
        let format = MeshFormat::of(&args.out).ok_or_else(|| unknown(".stl .ply .obj .glb"))?;
        let earlier = earlier(args, phases.len() > 1 && format != MeshFormat::Glb)?;
        let iso = match args.iso {
            Some(iso) => iso,
            None => vessel_threshold_per_mm(&renderer, &model, &grid)?,
        };
        let made =
            write_meshes(&renderer, &grid, &phases, iso, format, &args.out, |n, of| progress("surfaces", n, of))?;
        earlier.make_way(&made)?;
        made
    } else {
        let of_name = Format::of(&args.out);
        let format = args.format.or(of_name.map(|(format, _)| format));
        let compressed = args.compress || args.out.extension().is_some_and(|end| end.eq_ignore_ascii_case("gz"));
        let export = VolumeExport {
            grid,
            component: args.component,
            // The static background is the same at every phase.
            sequence: all && args.component.has_dynamic(),
            phases: if args.component.has_dynamic() { phases } else { vec![0] },
            format: format.ok_or_else(|| no_volume(&args.out))?,
            compression: if compressed { Compression::Gzip } else { Compression::None },
        };
        let earlier = earlier(args, export.format == Format::Vtk && export.sequence)?;
        let made = export.write(&renderer, &args.out, |n, of| progress("volume", n, of))?;
        earlier.make_way(&made)?;
        made
    };
    made.iter().for_each(|path| out!("{}", path.display()));
    let [nx, ny, nz] = grid.size;
    let o = grid.origin_mm;
    eprintln!(
        "{nx} x {ny} x {nz} points (left, posterior, superior), {} mm apart, the first at ({:.2}, {:.2}, {:.2}) mm LPS",
        args.spacing, o.x, o.y, o.z
    );
    drop(renderer);
    global.close_device(&gpu)
}

/// Writes the vessels of phases as DICOM segmentations; returns the files.
fn write_segmentations(
    args: &ExportArgs,
    (renderer, model): (&Renderer, &Model),
    grid: &PatientGrid,
    phases: &[u32],
    progress: &mut impl FnMut(&str, u64, u64),
) -> Result<Vec<PathBuf>> {
    if !args.out.extension().is_some_and(|end| end.eq_ignore_ascii_case("dcm")) {
        return Err(Error::config("--out", args.out.display(), "does not end in .dcm"));
    }
    let iso_per_mm = match args.iso {
        Some(iso) if !(iso.is_finite() && iso > 0.0) => {
            return Err(Error::config("--iso", iso, "is not a positive attenuation per mm"));
        }
        Some(iso) => iso,
        None => vessel_threshold_per_mm(renderer, model, grid)?,
    };
    let earlier = earlier(args, phases.len() > 1)?;
    let [study, frame] = numbers_of_checkpoint(&args.run)?;
    let [series] = random_numbers()?;
    let rule = format!("attenuation above {iso_per_mm:.4e} per mm, {} iterations", model.step);
    let mut made = Vec::new();
    for phase in phases {
        let values = renderer.sample_patient(Component::Dynamic, *phase, grid)?;
        let inside: Vec<bool> = values.iter().map(|value| f64::from(*value) > iso_per_mm).collect();
        if !inside.contains(&true) {
            eprintln!("phase {phase} has no vessel above {iso_per_mm:.4e} per mm, so that no file is written for it");
            continue;
        }
        let [instance, dimensions] = random_numbers()?;
        let file = if phases.len() == 1 { args.out.clone() } else { files::of_phase(&args.out, *phase) };
        let segmentation = Segmentation {
            grid: *grid,
            inside: &inside,
            phase: *phase,
            n_phases: model.shown_phases(),
            rule: &rule,
            seeds: SegmentationSeeds { study, series, frame, instance, dimensions },
        };
        segmentation::write(&file, &segmentation)?;
        made.push(file);
        progress("segmentation", made.len() as u64, phases.len() as u64);
    }
    if made.is_empty() {
        return Err(Error::config(
            "--iso",
            format!("{iso_per_mm:.4e}"),
            "is too high: no vessel has this attenuation at any phase",
        ));
    }
    earlier.make_way(&made)?;
    Ok(made)
}

/// Files of an earlier series in the way of an export that writes one file per phase.
fn earlier(args: &ExportArgs, several: bool) -> Result<Earlier> {
    if several { Earlier::series(&args.out, args.force) } else { Ok(Earlier::none()) }
}

/// Exports Gaussians; needs no device.
fn export_splats(args: &ExportArgs, model: &Model, phases: &[u32]) -> Result<()> {
    if !args.out.extension().is_some_and(|end| end.eq_ignore_ascii_case("ply")) {
        return Err(Error::config("--out", args.out.display(), "does not end in .ply"));
    }
    let earlier = earlier(args, phases.len() > 1)?;
    let made = write_splats(model, phases, &args.out)?;
    earlier.make_way(&made)?;
    made.iter().for_each(|path| out!("{}", path.display()));
    Ok(())
}

/// Returns the error for a file whose name does not end as those of volumes do. It names the option for other endings.
fn no_volume(out: &Path) -> Error {
    let end = out.extension().and_then(|end| end.to_str()).unwrap_or_default().to_ascii_lowercase();
    let advice = match end.as_str() {
        "dcm" => "add --segmentation for DICOM segmentations",
        "ply" => "add --mesh for surfaces or --splats for Gaussians",
        "stl" | "obj" | "glb" => "add --mesh for surfaces",
        _ => "choose one with --format",
    };
    let problem = format!("does not end in one of .nrrd .nii .nii.gz .mha .npy .vtk, as volumes do; {advice}");
    Error::config("--out", out.display(), problem)
}

/// Exports displacements, or the paths of the Gaussians; needs no device.
fn export_motion(args: &ExportArgs, model: &Model, phases: Vec<u32>, sequence: bool) -> Result<()> {
    let tree = moving_set(model)?;
    let format = MotionFormat::of(&args.out);
    let unknown = |known: &str| Error::config("--out", args.out.display(), format!("does not end in one of {known}"));
    let made = if args.trajectories {
        if format != Some(MotionFormat::Vtk) {
            return Err(unknown(".vtk"));
        }
        write_trajectories(tree, &args.out)?;
        vec![args.out.clone()]
    } else {
        let encoding = if args.compress { Encoding::Gzip } else { Encoding::Raw };
        let format = format.ok_or_else(|| unknown(".nrrd .vtk"))?;
        let earlier = earlier(args, format == MotionFormat::Vtk && sequence)?;
        let made = MotionExport { moving: tree, phases, sequence, format, encoding }.write(&args.out)?;
        earlier.make_way(&made)?;
        made
    };
    made.iter().for_each(|path| out!("{}", path.display()));
    eprintln!(
        "motion along a vessel is not observed in projections: displacements along vessels come from the smoothness of \
         the motion only"
    );
    Ok(())
}

/// Converts a dataset between layouts.
pub fn convert(args: &ConvertArgs) -> Result<()> {
    let dataset = Dataset::open(&args.data)?;
    let between = dataset.frames.iter().filter(|frame| frame.after_phase != 0.0).count();
    if args.layout == Layout::Nerfca && between > 0 {
        eprintln!(
            "{between} frames lie between two phases; this layout has whole phases only, so they get the nearest phase"
        );
    }
    if args.layout == Layout::Nerfca && dataset.still {
        eprintln!("this layout cannot state that the object is at rest: phase 1 is the object without its vessels");
    }
    let references = KeptReferences::of(&dataset, args.keep_references)?;
    write_dataset(&args.out, args.force, |out| {
        let image_files = convert_dataset(&dataset, args.layout, out)?;
        references.write(&image_files, out)
    })?;
    out!("{}", args.out.display());
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn endings_of_other_exports_name_their_option() {
        let options = [("v.dcm", "--segmentation"), ("v.PLY", "--splats"), ("v.glb", "--mesh"), ("v.xyz", "--format")];
        for (name, option) in options {
            let said = no_volume(Path::new(name)).to_string();
            assert!(said.contains(name) && said.contains(option), "{said}");
        }
        assert!(!no_volume(Path::new("v.dcm")).to_string().contains("--format"));
    }
}
