"""What each tier of quality costs on the training device: inpainting by steps and autoencoder, depth by network size.

    python benchmarks/tiers.py                             # full-size networks on the GPU, a few minutes
    python benchmarks/tiers.py --device cpu --dtype bf16   # the same networks on the CPU, half an hour on two cores
    python benchmarks/tiers.py --smoke                     # small networks on the CPU: does it run at all

Networks are built from the published configurations with random weights, which take the same time as trained ones: Stable Diffusion 2
Inpainting's U-Net and autoencoder, the tiny autoencoder (TAESD), Depth Anything V2 Small, Base and Large. They are saved and loaded as the
real ones are. Images, masks and noise lie on the device; "pairs/s" is the inpainter alone, without a matcher beside it.

"TFLOP" is the arithmetic of a pair's matrix products and convolutions, the same on every device; "TFLOP/s" is how fast they went, and "of
matmul" the share of what one large matrix product reaches on the device in the same run: where it is high, arithmetic is what bounds the
tier, and only fewer steps, a smaller autoencoder or a faster device help.
"""

from __future__ import annotations

import argparse
import gc
import json
import platform
import statistics
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Any

import diffusers
import numpy as np
import torch
import transformers
from torch import Tensor
from torch.utils.flop_counter import FlopCounterMode

from zsdata import load_depth, load_inpainter
from zsdata.seeding import rng
from zsdata.synthesis.inpaint import fill
from zsdata.synthesis.inpaint.diffusion import DiffusionInpainter
from zsdata.synthesis.micro_batch import GIB
from zsdata.synthesis.precision import choose_dtype
from zsdata.synthesis.synthesizer import INPAINT_CONTEXT_PX

TIERS = (1, 4, 8, 50)  # denoising steps
TARGETS = {(50, "full"): 8.0, (4, "tiny"): 60.0}  # pairs/s on one H100 in bf16
DEPTH_TARGETS = {"Small": 150.0}  # photos/s with their mirror images
MEMORY_TARGET_GIB = 8.0  # micro-batch 8 with the full autoencoder
PHOTO = (768, 1024)  # Depth Anything sees it at 518x686
HOLE_SHARE = 0.1
STAGES = {"encode": "_encode", "denoise": "_denoise", "decode": "_decode"}  # of an inpainter, and the methods that do them

