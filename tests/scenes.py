"""Small photos, tars and estimators that the tests are made of."""

from __future__ import annotations

import io
import tarfile
from pathlib import Path

import cv2
import numpy as np
import torch
from torch import Tensor

SHARED = Path(__file__).resolve().parents[1] / ".." / "shared"


def photo(seed: int, height: int = 120, width: int = 160) -> np.ndarray:
    """A smooth random photo, uint8 [H, W, 3]."""
    generator = np.random.default_rng(seed)
    coarse = generator.integers(0, 256, (6, 8, 3)).astype(np.float32)
    fine = generator.normal(0, 12, (height, width, 3))
    return np.clip(
        cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC) + cv2.GaussianBlur(fine, (0, 0), 1.2) * 3, 0, 255
    ).astype(np.uint8)


def jpeg(image: np.ndarray) -> bytes:
    return cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 95])[1].tobytes()


def png(image: np.ndarray) -> bytes:
    return cv2.imencode(".png", image[..., ::-1])[1].tobytes()


def npy(values: np.ndarray) -> bytes:
    stream = io.BytesIO()
    np.save(stream, values, allow_pickle=values.dtype.hasobject)
    return stream.getvalue()


def grey16(values: np.ndarray) -> bytes:
    """A PNG of one channel, as deep as its values."""
    return cv2.imencode(".png", values)[1].tobytes()


def write_tar(path: Path, members: dict[str, bytes]) -> str:
    with tarfile.open(path, "w", format=tarfile.USTAR_FORMAT) as archive:
        for name, data in members.items():
            info = tarfile.TarInfo(name)
            info.size = len(data)
            archive.addfile(info, io.BytesIO(data))
    return str(path)


def photo_tar(path: Path, count: int, first_seed: int = 0, **size: int) -> str:
    return write_tar(path, {f"{first_seed + i:06d}.jpg": jpeg(photo(first_seed + i, **size)) for i in range(count)})


def layered_depth(images: Tensor) -> Tensor:
    """A cheap estimator for tests of everything but depth: a ground plane with blocks on it where the photo is bright."""
    height = images.shape[-2]
    plane = torch.linspace(0.1, 0.6, height).view(1, 1, height, 1)
    return plane + 0.4 * (images[:, 1:2] > 140).float()


def grey_fill(right: Tensor, inpaint_mask: Tensor, generators: list[np.random.Generator]) -> Tensor:
    """A cheap inpainter that draws: one grey level per sample."""
    levels = torch.tensor([generator.uniform(0, 255) for generator in generators], dtype=torch.float32)
    return levels.view(-1, 1, 1, 1).expand_as(right)


def shifted_pairs(folder):
    """A folder of two pairs of photos, shifted by 4 and 6 px, as evaluation reads it."""
    for name, shift in (("near", 6), ("far", 4)):
        (folder / name).mkdir(parents=True)
        wide = photo(shift, 64, 96 + shift)
        cv2.imwrite(str(folder / name / "left.png"), wide[:, :96])
        cv2.imwrite(str(folder / name / "right.png"), wide[:, shift:])
        np.save(folder / name / "disp.npy", np.full((64, 96), shift, np.float32))
    return folder
