#!/usr/bin/env python3
"""Writes six procedural coronary trees at the scale of a heart, three left and three right ones, that move over a beat.

    .cache/python/bin/python tools/heart-trees.py OUT
    nertca-vk phantom DATA --tree OUT/l1.json ...

Branches follow control points on half an ellipsoid, the epicardium. Over the beat the ellipsoid narrows, twists, and its base descends. The
numbers are plausible ones for an adult, not measurements. Lengths are in mm, axes are RAS, the format is that of `phantom --tree`.
"""
import json
import pathlib
import sys

import numpy as np

PHASES = 25
BEAT_MS = 860.0
STEP_MM = 0.5
# From the base to the apex.
LONG_AXIS = np.array([-0.62, 0.55, -0.56]) / np.linalg.norm([-0.62, 0.55, -0.56])
# Numbers were chosen on trees 1 and 2 of each side. Trees 3 judge (`studies/rules.toml`), and no number is chosen on them.
TREES = {"l1": ("left", 1), "l2": ("left", 2), "l3": ("left", 103), "r1": ("right", 3), "r2": ("right", 4), "r3": ("right", 104)}


def axes():
    """Returns two axes across the long one: towards the front, and the third."""
    front = np.array([0, 0, 1.0]) - LONG_AXIS * LONG_AXIS[2]
    front /= np.linalg.norm(front)
    return front, np.cross(LONG_AXIS, front)


def surface(height, angle, radius_mm, length_mm):
    """Returns points of the epicardium: height 0 (base) to 1 (apex), angle in radians."""
    height = np.asarray(height)
    front, side = axes()
    across = radius_mm * np.sqrt(np.clip(1 - height**2, 0, None))
    along = (length_mm * height)[..., None] * LONG_AXIS
    return along + (across * np.cos(angle))[..., None] * front + (across * np.sin(angle))[..., None] * side


def path(rng, controls, n, tortuosity):
    """Returns n heights and angles (degrees) along a cubic through controls, with random waves."""
    controls = np.array(controls, float)
    t, s = np.linspace(0, 1, n), np.linspace(0, 1, len(controls))
    degree = min(3, len(controls) - 1)
    fit = [np.polynomial.polynomial.polyfit(s, controls[:, d], degree) for d in range(2)]
    line = np.stack([np.polynomial.polynomial.polyval(t, f) for f in fit], 1)
    for wave in range(2, 7):
        for d, size in enumerate((0.012, 1.6)):
            line[:, d] += tortuosity / wave * size * rng.normal() * np.sin(np.pi * wave * t)
    return line


def branches(side, vary):
    """Returns name, parent, share of the parent at the start, controls, first and last radius of each branch."""
    if side == "left":
        return [
            ("LM", None, 0, [(-0.05, -20 + vary(5)), (0.02, 2 + vary(4))], 1.9, 1.8),
            ("LAD", "LM", 1, [(0.02, 2), (0.3, 18 + vary(6)), (0.65, 22 + vary(6)), (0.93, 20 + vary(8))], 1.7, 0.6),
            ("LCx", "LM", 1, [(0.02, 2), (0.03, 60 + vary(5)), (0.1, 110 + vary(6)), (0.2, 150 + vary(8))], 1.5, 0.7),
            ("D1", "LAD", 0.25 + vary(0.03), [None, (0.45, 52 + vary(6)), (0.68, 64 + vary(8))], 1.0, 0.5),
            ("D2", "LAD", 0.5 + vary(0.03), [None, (0.7, 42 + vary(5)), (0.83, 50 + vary(6))], 0.8, 0.5),
            ("OM1", "LCx", 0.4 + vary(0.04), [None, (0.35, 88 + vary(6)), (0.66, 96 + vary(8))], 1.1, 0.5),
            ("OM2", "LCx", 0.75 + vary(0.04), [None, (0.4, 128 + vary(6)), (0.65, 138 + vary(8))], 0.9, 0.5),
        ]
    return [
        ("RCA", None, 0, [(-0.06, -35 + vary(5)), (0.05, -85 + vary(6)), (0.1, -150 + vary(6)), (0.12, -190 + vary(6))], 1.8, 1.1),
        ("CON", "RCA", 0.15 + vary(0.02), [None, (0.2, -30 + vary(6)), (0.35, -22 + vary(6))], 0.8, 0.5),
        ("AM", "RCA", 0.5 + vary(0.04), [None, (0.4, -110 + vary(6)), (0.68, -95 + vary(8))], 0.9, 0.5),
        ("PDA", "RCA", 0.98, [None, (0.4, -185 + vary(5)), (0.8, -178 + vary(8))], 1.1, 0.5),
        ("PL", "RCA", 0.99, [None, (0.2, -215 + vary(5)), (0.45, -225 + vary(8))], 1.0, 0.5),
    ]


