"""A folder of photographs to shards and back."""

import gc
import os
import tarfile
import warnings
from pathlib import Path

import numpy as np
import pytest
import webdataset

from zsdata.source.archive import read_shard
from zsdata.source.index import write_index
from zsdata.source.manifest import build_manifest
from zsdata.source.pack import pack
from zsdata.source.photo import decode_rgb, usable_photo
from zsdata.source.verify import verify

from .images import encode, picture


def fill(folder, *paths, kind="JPEG"):
    photos = {}
    for number, path in enumerate(paths):
        photos[path] = encode(picture(20 + number, 30), kind)
        (folder / path).parent.mkdir(parents=True, exist_ok=True)
        (folder / path).write_bytes(photos[path])
    return photos


@pytest.fixture
def photos(tmp_path):
    return tmp_path / "photos"


def contents(report):
    return [item for shard in report.shards for item in read_shard(shard)]


def test_bytes_come_back_unchanged_in_the_order_of_their_paths(photos, tmp_path):
    files = fill(photos, "b.jpg", "a/2.jpeg", "a/10.JPG", "é/ü.jpg", "Z.jpg", "a.b/c.jpg")
    report = pack(photos, tmp_path / "shards", photos_per_shard=4)
    assert report.shards == [str(tmp_path / "shards" / f"photos-00000{number}.tar") for number in range(2)]
    assert (report.photos, report.skipped) == (6, [])
    assert report.bytes == sum(os.path.getsize(shard) for shard in report.shards)
    keys = ["Z", "a.b/c", "a/10", "a/2", "b", "é/ü"]
    assert contents(report) == [(key, files[path]) for key, path in zip(keys, sorted(files, key=os.fsencode), strict=True)]
    assert len(build_manifest(tmp_path / "shards")) == 6
    assert {path: (photos / path).read_bytes() for path in files} == files


def test_the_same_photos_give_the_same_bytes_anywhere(photos, tmp_path):
    fill(photos, "b.jpg", "a/" + "long" * 40 + ".jpg", "c.jpg")
    other = tmp_path / "elsewhere" / "photos"
    fill(other, "b.jpg", "a/" + "long" * 40 + ".jpg", "c.jpg")
    os.utime(other / "b.jpg", (1, 1))
    os.chmod(other / "c.jpg", 0o600)
    first, second = pack(photos, tmp_path / "1"), pack(other, tmp_path / "2")
    read = [Path(shard).read_bytes() for report in (first, second) for shard in report.shards]
    assert len(read) == 2 and read[0] == read[1]
    with tarfile.open(first.shards[0]) as tar:
        assert {(member.mtime, member.uid, member.gid, member.mode, member.uname) for member in tar} == {(0, 0, 0, 0o644, "")}


def test_webdataset_reads_the_shards(photos, tmp_path):
    files = fill(photos, *(f"{number:03d}.jpg" for number in range(5)), "x/" + "long" * 40 + ".jpg")
    report = pack(photos, tmp_path / "shards", photos_per_shard=3)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ResourceWarning)  # webdataset leaves its files to the garbage collector
        samples = list(webdataset.WebDataset(report.shards, shardshuffle=False).decode("rgb8"))
        gc.collect()
    assert [sample["__key__"] for sample in samples] == [path.removesuffix(".jpg") for path in sorted(files)]
    for sample, path in zip(samples, sorted(files), strict=True):
        assert np.abs(sample["jpg"].astype(int) - decode_rgb(files[path])).max() <= 3


def test_dots_and_equal_names_give_keys_of_their_own(photos, tmp_path):
    fill(photos, "a.b.jpg", "a_b.jpg", "a_b_2.jpg", "c.jpg", "d.e/f.g.jpg")
    files = fill(photos, "c.png", kind="PNG")
    report = pack(photos, tmp_path / "shards")
    assert [key for key, _ in contents(report)] == ["a_b", "a_b_2", "a_b_2_2", "c", "c_2", "d.e/f_g"]
    assert dict(contents(report))["c_2"] == files["c.png"]
    assert not build_manifest(tmp_path / "shards").problems


def test_the_extension_is_that_of_the_content(photos, tmp_path):
    fill(photos, "a.jpg", "b.jfif", kind="PNG")
    fill(photos, "c.png", kind="WEBP")
    with tarfile.open(pack(photos, tmp_path / "shards").shards[0]) as tar:
        assert tar.getnames() == ["a.png", "b.png", "c.webp"]


