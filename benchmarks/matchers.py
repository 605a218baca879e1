"""What do half precision, channels last and compilation bring the matchers? And do they still compute the same?

python benchmarks/matchers.py                                     small sizes on the CPU, a few minutes
python benchmarks/matchers.py --device cuda --json matchers.json  the paper's: batch 8, 384x512, 22 iterations in training, 32 in inference
python benchmarks/matchers.py --models raft --ways bf16           parts of the table

Every way starts from the same weights and sees the same pairs, in one process; float32 is eager, with TF32 off, and what the others are
measured by; the column "x tf32" measures them by eager TF32. To compile takes minutes on the CPU, and is done there only for --ways that
say so.
A training step is forward, ZeroStereo loss, backward, clipping and AdamW. Medians after a warm-up, on the CPU of the process's own
time, which others on the machine do not change. The peak is that of tensors on a GPU, and of the whole process on the CPU. The last column
is how far the last prediction is from float32's, averaged over the pixels, as a share of the largest disparity; where that is more
than the way may round (DEVIATIONS) the program fails.
"""

from __future__ import annotations

import argparse
import gc
import json
import platform
import statistics
import sys
import time
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from trainers.models import Matcher, load_matcher
from trainers.training_loss import TrainingLoss
from zsdata import Masks, StereoBatch
from zsdata.progress import Progress

MODELS = {"raft": "raft_stereo", "igev": "igev_stereo"}
GIB = 2**30


@dataclass(frozen=True, kw_only=True)
class Way:
    """How a matcher is run."""

    half: torch.dtype | None = None
    tf32: bool = False
    channels_last: bool = False
    compiled: bool = False


WAYS = {
    "float32": Way(),
    "tf32": Way(tf32=True),
    "float32+channels_last": Way(channels_last=True),
    "float32+compile": Way(compiled=True),
    "bf16": Way(half=torch.bfloat16),
    "bf16+channels_last": Way(half=torch.bfloat16, channels_last=True),
    "bf16+compile": Way(half=torch.bfloat16, compiled=True),
    "bf16+compile+channels_last": Way(half=torch.bfloat16, compiled=True, channels_last=True),
    "tf32+compile": Way(tf32=True, compiled=True),
}
DEVIATIONS = {"float32": 1e-4, "tf32": 1e-2, "bf16": 5e-2}  # allowed, by the first word of the way


@dataclass(frozen=True, kw_only=True)
class Sizes:
    batch: int
    height: int
    width: int
    iterations: int
    inference_iterations: int
    repeats: int
    warm_up: int


DEFAULTS = {
    "cpu": Sizes(batch=1, height=64, width=128, iterations=3, inference_iterations=6, repeats=5, warm_up=1),
    "cuda": Sizes(batch=8, height=384, width=512, iterations=22, inference_iterations=32, repeats=15, warm_up=4),
}


def make_batch(sizes: Sizes, device: torch.device) -> StereoBatch:
    """Noise at several scales, seen 8 px apart, with half-trusted labels."""
    generator = torch.Generator().manual_seed(0)
    shape = (sizes.batch, 1, sizes.height, sizes.width)
    wide = torch.zeros(sizes.batch, 3, sizes.height, sizes.width + 8)
    for cells in (4, 16, 64):
        coarse = torch.rand(sizes.batch, 3, cells, cells, generator=generator)
        wide += nn.functional.interpolate(coarse, wide.shape[2:], mode="bicubic").clamp(0, 1) * (255 / 3)
    left, right = wide[..., :-8].to(device), wide[..., 8:].to(device)
    yes = torch.ones(shape, dtype=torch.bool, device=device)
    masks = Masks(nonocclusion=yes, inpaint=~yes, valid=yes)
    half, label = torch.full(shape, 0.5, device=device), torch.full(shape, 8.0, device=device)
    return StereoBatch(left, right, label, half, masks, left, right, [{}] * sizes.batch)


def median_seconds(work: Callable[[], object], sizes: Sizes, device: torch.device) -> tuple[float, float]:
    """Median time, and the peak of memory in use in GiB."""
    clock = time.perf_counter if device.type == "cuda" else time.process_time
    seconds = []
    for i in range(sizes.warm_up + sizes.repeats):
        if i == sizes.warm_up:
            reset_peak(device)
        wait(device)
        start = clock()
        work()
        wait(device)
        seconds.append(clock() - start)
    return statistics.median(seconds[sizes.warm_up :]), peak_bytes(device) / GIB


