"""A trainer, but every rank writes down which samples it trained on; on demand the loss of some of its batches is broken.

In the environment, TRAINER says which one, raft or igev; BROKEN_RANK and BROKEN_BY say where, and what by: {"number of the batch": factor}.
ENDED_RANK gets SIGTERM in its second step.
"""

import importlib
import json
import os
import signal
import sys
from pathlib import Path

import trainers.loop as loop
import trainers.step_guard as step_guard
from trainers.training_loss import TrainingLoss

trainer = importlib.import_module(f"trainers.{os.environ.get('TRAINER', 'raft')}")
output = Path(sys.argv[sys.argv.index("--output") + 1])
rank = os.environ.get("RANK", "0")
broken_by = json.loads(os.environ["BROKEN_BY"]) if os.environ.get("BROKEN_RANK") == rank else {}
calls = 0


class Recording(TrainingLoss):
    def __call__(self, initial, sequence, batch):
        global calls
        loss, metrics = super().__call__(initial, sequence, batch)
        with (output / f"samples-{rank}.jsonl").open("a") as file:
            for meta in batch.meta:
                file.write(json.dumps([meta["epoch"], meta["index"]]) + "\n")
        calls += 1
        if calls == 2 and os.environ.get("ENDED_RANK") == rank:
            os.kill(os.getpid(), signal.SIGTERM)
        return loss * broken_by.get(str(calls - 1), 1.0), metrics


loop.LOG_EVERY_STEPS = 1
step_guard.FEWEST_STEPS = 1
trainer.TrainingLoss = Recording
trainer.run(trainer.main)
