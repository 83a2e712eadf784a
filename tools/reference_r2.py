#!/usr/bin/env python3
"""Golden values of R2-Gaussian's fit from an independent PyTorch float64 implementation.

Writes tests/golden/r2.safetensors, and r2_exact.safetensors with exact line integrals: two images, Gaussians as they are stored, and
what follows from them: picture, the three terms of the loss, all gradients, and the parameters after ten Adam updates that see the
images in turn. Nothing here is shared with the engine: pictures come from 3 x 3 matrices in the camera's frame, SSIM from conv2d,
total variation from a grid of voxels, gradients from autograd, updates from torch.optim.Adam.

    python3 tools/reference_r2.py [--out tests/golden]      (needs torch and numpy)
"""

import argparse
import json
import math
import pathlib

import numpy as np
import torch
from reference_gaussians import rotation, rotations, write

torch.set_default_dtype(torch.float64)

CASE = dict(
    width_px=17, height_px=14, angles=[[-30.0, 30.0], [55.0, -20.0]], half_mm=15.0,
    arm=dict(sid_mm=1000.0, sod_mm=620.0, pixel_mm=[1.5, 1.8]),
    gaussians=26, least_scale=0.0005, greatest_scale=0.5, voxels=24, tv_box=6, ssim=0.25, tv=0.05, updates=10, iterations=40,
    rates=dict(position=[2e-4, 2e-5], density=[1e-2, 1e-3], scale=[5e-3, 5e-4], rotation=[1e-3, 1e-4]),
    # Image of each iteration.
    shown=[0, 1, 1, 0, 0, 1, 1, 0, 1, 0],
)
W, H = CASE["width_px"], CASE["height_px"]


class Camera:
    """Points are half sides of the volume in world axes; the camera looks along z from (0, 0, -sod)."""

    def __init__(self, angles):
        arm = CASE["arm"]
        self.r = rotation(*angles)
        self.sod = arm["sod_mm"] / CASE["half_mm"]
        self.focal = [arm["sid_mm"] / p for p in arm["pixel_mm"]]

    def project(self, x, covariance):
        """Centres, 2 x 2 variances, and the factor from a density to the line integral through the centre."""
        t = x @ self.r + torch.tensor([0.0, 0.0, self.sod])
        fu, fv = self.focal
        mean = torch.stack([fu * t[:, 0] / t[:, 2] + (W - 1) / 2, fv * t[:, 1] / t[:, 2] + (H - 1) / 2], -1)
        # tan(fov / 2) is half the detector over the focal length.
        limits = [1.3 * W / (2 * fu), 1.3 * H / (2 * fv)]
        z = t[:, 2]
        a, b = [torch.clamp(t[:, k] / z, -limits[k], limits[k]) * z for k in range(2)]
        length = torch.sqrt(a * a + b * b + z * z)
        zero = torch.zeros_like(z)
        j = torch.stack([torch.stack([fu / z, zero, -fu * a / z**2], -1),
                         torch.stack([zero, fv / z, -fv * b / z**2], -1),
                         torch.stack([a, b, z], -1) / length[:, None]], 1)
        full = j @ (self.r.T @ covariance @ self.r) @ j.transpose(1, 2)
        flat = full[:, :2, :2]
        return mean, flat, torch.sqrt(2 * math.pi * torch.linalg.det(full) / torch.linalg.det(flat))


def scales(p):
    low, high = 2 * CASE["least_scale"], 2 * CASE["greatest_scale"]
    return torch.sigmoid(p["scale"]) * (high - low) + low


def covariances(p):
    r = rotations(p["rotation"])
    return r @ ((scales(p) ** 2)[:, :, None] * r.transpose(1, 2))


