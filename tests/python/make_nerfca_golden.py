"""Writes tests/golden/nerfca: a small dataset in the NeRF-CA and NerT-CA authors' layout, made with numpy alone.

    python3 tests/python/make_nerfca_golden.py tests/golden/nerfca

Pixel values are exact line integrals of a few balls. Rays are laid out as the authors' loader does it: the ray array is
indexed [u][v], and the array in the file is transposed to match it, so that the file is an ordinary picture, [row = v]
[column = u]. Width and height differ and nothing is symmetric: a transposed or mirrored picture does not fit.
"""
import json
import sys
from pathlib import Path

import numpy as np

I0 = np.log(8.670397)
SCALE = 1e-2  # mm to world units
WIDTH, HEIGHT = 14, 10
DSD, DSO, PIXEL, OFFSET, NEAR, FAR = 1000.0, 600.0, (6.0, 9.0), (4.0, -5.0), 5.0, 7.0
VIEWS = {"train": [(-30.0, 25.0)], "test": [(50.0, -10.0)]}  # theta, phi
PHASES = [0, 1]
# World units: the body, a bone on one side of it, and the vessel, which moves.
BODY = ((0.05, -0.04, 0.02), 0.30, 0.8)
BONE = ((-0.12, 0.15, 0.10), 0.08, 1.5)
VESSEL = [((0.10, 0.08, -0.09), 0.05, 6.0), ((0.06, 0.12, -0.05), 0.05, 6.0)]


def about_x(degrees):
    c, s = np.cos(np.deg2rad(degrees)), np.sin(np.deg2rad(degrees))
    return np.array([[1, 0, 0], [0, c, -s], [0, s, c]])


def about_z(degrees):
    c, s = np.cos(np.deg2rad(degrees)), np.sin(np.deg2rad(degrees))
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])


def rays(theta, phi):
    """Source, and a direction for each [u][v]."""
    pose = about_z(-theta) @ about_z(90) @ about_x(phi) @ about_x(-90)
    u, v = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT), indexing="ij")
    u = ((u + 0.5 - WIDTH / 2) * PIXEL[0] + OFFSET[0]) / DSD
    v = ((v + 0.5 - HEIGHT / 2) * PIXEL[1] + OFFSET[1]) / DSD
    return pose @ [0, 0, -DSO * SCALE], np.stack([u, v, np.ones_like(u)], -1) @ pose.T


def integral(ball, source, directions):
    centre, radius, attenuation = ball
    unit = directions / np.linalg.norm(directions, axis=-1, keepdims=True)
    away = np.array(centre) - source
    across = (away**2).sum() - (unit @ away) ** 2
    return attenuation * 2 * np.sqrt(np.maximum(radius**2 - across, 0))


def frame(out, theta, phi, phase):
    source, directions = rays(theta, phi)
    vessel = integral(VESSEL[phase], source, directions)
    seen = I0 - sum(integral(ball, source, directions) for ball in (BODY, BONE)) - vessel
    # What the loader holds as [u][v] is the transposed picture.
    picture, mask = seen.T, np.where(vessel > 0, seen, I0).T
    low, high = picture.min(), picture.max()
    name = f"image-hrt={phase}-resp=0-angles={theta}-{phi}"
    np.save(out / f"{name}.npy", ((picture - low) / (high - low)).astype(np.float32))
    np.save(out / f"{name}-mask.npy", mask)
    stale = f"data/GOLDEN/{WIDTH}/{name}"
    return {
        "image_id_str": name, "file_path": f"{stale}.npy", "mask_file_path": f"{stale}-mask.npy",
        "weighted_file_path": f"{stale}-var.npy", "img_min_max": [low, high], "resp_phase": 0, "heart_phase": phase,
        "org_heart_phase": 0, "theta": theta, "phi": phi, "larm": 0.0,
    }


out = Path(sys.argv[1])
out.mkdir(parents=True, exist_ok=True)
for kind, views in VIEWS.items():
    frames = [frame(out, theta, phi, phase) for phase in PHASES for theta, phi in views]
    (out / f"{kind}-golden.json").write_text(json.dumps({"frames": frames}, indent=1))
general = {
    "DSD": DSD * SCALE, "DSO": DSO * SCALE, "nDetector": [WIDTH, HEIGHT], "dDetector": [p * SCALE for p in PIXEL],
    "nVoxel": [64, 64, 64], "dVoxel": [0.02] * 3, "offOrigin": [0.0] * 3, "offDetector": [p * SCALE for p in OFFSET],
    "accuracy": 0.5, "mode": "cone", "filter": None, "near_thresh": NEAR, "far_thresh": FAR, "max_pixel_value": I0,
}
(out / "general.json").write_text(json.dumps(general, indent=1))
balls = {"still": [BODY, BONE], "vessel": VESSEL}
(out / "balls.json").write_text(json.dumps(balls, indent=1))
