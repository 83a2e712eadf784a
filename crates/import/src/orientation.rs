//! Orientation of stored images relative to the detector, by the rotation and the flip of the field of view that a file states (DICOM PS3.3,
//! (0018,7032) and (0018,7034)). The geometry of a C-arm is that of an image which is seen facing the source.

use crate::enhanced::Groups;
use crate::error::Result;
use crate::geometry::CArm;
use crate::reader::Reader;
use dicom_core::Tag;
use dicom_dictionary_std::tags;
use std::ops::Range;

/// Rotation of a detector about its normal, degrees, that is taken for none: the accuracy of stated angles.
const NO_TURN_DEG: f64 = 0.5;
/// Primary angle, degrees, up to which the columns of an image run towards the patient's left: they have half of their
/// length in this direction there, its cosine.
const FROM_THE_FRONT_DEG: f64 = 60.0;
/// Distance of the field of view from the middle of the detector, mm, that is not worth a warning: a few pixels.
const MIDDLE_MM: f64 = 1.0;

/// Rotation and flip by which a stored image differs from that of the detector.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub(super) struct Orientation {
    /// Clockwise rotation, quarters of a turn.
    quarter_turns: usize,
    /// Whether columns run backwards, after the rotation.
    flipped: bool,
}

impl Orientation {
    /// Reads the orientation that the images of a run share.
    ///
    /// # Errors
    /// [`crate::error::Error::Data`] naming the tag, for a rotation that is no multiple of 90 degrees, an unknown flip, a detector that is
    /// turned, and an orientation that differs between frames.
    pub(super) fn of(run: &Reader<'_>, groups: Option<&Groups<'_>>, frames: usize) -> Result<Orientation> {
        let Some(groups) = groups else { return read(run) };
        let of_frame = |frame: usize| -> Result<Orientation> {
            if let Some(isocentre) = groups.item(frame, tags::ISOCENTER_REFERENCE_SYSTEM_SEQUENCE)? {
                let (tag, name) =
                    (tags::POSITIONER_ISOCENTER_DETECTOR_ROTATION_ANGLE, "PositionerIsocenterDetectorRotationAngle");
                if let Some(degrees) = isocentre.number(tag, name)?.filter(|degrees| degrees.abs() > NO_TURN_DEG) {
                    let problem = format!("is {degrees}: images of a detector that is turned are not supported");
                    return Err(run.bad(tag, name, problem));
                }
            }
            groups.item(frame, tags::FIELD_OF_VIEW_SEQUENCE)?.map_or_else(|| read(run), |field| read(&field))
        };
        let first = of_frame(0)?;
        for frame in 1..frames {
            if of_frame(frame)? != first {
                let problem = "differs between frames, which is not supported";
                return Err(run.bad(tags::FIELD_OF_VIEW_ROTATION, "FieldOfViewRotation", problem));
            }
        }
        Ok(first)
    }

    /// Tells whether stored images are those of the detector.
    pub(super) fn is_upright(self) -> bool {
        self == Orientation::default()
    }

    fn swaps_sides(self) -> bool {
        self.quarter_turns % 2 == 1
    }

    /// Columns and rows of the detector's image, from those of the stored one; likewise for the sides of a pixel.
    pub(super) fn sides<T: Copy>(self, [columns, rows]: [T; 2]) -> [T; 2] {
        if self.swaps_sides() { [rows, columns] } else { [columns, rows] }
    }

    /// Returns a C-arm with the pixels of the detector's image.
    pub(super) fn c_arm(self, stored: CArm) -> CArm {
        CArm { pixel_mm: self.sides(stored.pixel_mm), ..stored }
    }

    /// Returns the detector's image of a stored one with `size` columns and rows.
    pub(super) fn image(self, stored: &[f32], size: [usize; 2]) -> Vec<f32> {
        let [width, height] = self.sides(size);
        (0..width * height)
            .map(|p| {
                let [x, y] = self.stored([p % width, p / width], size);
                stored[y * size[0] + x]
            })
            .collect()
    }

    /// Place in a stored image with `size` columns and rows of a place in the detector's image.
    fn stored(self, [x, y]: [usize; 2], [width, height]: [usize; 2]) -> [usize; 2] {
        let [x, y] = match self.quarter_turns {
            0 => [x, y],
            1 => [width - 1 - y, x],
            2 => [width - 1 - x, height - 1 - y],
            _ => [y, height - 1 - x],
        };
        [if self.flipped { width - 1 - x } else { x }, y]
    }

    /// Returns columns and rows of the detector's image that show columns and rows of a stored one with `size` columns and rows.
    pub(super) fn area(
        self,
        (columns, rows): (Range<usize>, Range<usize>),
        size: [usize; 2],
    ) -> (Range<usize>, Range<usize>) {
        let back = |range: Range<usize>, length: usize| length - range.end..length - range.start;
        let columns = if self.flipped { back(columns, size[0]) } else { columns };
        match self.quarter_turns {
            0 => (columns, rows),
            1 => (rows, back(columns, size[0])),
            2 => (back(columns, size[0]), back(rows, size[1])),
            _ => (back(rows, size[1]), columns),
        }
    }

