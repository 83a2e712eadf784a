//! Views of synthetic data: angles, distances and detectors.

use crate::error::{Error, Result};
use crate::geometry::CArm;
use crate::scan::dataset::Split;

/// A pair of C-arm angles.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Angles {
    /// Primary angle in degrees, LAO positive.
    pub primary_deg: f64,
    /// Secondary angle in degrees, cranial positive.
    pub secondary_deg: f64,
}

const fn angles(primary_deg: f64, secondary_deg: f64) -> Angles {
    Angles { primary_deg, secondary_deg }
}

/// Validation views of the paper (method, section 1).
pub const VALIDATION_ANGLES: [Angles; 4] =
    [angles(-5.0, 40.0), angles(-5.0, -40.0), angles(90.0, 0.0), angles(-30.0, 0.0)];

/// Distance below which a training view is too similar to a validation view: the sum of the differences of both angles,
/// degrees.
const TOO_NEAR_DEG: f64 = 15.0;

impl Angles {
    fn is_near(&self, other: &Angles) -> bool {
        let apart = (self.primary_deg - other.primary_deg).abs() + (self.secondary_deg - other.secondary_deg).abs();
        apart <= TOO_NEAR_DEG
    }

    fn check(&self) -> Result<()> {
        for (field, value) in [("primary_deg", self.primary_deg), ("secondary_deg", self.secondary_deg)] {
            if !(value.is_finite() && value.abs() <= 360.0) {
                return Err(Error::config(field, value, "is not an angle in degrees"));
            }
        }
        Ok(())
    }
}

/// Views of a dataset.
#[derive(Debug, Clone, PartialEq)]
pub struct ViewAngles {
    /// Training views.
    pub training: Vec<Angles>,
    /// Validation views.
    pub validation: Vec<Angles>,
}

impl ViewAngles {
    /// Returns the paper's 3, 4 or 9 training views and its validation views.
    ///
    /// # Errors
    /// [`Error::Config`] for another number.
    pub fn published(views: u32) -> Result<ViewAngles> {
        let four = [angles(-30.0, 30.0), angles(-30.0, -30.0), angles(60.0, -30.0), angles(60.0, 30.0)];
        let training = match views {
            3 => four[1..].to_vec(),
            4 => four.to_vec(),
            9 => {
                let grid = [-60.0, 0.0, 60.0];
                let all = grid.iter().flat_map(|a| grid.iter().map(move |b| angles(*a, *b)));
                all.filter(|a| !VALIDATION_ANGLES.iter().any(|v| v.is_near(a))).collect()
            }
            other => {
                return Err(Error::config("views", other, "is not 3, 4 or 9; state the angles of other views"));
            }
        };
        Ok(ViewAngles { training, validation: VALIDATION_ANGLES.to_vec() })
    }

    /// Makes views from a user's training views. Without validation views, the paper's are used, except those near a training
    /// view.
    ///
    /// # Errors
    /// [`Error::Config`] without training views and for impossible angles.
    pub fn given(training: &[Angles], validation: Option<&[Angles]>) -> Result<ViewAngles> {
        if training.is_empty() {
            return Err(Error::config("angles", "", "at least one training view is needed"));
        }
        let unseen = || VALIDATION_ANGLES.iter().filter(|v| !training.iter().any(|t| t.is_near(v))).copied().collect();
        let views =
            ViewAngles { training: training.to_vec(), validation: validation.map_or_else(unseen, <[Angles]>::to_vec) };
        views.all().try_for_each(|(angles, _)| angles.check())?;
        Ok(views)
    }

    /// All views with their purpose; training views come first.
    pub fn all(&self) -> impl Iterator<Item = (Angles, Split)> {
        let training = self.training.iter().map(|a| (*a, Split::Train));
        training.chain(self.validation.iter().map(|a| (*a, Split::Validation)))
    }
}

/// Width of a detector's pixels.
#[derive(Debug, Clone, PartialEq)]
pub enum PixelPitch {
    /// Width that gives this field of view at the isocentre, mm.
    FieldOfView(f64),
    /// Pixel pitch along columns and rows of the detector, mm.
    Detector([f64; 2]),
}

/// Options of C-arms. Each list holds one value for all views, or one for each: training views first, then validation views.
#[derive(Debug, Clone, PartialEq)]
pub struct CArmOptions {
    /// Source to isocentre, mm.
    pub sod_mm: Vec<f64>,
    /// Source to detector, mm.
    pub sid_mm: Vec<f64>,
    /// Pixel pitch of the detector.
    pub pixel: PixelPitch,
    /// Offset of the detector's centre along columns and rows, mm.
    pub offset_mm: Vec<[f64; 2]>,
}