STABLE_DIFFUSION_2: dict[str, Any] = {
    "sample_size": 64,
    "in_channels": 9,
    "out_channels": 4,
    "block_out_channels": [320, 640, 1280, 1280],
    "layers_per_block": 2,
    "attention_head_dim": [5, 10, 20, 20],
    "cross_attention_dim": 1024,
    "use_linear_projection": True,
}
SMALL_UNET: dict[str, Any] = {
    "in_channels": 9,
    "out_channels": 4,
    "block_out_channels": [8, 16, 16, 16],
    "layers_per_block": 1,
    "norm_num_groups": 4,
    "attention_head_dim": 4,
    "cross_attention_dim": 16,
    "use_linear_projection": True,
}
AUTOENCODER: dict[str, Any] = {
    "down_block_types": ["DownEncoderBlock2D"] * 4,
    "up_block_types": ["UpDecoderBlock2D"] * 4,
    "block_out_channels": [128, 256, 512, 512],
    "layers_per_block": 2,
    "sample_size": 512,
}
SMALL_AUTOENCODER = {**AUTOENCODER, "block_out_channels": [4, 4, 8, 8], "layers_per_block": 1, "norm_num_groups": 2}
SCHEDULE = {"beta_start": 0.00085, "beta_end": 0.012, "beta_schedule": "scaled_linear", "steps_offset": 1, "clip_sample": False}
# hidden size, layers, heads, neck, fusion; the layers whose features are used
DEPTH_ANYTHING_V2: dict[str, tuple[int, int, int, list[int], int, list[int]]] = {
    "Small": (384, 12, 6, [48, 96, 192, 384], 64, [3, 6, 9, 12]),
    "Base": (768, 12, 12, [96, 192, 384, 768], 128, [3, 6, 9, 12]),
    "Large": (1024, 24, 16, [256, 512, 1024, 1024], 256, [5, 12, 18, 24]),
}
SMALL_DEPTH_ANYTHING = {"Tiny": (32, 4, 2, [8, 16, 24, 32], 16, [1, 2, 3, 4])}


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", choices=("cuda", "cpu"), help="default: cuda, with --smoke cpu")
    parser.add_argument("--smoke", action="store_true", help="small networks: does it run at all")
    parser.add_argument(
        "--size", type=int, nargs=2, default=(384, 512), metavar=("HEIGHT", "WIDTH"), help="of the pairs (default: 384 512)"
    )
    parser.add_argument("--micro-batch", type=int, help="pairs at once (default: 8, on the CPU 1, as in the stream)")
    parser.add_argument("--repeats", type=int, help="the median of so many runs counts (default: 5, on the CPU 3)")
    parser.add_argument("--dtype", help="float32, bf16 or fp16 (default: as the device has it)")
    parser.add_argument("--compile", nargs="?", const="default", help="torch.compile, optionally its mode, such as reduce-overhead")
    parser.add_argument("--tiers", type=int, nargs="+", default=TIERS, metavar="STEPS", help="default: 1 4 8 50")
    parser.add_argument("--json", type=Path, metavar="FILE", help="also writes the figures there")
    options = parser.parse_args(arguments)
    options.device = options.device or ("cpu" if options.smoke else "cuda")
    if options.smoke:
        options.size, options.micro_batch, options.repeats, options.tiers = (64, 96), 2, 1, [1, 4]
    if options.device == "cuda" and not torch.cuda.is_available():
        parser.error("torch finds no GPU; --device cpu runs the full-size networks on the CPU (half an hour), --smoke small ones")
    device = torch.device(options.device)
    options.micro_batch = options.micro_batch or (1 if device.type == "cpu" else 8)
    options.repeats = options.repeats or (3 if device.type == "cpu" else 5)
    quiet()
    cpu = f"{platform.processor() or platform.machine()}, {torch.get_num_threads()} threads"
    name = cpu if device.type == "cpu" else torch.cuda.get_device_name(device)
    dtype = choose_dtype(options.dtype, device)
    options.dtype = str(dtype).removeprefix("torch.")  # depth has no other format on a GPU by itself
    matmul = matmul_tflops(device, dtype, options)
    print(
        f"{name}, torch {torch.__version__}, Python {platform.python_version()}, {options.size[0]}x{options.size[1]}, {dtype}; "
        f"a matrix product runs at {matmul:.3g} TFLOP/s"
    )
    with tempfile.TemporaryDirectory() as folder:
        inpainting = measure_inpainting(Path(folder), device, matmul, options)
        depth = measure_depth(Path(folder), device, matmul, options)
    if options.json:
        options.json.write_text(
            json.dumps(
                {
                    "device": name,
                    "torch": torch.__version__,
                    "dtype": str(dtype),
                    "matmul_tflops": matmul,
                    "inpainting": inpainting,
                    "depth": depth,
                },
                indent=2,
            )
        )


def quiet() -> None:
    for library in (diffusers, transformers):
        library.logging.set_verbosity_error()  # what they say of made-up configurations
        library.logging.disable_progress_bar()


def matmul_tflops(device: torch.device, dtype: torch.dtype, options: argparse.Namespace) -> float:
    """TFLOP/s of a matrix product that is large enough to keep the device busy."""
    side = 256 if options.smoke else 8192 if device.type == "cuda" else 2048
    one = torch.randn(side, side, dtype=dtype, device=device)
    seconds, _ = timed(lambda: one @ one, device, 5)
    return 2 * side**3 / seconds / 1e12


