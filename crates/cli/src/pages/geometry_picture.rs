//! Draws sources and detectors about the patient, for `info --picture`.

use crate::pages::lettering;
use glam::{DVec2, DVec3};
use image::{DynamicImage, Rgb, RgbImage};
use nertca_vk::error::Result;
use nertca_vk::formats::png;
use nertca_vk::geometry::{Geometry, MM_PER_UNIT, angles_deg_of, lps_mm_from_world};
use nertca_vk::scan::dataset::Dataset;
use std::path::Path;

/// Side of each of the four fields, pixels.
const FIELD: u32 = 480;
const MARGIN: f64 = 45.0;
/// Length of the patient's axes, as a share of the field's reach.
const AXIS_SHARE: f64 = 0.55;
/// Minimum reach of a field: the distance from its middle to its edge, mm.
const MIN_REACH_MM: f64 = 300.0;
/// Source-to-detector distance of a projection matrix, which does not define it, in units of the source-to-isocentre
/// distance.
const MATRIX_SID: f64 = 1.5;
/// Distance of a detector's number beyond the detector's middle, pixels.
const BEYOND: f64 = 24.0;
const MAX_NAMED: usize = 24;
const WHITE: Rgb<u8> = Rgb([255, 255, 255]);
const INK: Rgb<u8> = Rgb([40, 42, 48]);
const GREY: Rgb<u8> = Rgb([165, 168, 175]);
const AXES: Rgb<u8> = Rgb([120, 124, 132]);
/// Colours of training views.
const COLOURS: [Rgb<u8>; 6] = [
    Rgb([214, 39, 60]),
    Rgb([20, 120, 220]),
    Rgb([40, 150, 50]),
    Rgb([225, 120, 0]),
    Rgb([150, 60, 220]),
    Rgb([0, 150, 150]),
];

/// Viewing direction of a field: patient directions (left, posterior, superior) of its columns and rows.
struct Side {
    title: &'static str,
    columns: DVec3,
    rows: DVec3,
    /// Position of the field among the four.
    at: [u32; 2],
}

const SIDES: [Side; 3] = [
    Side { title: "FROM THE FEET", columns: DVec3::X, rows: DVec3::Y, at: [0, 0] },
    Side { title: "FROM THE FRONT", columns: DVec3::X, rows: DVec3::NEG_Z, at: [0, 1] },
    Side { title: "FROM THE LEFT", columns: DVec3::Y, rows: DVec3::NEG_Z, at: [1, 1] },
];

/// A C-arm in patient coordinates, mm.
struct DrawnCArm {
    source_mm: DVec3,
    /// Middle of the detector, where the central ray ends.
    middle_mm: DVec3,
    corners_mm: [DVec3; 4],
    name: String,
    colour: Rgb<u8>,
}

impl DrawnCArm {
    fn of(dataset: &Dataset, view: usize, colour: Rgb<u8>) -> DrawnCArm {
        let seen = &dataset.views[view];
        let sid = match &seen.geometry {
            Geometry::CArm(c_arm) => c_arm.sid_mm / MM_PER_UNIT,
            Geometry::Matrix(_) => MATRIX_SID * seen.rays.sod,
        };
        let (source, [right, bottom]) = (seen.rays.source(), seen.size.map(|n| n as f64 - 0.5));
        let at = |i: f64, j: f64| lps_mm_from_world(source + sid * seen.rays.pixel(i, j).1);
        let [primary, secondary] = angles_deg_of(seen.rays.axis());
        let angle = |value: f64, plus: &str, minus: &str| {
            format!("{} {:.0}°", if value >= -0.5 { plus } else { minus }, value.abs())
        };
        DrawnCArm {
            source_mm: lps_mm_from_world(source),
            middle_mm: at(0.5 * (right - 0.5), 0.5 * (bottom - 0.5)),
            corners_mm: [at(-0.5, -0.5), at(right, -0.5), at(right, bottom), at(-0.5, bottom)],
            name: format!("{view}: {}, {}", angle(primary, "LAO", "RAO"), angle(secondary, "CRA", "CAU")),
            colour,
        }
    }

    fn places_mm(&self) -> impl Iterator<Item = DVec3> {
        [self.source_mm, self.middle_mm].into_iter().chain(self.corners_mm)
    }
}

/// One field of the picture.
struct Field<'a> {
    picture: &'a mut RgbImage,
    side: &'a Side,
    /// Distance from the middle of the field to its edge, mm.
    reach_mm: f64,
}