def test_what_cannot_be_used_is_left_out_and_listed(photos, tmp_path):
    files = fill(photos, "good.jpg", "cut.jpg")
    (photos / "cut.jpg").write_bytes(files["cut.jpg"][:-9])
    fill(photos, "scan.tif", kind="TIFF")
    (photos / "empty.png").touch()
    (photos / "gone.jpg").symlink_to("nowhere.jpg")
    os.mkfifo(photos / "pipe.jpg")
    for other in ("notes.txt", ".hidden.jpg", "._good.jpg"):
        (photos / other).write_bytes(b"no photo")
    (photos / "folder.jpg").mkdir()
    report = pack(photos, tmp_path / "shards")
    assert contents(report) == [("good", files["good.jpg"])]
    assert report.skipped == [
        ("cut.jpg", "truncated: a JPEG without its end"),
        ("empty.png", "empty file"),
        ("gone.jpg", "not a file, or a link to nothing"),
        ("pipe.jpg", "not a file, or a link to nothing"),
        ("scan.tif", "not a JPEG, PNG or WebP: TIFF"),
    ]


def test_files_that_are_no_photos_by_their_names_are_counted_by_extension(photos, tmp_path):
    """Downloads without an extension are photos that their owner would miss."""
    fill(photos, "a.jpg", "12345", "below/678", "b.jpg.1")
    for other in ("notes.txt", ".hidden", "Thumbs.db", "__MACOSX"):
        (photos / other).write_bytes(b"no photo")
    report = pack(photos, tmp_path / "shards")
    assert (report.photos, report.passed_over) == (1, {"no extension": 2, ".1": 1, ".txt": 1, ".db": 1})
    with pytest.raises(
        ValueError, match=r"no photo to pack in .* JPEG, PNG or WebP file; passed over by their names: 1 with no extension$"
    ):
        pack(photos / "below", tmp_path / "other")


@pytest.mark.parametrize("extension", ["cr3", "raf", "ORF", "rw2", "pef", "srw", "mpo"])
def test_photos_of_every_camera_maker_are_packed_or_listed(photos, tmp_path, extension):
    fill(photos, "a.jpg")
    (photos / f"b.{extension}").write_bytes(b"raw")
    assert pack(photos, tmp_path / "shards").skipped == [(f"b.{extension}", "not a JPEG, PNG or WebP: unknown format")]


def test_photos_with_a_side_too_short_are_left_out_where_a_limit_is_given(photos, tmp_path):
    files = fill(photos, "good.jpg")  # 20 x 30
    (photos / "icon.png").write_bytes(encode(picture(16, 30), "PNG"))
    np.save(photos / "icon.depth.npy", np.ones((16, 30), np.float32))
    assert pack(photos, tmp_path / "all").photos == 2
    report = pack(photos, tmp_path / "shards", shortest_side_px=20)
    assert contents(report) == [("good", files["good.jpg"])]
    assert report.skipped == [
        ("icon.png", "too small: a side shorter than 20 px: 30x16"),
        ("icon.depth.npy", "a depth map whose photo is not packed"),
    ]
    assert not verify(tmp_path / "shards", shortest_side_px=20).problems and verify(tmp_path / "all", shortest_side_px=20).problems


def test_links_are_read_through_but_not_round_in_circles(photos, tmp_path):
    files = fill(tmp_path / "real", "a.jpg", "below/b.jpg")
    photos.mkdir()
    (photos / "link.jpg").symlink_to(tmp_path / "real" / "a.jpg")
    (photos / "folder").symlink_to(tmp_path / "real" / "below")
    (photos / "self").symlink_to(photos)
    assert contents(pack(photos, tmp_path / "shards")) == [("folder/b", files["below/b.jpg"]), ("link", files["a.jpg"])]


def test_the_output_may_lie_in_the_folder_and_is_not_packed(photos):
    fill(photos, "a.jpg", "shards/old.jpg")
    assert [key for key, _ in contents(pack(photos, photos / "shards"))] == ["a"]
    assert [key for key, _ in contents(pack(photos, photos / "shards", overwrite=True))] == ["a"]


def test_the_output_is_not_the_folder_of_photos_itself(photos, tmp_path):
    fill(photos, "a.jpg")
    (tmp_path / "link").symlink_to(photos)
    for output in (photos, photos / ".", tmp_path / "link"):
        with pytest.raises(ValueError, match="is the folder of photos itself; choose another one for the shards"):
            pack(photos, output)
    assert [path.name for path in photos.iterdir()] == ["a.jpg"]


