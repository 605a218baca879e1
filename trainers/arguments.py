"""The command line that all matcher trainers share: the stream, the training, the evaluation."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from torch import Tensor

from trainers import run_folder
from trainers.loop import LossFunction, TrainConfig, train
from trainers.models import Matcher, load_checkpoint
from trainers.models.checkpoint import WEIGHTS_FILE
from trainers.models.matcher import SIZE_MULTIPLE_PX
from trainers.ranks import end_with_launcher, start_missing_ranks
from trainers.scores import METRICS
from trainers.step_guard import TrainingDiverged
from trainers.training_loss import LOSSES
from trainers.validation import EvaluationSet
from zsdata import AdaptiveDisparity, AugmentConfig, DepthNetwork, DiffusionNetwork, SynthesisConfig, UniformDisparity, ZeroStereoStream
from zsdata.faults import TOLD_IN_WORDS, in_words
from zsdata.sources import parse_sources
from zsdata.stream import DEPTH_PLACEMENTS


def labels_are_trusted(arguments: argparse.Namespace) -> bool:
    """Whether every label has confidence 1, so that nothing is left for the photometric term."""
    return arguments.no_confidence or arguments.depth == "stored"


def add_training_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds every option but the matcher's own."""
    defaults = TrainConfig()
    stream = parser.add_argument_group("the stream")
    stream.add_argument(
        "--sources",
        nargs="+",
        required=True,
        metavar="URL",
        help='tars: paths, urls or patterns ("shards/{000..099}.tar"); or NAME=URL@WEIGHT for weighted sources (indoor=in.tar@0.7)',
    )
    stream.add_argument(
        "--sources-from",
        nargs="+",
        action="append",
        default=[],
        metavar=("EPOCH", "URL"),
        help="other sources from that epoch on; may be given several times",
    )
    stream.add_argument("--epoch-size", type=int, metavar="N", help="samples per epoch (default: one pass over the photos)")
    stream.add_argument(
        "--size",
        type=int,
        nargs=2,
        default=(384, 512),
        metavar=("HEIGHT", "WIDTH"),
        help="of the crops, multiples of 32 (default: 384 512)",
    )
    stream.add_argument(
        "--depth",
        default="builtin",
        metavar="NAME",
        help='"builtin", "stored" (maps beside the photos in the tars), a Hub id ("owner/name", or "owner/name@commit") or a folder in the '
        "transformers format (default: builtin)",
    )
    stream.add_argument(
        "--inpaint",
        default="builtin",
        metavar="NAME",
        help='"builtin", "background" (another photo, as in MfS-Stereo), "none" (black), or a Hub id or folder in the diffusers format '
        "(default: builtin)",
    )
    stream.add_argument(
        "--depth-resolution",
        metavar="PX",
        help="short side of a depth network's input in pixels, or \"native\", the photo's own size (default: the network's own)",
    )
    stream.add_argument(
        "--depth-placement",
        choices=DEPTH_PLACEMENTS,
        default="auto",
        help="where depth is estimated: in the workers, on the CPU, or on the training device (default: auto, there where it has a GPU)",
    )
    stream.add_argument("--depth-cache", metavar="DIR", help="keep each photo's depth there: it is estimated once, not once per epoch")
    stream.add_argument("--inpaint-steps", type=int, metavar="T", help="denoising steps of a diffusion network (default: 50)")
    stream.add_argument(
        "--inpaint-scheduler",
        metavar="NAME",
        help='of these steps: "ddim", "dpm++", "euler", "lcm", "tcd" or a class of diffusers (default: ddim)',
    )
    stream.add_argument(
        "--inpaint-autoencoder",
        metavar="NAME",
        help='another autoencoder, such as the tiny and fast "madebyollin/taesd" (default: its own)',
    )
    stream.add_argument("--inpaint-subfolder", metavar="NAME", help='where it lies in --inpaint: "StereoGen" in "Windsrain/ZeroStereo"')
    stream.add_argument("--views-per-image", type=int, default=1, metavar="K", help="samples in a row from one photo (default: 1)")
    stream.add_argument(
        "--reuse", type=int, default=1, metavar="K", help="samples in a row from one pair, with augmentations of their own (default: 1)"
    )
    stream.add_argument("--commercial-safe", action="store_true", help="refuse models that are known to be for non-commercial use")
    stream.add_argument(
        "--disparity", choices=("adaptive", "uniform"), default="adaptive", help="the paper's ADS, or MfS-Stereo's uniform range"
    )
    stream.add_argument("--no-confidence", action="store_true", help="every label counts fully (no TCG)")
    stream.add_argument("--no-augmentation", action="store_true", help="train on the clean pairs")
    stream.add_argument("--seed", type=int, metavar="N", default=0, help="of the stream and of the fresh weights (default: 0)")
    stream.add_argument(
        "--workers",
        type=int,
        metavar="N",
        default=defaults.workers,
        help=f"processes that make pairs, per rank (default: {defaults.workers})",
    )

    training = parser.add_argument_group("the training")
    training.add_argument(
        "--steps", type=int, metavar="N", default=defaults.steps, help=f"optimizer steps in all (default: {defaults.steps:,})"
    )
    training.add_argument(
        "--batch-size", type=int, metavar="N", default=defaults.batch_size, help=f"pairs per rank and step (default: {defaults.batch_size})"
    )
    training.add_argument("--accumulate", type=int, metavar="N", default=1, help="batches per optimizer step (default: 1)")
    training.add_argument(
        "--iterations",
        type=int,
        metavar="N",
        default=defaults.iterations,
        help=f"of the matcher, in training (default: {defaults.iterations})",
    )
    training.add_argument(
        "--learning-rate",
        type=float,
        metavar="X",
        default=defaults.learning_rate,
        help=f"peak of the one-cycle (default: {defaults.learning_rate})",
    )
    training.add_argument(
        "--loss",
        choices=list(LOSSES),
        default="zero",
        help="the paper's, or one of its ablations: "
        + "; ".join(f"{name} is {words}" for name, words in LOSSES.items())
        + " (default: zero)",
    )
    training.add_argument("--mixed-precision", choices=("no", "bf16", "fp16"), help="default: what `accelerate launch` was told")
    training.add_argument("--compile", action="store_true", help="torch.compile the encoders and the update; the first step takes minutes")
    training.add_argument("--channels-last", action="store_true", help="store images as tensor cores take them")
    training.add_argument(
        "--ema", type=float, metavar="DECAY", help="save and judge a moving average of the weights, such as 0.999 (default: none)"
    )
    training.add_argument(
        "--initial-weights",
        type=Path,
        metavar="PATH",
        help="a published or own checkpoint to start from: .pth, .safetensors, or a checkpoint's folder, such as RUN/best",
    )
    training.add_argument(
        "--output", type=Path, required=True, metavar="DIR", help="the run's own folder: checkpoints, best, logs, evaluations"
    )
    training.add_argument(
        "--resume",
        type=Path,
        metavar="DIR",
        help="go on from the newest checkpoint of that run, or from that checkpoint; "
        "with --output's folder the run begins where there is none yet, so that a cluster can repeat the command (SIGTERM saves one)",
    )
    training.add_argument(
        "--save-every",
        type=int,
        metavar="N",
        default=defaults.save_every,
        help=f"steps between checkpoints (default: {defaults.save_every:,})",
    )
    training.add_argument(
        "--tracker",
        default="tensorboard",
        metavar="NAME",
        help='one of Accelerate\'s trackers (wandb, mlflow, ...), or "none" (default: tensorboard)',
    )

    evaluation = parser.add_argument_group("the evaluation")
    evaluation.add_argument(
        "--evaluate",
        nargs="+",
        default=[],
        metavar="DATASET[=ROOT]",
        help='"motorcycle" (ships with scikit-image), folders of stereo pairs with ground truth, or benchmarks such as kitti2015=DIR or '
        "middlebury:F=DIR, as evaluate.py --help lists them with their variants",
    )
    evaluation.add_argument(
        "--evaluate-every",
        type=int,
        metavar="N",
        help="also every N steps, where a checkpoint is saved, too; OUTPUT/best is the best of them (default: at the end only)",
    )
    evaluation.add_argument(
        "--evaluate-first", action="store_true", help="also before the first step: what the fresh, or the initial, weights are worth"
    )
    evaluation.add_argument(
        "--best-by",
        choices=list(METRICS),
        default=defaults.best_by,
        help="what tells the best checkpoint: over all pixels with ground truth, the mean over the pairs of a set and then over the sets "
        f"(default: {defaults.best_by})",
    )
    evaluation.add_argument(
        "--evaluation-iterations",
        type=int,
        metavar="N",
        default=defaults.evaluation_iterations,
        help=f"default: {defaults.evaluation_iterations}",
    )


