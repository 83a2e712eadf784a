#!/usr/bin/env python3
"""Times the same work in PyTorch: the paper's fields, batch and sampling, forward, backward and Adam.

The counterpart of `nertca-vk bench`, to be run beside it on one machine:

    python3 tools/bench-pytorch.py --preset paper --device cuda                 # eager
    python3 tools/bench-pytorch.py --preset paper --device cuda --compile       # torch.compile
    python3 tools/bench-pytorch.py --preset paper --device cuda --compile --amp --graph   # its best
    python3 tools/bench-pytorch.py --preset paper --rays 256 --device cpu --threads 2

An iteration never waits for the host; Adam is fused where the device is a GPU. Iterations are timed several at a time,
between two waits, after seconds of warming up. Data are random: time does not depend on them. Only torch is needed.
Rays and samples are those of a batch in which every dynamic sample is live, as with the authors' code; `--live` keeps a
share of them, as a hull does.
"""

import argparse
import json
import statistics
import time

import torch

PRESETS = {
    "paper": dict(rays=2048, static=256, dynamic=256, width=128, layers=4, skip=0, bands=10),
    "public-code": dict(rays=2048, static=256, dynamic=256, width=128, layers=5, skip=4, bands=10),
    "fast-mlp": dict(rays=1024, static=32, dynamic=128, width=96, layers=4, skip=0, bands=8),
}
GRID, RANKS, PHASES, LATENT = 48, 3, 10, 8
# Factor on the loss while gradients are f16: as many bits as nertca-vk begins with.
LOSS_SCALE = 65_536.0


class StaticField(torch.nn.Module):
    """Three plane x line modes, as TensoRF looks them up."""

    def __init__(self):
        super().__init__()
        self.planes = torch.nn.Parameter(0.1 * torch.randn(3, RANKS, GRID, GRID))
        self.lines = torch.nn.Parameter(0.1 * torch.randn(3, RANKS, GRID, 1))

    def forward(self, x):
        sample = torch.nn.functional.grid_sample
        plane = torch.stack((x[..., [0, 1]], x[..., [0, 2]], x[..., [1, 2]])).view(3, -1, 1, 2)
        line = torch.stack((x[..., 2], x[..., 1], x[..., 0])).view(3, -1, 1)
        line = torch.stack((torch.zeros_like(line), line), -1)
        on_planes = sample(self.planes, plane, align_corners=True).view(3 * RANKS, -1)
        on_lines = sample(self.lines, line, align_corners=True).view(3 * RANKS, -1)
        feature = (on_planes * on_lines).sum(0).view(x.shape[:-1])
        inside = (x.abs() <= 1).all(-1)
        return torch.nn.functional.softplus(feature - 10) * inside

    def total_variation(self):
        p, l = self.planes, self.lines
        return 1e-2 * ((p[:, :, 1:] - p[:, :, :-1]).square().mean() + (p[..., 1:] - p[..., :-1]).square().mean()) \
            + 1e-3 * (l[:, :, 1:] - l[:, :, :-1]).square().mean()


class DynamicField(torch.nn.Module):
    """Multi-layer perceptron on a windowed encoding and a latent per phase."""

    def __init__(self, width, layers, skip, bands):
        super().__init__()
        inputs = 3 + 6 * bands + LATENT
        sizes = [inputs if i == 0 else width + (inputs if skip and i == skip - 1 else 0) for i in range(layers)]
        self.hidden = torch.nn.ModuleList(torch.nn.Linear(n, width) for n in sizes)
        self.out = torch.nn.Linear(width, 1)
        self.latents = torch.nn.Parameter(torch.rand(PHASES, LATENT))
        self.skip, self.bands = skip, bands

    def forward(self, x, phase, window):
        frequency = 2.0 ** torch.arange(self.bands, device=x.device)
        weight = (window - torch.arange(self.bands, device=x.device)).clamp(0, 1)
        angle = x[:, None, :] * frequency[:, None]
        waves = torch.stack((angle.sin(), angle.cos()), 2) * weight[:, None, None]
        inputs = torch.cat((x, waves.flatten(1), self.latents[phase]), -1)
        h = inputs
        for i, layer in enumerate(self.hidden):
            h = torch.relu(layer(torch.cat((inputs, h), -1) if self.skip and i == self.skip - 1 else h))
        return torch.nn.functional.softplus(self.out(h)[:, 0].float() - 10)


