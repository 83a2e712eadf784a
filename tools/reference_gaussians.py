#!/usr/bin/env python3
"""Golden values of the Gaussians from an independent PyTorch float64 implementation.

Writes tests/golden/gaussians.safetensors: two views of two phases with bounds and weights, Gaussians, and what follows from
them: images, loss, all gradients, the parameters after ten Adam updates, and exact line integrals by quadrature. Nothing
here is shared with the engine: C-arm, camera-frame projection, autograd and torch.optim.Adam are this script's own.

    python3 tools/reference_gaussians.py [--out tests/golden]      (needs torch and numpy)
"""

import argparse
import json
import math
import pathlib
import struct

import numpy as np
import torch

torch.set_default_dtype(torch.float64)

CASE = dict(
    width_px=17, height_px=14, phases=2, angles=[[-30.0, 30.0], [55.0, -20.0], [5.0, 8.0]],
    arm=dict(sid_mm=1000.0, sod_mm=620.0, pixel_mm=[1.5, 1.8], offset_mm=[1.0, -2.0]),
    gaussians=26, cut=3.2, least_scale=0.4, greatest_scale=3.0, bend=0.05, updates=10, iterations=40,
    rates=dict(position=0.05, scale=0.03, rotation=0.03, density=0.08), betas=[0.9, 0.98],
    # The last view has no image of the last phase.
    missing=[[1, 2]],
)
# A pixel at the isocentre: mean pitch over the magnification, in units of 100 mm.
PIXEL = 0.5 * (1.5 + 1.8) * 620.0 / 1000.0 / 100.0


def rotation(primary, secondary):
    def about_x(a):
        return np.array([[1, 0, 0], [0, math.cos(a), -math.sin(a)], [0, math.sin(a), math.cos(a)]])

    def about_z(a):
        return np.array([[math.cos(a), -math.sin(a), 0], [math.sin(a), math.cos(a), 0], [0, 0, 1]])

    r = about_z(-math.radians(primary)) @ about_z(math.pi / 2) @ about_x(math.radians(secondary)) @ about_x(-math.pi / 2)
    return torch.tensor(r)


class Camera:
    """Points are isocentre pixels in world axes; the camera looks along z from (0, 0, -sod)."""

    def __init__(self, angles):
        arm = CASE["arm"]
        self.r = rotation(*angles)
        self.sod = arm["sod_mm"] / 100.0 / PIXEL
        self.focal = [arm["sid_mm"] / p for p in arm["pixel_mm"]]
        self.centre = [(n - 1) / 2 - o / p for n, o, p in
                       zip((CASE["width_px"], CASE["height_px"]), arm["offset_mm"], arm["pixel_mm"])]

    def project(self, x, covariance, volume):
        q = x @ self.r
        z = q[:, 2] + self.sod
        a, b = q[:, 0] / z, q[:, 1] / z
        zero = torch.zeros_like(z)
        fu, fv = self.focal
        jacobian = torch.stack([torch.stack([fu / z, zero, -fu * a / z], -1), torch.stack([zero, fv / z, -fv * b / z], -1)], 1)
        c = self.r.T @ covariance @ self.r
        image = jacobian @ c @ jacobian.transpose(1, 2)
        # Integral over depth: the volume of the Gaussian over the area of its image, along a ray longer than its depth.
        ray = torch.sqrt(1 + a * a + b * b)
        amplitude = math.sqrt(2 * math.pi) * volume * fu * fv / z**2 * ray / torch.sqrt(torch.linalg.det(image))
        mean = torch.stack([fu * a + self.centre[0], fv * b + self.centre[1]], -1)
        return mean, image, amplitude

    def ray(self, column, row):
        """Source, and direction of unit length."""
        d = torch.tensor([(column - self.centre[0]) / self.focal[0], (row - self.centre[1]) / self.focal[1], 1.0])
        return self.r @ torch.tensor([0.0, 0.0, -self.sod]), self.r @ (d / d.norm())


def rotations(q):
    w, x, y, z = torch.nn.functional.normalize(q, dim=-1).unbind(-1)
    return torch.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
                        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
                        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], -1).view(-1, 3, 3)


def shapes(p):
    scale = p["scale"].exp().clamp(CASE["least_scale"], CASE["greatest_scale"])
    r = rotations(p["rotation"])
    return r @ ((scale * scale)[:, :, None] * r.transpose(1, 2)), scale.prod(-1)


def images(p, phase_of):
    h, w = CASE["height_px"], CASE["width_px"]
    rows, columns = torch.meshgrid(torch.arange(h, dtype=torch.float64), torch.arange(w, dtype=torch.float64), indexing="ij")
    pixels = torch.stack([columns, rows], -1)
    covariance, volume = shapes(p)
    out = {}
    for view, angles in enumerate(CASE["angles"]):
        mean, image, amplitude = Camera(angles).project(p["position"], covariance, volume)
        conic = torch.linalg.inv(image)
        half = CASE["cut"] * torch.diagonal(image, dim1=1, dim2=2).detach().sqrt()
        for phase in range(CASE["phases"]):
            if [phase, view] in CASE["missing"]:
                continue
            total = torch.zeros(h, w)
            for i in torch.nonzero(phase_of == phase)[:, 0]:
                d = pixels - mean[i]
                q = (d @ conic[i] * d).sum(-1)
                inside = (d.detach().abs() <= half[i]).all(-1)
                total = total + torch.where(inside, p["density"][i].exp() * amplitude[i] * torch.exp(-0.5 * q), torch.zeros(()))
            out[view, phase] = total
    return out


