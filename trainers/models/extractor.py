"""The convolutional encoders of RAFT-Stereo: what a pixel looks like, and what surrounds it.

Modules carry the published parameter names; `08`, `16`, `32` in them mean full, half and quarter of the features' resolution.
"""

from __future__ import annotations

from torch import Tensor, nn

NORMS = ("batch", "group", "instance", "none")
TRUNK_CHANNELS = 128


def make_norm(norm: str, channels: int, groups: int) -> nn.Module:
    """One of NORMS; instance norm has no parameters, as published."""
    if norm == "batch":
        return nn.BatchNorm2d(channels)
    if norm == "group":
        return nn.GroupNorm(groups, channels)
    return nn.InstanceNorm2d(channels) if norm == "instance" else nn.Identity()


class ResidualBlock(nn.Module):
    """Two 3x3 convolutions and a shortcut, which is a strided 1x1 convolution where the shape changes."""

    def __init__(self, inputs: int, outputs: int, norm: str, stride: int = 1) -> None:
        super().__init__()
        groups = outputs // 8
        self.conv1 = nn.Conv2d(inputs, outputs, 3, stride=stride, padding=1)
        self.conv2 = nn.Conv2d(outputs, outputs, 3, padding=1)
        self.relu = nn.ReLU(inplace=True)
        self.norm1 = make_norm(norm, outputs, groups)
        self.norm2 = make_norm(norm, outputs, groups)
        if stride == 1 and inputs == outputs:
            self.downsample = nn.Identity()
        else:
            # One norm under two names, as in the published checkpoints; should they differ, the later registered one counts.
            self.norm3 = make_norm(norm, outputs, groups)
            self.downsample = nn.Sequential(nn.Conv2d(inputs, outputs, 1, stride=stride), self.norm3)

    def forward(self, x: Tensor) -> Tensor:
        y = self.relu(self.norm1(self.conv1(x)))
        y = self.relu(self.norm2(self.conv2(y)))
        return self.relu(self.downsample(x) + y)


class Trunk(nn.Module):
    """Images [B, 3, H, W] in -1..1 to features [B, 128, H / 2^downsample, W / 2^downsample]."""

    def __init__(self, norm: str, downsample: int) -> None:
        super().__init__()
        self.norm1 = make_norm(norm, 64, groups=8)
        self.conv1 = nn.Conv2d(3, 64, 7, stride=2 if downsample > 2 else 1, padding=3)
        self.relu1 = nn.ReLU(inplace=True)
        self.layer1 = residual_layer(64, 64, norm)
        self.layer2 = residual_layer(64, 96, norm, stride=2 if downsample > 1 else 1)
        self.layer3 = residual_layer(96, TRUNK_CHANNELS, norm, stride=2 if downsample > 0 else 1)

    def forward(self, images: Tensor) -> Tensor:
        x = self.relu1(self.norm1(self.conv1(images)))
        return self.layer3(self.layer2(self.layer1(x)))


class FeatureEncoder(Trunk):
    """The features that are correlated: [B, 256, h, w]."""

    def __init__(self, downsample: int, outputs: int = 256) -> None:
        super().__init__("instance", downsample)
        self.conv2 = nn.Conv2d(TRUNK_CHANNELS, outputs, 1)
        initialize(self)

    def forward(self, images: Tensor) -> Tensor:
        return self.conv2(super().forward(images))


class ContextEncoder(Trunk):
    """For each GRU level, finest first, its first hidden state and its context, before their activations.

    IGEV-Stereo has the same one under other names of the heads: it counts from the image's resolution.
    """

    def __init__(
        self,
        norm: str,
        downsample: int,
        hidden_dims: tuple[int, int, int],
        names: tuple[str, str, str] = ("outputs08", "outputs16", "outputs32"),
    ) -> None:
        super().__init__(norm, downsample)
        self.names = names
        self.layer4 = residual_layer(TRUNK_CHANNELS, TRUNK_CHANNELS, norm, stride=2)
        self.layer5 = residual_layer(TRUNK_CHANNELS, TRUNK_CHANNELS, norm, stride=2)
        coarse, middle, fine = hidden_dims

        def head(outputs: int) -> nn.Conv2d:
            return nn.Conv2d(TRUNK_CHANNELS, outputs, 3, padding=1)

        def refined_head(outputs: int) -> nn.Sequential:
            return nn.Sequential(ResidualBlock(TRUNK_CHANNELS, TRUNK_CHANNELS, norm), head(outputs))

        # Two heads a level: hidden state and context.
        self.add_module(names[0], nn.ModuleList(refined_head(fine) for _ in range(2)))
        self.add_module(names[1], nn.ModuleList(refined_head(middle) for _ in range(2)))
        self.add_module(names[2], nn.ModuleList(head(coarse) for _ in range(2)))
        initialize(self)

    def heads(self, features: Tensor, levels: int) -> list[list[Tensor]]:
        """[hidden, context] of the first `levels` levels, from the trunk's features."""
        outputs: list[list[Tensor]] = []
        for layer, name in zip((nn.Identity(), self.layer4, self.layer5), self.names, strict=True):
            if len(outputs) < levels:
                features = layer(features)
                outputs.append([head(features) for head in self.get_submodule(name).children()])
        return outputs

    def unused(self, levels: int) -> list[nn.Module]:
        """The modules that `heads` does not touch with so few levels."""
        layers = (self.layer4, self.layer5)[levels - 1 :]
        return [*layers, *(self.get_submodule(name) for name in self.names[levels:])]


def residual_layer(inputs: int, outputs: int, norm: str, stride: int = 1) -> nn.Sequential:
    return nn.Sequential(ResidualBlock(inputs, outputs, norm, stride), ResidualBlock(outputs, outputs, norm))


def initialize(encoder: nn.Module) -> None:
    """He initialisation of the convolutions; norms start as the identity by themselves."""
    for module in encoder.modules():
        if isinstance(module, nn.Conv2d):
            nn.init.kaiming_normal_(module.weight, mode="fan_out", nonlinearity="relu")
