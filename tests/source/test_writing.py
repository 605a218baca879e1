"""What cannot be written is named, and none of it stays."""

import gzip
import os
import resource
from contextlib import contextmanager

import pytest

from trainers import run_folder
from zsdata.export import write_whole
from zsdata.rejected import RejectedFile
from zsdata.source.compressed import decompress
from zsdata.source.pack import pack

from .images import encode, picture
from .test_tar import write_tar


@contextmanager
def small_disk():
    """No file can grow beyond 4 KiB: refused as on a full disk. Nor can that which pytest prints to: nothing else belongs inside."""
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (4096, limits[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)


@pytest.fixture
def photos(tmp_path):
    (tmp_path / "photos").mkdir()
    for number in range(3):
        (tmp_path / "photos" / f"{number}.png").write_bytes(encode(picture(80 + number, 90), "PNG"))
    (tmp_path / "a.tar.gz").write_bytes(gzip.compress(write_tar([("a.jpg", os.urandom(9000))])))


@pytest.mark.parametrize(
    ("write", "name"),
    [
        (lambda folder: pack(folder / "photos", folder / "out"), "photos-000000.tar.partial"),
        (lambda folder: decompress(folder / "a.tar.gz", folder / "out"), "a.tar."),
        (lambda folder: write_whole(folder / "out" / "left.jpg", bytes(9000)), "left.jpg"),
    ],
)
def test_a_file_that_the_disk_has_no_room_for_is_named_and_removed(photos, tmp_path, write, name):
    (tmp_path / "out").mkdir()
    with pytest.raises(OSError, match="too large") as raised, small_disk():
        write(tmp_path)
    assert name in str(raised.value.filename)
    assert list((tmp_path / "out").iterdir()) == []


@pytest.mark.parametrize(
    ("append", "line"),
    [
        (lambda path: run_folder.append(path, {"step": 1}), '{"step": 1}\n'),
        (lambda path: RejectedFile(path).add([{"replaced": [("a", "b", "c", "d")], "epoch": 0, "index": 0}]), '{"source": "a"'),
    ],
)
def test_a_list_that_the_disk_has_no_room_for_is_named(tmp_path, append, line):
    path = tmp_path / "list.jsonl"
    append(path)
    assert path.read_text().startswith(line)
    path.write_bytes(bytes(4096))
    with pytest.raises(OSError, match="too large") as raised, small_disk():
        append(path)
    assert str(raised.value.filename) == str(path)