    /// Describes what was undone.
    pub(super) fn note(self) -> Option<String> {
        let turned = (self.quarter_turns > 0)
            .then(|| format!("turned by {} degrees (FieldOfViewRotation)", 90 * self.quarter_turns));
        let flipped = self.flipped.then(|| "mirrored (FieldOfViewHorizontalFlip)".to_owned());
        let done: Vec<String> = turned.into_iter().chain(flipped).collect();
        (!done.is_empty()).then(|| {
            format!(
                "the images are stored {}, which was undone: images are those of the detector, seen facing the source",
                done.join(" and ")
            )
        })
    }
}

/// Reads the orientation that a data set or an item states.
fn read(from: &Reader<'_>) -> Result<Orientation> {
    let (tag, name) = (tags::FIELD_OF_VIEW_ROTATION, "FieldOfViewRotation");
    let degrees = from.number(tag, name)?.unwrap_or(0.0).rem_euclid(360.0);
    if degrees % 90.0 != 0.0 {
        return Err(from.bad(tag, name, format!("{degrees} is no multiple of 90 degrees")));
    }
    let (tag, name) = (tags::FIELD_OF_VIEW_HORIZONTAL_FLIP, "FieldOfViewHorizontalFlip");
    let flipped = match from.text(tag).as_deref() {
        None | Some("NO") => false,
        Some("YES") => true,
        Some(other) => return Err(from.bad(tag, name, format!("`{other}` is neither YES nor NO"))),
    };
    Ok(Orientation { quarter_turns: (degrees / 90.0) as usize, flipped })
}

/// Returns warnings on statements about the orientation that are not corrected.
pub(super) fn warnings(run: &Reader<'_>, c_arm: &CArm) -> Vec<String> {
    let from_the_front = c_arm.primary_deg.abs() < FROM_THE_FRONT_DEG;
    let stated = run.text(tags::PATIENT_ORIENTATION).filter(|text| from_the_front && text.starts_with('R'));
    let mirrored = stated.map(|text| {
        format!(
            "warning: PatientOrientation is {text}: columns run towards the patient's right, as in a mirrored image, but towards the left in one \
             that is seen facing the source; the image is used as it is stored"
        )
    });
    mirrored.into_iter().chain(off_the_middle(run)).collect()
}

/// Returns a warning where the file states that the field of view is not in the middle of the detector.
fn off_the_middle(run: &Reader<'_>) -> Option<String> {
    // Rows come first.
    let two = |tag: Tag| -> Option<[f64; 2]> {
        match run.numbers(tag, "field of view").ok()??[..] {
            [both] => Some([both; 2]),
            [rows, columns, ..] => Some([rows, columns]),
            [] => None,
        }
    };
    let [origin, spacing] = [tags::FIELD_OF_VIEW_ORIGIN, tags::DETECTOR_ELEMENT_SPACING].map(two);
    let [field, detector] = [tags::FIELD_OF_VIEW_DIMENSIONS, tags::DETECTOR_ACTIVE_DIMENSIONS].map(two);
    let (origin, spacing, field, detector) = (origin?, spacing?, field?, detector?);
    let away = [0, 1].map(|k| origin[k] * spacing[k] + 0.5 * (field[k] - detector[k]));
    away.iter().any(|mm| mm.abs() > MIDDLE_MM).then(|| {
        format!(
            "warning: the middle of the field of view lies {:.1} mm along the columns and {:.1} mm along the rows from that of the detector \
             (FieldOfViewOrigin), which is not corrected: import pictures --geometry states such an offset",
            away[1], away[0]
        )
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_was_turned_and_flipped_becomes_the_image_of_the_detector() {
        // 3 columns and 2 rows; the letters of a detector's image are abc, def.
        let detector = [1.0, 2.0, 3.0, 4.0, 5.0, 6.0];
        let turned: [(usize, [usize; 2], [f32; 6]); 4] = [
            (0, [3, 2], [1.0, 2.0, 3.0, 4.0, 5.0, 6.0]),
            (1, [2, 3], [4.0, 1.0, 5.0, 2.0, 6.0, 3.0]),
            (2, [3, 2], [6.0, 5.0, 4.0, 3.0, 2.0, 1.0]),
            (3, [2, 3], [3.0, 6.0, 2.0, 5.0, 1.0, 4.0]),
        ];
        for (quarter_turns, size, stored) in turned {
            let of = Orientation { quarter_turns, flipped: false };
            assert_eq!(of.image(&stored, size), detector, "{quarter_turns}");
            assert_eq!(of.sides(size), [3, 2]);
            let flipped: Vec<f32> = stored.chunks(size[0]).flat_map(|row| row.iter().rev().copied()).collect();
            let of = Orientation { quarter_turns, flipped: true };
            assert_eq!(of.image(&flipped, size), detector, "{quarter_turns}, flipped");
            // The area that shows the detector's last column alone.
            let is_last = |p: &usize| flipped[*p] == 3.0 || flipped[*p] == 6.0;
            let places: Vec<[usize; 2]> = (0..6).filter(is_last).map(|p| [p % size[0], p / size[0]]).collect();
            let range = |axis: usize| {
                let all = || places.iter().map(move |place| place[axis]);
                all().min().unwrap()..all().max().unwrap() + 1
            };
            assert_eq!(of.area((range(0), range(1)), size), (2..3, 0..2), "{quarter_turns}");
        }
    }
}
