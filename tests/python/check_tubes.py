"""Plays the tubes of a tree with VTK's glTF reader, and weighs them with trimesh: rings have the tree's radii around its points.

    python3 check_tubes.py TUBES.glb TREE.json   # made by tests/cli/trees.rs of the same phases
"""
import json
import struct
import sys

import numpy as np
import trimesh
from vtkmodules.util.numpy_support import vtk_to_numpy
from vtkmodules.vtkIOGeometry import vtkGLTFReader

CORNERS = 16
METRES_PER_MM = 1e-3
NEAR_MM = 1e-3
BEAT_S = 1.0

path = sys.argv[1]
tree = json.load(open(sys.argv[2]))
phases = tree["phases"]


def seen(points_mm):
    """Places in glTF's axes: left, superior, anterior."""
    left, posterior, superior = np.array(points_mm).T
    return np.stack([left, superior, -posterior], axis=1)


def polydata(block):
    if block is None:
        return []
    if block.IsA("vtkMultiBlockDataSet"):
        return [found for i in range(block.GetNumberOfBlocks()) for found in polydata(block.GetBlock(i))]
    return [vtk_to_numpy(block.GetPoints().GetData()) / METRES_PER_MM]


def check_tube(vertices, points, radii):
    n = len(points)
    assert len(vertices) == CORNERS * n + 2 * (CORNERS + 1), (len(vertices), n)
    rings = vertices[: CORNERS * n].reshape(n, CORNERS, 3)
    away = np.linalg.norm(rings - points[:, None], axis=2)
    assert np.abs(away - radii[:, None]).max() < NEAR_MM, np.abs(away - radii[:, None]).max()
    # The ring goes all the way round its point, across the line.
    assert np.abs(rings.mean(axis=1) - points).max() < NEAR_MM
    caps = vertices[CORNERS * n:].reshape(2, CORNERS + 1, 3)
    assert np.abs(caps[:, :CORNERS] - rings[[0, -1]]).max() < NEAR_MM
    assert np.abs(caps[:, CORNERS] - points[[0, -1]]).max() < NEAR_MM


def check_animation():
    """What VTK shows at the time of each phase, and halfway to the next, until the beat has closed."""
    reader = vtkGLTFReader()
    reader.SetFileName(path)
    reader.SetFrameRate(1000)
    reader.ApplyDeformationsToGeometryOn()
    reader.UpdateInformation()
    n = len(phases)
    assert reader.GetNumberOfAnimations() == (1 if n > 1 else 0), path
    if n > 1:
        assert reader.GetAnimationName(0) == "beat" and np.isclose(reader.GetAnimationDuration(0), BEAT_S)
        reader.EnableAnimation(0)
    for step in range(2 * n + 1 if n > 1 else 1):
        reader.UpdateInformation()
        reader.UpdateTimeStep(BEAT_S * step / (2 * n))
        tubes = polydata(reader.GetOutput())
        before, after = phases[step // 2 % n]["branches"], phases[(step + 1) // 2 % n]["branches"]
        assert len(tubes) == len(before), (len(tubes), len(before))
        for tube, a, b in zip(tubes, before, after):
            if step % 2 == 0:
                check_tube(tube, seen(a["points_mm"]), np.array(a["radius_mm"]))
            else:
                rings = tube[: CORNERS * len(a["points_mm"])].reshape(-1, CORNERS, 3)
                halfway = (seen(a["points_mm"]) + seen(b["points_mm"])) / 2
                assert np.abs(rings.mean(axis=1) - halfway).max() < NEAR_MM, step


def check_solids(scene):
    """Closed, turned outwards, and about as large as cones between rings, which lean where a line bends."""
    share = CORNERS / (2 * np.pi) * np.sin(2 * np.pi / CORNERS)
    for index, branch in enumerate(phases[0]["branches"]):
        solid = scene.geometry[scene.graph[f"branch {index}"][1]].copy()
        solid.merge_vertices(merge_norm=True, merge_tex=True)
        assert solid.is_watertight and solid.is_winding_consistent, index
        r, steps = np.array(branch["radius_mm"]), np.linalg.norm(np.diff(branch["points_mm"], axis=0), axis=1)
        wanted = share * np.pi / 3 * (steps * (r[1:] ** 2 + r[1:] * r[:-1] + r[:-1] ** 2)).sum()
        found = solid.volume / METRES_PER_MM**3
        assert abs(found / wanted - 1) < 0.1, (index, found, wanted)


def check_phases(scene):
    """Trees that are not followed: a mesh per phase, shown for its share of the beat."""
    for row in phases:
        transform, mesh = scene.graph[f"phase {row['phase']}"]
        vertices = scene.geometry[mesh].vertices / METRES_PER_MM
        first = 0
        for branch in row["branches"]:
            count = CORNERS * len(branch["points_mm"]) + 2 * (CORNERS + 1)
            check_tube(vertices[first:first + count], seen(branch["points_mm"]), np.array(branch["radius_mm"]))
            first += count
        assert first == len(vertices), (first, len(vertices))


def check_document():
    """What the standard asks for and readers may forgive."""
    data = open(path, "rb").read()
    magic, version, length = struct.unpack_from("<4sII", data)
    assert (magic, version, length) == (b"glTF", 2, len(data))
    size = struct.unpack_from("<I", data, 12)[0]
    document = json.loads(data[20:20 + size])
    binary = data[20 + size + 8:]
    assert document["buffers"][0]["byteLength"] <= len(binary)
    widths = {"SCALAR": 1, "VEC3": 3}

    def array(index):
        accessor = document["accessors"][index]
        view = document["bufferViews"][accessor["bufferView"]]
        count = accessor["count"] * widths[accessor["type"]]
        assert view["byteOffset"] % 4 == 0 and view["byteLength"] == 4 * count, index
        kind = {5126: "<f4", 5125: "<u4"}[accessor["componentType"]]
        return accessor, np.frombuffer(binary, kind, count, view["byteOffset"]).reshape(-1, widths[accessor["type"]])

    for mesh in document["meshes"]:
        for primitive in mesh["primitives"]:
            targets = primitive.get("targets", [])
            assert len(mesh.get("weights", [])) == len(targets)
            for attributes in [primitive["attributes"], *targets]:
                accessor, places = array(attributes["POSITION"])
                assert np.allclose(accessor["min"], places.min(axis=0)), "bounds"
                assert np.allclose(accessor["max"], places.max(axis=0)), "bounds"
                assert array(attributes["NORMAL"])[0]["count"] == accessor["count"]
    if tree["tracked"]:
        assert all(len(mesh["primitives"][0].get("targets", [])) == len(phases) - 1 for mesh in document["meshes"])
    for animation in document.get("animations", []):
        assert {channel["target"]["node"] for channel in animation["channels"]} == set(range(len(document["nodes"])))


check_document()
opened = trimesh.load(path)
if tree["tracked"]:
    assert len(opened.geometry) == len(phases[0]["branches"])
    check_solids(opened)
    check_animation()
else:
    check_phases(opened)
