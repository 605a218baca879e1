"""The `zsdata` command: it parses, calls the library and prints."""

from __future__ import annotations

import argparse
import json
import os
import shlex
import sys
import warnings
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from functools import partial
from pathlib import Path

import cv2
import torch

import zsdata
from zsdata.augment import AugmentConfig
from zsdata.bench import REST, BenchReport, advice, bench, fill_depth_cache, leave_holes, samples_needed
from zsdata.example_photos import EXAMPLE_PHOTOS, pack_example_photos
from zsdata.export import export_pairs, write_whole
from zsdata.faults import TOLD_IN_WORDS, in_words
from zsdata.preview import contact_sheet
from zsdata.progress import Progress
from zsdata.sample import StereoBatch
from zsdata.source.archive import Problem
from zsdata.source.compressed import decompress
from zsdata.source.index import write_index
from zsdata.source.pack import PackReport, pack
from zsdata.source.urls import expand_urls
from zsdata.source.verify import verify
from zsdata.source.writing import writing
from zsdata.sources import parse_sources
from zsdata.statistics import source_statistics
from zsdata.stream import ZeroStereoStream
from zsdata.synthesis.depth import DepthEstimator, load_depth
from zsdata.synthesis.depth.options import STORED
from zsdata.synthesis.inpaint import Inpainter, load_inpainter
from zsdata.worker import SHORTEST_SIDE_PX

OK, FOUND_PROBLEMS, USER_ERROR, INTERRUPTED, PIPE_CLOSED = 0, 1, 2, 130, 141  # the last two as a shell counts signals
SKIPPED_SHOWN = 20