def tree(side, seed):
    rng = np.random.default_rng(seed)
    radius_mm, length_mm, tortuosity = rng.uniform(36, 42), rng.uniform(78, 90), rng.uniform(1, 2.2)
    places, radii, rows, found = [], [], [], {}
    for name, parent, share, controls, first_mm, last_mm in branches(side, lambda s: rng.normal() * s):
        attach = -1
        if parent is not None:
            _, begin, count = found[parent]
            attach = count - 1 if share >= 1 else int(round(share * (count - 1)))
            start = places[begin + attach]
            controls = [tuple(start)] + list(controls[1:])
        line = path(rng, controls, 400, tortuosity if parent else 0.3 * tortuosity)
        if parent is not None:
            line += (np.array(start) - line[0]) * np.linspace(1, 0, 400)[:, None]
        points = surface(line[:, 0], np.radians(line[:, 1]), radius_mm, length_mm)
        way = np.r_[0, np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))]
        n = int(way[-1] / STEP_MM) + 1
        even = np.linspace(0, way[-1], n)
        line = np.c_[np.interp(even, way, line[:, 0]), np.interp(even, way, line[:, 1])]
        if parent is not None:
            line[0] = start
        found[name] = (len(rows), len(places), n)
        rows.append({"id": len(rows), "name": name, "parent": -1 if parent is None else found[parent][0], "attach": attach,
                     "first": len(places), "count": n})
        places += [tuple(x) for x in line]
        radii += list(np.linspace(first_mm, last_mm, n))
    points_mm = beat(rng, np.array(places), radius_mm, length_mm)
    return {"format": "coronary-tree-4d", "version": 1, "units": "mm", "axes": "RAS: +x right, +y anterior, +z superior",
            "rr_ms": BEAT_MS, "n_phases": PHASES, "phase_ms": [BEAT_MS / PHASES * i for i in range(PHASES)], "n_points": len(radii),
            "branches": rows, "radius_mm": [round(float(r), 3) for r in radii], "points_mm": np.round(points_mm, 2).tolist()}


def beat(rng, places, radius_mm, length_mm):
    """Returns the points at each phase, around the middle of their extent."""
    strength, shift = rng.uniform(0.8, 1.1), rng.uniform(-0.05, 0.05)
    height, phases = places[:, 0], []
    for t in np.arange(PHASES) / PHASES:
        # Systole, relaxation, and a small atrial kick.
        contraction = np.sin(np.pi * np.clip(t / 0.62, 0, 1)) ** 1.3 - 0.12 * np.exp(-(((t - 0.88 + shift) / 0.06) ** 2))
        contraction *= strength
        angle = np.radians(places[:, 1] + (10 * height - 3) * contraction)
        narrow = 1 - 0.20 * contraction * (1 - 0.3 * np.abs(height))
        points = surface(height, angle, radius_mm * narrow, length_mm * (1 - 0.04 * contraction))
        phases.append(points + LONG_AXIS * (13 * contraction * np.clip(1 - height, 0, 1.06))[:, None])
    points = np.array(phases)
    return points - 0.5 * (points.reshape(-1, 3).min(0) + points.reshape(-1, 3).max(0))


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit("usage: heart-trees.py OUT")
    out = pathlib.Path(sys.argv[1])
    out.mkdir(parents=True, exist_ok=True)
    for name, (side, seed) in TREES.items():
        (out / f"{name}.json").write_text(json.dumps(tree(side, seed)))