def picture(p, angles):
    rows, columns = torch.meshgrid(torch.arange(H).double(), torch.arange(W).double(), indexing="ij")
    pixels = torch.stack([columns, rows], -1)
    mean, flat, factor = Camera(angles).project(p["position"], covariances(p))
    conic = torch.linalg.inv(flat)
    density = torch.nn.functional.softplus(p["density"])
    total = torch.zeros(H, W)
    for i in range(len(density)):
        mid = 0.5 * (flat[i, 0, 0] + flat[i, 1, 1]).detach()
        spread = torch.sqrt(torch.clamp(mid**2 - torch.linalg.det(flat[i]).detach(), min=0.1))
        radius = torch.ceil(3 * torch.sqrt(mid + spread))
        d = pixels - mean[i]
        value = density[i] * factor[i] * torch.exp(-0.5 * (d @ conic[i] * d).sum(-1))
        total = total + torch.where((d.detach().abs() <= radius).all(-1), value, torch.zeros(()))
    return total


def half_box(t, covariance, mean, focal):
    """Largest distances of a column and a row from the centre's whose plane with the source touches the ellipsoid at 3 deviations."""
    half = []
    for k in range(2):
        # Planes focal x - (u - middle) z = 0, of which that through the centre has u = mean.
        middle = ((W if k == 0 else H) - 1) / 2
        through = np.zeros(3)
        through[k], through[2] = focal[k], -(mean[k] - middle)
        turn = np.array([0.0, 0.0, -1.0])
        a, b, c = (9 * v @ covariance @ w for v, w in [(through, through), (through, turn), (turn, turn)])
        half.append(np.abs(np.roots([t[2] ** 2 - c, -2 * b, -a])).max())
    return half


def exact_picture(p, angles):
    """Each pixel's own ray past each Gaussian, in closed form; for each Gaussian one ray is held against a sum along it."""
    camera = Camera(angles)
    rows, columns = torch.meshgrid(torch.arange(H).double(), torch.arange(W).double(), indexing="ij")
    fu, fv = camera.focal
    d = torch.stack([(columns - (W - 1) / 2) / fu, (rows - (H - 1) / 2) / fv, torch.ones(H, W)], -1)
    covariance = camera.r.T @ covariances(p) @ camera.r
    t = p["position"] @ camera.r + torch.tensor([0.0, 0.0, camera.sod])
    density = torch.nn.functional.softplus(p["density"])
    total = torch.zeros(H, W)
    for i in range(len(density)):
        inverse = torch.linalg.inv(covariance[i])
        dd = torch.einsum("hwj,jk,hwk->hw", d, inverse, d)
        dt = torch.einsum("hwj,jk,k->hw", d, inverse, t[i])
        nearest = t[i] @ inverse @ t[i] - dt**2 / dd
        value = density[i] * d.norm(dim=-1) * torch.sqrt(2 * math.pi / dd) * torch.exp(-0.5 * nearest)
        mean = [(f * t[i, k] / t[i, 2] + (n - 1) / 2).item() for k, (f, n) in enumerate([(fu, W), (fv, H)])]
        half = half_box(t[i].detach().numpy(), covariance[i].detach().numpy(), mean, camera.focal)
        inside = ((columns - mean[0]).abs() <= half[0]) & ((rows - mean[1]).abs() <= half[1])
        total = total + torch.where(inside, value, torch.zeros(()))
        check_along_ray(d[i % H, i % W], t[i], inverse, density[i], value[i % H, i % W])
    return total


@torch.no_grad()
def check_along_ray(d, t, inverse, density, value):
    reach = 10 * 2 * CASE["greatest_scale"]
    depths = torch.linspace(t[2].item() - reach, t[2].item() + reach, 400_001)
    x = depths[:, None] * d - t
    total = (density * torch.exp(-0.5 * torch.einsum("sj,jk,sk->s", x, inverse, x))).sum() * (depths[1] - depths[0]) * d.norm()
    assert abs(total - value) <= 1e-9 * density, (total, value)


def ssim(x, y):
    g = torch.exp(-torch.arange(-5, 6).double() ** 2 / (2 * 1.5**2))
    window = torch.outer(g, g)[None, None] / g.sum() ** 2
    under = lambda image: torch.nn.functional.conv2d(image[None, None], window, padding=5)[0, 0]
    m1, m2 = under(x), under(y)
    s1, s2, s12 = under(x * x) - m1 * m1, under(y * y) - m2 * m2, under(x * y) - m1 * m2
    c1, c2 = 0.01**2, 0.03**2
    return ((2 * m1 * m2 + c1) * (2 * s12 + c2) / ((m1 * m1 + m2 * m2 + c1) * (s1 + s2 + c2))).mean()


