#!/usr/bin/env python3
"""Shows from checkpoints of NerT-CA whether the dynamic field still learns: its gradients against Adam's epsilon, and the slope of its softplus.

    python3 tools/dynamic-field-health.py RUN/checkpoint-*.safetensors      (needs numpy and safetensors)

For each checkpoint:

gradient / epsilon  root of Adam's bias-corrected second moment over adam.epsilon, for the weights of the dynamic field: median and 99th
                    percentile. Far above 1 Adam takes steps of full size whatever the size of the gradient; far below 1 it is gradient
                    descent with a rate of dynamic.lr / adam.epsilon.
below epsilon       share of the weights whose gradient is smaller than epsilon.
step                |m| / (sqrt(v) + epsilon), 99th percentile over the weights: the size of a step as a share of the learning rate.
dead                share of random points of the field's box, over all phases, where the slope of the softplus is below a thousandth of that
                    at its start, so that no gradient of use reaches the network.
slope               median of this slope. At the start it is 1 / (1 + exp(-shift)).
"""

import argparse
import json

import numpy as np
from safetensors import safe_open

POINTS = 4000
DEAD = 1e-3  # of the slope at the start


def read(path):
    with safe_open(path, "numpy") as file:
        header = json.loads(file.metadata()["nertca"])
        tensors = {name: file.get_tensor(name).astype(np.float64) for name in file.keys() if file.get_tensor(name).dtype == np.float32}
    return tensors, header


def encoded(points, scene, bands, window):
    """Positional encoding; bands open one after the other."""
    x = (points - np.array(scene["encode_centre"])) * scene["encode_scale"]
    parts = [x]
    for band in range(bands):
        is_open = np.clip(window - band, 0, 1)
        parts += [is_open * np.sin(2.0**band * x), is_open * np.cos(2.0**band * x)]
    return np.concatenate(parts, 1)


def features(tensors, inputs, latent):
    """Output of the network before the softplus."""
    entry = np.concatenate([inputs, np.broadcast_to(latent, (len(inputs), len(latent)))], 1)
    hidden, layer = entry, 0
    while f"dynamic.layer{layer}.weight" in tensors:
        weight, bias = tensors[f"dynamic.layer{layer}.weight"], tensors[f"dynamic.layer{layer}.bias"]
        wide = layer > 0 and weight.shape[1] == hidden.shape[1] + entry.shape[1]
        hidden = np.maximum((np.concatenate([entry, hidden], 1) if wide else hidden) @ weight.T + bias, 0)
        layer += 1
    return hidden @ tensors["dynamic.out.weight"][0] + tensors["dynamic.out.bias"][0]


def slopes(tensors, header):
    """Slopes of the softplus at random points of the box and at all phases."""
    config, scene = header["config"], header["scene"]
    field = config["dynamic"]
    progress = np.clip((header["step"] - field["delay"]) / max(field["window_iterations"], 1), 0, 1)
    window = field["window_start"] + (field["bands"] - field["window_start"]) * progress
    low, high = np.array(scene["dynamic_min"]), np.array(scene["dynamic_max"])
    inputs = encoded(low + np.random.default_rng(1).random((POINTS, 3)) * (high - low), scene, field["bands"], window)
    raw = [features(tensors, inputs, latent) for latent in tensors["dynamic.latent"]]
    return 1 / (1 + np.exp(-(np.concatenate(raw) + scene["dynamic_shift"])))


def moments(tensors, header):
    """Bias-corrected moments of the weights of the dynamic field."""
    adam, steps = header["config"]["adam"], max(header["step"] - header["config"]["dynamic"]["delay"], 1)
    flat = lambda kind: np.concatenate([t.ravel() for name, t in tensors.items() if name.startswith(f"adam.{kind}.dynamic.layer")])
    return flat("m") / (1 - adam["beta1"] ** steps), np.sqrt(flat("v") / (1 - adam["beta2"] ** steps)), adam["epsilon"]


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("checkpoints", nargs="+", help="checkpoints of a run whose dynamic field is a network")
    print("| iteration | gradient / epsilon | 99th percentile | below epsilon | step | dead | slope |\n|---|---|---|---|---|---|---|")
    for path in parser.parse_args().checkpoints:
        tensors, header = read(path)
        first, second, epsilon = moments(tensors, header)
        slope = slopes(tensors, header)
        at_start = 1 / (1 + np.exp(-header["scene"]["dynamic_shift"]))
        gradient, step = second / epsilon, np.abs(first) / (second + epsilon)
        print(f"| {header['step']:,} | {np.median(gradient):.2g} | {np.percentile(gradient, 99):.2g} | {np.mean(gradient < 1):.0%} "
              f"| {np.percentile(step, 99):.2g} | {np.mean(slope < DEAD * at_start):.0%} | {np.median(slope):.1e} |")


if __name__ == "__main__":
    main()