_URLS = (
    'a tar, a folder of tars, a pattern in quotes ("shards/{000..099}.tar", "shards/*.tar") or a url '
    "(http, https, s3, gs, hf); several may be given"
)


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs one command; returns its exit status: 0 done, 1 problems found, 2 an error that the user can mend, 130 interrupted."""
    options = _parser().parse_args(arguments)
    try:
        with warnings.catch_warnings():
            warnings.showwarning = _print_warning
            status = options.run(options)
        sys.stdout.flush()
        return status
    except KeyboardInterrupt:
        return _fail("interrupted", INTERRUPTED)
    except BrokenPipeError:  # whoever read the output, such as `head`, has enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return PIPE_CLOSED
    except TOLD_IN_WORDS as error:
        return _fail(in_words(error), USER_ERROR)


def _fail(message: str, status: int) -> int:
    print(f"zsdata: {_printable(message)}", file=sys.stderr)
    return status


def _print_warning(message: Warning | str, *where: object) -> None:
    """A warning in words, without the line of code that it came from."""
    Progress.write(f"zsdata: {_printable(str(message))}", file=sys.stderr)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="zsdata",
        description="Single photographs in, stereo training pairs out. "
        "First pack photos into shards, then look at the pairs made from them.",
        epilog="`zsdata COMMAND --help` explains a command. To train, give the shards to zsdata.ZeroStereoStream in Python.",
    )
    parser.add_argument("--version", action="version", version=f"zsdata {zsdata.__version__}")
    commands = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)

    def add(run: Callable[[argparse.Namespace], int], name: str, summary: str, description: str, example: str) -> argparse.ArgumentParser:
        command = commands.add_parser(name, help=summary, description=description, epilog=f"Example: {example}")
        command.set_defaults(run=run)
        return command

    command = add(
        _pack,
        "pack",
        "pack a folder of photos into shards",
        "Packs the JPEG, PNG and WebP photos in FOLDER and its subfolders into uncompressed tars (shards) in OUTPUT. "
        "A depth map NAME.depth.npy or NAME.depth.png beside a photo NAME.jpg is packed with it, for --depth stored. "
        "Photos are copied byte for byte; those that zsdata cannot use are left out and listed with the reason, and files without an "
        "image's extension are counted. FOLDER itself stays as it is.",
        example="zsdata pack holiday-photos shards",
    )
    command.add_argument("folder", metavar="FOLDER", help="folder of photos")
    command.add_argument("output", metavar="OUTPUT", help="folder for the shards; made if missing")
    command.add_argument("--photos-per-shard", metavar="N", type=_positive, default=1000, help="photos in each tar (default: %(default)s)")
    _add_overwrite(command)

    command = add(
        _example,
        "example",
        "pack a few photos to try zsdata with",
        f"Packs {len(EXAMPLE_PHOTOS)} photos that come with scikit-image into a shard in OUTPUT. "
        'Nothing is downloaded; scikit-image itself is installed by pip install "zsdata[demo]".',
        example="zsdata example example-shards",
    )
    command.add_argument("output", metavar="OUTPUT", help="folder for the shard; made if missing")
    _add_overwrite(command)

    command = add(
        _verify,
        "verify",
        "check every photo of a source",
        "Walks all shards and decodes every photo, and the depth maps beside them (KEY.depth.npy, KEY.depth.png). "
        "Prints a line per problem (shard, photo, reason) and a summary. "
        "The exit status is 0 when all is well, 1 when there are problems, 2 when nothing could be checked.",
        example='zsdata verify "shards/{000..099}.tar"',
    )
    command.add_argument("urls", metavar="SHARDS", nargs="+", help=_URLS)

    command = add(
        _index,
        "index",
        "list the photos of a source once, for all runs to come",
        "Walks all shards, reads every photo and depth map once, and stores where each lies and its checksum: SHARD.index.json beside a "
        "local shard, in the cache ($ZSDATA_CACHE, or zsdata in the user's cache folder) for a remote one. Opening a source of many shards "
        "then takes moments, and what changes afterwards is noticed. Indexes that are up to date stay; run it again when a shard has "
        "changed.",
        example='zsdata index "shards/{000..099}.tar"',
    )
    command.add_argument("urls", metavar="SHARDS", nargs="+", help=_URLS)

    command = add(
        _decompress,
        "decompress",
        "unpack tar.gz and tar.zst to shards",
        "Photos are read by their place in a shard, which a compressed file does not allow. Writes NAME.tar into OUTPUT for every "
        "NAME.tar.gz, NAME.tgz or NAME.tar.zst; the originals stay.",
        example='zsdata decompress "downloads/*.tar.gz" shards',
    )
    command.add_argument("urls", metavar="FILE", nargs="+", help='compressed tars: paths, urls or patterns ("downloads/*.tar.gz")')
    command.add_argument("output", metavar="OUTPUT", help="folder for the shards; made if missing")
    _add_overwrite(command)

    command = add(
        _preview,
        "preview",
        "make a picture of pairs, as training would see them",
        "Makes pairs and draws them on a contact sheet, one row each: left and right image, disparity, confidence, "
        "which pixels are hidden in the right image and which were invented there, and where the pair comes from.",
        example="zsdata preview --sources shards --output preview.png",
    )
    command.add_argument("--sources", metavar="SHARDS", nargs="+", required=True, help=_URLS)
    command.add_argument("--output", metavar="FILE.png", required=True, type=Path, help="the picture; an existing one is replaced")
    command.add_argument("--pairs", metavar="N", type=_positive, default=6, help="how many (default: %(default)s)")
    command.add_argument("--epoch", metavar="E", type=_count, default=0, help="of the first pair (default: %(default)s)")
    command.add_argument("--first-index", metavar="I", type=_count, default=0, help="of the first pair in its epoch (default: %(default)s)")
    _add_size(command)
    _add_steps(command)
    command.add_argument("--clean", action="store_true", help="show the pairs without their augmentation")

    command = add(
        _bench,
        "bench",
        "measure how fast pairs would be fed to training",
        "Makes pairs as training would and takes the time, on this machine and from these photos. Prints where a pair's time goes, in "
        "milliseconds and in decodes (how long OpenCV takes for the same photos, measured in between: the unit to compare machines by); "
        "the pairs per second for several numbers of workers; and, in words, what bounds them and what to change. Every run makes the same "
        "pairs, so after the first one the photos come from the system's memory. With nothing else on the machine, and without training "
        "on the GPU, these are the most that training can get.",
        example="zsdata bench --sources shards --workers 1 4 --depth-cache depth",
    )
    command.add_argument("--sources", metavar="SHARDS", nargs="+", required=True, help=_URLS)
    cores = _cores()
    command.add_argument(
        "--workers",
        metavar="N",
        nargs="+",
        type=_count,
        default=sorted({0, 1, cores // 2, cores}),
        help="numbers of worker processes to try; 0, no workers, is always measured (default: 0, 1, half of the cores and all, "
        "here %(default)s)",
    )
    command.add_argument("--device", metavar="NAME", default="cpu", help='that finishes the batches: "cpu" or "cuda" (default: cpu)')
    command.add_argument("--batch-size", metavar="N", type=_positive, default=8, help="pairs per batch (default: %(default)s)")
    command.add_argument(
        "--pairs", metavar="N", type=_positive, default=64, help="pairs per measurement, more with many workers (default: %(default)s)"
    )
    _add_size(command)
    _add_steps(command)
    command.add_argument(
        "--depth-cache",
        metavar="DIR",
        type=Path,
        help="keep depth in this folder, made if missing, and measure as in later epochs: once the depth of each photo is there",
    )
    command.add_argument("--views-per-image", metavar="N", type=_positive, default=1, help="pairs from each photo (default: %(default)s)")

    command = add(
        _stats,
        "stats",
        "say what the pairs of each source are like",
        "Makes pairs of whole photos, without augmentation, and prints a row per source: mean and largest disparity (in pixels, and as "
        "shares of the photo's width), how much of the left image is hidden in the right one, how much of the right one was invented, how "
        "well depth survives mirroring the photo, and how well the left image is reconstructed from the right one by the label (mean "
        "absolute error in 0..1, SSIM, photometric loss; over whole images, hidden pixels included).",
        example="zsdata stats --sources indoor=indoor.tar street=street.tar --pairs 200",
    )
    command.add_argument(
        "--sources", metavar="SHARDS", nargs="+", required=True, help=_URLS + "; NAME=URL gives a source a name and a row of its own"
    )
    command.add_argument(
        "--pairs", metavar="N", type=_positive, default=100, help="pairs to look at, of all sources (default: %(default)s)"
    )
    _add_steps(command)
    command.add_argument("--json", metavar="FILE", type=Path, help="write the figures there too")

    command = add(
        _export,
        "export",
        "write pairs to disk, in the layout of ZeroStereo's published data set",
        "Makes pairs without augmentation and writes them to DIR: left image (JPEG), right image (PNG), disparity and confidence (.npy), "
        "masks of what is visible in the right image and of what was invented there (PNG, 255 is yes), where the pair comes from (JSON), "
        "and filelist.txt, which the published training code takes and which names whole pairs only. Stopped at any moment, the same "
        "command goes on where it stopped, and the files come out the same.",
        example="zsdata export --sources shards --output pairs --workers 2",
    )
    command.add_argument("--sources", metavar="SHARDS", nargs="+", required=True, help=_URLS)
    command.add_argument("--output", metavar="DIR", required=True, type=Path, help="folder for the pairs; made if missing")
    command.add_argument("--pairs", metavar="N", type=_positive, help="how many (default: one per photo)")
    command.add_argument("--epoch", metavar="E", type=_count, default=0, help="of the first pair (default: %(default)s)")
    command.add_argument(
        "--size", metavar=("HEIGHT", "WIDTH"), nargs=2, type=_positive, help="of a pair in pixels (default: the whole photo, as published)"
    )
    _add_steps(command)
    command.add_argument(
        "--workers",
        metavar="N",
        type=_count,
        default=0,
        help="processes that prepare pairs, beside the one that inpaints and writes (default: %(default)s)",
    )
    return parser


def _add_size(command: argparse.ArgumentParser) -> None:
    command.add_argument(
        "--size", metavar=("HEIGHT", "WIDTH"), nargs=2, type=_positive, default=(384, 512), help="of a pair in pixels (default: 384 512)"
    )


def _add_steps(command: argparse.ArgumentParser) -> None:
    command.add_argument(
        "--depth",
        metavar="NAME",
        default="builtin",
        help='"builtin", "stored" (the maps beside the photos, KEY.depth.npy or KEY.depth.png), or a Hub id or folder in the transformers '
        "format (default: builtin)",
    )
    command.add_argument(
        "--inpaint",
        metavar="NAME",
        default="builtin",
        help='"builtin", "background" (another photo), or a Hub id or folder in the diffusers format (default: builtin)',
    )
    command.add_argument("--seed", metavar="N", type=_count, default=0, help="of the stream (default: %(default)s)")


def _depth(options: argparse.Namespace) -> str | DepthEstimator:
    """Stored depth is the stream's to read; an estimator is loaded here, so that what is wrong with it is told at once."""
    return STORED if options.depth == STORED else load_depth(options.depth)


