//! Projections and a geometry that RTK has written (`tests/python/write_rtk.py`): the import gives rays along which an ellipsoid has the line
//! integrals of RTK.

use crate::root::root;
use glam::DVec3;
use nertca_vk::error::Result;
use nertca_vk::geometry::MM_PER_UNIT;
use nertca_vk::scan::dataset::Dataset;
use nertca_vk::scan::rtk::{RtkOptions, import};
use std::path::{Path, PathBuf};

/// Ellipsoid of the script in (posterior, left, superior), mm.
const CENTRE: DVec3 = DVec3::new(-13.0, 6.0, -9.0);
const HALF_AXES: DVec3 = DVec3::new(11.0, 14.0, 8.0);
const PER_MM: f64 = 0.02;

fn file(name: &str) -> PathBuf {
    root().join("tests/formats/rtk").join(name)
}

fn options(times: Option<Vec<f64>>) -> RtkOptions {
    RtkOptions { phases: 4, times, depth_half_extent_mm: 80.0 }
}

/// Line integral of the ellipsoid along a ray through `from`, mm, along the unit vector `along`.
fn integral(from: DVec3, along: DVec3) -> f64 {
    let (p, d) = ((from - CENTRE) / HALF_AXES, along / HALF_AXES);
    let (a, b, c) = (d.length_squared(), p.dot(d), p.length_squared() - 1.0);
    let root = b * b - a * c;
    if root <= 0.0 { 0.0 } else { PER_MM * 2.0 * root.sqrt() / a }
}

#[test]
fn rays_are_those_of_rtk() {
    let directory = tempfile::tempdir().unwrap();
    let times = Some(vec![0.0, 1.0, 2.0, 3.0]);
    let views = import(&file("geometry.xml"), &file("projections.mha"), &options(times), directory.path()).unwrap();
    let data = Dataset::open(directory.path()).unwrap();
    assert_eq!((views, data.views.len(), data.frames.len(), data.n_phases), (4, 4, 4, 4));
    let mut off = 0f64;
    for frame in &data.frames {
        let rays = &data.views[frame.view].rays;
        let [width, _] = data.views[frame.view].size;
        let mut largest = 0f64;
        for (p, found) in frame.integrals.iter().enumerate() {
            let (point, along) = rays.pixel((p % width) as f64, (p / width) as f64);
            let wanted = integral(MM_PER_UNIT * point, along.normalize());
            largest = largest.max(wanted);
            off = off.max((f64::from(*found) - wanted).abs());
        }
        assert!(largest > 0.3, "{}: the ellipsoid is seen", frame.name);
    }
    assert!(off < 1e-4, "{off}");
}

#[test]
fn pictures_stand_upright_and_need_no_times() {
    let directory = tempfile::tempdir().unwrap();
    import(&file("geometry.xml"), &file("projections.mha"), &options(None), directory.path()).unwrap();
    let data = Dataset::open(directory.path()).unwrap();
    assert!(data.still, "without times the object is at rest");
    // The source of RTK's angle 0 is anterior.
    let rays = &data.views[0].rays;
    let at = |lps: DVec3| rays.project(DVec3::new(lps.y, lps.x, lps.z) / MM_PER_UNIT).unwrap();
    assert!(at(DVec3::Z * 10.0).1 < at(DVec3::ZERO).1, "superior is above");
    assert!(rays.source().x < 0.0, "the source is anterior");
}

#[test]
fn what_does_not_fit_is_named() {
    let directory = tempfile::tempdir().unwrap();
    let at = |name: &str| directory.path().join(name);
    let tried = |geometry: &Path, projections: &Path, options: &RtkOptions| -> Result<usize> {
        import(geometry, projections, options, &at("data"))
    };
    let (good, stack) = (file("geometry.xml"), file("projections.mha"));
    let text = std::fs::read_to_string(&good).unwrap();
    let one = text[..text.find("</Projection>").unwrap()].to_owned() + "</Projection></RTKThreeDCircularGeometry>";
    std::fs::write(at("one.xml"), one).unwrap();
    let bytes = std::fs::read(&stack).unwrap();
    let turned: Vec<u8> = {
        let (from, to) = ("TransformMatrix = 1 0 0 0 1 0", "TransformMatrix = 0 1 0 1 0 0");
        let place = bytes.windows(from.len()).position(|part| part == from.as_bytes()).unwrap();
        [&bytes[..place], to.as_bytes(), &bytes[place + from.len()..]].concat()
    };
    std::fs::write(at("turned.mha"), turned).unwrap();
    let near = RtkOptions { depth_half_extent_mm: 800.0, ..options(None) };
    for (geometry, projections, options, parts) in [
        (&at("one.xml"), &stack, options(None), ["one.xml", "1 projections"]),
        (&good, &at("turned.mha"), options(None), ["turned.mha", "orientation"]),
        (&good, &stack, options(Some(vec![0.0; 3])), ["phases", "4 projections"]),
        (&good, &stack, options(Some(vec![0.0, 1.0, 2.0, 4.0])), ["phase", "out of range"]),
        (&good, &stack, near, ["projection 1", "too small"]),
        (&at("none.xml"), &stack, options(None), ["none.xml", "read"]),
    ] {
        let message = tried(geometry, projections, &options).unwrap_err().to_string();
        assert!(parts.iter().all(|part| message.contains(part)), "{parts:?}: {message}");
        assert!(!at("data").join("dataset.json").exists());
    }
}