def wait(device: torch.device) -> None:
    if device.type == "cuda":
        torch.cuda.synchronize(device)


def reset_peak(device: torch.device) -> None:
    if device.type == "cuda":
        torch.cuda.reset_peak_memory_stats(device)
    else:
        Path("/proc/self/clear_refs").write_text("5")  # resets the high-water mark of resident memory


def peak_bytes(device: torch.device) -> int:
    """Of tensors on a GPU; of the whole process on the CPU."""
    if device.type == "cuda":
        return torch.cuda.max_memory_allocated(device)
    (line,) = [line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith("VmHWM")]
    return int(line.split()[1]) * 1024


def prepare(name: str, way: Way, weights: dict[str, Tensor], device: torch.device) -> Matcher:
    torch.backends.cuda.matmul.allow_tf32 = torch.backends.cudnn.allow_tf32 = way.tf32
    torch.compiler.reset()
    matcher = load_matcher(MODELS[name]).to(device)
    matcher.load_state_dict(weights)
    matcher.freeze_bn()
    if way.channels_last:
        matcher.use_channels_last()
    if way.compiled:
        matcher.compile_parts()
    return matcher


def measure(name: str, way: Way, weights: dict[str, Tensor], sizes: Sizes, device: torch.device) -> tuple[dict[str, float], Tensor]:
    """Seconds and peaks of inference and of a training step, and the last prediction of the untrained weights."""
    batch = make_batch(sizes, device)
    matcher = prepare(name, way, weights, device)
    autocast = torch.autocast(device.type, way.half) if way.half is not None else nullcontext()
    first = time.perf_counter()

    @torch.no_grad()
    def infer() -> Tensor:
        with autocast:
            return matcher(batch.left, batch.right, iterations=sizes.inference_iterations, every_iteration=False)[1][-1]

    matcher.eval()
    prediction = infer()
    inference_seconds, inference_peak = median_seconds(infer, sizes, device)

    matcher.train()
    optimizer = torch.optim.AdamW(matcher.parameters(), lr=1e-6)
    loss_function = TrainingLoss()

    def step() -> None:
        with autocast:
            initial, sequence = matcher(batch.left, batch.right, iterations=sizes.iterations)
        loss, _ = loss_function(initial, sequence, batch)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(matcher.parameters(), 1.0)
        optimizer.step()
        optimizer.zero_grad()

    step_seconds, step_peak = median_seconds(step, sizes, device)
    total = time.perf_counter() - first
    used = {"step_seconds": step_seconds, "step_peak_gib": step_peak, "inference_seconds": inference_seconds}
    return used | {"inference_peak_gib": inference_peak, "total_seconds": total}, prediction.float().cpu()


def measure_loss(sizes: Sizes, device: torch.device) -> float:
    """Seconds of the ZeroStereo loss alone, forward and backward, for as many predictions as a step has."""
    batch = make_batch(sizes, device)
    predictions = [(batch.disparity + i / 10).requires_grad_() for i in range(sizes.iterations)]
    loss_function = TrainingLoss()
    return median_seconds(lambda: loss_function(None, predictions, batch)[0].backward(), sizes, device)[0]


def machine(device: torch.device) -> dict[str, Any]:
    cpu = platform.processor() or platform.machine()
    try:
        cpu = next(line.split(":")[1].strip() for line in Path("/proc/cpuinfo").read_text().splitlines() if line.startswith("model name"))
    except (OSError, StopIteration):
        pass
    versions = {"python": platform.python_version(), "torch": torch.__version__, "cuda": torch.version.cuda}
    if device.type == "cuda":
        versions |= {"cudnn": torch.backends.cudnn.version()}
    return {
        "device": torch.cuda.get_device_name(device) if device.type == "cuda" else cpu,
        "threads": torch.get_num_threads(),
        "versions": versions,
    }