def captured(iteration):
    """The iteration as a CUDA graph, after some on a stream of their own, as capturing asks for."""
    side = torch.cuda.Stream()
    side.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(side):
        for _ in range(3):
            iteration()
    torch.cuda.current_stream().wait_stream(side)
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        iteration()
    return graph.replay


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--preset", choices=PRESETS, default="paper")
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--rays", type=int, help="rays per batch, instead of the number of the preset")
    parser.add_argument("--live", type=float, default=1.0, help="share of the dynamic samples that is evaluated")
    parser.add_argument("--compile", action="store_true", help="torch.compile the iteration's forward pass")
    parser.add_argument("--tf32", action="store_true", help="allow TF32 matrix products (CUDA)")
    parser.add_argument("--amp", action="store_true", help="f16 products and a constant loss scale (CUDA), or bf16 (CPU)")
    parser.add_argument("--graph", action="store_true", help="execute each iteration as one CUDA graph")
    parser.add_argument("--threads", type=int, help="CPU threads")
    parser.add_argument("--warm-up", type=float, default=5.0, help="seconds of iterations before the first timed one")
    parser.add_argument("--sample", type=float, default=10.0, help="total seconds of all timed repeats")
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args()
    if args.threads:
        torch.set_num_threads(args.threads)
    torch.backends.cuda.matmul.allow_tf32 = args.tf32
    torch.manual_seed(1)
    shape = dict(PRESETS[args.preset], **({"rays": args.rays} if args.rays else {}))
    device, rays = torch.device(args.device), shape["rays"]
    on_gpu = device.type == "cuda"
    if args.graph and not on_gpu:
        parser.error("--graph needs a CUDA device")
    loss_scale = LOSS_SCALE if args.amp and on_gpu else 1.0
    static = StaticField().to(device)
    dynamic = DynamicField(shape["width"], shape["layers"], shape["skip"], shape["bands"]).to(device)
    parameters = [*static.parameters(), *dynamic.parameters()]
    optimiser = torch.optim.Adam(parameters, lr=1e-4, betas=(0.9, 0.99), fused=on_gpu, capturable=args.graph)
    anchor = 0.3 * torch.randn(rays, 1, 3, device=device)
    direction = torch.nn.functional.normalize(torch.randn(rays, 1, 3, device=device), dim=-1)
    target, phase = torch.rand(rays, device=device), torch.randint(PHASES, (rays,), device=device)
    live = torch.rand(rays, shape["dynamic"], device=device) < args.live
    # Which samples these are is looked up once: finding out makes the device wait for the host.
    live_at = live.flatten().nonzero()[:, 0]
    live_rays = live_at // shape["dynamic"]
    live_phases, n_live = phase[live_rays], len(live_at)

    def points(n):
        """Stratified depths of every ray."""
        depth = (torch.arange(n, device=device) + torch.rand(rays, n, device=device)) / n * 1.8 - 0.9
        depth, _ = depth.sort(-1)
        length = torch.cat((depth[:, 1:] - depth[:, :-1], torch.full((rays, 1), 1e-10, device=device)), -1)
        return anchor + depth[..., None] * direction, length

    def forward(x_static, dl_static, x_dynamic, dl_dynamic, rays_of, phases, window):
        still = (static(x_static) * dl_static).sum(-1)
        sigma = dynamic(x_dynamic, phases, window)
        moving = torch.zeros(rays, device=device).index_add(0, rays_of, sigma * dl_dynamic)
        return (still + moving - target).square().mean() + static.total_variation()

    if args.compile:
        forward = torch.compile(forward)

    def iteration():
        x_static, dl_static = points(shape["static"])
        x_dynamic, dl_dynamic = points(shape["dynamic"])
        x_live, dl_live = x_dynamic.flatten(0, 1)[live_at], dl_dynamic.flatten()[live_at]
        with torch.autocast(device.type, torch.float16 if on_gpu else torch.bfloat16, enabled=args.amp):
            loss = forward(x_static, dl_static, x_live, dl_live, live_rays, live_phases, 5.0)
        (loss_scale * loss).backward()
        if loss_scale != 1.0:
            torch._foreach_mul_([p.grad for p in parameters], 1.0 / loss_scale)
        optimiser.step()
        optimiser.zero_grad(set_to_none=not args.graph)

    def synchronise():
        if on_gpu:
            torch.cuda.synchronize()

    if args.graph:
        iteration = captured(iteration)

    def run(n):
        """Milliseconds of an iteration, of n that follow each other."""
        synchronise()
        begin = time.perf_counter()
        for _ in range(n):
            iteration()
        synchronise()
        return 1e3 * (time.perf_counter() - begin) / n

    begin, last = time.perf_counter(), run(1)
    while time.perf_counter() - begin < args.warm_up:
        last = run(max(1, int(100 / last)))
    iterations = max(1, int(1e3 * args.sample / args.repeats / last))
    ms = [run(iterations) for _ in range(args.repeats)]
    inputs, width = 3 + 6 * shape["bands"], shape["width"]
    hidden = (shape["layers"] - 1) * width * width
    encoded = inputs * width * (2 if shape["skip"] else 1)
    # Latents and biases left out, as nertca-vk counts.
    gflop = 2e-9 * n_live * (2 * (encoded + hidden + width) + hidden + width)
    median = statistics.median(ms)
    result = dict(
        torch=torch.__version__, device=torch.cuda.get_device_name() if device.type == "cuda" else "cpu",
        threads=torch.get_num_threads(), compiled=args.compile, tf32=args.tf32, amp=args.amp, graph=args.graph,
        preset=args.preset, rays=rays, live_samples=n_live, iterations=iterations, ms=ms, median_ms=median,
        network_tflops=gflop / median, cost_gflop=gflop,
    )
    if args.json:
        print(json.dumps(result))
    else:
        chosen = [("compiled", args.compile), ("TF32", args.tf32), ("AMP", args.amp), ("CUDA graph", args.graph)]
        way = ", ".join(name for name, on in chosen if on) or "eager"
        print(f"PyTorch {torch.__version__} on {result['device']} ({result['threads']} threads), {way}, {args.preset}")
        print(f"{median:.2f} ms per iteration (median of {len(ms)} repeats of {iterations}; {min(ms):.2f} to {max(ms):.2f}), "
              f"{rays} rays, {n_live} live samples")
        print(f"{gflop / median:.4f} TFLOP/s in whole iterations; 30,000 iterations take {30 * median / 60:.1f} minutes")


if __name__ == "__main__":
    main()
