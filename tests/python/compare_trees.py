"""How far trees of vessels agree with the true ones: SciPy's distances, phase by phase.

    python3 compare_trees.py DATA/volumes/tree.json beat.json [NEAR_MM]
"""
import json
import sys

import numpy as np
from scipy.spatial import cKDTree

RAS_TO_LPS = np.array([-1, -1, 1])
STEP_MM = 0.05


def read_truth(file):
    """Points of the phases, LPS mm, radii, and the branches as slices of them."""
    with open(file) as text:
        truth = json.load(text)
    branches = [slice(b["first"], b["first"] + b["count"]) for b in truth["branches"]]
    return np.array(truth["points_mm"]) * RAS_TO_LPS, np.array(truth["radius_mm"]), branches


def finely(points, radii):
    """Points of a line at most STEP_MM apart, each with its radius."""
    share = [np.zeros(1)]
    for i, length in enumerate(np.linalg.norm(np.diff(points, axis=0), axis=1)):
        n = int(np.ceil(length / STEP_MM)) or 1
        share.append(i + np.arange(1, n + 1) / n)
    share = np.concatenate(share)
    columns = np.column_stack([points, radii]).T
    return np.column_stack([np.interp(share, np.arange(len(points)), column) for column in columns])


def compare(truth, phase, branches, near_mm):
    """Scores of a phase's branches. Radii are compared where a line is near the true one."""
    points, radii, true_branches = truth
    ours = np.concatenate([finely(np.array(b["points_mm"]), b["radius_mm"]) for b in branches])
    true = np.concatenate([finely(points[phase][b], radii[b]) for b in true_branches])
    to_true, nearest = cKDTree(true[:, :3]).query(ours[:, :3])
    to_ours, _ = cKDTree(ours[:, :3]).query(true[:, :3])
    near = to_true <= near_mm
    errors = (ours[:, 3] - true[nearest, 3])[near]
    return {
        "ours_near": near.mean(),
        "true_near": (to_ours <= near_mm).mean(),
        "ours_to_true_mm": to_true.mean(),
        "true_to_ours_mm": to_ours.mean(),
        "radius_rmse_mm": np.sqrt((errors**2).mean()),
        "radius_bias_mm": errors.mean(),
        "components": sum(b["parent"] is None for b in branches),
    }


def show(name, scores):
    print(f"{name:>8}: " + ", ".join(f"{key} {value:.3f}" for key, value in scores.items()))


def main():
    truth, near_mm = read_truth(sys.argv[1]), float(sys.argv[3]) if len(sys.argv) > 3 else 1.0
    with open(sys.argv[2]) as text:
        phases = json.load(text)["phases"]
    rows = [compare(truth, row["phase"], row["branches"], near_mm) for row in phases]
    for row, scores in zip(phases, rows):
        show(f"phase {row['phase']}", scores)
    show("mean", {key: np.mean([scores[key] for scores in rows]) for key in rows[0]})


if __name__ == "__main__":
    main()
