#!/usr/bin/env python3
"""Golden values from an independent PyTorch float64 implementation of the method.

Writes tests/golden/<preset>.safetensors: a small dataset, initial parameters, losses and all gradients of
the first and of later iterations, and the parameters after ten Adam updates across the delay of the dynamic
field. Nothing here is shared with the engine: geometry, ray order, depths, fields (torch's grid_sample and
matrix products), losses, autograd and torch.optim.Adam are all this script's own.

    python3 tools/reference.py [--out tests/golden] [--preset nerf-ca]      (needs torch and numpy)
"""

import argparse
import json
import math
import pathlib
import struct

import numpy as np
import torch

torch.set_default_dtype(torch.float64)
U32 = 0xFFFFFFFF

COMMON = dict(
    seed=5, width_px=7, height_px=6, phases=3, rays=21, static_samples=20, dynamic_samples=20, grid=6, ranks=3,
    mlp_width=16, latent=8, iterations=40, delay=4, window_iterations=12, depth=0.9, tv_plane=1e-2, tv_line=1e-3,
    betas=(0.9, 0.99), occlusion_share=0.2, occlusion_region="depth-range", after_phases=(0.0,), decay_share=1.0,
)
PRESETS = {
    "paper": dict(
        layers=4, skip=0, bands=10, window_start=0.0, per_ray=True, temporal=False, decay="linear",
        static_lr=(1e-2, 1e-3), dynamic_lr=(1e-2, 1e-3), tv=1e-2, occlusion=1e-3, eps=1e-6, n_motion=0,
        scene=dict(static_half=0.5, dynamic_half=1.0, static_gain=1.0, static_shift=-4.0, dynamic_gain=1.0,
                   dynamic_shift=-3.0, static_weight=1.0, dynamic_weight=1.0, robust_scale=0.0, centre=(0.0, 0.0, 0.0), scale=1.0),
    ),
    "public-code": dict(
        layers=5, skip=4, bands=10, window_start=0.0, per_ray=False, temporal=False, decay="exponential",
        occlusion_region="last-ray",
        static_lr=(2e-2, 2e-3), dynamic_lr=(1e-2, 1e-3), tv=1e-2, occlusion=1e-3, eps=1e-6, n_motion=0,
        scene=dict(static_half=0.5, dynamic_half=1.0, static_gain=1.0, static_shift=-4.0, dynamic_gain=1.0,
                   dynamic_shift=-3.0, static_weight=1.0, dynamic_weight=1.0, robust_scale=0.0, centre=(0.0, 0.0, 0.0), scale=1.0),
    ),
    "fast": dict(
        layers=3, skip=0, bands=6, window_start=3.0, per_ray=True, temporal=True, decay="linear",
        static_lr=(1e-2, 1e-3), dynamic_lr=(3e-3, 3e-4), tv=1e-3, occlusion=0.0, eps=1e-6, n_motion=12,
        after_phases=(0.0, 0.375, -0.25, 0.5),
        scene=dict(static_half=0.9, dynamic_half=0.45, static_gain=0.5, static_shift=0.54, dynamic_gain=4.0,
                   dynamic_shift=-2.0, static_weight=1.2, dynamic_weight=9.0, robust_scale=0.05, centre=(0.02, -0.01, 0.03), scale=6.5),
    ),
    # Two networks; weights large enough for each loss to show in the gradient. `delay` is that of the losses.
    "nerf-ca": dict(
        layers=5, skip=0, bands=12, window_start=1.0, per_ray=False, decay="linear", iterations=12, decay_share=0.75,
        static_lr=(1e-3, 1e-5), dynamic_lr=(1e-3, 1e-5), betas=(0.9, 0.999), eps=1e-6, n_motion=12, occlusion_share=0.4,
        gain=0.5, ramp=5, favour_static=(0.05, 0.2), ray_entropy=(0.02, 0.1), near_integral=(0.01, 0.3),
        static_size=(1e-3, 1e-2), least_change=0.03, least_integral=0.63, change_weight=1.0,
        scene=dict(centre=(0.0, 0.0, 0.0), scale=1.0),
    ),
}
TWO_NETWORKS = "nerf-ca"


