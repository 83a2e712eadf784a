#!/usr/bin/env python3
"""Golden values of a whole training, from an independent PyTorch implementation in float64 and in float32.

Writes tests/golden/training-<preset>.safetensors: a small dataset, initial parameters, and after some of 300 iterations, with the
delay of the dynamic field among them, the losses and all parameters in float64. Beside the losses of an iteration, the static field
and the dynamic one (of NeRF-CA both networks together) stands their spread: by how much the same training in float32 differs,
relative to the root of the sum of squares, the most of several orders of summation with sines as inexact as those of a driver. An
engine in f32 that trains alike stays within a
small multiple of the spread; one that forgets to start learning rates again, keeps old moments or leaves out a step does not.

The loop is the one of the authors' code: torch.optim.Adam with a parameter group per field, rates multiplied or lowered after each
step, the dynamic field's gradients absent before the delay, and a new optimiser made after the first step with them. Geometry, ray
order, depths, data and initial parameters are those of reference.py.

    python3 tools/reference_training.py [--out tests/golden] [--preset paper] [--fault rates|moments|step]

On request a fault is planted, and the table tells by how many spreads the values would be off: rates that do not start again,
moments that are kept, one step too few (of NeRF-CA: weights that come an iteration late). (needs torch and numpy)
"""

import argparse
import json
import math
import pathlib
import sys

import numpy as np
import torch

sys.path.insert(0, str(pathlib.Path(__file__).parent))
import reference as ref

ITERATIONS, DELAY = 300, 150
COMMON = dict(iterations=ITERATIONS, delay=DELAY, window_iterations=100, grid=8, rays=24, static_samples=24, dynamic_samples=24)
# What differs from the cases of single steps.
PRESETS = {
    "paper": {},
    # Gentler rates than in single steps: with those, rounding alone decides where the network is after 150 steps.
    "public-code": dict(static_lr=(1e-2, 1e-3), dynamic_lr=(3e-3, 3e-4)),
    # `delay` is that of losses; the ramps of their weights end within the run.
    "nerf-ca": dict(window_iterations=200, ramp=100, rays=21),
}
COMPARED = (1, 10, DELAY - 1, DELAY, DELAY + 1, DELAY + 2, ITERATIONS)
# Orders in which float32 sums: the ray that comes first, and 1 or -1 for samples forwards or backwards.
ORDERS = [(first_ray, direction) for first_ray in (0, 5, 11, 16) for direction in (1, -1)]
# Sines and cosines of the float32 runs are off by up to this: Vulkan allows 2^-11.
SINE_ERROR = 2.0**-20
# Smallest spread: float32 resolves no less.
LEAST_SPREAD = 2.0**-23


class Batches:
    """Rays of every iteration and the random numbers of their depths, the same for all runs of a case."""

    def __init__(self, c, frames):
        self.c = c
        self.rays = [self.draw(frames, step) for step in range(c["iterations"])]

    def draw(self, frames, step):
        c, rays = self.c, dict(anchor=[], direction=[], random=[], phase=[], target=[], change=[])
        for frame, pixel, ray_id in ref.batch(c, frames, step):
            view, phase, image = frames[frame]
            anchor, direction = ref.pixel_ray(c, view, pixel)
            stream = 1 + (((ray_id + 1) if c["per_ray"] else 0) << 4)
            rays["anchor"].append(anchor)
            rays["direction"].append(direction)
            rays["random"].append([ref.uniform(c["seed"], stream, step, k) for k in range(c["dynamic_samples"])])
            rays["phase"].append(phase)
            rays["target"].append(image.flatten()[pixel])
            rays["change"].append(ref.changes(frames, view).flatten()[pixel] if c["two_networks"] else 0.0)
        return {key: np.array(value) for key, value in rays.items()}

    def samples(self, step, precision):
        """Depths, path lengths and points, computed in a precision."""
        c, rays = self.c, self.rays[step]
        real = lambda value: np.asarray(value, dtype=precision)
        near, span, n = real(-c["depth"]), real(2 * c["depth"]), c["dynamic_samples"]
        grid = near + span * (real(np.arange(n)) / real(n - 1))
        middle = real(0.5) * (grid[1:] + grid[:-1])
        low, high = np.concatenate([grid[:1], middle]), np.concatenate([middle, grid[-1:]])
        t = low + (high - low) * real(rays["random"])
        anchor, direction = real(rays["anchor"]), real(rays["direction"])
        norm = real(1.0) if c["two_networks"] else np.sqrt((direction**2).sum(1, keepdims=True))
        last = np.full((len(t), 1), 1e-10, dtype=precision)
        dl = np.concatenate([t[:, 1:] - t[:, :-1], last], 1) * norm
        x = anchor[:, None] + t[:, :, None] * direction[:, None]
        kept = {key: real(rays[key]) for key in ("target", "change")}
        return dict(x=x, dl=dl, t=t, phase=rays["phase"]) | kept


