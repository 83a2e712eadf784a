"""Opens every kind of file the program exports with the tool people would use, and compares values and geometry.

    python3 check_exports.py DIRECTORY   # made by tests/cli/interop.rs
"""
import json
import sys
from pathlib import Path

import nibabel
import nrrd
import numpy as np
import safetensors.numpy
import SimpleITK as sitk
import trimesh

directory = Path(sys.argv[1])
expected = json.loads((directory / "expected.json").read_text())
origin, spacing, size = (np.array(expected[k]) for k in ("origin_mm", "spacing_mm", "size"))
phases = expected["phases"]

# (phase, superior, posterior, left)
every = np.load(directory / "all.npy")
one = np.load(directory / "one.npy")
assert every.shape == (phases, *size[::-1]) and every.dtype == np.float32
assert np.isfinite(every).all() and every.max() > 0
assert (every[1] == one).all(), "phase order"
assert any((every[p] != every[0]).any() for p in range(1, phases)), "phases differ"

data, header = nrrd.read(str(directory / "all.seq.nrrd"))
assert header["kinds"][0] == "list" and data.shape == (phases, *size)
assert (data.transpose(0, 3, 2, 1) == every).all()
assert header["space"] == "left-posterior-superior"
assert np.allclose(header["space origin"], origin) and np.allclose(header["space directions"][1:], np.diag(spacing))

image = nibabel.load(directory / "all.nii")
assert (np.asarray(image.dataobj).transpose(3, 2, 1, 0) == every).all()
to_ras = np.diag([-1, -1, 1])
assert np.allclose(image.affine[:3, :3], to_ras @ np.diag(spacing)) and np.allclose(image.affine[:3, 3], to_ras @ origin, atol=1e-4)
assert np.allclose(image.get_qform(), image.affine) and nibabel.aff2axcodes(image.affine) == ("L", "P", "S")

for name in ("one.mha", "one.nii", "one.nrrd", "one.vtk"):
    image = sitk.ReadImage(str(directory / name))
    assert (sitk.GetArrayFromImage(image) == one).all(), name
    assert np.allclose(image.GetOrigin(), origin, atol=1e-4) and np.allclose(image.GetSpacing(), spacing), name
    assert np.allclose(image.GetDirection(), np.eye(3).ravel()), name
image = sitk.ReadImage(str(directory / "all.mha"))
assert (sitk.GetArrayFromImage(image) == every).all()
for phase in range(phases):
    image = sitk.ReadImage(str(directory / f"all_{phase:04}.vtk"))
    assert (sitk.GetArrayFromImage(image) == every[phase]).all()

# Surfaces enclose what is above the threshold.
inside = np.argwhere(one > expected["iso_per_mm"])[:, ::-1] * spacing + origin
stl, ply, obj = (trimesh.load(directory / f"one.{kind}") for kind in ("stl", "ply", "obj"))
for mesh in (stl, ply, obj):
    assert len(mesh.faces) == len(stl.faces) > 10 and np.allclose(mesh.bounds, stl.bounds, atol=1e-3)
    assert (mesh.bounds[0] <= inside.min(0)).all() and (mesh.bounds[1] >= inside.max(0)).all()
    assert (mesh.bounds[1] - inside.max(0) <= spacing + 1e-3).all()
    assert mesh.volume > 0, "normals point outwards"
scene = trimesh.load(directory / "beat.glb")
assert len(scene.geometry) == phases
left, superior, anterior = scene.geometry[list(scene.geometry)[1]].vertices.T * 1e3
assert np.allclose([left.min(), -anterior.max(), superior.min()], stl.bounds[0], atol=1e-2)

tensors = safetensors.numpy.load_file(directory / "checkpoint.safetensors")
assert all(np.isfinite(t).all() for t in tensors.values() if t.dtype == np.float32) and len(tensors) > 10
json.loads((directory / "evaluation.json").read_text())
print("every file opened, and says the same")
