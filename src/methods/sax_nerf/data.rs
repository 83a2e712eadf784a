//! A dataset in the form that SAX-NeRF uses: whole images in its units, the pixels that show something, and the images that
//! each field is fitted to.

use crate::config::sections::Sax;
use crate::error::{Error, Result};
use crate::fitting::sets::{Sets, check_finite, check_sizes};
use crate::geometry::MM_PER_UNIT;
use crate::kernels::layout::{SaxList, View};
use crate::scan::dataset::Dataset;

/// Length by which rays continue beyond the volume's corners, mm.
const TOLERANCE_MM: f64 = 5.0;

/// The data in SAX-NeRF's units.
#[derive(Debug, Clone)]
pub struct SaxData {
    /// Half a side of the volume, world units.
    pub half: f64,
    /// First and last depth along rays, world units from the isocentre.
    pub depths: [f64; 2],
    /// Attenuation per world unit of a density of 1.
    pub attenuation: f64,
    /// Columns of an image.
    pub width: usize,
    /// Rows of an image.
    pub height: usize,
    /// Cardiac phases.
    pub n_phases: usize,
    /// Rays of each image.
    pub views: Vec<View>,
    /// `[image][pixel]`: line integrals of the density.
    pub images: Vec<f32>,
    /// Range of each image's pixels in `listed`.
    pub lists: Vec<SaxList>,
    /// Pixels that show something; all of an image that shows nothing.
    pub listed: Vec<u32>,
    /// Images of each set.
    pub sets: Sets,
}

impl SaxData {
    /// Converts a dataset for a volume of half side `half`, world units.
    ///
    /// # Errors
    /// [`Error::Config`] for images of several sizes, and for a pixel that is not finite; [`Error::Unmet`] for images without room for the
    /// windows, and for phases that no image shows.
    pub fn new(dataset: &Dataset, settings: &Sax, half: f64) -> Result<SaxData> {
        check_sizes(dataset, "SAX-NeRF")?;
        check_windows(settings, [dataset.width, dataset.height])?;
        let attenuation = dataset.vessel_attenuation.unwrap_or(1.0);
        let (training, n_pixels) = (dataset.training(), dataset.n_pixels());
        let mut data = SaxData {
            half,
            depths: depths(half),
            attenuation,
            width: dataset.width,
            height: dataset.height,
            n_phases: dataset.n_phases as usize,
            views: training.iter().map(|frame| View::of(&dataset.views[frame.view].rays)).collect(),
            images: Vec::with_capacity(training.len() * n_pixels),
            lists: Vec::new(),
            listed: Vec::new(),
            sets: Sets::of(dataset, settings.static_data, "sax.static_data")?,
        };
        for frame in training {
            check_finite(dataset, frame)?;
            data.add_image(frame.integrals.iter().map(|v| (f64::from(*v) / attenuation) as f32).collect());
        }
        Ok(data)
    }

    fn add_image(&mut self, image: Vec<f32>) {
        let first = self.listed.len() as u32;
        let n_pixels = image.len() as u32;
        self.listed.extend((0..n_pixels).filter(|p| image[*p as usize] > 0.0));
        if self.listed.len() as u32 == first {
            self.listed.extend(0..n_pixels);
        }
        self.lists.push(SaxList { first, n: self.listed.len() as u32 - first });
        self.images.extend(image);
    }

    /// Returns the number of pixels of an image.
    pub fn n_pixels(&self) -> usize {
        self.width * self.height
    }

    /// Returns the number of fields, each fitted separately.
    pub fn n_sets(&self) -> usize {
        self.sets.len()
    }

    /// Returns the images of all sets in their order, and the index of each set's first image.
    pub fn turns(&self) -> (Vec<u32>, Vec<u32>) {
        let images = || (0..self.sets.len()).map(|set| self.sets.images(set));
        let turns = images().flatten().map(|image| *image as u32).collect();
        let mut first = 0;
        let begin = |images: &[usize]| {
            first += images.len() as u32;
            first - images.len() as u32
        };
        (turns, images().map(begin).collect())
    }
}

/// Returns the first and last depth of rays: the distance of the corners of the volume's slices from its axis, plus a
/// tolerance.
fn depths(half: f64) -> [f64; 2] {
    let far = half * 2f64.sqrt() + TOLERANCE_MM / MM_PER_UNIT;
    [-far, far]
}

/// Refuses windows that do not fit into the images.
fn check_windows(settings: &Sax, [width, height]: [usize; 2]) -> Result<()> {
    let side = settings.window as usize;
    let room = (width / side) * (height / side);
    if settings.windows as usize > room {
        let problem = format!(
            "an image of {width} x {height} pixels has room for at most {room} windows of {side} x {side} pixels"
        );
        return Err(Error::unmet("sax.window_num", settings.windows, problem));
    }
    Ok(())
}