def in_order(rows, order):
    """A batch whose rays and samples are summed in another order."""
    first_ray, direction = order
    rolled = {key: np.roll(value, -first_ray, 0) for key, value in rows.items()}
    return {key: value[:, ::direction] if value.ndim > 1 else value for key, value in rolled.items()}


def near_mask(c, rows):
    """Samples near the source, before they are put in another order: (rays, samples)."""
    if c["two_networks"] or c["occlusion_region"] == "depth-range":
        return rows["t"] < -c["depth"] + 2 * c["depth"] * c["occlusion_share"]
    paths = np.cumsum(rows["dl"], 1)
    return paths < c["occlusion_share"] * paths[-1, -1]


def inside(x, half):
    return (np.abs(x) <= half).all(-1)


class Training:
    """A run in one precision and one order of summation."""

    def __init__(self, c, initial, dtype, order, fault=None):
        self.c, self.dtype, self.order, self.fault = c, dtype, order, fault
        self.p = {name: value.detach().to(dtype).clone().requires_grad_() for name, value in initial.items()}
        self.adam = self.new_optimiser()
        self.rates_since = 0
        self.random = torch.Generator().manual_seed(1 + ORDERS.index(order))

    def tensor(self, values):
        return torch.tensor(np.ascontiguousarray(values), dtype=self.dtype)

    def inexact(self, wave):
        if self.dtype == torch.float64:
            return wave
        return wave + SINE_ERROR * (2 * torch.rand(wave.shape, generator=self.random, dtype=self.dtype) - 1)

    def network(self, field, x, phases, window):
        c, p = self.c, self.p
        x = (x - self.tensor(np.array(c["scene"]["centre"]))) * c["scene"]["scale"]
        parts = [x]
        for k in range(c["bands"]):
            open_share = min(max(window - k, 0.0), 1.0)
            parts += [open_share * self.inexact(wave(2.0**k * x)) for wave in (torch.sin, torch.cos)]
        if field == "dynamic":
            parts.append(p["dynamic.latent"][phases])
        inputs = torch.cat(parts, -1)
        h = inputs
        for i in range(c["layers"]):
            if i + 1 == c["skip"]:
                h = torch.cat([inputs, h], -1)
            h = torch.relu(h @ p[f"{field}.layer{i}.weight"].T + p[f"{field}.layer{i}.bias"])
        return (h @ p[f"{field}.out.weight"].T + p[f"{field}.out.bias"])[:, 0]

    def at_samples(self, mask, values):
        """Values at the samples of a mask, zero elsewhere: (rays, samples)."""
        out = torch.zeros(mask.shape, dtype=self.dtype)
        out[torch.tensor(mask.copy())] = values
        return out

    def total_variation(self):
        c, value = self.c, 0.0
        for plane in ("xy", "xz", "yz"):
            g = self.p[f"static.plane.{plane}"]
            value = value + c["tv_plane"] * 2 * ((g[:, 1:] - g[:, :-1]) ** 2).mean()
            value = value + c["tv_plane"] * 2 * ((g[:, :, 1:] - g[:, :, :-1]) ** 2).mean()
        for line in ("z", "y", "x"):
            g = self.p[f"static.line.{line}"]
            value = value + c["tv_line"] * 2 * ((g[:, 1:] - g[:, :-1]) ** 2).mean()
        return c["tv"] * value

    def losses(self, rows, step):
        """NerT-CA: a tensor field and, from the delay on, a network in its box."""
        c, scene = self.c, self.c["scene"]
        near, rows = in_order(dict(near=near_mask(c, rows)), self.order)["near"], in_order(rows, self.order)
        dl = self.tensor(rows["dl"])
        mask = inside(rows["x"], scene["static_half"])
        feature = ref.static_feature(c, self.p, self.tensor(rows["x"][mask]), scene["static_half"])
        sigma = scene["static_gain"] * torch.nn.functional.softplus(feature + scene["static_shift"])
        integral = (self.at_samples(mask, sigma) * dl).sum(1)
        occlusion, live = torch.zeros((), dtype=self.dtype), 0
        if step >= c["delay"]:
            window = min(c["bands"] * (step - c["delay"]) / c["window_iterations"], c["bands"])
            mask = inside(rows["x"], scene["dynamic_half"])
            live = int(mask.sum())
            phases = torch.tensor(np.broadcast_to(rows["phase"][:, None], mask.shape)[mask])
            feature = self.network("dynamic", self.tensor(rows["x"][mask]), phases, window)
            sigma = scene["dynamic_gain"] * torch.nn.functional.softplus(feature + scene["dynamic_shift"])
            mass = self.at_samples(mask, sigma) * dl
            integral = integral + mass.sum(1)
            occlusion = (mass * self.tensor(near)).sum()
        data = ((integral - self.tensor(rows["target"])) ** 2).mean()
        return dict(data=data, tv=self.total_variation(), occlusion=c["occlusion"] * occlusion), live

    def losses_of_two_networks(self, rows, step):
        """NeRF-CA: both fields are networks, at the same samples everywhere."""
        c, small, n = self.c, 1e-10, self.c["rays"]
        near, rows = in_order(dict(near=near_mask(c, rows)), self.order)["near"], in_order(rows, self.order)
        opened = min(c["window_start"] + (c["bands"] - c["window_start"]) * step / c["window_iterations"], c["bands"])
        shape, dl = rows["dl"].shape, self.tensor(rows["dl"])
        x = self.tensor(rows["x"].reshape(-1, 3))
        phases = torch.tensor(np.repeat(rows["phase"], shape[1]))
        field = lambda name: c["gain"] * torch.nn.functional.softplus(self.network(name, x, phases, opened)).reshape(shape)
        still, moving = field("static"), field("dynamic")
        change, target = self.tensor(rows["change"]), self.tensor(rows["target"])
        residual = ((still + moving) * dl).sum(1) - target
        data = ((1 + c["change_weight"] * change) * residual**2).sum() / n
        b = torch.clamp(moving / (still + moving + small), 1e-19, 1 - 1e-19)
        rest = torch.clamp(1 - b, min=1e-19)
        favour = -(b * torch.log(b) + rest * torch.log(rest)).mean(1).sum() / n
        mass = moving * dl
        share = mass / torch.clamp(mass.sum(1, keepdim=True), min=1e-19)
        counts = (mass.sum(1) >= c["least_integral"]) | (change > c["least_change"])
        entropy = (-(share * torch.log(share + small)).sum(1) * counts).sum() / n
        # The planted fault of a missing step: weights come an iteration late.
        ramp = lambda name, delay: ref.ramp(c, name, step - int(self.fault == "step"), delay)
        size = (still * dl).sum() + ((still * dl) ** 2).sum()
        return dict(
            data=data,
            favour_static=ramp("favour_static", c["delay"]) * favour,
            ray_entropy=ramp("ray_entropy", 0) * entropy,
            occlusion=ramp("near_integral", c["delay"]) * (mass * self.tensor(near)).sum() / n,
            static_size=ramp("static_size", 0) * size,
        ), shape[0] * shape[1]

    def new_optimiser(self):
        c = self.c
        groups = [
            dict(params=[v for k, v in self.p.items() if k.startswith(field)], lr=c[f"{field}_lr"][0], name=f"{field}_lr")
            for field in ("static", "dynamic")
        ]
        return torch.optim.Adam(groups, betas=c["betas"], eps=c["eps"])

    def lower_rates(self, step):
        """Rates of the iteration after `step`. A straight line reaches its end with the run; a factor stays what it was."""
        c = self.c
        for group in self.adam.param_groups:
            if group["name"] == "dynamic_lr" and step < c["delay"] and not c["two_networks"]:
                continue
            start, end = c[group["name"]]
            if c["decay"] == "exponential":
                group["lr"] *= (end / start) ** (1 / c["iterations"])
            else:
                length = c["iterations"] * c["decay_share"] - self.rates_since
                group["lr"] = start + (end - start) * min((step + 1 - self.rates_since) / length, 1.0)

    def step(self, rows, step):
        """One iteration: the loss terms before its update."""
        c = self.c
        delayed = c["delay"] if not c["two_networks"] else None
        if self.fault == "step" and step == delayed:
            # The optimiser is made anew before the first step with the dynamic field, so that one step is missing.
            self.start_again(step)
        terms, live = (self.losses_of_two_networks if c["two_networks"] else self.losses)(rows, step)
        self.adam.zero_grad(set_to_none=True)
        sum(terms.values()).backward()
        self.adam.step()
        self.lower_rates(step)
        if step == delayed and self.fault != "step":
            self.start_again(step + 1)
        return {name: float(value.detach()) for name, value in terms.items()} | dict(live=float(live))

    def start_again(self, since):
        if self.fault == "moments":
            for group in self.adam.param_groups:
                group["lr"] = self.c[group["name"]][0]
            self.rates_since = since
            return
        rates = [group["lr"] for group in self.adam.param_groups]
        self.adam = self.new_optimiser()
        self.rates_since = since
        if self.fault == "rates":
            self.rates_since = 0
            for group, rate in zip(self.adam.param_groups, rates):
                group["lr"] = rate

    def run(self, batches):
        """Losses and parameters after the compared iterations."""
        kept, precision = {}, np.float64 if self.dtype == torch.float64 else np.float32
        for step in range(self.c["iterations"]):
            terms = self.step(batches.samples(step, precision), step)
            if step + 1 in COMPARED:
                kept |= {f"{step + 1}/loss/{k}": torch.tensor([v], dtype=torch.float64) for k, v in terms.items()}
                kept |= {f"{step + 1}/{k}": v.detach().double().clone() for k, v in self.p.items()}
        return kept