def _ratio(value: float | None) -> str:
    return "-" if value is None else f"{value:.2f}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cpu", help='"cpu" or "cuda"; sets the defaults of what follows (default: cpu)')
    parser.add_argument("--models", nargs="+", choices=list(MODELS), default=list(MODELS))
    parser.add_argument(
        "--ways", nargs="+", choices=list(WAYS), help="besides float32 (default: all, on the CPU none with tf32 or compile)"
    )
    for name in Sizes.__dataclass_fields__:
        default = ", ".join(f"{device}: {getattr(sizes, name)}" for device, sizes in DEFAULTS.items())
        parser.add_argument(f"--{name.replace('_', '-')}", type=int, metavar="N", help=f"default: {default}")
    parser.add_argument("--threads", type=int, default=1, help="on the CPU (default: 1)")
    parser.add_argument("--json", type=Path, metavar="OUT", help="write the figures here, too, as they come")
    arguments = parser.parse_args()
    device = torch.device(arguments.device)
    if device.type == "cuda" and not torch.cuda.is_available():
        parser.error("torch finds no GPU")
    torch.set_num_threads(arguments.threads)
    defaults = DEFAULTS[device.type]
    given = {name: getattr(arguments, name) for name in Sizes.__dataclass_fields__}
    sizes = Sizes(**{name: getattr(defaults, name) if value is None else value for name, value in given.items()})
    usual = [name for name, way in WAYS.items() if device.type == "cuda" or not (way.tf32 or way.compiled)]
    ways = ["float32", *sorted(set(arguments.ways or usual) - {"float32"}, key=list(WAYS).index)]  # TF32 second

    report: dict[str, Any] = {"machine": machine(device), "sizes": vars(sizes), "rows": []}
    print(json.dumps(report["machine"]))
    print(
        f"batch {sizes.batch} at {sizes.height}x{sizes.width}, {sizes.iterations} iterations in training, "
        f"{sizes.inference_iterations} in inference; medians of {sizes.repeats}"
    )
    report["loss_ms"] = 1e3 * measure_loss(sizes, device)
    print(f"the loss alone, forward and backward: {report['loss_ms']:.1f} ms")
    print(f"{'':33}{'training step':>39}{'inference':>39}{'in all':>9}{'off by':>10}")
    print(f"{'':33}" + f"{'ms':>12}{'x float32':>11}{'x tf32':>8}{'GiB':>8}" * 2 + f"{'s':>9}{'share':>10}")
    wrong = []
    for model in arguments.models:
        torch.manual_seed(0)
        weights = load_matcher(MODELS[model]).state_dict()
        plain: dict[str, dict[str, float]] = {}  # what the others are measured by
        expected = torch.zeros(())
        for name in Progress(ways, desc=model, leave=False, disable=not sys.stderr.isatty()):
            gc.collect()
            if device.type == "cuda":
                torch.cuda.empty_cache()
            try:
                used, prediction = measure(model, WAYS[name], weights, sizes, device)
            except torch.OutOfMemoryError:
                print(f"{model + ' ' + name:33}out of memory")
                continue
            if name in ("float32", "tf32"):
                plain[name] = used
            if name == "float32":
                expected = prediction
            row: dict[str, Any] = {"model": model, "way": name, **used}
            for other, seconds in plain.items():
                row |= {f"{part}_x_{other}": seconds[f"{part}_seconds"] / used[f"{part}_seconds"] for part in ("step", "inference")}
            if "float32" in plain:
                row["deviation"] = ((prediction - expected).abs().mean() / expected.abs().max()).item()
                if not row["deviation"] <= DEVIATIONS[name.split("+")[0]]:
                    wrong.append(f"{model} {name} is off by {row['deviation']:.2g} of the largest prediction")
            cells = [
                f"{1e3 * row[f'{part}_seconds']:12.1f}{_ratio(row.get(f'{part}_x_float32')):>11}{_ratio(row.get(f'{part}_x_tf32')):>8}"
                f"{row[f'{part}_peak_gib']:8.2f}"
                for part in ("step", "inference")
            ]
            rest = f"{row['total_seconds']:9.0f}{row.get('deviation', float('nan')):10.1e}"
            print(f"{model + ' ' + name:33}" + "".join(cells) + rest, flush=True)
            report["rows"].append(row)
            if arguments.json is not None:
                arguments.json.parent.mkdir(parents=True, exist_ok=True)
                arguments.json.write_text(json.dumps(report, indent=2) + "\n")
    if wrong:
        sys.exit("not the same matcher any more: " + "; ".join(wrong))


if __name__ == "__main__":
    main()