impl Field<'_> {
    fn place(&self, point_mm: DVec3) -> DVec2 {
        let middle = DVec2::from_array(self.side.at.map(|n| f64::from(n * FIELD + FIELD / 2)));
        let pixels_per_mm = (0.5 * f64::from(FIELD) - MARGIN) / self.reach_mm;
        middle + pixels_per_mm * DVec2::new(point_mm.dot(self.side.columns), point_mm.dot(self.side.rows))
    }

    fn dot(&mut self, place: DVec2, half: i64, colour: Rgb<u8>) {
        let [x, y] = place.to_array().map(|v| v.round() as i64);
        for (dx, dy) in (-half..=half).flat_map(|dy| (-half..=half).map(move |dx| (dx, dy))) {
            if let (Ok(x), Ok(y)) = (u32::try_from(x + dx), u32::try_from(y + dy))
                && let Some(pixel) = self.picture.get_pixel_mut_checked(x, y)
            {
                *pixel = colour;
            }
        }
    }

    fn line(&mut self, from_mm: DVec3, to_mm: DVec3, half: i64, colour: Rgb<u8>) {
        let (from, to) = (self.place(from_mm), self.place(to_mm));
        let steps = from.distance(to).ceil().max(1.0);
        (0..=steps as usize).for_each(|i| self.dot(from.lerp(to, i as f64 / steps), half, colour));
    }

    fn text(&mut self, place: DVec2, text: &str, colour: Rgb<u8>) {
        lettering::write(self.picture, (place.x.round() as i64, place.y.round() as i64), text, colour);
    }

    fn axes(&mut self) {
        let corner = DVec2::from_array(self.side.at.map(|n| f64::from(n * FIELD)));
        self.text(corner + 12.0, self.side.title, INK);
        for (axis, name) in [(DVec3::X, "LEFT"), (DVec3::Y, "POSTERIOR"), (DVec3::Z, "SUPERIOR")] {
            let end = AXIS_SHARE * self.reach_mm * axis;
            self.line(DVec3::ZERO, end, 0, AXES);
            // An axis that points at the viewer is not labelled.
            if self.place(end).distance(self.place(DVec3::ZERO)) > 1.0 {
                self.text(self.place(end) + 4.0, name, AXES);
            }
        }
        self.dot(self.place(DVec3::ZERO), 4, INK);
        self.text(self.place(DVec3::ZERO) - DVec2::new(46.0, 20.0), "ISO", INK);
    }

    fn stand(&mut self, stand: &DrawnCArm) {
        self.line(stand.source_mm, stand.middle_mm, 0, stand.colour);
        for (k, corner) in stand.corners_mm.into_iter().enumerate() {
            self.line(corner, stand.corners_mm[(k + 1) % 4], 1, stand.colour);
        }
        self.dot(self.place(stand.source_mm), 5, stand.colour);
        let number = stand.name.split(':').next().unwrap_or_default();
        // Numbers are placed at the detectors, which are farther apart than the sources.
        let (iso, middle) = (self.place(DVec3::ZERO), self.place(stand.middle_mm));
        let beyond = middle + BEYOND * (middle - iso).normalize_or(DVec2::X);
        self.text(beyond - DVec2::new(5.0, 7.0), number, stand.colour);
    }
}

/// Draws the picture of a dataset.
pub fn drawn(dataset: &Dataset) -> RgbImage {
    let training = dataset.training_views();
    let colour = |view: usize| {
        training.iter().position(|training| *training == view).map_or(GREY, |place| COLOURS[place % COLOURS.len()])
    };
    let stands: Vec<DrawnCArm> =
        (0..dataset.views.len()).map(|view| DrawnCArm::of(dataset, view, colour(view))).collect();
    let reach_mm =
        stands.iter().flat_map(DrawnCArm::places_mm).map(|p| p.abs().max_element()).fold(MIN_REACH_MM, f64::max);
    let mut picture = RgbImage::from_pixel(2 * FIELD, 2 * FIELD, WHITE);
    for side in &SIDES {
        let mut field = Field { picture: &mut picture, side, reach_mm };
        field.axes();
        // Training views are drawn over the others.
        let (unseen, seen): (Vec<&DrawnCArm>, Vec<&DrawnCArm>) = stands.iter().partition(|stand| stand.colour == GREY);
        unseen.into_iter().chain(seen).for_each(|stand| field.stand(stand));
    }
    let left = i64::from(FIELD) + 12;
    let mut top = 12;
    let mut line = |text: &str, colour: Rgb<u8>| {
        lettering::write(&mut picture, (left, top), text, colour);
        top += i64::from(lettering::HEIGHT) + 5;
    };
    line("VIEWS: SQUARE SOURCE, FRAMED DETECTOR", INK);
    for stand in stands.iter().take(MAX_NAMED) {
        line(&format!("{}{}", stand.name, if stand.colour == GREY { ", UNSEEN" } else { "" }), stand.colour);
    }
    if stands.len() > MAX_NAMED {
        line(&format!("AND {} MORE", stands.len() - MAX_NAMED), INK);
    }
    picture
}

/// Writes the picture of a dataset as PNG.
///
/// # Errors
/// [`nertca_vk::error::Error::Io`].
pub fn write(dataset: &Dataset, path: &Path) -> Result<()> {
    Ok(png::write(path, &DynamicImage::ImageRgb8(drawn(dataset)))?)
}
