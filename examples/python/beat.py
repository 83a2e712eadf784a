"""A beating coronary tree from angiograms, with pictures of every step, to be read from top to bottom.

    pip install nertca-vk matplotlib
    nertca-vk phantom phantom            # or a dataset of your own: docs/formats.md
    python3 beat.py phantom beat.png

The lines `# %%` make it a notebook in editors that know them (VS Code, Spyder, Jupyter with Jupytext).
"""

# %% What there is to see: a few views, each at all phases of the beat.
import json
import logging
import sys
from dataclasses import replace
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from nertca_vk import CArm, Grid, Progress, Reconstruction

data, picture = Path(sys.argv[1]), sys.argv[2]
dataset = json.loads((data / "dataset.json").read_text())
phases = dataset["phases"]
logging.basicConfig(level=logging.WARNING)

# %% A reconstruction takes calibrated frames, whose pixels are line integrals of attenuation here.
reconstruction = Reconstruction(
    phases,
    depth_half_extent_mm=dataset["depth_half_extent_mm"],
    vessel_attenuation_per_mm=dataset.get("vessel_attenuation_per_mm"),
)
for frame in dataset["frames"]:
    pixels = np.load(data / frame["image"])
    mask = plt.imread(data / frame["mask"]) > 0.5 if "mask" in frame else None
    geometry = CArm(**frame["geometry"])
    reconstruction.add_frame(pixels, geometry, phase=frame["phase"], split=frame["split"], mask=mask)

# %% Training tells how far it is. Ctrl-C ends it, and nothing is lost.
steps: list[int] = []
losses: list[float] = []


def remember(progress: Progress) -> None:
    steps.append(progress.step)
    losses.append(progress.loss)


reconstruction.train(progress=remember)
scores = reconstruction.evaluate()
print(scores)

# %% A view that nobody has taken, over the beat; the vessels' centrelines with radii; and a volume around them.
view = replace(geometry, primary_deg=20.0, secondary_deg=25.0)
beat = [reconstruction.render(view, pixels.shape, phase, component="dynamic") for phase in range(phases)]
tree = reconstruction.tree()
extent_mm = max(float(np.abs(branch.points_mm).max()) for branch in tree.at(0))
volume = reconstruction.volume(Grid.around_isocentre(extent_mm, extent_mm / 80), phase=0)
reconstruction.close()

# %% All of it in one picture.
figure = plt.figure(figsize=(14, 7), layout="constrained")
shown = range(0, phases, max(1, phases // 4))[:4]
for column, phase in enumerate(shown):
    axes = figure.add_subplot(2, 4, column + 1)
    axes.imshow(beat[phase], cmap="gray_r", vmax=float(max(image.max() for image in beat)))
    axes.set_title(f"LAO 20, CRAN 25, phase {phase}")
    axes.axis("off")
curve = figure.add_subplot(2, 4, 5, xlabel="iteration", ylabel="loss")
curve.semilogy(steps, losses)
projection = figure.add_subplot(2, 4, 6, title="volume, from the front")
projection.imshow(volume.max(axis=1)[::-1], cmap="gray_r")
projection.axis("off")
centrelines = figure.add_subplot(2, 4, (7, 8), projection="3d", title=f"centrelines, phase 0, Dice {scores.dice_dynamic:.3f}")
for branch in tree.at(0):
    centrelines.plot(*branch.points_mm.T, linewidth=2 * branch.radius_mm.mean())
figure.savefig(picture)
print("wrote", picture)