def _add_overwrite(command: argparse.ArgumentParser) -> None:
    command.add_argument("--overwrite", action="store_true", help="replace shards that were packed into OUTPUT before, under the same name")


def _cores() -> int:
    """Of this machine, as far as this process may use them."""
    return len(os.sched_getaffinity(0))


def _count(text: str) -> int:
    if not text.isdecimal():
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number, 0 or more")
    return int(text)


def _positive(text: str) -> int:
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number, 1 or more")
    return int(text)


def _pack(options: argparse.Namespace) -> int:
    return _pack_and_tell(
        partial(pack, options.folder, photos_per_shard=options.photos_per_shard, shortest_side_px=SHORTEST_SIDE_PX), options
    )


def _example(options: argparse.Namespace) -> int:
    return _pack_and_tell(pack_example_photos, options)


def _pack_and_tell(make_shards: Callable[..., PackReport], options: argparse.Namespace) -> int:
    with _naming_overwrite(options):
        report = make_shards(options.output, overwrite=options.overwrite)
    shards = report.shards[0] if len(report.shards) == 1 else f"{len(report.shards):,} shards, {report.shards[0]} to {report.shards[-1]}"
    depths = f" with {_several(report.depth_maps, 'depth map')}" if report.depth_maps else ""
    print(f"packed {_several(report.photos, 'photo')}{depths} ({_megabytes(report.bytes)}) into {_printable(shards)}")
    if report.skipped:
        print(f"skipped {len(report.skipped):,}:")
        for path, reason in report.skipped[:SKIPPED_SHOWN]:
            print(f"  {_printable(path)}: {_printable(reason)}")
        if len(report.skipped) > SKIPPED_SHOWN:
            print(f"  ... and {len(report.skipped) - SKIPPED_SHOWN:,} more")
    if report.passed_over:
        print(_printable(report.passed_over_in_words))
    print(f"to look at pairs made from them: zsdata preview --sources {_printable(shlex.quote(options.output))} --output preview.png")
    return OK


