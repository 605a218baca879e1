"""Trains IGEV-Stereo on pairs that are made while it trains.

accelerate launch trainers/igev.py --sources photos.tar --backbone-weights mobilenetv2_100.safetensors --output runs/first
accelerate launch trainers/igev.py --sources photos.tar --output runs/first --resume runs/first
"""

from __future__ import annotations

import argparse
from pathlib import Path

import torch

from trainers.arguments import add_training_arguments, labels_are_trusted, run, train_as_told
from trainers.models.igev_stereo import IGEVStereo
from trainers.models.mobilenet import load_imagenet_weights
from trainers.training_loss import TrainingLoss


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add_training_arguments(parser)
    model = parser.add_argument_group("IGEV-Stereo (defaults as published)")
    model.add_argument(
        "--hidden-dims",
        type=int,
        metavar="N",
        nargs=3,
        default=(128, 128, 128),
        help="channels of the GRUs, coarsest first (default: 128 128 128)",
    )
    model.add_argument("--corr-levels", type=int, metavar="N", default=2, help="levels of the lookup's pyramids (default: 2)")
    model.add_argument("--corr-radius", type=int, metavar="N", default=4, help="of the lookup (default: 4)")
    model.add_argument("--n-gru-layers", type=int, default=3, choices=(1, 2, 3), help="default: 3")
    model.add_argument(
        "--max-disp", type=int, metavar="N", default=192, help="what the cost volume covers, in pixels, a multiple of 32 (default: 192)"
    )
    model.add_argument("--slow-fast-gru", action="store_true", help="update coarse GRUs more often")
    model.add_argument(
        "--backbone-weights",
        type=Path,
        metavar="FILE",
        help="timm's mobilenetv2_100, trained on ImageNet, which the published training starts from",
    )
    model.add_argument(
        "--max-supervised-disparity",
        type=float,
        default=192,
        metavar="PX",
        help="larger labels do not supervise; 700 for the starred version in the paper (default: 192)",
    )
    arguments = parser.parse_args()

    names = ("hidden_dims", "corr_levels", "corr_radius", "n_gru_layers", "max_disp", "slow_fast_gru")
    options = {name: getattr(arguments, name) for name in names}
    torch.manual_seed(arguments.seed)  # the fresh weights
    matcher = IGEVStereo(**options)
    if arguments.backbone_weights is not None:
        load_imagenet_weights(matcher.feature, arguments.backbone_weights)
    loss = TrainingLoss(name=arguments.loss, trusted=labels_are_trusted(arguments), max_disparity=arguments.max_supervised_disparity)
    train_as_told(arguments, matcher, loss, "igev_stereo", options)


if __name__ == "__main__":
    run(main)