def test_existing_shards_are_kept_unless_told_otherwise(photos, tmp_path):
    fill(photos, *"abcde")  # no extension: no photos
    fill(photos, *(f"{letter}.jpg" for letter in "abcde"))
    output = tmp_path / "shards"
    pack(photos, output, photos_per_shard=2)
    assert len(list(output.iterdir())) == 3
    before = {path: path.read_bytes() for path in output.iterdir()}
    with pytest.raises(FileExistsError, match=r"already holds photos-000000.tar; choose another folder"):
        pack(photos, output)
    assert {path: path.read_bytes() for path in output.iterdir()} == before
    report = pack(photos, output, overwrite=True)
    assert [str(path) for path in output.iterdir()] == report.shards and report.photos == 5


def test_the_shards_of_another_folder_are_never_replaced(photos, tmp_path):
    fill(photos, "a.jpg")
    output = tmp_path / "shards"
    output.mkdir()
    (output / "other-000000.tar").write_bytes(b"mine")
    with pytest.raises(FileExistsError, match=r"other-000000.tar, which is no shard of 'photos'"):
        pack(photos, output, overwrite=True)
    assert (output / "other-000000.tar").read_bytes() == b"mine"


def test_a_pack_that_fails_leaves_nothing_behind(photos, tmp_path, monkeypatch):
    fill(photos, "a.jpg", "b.jpg", "c.jpg")
    output = tmp_path / "shards"
    whole = pack(photos, output)
    before = Path(whole.shards[0]).read_bytes()

    def fail(data, shortest_side_px, seen=[]):  # noqa: B006
        seen.append(1)
        if len(seen) == 3:
            raise KeyboardInterrupt
        return usable_photo(data, shortest_side_px)

    monkeypatch.setattr("zsdata.source.pack.usable_photo", fail)
    with pytest.raises(KeyboardInterrupt):
        pack(photos, output, photos_per_shard=1, overwrite=True)
    assert [path.name for path in output.iterdir()] == ["photos-000000.tar"]
    assert Path(whole.shards[0]).read_bytes() == before


def test_a_link_in_the_output_is_not_written_through(photos, tmp_path):
    fill(photos, "a.jpg")
    output = tmp_path / "shards"
    output.mkdir()
    (tmp_path / "precious").write_bytes(b"keep")
    (output / "photos-000000.tar.partial").symlink_to(tmp_path / "precious")
    pack(photos, output)
    assert (tmp_path / "precious").read_bytes() == b"keep"
    assert not (output / "photos-000000.tar").is_symlink()


def test_bad_arguments_are_errors_with_their_cure(photos, tmp_path):
    with pytest.raises(NotADirectoryError, match="pack takes a folder of photographs"):
        pack(tmp_path / "missing", tmp_path / "shards")
    photos.mkdir()
    (photos / "a.jpg").write_bytes(b"<html>")
    with pytest.raises(ValueError, match=r"no photo to pack in .*; a.jpg: not a JPEG, PNG or WebP: HTML or XML"):
        pack(photos, tmp_path / "shards")
    with pytest.raises(ValueError, match="at least 1, got 0"):
        pack(photos, tmp_path / "shards", photos_per_shard=0)
    (tmp_path / "file").touch()
    with pytest.raises(NotADirectoryError, match="is not a folder; pack writes its shards into a folder"):
        pack(photos, tmp_path / "file")


def test_names_that_are_no_text_survive(photos, tmp_path):
    photos.mkdir()
    data = encode(picture())
    with open(os.path.join(os.fsencode(photos), b"\xff\xfe.jpg"), "wb") as file:
        file.write(data)
    ((key, packed),) = contents(pack(photos, tmp_path / "shards"))
    assert os.fsencode(key) == b"\xff\xfe" and packed == data


def test_packing_anew_drops_the_indexes_of_what_was_there(tmp_path):
    folder = tmp_path / "photos"
    fill(folder, "a.jpg")
    (shard,) = pack(folder, tmp_path / "shards").shards
    write_index(shard)
    assert Path(f"{shard}.index.json").exists()
    pack(folder, tmp_path / "shards", overwrite=True)
    assert not Path(f"{shard}.index.json").exists()