def _verify(options: argparse.Namespace) -> int:
    report = verify(options.urls, _print_problem, shortest_side_px=SHORTEST_SIDE_PX)
    depths = f" with {_several(report.depth_maps, 'good depth map')}" if report.depth_maps else ""
    held = f", {report.indexed:,} held against their index" if report.indexed else ""
    good = f"{_several(report.photos, 'good photo')}{depths} in {_several(report.shards, 'shard')}, {_megabytes(report.bytes)}{held}"
    if not report.problems:
        print(f"all is well: {good}")
        return OK
    reasons = Counter(problem.reason.split(":")[0] for problem in report.problems)
    by_reason = ", ".join(f"{reason}: {count:,}" for reason, count in reasons.most_common())
    print(f"{_several(len(report.problems), 'problem')} ({_printable(by_reason)}); {good}")
    return FOUND_PROBLEMS if report.opened else USER_ERROR


def _index(options: argparse.Namespace) -> int:
    report = write_index(options.urls)
    for problem in report.problems:
        _print_problem(problem)
    photos = f"{_several(report.photos, 'photo')} in {_several(report.shards, 'shard')}, {_megabytes(report.bytes)}"
    print(f"{photos}: {_several(len(report.files), 'index', 'indexes')} written, {report.unchanged:,} up to date")
    if report.problems:
        print(f"{_several(len(report.problems), 'problem')} as above; `zsdata verify` decodes every photo")
    return FOUND_PROBLEMS if report.problems else OK


def _decompress(options: argparse.Namespace) -> int:
    with _naming_overwrite(options):
        shards = decompress(options.urls, options.output, overwrite=options.overwrite)
    for shard in shards:
        print(_printable(shard))
    return OK


@contextmanager
def _naming_overwrite(options: argparse.Namespace) -> Iterator[None]:
    """What is refused because it is there already names the option that allows it."""
    try:
        yield
    except FileExistsError as error:
        if options.overwrite:
            raise
        raise FileExistsError(f"{error} (--overwrite)") from error


