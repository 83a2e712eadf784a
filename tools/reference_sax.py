#!/usr/bin/env python3
"""Golden values of SAX-NeRF's field and its fit from an independent PyTorch float64 implementation.

Writes tests/golden/sax.safetensors: samples of some rays, and what follows from them and from numbers of a field that a
formula gives (`number`): densities, loss, gradients, and the numbers after ten Adam updates on the same rays. Nothing here is
shared with the engine: layers are torch.nn's, attention is softmax over an axis, the hash goes corner by corner through Python
integers, gradients come from autograd, updates from torch.optim.Adam.

    python3 tools/reference_sax.py [--out tests/golden]      (needs torch and numpy)
"""

import argparse
import json
import pathlib

import numpy as np
import torch
from reference_gaussians import write
from torch import nn

torch.set_default_dtype(torch.float64)

# Of parts with more numbers than `few`, every `stride`-th is kept.
CASE = dict(levels=6, base=3, log2_table=7, rays=7, samples=8, updates=10, rate=1e-3, seed=5, few=1000, stride=13)
PRIMES = (1, 19349663, 83492791)


def grid_levels():
    """Cells along a side and entries of each level."""
    for level in range(CASE["levels"]):
        cells = CASE["base"] * 2**level
        yield cells, min((cells + 1) ** 3, 2 ** CASE["log2_table"])


def entry(cells, entries, corner):
    if (cells + 1) ** 3 <= entries:
        return corner[0] + corner[1] * (cells + 1) + corner[2] * (cells + 1) ** 2
    index = 0
    for axis in range(3):
        index ^= corner[axis] * PRIMES[axis] & 0xFFFFFFFF
    return index % entries


def look_up(points):
    """For each level: entries and shares of the eight corners around each point, [point][corner]."""
    first, found = 0, []
    for cells, entries in grid_levels():
        at = points.astype(np.float32) * np.float32(cells - 1) + np.float32(0.5)
        low = np.floor(at)
        share = (at - low).astype(np.float64)
        rows, weights = [], []
        for point, fraction in zip(low.astype(int), share):
            corners = [(x, y, z) for x in (0, 1) for y in (0, 1) for z in (0, 1)]
            rows.append([first + entry(cells, entries, [int(p) + c for p, c in zip(point, corner)]) for corner in corners])
            weights.append([np.prod([f if c else 1 - f for f, c in zip(fraction, corner)]) for corner in corners])
        found.append((torch.tensor(rows), torch.tensor(np.array(weights))))
        first += entries
    return found, first


def number(part, i):
    """A number between -1 and 1 for the i-th of a part."""
    value = np.sin(12.9898 * i + 78.233 * part) * 43758.5453
    return 2 * (value - np.floor(value)) - 1


class Field(nn.Module):
    def __init__(self, n_entries):
        super().__init__()
        features = 2 * CASE["levels"]
        self.grid = nn.Parameter(torch.empty(n_entries, 2))
        self.input = nn.Linear(features, 32)
        self.norm1, self.norm2 = nn.LayerNorm(32), nn.LayerNorm(32)
        self.query, self.key_value = nn.Linear(32, 32, bias=False), nn.Linear(32, 64, bias=False)
        self.position = nn.Parameter(torch.empty(8, 2, 2))
        self.out = nn.Linear(32, 32)
        self.feed_forward = nn.Sequential(nn.Linear(32, 128, bias=False), nn.GELU(), nn.Linear(128, 128, bias=False), nn.GELU(),
                                          nn.Linear(128, 32, bias=False))
        self.joint, self.density = nn.Linear(features + 32, 32), nn.Linear(32, 1)
        for part, (name, parameter) in enumerate(self.named().items()):
            spread = torch.tensor(number(part, np.arange(parameter.numel()))).reshape(parameter.shape)
            if name.startswith("norm"):
                parameter.data = 0.3 * spread + (1 if name.endswith("weight") else 0)
            elif name in ("grid", "attention.position") or name.endswith("bias"):
                parameter.data = 0.5 * spread
            else:
                parameter.data = spread * parameter.shape[-1] ** -0.5

    def attend(self, x):
        pairs = x.reshape(-1, 2, 32)
        query = self.query(pairs).reshape(-1, 2, 8, 4).transpose(1, 2) * 4**-0.5
        key, value = (t.reshape(-1, 2, 8, 4).transpose(1, 2) for t in self.key_value(pairs).chunk(2, -1))
        shares = torch.softmax(query @ key.transpose(-1, -2) + self.position, -1)
        return self.out((shares @ value).transpose(1, 2).reshape(-1, 32))

    def forward(self, corners):
        features = torch.cat([(self.grid[rows] * weights[..., None]).sum(1) for rows, weights in corners], -1)
        leaky = nn.functional.leaky_relu
        x = leaky(self.input(features))
        x = x + self.attend(self.norm1(x))
        x = leaky(x + self.feed_forward(self.norm2(x)))
        x = leaky(self.joint(torch.cat([features, x], -1)))
        return torch.sigmoid(self.density(x))[:, 0]

    def named(self):
        ff = self.feed_forward
        return {
            "norm1.weight": self.norm1.weight, "norm1.bias": self.norm1.bias, "attention.query": self.query.weight,
            "attention.key_value": self.key_value.weight, "attention.position": self.position,
            "attention.out.weight": self.out.weight, "attention.out.bias": self.out.bias, "norm2.weight": self.norm2.weight,
            "norm2.bias": self.norm2.bias, "feed_forward.expand": ff[0].weight, "feed_forward.mix": ff[2].weight,
            "feed_forward.contract": ff[4].weight, "input.bias": self.input.bias, "joint.bias": self.joint.bias,
            "density.weight": self.density.weight, "density.bias": self.density.bias, "input.weight": self.input.weight,
            "joint.weight": self.joint.weight, "grid": self.grid,
        }


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", default="tests/golden", type=pathlib.Path)
    out = parser.parse_args().out
    rng = np.random.default_rng(CASE["seed"])
    n = CASE["rays"] * CASE["samples"]
    points = rng.uniform(0, 1, (n, 3)).astype(np.float32)
    # The faces of the box.
    points[:2] = [[0, 1, 0.5], [1, 0, 1]]
    paths = torch.tensor(rng.uniform(0.01, 0.2, (CASE["rays"], CASE["samples"])))
    targets = torch.tensor(rng.uniform(0, 1.5, CASE["rays"]))
    corners, n_entries = look_up(points)
    field = Field(n_entries)
    kept = lambda v: v.detach().numpy().reshape(-1)[:: CASE["stride"] if v.numel() > CASE["few"] else 1].copy()
    loss_of = lambda sigma: (((sigma.reshape(paths.shape) * paths).sum(1) - targets) ** 2).mean()
    sigma = field(corners)
    loss = loss_of(sigma)
    loss.backward()
    tensors = {f"gradient/{k}": kept(v.grad) for k, v in field.named().items()}
    tensors |= dict(points=points.astype(np.float64), paths=paths.numpy(), targets=targets.numpy(),
                    sigma=sigma.detach().numpy(), loss=np.array([loss.item()]))
    adam = torch.optim.Adam(field.parameters(), lr=CASE["rate"], betas=(0.9, 0.999), eps=1e-8)
    for _ in range(CASE["updates"]):
        adam.zero_grad()
        loss_of(field(corners)).backward()
        adam.step()
    tensors |= {f"final/{k}": kept(v) for k, v in field.named().items()}
    write(out / "sax.safetensors", tensors, {"case": json.dumps(CASE)})


if __name__ == "__main__":
    main()
