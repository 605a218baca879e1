"""Fine-tunes a diffusion inpainting model on the holes that stereo leaves: what a right camera sees and the left one does not.

accelerate launch trainers/inpaint.py --pipeline sd2-community/stable-diffusion-2-inpainting --photos "shards/*.tar" \\
    --depth depth-anything/Depth-Anything-V2-Small-hf --depth-cache depth --mixed-precision bf16 --output runs/inpaint
accelerate launch trainers/inpaint.py --pipeline sd2-community/stable-diffusion-2-inpainting \\
    --datasets sceneflow-final=data/sceneflow tartanair=data/tartanair crestereo=data/crestereo vkitti2=data/vkitti2 --output runs/inpaint

The result is a pipeline in the diffusers format, RUN/checkpoints/step-.../pipeline, for `ZeroStereoStream(inpaint=that folder)` or
`trainers/raft.py --inpaint that folder`. The last three checkpoints stay; of a run that judges them (--validate) the best one, too, in
RUN/best/pipeline.

The defaults are the paper's: the VAE is frozen, the U-Net learns to predict the noise; 50,000 steps of 32 crops of 512x512; AdamW, a
one-cycle of 2e-5; the same colour augmentation for both images. --batch-size counts all ranks, and what does not fit at once is
accumulated: where memory is short, lower --micro-batch and take --gradient-checkpointing; both leave the result as it is, up to rounding.

Where the examples come from
  --photos       no stereo at all: a photo is taken for the right image, a disparity is drawn from its depth, and exactly those of its
                 pixels are masked that a left view could not show. The truth is the photo itself. Needs no licence but the photos' own.
  --datasets     synthetic stereo with true disparity, warped left to right, in the folders that their authors publish:
{layouts}
                 The folder may be the data set's own or one above it. Where the right view's truth is there too, half of the pairs are
                 mirrored. A pair of sparse truth, of which less than half is known, is refused. Several data sets, and photos beside them,
                 are mixed by their numbers of pairs.
  --datasets tars=URL   the same in WebDataset tars: KEY.left.png (or jpg, webp), KEY.right.png, KEY.disp.pfm (or .npy in pixels, or
                 .png of 16 bits, 256 times the disparity), optionally KEY.disp_right.*.

The pipelines: sd2-community/stable-diffusion-2-inpainting (Open RAIL++) is a mirror of Stability AI's repository, which is gone; the
paper's own fine-tuned model is Windsrain/ZeroStereo with --subfolder StereoGen. A local folder works as well. What is needed:
pip install "zsdata[depth,diffusion,tensorboard]".
"""

from __future__ import annotations

import argparse
from pathlib import Path

from trainers import run_folder
from trainers.arguments import run
from trainers.inpaint_data.layouts import LAYOUTS, StereoFolder
from trainers.inpaint_data.sources import Examples, PhotoSource, Source, StereoSource
from trainers.inpaint_data.tars import StereoTars
from trainers.inpaint_loop import TuneConfig, tune
from trainers.pairs_on_disk import StereoPair, find_pairs, motorcycle, read_pair
from trainers.pipeline_folder import local_pipeline
from zsdata import AdaptiveDisparity
from zsdata.source.manifest import build_manifest

TARS = "tars"


def main() -> None:
    arguments = _parser().parse_args()
    run_folder.check_output(arguments.output, arguments.resume)  # before any photo is read
    names = (
        "steps",
        "batch_size",
        "micro_batch",
        "learning_rate",
        "ema",
        "gradient_checkpointing",
        "mixed_precision",
        "workers",
        "save_every",
        "validation_steps",
        "seed",
    )
    config = TuneConfig(**{name: getattr(arguments, name) for name in names})
    examples = Examples(open_sources(arguments), tuple(arguments.size), config.seed, config.batch_size)
    with run_folder.claimed(arguments.output):
        tune(
            local_pipeline(arguments.pipeline, arguments.subfolder, arguments.revision),
            examples,
            config,
            subfolder=arguments.subfolder,
            output=arguments.output,
            arguments={argument: str(value) for argument, value in vars(arguments).items()},
            resume=arguments.resume,
            pairs=validation_pairs(arguments.validate),
            tracker=None if arguments.tracker == "none" else arguments.tracker,
        )


def open_sources(arguments: argparse.Namespace) -> dict[str, Source]:
    """The data that the arguments name.

    Raises:
        ValueError, FileNotFoundError: nothing is named, or something that is not there.
    """
    sources: dict[str, Source] = {}
    for spec in arguments.datasets:
        kind, equals, where = spec.partition("=")
        if not equals or not where or kind not in (*LAYOUTS, TARS):
            raise ValueError(f"--datasets takes KIND=FOLDER with one of {', '.join((*LAYOUTS, TARS))} as the kind; got {spec!r}")
        if kind in sources:
            raise ValueError(f"{kind} is named twice; put both below one folder, or give a pattern of tars")
        sources[kind] = StereoSource(StereoTars(where) if kind == TARS else StereoFolder(kind, where))
    if arguments.photos:
        sources["photos"] = PhotoSource(build_manifest(arguments.photos), arguments.depth, AdaptiveDisparity(), arguments.depth_cache)
    elif arguments.depth_cache is not None:
        raise ValueError("--depth-cache keeps the depth of photos; name --photos, or leave it out")
    if not sources:
        raise ValueError("nothing to learn from: name --photos or --datasets (or both)")
    return sources


