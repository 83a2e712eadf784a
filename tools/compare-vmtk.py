#!/usr/bin/env python3
"""Compares the radii of a tree with those that VMTK measures on an exported surface (needs vmtk from PyPI, with its numpy and vtk).

    nertca-vk tree RUN -o tree.json --phase 0
    nertca-vk export RUN --mesh --phase 0 --spacing 0.4 --iso 0.03 -o vessels.stl
    python3 tools/compare-vmtk.py vessels.stl tree.json

VMTK finds centrelines between the ends of the branches, in each connected part of the surface, with the radius of the largest inscribed
sphere. Each point of the tree within a millimetre of one is compared.
"""

import argparse
import json

import numpy as np
import vtk
from vmtk import vmtkscripts
from vtk.util.numpy_support import vtk_to_numpy

MIN_POINTS = 300  # of a part of the surface
SEED_MM = 3.0  # largest distance of the end of a branch from the surface
APART_MM = 1.0  # least distance of two seeds
MATCHED_MM = 1.0  # largest distance of a point of the tree from VMTK's centreline
LESION_MM = 3.0  # length of the centreline on both sides of a stenosis in which VMTK's least radius is taken


def parts(surface):
    """Connected parts of a surface."""
    connected = vtk.vtkPolyDataConnectivityFilter()
    connected.SetInputData(surface)
    connected.SetExtractionModeToAllRegions()
    connected.Update()
    count = connected.GetNumberOfExtractedRegions()
    connected.SetExtractionModeToSpecifiedRegions()
    for number in range(count):
        connected.InitializeSpecifiedRegionList()
        connected.AddSpecifiedRegion(number)
        clean = vtk.vtkCleanPolyData()
        clean.SetInputConnection(connected.GetOutputPort())
        clean.Update()
        part = vtk.vtkPolyData()
        part.DeepCopy(clean.GetOutput())
        if part.GetNumberOfPoints() >= MIN_POINTS:
            yield part


def seeds(part, ends):
    """Ends of branches that lie at a part of the surface, apart from each other."""
    points, found = vtk_to_numpy(part.GetPoints().GetData()), []
    for end in ends:
        is_new = all(np.linalg.norm(end - other) > APART_MM for other in found)
        if is_new and np.linalg.norm(points - end, axis=1).min() < SEED_MM:
            found.append(end)
    return found


def centreline(part, ends):
    """Points and radii of VMTK's centrelines from one end to the others."""
    lines = vmtkscripts.vmtkCenterlines()
    lines.Surface, lines.SeedSelectorName, lines.AppendEndPoints = part, "pointlist", 0
    lines.SourcePoints = [float(v) for v in ends[0]]
    lines.TargetPoints = [float(v) for end in ends[1:] for v in end]
    lines.Resampling, lines.ResamplingStepLength = 1, 0.3
    lines.Execute()
    if lines.Centerlines.GetNumberOfPoints() == 0:
        return np.empty((0, 3)), np.empty(0)
    radii = lines.Centerlines.GetPointData().GetArray("MaximumInscribedSphereRadius")
    return vtk_to_numpy(lines.Centerlines.GetPoints().GetData()).copy(), vtk_to_numpy(radii).copy()


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("mesh", help="surface of a phase (.stl)")
    parser.add_argument("tree", help="tree of the same phase (.json)")
    args = parser.parse_args()
    reader = vmtkscripts.vmtkSurfaceReader()
    reader.InputFileName = args.mesh
    reader.Execute()
    with open(args.tree, encoding="utf-8") as file:
        phase = json.load(file)["phases"][0]
    branches = phase["branches"]
    ends = [np.array(branch["points_mm"][k]) for branch in branches for k in (0, -1)]
    seeded = [(part, found) for part in parts(reader.Surface) if len(found := seeds(part, ends)) > 1]
    lines = [centreline(part, found) for part, found in seeded]
    places, radii = np.concatenate([line[0] for line in lines]), np.concatenate([line[1] for line in lines])

    ours, theirs = [], []
    for branch in branches:
        for point, radius in zip(branch["points_mm"], branch["radius_mm"]):
            away = np.linalg.norm(places - np.array(point), axis=1)
            if away.min() < MATCHED_MM:
                ours.append(radius)
                theirs.append(radii[away.argmin()])
    ours, theirs = np.array(ours), np.array(theirs)
    print(f"{len(ours)} points; ours - VMTK's: mean {np.mean(ours - theirs):+.3f} mm, mean absolute {np.mean(np.abs(ours - theirs)):.3f} mm, "
          f"correlation {np.corrcoef(ours, theirs)[0, 1]:.3f}")
    for lesion in phase["lesions"]:
        branch = branches[lesion["branch"]]
        near = np.linalg.norm(places - np.array(branch["points_mm"][lesion["point"]]), axis=1) < LESION_MM
        if near.any():
            print(f"stenosis: least radius {lesion['min_diameter_mm'] / 2:.3f} mm (with the field's blur {branch['radius_mm'][lesion['point']]:.3f}), "
                  f"VMTK's {radii[near].min():.3f}")


if __name__ == "__main__":
    main()