def measure_inpainting(folder: Path, device: torch.device, matmul: float, options: argparse.Namespace) -> list[dict[str, Any]]:
    height, width = options.size
    right, inpaint_mask = images_with_holes(options.micro_batch, height, width + INPAINT_CONTEXT_PX, device)
    rows = [measure_builtin(right, inpaint_mask, options)]
    save_pipeline(folder / "pipeline", device, options.smoke)  # gigabytes, which the system is busy with for a while
    stages = [f"{stage} ms" for stage in STAGES]
    print_row(("tier", "autoencoder", "pairs/s", "target", *stages, "TFLOP", "TFLOP/s", "of matmul", "peak GiB", "micro-batch"))
    print_row(("built-in", "", f"{rows[0]['pairs_per_second']:.1f}", *[""] * 7, gib(rows[0]["peak_bytes"]), options.micro_batch))
    for autoencoder in ("full", "tiny"):
        tiny = str(folder / "pipeline" / "tiny") if autoencoder == "tiny" else None
        for steps in options.tiers:
            row = measure_tier(folder / "pipeline", tiny, steps, right, inpaint_mask, options)
            rows.append({"steps": steps, "autoencoder": autoencoder, **row})
            target = TARGETS.get((steps, autoencoder)) if device.type == "cuda" else None
            speed = row["tflop"] * row["pairs_per_second"]
            print_row(
                (
                    f"{steps} steps",
                    autoencoder,
                    f"{row['pairs_per_second']:.3g}",
                    "" if target is None else f"{target:g}",
                    *(f"{row[f'{stage}_ms']:.3g}" for stage in STAGES),
                    f"{row['tflop']:.3g}",
                    f"{speed:.3g}",
                    f"{speed / matmul:.2f}",
                    gib(row["peak_bytes"]),
                    row["micro_batch"],
                )
            )
    full = next(row for row in rows if row.get("autoencoder") == "full")
    if full["peak_bytes"] is not None:
        print(f"peak memory with the full autoencoder {gib(full['peak_bytes'])} GiB (target {MEMORY_TARGET_GIB:g} at micro-batch 8)")
    return rows


def measure_builtin(right: Tensor, inpaint_mask: Tensor, options: argparse.Namespace) -> dict[str, Any]:
    inpainter = load_inpainter("builtin")
    context = {"right_disparity": torch.linspace(5, 60, right.shape[-2], device=right.device).view(1, 1, -1, 1).expand_as(inpaint_mask)}
    generators = [rng(0, 0, index, "inpaint") for index in range(len(right))]
    seconds, peak = timed(lambda: fill(inpainter, right, inpaint_mask, generators, context, None), right.device, options.repeats)
    return {"steps": 0, "pairs_per_second": len(right) / seconds, "peak_bytes": peak}


def measure_tier(
    pipeline: Path, autoencoder: str | None, steps: int, right: Tensor, inpaint_mask: Tensor, options: argparse.Namespace
) -> dict[str, Any]:
    inpainter = load_inpainter(
        pipeline,
        right.device,
        steps=steps,
        autoencoder=autoencoder,
        dtype=options.dtype,
        micro_batch=options.micro_batch,
        compile=options.compile or False,
    )
    assert isinstance(inpainter, DiffusionInpainter)
    report = inpainter.warm_up((right.shape[-2], right.shape[-1]))

    def work() -> Tensor:
        return inpainter(right, inpaint_mask, [rng(0, 0, index, "inpaint") for index in range(len(right))])

    seconds, _ = timed(work, right.device, options.repeats)
    stages = stage_ms(inpainter, work, len(right), right.device)
    tflop = count_tflop(work) / len(right)
    release(right.device)
    return {
        "pairs_per_second": len(right) / seconds,
        **stages,
        "tflop": tflop,
        "peak_bytes": report.peak_bytes,
        "micro_batch": report.micro_batch,
    }