def _print_problem(problem: Problem) -> None:
    Progress.write(_printable(str(problem)), file=sys.stdout)


def _preview(options: argparse.Namespace) -> int:
    output: Path = options.output
    if output.suffix.lower() != ".png" or output.is_dir():
        raise ValueError(f"{output}: the preview is a PNG file; give --output a name that ends in .png")
    if not output.parent.is_dir():
        raise NotADirectoryError(f"{output.parent} is not a folder; make it first, or write the preview elsewhere")
    shards = expand_urls(options.sources)  # a wrong path is told before a network is loaded
    stream = ZeroStereoStream(
        shards,
        size=tuple(options.size),
        depth=_depth(options),
        inpaint=load_inpainter(options.inpaint),
        seed=options.seed,
        augmentation=AugmentConfig.none() if options.clean else None,
    )
    pairs = _take(stream, options.epoch, options.first_index, options.pairs)
    sheet = cv2.imencode(".png", cv2.cvtColor(contact_sheet(pairs), cv2.COLOR_RGB2BGR))[1]
    write_whole(output, sheet.tobytes())
    (height, width), last = options.size, pairs[-1].meta
    print(
        f"{_printable(str(output))}: {_several(len(pairs), 'pair')}, {height} px high and {width} px wide, seed {options.seed}, "
        f"from epoch {options.epoch}, index {options.first_index} to epoch {last['epoch']}, index {last['index']}"
    )
    _tell_refused(stream)
    return OK


def _tell_refused(stream: ZeroStereoStream) -> None:
    refused = stream.stats()["rejected"]
    if refused:
        print(f"photos that could not be used and were replaced: {', '.join(f'{reason}: {n:,}' for reason, n in refused.items())}")


def _stats(options: argparse.Namespace) -> int:
    sources = parse_sources(options.sources)
    if isinstance(sources, list):
        sources = expand_urls(sources)
    stream = ZeroStereoStream(
        sources,
        size=None,
        depth=_depth(options),
        inpaint=load_inpainter(options.inpaint),
        seed=options.seed,
        augmentation=AugmentConfig.none(),
    )
    pairs = min(options.pairs, len(stream))
    with Progress(total=pairs, desc="looking at pairs", unit="pair", disable=None) as bar:
        statistics = source_statistics(stream, pairs, bar.update)
    if options.json is not None:
        with writing(options.json):
            options.json.write_text(json.dumps({name: asdict(row) for name, row in statistics.items()}, indent=2) + "\n", encoding="utf-8")
    print("                             disparity, px  share of width    share of pixels     flip   reconstruction of the left image")
    print("source                pairs    mean     max    mean    max   hidden  invented  consist.  abs. error    SSIM  photometric")
    for name, row in statistics.items():
        print(
            f"{_printable(name):20.20} {row.pairs:6,} {row.mean_px:7.2f} {row.max_px:7.2f} {row.mean_share:7.3f} {row.max_share:6.3f} "
            f"{row.hidden:8.3f} {row.invented:9.3f} {row.flip_consistency:9.3f} {row.abs_err:11.4f} {row.ssim:7.3f} {row.photometric:12.4f}"
        )
    _tell_refused(stream)
    return OK


def _export(options: argparse.Namespace) -> int:
    shards = expand_urls(options.sources)
    size = None if options.size is None else tuple(options.size)
    stream = ZeroStereoStream(
        shards,
        size=size,
        depth=_depth(options),
        inpaint=load_inpainter(options.inpaint),
        seed=options.seed,
        augmentation=AugmentConfig.none(),
    )
    report = export_pairs(
        stream,
        options.output,
        pairs=options.pairs,
        epoch=options.epoch,
        workers=options.workers,
        settings={"size": size, "depth": options.depth, "inpaint": options.inpaint},
    )
    already_there = f", {report.already_there:,} of them already there" if report.already_there else ""
    print(f"{_printable(str(options.output))}: {_several(report.pairs, 'pair')} ({_megabytes(report.bytes)}){already_there}")
    if report.replaced:
        reasons = ", ".join(f"{reason}: {count:,}" for reason, count in report.replaced.most_common())
        print(f"photos that could not be used and were replaced: {_printable(reasons)}")
    return OK