def voxels(p, corner):
    n, side = CASE["tv_box"], 2.0 / CASE["voxels"]
    axes = [corner[k] + side * torch.arange(n).double() for k in range(3)]
    x, y, z = torch.meshgrid(*axes, indexing="ij")
    at = torch.stack([x, y, z], -1)
    inverse, density = torch.linalg.inv(covariances(p)), torch.nn.functional.softplus(p["density"])
    total = torch.zeros(n, n, n)
    for i in range(len(density)):
        d = at - p["position"][i]
        value = density[i] * torch.exp(-0.5 * (d @ inverse[i] * d).sum(-1))
        reach = 3 * scales(p)[i].max().detach()
        total = total + torch.where((d.detach().abs() <= reach).all(-1), value, torch.zeros(()))
    return total


def variation(v):
    n = CASE["tv_box"]
    return (v.diff(dim=0).abs().sum() + v.diff(dim=1).abs().sum() + v.diff(dim=2).abs().sum()) / (3 * (n - 1) * n * n)


def terms(see, p, y, angles, corner):
    x = see(p, angles)
    return (x - y).abs().mean(), CASE["ssim"] * (1 - ssim(x, y)), CASE["tv"] * variation(voxels(p, corner)), x


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", default="tests/golden", type=pathlib.Path)
    out = parser.parse_args().out
    for name, see in [("r2", picture), ("r2_exact", exact_picture)]:
        write(out / f"{name}.safetensors", golden(see), {"case": json.dumps(CASE)})


def golden(see):
    rng = np.random.default_rng(11)
    n = CASE["gaussians"]
    f32 = lambda a: torch.tensor(np.asarray(a, np.float32).astype(np.float64))
    position = rng.normal(0, 0.3, (n, 3))
    # Beyond where slopes follow the centre.
    position[:3] = [[0.7, -0.9, 0.2], [-0.8, 0.3, 0.9], [0.1, 0.95, -0.9]]
    scale = rng.normal(-2.2, 0.4, (n, 3))
    scale[:3] += 1.5
    start = dict(position=f32(position), scale=f32(scale), rotation=f32(rng.normal(0, 1, (n, 4))),
                 density=f32(rng.normal(-0.7, 0.6, n)))
    shown = CASE["shown"]
    images = [f32(rng.uniform(0, 0.6, (H, W))) for _ in CASE["angles"]]
    room = 2 - 2.0 / CASE["voxels"] * CASE["tv_box"]
    corners = f32(0.6 * (rng.uniform(0, room, (len(shown), 3)) - room / 2) - CASE["tv_box"] / CASE["voxels"])
    p = {k: torch.nn.Parameter(v.clone()) for k, v in start.items()}
    parts = terms(see, p, images[shown[0]], CASE["angles"][shown[0]], corners[0])
    sum(parts[:3]).backward()
    tensors = {f"start/{k}": v.numpy() for k, v in start.items()}
    tensors |= {f"gradient/{k}": v.grad.clone().numpy() for k, v in p.items()}
    tensors |= {f"image/{k}": image.numpy() for k, image in enumerate(images)}
    tensors["corner"] = corners.numpy()
    tensors["terms"] = np.array([part.item() for part in parts[:3]])
    tensors["picture"] = parts[3].detach().numpy()
    rates = CASE["rates"]
    adam = torch.optim.Adam([dict(params=[p[k]], lr=0.0, name=k) for k in p], betas=(0.9, 0.999), eps=1e-15)
    for step in range(CASE["updates"]):
        for group in adam.param_groups:
            first, last = rates[group["name"]]
            group["lr"] = first * (last / first) ** ((step + 1) / CASE["iterations"])
        adam.zero_grad()
        image = shown[step]
        sum(terms(see, p, images[image], CASE["angles"][image], corners[step])[:3]).backward()
        adam.step()
    return tensors | {f"final/{k}": v.detach().numpy() for k, v in p.items()}


if __name__ == "__main__":
    main()