def measure_depth(folder: Path, device: torch.device, matmul: float, options: argparse.Namespace) -> list[dict[str, Any]]:
    sizes = SMALL_DEPTH_ANYTHING if options.smoke else DEPTH_ANYTHING_V2
    photo_size = (96, 128) if options.smoke else PHOTO
    photo = torch.from_numpy(np.random.default_rng(0).integers(0, 256, (1, 3, *photo_size), dtype=np.uint8))
    print()
    print_row(("depth, mirrored too", "photos/s", "target", "network ms", "prepare ms", "TFLOP", "TFLOP/s", "of matmul", "peak GiB"))
    rows = []
    for name, size in sizes.items():
        save_depth(folder / name, size, device, 70 if options.smoke else 518)
        depth: Any = load_depth(folder / name, device, dtype=options.dtype, compile=bool(options.compile))
        report = depth.warm_up(photo_size)
        prepare, _ = timed(lambda depth=depth: depth.prepare(photo), torch.device("cpu"), options.repeats)
        inputs = [depth.prepare(photo).to(device)] * options.micro_batch
        work = lambda depth=depth, inputs=inputs: list(depth.predict_mirrored(inputs, [photo_size] * len(inputs)))  # noqa: E731
        seconds, _ = timed(work, device, options.repeats)
        photos_per_second = len(inputs) / seconds
        row = {"network": name, "photos_per_second": photos_per_second, "prepare_ms": 1e3 * prepare, "peak_bytes": report.peak_bytes}
        row["tflop"] = count_tflop(work) / len(inputs)
        rows.append(row)
        target = DEPTH_TARGETS.get(name) if device.type == "cuda" else None
        speed = row["tflop"] * photos_per_second
        print_row(
            (
                f"{name} at {'x'.join(map(str, inputs[0].shape[-2:]))}",
                f"{photos_per_second:.3g}",
                "" if target is None else f"{target:g}",
                f"{1e3 / photos_per_second:.3g}",
                f"{row['prepare_ms']:.3g}",
                f"{row['tflop']:.3g}",
                f"{speed:.3g}",
                f"{speed / matmul:.2f}",
                gib(report.peak_bytes),
            )
        )
        del depth, work
        release(device)
    return rows


def save_pipeline(folder: Path, device: torch.device, small: bool) -> None:
    """Stable Diffusion 2 Inpainting's layout, with a text encoder of one layer (it embeds one empty prompt), and the tiny autoencoder."""
    half = torch.float32 if small else torch.bfloat16
    with torch.random.fork_rng(), torch.device(device):
        torch.manual_seed(0)
        unet = diffusers.UNet2DConditionModel(**(SMALL_UNET if small else STABLE_DIFFUSION_2))
        unet.to(half).save_pretrained(folder / "unet")
        vae = diffusers.AutoencoderKL(**(SMALL_AUTOENCODER if small else AUTOENCODER))
        vae.to(half).save_pretrained(folder / "vae")
        channels = (8,) * 4 if small else (64,) * 4
        tiny = diffusers.AutoencoderTiny(encoder_block_out_channels=channels, decoder_block_out_channels=channels)
        tiny.to(half).save_pretrained(folder / "tiny")
    hidden = unet.config["cross_attention_dim"]
    text = transformers.CLIPTextConfig(vocab_size=4, hidden_size=hidden, intermediate_size=64, num_hidden_layers=1, num_attention_heads=2)
    transformers.CLIPTextModel(text).save_pretrained(folder / "text_encoder")
    diffusers.DDIMScheduler(**SCHEDULE).save_pretrained(folder / "scheduler")
    tokenizer = folder / "tokenizer"
    tokenizer.mkdir()
    (tokenizer / "vocab.json").write_text('{"<|startoftext|>": 0, "<|endoftext|>": 1, "a": 2, "a</w>": 3}')
    (tokenizer / "merges.txt").write_text("#version: 0.2\n")
    special = {"bos_token": "<|startoftext|>", "eos_token": "<|endoftext|>", "pad_token": "!", "unk_token": "<|endoftext|>"}
    (tokenizer / "tokenizer_config.json").write_text(json.dumps({"tokenizer_class": "CLIPTokenizer", "model_max_length": 77} | special))
    del unet, vae, tiny
    release(device)