def groups(c, kept, iteration):
    """Values after an iteration that are compared as one vector: each loss, and the parameters of each field."""
    out = {}
    for key, value in sorted(kept.items()):
        place = key.split("/")
        if place[0] == str(iteration):
            field = "fields" if c["two_networks"] else place[1].split(".")[0]
            name = key if place[1] == "loss" else f"{iteration}/{field}"
            out[name] = torch.cat([out[name], value.flatten()]) if name in out else value.flatten()
    return out


def kind(name):
    """Of one kind are the losses of an iteration, and each field."""
    return name.split("/")[1]


def off(value, other):
    """Distance between two vectors relative to the length of the first; float32 resolves no less than the least."""
    return max(float((other - value).norm() / max(float(value.norm()), 1e-300)), LEAST_SPREAD)


def train(name, fault=None):
    c = ref.constants(name) | COMMON | PRESETS[name]
    frames, initial = ref.dataset(c), ref.initial(c)
    batches = Batches(c, frames)
    exact = Training(c, initial, torch.float64, ORDERS[0]).run(batches)
    if fault:
        faulty = Training(c, initial, torch.float64, ORDERS[0], fault).run(batches)
    singles = [Training(c, initial, torch.float32, order).run(batches) for order in ORDERS]
    spreads = {}
    for iteration in COMPARED:
        here = groups(c, exact, iteration)
        others = [groups(c, single, iteration) for single in singles]
        found = {}
        for key, value in here.items():
            found[kind(key)] = max([off(value, other[key]) for other in others] + [found.get(kind(key), 0.0)])
        text = f"{name} {iteration}: spreads " + ", ".join(f"{key} {value:.1e}" for key, value in found.items())
        if fault:
            wrong = groups(c, faulty, iteration)
            text += f"; planted, in spreads: {max(off(value, wrong[key]) / found[kind(key)] for key, value in here.items()):.1f}"
        print(text)
        spreads |= {f"{iteration}/{key}": value for key, value in found.items()}
    out = {f"initial/{k}": v.detach().clone() for k, v in initial.items()} | exact
    out |= {f"spread/{k}": torch.tensor([v], dtype=torch.float64) for k, v in spreads.items()}
    out |= {f"image/{i}": torch.tensor(f[2]) for i, f in enumerate(frames)}
    for view in range(len(ref.ANGLES)):
        low, high = ref.still_background(c, frames, view)
        out |= {f"background/{view}/low": torch.tensor(low), f"background/{view}/high": torch.tensor(high)}
    return c, out


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=pathlib.Path, default=pathlib.Path(__file__).parent.parent / "tests" / "golden")
    parser.add_argument("--preset", action="append", choices=PRESETS, help="use only this preset; may be repeated")
    parser.add_argument("--fault", choices=("rates", "moments", "step"),
                        help="introduce this fault, print its effect, and write no file")
    args = parser.parse_args()
    for name in args.preset or PRESETS:
        c, out = train(name, args.fault)
        if args.fault:
            continue
        case = c | dict(preset=name, angles=ref.ANGLES, arm=ref.ARM, compared=COMPARED)
        path = args.out / f"training-{name}.safetensors"
        ref.write_safetensors(path, out, dict(case=json.dumps(case), torch=torch.__version__))
        print(path)


if __name__ == "__main__":
    main()
