//! Angiograms of a study: phantoms, made once and shared between methods, or an existing directory.

use crate::COMMIT;
use crate::text::Places;
use nertca_vk::error::{Error, Result};
use nertca_vk::files::{self, Lock};
use nertca_vk::fingerprint::Fingerprint;
use nertca_vk::gpu::device::Gpu;
use nertca_vk::scan::dataset::Layout;
use nertca_vk_phantom::dataset::{Anatomy, PhantomOptions, Setting, make};
use nertca_vk_phantom::degradations::{Breathing, Degradations, GeometryError, Rhythm};
use nertca_vk_phantom::noise::Photons;
use nertca_vk_phantom::stenosis::Stenosis;
use nertca_vk_phantom::views::{Angles, CArmOptions, PixelPitch, ViewAngles};
use serde::{Deserialize, Serialize};
use std::num::NonZeroU32;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

/// Name of the file that is written last into a phantom; it records the data and the commit it was made from.
const STAMP: &str = "study-data.json";
/// Interval between checks whether another process has finished a data set.
const LOOK_EVERY: Duration = Duration::from_millis(200);
/// Size, phases and views of a phantom where a study does not state them; the defaults of the command line.
const USUAL_SIZE: usize = 100;
const USUAL_PHASES: u32 = 10;
const USUAL_VIEWS: u32 = 4;
/// Attenuation of filled vessels in real anatomy, 1/mm.
const USUAL_IODINE_PER_MM: f64 = 0.10;
/// C-arm of real anatomy: source to isocentre, source to detector, field of view, mm.
const USUAL_C_ARM_MM: [f64; 3] = [750.0, 1100.0, 160.0];

/// A phantom as a study states it. Omitted fields take the values of the study's common section, or defaults.
#[derive(Debug, Clone, Default, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct PhantomSection {
    /// Procedural anatomy with its C-arm: `small-xcat`, `xcat` or `magix`.
    geometry: Option<Setting>,
    /// Columns and rows of the images.
    size: Option<usize>,
    /// Cardiac phases.
    phases: Option<u32>,
    /// Numbers of training views; each gives a data set of its own.
    views: Option<Vec<u32>>,
    /// Primary and secondary angle of each training view, degrees, instead of a number of published views.
    #[serde(skip_serializing_if = "Option::is_none")]
    angles: Option<Vec<[f64; 2]>>,
    /// Angles of the unseen views, degrees; without them, those of the paper.
    #[serde(skip_serializing_if = "Option::is_none")]
    test_angles: Option<Vec<[f64; 2]>>,
    /// Seed of shape and noise for all runs; without it, each run uses its own seed.
    seed: Option<u32>,
    /// File with a tree of real anatomy.
    tree: Option<PathBuf>,
    /// CT file with the background of the tree.
    background: Option<PathBuf>,
    /// Attenuation of filled vessels with a tree, 1/mm.
    iodine_per_mm: Option<f64>,
    /// Whether the true vessels are written as volumes, for scores in 3D.
    volumes: Option<bool>,
    /// Interval of the phases whose volumes are written: the first of every so many.
    volumes_every: Option<NonZeroU32>,
    catheter: Option<bool>,
    geometry_error: Option<GeometryError>,
    breathing: Option<Breathing>,
    /// Photons per pixel of the unattenuated beam.
    photons: Option<f64>,
    /// Photons per pixel at the detector.
    detector_photons: Option<f64>,
    contrast_variation_percent: Option<f64>,
    inflow_s: Option<f64>,
    heart: Option<Rhythm>,
    collimated_share: Option<f64>,
    /// Stenoses, the same in all runs. Data without them keep the fingerprint that they had before this key existed.
    #[serde(skip_serializing_if = "Option::is_none")]
    stenoses: Option<Vec<Stenosis>>,
}

