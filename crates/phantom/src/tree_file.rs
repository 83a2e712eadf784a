//! Tree files: the input of `phantom --tree`, and the true vessels that phantoms write.

use crate::error::{Error, Result};
use crate::files;
use crate::formats::vtp::{self, ReadLines};
use crate::tree::{Bounds, Branch, Tree};
use glam::DVec3;
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};

/// File of the true vessels as a tree, in the directory of a dataset's volumes.
pub const TREE: &str = "tree.json";
/// Names of arrays of radii at points: the name VMTK and 3D Slicer use, and other common names.
const RADII: [&str; 3] = ["MaximumInscribedSphereRadius", "Radius", "radius"];
/// Largest accepted coordinate and radius, mm.
const FARTHEST_MM: f64 = 1e4;
/// Largest accepted length of all branches together, mm: lines are compared point by point.
const LONGEST_MM: f64 = 1e6;
/// Advice where a length is out of range.
pub(super) const UNITS: &str = "lengths are mm; in micrometres they are 1000 times as large, in metres a thousandth";

/// A tree over its beat, as stored in a file.
#[derive(Debug, Serialize, Deserialize)]
pub struct TreeFile {
    branches: Vec<TreeBranch>,
    radius_mm: Vec<f64>,
    points_mm: Vec<Vec<[f64; 3]>>,
}

#[derive(Debug, Serialize, Deserialize)]
struct TreeBranch {
    name: String,
    first: usize,
    count: usize,
}

impl TreeFile {
    /// Reads a tree (see `docs/formats.md`): JSON in RAS mm; lines of a `.vtp` in LPS mm, which do not move; or the files that
    /// a `.pvd` names, which are the phases of a beat.
    ///
    /// # Errors
    /// [`Error::Data`] naming file and field, [`Error::Io`].
    pub fn read(path: &Path) -> Result<TreeFile> {
        let extension = path.extension().unwrap_or_default().to_string_lossy().to_lowercase();
        let file = match extension.as_str() {
            "vtp" => TreeFile::of_lines(&[(path.to_path_buf(), vtp::read(path)?)])?,
            "pvd" => {
                let phases = vtp::read_collection(path)?;
                let lines = phases.into_iter().map(|file| -> Result<_> { Ok((file.clone(), vtp::read(&file)?)) });
                TreeFile::of_lines(&lines.collect::<Result<Vec<_>>>()?)?
            }
            _ => files::read_json(path, 1 << 30)?,
        };
        file.check(path)?;
        Ok(file)
    }

    /// Makes a tree from files that are the phases of a beat and must contain the same lines. Radii are those of the first
    /// file.
    fn of_lines(phases: &[(PathBuf, ReadLines)]) -> Result<TreeFile> {
        let Some((first_file, rest)) = phases.first() else {
            return Ok(TreeFile { branches: Vec::new(), radius_mm: Vec::new(), points_mm: Vec::new() });
        };
        let named = |name: &&str| rest.of_points.iter().find(|(found, _)| found == *name);
        let radii = RADII.iter().find_map(named).ok_or_else(|| {
            let found: Vec<&str> = rest.of_points.iter().map(|(name, _)| name.as_str()).collect();
            let problem =
                format!("has none of the arrays of radii {}; its arrays are: {}", RADII.join(", "), found.join(", "));
            Error::data(first_file, "PointData", problem)
        })?;
        let mut first = 0;
        let branch = |(index, line): (usize, &Vec<usize>)| {
            let branch = TreeBranch { name: format!("line {index}"), first, count: line.len() };
            first += line.len();
            branch
        };
        let branches = rest.lines.iter().enumerate().map(branch).collect();
        let count = |lines: &ReadLines| lines.lines.iter().map(Vec::len).collect::<Vec<_>>();
        for (file, lines) in phases {
            if count(lines) != count(rest) {
                let problem = format!(
                    "differ from those of {}: all files of a beat must have the same lines and the same points",
                    first_file.display()
                );
                return Err(Error::data(file, "Lines", problem));
            }
        }
        let ras = |p: [f64; 3]| [-p[0], -p[1], p[2]];
        let points =
            |lines: &ReadLines| lines.lines.iter().flatten().map(|point| ras(lines.points[*point])).collect::<Vec<_>>();
        Ok(TreeFile {
            branches,
            radius_mm: rest.lines.iter().flatten().map(|point| radii.1[*point]).collect(),
            points_mm: phases.iter().map(|(_, lines)| points(lines)).collect(),
        })
    }

    /// Makes a tree from its shapes at equal fractions of the beat, which must have the same branches; none without shapes.
    pub fn of(shapes: &[Tree]) -> Option<TreeFile> {
        let rest = shapes.first()?;
        let firsts = rest.branches.iter().scan(0, |end, branch| {
            let first = *end;
            *end += branch.points.len();
            Some(first)
        });
        let branch = |(branch, first): (&Branch, usize)| TreeBranch {
            name: branch.name.clone(),
            first,
            count: branch.points.len(),
        };
        let ras = |p: &DVec3| [-p.x, -p.y, p.z];
        let points = |tree: &Tree| tree.branches.iter().flat_map(|b| b.points.iter().map(ras)).collect();
        Some(TreeFile {
            branches: rest.branches.iter().zip(firsts).map(branch).collect(),
            radius_mm: rest.branches.iter().flat_map(|b| b.radius_mm.iter().copied()).collect(),
            points_mm: shapes.iter().map(points).collect(),
        })
    }

