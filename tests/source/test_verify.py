"""Every shard walked, every photo decoded."""

import os

import pytest

from zsdata.faults import BadPhoto
from zsdata.source.archive import Problem
from zsdata.source.manifest import build_manifest
from zsdata.source.photo import decode_rgb
from zsdata.source.verify import verify

from ..scenes import jpeg, photo, photo_tar, write_tar

PHOTO = jpeg(photo(0))


def test_good_shards_are_counted_and_nothing_is_said(tmp_path, capfd):
    shards = [photo_tar(tmp_path / f"{i}.tar", count=3, first_seed=3 * i) for i in range(2)]
    report = verify(tmp_path)
    assert (report.shards, report.photos, report.problems) == (2, 6, [])
    assert report.bytes == sum((tmp_path / shard).stat().st_size for shard in shards)
    assert capfd.readouterr() == ("", "")


def test_each_problem_is_named_with_its_shard_photo_and_reason(tmp_path):
    members = {
        "good.jpg": PHOTO,
        "cut.jpg": PHOTO[:1000],
        "page.jpg": b"<html>",
        "b.gif": b"GIF89a",
        "good.png": PHOTO,
        "label.txt": b"cat",
    }
    shard = write_tar(tmp_path / "a.tar", members)
    found = []
    report = verify(shard, found.append)
    assert found == report.problems
    assert (report.shards, report.photos) == (1, 1)
    assert [(problem.shard, problem.key) for problem in found] == [(shard, "cut"), (shard, "page"), (shard, "b"), (shard, "good")]
    reasons = [problem.reason.split(":")[0] for problem in found]
    assert reasons == ["truncated", "not a JPEG, PNG or WebP", "not a JPEG, PNG or WebP", "duplicate key"]


def test_the_good_photos_are_those_that_a_stream_can_use(tmp_path):
    members = {f"{i}.jpg": jpeg(photo(i, 40, 40))[: None if i % 3 else 300 * i] for i in range(9)}
    shard = write_tar(tmp_path / "a.tar", members)
    manifest = build_manifest(shard)

    def usable(index):
        try:
            decode_rgb(manifest.read(index))
        except BadPhoto:
            return False
        return True

    report = verify(shard)
    assert report.photos == sum(usable(i) for i in range(len(manifest)))
    assert {problem.key for problem in report.problems} == {manifest.member(i).key for i in range(9) if not usable(i)} != set()


def test_a_damaged_shard_does_not_hide_the_others(tmp_path):
    photo_tar(tmp_path / "1.tar", count=2)
    (tmp_path / "0.tar").write_bytes((tmp_path / "1.tar").read_bytes()[:3000])
    (tmp_path / "2.tar").write_bytes(b"PK\x03\x04" + bytes(600))
    write_tar(tmp_path / "3.tar", {"readme.txt": b"no photos"})
    report = verify([tmp_path / "0.tar", "memory://zsdata-missing.tar", *(tmp_path / f"{i}.tar" for i in (1, 2, 3))])
    assert (report.shards, report.photos) == (5, 2)
    by_shard = {problem.shard.rpartition("/")[2]: problem for problem in report.problems}
    assert "ends inside" in by_shard["0.tar"].reason
    assert by_shard["zsdata-missing.tar"].reason.startswith("cannot be read")
    assert "a zip" in by_shard["2.tar"].reason
    assert by_shard["3.tar"] == Problem(str(tmp_path / "3.tar"), None, 0, "no JPEG, PNG or WebP in it")
    assert len(report.problems) == 4


def test_photos_with_a_side_too_short_are_problems_where_a_limit_is_given(tmp_path):
    shard = write_tar(tmp_path / "a.tar", {"wide.jpg": jpeg(photo(0, 31, 200)), "enough.jpg": jpeg(photo(0, 32, 32))})
    assert verify(shard).photos == 2
    report = verify(shard, shortest_side_px=32)
    assert report.photos == 1
    assert [(problem.key, problem.reason) for problem in report.problems] == [("wide", "too small: a side shorter than 32 px: 200x31")]


def test_nothing_is_verified_where_nothing_is_named(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"missing\.tar"):
        verify(tmp_path / "missing.tar")


def test_the_progress_bar_is_on_stderr_when_asked_for(tmp_path, capsys):
    shards = [photo_tar(tmp_path / f"{number}.tar", count=2) for number in range(2)]
    verify(shards, progress=True)
    out, err = capsys.readouterr()
    assert not out and "verifying" in err and "shard 2 of 2: 1.tar" in err
    verify(shards, progress=False)
    assert capsys.readouterr() == ("", "")


@pytest.mark.timeout(30)
@pytest.mark.parametrize(("make", "says"), [(os.mkdir, "it is a folder"), (os.mkfifo, "it is no regular file")])
def test_what_only_has_the_name_of_a_shard_is_named_and_not_waited_for(tmp_path, make, says):
    photo_tar(tmp_path / "a.tar", count=1)
    make(tmp_path / "b.tar")
    assert verify(tmp_path).problems == [
        Problem(str(tmp_path / "b.tar"), None, 0, f"cannot be read: {says}; a shard is an uncompressed tar")
    ]
    with pytest.raises(OSError, match=f"{says}.*b.tar"):
        build_manifest(tmp_path)