def loss(seen, bounds):
    total = 0.0
    for key, image in seen.items():
        low, high, weight = bounds[key]
        r = weight * ((image - high).clamp(min=0) - (low - image).clamp(min=0))
        total = total + (torch.sqrt(r * r + CASE["bend"] ** 2) - CASE["bend"]).sum()
    return total / CASE["phases"]


def rate(step):
    return min(1.0, max(0.05, (CASE["iterations"] - step) / (0.3 * CASE["iterations"])))


def exact_integrals(p, count):
    """Quadrature of the density along rays through the first view, one Gaussian at a time: [Gaussian, column, row, value]."""
    covariance, _ = shapes(p)
    camera = Camera(CASE["angles"][0])
    rows = []
    for i in range(count):
        mean, _, _ = camera.project(p["position"], covariance, torch.ones(len(covariance)))
        column, row = float(mean[i, 0]) + 0.7, float(mean[i, 1]) - 0.4
        source, direction = camera.ray(column, row)
        at = (p["position"][i] - source) @ direction
        t = at + torch.linspace(-40, 40, 40001)
        x = source + t[:, None] * direction - p["position"][i]
        value = p["density"][i].exp() * torch.exp(-0.5 * (x @ torch.linalg.inv(covariance[i]) * x).sum(-1))
        rows.append([i, column, row, float(torch.trapezoid(value, t))])
    return np.array(rows)


def write(path, tensors, metadata):
    header, offset, blobs = {"__metadata__": metadata}, 0, []
    for name, value in tensors.items():
        data = np.ascontiguousarray(value, dtype="<f8").tobytes()
        header[name] = {"dtype": "F64", "shape": list(np.shape(value)), "data_offsets": [offset, offset + len(data)]}
        offset += len(data)
        blobs.append(data)
    text = json.dumps(header).encode()
    text += b" " * (-len(text) % 8)
    path.write_bytes(struct.pack("<Q", len(text)) + text + b"".join(blobs))


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", default="tests/golden", type=pathlib.Path)
    out = parser.parse_args().out
    rng = np.random.default_rng(3)
    n, w, h = CASE["gaussians"], CASE["width_px"], CASE["height_px"]
    f32 = lambda a: torch.tensor(np.asarray(a, np.float32).astype(np.float64))
    start = dict(position=f32(rng.normal(0, 3.0, (n, 3))), scale=f32(rng.normal(0.1, 0.45, (n, 3))),
                 rotation=f32(rng.normal(0, 1, (n, 4))), density=f32(rng.normal(-1.5, 0.4, n)))
    phase_of = torch.arange(n) % CASE["phases"]
    bounds = {}
    for view in range(len(CASE["angles"])):
        for phase in range(CASE["phases"]):
            if [phase, view] not in CASE["missing"]:
                low = rng.uniform(-0.1, 0.9, (h, w))
                bounds[view, phase] = f32(low), f32(low + rng.uniform(0, 0.3, (h, w))), f32(rng.uniform(0.5, 1, (h, w)))
    p = {k: torch.nn.Parameter(v.clone()) for k, v in start.items()}
    seen = images(p, phase_of)
    value = loss(seen, bounds)
    value.backward()
    tensors = {f"start/{k}": v.numpy() for k, v in start.items()}
    tensors |= {f"gradient/{k}": v.grad.clone().numpy() for k, v in p.items()}
    tensors["loss"] = np.array([float(value)])
    for (view, phase), (low, high, weight) in bounds.items():
        key = f"{view}/{phase}"
        tensors |= {f"low/{key}": low.numpy(), f"high/{key}": high.numpy(), f"weight/{key}": weight.numpy()}
        tensors[f"image/{key}"] = seen[view, phase].detach().numpy()
    groups = [dict(params=[p[k]], lr=CASE["rates"][k], base=CASE["rates"][k]) for k in p]
    adam = torch.optim.Adam(groups, betas=tuple(CASE["betas"]), eps=1e-12)
    for step in range(CASE["updates"]):
        for group in adam.param_groups:
            group["lr"] = group["base"] * rate(step)
        adam.zero_grad()
        loss(images(p, phase_of), bounds).backward()
        adam.step()
    tensors |= {f"final/{k}": v.detach().numpy() for k, v in p.items()}
    tensors["exact"] = exact_integrals({k: v for k, v in start.items()}, 8)
    write(out / "gaussians.safetensors", tensors, {"case": json.dumps(CASE)})


if __name__ == "__main__":
    main()