impl PhantomSection {
    /// Fills the fields that are missing here from `common`.
    pub(super) fn over(self, common: &PhantomSection) -> PhantomSection {
        let common = common.clone();
        // Either kind of photon count overrides both kinds of the common section.
        let counted = self.photons.is_some() || self.detector_photons.is_some();
        PhantomSection {
            geometry: self.geometry.or(common.geometry),
            size: self.size.or(common.size),
            phases: self.phases.or(common.phases),
            views: if self.angles.is_some() { self.views.clone() } else { self.views.clone().or(common.views) },
            angles: if self.views.is_some() { self.angles } else { self.angles.or(common.angles) },
            test_angles: self.test_angles.or(common.test_angles),
            seed: self.seed.or(common.seed),
            tree: self.tree.or(common.tree),
            background: self.background.or(common.background),
            iodine_per_mm: self.iodine_per_mm.or(common.iodine_per_mm),
            volumes: self.volumes.or(common.volumes),
            volumes_every: self.volumes_every.or(common.volumes_every),
            catheter: self.catheter.or(common.catheter),
            geometry_error: self.geometry_error.or(common.geometry_error),
            breathing: self.breathing.or(common.breathing),
            photons: if counted { self.photons } else { common.photons },
            detector_photons: if counted { self.detector_photons } else { common.detector_photons },
            contrast_variation_percent: self.contrast_variation_percent.or(common.contrast_variation_percent),
            inflow_s: self.inflow_s.or(common.inflow_s),
            heart: self.heart.or(common.heart),
            collimated_share: self.collimated_share.or(common.collimated_share),
            stenoses: self.stenoses.or(common.stenoses),
        }
    }

    /// Returns the numbers of training views, each of which gives a data set.
    fn numbers_of_views(&self) -> std::result::Result<Vec<u32>, String> {
        match (&self.views, &self.angles) {
            (Some(_), Some(_)) => Err("`views` and `angles` cannot be used together".into()),
            (None, Some(angles)) => Ok(vec![angles.len() as u32]),
            (Some(views), None) => Ok(views.clone()),
            (None, None) => Ok(vec![USUAL_VIEWS]),
        }
    }

    /// Returns the stated angles, or the published ones of a number of training views.
    fn view_angles(&self, views: u32) -> Result<ViewAngles> {
        let listed = |angles: &[[f64; 2]]| {
            angles
                .iter()
                .map(|[primary_deg, secondary_deg]| Angles { primary_deg: *primary_deg, secondary_deg: *secondary_deg })
                .collect::<Vec<_>>()
        };
        let unseen = self.test_angles.as_deref().map(listed);
        let mut angles = match &self.angles {
            Some(training) => ViewAngles::given(&listed(training), unseen.as_deref())?,
            None => ViewAngles::published(views)?,
        };
        if let Some(unseen) = unseen {
            angles.validation = unseen;
        }
        Ok(angles)
    }

    fn degradations(&self) -> std::result::Result<Degradations, String> {
        let photons = match (self.photons, self.detector_photons) {
            (Some(_), Some(_)) => return Err("`photons` and `detector_photons` cannot be used together".into()),
            (open, detector) => open.map(Photons::Unattenuated).or(detector.map(Photons::Detector)),
        };
        Ok(Degradations {
            geometry_error: self.geometry_error,
            breathing: self.breathing,
            photons,
            contrast_variation: self.contrast_variation_percent.unwrap_or(0.0) / 100.0,
            inflow_s: self.inflow_s.unwrap_or(0.0),
            rhythm: self.heart.clone(),
            collimated_share: self.collimated_share.unwrap_or(0.0),
            catheter: self.catheter.unwrap_or(false),
        })
    }