def constants(name):
    return COMMON | PRESETS[name] | dict(two_networks=name == TWO_NETWORKS)


# -- counter-based random numbers -----------------------------------------------------------------------------

def pcg4d(a, b, c, d):
    v = [(x * 1664525 + 1013904223) & U32 for x in (a, b, c, d)]

    def mix():
        for target, p, q in ((0, 1, 3), (1, 2, 0), (2, 0, 1), (3, 1, 2)):
            v[target] = (v[target] + v[p] * v[q]) & U32

    mix()
    v[:] = [x ^ (x >> 16) for x in v]
    mix()
    return v


def uniform(seed, stream, a, b):
    return (pcg4d(seed, stream & U32, a, b)[0] >> 8) / 16777216.0


def permute(index, n, seed, epoch, stream):
    half = 1
    while half < 16 and (1 << (2 * half)) < n:
        half += 1
    mask = (1 << half) - 1
    x = index
    while True:
        left, right = x >> half, x & mask
        for turn in range(4):
            left, right = right, left ^ (pcg4d(right, seed ^ ((stream << 28) & U32), epoch, turn)[0] & mask)
        x = (left << half) | right
        if x < n:
            return x


# -- data ------------------------------------------------------------------------------------------------------

ANGLES = [(-30.0, 20.0), (40.0, -10.0), (85.0, 15.0)]
ARM = dict(sid_mm=1000.0, sod_mm=600.0, pixel_mm=(17.0, 20.0), offset_mm=(1.0, -2.0))


def rotation(primary, secondary):
    def rx(t):
        c, s = math.cos(t), math.sin(t)
        return np.array([[1, 0, 0], [0, c, -s], [0, s, c]])

    def rz(t):
        c, s = math.cos(t), math.sin(t)
        return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])

    a, b = math.radians(primary), math.radians(secondary)
    return rz(-a) @ rz(math.pi / 2) @ rx(b) @ rx(-math.pi / 2)


def f32(x):
    return np.asarray(x, dtype=np.float32).astype(np.float64)


def dataset(c):
    w, h = c["width_px"], c["height_px"]
    frames = []
    for v in range(len(ANGLES)):
        for phase in range(c["phases"]):
            x, y = np.meshgrid(np.arange(w) / w, np.arange(h) / h)
            d2 = (x - 0.4 - 0.1 * phase) ** 2 + (y - 0.5 + 0.05 * v) ** 2
            frames.append((v, phase, f32(0.8 + 0.3 * x - 0.2 * y + 0.5 * np.exp(-d2 / 0.02))))
    return frames


def pixel_ray(c, view, pixel):
    i, j = pixel % c["width_px"], pixel // c["width_px"]
    u = (i + 0.5 - c["width_px"] / 2) * ARM["pixel_mm"][0] + ARM["offset_mm"][0]
    v = (j + 0.5 - c["height_px"] / 2) * ARM["pixel_mm"][1] + ARM["offset_mm"][1]
    r = rotation(*ANGLES[view])
    across = r @ np.array([u / ARM["sid_mm"], v / ARM["sid_mm"], 0.0])
    return across * ARM["sod_mm"] / 100.0, across + r @ np.array([0.0, 0.0, 1.0])


def still_background(c, frames, view):
    """Bounds of each pixel's still background."""
    high = np.stack([f[2] for f in frames if f[0] == view]).min(0)
    return f32(high - 0.1), high


def changes(frames, view):
    """Variance over the phases of the transmission, from 0 to 1 within the view."""
    variance = np.exp(-np.stack([f[2] for f in frames if f[0] == view])).var(0)
    return (variance - variance.min()) / (variance.max() - variance.min())


def ray_lists(c, frames):
    """Rays that are drawn first, and those that the others are drawn from."""
    everything = range(len(frames) * c["width_px"] * c["height_px"])
    if c["two_networks"]:
        changing = np.concatenate([changes(frames, f[0]).flatten() for f in frames]) > c["least_change"]
        return [r for r in everything if changing[r]], [r for r in everything if not changing[r]]
    # Every third one is said to meet the hull.
    return list(everything[::3]), list(everything)