def validation_pairs(names: list[str]) -> list[StereoPair]:
    """The pairs to judge by, read before the training so that a wrong path fails at once."""
    pairs = []
    for name in names:
        pairs += [motorcycle()] if name == "motorcycle" else [read_pair(folder) for folder in find_pairs(Path(name))]
    return pairs


def _parser() -> argparse.ArgumentParser:
    defaults = TuneConfig()
    layouts = "\n".join(f"                   {kind + '=FOLDER':24s}{layout.example}" for kind, layout in LAYOUTS.items())
    parser = argparse.ArgumentParser(
        description=(__doc__ or "").replace("{layouts}", layouts), formatter_class=argparse.RawDescriptionHelpFormatter
    )
    model = parser.add_argument_group("the pipeline to start from")
    model.add_argument(
        "--pipeline", required=True, metavar="NAME", help="a Hub id or folder of an inpainting pipeline in the diffusers format"
    )
    model.add_argument("--subfolder", default="", metavar="DIR", help="where in it the pipeline lies")
    model.add_argument("--revision", help="branch, tag or commit of a Hub id")

    data = parser.add_argument_group("the examples")
    data.add_argument("--photos", nargs="+", default=[], metavar="URL", help='tars of photos: paths, urls or patterns ("shards/*.tar")')
    data.add_argument(
        "--depth",
        default="builtin",
        help='for photos: "builtin", a Hub id or folder in the transformers format, or "stored", the maps beside them in the tars, where '
        "`zsdata pack` puts NAME.depth.npy or NAME.depth.png with NAME.jpg (default: builtin)",
    )
    data.add_argument(
        "--depth-cache",
        metavar="DIR",
        help="keep each photo's depth there: it is estimated once, not once per epoch on one CPU thread; a matcher's trainer that was "
        "given this folder and --depth has filled it already",
    )
    data.add_argument("--datasets", nargs="+", default=[], metavar="KIND=FOLDER", help="synthetic stereo, see above")
    data.add_argument(
        "--size", type=int, nargs=2, default=(512, 512), metavar=("HEIGHT", "WIDTH"), help="of the crops, multiples of 8 (default: 512 512)"
    )
    data.add_argument("--seed", type=int, default=defaults.seed, help="of order, crops, colours and noise (default: 0)")
    data.add_argument(
        "--workers", type=int, default=defaults.workers, help=f"processes that make examples, per rank (default: {defaults.workers})"
    )

    training = parser.add_argument_group("the training")
    training.add_argument("--steps", type=int, default=defaults.steps, help=f"optimizer steps in all (default: {defaults.steps:,})")
    training.add_argument(
        "--batch-size",
        type=int,
        default=defaults.batch_size,
        help=f"examples per step, all ranks together (default: {defaults.batch_size})",
    )
    training.add_argument(
        "--micro-batch",
        type=int,
        default=defaults.micro_batch,
        help=f"examples at once on one rank: memory (default: {defaults.micro_batch})",
    )
    training.add_argument("--gradient-checkpointing", action="store_true", help="much less memory, a third more time")
    training.add_argument(
        "--learning-rate", type=float, default=defaults.learning_rate, help=f"peak of the one-cycle (default: {defaults.learning_rate})"
    )
    training.add_argument(
        "--ema", type=float, metavar="DECAY", help="save and judge a moving average of the weights, such as 0.9999 (default: none)"
    )
    training.add_argument("--mixed-precision", choices=("no", "bf16", "fp16"), help="default: what `accelerate launch` was told")
    training.add_argument(
        "--output", type=Path, required=True, metavar="DIR", help="the run's own folder: checkpoints, best, logs, validation.jsonl"
    )
    training.add_argument(
        "--resume",
        type=Path,
        metavar="DIR",
        help="go on from the newest checkpoint of that run, or from that checkpoint; with --output's folder the run begins where there is "
        "none yet, so that a cluster can repeat the command (SIGTERM saves one)",
    )
    training.add_argument(
        "--save-every", type=int, default=defaults.save_every, help=f"steps between checkpoints (default: {defaults.save_every:,})"
    )
    training.add_argument("--tracker", default="tensorboard", help='one of Accelerate\'s trackers, or "none" (default: tensorboard)')

    validation = parser.add_argument_group("the validation, before the first step, at every checkpoint and on resume")
    validation.add_argument(
        "--validate",
        nargs="+",
        default=[],
        metavar="WHAT",
        help='"motorcycle" (ships with scikit-image), or folders of real pairs with dense ground truth: PSNR and SSIM in their holes; the '
        "checkpoint of the highest mean PSNR is kept in RUN/best",
    )
    validation.add_argument(
        "--validation-steps", type=int, default=defaults.validation_steps, help=f"of DDIM (default: {defaults.validation_steps})"
    )
    return parser


if __name__ == "__main__":
    run(main)