    fn anatomy(&self, places: &Places<'_>) -> std::result::Result<Option<Anatomy>, String> {
        let Some(tree) = &self.tree else {
            return match self.background.is_some() || self.iodine_per_mm.is_some() {
                true => Err("`background` and `iodine_per_mm` need a `tree`".into()),
                false => Ok(None),
            };
        };
        if self.geometry.is_some() {
            return Err(
                "`geometry` is a published set-up with its own tree and cannot be used together with `tree`".into()
            );
        }
        let [sod_mm, sid_mm, field_mm] = USUAL_C_ARM_MM;
        Ok(Some(Anatomy {
            tree: places.find(tree)?,
            background: self.background.as_deref().map(|path| places.find(path)).transpose()?,
            centre: false,
            c_arms: CArmOptions {
                sod_mm: vec![sod_mm],
                sid_mm: vec![sid_mm],
                pixel: PixelPitch::FieldOfView(field_mm),
                offset_mm: vec![[0.0; 2]],
            },
            iodine_per_mm: self.iodine_per_mm.unwrap_or(USUAL_IODINE_PER_MM),
        }))
    }
}

/// A data set of a study, for all its seeds.
#[derive(Debug, Clone)]
pub struct DataSet {
    /// Prefix of the names of its runs: the name of the data set and, for a phantom, its number of views.
    pub id: String,
    /// Name in the study.
    pub name: String,
    /// Name in tables.
    pub label: String,
    /// Number of training views of a phantom.
    pub views: Option<u32>,
    /// Source of the data.
    pub source: Source,
}

/// Source of a data set.
#[derive(Debug, Clone)]
pub enum Source {
    /// Phantom that the study makes.
    Phantom(Box<Phantom>),
    /// Existing data in a directory.
    Directory {
        /// The directory.
        path: PathBuf,
        /// Fingerprint of all its files.
        fingerprint: Fingerprint,
    },
}

/// A phantom without its seed.
#[derive(Debug, Clone)]
pub struct Phantom {
    /// Options; their seed is replaced by that of the run, or by `fixed_seed`.
    options: PhantomOptions,
    fixed_seed: Option<u32>,
    /// Fingerprint of the stated options and of the files they name.
    fingerprint: Fingerprint,
}

impl Phantom {
    /// Seed of the phantom in a run with the seed `run`.
    fn seed(&self, run: u32) -> u32 {
        self.fixed_seed.unwrap_or(run)
    }
}

impl Source {
    /// Describes data that lie in a directory.
    ///
    /// # Errors
    /// [`Error::Io`].
    pub fn directory(path: &Path) -> Result<Source> {
        let mut fingerprint = Fingerprint::default();
        take_in(&mut fingerprint, path)?;
        Ok(Source::Directory { path: path.to_path_buf(), fingerprint })
    }

    /// Tells whether the training views may show a catheter: that of a directory is not known.
    pub fn may_show_catheter(&self) -> bool {
        match self {
            Source::Phantom(phantom) => phantom.options.degradations.catheter,
            Source::Directory { .. } => true,
        }
    }
}

/// Adds a file to a fingerprint, or all files of a directory with their names, sorted by name.
fn take_in(fingerprint: &mut Fingerprint, path: &Path) -> Result<()> {
    if path.is_dir() {
        let entries = std::fs::read_dir(path).map_err(Error::io("list", path))?;
        let mut inside = entries.collect::<std::io::Result<Vec<_>>>().map_err(Error::io("list", path))?;
        inside.sort_by_key(std::fs::DirEntry::file_name);
        return inside.iter().try_for_each(|entry| {
            fingerprint.bytes(entry.file_name().as_encoded_bytes());
            take_in(fingerprint, &entry.path())
        });
    }
    let mut file = std::fs::File::open(path).map_err(Error::io("read", path))?;
    std::io::copy(&mut file, fingerprint).map_err(Error::io("read", path)).map(drop)
}

