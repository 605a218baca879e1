"""Five photographs that scikit-image brings along: enough to see a stream at work without photos of one's own."""

from __future__ import annotations

import importlib.util
import os
import shutil
import tempfile
from pathlib import Path

from zsdata.source.pack import PackReport, pack

# The scenes among the images inside scikit-image's wheel; the others are textures, drawings, microscopy and the sky, and the
# motorcycle pair, which is kept for judging what was trained.
EXAMPLE_PHOTOS = ("astronaut.png", "camera.png", "chelsea.png", "coffee.png", "rocket.jpg")


def example_photos() -> list[Path]:
    """Where the example photos lie; nothing is downloaded.

    Raises:
        ImportError: scikit-image is not installed, or came without them.
    """
    package = importlib.util.find_spec("skimage")
    if package is None or package.origin is None:
        raise ImportError('the example photos come with scikit-image, which is not installed; pip install "zsdata[demo]"')
    photos = [Path(package.origin).parent / "data" / name for name in EXAMPLE_PHOTOS]
    for photo in photos:
        if not photo.is_file():
            raise ImportError(f"{photo} is missing; pip install --force-reinstall scikit-image brings it back")
    return photos


def pack_example_photos(output: str | os.PathLike[str], *, overwrite: bool = False, progress: bool | None = None) -> PackReport:
    """Packs the example photos into OUTPUT/example-000000.tar; raises what `example_photos` and `pack` raise."""
    photos = example_photos()
    with tempfile.TemporaryDirectory() as parent:
        folder = Path(parent) / "example"
        folder.mkdir()
        for photo in photos:
            shutil.copyfile(photo, folder / photo.name)
        return pack(folder, output, overwrite=overwrite, progress=progress)