def open_stream(arguments: argparse.Namespace) -> ZeroStereoStream:
    """The stream that the arguments describe."""
    schedule: dict[int, Any] = {0: parse_sources(arguments.sources)}
    for epoch, *urls in arguments.sources_from:
        if not epoch.isdigit() or not urls:
            raise ValueError(f"--sources-from takes an epoch and urls, such as: --sources-from 5 other.tar; got {' '.join([epoch, *urls])}")
        schedule[int(epoch)] = parse_sources(urls)
    return ZeroStereoStream(
        schedule,
        size=tuple(arguments.size),
        depth=_depth(arguments),
        depth_placement=arguments.depth_placement,
        depth_cache=arguments.depth_cache,
        inpaint=_inpainter(arguments),
        views_per_image=arguments.views_per_image,
        reuse=arguments.reuse,
        commercial_safe=arguments.commercial_safe,
        disparity=AdaptiveDisparity() if arguments.disparity == "adaptive" else UniformDisparity(),
        seed=arguments.seed,
        epoch_size=arguments.epoch_size,
        synthesis=SynthesisConfig(flip_confidence=not arguments.no_confidence),
        augmentation=AugmentConfig.none() if arguments.no_augmentation else AugmentConfig(),
    )


def _depth(arguments: argparse.Namespace) -> str | DepthNetwork:
    options = _options_of(arguments, "depth", ("resolution",))
    if arguments.depth in ("builtin", "stored"):
        if options:
            raise ValueError(f"--depth-{next(iter(options))} belongs to a depth network; --depth is {arguments.depth}")
        return arguments.depth
    if options.get("resolution", "").isdecimal():
        options["resolution"] = int(options["resolution"])
    return DepthNetwork(arguments.depth, **options)


