"""What does a matcher learn in ten minutes from photographs alone? Bad-2 before and after, pair by pair, beside SGBM.

python benchmarks/ten_minutes.py --model raft --sources shards --output runs/ten-minutes-raft
python benchmarks/ten_minutes.py --model igev --sources shards --stereo DIR --output runs/ten-minutes-igev -- --workers 14 --depth-cache DIR

Nothing is downloaded: fresh weights, built-in depth and inpainting. A short run shows how many pairs a second this machine trains on; then
the matcher is trained for as many steps as fit into --minutes, with the paper's defaults, and on a GPU in bf16, compiled and with channels
last. Evaluation comes on top. What stands after -- goes to the trainer. --output keeps the checkpoints, the logs and scores.json.
"""

from __future__ import annotations

import argparse
import json
import statistics
import subprocess
import sys
from pathlib import Path
from typing import Any

import torch

from trainers.evaluate import evaluate
from trainers.sgbm import sgbm
from trainers.validation import EvaluationSet

TRAINERS = Path(__file__).resolve().parents[1] / "trainers"
FAST = ("--mixed-precision", "bf16", "--compile", "--channels-last")
STEADY_LINES = 3  # of the short run's log, the last ones: the first steps compile


def train(model: str, output: Path, *options: object) -> list[dict[str, Any]]:
    """Runs the trainer, and returns its log."""
    command = [sys.executable, TRAINERS / f"{model}.py", "--output", output, *options]
    print("$", *command, flush=True)
    subprocess.run([*map(str, command)], check=True)
    return read_lines(output / "log.jsonl")


def read_lines(path: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in path.read_text().splitlines()]


def classical_scores(specs: list[str]) -> dict[str, dict[str, float]]:
    """SGBM's bad-2 of each pair of each set."""
    sets = [EvaluationSet.parse(spec) for spec in specs]
    return {one.name: {scores["name"]: scores["all"]["bad_2"] for scores in evaluate(sgbm, one.pairs()[0])} for one in sets}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--model", choices=("raft", "igev"), required=True)
    parser.add_argument("--sources", nargs="+", required=True, metavar="URL", help="tars of photos, as `zsdata pack` makes them")
    parser.add_argument(
        "--stereo", type=Path, nargs="*", default=[], metavar="DIR", help="folders of pairs to judge by, besides the Motorcycle"
    )
    parser.add_argument("--output", type=Path, required=True, metavar="DIR", help="a new folder")
    parser.add_argument("--minutes", type=float, default=9.0, metavar="X", help="of training (default: 9)")
    parser.add_argument("--pace-steps", type=int, default=60, metavar="N", help="of the short run (default: 60)")
    words = sys.argv[1:]
    split = words.index("--") if "--" in words else len(words)
    arguments, more = parser.parse_args(words[:split]), words[split + 1 :]
    if arguments.output.exists():
        parser.error(f"--output is a new folder; {arguments.output} is there already")
    options = ["--sources", *arguments.sources, *(FAST if torch.cuda.is_available() else ()), *more]
    sets = ["motorcycle", *map(str, arguments.stereo)]
    classical = classical_scores(sets)

    pace = train(arguments.model, arguments.output / "pace", *options, "--steps", arguments.pace_steps)
    rate = statistics.median(line["pairs_per_second"] for line in pace[-STEADY_LINES:])
    state = json.loads(next((arguments.output / "pace").glob("checkpoints/*/state.json")).read_text())
    a_step = int(state["arguments"]["batch_size"]) * int(state["arguments"]["accumulate"]) * state["world_size"]
    steps = max(2, round(60 * arguments.minutes * rate / a_step))
    print(f"{rate:.1f} pairs/s: {steps} steps of {a_step} pairs in {arguments.minutes:g} minutes", flush=True)

    folder = arguments.output / "run"
    train(arguments.model, folder, *options, "--steps", steps, "--evaluate", *sets, "--evaluate-first")
    evaluations = read_lines(folder / "evaluations.jsonl")
    before, after = evaluations[0]["bad_2_by_pair"], evaluations[-1]["bad_2_by_pair"]

    rows = []
    for name, pairs in classical.items():
        rows += [
            (f"{name}/{pair}" if pair != name else name, value, before[name][pair], after[name][pair]) for pair, value in pairs.items()
        ]
        values = [list(scores[name].values()) for scores in (classical, before, after)]
        if len(pairs) > 1:
            rows.append((f"{name}, mean over pairs ({len(pairs)})", *map(statistics.fmean, values)))
    width = max(len(row[0]) for row in rows)
    print(f"{'bad-2, %':{width}}{'SGBM':>9}{'before':>9}{'after':>9}")
    for name, *values in rows:
        print(f"{name:{width}}" + "".join(f"{100 * value:9.2f}" for value in values))
    device = torch.cuda.get_device_name() if torch.cuda.is_available() else "cpu"
    report = {"model": arguments.model, "device": device, "steps": steps, "pairs_per_second": rate, "evaluations": evaluations}
    (arguments.output / "scores.json").write_text(json.dumps(report | {"sgbm": classical}, indent=2) + "\n")


if __name__ == "__main__":
    main()