/// Value for a view in a list of one value for all views or one for each.
fn of_view<T: Copy>(field: &str, list: &[T], view: usize, views: usize) -> Result<T> {
    match list {
        [one] => Ok(*one),
        list if list.len() == views => Ok(list[view]),
        list => {
            let problem = format!(
                "is the number of values, but one or {views} are needed: one for all views, or one for each view \
                 (training first, then validation)"
            );
            Err(Error::config(field, list.len(), problem))
        }
    }
}

impl CArmOptions {
    /// Returns the C-arm of each view, for images of `size` columns and rows.
    ///
    /// # Errors
    /// [`Error::Config`] for values that are not lengths, and for lists of a wrong length.
    pub fn c_arms(&self, views: &ViewAngles, size: usize) -> Result<Vec<CArm>> {
        let all: Vec<Angles> = views.all().map(|(angles, _)| angles).collect();
        all.iter().enumerate().map(|(view, angles)| self.c_arm(*angles, view, all.len(), size)).collect()
    }

    fn c_arm(&self, angles: Angles, view: usize, views: usize, size: usize) -> Result<CArm> {
        let sod_mm = of_view("sod_mm", &self.sod_mm, view, views)?;
        let sid_mm = of_view("sid_mm", &self.sid_mm, view, views)?;
        let offset_mm = of_view("offset_mm", &self.offset_mm, view, views)?;
        let positive = |field: &str, value: f64| match value.is_finite() && value > 0.0 {
            true => Ok(value),
            false => Err(Error::config(field, value, "is not a positive length in mm")),
        };
        positive("sod_mm", sod_mm)?;
        positive("sid_mm", sid_mm)?;
        if sod_mm >= sid_mm {
            let problem = format!("would put the isocentre behind the detector (sid_mm = {sid_mm})");
            return Err(Error::config("sod_mm", sod_mm, problem));
        }
        if let Some(bad) = offset_mm.iter().find(|o| !o.is_finite()) {
            return Err(Error::config("offset_mm", bad, "is not a length in mm"));
        }
        let pixel_mm = match self.pixel {
            PixelPitch::FieldOfView(field) => [positive("field_mm", field)? / size as f64 * sid_mm / sod_mm; 2],
            PixelPitch::Detector([u, v]) => [positive("pixel_mm", u)?, positive("pixel_mm", v)?],
        };
        let Angles { primary_deg, secondary_deg } = angles;
        Ok(CArm { primary_deg, secondary_deg, sid_mm, sod_mm, pixel_mm, offset_mm, table_mm: [0.0; 3] })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn nine_views_leave_validation_unseen() {
        let nine = ViewAngles::published(9).unwrap();
        assert_eq!(nine.training.len(), 9);
        assert_eq!(ViewAngles::published(3).unwrap().training[0], angles(-30.0, -30.0));
        assert!(ViewAngles::published(5).is_err());
    }

    #[test]
    fn own_views_do_not_give_the_paper_s_away() {
        let own = ViewAngles::given(&[angles(85.0, 5.0), angles(0.0, 0.0)], None).unwrap();
        assert_eq!(own.validation, [angles(-5.0, 40.0), angles(-5.0, -40.0), angles(-30.0, 0.0)]);
        let both = ViewAngles::given(&[angles(85.0, 5.0)], Some(&[angles(86.0, 5.0)])).unwrap();
        assert_eq!(both.validation, [angles(86.0, 5.0)], "what is asked for is done");
        assert!(ViewAngles::given(&[], None).is_err());
        assert!(ViewAngles::given(&[angles(f64::NAN, 0.0)], None).is_err());
    }

    #[test]
    fn a_list_has_one_value_or_one_per_view() {
        let views = ViewAngles::given(&[angles(0.0, 0.0), angles(50.0, 0.0)], Some(&[angles(90.0, 0.0)])).unwrap();
        let mut options = CArmOptions {
            sod_mm: vec![700.0, 710.0, 720.0],
            sid_mm: vec![1100.0],
            pixel: PixelPitch::FieldOfView(100.0),
            offset_mm: vec![[1.0, 2.0]],
        };
        let arms = options.c_arms(&views, 50).unwrap();
        assert_eq!(arms.iter().map(|a| a.sod_mm).collect::<Vec<_>>(), [700.0, 710.0, 720.0]);
        assert!((arms[1].pixel_mm[0] - 2.0 * 1100.0 / 710.0).abs() < 1e-12 && arms[1].offset_mm == [1.0, 2.0]);
        options.pixel = PixelPitch::Detector([0.3, 0.4]);
        assert_eq!(options.c_arms(&views, 50).unwrap()[2].pixel_mm, [0.3, 0.4]);
        options.sid_mm = vec![1100.0, 1000.0];
        let message = options.c_arms(&views, 50).unwrap_err().to_string();
        assert!(message.contains("sid_mm = 2") && message.contains("one or 3"), "{message}");
        options.sid_mm = vec![705.0];
        assert!(options.c_arms(&views, 50).unwrap_err().to_string().contains("sod_mm = 710"));
    }
}
