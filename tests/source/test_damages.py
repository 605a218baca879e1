"""A shard that is damaged anywhere: what comes out of it is whole, and what does not come out is reported.

A photo counts as reported where a problem names its key, or where a problem of the shard lies between the photo that was delivered before
it and the one that was delivered after it.
"""

import tarfile
from functools import cache

import numpy as np
import pytest

from zsdata.faults import BadPhoto, BadShard
from zsdata.source.archive import Problem
from zsdata.source.index import write_index
from zsdata.source.manifest import build_manifest
from zsdata.source.photo import decode_rgb

from .images import encode, png
from .test_tar import write_tar

FORMATS = (tarfile.USTAR_FORMAT, tarfile.GNU_FORMAT, tarfile.PAX_FORMAT)
INNER = write_tar([("inner.png", png([b"\0\1\2"] * 3, 1, 8, 2)), ("more.png", b"no")])


@cache
def shard(number, kinds=("PNG",)):
    """Photos with sidecars, long and odd names, an archive in the archive and an empty member."""
    generator = np.random.default_rng([1, number])
    entries = []
    for index in range(6):
        image = generator.integers(0, 256, (int(generator.integers(1, 25)), 20, 3)).astype(np.uint8)
        kind = kinds[index % len(kinds)]
        name = ("x" * 60 + "/" + "y" * 60 + f"/{index}", f"{index}", f"é/{index}")[generator.integers(3)]
        entries.append((f"{name}.{kind.lower()}", encode(image, kind)))
        if index % 2:
            entries.append((f"{name}.txt", b"a caption" * int(generator.integers(3))))
    entries.insert(5, ("inner.tar", INNER))
    data = write_tar(entries, FORMATS[number % 3])
    photos = [(name.rpartition(".")[0], body) for name, body in entries if name.endswith(tuple(kind.lower() for kind in kinds))]
    return data, photos


def damage(data, generator):
    """One flip, cut, insertion, loss or overwritten stretch; and where it is."""
    place = int(generator.integers(len(data)))
    length = int(2 ** generator.uniform(0, 12))
    kind = generator.integers(6)
    if kind == 0:
        return data[:place] + bytes([data[place] ^ 1 << int(generator.integers(8))]) + data[place + 1 :], "flip"
    if kind == 1:
        return data[:place], "cut"
    if kind == 2:
        return data[:place] + generator.bytes(length) + data[place:], "insert"
    if kind == 3:
        return data[:place] + data[place + length :], "lose"
    if kind == 4:
        place, length = place // 512 * 512, -(-length // 512) * 512
    length = min(length, len(data) - place)
    return data[:place] + bytes(length) + data[place + length :], "zero"


def long_names(data):
    """Where the text of the long names is, which a tar protects by no checksum."""
    position = 0
    while any(data[position : position + 512]):
        header = tarfile.TarInfo.frombuf(data[position : position + 512], "utf-8", "surrogateescape")
        if header.type in (tarfile.GNUTYPE_LONGNAME, tarfile.XHDTYPE):
            yield position + 512, position + 512 + header.size
        position += 512 + -(-header.size // 512) * 512


def changes_a_letter_of_a_name(data, damaged):
    place = next((place for place, (old, new) in enumerate(zip(data, damaged, strict=True)) if old != new), 0)
    return any(start <= place < end for start, end in long_names(data))


def deliver(path):
    """The photos as a stream gets them, with their offsets, and every problem."""
    try:
        manifest = build_manifest(path)
    except ValueError as error:  # not one photo is left
        return [], [Problem(str(path), None, 0, str(error))]
    photos, problems = [], list(manifest.problems)
    for index in range(len(manifest)):
        member = manifest.member(index)
        try:
            data = manifest.read(index)
            decode_rgb(data)
            photos.append((member.offset, member.key, data))
        except BadPhoto as fault:
            problems.append(Problem(member.shard_url, member.key, member.offset, fault.reason))
        except BadShard as fault:
            problems.append(Problem(member.shard_url, None, fault.offset, fault.reason))
    return photos, problems


def unreported(photos, delivered, problems):
    """The keys that are neither delivered nor reported; asserts that what is delivered was there, in order and untouched."""
    assert [(key, data) for _, key, data in delivered] == [photo for photo in photos if photo[0] in {key for _, key, _ in delivered}]
    missing, named = [], {problem.key for problem in problems}
    places = {key: offset for offset, key, _ in delivered}
    for index, (key, _) in enumerate(photos):
        before = max((places[other] for other, _ in photos[:index] if other in places), default=-1)
        after = min((places[other] for other, _ in photos[index + 1 :] if other in places), default=float("inf"))
        between = any(problem.key is None and before < problem.offset < after for problem in problems)
        if key not in places and key not in named and not between:
            missing.append(key)
    return missing


def zeroed_up_to_the_end(data, damaged, photos):
    """The photos of which nothing is left, header included, up to an end that looks like any other."""
    rest = len(damaged.rstrip(b"\0"))
    return [key for key, photo in photos if data.index(photo) - 512 >= rest]


def check_damages(tmp_path, first, count):
    lost = {}
    for number in range(first, first + count):
        generator = np.random.default_rng([2, number])
        data, photos = shard(number % 30)
        damaged, kind = damage(data, generator)
        path = tmp_path / "s.tar"
        path.write_bytes(damaged)
        delivered, problems = deliver(path)
        if kind == "flip" and changes_a_letter_of_a_name(data, damaged):
            assert {body for _, _, body in delivered} <= {body for _, body in photos}
            continue
        missing = unreported(photos, delivered, problems)
        if missing:
            assert kind == "zero" and missing == zeroed_up_to_the_end(data, damaged, photos), (number, kind, missing, problems)
        lost[kind] = lost.get(kind, 0) + len(photos) - len(delivered)
    return lost


def test_of_random_damages_none_loses_a_photo_in_silence_or_makes_one_up(tmp_path):
    lost = check_damages(tmp_path, 0, 300)
    assert all(lost[kind] for kind in ("flip", "cut", "insert", "lose", "zero"))


@pytest.mark.slow
def test_of_ten_thousand_damages_none_loses_a_photo_in_silence_or_makes_one_up(tmp_path):
    check_damages(tmp_path, 0, 10_000)


@pytest.mark.parametrize("number", range(3), ids=["ustar", "gnu", "pax"])
def test_a_cut_at_every_byte_leaves_whole_photos_and_is_reported(number, tmp_path):
    data, photos = shard(number)
    end = max(data.index(photo) + len(photo) for _, photo in photos)
    step = 1 if number == 0 else 13
    for cut in range(0, end, step):
        path = tmp_path / "s.tar"
        path.write_bytes(data[:cut])
        delivered, problems = deliver(path)
        assert problems and not unreported(photos, delivered, problems)


def test_with_an_index_no_changed_byte_passes_whatever_the_format(tmp_path):
    """Flips and zeros that leave size and time as they were, as failing disks do."""
    import os

    for number in range(60):
        generator = np.random.default_rng([3, number])
        data, photos = shard(number % 3, ("JPEG", "WEBP", "PNG"))
        path = tmp_path / f"{number}.tar"
        path.write_bytes(data)
        write_index(path)
        before = os.stat(path)
        damaged = data
        while len(damaged) != len(data) or damaged == data:
            damaged, _ = damage(data, generator)
        path.write_bytes(damaged)
        os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns))
        delivered, problems = deliver(path)
        assert not unreported(photos, delivered, problems)
        changed = [key for key, photo in photos if photo not in damaged]
        assert {problem.key for problem in problems} == set(changed)
        assert len(delivered) == len(photos) - len(changed)