def _bench(options: argparse.Namespace) -> int:
    shards = expand_urls(options.sources)
    device = _device(options.device)
    _depth(options)  # what is wrong with it is told first; training is given the name, and every worker loads its own
    inpainter = load_inpainter(options.inpaint, device)
    samples = samples_needed(options.workers, batch_size=options.batch_size, pairs=options.pairs)

    def stream_with(inpaint: Inpainter, augmentation: AugmentConfig | None) -> ZeroStereoStream:
        return ZeroStereoStream(
            shards,
            size=tuple(options.size),
            depth=options.depth,
            inpaint=inpaint,
            seed=options.seed,
            epoch_size=samples,
            views_per_image=options.views_per_image,
            depth_cache=options.depth_cache,
            augmentation=augmentation,
        )

    stream = stream_with(inpainter, None)
    if options.depth_cache is not None:
        fill_depth_cache(stream_with(leave_holes, AugmentConfig.none()), max(options.workers), samples)
    report = bench(stream, options.workers, batch_size=options.batch_size, pairs=options.pairs, device=device)
    _print_bench(report, options)
    stored = options.depth == STORED
    print(advice(report, device=device, cores=_cores(), depth_cached=options.depth_cache is not None, depth_stored=stored))
    return OK


def _device(name: str) -> torch.device:
    try:
        device = torch.device(name)
    except RuntimeError as error:
        raise ValueError(f'--device is "cpu", "cuda" or "cuda:1"; got {name!r}') from error
    if device.type not in ("cpu", "cuda"):
        raise ValueError(f'--device is "cpu", "cuda" or "cuda:1"; got {name!r}')
    if device.type == "cuda" and (device.index or 0) >= torch.cuda.device_count():
        raise ValueError(f"--device {name}: PyTorch sees {_several(torch.cuda.device_count(), 'GPU')} here; use --device cpu")
    return device


def _print_bench(report: BenchReport, options: argparse.Namespace) -> None:
    height, width = options.size
    total = sum(report.worker_ms.values()) + sum(report.finish_ms.values())
    print(f"a pair, {height} px high and {width} px wide; a decode is {report.decode_ms:.2f} ms, the mean over the same photos\n")
    print(f"{'stage':32}{'ms a pair':>10}{'share':>8}{'decodes':>9}")

    def row(name: str, ms: float) -> None:
        print(f"{name:32}{ms:10.2f}{ms / total:8.1%}{ms / report.decode_ms:9.2f}")

    for process, stages in (("a worker", report.worker_ms), ("the training process", report.finish_ms)):
        for name, ms in stages.items():
            row(f"  {name}" if name != REST else f"  {REST} of {process}", ms)
        row(process, sum(stages.values()))
    row("both", total)
    print(f"\n{'workers':>7}{'pairs/s':>10}{'batches/s':>11}{'training waits':>16}{'batches ready':>15}")
    for run in report.runs:
        waiting = f"{run.waiting:.0%}" if run.workers else "-"
        ready = f"{run.ready_batches:.1f}" if run.workers else "-"
        print(f"{run.workers:7}{run.pairs_per_second:10.1f}{run.pairs_per_second / options.batch_size:11.2f}{waiting:>16}{ready:>15}")
    print()


def _take(stream: ZeroStereoStream, epoch: int, index: int, count: int) -> list[StereoBatch]:
    """`count` pairs from a place on, over the end of the epoch if need be."""
    size = stream.epoch_size(epoch)
    if index >= size:
        raise ValueError(f"--first-index {index}: epoch {epoch} of these sources has samples 0 to {size - 1}, one per photo")
    stream.load_state_dict({**stream.state_dict(), "epoch": epoch, "samples": index})
    pairs: list[StereoBatch] = []
    with Progress(total=count, desc="making pairs", unit="pair", disable=None) as bar:
        while len(pairs) < count:
            for pair in stream:
                pairs.append(pair)
                bar.update()
                if len(pairs) == count:
                    break
    return pairs


def _several(count: int, noun: str, nouns: str = "") -> str:
    return f"{count:,} {noun if count == 1 else nouns or noun + 's'}"


def _megabytes(count: int) -> str:
    return f"{count / 1e6:,.1f} MB"


def _printable(text: str) -> str:
    """One line, with what no terminal should be sent (control characters, undecodable bytes of file names) written out."""
    text = text.replace("\n", " ")
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)