def batch(c, frames, step):
    """Frame index, pixel and id of each ray."""
    pixels, lists = c["width_px"] * c["height_px"], ray_lists(c, frames)
    out = []
    for r in range(c["rays"]):
        first = r < c["n_motion"]
        per, rays = (c["n_motion"], lists[0]) if first else (c["rays"] - c["n_motion"], lists[1])
        counter = step * per + (r if first else r - c["n_motion"])
        chosen = permute(counter % len(rays), len(rays), c["seed"], counter // len(rays), 3 if first else 2)
        ray_id = rays[chosen]
        out.append((ray_id // pixels, ray_id % pixels, ray_id))
    return out


def depths(c, n, near, far, step, ray_id, norm):
    grid = [near + (far - near) * k / (n - 1) for k in range(n)]
    stream = (1 + (((ray_id + 1) if c["per_ray"] else 0) << 4)) & U32
    t = []
    for k in range(n):
        low = grid[k] if k == 0 else 0.5 * (grid[k - 1] + grid[k])
        high = grid[k] if k == n - 1 else 0.5 * (grid[k] + grid[k + 1])
        t.append(low + (high - low) * uniform(c["seed"], stream, step, k))
    dl = [(t[k + 1] - t[k]) * norm for k in range(n - 1)] + [1e-10 * norm]
    return np.array(t), np.array(dl)


# -- model -----------------------------------------------------------------------------------------------------

def network_shapes(c, field, latent):
    w, encoded = c["mlp_width"], 3 + 6 * c["bands"]
    out = {}
    for i in range(c["layers"]):
        inputs = w
        if i == 0:
            inputs = encoded + latent
        elif i + 1 == c["skip"]:
            inputs = encoded + latent + w
        out[f"{field}.layer{i}.weight"] = (w, inputs)
        out[f"{field}.layer{i}.bias"] = (w,)
    return out | {f"{field}.out.weight": (1, w), f"{field}.out.bias": (1,)}


def shapes(c):
    d, r = c["grid"], c["ranks"]
    if c["two_networks"]:
        out = network_shapes(c, "static", 0)
    else:
        out = {f"static.plane.{p}": (r, d, d) for p in ("xy", "xz", "yz")}
        out |= {f"static.line.{p}": (r, d) for p in ("z", "y", "x")}
    return out | network_shapes(c, "dynamic", c["latent"]) | {"dynamic.latent": (c["phases"], c["latent"])}


def initial(c):
    torch.manual_seed(c["seed"])
    params = {}
    for name, shape in shapes(c).items():
        if name.startswith(("static.plane", "static.line")):
            value = 0.5 * torch.randn(shape)
        elif name == "dynamic.latent":
            value = torch.rand(shape)
        else:
            value = (2 * torch.rand(shape) - 1) / math.sqrt(shapes(c)[name.replace("bias", "weight")][-1])
        params[name] = value.float().double().requires_grad_()
    return params


def static_feature(c, p, x, half):
    """TensoRF vector-matrix lookup through torch's own grid_sample."""
    unit = x / half
    total = 0.0
    for plane, line, (u, v, w) in (("xy", "z", (0, 1, 2)), ("xz", "y", (0, 2, 1)), ("yz", "x", (1, 2, 0))):
        at = torch.stack([unit[:, u], unit[:, v]], -1).view(1, -1, 1, 2)
        planes = torch.nn.functional.grid_sample(p[f"static.plane.{plane}"][None], at, align_corners=True)
        at = torch.stack([torch.zeros_like(unit[:, w]), unit[:, w]], -1).view(1, -1, 1, 2)
        lines = torch.nn.functional.grid_sample(p[f"static.line.{line}"][None, :, :, None], at, align_corners=True)
        total = total + (planes * lines).sum(1).flatten()
    return total


def latent(c, p, time):
    """Latent at a time counted in phases: on the straight way from one phase to the next; the beat closes."""
    before = math.floor(time)
    share = time - before
    rows = p["dynamic.latent"]
    return (1 - share) * rows[before % c["phases"]] + share * rows[(before + 1) % c["phases"]]


def network(c, p, x, time, window, scene, field="dynamic"):
    x = (x - torch.tensor(scene["centre"])) * scene["scale"]
    parts = [x]
    for k in range(c["bands"]):
        a = min(max(window - k, 0.0), 1.0)
        parts += [a * torch.sin(2.0**k * x), a * torch.cos(2.0**k * x)]
    if field == "dynamic":
        parts.append(latent(c, p, time).expand(len(x), -1))
    inputs = torch.cat(parts, -1)
    h = inputs
    for i in range(c["layers"]):
        if i + 1 == c["skip"]:
            h = torch.cat([inputs, h], -1)
        h = torch.relu(torch.nn.functional.linear(h, p[f"{field}.layer{i}.weight"], p[f"{field}.layer{i}.bias"]))
    return torch.nn.functional.linear(h, p[f"{field}.out.weight"], p[f"{field}.out.bias"])[:, 0]


def ramp(c, name, step, delay):
    """A weight that goes from one value to another on a straight line after a delay, then stays."""
    start, end = c[name]
    return 0.0 if step < delay else start + (end - start) * min((step - delay) / c["ramp"], 1.0)


def losses_of_two_networks(c, frames, p, step):
    """NeRF-CA: both fields at the same points, everywhere between the first and the last depth."""
    depth, n, small = c["depth"], c["rays"], 1e-10
    opened = c["window_start"] + (c["bands"] - c["window_start"]) * step / c["window_iterations"]
    near_limit = -depth + 2 * depth * c["occlusion_share"]
    terms = dict.fromkeys(("data", "favour_static", "ray_entropy", "occlusion", "static_size"), 0.0)
    counted = 0
    for frame, pixel, ray_id in batch(c, frames, step):
        view, phase, image = frames[frame]
        anchor, direction = pixel_ray(c, view, pixel)
        t, dl = depths(c, c["dynamic_samples"], -depth, depth, step, ray_id, 1.0)
        x, dl = torch.tensor(anchor + t[:, None] * direction), torch.tensor(dl)
        field = lambda name: c["gain"] * torch.nn.functional.softplus(
            network(c, p, x, phase, min(opened, c["bands"]), c["scene"], name))
        still, moving = field("static"), field("dynamic")
        change = changes(frames, view).flatten()[pixel]
        residual = ((still + moving) * dl).sum() - image.flatten()[pixel]
        terms["data"] += (1 + c["change_weight"] * change) * residual**2 / n
        b = torch.clamp(moving / (still + moving + small), 1e-19, 1 - 1e-19)
        rest = torch.clamp(1 - b, min=1e-19)
        terms["favour_static"] += -(b * torch.log(b) + rest * torch.log(rest)).mean() / n
        mass = moving * dl
        if mass.sum() >= c["least_integral"] or change > c["least_change"]:
            share = mass / torch.clamp(mass.sum(), min=1e-19)
            terms["ray_entropy"] += -(share * torch.log(share + small)).sum() / n
            counted += 1
        terms["occlusion"] += (mass * torch.tensor((t < near_limit).astype(float))).sum() / n
        terms["static_size"] += (still * dl).sum() + ((still * dl) ** 2).sum()
    assert 0 < counted < n, f"the entropy of {counted} of {n} rays counts: the case is about both"
    for name, delay in (("favour_static", c["delay"]), ("ray_entropy", 0), ("static_size", 0)):
        terms[name] = ramp(c, name, step, delay) * terms[name]
    terms["occlusion"] = ramp(c, "near_integral", step, c["delay"]) * terms["occlusion"]
    return terms | dict(dynamic=terms["data"], tv=0.0, live=float(n * c["dynamic_samples"]))


def near_end_by_last_ray(c, frames, step):
    """Path length within which samples of all rays are near: a share of that of the batch's last ray."""
    frame, pixel, ray_id = batch(c, frames, step)[-1]
    norm = float(np.linalg.norm(pixel_ray(c, frames[frame][0], pixel)[1]))
    return c["occlusion_share"] * depths(c, c["dynamic_samples"], -c["depth"], c["depth"], step, ray_id, norm)[1].sum()


def losses(c, frames, p, step):
    if c["two_networks"]:
        return losses_of_two_networks(c, frames, p, step)
    scene, depth = c["scene"], c["depth"]
    active = step >= c["delay"]
    since = max(step - c["delay"], 0)
    window = min(c["window_start"] + (c["bands"] - c["window_start"]) * since / c["window_iterations"], c["bands"])
    near_limit = -depth + 2 * depth * c["occlusion_share"]
    near_end = near_end_by_last_ray(c, frames, step)
    n_motion = c["n_motion"]
    s_int, d_int, target, bounds, occlusion, live = [], [], [], [], 0.0, 0
    for r, (frame, pixel, ray_id) in enumerate(batch(c, frames, step)):
        view, phase, image = frames[frame]
        anchor, direction = pixel_ray(c, view, pixel)
        norm = float(np.linalg.norm(direction))
        target.append(image.flatten()[pixel])
        low, high = still_background(c, frames, view)
        bounds.append((target[-1] - high.flatten()[pixel], target[-1] - low.flatten()[pixel]))
        t, dl = depths(c, c["static_samples"], -depth, depth, step, ray_id, norm)
        x = anchor + t[:, None] * direction
        inside = (np.abs(x) <= scene["static_half"]).all(1)
        if inside.any() and not (0 < n_motion < c["rays"] and r < n_motion):
            f = static_feature(c, p, torch.tensor(x[inside]), scene["static_half"])
            sigma = scene["static_gain"] * torch.nn.functional.softplus(f + scene["static_shift"])
            s_int.append((sigma * torch.tensor(dl[inside])).sum())
        else:
            s_int.append(torch.zeros(()))
        t, dl = depths(c, c["dynamic_samples"], -depth, depth, step, ray_id, norm)
        x = anchor + t[:, None] * direction
        inside = (np.abs(x) <= scene["dynamic_half"]).all(1)
        if active and inside.any():
            n = int(inside.sum())
            live += n
            time = phase + c["after_phases"][frame % len(c["after_phases"])]
            f = network(c, p, torch.tensor(x[inside]), time, window, scene)
            mass = scene["dynamic_gain"] * torch.nn.functional.softplus(f + scene["dynamic_shift"])
            mass = mass * torch.tensor(dl[inside])
            near = np.cumsum(dl) < near_end if c["occlusion_region"] == "last-ray" else t < near_limit
            occlusion = occlusion + (mass * torch.tensor(near[inside].astype(float))).sum()
            d_int.append(mass.sum())
        else:
            d_int.append(torch.zeros(()))
    s_int, d_int, target = torch.stack(s_int), torch.stack(d_int), torch.tensor(target)
    if c["temporal"]:
        low, high = torch.tensor(bounds).unbind(1)
        outside = d_int - torch.minimum(torch.maximum(d_int.detach(), low), high)
        s2 = scene["robust_scale"] ** 2
        dynamic = scene["dynamic_weight"] * (2 * s2 * (torch.sqrt(1 + outside**2 / s2) - 1)).mean()
        rest = slice(n_motion if n_motion < c["rays"] else 0, None)
        data = scene["static_weight"] * ((s_int + d_int.detach() - target)[rest] ** 2).mean() + dynamic
    else:
        dynamic = scene["dynamic_weight"] * ((s_int + d_int - target) ** 2).mean()
        data = dynamic
    tv = 0.0
    for plane in ("xy", "xz", "yz"):
        g = p[f"static.plane.{plane}"]
        tv = tv + c["tv_plane"] * 2 * (((g[:, 1:] - g[:, :-1]) ** 2).mean() + ((g[:, :, 1:] - g[:, :, :-1]) ** 2).mean())
    for line in ("z", "y", "x"):
        g = p[f"static.line.{line}"]
        tv = tv + c["tv_line"] * 2 * ((g[:, 1:] - g[:, :-1]) ** 2).mean()
    return dict(data=data, dynamic=dynamic, tv=c["tv"] * tv, occlusion=c["occlusion"] * occlusion, live=float(live))


def rate(c, name, step):
    """Learning rate of an iteration. Both start again after the first iteration with a delayed dynamic field."""
    start, end = c[name]
    length, restart = c["iterations"] * c["decay_share"], 0 if c["two_networks"] else c["delay"] + 1
    if step >= restart:
        x = min((step - restart) / (length - restart if c["decay"] == "linear" else length), 1.0)
    else:
        x = 0.0 if name == "dynamic_lr" else step / length
    return start + (end - start) * x if c["decay"] == "linear" else start * (end / start) ** x


def optimiser(c, p):
    groups = [
        dict(params=[v for k, v in p.items() if k.startswith("static")], name="static_lr"),
        dict(params=[v for k, v in p.items() if k.startswith("dynamic")], name="dynamic_lr"),
    ]
    return torch.optim.Adam(groups, lr=0.0, betas=c["betas"], eps=c["eps"])


# Terms that are minimised.
OBJECTIVE = ("data", "tv", "occlusion", "favour_static", "ray_entropy", "static_size")


def run(c):
    frames = dataset(c)
    p = initial(c)
    out = {f"initial/{k}": v.detach().clone() for k, v in p.items()}
    out |= {f"image/{i}": torch.tensor(f[2]) for i, f in enumerate(frames)}
    for view in range(len(ANGLES)):
        low, high = still_background(c, frames, view)
        out |= {f"background/{view}/low": torch.tensor(low), f"background/{view}/high": torch.tensor(high)}
    adam = optimiser(c, p)
    for step in range(10):
        terms = losses(c, frames, p, step)
        adam.zero_grad()
        sum(terms[name] for name in OBJECTIVE if name in terms).backward()
        for name, value in terms.items():
            out[f"loss{step}/{name}"] = torch.as_tensor(value).detach().reshape(1).clone()
        if step in (0, c["delay"], c["delay"] + 3):
            out |= {f"gradient{step}/{k}": torch.zeros_like(v) if v.grad is None else v.grad.clone() for k, v in p.items()}
            out |= {f"params{step}/{k}": v.detach().clone() for k, v in p.items()}
        for group in adam.param_groups:
            group["lr"] = rate(c, group["name"], step)
        if step < c["delay"] and not c["two_networks"]:
            for k, v in p.items():
                if k.startswith("dynamic"):
                    v.grad = None
        adam.step()
        if step == c["delay"] and not c["two_networks"]:
            # After the dynamic field's first step, as the authors do it.
            adam = optimiser(c, p)
    return out | {f"final/{k}": v.detach().clone() for k, v in p.items()}


def write_safetensors(path, tensors, metadata):
    header, data = {"__metadata__": metadata}, b""
    for name, value in sorted(tensors.items()):
        raw = value.contiguous().numpy().astype("<f8").tobytes()
        header[name] = dict(dtype="F64", shape=list(value.shape), data_offsets=[len(data), len(data) + len(raw)])
        data += raw
    text = json.dumps(header, sort_keys=True).encode()
    text += b" " * (-len(text) % 8)
    path.write_bytes(struct.pack("<Q", len(text)) + text + data)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=pathlib.Path, default=pathlib.Path(__file__).parent.parent / "tests" / "golden")
    parser.add_argument("--preset", action="append", choices=PRESETS, help="use only this preset; may be repeated")
    args = parser.parse_args()
    out = args.out
    out.mkdir(parents=True, exist_ok=True)
    for name in args.preset or PRESETS:
        c = constants(name)
        case = c | dict(preset=name, angles=ANGLES, arm=ARM)
        write_safetensors(out / f"{name}.safetensors", run(c), dict(case=json.dumps(case), torch=torch.__version__))
        print(out / f"{name}.safetensors")


if __name__ == "__main__":
    main()
