"""trainers/raft.py, but every rank writes down which samples it trained on; on demand the loss of a rank's batch is NaN.

NAN_AT_RANK and NAN_AT_STEPS (comma-separated) in the environment say where and when.
"""

import json
import os
import sys
from pathlib import Path

import trainers.loop as loop
import trainers.raft as raft
from trainers.training_loss import TrainingLoss

output = Path(sys.argv[sys.argv.index("--output") + 1])
rank = os.environ.get("RANK", "0")
broken = os.environ.get("NAN_AT_STEPS", "").split(",") if os.environ.get("NAN_AT_RANK") == rank else []
calls = 0


class Recording(TrainingLoss):
    def __call__(self, initial, sequence, batch):
        global calls
        loss, metrics = super().__call__(initial, sequence, batch)
        with (output / f"samples-{rank}.jsonl").open("a") as file:
            for meta in batch.meta:
                file.write(json.dumps([meta["epoch"], meta["index"]]) + "\n")
        if str(calls) in broken:
            loss = loss * float("nan")
        calls += 1
        return loss, metrics


loop.LOG_EVERY_STEPS = 1
raft.TrainingLoss = Recording
raft.run(raft.main)
