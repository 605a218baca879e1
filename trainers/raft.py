"""Trains RAFT-Stereo on pairs that are made while it trains.

accelerate launch trainers/raft.py --sources photos.tar --output runs/first
accelerate launch trainers/raft.py --sources photos.tar --output runs/first --resume runs/first
"""

from __future__ import annotations

import argparse

import torch

from trainers.arguments import add_training_arguments, labels_are_trusted, run, train_as_told
from trainers.models import load_matcher
from trainers.models.extractor import NORMS
from trainers.training_loss import TrainingLoss


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add_training_arguments(parser)
    model = parser.add_argument_group("RAFT-Stereo (defaults as published)")
    model.add_argument(
        "--hidden-dims",
        type=int,
        metavar="N",
        nargs=3,
        default=(128, 128, 128),
        help="channels of the GRUs, coarsest first (default: 128 128 128)",
    )
    model.add_argument("--corr-implementation", choices=("reg", "alt"), default="reg", help="alt saves memory, same numbers (default: reg)")
    model.add_argument("--corr-levels", type=int, metavar="N", default=4, help="levels of the correlation pyramid (default: 4)")
    model.add_argument("--corr-radius", type=int, metavar="N", default=4, help="of the lookup (default: 4)")
    model.add_argument("--n-downsample", type=int, default=2, choices=(2, 3), help="features have 1/2^n of the resolution (default: 2)")
    model.add_argument("--context-norm", choices=NORMS, default="batch", help="in the context encoder (default: batch)")
    model.add_argument("--n-gru-layers", type=int, default=3, choices=(1, 2, 3), help="default: 3")
    model.add_argument("--slow-fast-gru", action="store_true", help="update coarse GRUs more often")
    model.add_argument("--shared-backbone", action="store_true", help="one encoder for features and context")
    arguments = parser.parse_args()

    names = (
        "hidden_dims",
        "corr_implementation",
        "corr_levels",
        "corr_radius",
        "n_downsample",
        "context_norm",
        "n_gru_layers",
        "slow_fast_gru",
        "shared_backbone",
    )
    options = {name: getattr(arguments, name) for name in names}
    torch.manual_seed(arguments.seed)  # the fresh weights
    matcher = load_matcher("raft_stereo", **options)
    loss = TrainingLoss(name=arguments.loss, trusted=labels_are_trusted(arguments))
    train_as_told(arguments, matcher, loss, "raft_stereo", options)


if __name__ == "__main__":
    run(main)
