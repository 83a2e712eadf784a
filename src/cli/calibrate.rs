//! `calibrate`: a dataset whose views agree.

use super::args::CalibrateArgs;
use nertca_vk::calibrate::choose::Correction;
use nertca_vk::calibrate::correction::Calibration;
use nertca_vk::calibrate::{calibrate, silhouettes};
use nertca_vk::config::{Config, Preset};
use nertca_vk::error::{Error, Result};
use nertca_vk::files;
use nertca_vk::scan::dataset::{Dataset, Layout, MANIFEST};
use nertca_vk::scan::writer;
use nertca_vk::score::pictures::write_silhouettes;

/// Folder of what belongs to the correction, in the dataset.
const FOLDER: &str = "calibration";

/// Corrects a dataset.
pub fn run(args: &CalibrateArgs) -> Result<()> {
    let dataset = Dataset::open(&args.data)?;
    if args.out.join(MANIFEST).exists() {
        return Err(Error::config("--out", args.out.display(), "already holds a dataset; choose another directory"));
    }
    let mut config = Config::preset(Preset::Fast);
    config.calibrate.mode = args.mode;
    let calibration = calibrate(&dataset, &config)?;
    let corrected = dataset.corrected(&calibration)?;
    let description = format!("calibrated from {}", dataset.path.display());
    writer::write(&corrected, Layout::Native, &args.out, description, &|view| calibration.stated(view).cloned())?;
    let folder = args.out.join(FOLDER);
    files::create_directory(&folder)?;
    calibration.write(&folder)?;
    for s in silhouettes(&dataset, &corrected) {
        let path = folder.join(format!("view{}-phase{:02}.png", s.view, s.phase));
        let [before, after] = &s.explained;
        write_silhouettes(&path, &s.seen, &s.shown, [before, after], s.width)?;
    }
    if args.json {
        out!("{}", files::pretty_json(&calibration)?);
    } else {
        print_table(&calibration);
        out!("dataset: {}, before and after: {}", args.out.display(), folder.display());
    }
    Ok(())
}

fn print_table(calibration: &Calibration) {
    if calibration.correction != Correction::Stated {
        out!("view  primary  secondary   left  posterior  superior   moved    residual %  ");
        out!("          deg        deg     mm         mm        mm      px  before  after");
    }
    for v in &calibration.views {
        let [left, posterior, superior] = v.table_mm;
        out!(
            "{:4}  {:+7.2}    {:+7.2}  {left:+5.2}      {posterior:+5.2}     {superior:+5.2}  {:6.2}  {:6.1} {:6.1}",
            v.view,
            v.primary_deg,
            v.secondary_deg,
            v.moved_px,
            100.0 * v.residual_before,
            100.0 * v.residual_after
        );
    }
    if calibration.correction != Correction::Stated {
        let [before, after] = calibration.explained;
        out!(
            "vessel pixels that all other views explain: {:.0} % before, {:.0} % after",
            100.0 * before,
            100.0 * after
        );
    }
    calibration.notes.iter().for_each(|note| out!("{note}"));
}