    /// Writes the tree in the JSON format that [`TreeFile::read`] reads.
    ///
    /// # Errors
    /// [`Error::Io`].
    pub fn write(&self, path: &Path) -> Result<()> {
        let json = serde_json::to_string(self).map_err(|e| Error::Internal(e.to_string()))?;
        Ok(files::write_atomic(path, json.as_bytes())?)
    }

    /// Tree at a fraction (0 to 1) of its beat, by linear interpolation between the stored phases; the beat is cyclic.
    pub fn at(&self, fraction: f64) -> Tree {
        let stored = self.points_mm.len();
        let x = fraction * stored as f64;
        let (a, b) = (x as usize % stored, (x as usize + 1) % stored);
        let point = |i: usize| {
            let (from, to) = (DVec3::from_array(self.points_mm[a][i]), DVec3::from_array(self.points_mm[b][i]));
            let ras = from.lerp(to, x.fract());
            DVec3::new(-ras.x, -ras.y, ras.z)
        };
        let branch = |b: &TreeBranch| {
            let range = b.first..b.first + b.count;
            Branch {
                name: b.name.clone(),
                points: range.clone().map(point).collect(),
                radius_mm: self.radius_mm[range].to_vec(),
                filling: vec![1.0; b.count],
            }
        };
        Tree { branches: self.branches.iter().map(branch).collect() }
    }

    /// Trees of the stored phases, at equal fractions of the beat.
    pub fn stored(&self) -> impl Iterator<Item = Tree> {
        let stored = self.points_mm.len();
        (0..stored).map(move |phase| self.at(phase as f64 / stored as f64))
    }

    /// Bounding box over all stored phases, including radii.
    pub(super) fn bounds(&self) -> Bounds {
        self.stored().map(|tree| tree.bounds()).fold(Bounds::EMPTY, Bounds::joined)
    }

    /// Index and value of the largest radius, mm.
    pub(super) fn widest_mm(&self) -> (usize, f64) {
        let radii = self.radius_mm.iter().copied().enumerate();
        radii.fold((0, 0.0), |widest, next| if next.1 > widest.1 { next } else { widest })
    }

    /// Returns the tree moved by `shift_mm` (LPS).
    pub(super) fn moved(mut self, shift_mm: DVec3) -> TreeFile {
        let ras = [-shift_mm.x, -shift_mm.y, shift_mm.z];
        for point in self.points_mm.iter_mut().flatten() {
            point.iter_mut().zip(ras).for_each(|(at, by)| *at += by);
        }
        self
    }

    fn check(&self, path: &Path) -> Result<()> {
        let n = self.radius_mm.len();
        if self.points_mm.is_empty() || self.branches.is_empty() {
            return Err(Error::data(path, "points_mm", "has no phase or no branch"));
        }
        if let Some(i) = self.radius_mm.iter().position(|r| !(r.is_finite() && *r > 0.0)) {
            return Err(Error::data(path, format!("radius_mm[{i}]"), "is not a positive length"));
        }
        if let Some(i) = self.radius_mm.iter().position(|r| *r > FARTHEST_MM) {
            let problem = format!("{:e} is not the radius of a vessel in mm: {UNITS}", self.radius_mm[i]);
            return Err(Error::data(path, format!("radius_mm[{i}]"), problem));
        }
        for (p, points) in self.points_mm.iter().enumerate() {
            if points.len() != n {
                return Err(Error::data(
                    path,
                    format!("points_mm[{p}]"),
                    format!("has {} points for {n} radii", points.len()),
                ));
            }
            if let Some(i) = points.iter().position(|x| x.iter().any(|v| v.is_nan() || v.abs() > FARTHEST_MM)) {
                let problem = format!("{:?} is not a position in mm: {UNITS}", points[i]);
                return Err(Error::data(path, format!("points_mm[{p}][{i}]"), problem));
            }
        }
        for (i, b) in self.branches.iter().enumerate() {
            if b.count < 2 || b.first.checked_add(b.count).is_none_or(|end| end > n) {
                return Err(Error::data(
                    path,
                    format!("branches[{i}]"),
                    "its range exceeds the point array or has fewer than 2 points",
                ));
            }
        }
        let length = |points: &Vec<[f64; 3]>| -> f64 {
            let of_branch = |b: &TreeBranch| {
                let points = points[b.first..b.first + b.count].iter().map(|p| DVec3::from_array(*p));
                points.clone().zip(points.skip(1)).map(|(a, b)| a.distance(b)).sum::<f64>()
            };
            self.branches.iter().map(of_branch).sum()
        };
        if let Some((p, long)) = self.points_mm.iter().map(length).enumerate().find(|(_, l)| *l > LONGEST_MM) {
            let problem = format!("the branches are {long:.0} mm long, more than {LONGEST_MM:.0} mm together: {UNITS}");
            return Err(Error::data(path, format!("points_mm[{p}]"), problem));
        }
        Ok(())
    }
}
