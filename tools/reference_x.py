#!/usr/bin/env python3
"""Golden values of X-Gaussian's fit from an independent PyTorch float64 implementation.

Writes tests/golden/x.safetensors: two images from 0 to 1, Gaussians as they are stored, and what follows from them: picture, both
terms of the loss, all gradients, and the parameters after ten Adam updates that see the images in turn. Nothing here is shared
with the engine: splats come from 3 x 3 matrices in the camera's frame, each tile of 16 x 16 pixels sorts its own Gaussians,
gradients come from autograd through the blending, SSIM from conv2d, updates from torch.optim.Adam.

    python3 tools/reference_x.py [--out tests/golden]      (needs torch and numpy)
"""

import argparse
import json
import pathlib

import numpy as np
import torch
from reference_gaussians import rotation, rotations, write
from reference_r2 import ssim

torch.set_default_dtype(torch.float64)

CASE = dict(
    width_px=37, height_px=22, angles=[[-30.0, 30.0], [55.0, -20.0]], half_mm=15.0, extent_mm=440.0,
    arm=dict(sid_mm=1000.0, sod_mm=620.0, pixel_mm=[1.5, 1.8]),
    gaussians=40, ssim=0.2, nearest_mm=0.2, updates=10, iterations=40,
    # Positions in extents; intensities with a share by degree, which grows after `degree_every` iterations.
    rates=dict(position=[1.9e-4, 1.9e-6], opacity=0.008, scale=0.005, intensity=0.002, rotation=0.001),
    degree_every=4, shares=[0.2820947918, 0.3553851686, 0.5623507222, 0.9025143359],
    # Image of each iteration.
    shown=[0, 1, 1, 0, 0, 1, 1, 0, 1, 0],
)
W, H = CASE["width_px"], CASE["height_px"]
TILE = 16


def splats(p, angles):
    """Centres, inverse variances and depths in the image; and the squares' half sides, which have no gradient."""
    arm = CASE["arm"]
    r = rotation(*angles)
    fu, fv = [arm["sid_mm"] / pitch for pitch in arm["pixel_mm"]]
    t = p["position"] @ r + torch.tensor([0.0, 0.0, arm["sod_mm"]])
    z = t[:, 2]
    mean = torch.stack([fu * t[:, 0] / z + (W - 1) / 2, fv * t[:, 1] / z + (H - 1) / 2], -1)
    # tan(fov / 2) is half the detector over the focal length.
    limits = [1.3 * W / (2 * fu), 1.3 * H / (2 * fv)]
    a, b = [torch.clamp(t[:, k] / z, -limits[k], limits[k]) * z for k in range(2)]
    zero = torch.zeros_like(z)
    j = torch.stack([torch.stack([fu / z, zero, -fu * a / z**2], -1),
                     torch.stack([zero, fv / z, -fv * b / z**2], -1)], 1)
    axes = rotations(p["rotation"])
    covariance = axes @ (torch.exp(2 * p["scale"])[:, :, None] * axes.transpose(1, 2))
    flat = j @ (r.T @ covariance @ r) @ j.transpose(1, 2) + 0.3 * torch.eye(2)
    radius = torch.ceil(3 * torch.sqrt(torch.linalg.eigvalsh(flat.detach())[:, 1]))
    # The larger eigenvalue of one that is nearly round counts as a little more.
    mid = 0.5 * (flat[:, 0, 0] + flat[:, 1, 1]).detach()
    spread = torch.clamp(mid**2 - torch.linalg.det(flat.detach()), min=0.1)
    radius = torch.maximum(radius, torch.ceil(3 * torch.sqrt(mid + torch.sqrt(spread))))
    return mean, torch.linalg.inv(flat), z, radius