def save_depth(folder: Path, size: tuple[int, int, int, list[int], int, list[int]], device: torch.device, side: int) -> None:
    hidden, layers, heads, neck, fusion, used = size
    backbone = transformers.Dinov2Config(
        hidden_size=hidden,
        num_hidden_layers=layers,
        num_attention_heads=heads,
        image_size=side,
        patch_size=14,
        out_indices=used,
        apply_layernorm=True,
        reshape_hidden_states=False,
    )
    config = transformers.DepthAnythingConfig(
        backbone_config=backbone, reassemble_hidden_size=hidden, neck_hidden_sizes=neck, fusion_hidden_size=fusion, patch_size=14
    )
    with torch.random.fork_rng(), torch.device(device):
        torch.manual_seed(0)
        network = transformers.DepthAnythingForDepthEstimation(config)
    network.save_pretrained(folder)
    preprocessing = {"image_processor_type": "DPTImageProcessor", "size": {"height": side, "width": side}, "ensure_multiple_of": 14}
    (folder / "preprocessor_config.json").write_text(json.dumps({**preprocessing, "keep_aspect_ratio": True}))


def images_with_holes(count: int, height: int, width: int, device: torch.device) -> tuple[Tensor, Tensor]:
    """Noise with strips of holes, as a warp leaves them: beside objects, and at the right edge."""
    generator = np.random.default_rng(0)
    right = torch.from_numpy(generator.integers(0, 256, (count, 3, height, width)).astype(np.float32))
    inpaint_mask = torch.zeros(count, 1, height, width, dtype=torch.bool)
    strips = 5
    for sample in range(count):
        for _ in range(strips):
            left = int(generator.integers(0, width))
            inpaint_mask[sample, ..., left : left + int(HOLE_SHARE * width / strips)] = True
    return right.to(device), inpaint_mask.to(device)


def timed(work: Callable[[], object], device: torch.device, repeats: int) -> tuple[float, int | None]:
    """Median seconds of a run, and the most device memory it takes beyond what is taken already; the first run does not count."""
    cuda = device.type == "cuda"
    seconds = []
    work()
    if cuda:
        torch.cuda.synchronize(device)
        before = torch.cuda.memory_allocated(device)
        torch.cuda.reset_peak_memory_stats(device)
    for _ in range(repeats):
        start = time.perf_counter()
        work()
        if cuda:
            torch.cuda.synchronize(device)
        seconds.append(time.perf_counter() - start)
    return statistics.median(seconds), torch.cuda.max_memory_allocated(device) - before if cuda else None


@contextmanager
def around_stages(inpainter: DiffusionInpainter, enter: Callable[[str], AbstractContextManager[None]]) -> Iterator[None]:
    """Lets every stage of the inpainter run inside of `enter(its name)`."""

    def inside(stage: str, step: Callable[..., Tensor]) -> Callable[..., Tensor]:
        def run(*arguments: Any) -> Tensor:
            with enter(stage):
                return step(*arguments)

        return run

    for stage, method in STAGES.items():
        setattr(inpainter, method, inside(stage, getattr(inpainter, method)))
    yield
    for method in STAGES.values():
        delattr(inpainter, method)


def stage_ms(inpainter: DiffusionInpainter, work: Callable[[], object], pairs: int, device: torch.device) -> dict[str, float]:
    """Milliseconds a pair of each stage of one run; the device is waited for between them."""
    spent = dict.fromkeys(STAGES, 0.0)
    wait = torch.cuda.synchronize if device.type == "cuda" else lambda: None

    @contextmanager
    def take_time(stage: str) -> Iterator[None]:
        wait()
        start = time.perf_counter()
        yield
        wait()
        spent[stage] += 1e3 * (time.perf_counter() - start) / pairs

    with around_stages(inpainter, take_time):
        work()
    return {f"{stage}_ms": ms for stage, ms in spent.items()}


def count_tflop(work: Callable[[], object]) -> float:
    """The arithmetic of one run, in units of 1e12; compiled code runs uncompiled, the counter would not see into it."""
    with torch.compiler.set_stance("force_eager"), FlopCounterMode(display=False) as counter:
        work()
    return counter.get_total_flops() / 1e12


def release(device: torch.device) -> None:
    gc.collect()
    if device.type == "cuda":
        torch.cuda.empty_cache()


def gib(number: int | None) -> str:
    return "" if number is None else f"{number / GIB:.2f}"


def print_row(values: tuple[Any, ...]) -> None:
    print(f"{values[0]!s:20}" + "".join(f"{value!s:>12}" for value in values[1:]), flush=True)


if __name__ == "__main__":
    main()
