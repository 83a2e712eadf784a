"""Opens exported Gaussians with plyfile, and compares the field that they make with the exported volumes.

    python3 check_splats.py DIRECTORY   # made by tests/cli/motion.rs
"""
import json
import sys
from pathlib import Path

import nrrd
import numpy as np
from plyfile import PlyData
from scipy.spatial.transform import Rotation

directory = Path(sys.argv[1])
expected = json.loads((directory / "expected.json").read_text())
attenuation = np.array(expected["attenuation_per_mm"])
volume, header = nrrd.read(str(directory / "beat.nrrd"))
directions = np.array(header["space directions"], dtype=float)
spatial = [row for row in range(4) if not np.isnan(directions[row]).any()]
phase_axis = ({0, 1, 2, 3} - set(spatial)).pop()
assert header["space"] == "left-posterior-superior"
files = sorted(directory.glob("beat_*.ply"))
assert len(files) == volume.shape[phase_axis] == 3
for phase, file in enumerate(files):
    ply = PlyData.read(str(file))
    vertex = ply["vertex"].data
    values = lambda *names: np.stack([vertex[name].astype(float) for name in names], axis=-1)
    places, deviations = values("x", "y", "z"), np.exp(values("scale_0", "scale_1", "scale_2"))
    turns = Rotation.from_quat(values("rot_1", "rot_2", "rot_3", "rot_0")).as_matrix()
    opacity = 1 / (1 + np.exp(-vertex["opacity"].astype(float)))
    assert len(vertex) == len(attenuation)
    if phase == expected["rest_phase"]:
        assert np.allclose(places, expected["places_mm"], atol=1e-4)
    # Opacities are in proportion to the attenuation up to the greatest one.
    partial = opacity < 0.985
    assert partial.sum() >= 3 and (opacity <= 0.9901).all()
    assert np.ptp(opacity[partial] / attenuation[partial]) < 1e-4 * (opacity[partial] / attenuation[partial]).max()
    # The colour is red: viewers add a half to the first harmonic.
    red, green, blue = (0.5 + 0.28209479177387814 * values("f_dc_0", "f_dc_1", "f_dc_2")).T
    assert (red > 0.8).all() and (green < 0.3).all() and (blue < 0.3).all()

    field = np.take(volume, phase, axis=phase_axis)
    index = np.stack(np.meshgrid(*(np.arange(n) for n in field.shape), indexing="ij"), axis=-1)
    points = np.array(header["space origin"]) + index @ directions[spatial]
    made = np.zeros(field.shape)
    for place, own, turn, peak in zip(places, deviations, turns, attenuation):
        along = (points - place) @ turn / own
        made += peak * np.exp(-0.5 * (along**2).sum(axis=-1))
    assert field.max() > 0.1 * attenuation.max(), "the volume shows something"
    off = np.abs(made - field).max() / field.max()
    assert off < 1e-3, (file.name, off)