def _inpainter(arguments: argparse.Namespace) -> Any:
    options = _options_of(arguments, "inpaint", ("steps", "scheduler", "autoencoder", "subfolder"))
    if arguments.inpaint in ("none", "builtin", "background"):
        if options:
            raise ValueError(f"--inpaint-{next(iter(options))} belongs to a diffusion network; --inpaint is {arguments.inpaint}")
        return leave_black if arguments.inpaint == "none" else arguments.inpaint
    return DiffusionNetwork(arguments.inpaint, **options)


def _options_of(arguments: argparse.Namespace, network: str, names: Sequence[str]) -> dict[str, Any]:
    """Those of a network's options that were given, without its name before them."""
    given = {name: getattr(arguments, f"{network}_{name}") for name in names}
    return {name: value for name, value in given.items() if value is not None}


def train_config(arguments: argparse.Namespace) -> TrainConfig:
    """How to train, as the arguments say."""
    names = (
        "steps",
        "batch_size",
        "iterations",
        "evaluation_iterations",
        "learning_rate",
        "accumulate",
        "workers",
        "mixed_precision",
        "compile",
        "channels_last",
        "ema",
        "save_every",
        "evaluate_every",
        "evaluate_first",
        "best_by",
        "seed",
    )
    return TrainConfig(**{name: getattr(arguments, name) for name in names})


def leave_black(right: Tensor, inpaint_mask: Tensor, generators: Any) -> Tensor:
    """An inpainter that leaves the holes as the warp made them: black. No label leads there, and L_np leaves them out."""
    return right


def train_as_told(arguments: argparse.Namespace, matcher: Matcher, loss_function: LossFunction, name: str, options: dict[str, Any]) -> None:
    """Trains a fresh `matcher`, called `name` and built with `options`, as the command line says."""
    run_folder.check_output(arguments.output, arguments.resume)  # before any photo is read
    matcher.freeze_bn()
    if arguments.initial_weights is not None:
        weights = arguments.initial_weights
        load_checkpoint(matcher, weights / WEIGHTS_FILE if weights.is_dir() else weights)
    # Before the training, so that a wrong size or path fails at once.
    height, width = arguments.size
    if height % SIZE_MULTIPLE_PX or width % SIZE_MULTIPLE_PX or min(height, width) <= 0:
        raise ValueError(f"--size is a height and a width in multiples of {SIZE_MULTIPLE_PX} px; got {height} {width}")
    sets = [EvaluationSet.parse(spec) for spec in arguments.evaluate]
    if (arguments.evaluate_every is not None or arguments.evaluate_first) and not sets:
        option = "--evaluate-first" if arguments.evaluate_first else "--evaluate-every"
        raise ValueError(f"{option} needs --evaluate: what is to be judged on?")
    with run_folder.claimed(arguments.output):
        train(
            matcher,
            loss_function,
            open_stream(arguments),
            train_config(arguments),
            output=arguments.output,
            model_config={"model": name, "options": options},
            arguments={argument: str(value) for argument, value in vars(arguments).items()},
            resume=arguments.resume,
            sets=sets,
            tracker=None if arguments.tracker == "none" else arguments.tracker,
        )


def run(main: Any) -> None:
    """Runs a trainer's main on every rank; a wrong argument or a missing file is one line in words, not a traceback."""
    try:
        end_with_launcher()
        start_missing_ranks()
        main()
    except (*TOLD_IN_WORDS, TrainingDiverged) as error:
        sys.exit(f"{Path(sys.argv[0]).name}: {in_words(error)}")
    except KeyboardInterrupt:
        sys.exit(130)
