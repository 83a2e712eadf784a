"""Opens trees with VTK and compares them with the true vessels by SciPy.

    python3 check_trees.py DIRECTORY   # made by tests/cli/trees.rs
"""
import json
import sys
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import numpy as np
from compare_trees import compare, read_truth, show
from scipy.spatial import cKDTree
from vtkmodules.util.numpy_support import vtk_to_numpy
from vtkmodules.vtkIOXML import vtkXMLPolyDataReader

directory = Path(sys.argv[1])
NEAR_MM = 1.0

truth = read_truth(directory / "truth.json")
true_points, _, true_branches = truth
beat = json.loads((directory / "beat.json").read_text())


def length(points):
    return np.linalg.norm(np.diff(points, axis=0), axis=1).sum()


def check_json():
    assert beat["format"] == "nertca-tree" and beat["version"] == 1 and beat["axes"] == "left, posterior, superior"
    assert beat["tracked"] is True and beat["reference_phase"] == 0
    assert [row["phase"] for row in beat["phases"]] == list(range(len(true_points)))
    for row in beat["phases"]:
        for branch in row["branches"]:
            points = np.array(branch["points_mm"])
            assert len(points) == len(branch["radius_mm"]) >= 2
            assert np.isclose(length(points), branch["length_mm"], atol=0.02)
            if branch["parent"] is not None:
                assert branch["points_mm"][0] == row["branches"][branch["parent"]]["points_mm"][-1]
        total = sum(branch["length_mm"] for branch in row["branches"])
        assert np.isclose(total, row["length_mm"], atol=0.01)
        shape = [(branch["parent"], len(branch["points_mm"])) for branch in row["branches"]]
        assert shape == [(branch["parent"], len(branch["points_mm"])) for branch in beat["phases"][0]["branches"]]


def check_against_truth():
    """Of each phase: where the lines are, how wide they are and how many."""
    for row in beat["phases"]:
        scores = compare(truth, row["phase"], row["branches"], NEAR_MM)
        show(f"phase {row['phase']}", scores)
        assert scores["components"] == 1 and len(row["branches"]) == 3, (row["phase"], scores)
        assert scores["ours_near"] > 0.97 and scores["true_near"] > 0.95, (row["phase"], scores)
        assert scores["ours_to_true_mm"] < 0.4 and scores["radius_rmse_mm"] < 0.2, (row["phase"], scores)


def check_phantom():
    """The phantom leaves the tree it was made of."""
    points, radii, branches = read_truth(directory / "data/volumes/tree.json")
    assert branches == true_branches
    assert np.allclose(points, true_points, atol=1e-9) and np.allclose(radii, truth[1], atol=1e-9)


def check_tracking():
    """Points of the lines go where the true points beside them go."""
    rest = np.concatenate([np.array(b["points_mm"]) for b in beat["phases"][0]["branches"]])
    index = np.arange(len(true_points[0]))
    # The same shares of the same segments at every phase, so that rows are material points.
    share = np.linspace(0, 1, 20, endpoint=False)
    inner = [i for b in true_branches for i in index[b][:-1]]
    material = [np.concatenate([p[i] + share[:, None] * (p[i + 1] - p[i]) for i in inner]) for p in true_points]
    away, nearest = cKDTree(material[0]).query(rest)
    near = away < 0.5
    assert near.mean() > 0.9, near.mean()
    for phase, row in enumerate(beat["phases"]):
        now = np.concatenate([np.array(b["points_mm"]) for b in row["branches"]])
        moved = (material[phase] - material[0])[nearest]
        errors = np.linalg.norm(now - rest - moved, axis=1)[near]
        motion = np.linalg.norm(moved, axis=1).mean()
        print(f"phase {phase}: moved {motion:.2f} mm, off by {errors.mean():.2f} mm on average")
        assert errors.mean() <= 1.2, (phase, errors.mean())


def read(file):
    reader = vtkXMLPolyDataReader()
    reader.SetFileName(str(file))
    reader.Update()
    assert reader.GetErrorCode() == 0, file
    return reader.GetOutput()


def check_vtk(file, row):
    lines = read(file)
    branches = row["branches"]
    assert lines.GetNumberOfCells() == lines.GetNumberOfLines() == len(branches), file
    points = vtk_to_numpy(lines.GetPoints().GetData())
    assert np.allclose(points, np.concatenate([b["points_mm"] for b in branches]), atol=1e-9), file
    of_points, of_lines = lines.GetPointData(), lines.GetCellData()
    radii = np.concatenate([b["radius_mm"] for b in branches])
    for name in ("Radius", "MaximumInscribedSphereRadius"):
        assert np.allclose(vtk_to_numpy(of_points.GetArray(name)), radii, atol=1e-9), (file, name)
    ids = np.concatenate([np.arange(len(b["points_mm"])) for b in branches])
    assert (vtk_to_numpy(of_points.GetArray("PointId")) == ids).all(), file
    assert (vtk_to_numpy(of_lines.GetArray("BranchId")) == np.arange(len(branches))).all(), file
    parents = [-1 if b["parent"] is None else b["parent"] for b in branches]
    assert (vtk_to_numpy(of_lines.GetArray("ParentId")) == parents).all(), file
    assert (vtk_to_numpy(of_lines.GetArray("Tracked")) == 1).all(), file
    assert lines.GetFieldData().GetArray("TimeValue").GetTuple1(0) == row["phase"], file
    first = 0
    for i, branch in enumerate(branches):
        cell = lines.GetCell(i)
        n = len(branch["points_mm"])
        assert cell.GetClassName() == "vtkPolyLine" or n == 2, file
        assert [cell.GetPointId(k) for k in range(cell.GetNumberOfPoints())] == list(range(first, first + n)), file
        first += n


def check_collection():
    sets = ElementTree.parse(directory / "beat.pvd").getroot().findall("Collection/DataSet")
    assert [float(entry.get("timestep")) for entry in sets] == [row["phase"] for row in beat["phases"]]
    for entry, row in zip(sets, beat["phases"]):
        check_vtk(directory / entry.get("file"), row)
    check_vtk(directory / "one.vtp", beat["phases"][2])


def check_swc(file, row):
    rows = np.loadtxt(file)
    assert (rows[:, 0] == np.arange(1, len(rows) + 1)).all() and (rows[:, 6] < rows[:, 0]).all(), file
    linked = rows[rows[:, 6] > 0]
    assert len(rows) - len(linked) == 1, file
    lengths = np.linalg.norm(linked[:, 2:5] - rows[linked[:, 6].astype(int) - 1, 2:5], axis=1)
    assert np.isclose(lengths.sum(), row["length_mm"], atol=0.05), (file, lengths.sum(), row["length_mm"])
    ours = cKDTree(np.column_stack([np.concatenate([b["points_mm"] for b in row["branches"]]),
                                    np.concatenate([b["radius_mm"] for b in row["branches"]])]))
    # Where branches meet, a point has the radius of the parent alone.
    assert ours.query(rows[:, 2:6])[0].max() < 1e-6, file


check_json()
check_phantom()
check_against_truth()
check_tracking()
check_collection()
for row in beat["phases"]:
    check_swc(directory / f"beat_{row['phase']:04}.swc", row)