/// Geometries whose names changed after results were first recorded: as stated now, as in fingerprints.
const RENAMED_GEOMETRIES: [(&str, &str); 2] = [
    (r#""geometry":"xcat""#, r#""geometry":"xcat-half-size""#),
    (r#""geometry":"small-xcat""#, r#""geometry":"xcat""#),
];

/// Gives a geometry the name that it had when results were first recorded, so that these keep their fingerprint.
fn as_before(section: &str) -> String {
    match RENAMED_GEOMETRIES.iter().find(|(now, _)| section.contains(now)) {
        Some((now, before)) => section.replace(now, before),
        None => section.to_owned(),
    }
}

/// Expands a section into data sets, one for each number of views.
pub(super) fn phantoms(
    name: &str,
    label: &str,
    section: &PhantomSection,
    places: &Places<'_>,
) -> std::result::Result<Vec<DataSet>, String> {
    let anatomy = section.anatomy(places)?;
    let degradations = section.degradations()?;
    if section.volumes == Some(false) && section.volumes_every.is_some() {
        return Err("`volumes_every` and `volumes = false` contradict each other".into());
    }
    let numbers = section.numbers_of_views()?;
    if let Some(i) = (1..numbers.len()).find(|i| numbers[..*i].contains(&numbers[*i])) {
        return Err(format!("views: {} is given twice", numbers[i]));
    }
    let mut files = Fingerprint::default();
    for file in anatomy.iter().flat_map(|a| [Some(&a.tree), a.background.as_ref()]).flatten() {
        take_in(&mut files, file).map_err(|e| e.to_string())?;
    }
    let one = |views: u32| -> std::result::Result<DataSet, String> {
        let angles = section.view_angles(views).map_err(|e| e.to_string())?;
        degradations.check(angles.training.len(), Layout::Native).map_err(|e| e.to_string())?;
        let stated = PhantomSection { views: Some(vec![views]), ..section.clone() };
        let mut fingerprint = files;
        fingerprint.bytes(as_before(&serde_json::to_string(&stated).map_err(|e| e.to_string())?).as_bytes());
        let options = PhantomOptions {
            setting: section.geometry.unwrap_or(Setting::SmallXcat),
            size: section.size.unwrap_or(USUAL_SIZE),
            phases: section.phases.unwrap_or(USUAL_PHASES),
            views: angles,
            seed: 0,
            stenoses: section.stenoses.clone().unwrap_or_default(),
            degradations: degradations.clone(),
            layout: Layout::Native,
            anatomy: anatomy.clone(),
            volumes_every: section.volumes.unwrap_or(true).then_some(section.volumes_every.unwrap_or(NonZeroU32::MIN)),
        };
        Ok(DataSet {
            id: format!("{name}-{views}v"),
            name: name.to_owned(),
            label: label.to_owned(),
            views: Some(views),
            source: Source::Phantom(Box::new(Phantom { options, fixed_seed: section.seed, fingerprint })),
        })
    };
    numbers.iter().map(|views| one(*views)).collect()
}

/// Record of the data and the program that a phantom in a study's directory was made from.
#[derive(Debug, PartialEq, Serialize, Deserialize)]
struct Stamp {
    data: String,
    commit: String,
}

impl DataSet {
    /// Fingerprint that tells these data from others.
    pub fn fingerprint(&self, seed: u32) -> String {
        match &self.source {
            Source::Directory { fingerprint, .. } => fingerprint.hex(),
            Source::Phantom(phantom) => {
                let mut fingerprint = phantom.fingerprint;
                fingerprint.word(phantom.seed(seed));
                fingerprint.hex()
            }
        }
    }

    /// Directory of the data of a run; a phantom may not have been made yet.
    fn place(&self, study: &Path, seed: u32) -> PathBuf {
        match &self.source {
            Source::Directory { path, .. } => path.clone(),
            Source::Phantom(phantom) => study.join("data").join(format!("{}.s{}", self.id, phantom.seed(seed))),
        }
    }

    /// Makes the data of a run unless they are ready, and returns their directory. One process makes them while others wait.
    ///
    /// # Errors
    /// [`Error::Interrupted`]; errors of making phantoms.
    pub(super) fn prepare(
        &self,
        gpu: &Gpu,
        study: &Path,
        seed: u32,
        cancel: &AtomicBool,
        progress: impl FnMut(&str, u64, u64),
    ) -> Result<PathBuf> {
        let place = self.place(study, seed);
        let Source::Phantom(phantom) = &self.source else { return Ok(place) };
        let lock = study.join("locks").join(format!("data-{}.s{}", self.id, phantom.seed(seed)));
        let _alone = loop {
            if let Some(lock) = Lock::take(&lock)? {
                break lock;
            }
            if cancel.load(Ordering::Relaxed) {
                return Err(Error::Interrupted);
            }
            std::thread::sleep(LOOK_EVERY);
        };
        let wanted = Stamp { data: self.fingerprint(seed), commit: COMMIT.to_owned() };
        let stamp = place.join(STAMP);
        let found = std::fs::read(&stamp).ok().and_then(|text| serde_json::from_slice::<Stamp>(&text).ok());
        if found.is_some_and(|found| found == wanted) {
            return Ok(place);
        }
        if place.exists() {
            std::fs::remove_dir_all(&place).map_err(Error::io("remove", &place))?;
        }
        let options = PhantomOptions { seed: phantom.seed(seed), ..phantom.options.clone() };
        make(gpu, &options, &place, progress)?;
        files::write_atomic(&stamp, files::pretty_json(&wanted)?.as_bytes())?;
        Ok(place)
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "tests")]
mod tests {
    use super::*;

    #[test]
    fn stenoses_reach_the_phantom_and_other_data_keep_their_fingerprint() {
        let section = |text: &str| toml::from_str::<PhantomSection>(text).unwrap();
        let stated = section("stenoses = [{ branch = \"LAD\", position_mm = 10, percent = 60, length_mm = 6 }]");
        let places = Places::new([]);
        let sets = phantoms("ill", "ill", &stated, &places).unwrap();
        let Source::Phantom(phantom) = &sets[0].source else { panic!("a phantom") };
        let [stenosis] = &phantom.options.stenoses[..] else { panic!("{:?}", phantom.options.stenoses) };
        assert_eq!((stenosis.branch.as_str(), stenosis.percent), ("LAD", 60.0));
        // The text of a section decides its fingerprint.
        assert!(!serde_json::to_string(&section("size = 64")).unwrap().contains("stenoses"));
        assert!(toml::from_str::<PhantomSection>("stenoses = [{ branch = \"LAD\" }]").is_err(), "fields are missing");
    }

    #[test]
    fn angles_are_stated_instead_of_a_number_of_views() {
        let section = |text: &str| toml::from_str::<PhantomSection>(text).unwrap();
        let places = Places::new([]);
        let stated = section("angles = [[-30, 0], [60, -10]]\ntest_angles = [[0, 0]]");
        let sets = phantoms("two", "two", &stated.clone().over(&section("views = [3, 4]")), &places).unwrap();
        let Source::Phantom(phantom) = &sets[0].source else { panic!("a phantom") };
        let views = &phantom.options.views;
        assert_eq!((sets.len(), sets[0].id.as_str(), sets[0].views), (1, "two-2v", Some(2)));
        assert_eq!((views.training[1].primary_deg, views.training[1].secondary_deg), (60.0, -10.0));
        assert_eq!(views.validation.len(), 1);
        let of_four = section("views = [4]").over(&stated);
        assert_eq!(phantoms("a", "a", &of_four, &places).unwrap()[0].views, Some(4), "views replace angles");
        let both = section("views = [3]\nangles = [[0, 0], [90, 0]]");
        assert!(phantoms("a", "a", &both, &places).unwrap_err().contains("cannot be used together"));
        assert!(!serde_json::to_string(&section("size = 64")).unwrap().contains("angles"));
    }
}