def touches(mean, radius, corner):
    """Whether the tile with this first pixel is one of those that the square touches, by the code's integer division."""
    first = [max(0, int((float(m) - radius) / TILE)) for m in mean]
    end = [max(0, int((float(m) + radius + TILE - 1) / TILE)) for m in mean]
    return all(first[k] <= corner[k] // TILE < end[k] for k in range(2))


def picture(p, angles):
    mean, conic, depth, radius = splats(p, angles)
    depth = depth.detach()
    opacity, intensity = torch.sigmoid(p["opacity"]), torch.clamp(p["intensity"], min=0)
    out = torch.zeros(H, W)
    for top in range(0, H, TILE):
        for left in range(0, W, TILE):
            rows, columns = torch.meshgrid(torch.arange(top, min(top + TILE, H)).double(),
                                           torch.arange(left, min(left + TILE, W)).double(), indexing="ij")
            at = torch.stack([columns, rows], -1)
            near = [i for i in range(len(depth)) if float(depth[i]) > CASE["nearest_mm"]
                    and touches(mean[i].detach(), float(radius[i]), (left, top))]
            light, going = torch.ones(at.shape[:2]), torch.ones(at.shape[:2], dtype=torch.bool)
            total = torch.zeros(at.shape[:2])
            for i in sorted(near, key=lambda i: (float(depth[i]), i)):
                d = at - mean[i]
                alpha = torch.clamp(opacity[i] * torch.exp(-0.5 * (d @ conic[i] * d).sum(-1)), max=0.99)
                shows = going & (alpha.detach() >= 1 / 255)
                left_over = light * (1 - alpha)
                ends = shows & (left_over.detach() < 1e-4)
                going, shows = going & ~ends, shows & ~ends
                total = torch.where(shows, total + intensity[i] * alpha * light, total)
                light = torch.where(shows, left_over, light)
            out = torch.slice_scatter(out, torch.slice_scatter(out[top:top + TILE], total, 1, left, min(left + TILE, W)),
                                      0, top, min(top + TILE, H))
    return out


def terms(p, y, angles):
    x = picture(p, angles)
    return (1 - CASE["ssim"]) * (x - y).abs().mean(), CASE["ssim"] * (1 - ssim(x, y)), x


def image(rng):
    """From 0 to 1, so that it is what its normalisation makes of it."""
    y = rng.uniform(0, 1, (H, W))
    return (y - y.min()) / (y.max() - y.min())


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", default="tests/golden", type=pathlib.Path)
    out = parser.parse_args().out
    rng = np.random.default_rng(12)
    n, half = CASE["gaussians"], CASE["half_mm"]
    f32 = lambda a: torch.tensor(np.asarray(a, np.float32).astype(np.float64))
    position = rng.normal(0, 0.3 * half, (n, 3))
    # Beyond where slopes follow the centre, and behind the source.
    position[:3] = half * np.array([[0.7, -1.6, 0.2], [-0.8, 0.3, 1.5], [0.1, 1.7, -0.9]])
    position[3] = [900.0, 0.0, 0.0]
    scale = np.log(rng.uniform(0.6, 2.5, (n, 3)))
    scale[:3] += 1.2
    opacity = rng.normal(0.3, 1.5, n)
    opacity[4] = 7.0
    intensity = rng.normal(0.5, 0.25, n)
    intensity[5] = -0.1
    start = dict(position=f32(position), opacity=f32(opacity), scale=f32(scale), intensity=f32(intensity),
                 rotation=f32(rng.normal(0, 1, (n, 4))))
    shown = CASE["shown"]
    images = [f32(image(rng)) for _ in CASE["angles"]]
    p = {k: torch.nn.Parameter(v.clone()) for k, v in start.items()}
    parts = terms(p, images[shown[0]], CASE["angles"][shown[0]])
    sum(parts[:2]).backward()
    tensors = {f"start/{k}": v.numpy() for k, v in start.items()}
    tensors |= {f"gradient/{k}": v.grad.clone().numpy() for k, v in p.items()}
    tensors |= {f"image/{k}": image.numpy() for k, image in enumerate(images)}
    tensors["terms"] = np.array([part.item() for part in parts[:2]])
    tensors["picture"] = parts[2].detach().numpy()
    rates = CASE["rates"]
    adam = torch.optim.Adam([dict(params=[p[k]], lr=0.0, name=k) for k in p], betas=(0.9, 0.999), eps=1e-15)
    for step in range(CASE["updates"]):
        first, last = rates["position"]
        degree = min(3, (step + 1) // CASE["degree_every"])
        now = dict(rates, position=CASE["extent_mm"] * first * (last / first) ** ((step + 1) / CASE["iterations"]),
                   intensity=rates["intensity"] * CASE["shares"][degree])
        for group in adam.param_groups:
            group["lr"] = now[group["name"]]
        adam.zero_grad()
        seen = shown[step]
        sum(terms(p, images[seen], CASE["angles"][seen])[:2]).backward()
        adam.step()
    tensors |= {f"final/{k}": v.detach().numpy() for k, v in p.items()}
    write(out / "x.safetensors", tensors, {"case": json.dumps(CASE)})


if __name__ == "__main__":
    main()
