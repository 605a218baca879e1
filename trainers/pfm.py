"""PFM, the format of floating point maps: a header in letters, then rows from the bottom up in either byte order."""

from __future__ import annotations

import re

import numpy as np

_HEADER = re.compile(rb"(P[fF])\s+(\d{1,9})\s+(\d{1,9})\s+([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)[ \t\r]*\n")


def parse_pfm(content: bytes) -> np.ndarray:
    """The values as they are stored, upright: float32, [H, W], or [H, W, 3] of a file in colour.

    Raises:
        ValueError: no PFM file, or cut off.
    """
    header = _HEADER.match(content)
    if header is None:
        raise ValueError("does not begin as a PFM file does (Pf, width, height, scale)")
    kind, width, height, scale = header[1], int(header[2]), int(header[3]), float(header[4])
    channels = 3 if kind == b"PF" else 1
    values = content[header.end() :]
    if len(values) != 4 * width * height * channels:
        raise ValueError(f"holds {len(values):,} of the {4 * width * height * channels:,} bytes of {width} x {height} values")
    stored = np.frombuffer(values, "<f4" if scale < 0 else ">f4").reshape(height, width, channels)[::-1].astype(np.float32)
    return stored if channels == 3 else stored[..., 0]
