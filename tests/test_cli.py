"""The `zsdata` command: what it prints, what it writes, how it ends."""

import errno
import gzip
import os
import shlex
import signal
import subprocess
import sys
import time
import warnings

import cv2
import numpy as np
import pytest

import zsdata
from zsdata import cli
from zsdata.example_photos import EXAMPLE_PHOTOS
from zsdata.exported import load_exported, read_exported
from zsdata.faults import WorkerLost
from zsdata.source.archive import read_shard

from .scenes import grey_fill, jpeg, layered_depth, photo, photo_tar, write_tar


@pytest.fixture
def cheap(monkeypatch):
    """Cheap stand-ins behind "builtin"."""
    monkeypatch.setattr(cli, "load_depth", lambda name: layered_depth)
    monkeypatch.setattr(cli, "load_inpainter", lambda name: grey_fill)


@pytest.fixture
def run(capsys):
    """Runs a command in this process: exit status, stdout, stderr."""

    def run(*arguments):
        try:
            status = cli.main([str(argument) for argument in arguments])
        except SystemExit as stop:  # argparse
            status = stop.code
        return (status, *capsys.readouterr())

    return run


@pytest.fixture
def folder(tmp_path):
    """A folder "holiday" of three photos."""
    (tmp_path / "holiday").mkdir()
    for i in range(3):
        (tmp_path / "holiday" / f"{i}.jpg").write_bytes(jpeg(photo(i)))
    return tmp_path / "holiday"


def in_words(error):
    """The one line on stderr that an error of the user is told in."""
    assert error.startswith("zsdata: ") and error.count("\n") == 1 and error.endswith("\n")
    return error


def command(*arguments, **options):
    return subprocess.Popen(
        [sys.executable, "-m", "zsdata", *map(str, arguments)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONUNBUFFERED": "1"},
        **options,
    )


def test_help_explains_each_command_with_an_example(run):
    status, out, _ = run("--help")
    assert status == 0
    for name in ("pack", "example", "verify", "preview", "bench", "export"):
        assert f"\n    {name} " in out
        status, of_command, _ = run(name, "--help")
        assert status == 0
        assert f"Example: zsdata {name} " in of_command
    assert "(default: 1000)" in run("pack", "--help")[1]


def test_the_examples_in_the_help_are_commands_that_parse(run):
    for name in ("pack", "example", "verify", "preview", "bench", "export"):
        example = run(name, "--help")[1].partition("Example: zsdata ")[2]
        assert cli._parser().parse_args(shlex.split(example)).run is not None


def test_version(run):
    assert run("--version") == (0, f"zsdata {zsdata.__version__}\n", "")


@pytest.mark.parametrize("arguments", [[], ["pakc"], ["pack", "x", "y", "--photos-per-shard", "0"], ["preview", "--sources", "a.tar"]])
def test_wrong_usage_is_status_2(run, arguments):
    status, out, error = run(*arguments)
    assert (status, out) == (2, "")
    assert "usage: zsdata" in error and "zsdata" in error.splitlines()[-1]


def test_pack_says_what_it_packed_and_what_to_do_next(run, folder, tmp_path):
    status, out, error = run("pack", folder, tmp_path / "my shards", "--photos-per-shard", 2)
    assert (status, error) == (0, "")
    assert "packed 3 photos" in out and "2 shards" in out and "skipped" not in out
    assert [key for i in range(2) for key, _ in read_shard(f"{tmp_path}/my shards/holiday-00000{i}.tar")] == ["0", "1", "2"]
    following = shlex.split(out.splitlines()[-1].partition("zsdata ")[2])
    assert cli._parser().parse_args(following).sources == [str(tmp_path / "my shards")]


def test_pack_lists_what_it_skipped_but_not_without_end(run, folder, tmp_path):
    for i in range(23):
        (folder / f"bad {i:02d}.jpg").write_bytes(b"<html>")
    status, out, _ = run("pack", folder, tmp_path / "shards")
    assert status == 0
    lines = out.splitlines()
    start = lines.index("skipped 23:")
    assert lines[start + 1] == "  bad 00.jpg: not a JPEG, PNG or WebP: HTML or XML"
    assert lines[start + 20].startswith("  bad 19.jpg") and lines[start + 21] == "  ... and 3 more"


def test_what_pack_packs_verify_finds_good(run, folder, tmp_path):
    (folder / "icon.jpg").write_bytes(jpeg(photo(0, 16, 16)))
    status, out, _ = run("pack", folder, tmp_path / "shards")
    assert status == 0 and "packed 3 photos" in out and "  icon.jpg: too small: a side shorter than 32 px: 16x16" in out
    assert run("verify", tmp_path / "shards")[0] == 0


def test_pack_refuses_in_words(run, folder, tmp_path):
    status, out, error = run("pack", tmp_path / "missing", tmp_path / "shards")
    assert (status, out) == (2, "") and "missing is not a folder" in in_words(error)
    (tmp_path / "empty").mkdir()
    status, _, error = run("pack", tmp_path / "empty", tmp_path / "shards")
    assert status == 2 and "no photo to pack" in in_words(error)
    status, _, error = run("pack", folder, folder)
    assert status == 2 and "is the folder of photos itself" in in_words(error)


def test_pack_replaces_shards_only_when_told_to(run, folder, tmp_path):
    assert run("pack", folder, tmp_path / "shards")[0] == 0
    (folder / "more.jpg").write_bytes(jpeg(photo(9)))
    status, _, error = run("pack", folder, tmp_path / "shards")
    assert status == 2 and "holiday-000000.tar" in in_words(error) and "--overwrite" in error
    status, out, _ = run("pack", folder, tmp_path / "shards", "--overwrite")
    assert status == 0 and "packed 4 photos" in out
    photo_tar(tmp_path / "shards" / "foreign.tar", count=1)
    status, _, error = run("pack", folder, tmp_path / "shards", "--overwrite")
    assert status == 2 and "foreign.tar" in in_words(error) and "(--overwrite)" not in error


def test_names_that_a_terminal_must_not_be_sent_are_written_out(run, folder, tmp_path):
    (folder / "evil\x1b[2Jname.jpg").write_bytes(b"")
    with open(os.fsencode(folder) + b"/\xff.jpg", "wb"):
        pass
    status, out, _ = run("pack", folder, tmp_path / "shards")
    assert status == 0
    assert "\\x1b[2Jname.jpg: empty file" in out and "\\udcff.jpg: empty file" in out and "\x1b" not in out


def test_the_example_photos_become_a_shard(run, tmp_path):
    pytest.importorskip("skimage")
    status, out, error = run("example", tmp_path / "shards")
    assert (status, error) == (0, "") and f"packed {len(EXAMPLE_PHOTOS)} photos" in out and "skipped" not in out
    keys = [key for key, _ in read_shard(str(tmp_path / "shards" / "example-000000.tar"))]
    assert keys == [name.partition(".")[0] for name in EXAMPLE_PHOTOS]
    assert run("verify", tmp_path / "shards")[0] == 0


def test_without_scikit_image_the_example_names_what_to_install(run, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "skimage", None)
    status, _, error = run("example", tmp_path / "shards")
    assert status == 2 and 'pip install "zsdata[demo]"' in in_words(error)
    assert not (tmp_path / "shards").exists()


def test_verify_is_content_with_good_shards(run, tmp_path):
    shard = photo_tar(tmp_path / "a.tar", count=3)
    assert run("verify", shard) == (0, f"all is well: 3 good photos in 1 shard, {os.path.getsize(shard) / 1e6:.1f} MB\n", "")


def test_verify_lists_every_problem(run, tmp_path):
    good = jpeg(photo(0))
    first = write_tar(tmp_path / "a.tar", {"0.jpg": good, "1.jpg": good[:999], "2.jpg": good, "tiny.jpg": jpeg(photo(0, 8, 8))})
    second = tmp_path / "b.tar"
    second.write_bytes(b"\x1f\x8b" + bytes(700))
    status, out, error = run("verify", first, second)
    assert (status, error) == (1, "")
    cut, tiny, damaged, summary = out.splitlines()
    assert cut.startswith(f'{first} "1": truncated')
    assert tiny.startswith(f'{first} "tiny": too small')
    assert damaged.startswith(f"{second} at byte 0: compressed with gzip")
    assert summary.startswith("3 problems (") and "2 good photos in 2 shards" in summary


def test_verify_of_nothing_is_status_2(run, tmp_path):
    status, out, error = run("verify", tmp_path / "{000..009}.tar")
    assert (status, out) == (2, "") and "000.tar" in in_words(error)
    status, out, _ = run("verify", "memory://cli/none.tar")
    assert status == 2 and "memory://cli/none.tar at byte 0: cannot be read" in out
    shard = photo_tar(tmp_path / "a.tar", count=1)
    assert run("verify", "memory://cli/none.tar", shard)[0] == 1


def test_index_lists_once_and_says_what_is_wrong(run, tmp_path):
    shard = photo_tar(tmp_path / "a.tar", count=3)
    size = f"{os.path.getsize(shard) / 1e6:.1f} MB"
    assert run("index", shard) == (0, f"3 photos in 1 shard, {size}: 1 index written, 0 up to date\n", "")
    assert run("index", shard) == (0, f"3 photos in 1 shard, {size}: 0 indexes written, 1 up to date\n", "")
    assert (tmp_path / "a.tar.index.json").exists()
    twice = write_tar(tmp_path / "b.tar", {"0.jpg": jpeg(photo(0)), "0.jpeg": jpeg(photo(1))})
    status, out, _ = run("index", twice)
    assert status == 1 and '"0": duplicate key' in out and "1 problem" in out


def test_decompress_makes_shards(run, tmp_path):
    photo_tar(tmp_path / "a.tar", count=2)
    plain = (tmp_path / "a.tar").read_bytes()
    (tmp_path / "packed.tar.gz").write_bytes(gzip.compress(plain))
    assert run("decompress", tmp_path / "packed.tar.gz", tmp_path / "shards") == (0, f"{tmp_path / 'shards' / 'packed.tar'}\n", "")
    assert (tmp_path / "shards" / "packed.tar").read_bytes() == plain
    status, out, error = run("decompress", tmp_path / "packed.tar.gz", tmp_path / "shards")
    assert (status, out) == (2, "") and "or allow to overwrite (--overwrite)" in in_words(error)


@pytest.mark.usefixtures("cheap")
def test_preview_draws_the_pairs_that_training_sees(run, tmp_path):
    shard = photo_tar(tmp_path / "a.tar", count=4)
    sheet = tmp_path / "preview.png"
    status, out, error = run(
        "preview", "--sources", shard, "--output", sheet, "--pairs", 2, "--size", 96, 128, "--first-index", 1, "--seed", 5
    )
    assert (status, error) == (0, "") and str(sheet) in out and "2 pairs" in out
    image = cv2.imread(str(sheet))[..., ::-1]
    stream = zsdata.ZeroStereoStream(shard, size=(96, 128), depth=layered_depth, inpaint=grey_fill, seed=5)
    for index in (1, 2):
        assert shows(image, stream.replay(0, index).left) and shows(image, stream.replay(0, index).right)
    assert not shows(image, stream.replay(0, 0).left)


@pytest.mark.usefixtures("cheap")
def test_preview_goes_on_with_the_next_epoch(run, tmp_path):
    shard = photo_tar(tmp_path / "a.tar", count=2)
    status, out, _ = run(
        "preview", "--sources", shard, "--output", tmp_path / "p.png", "--pairs", 4, "--size", 64, 64, "--epoch", 7, "--clean"
    )
    assert status == 0 and "from epoch 7, index 0 to epoch 8, index 1" in out
    stream = zsdata.ZeroStereoStream(shard, size=(64, 64), depth=layered_depth, inpaint=grey_fill)
    image = cv2.imread(str(tmp_path / "p.png"))[..., ::-1]
    assert shows(image, stream.replay(8, 1).left_clean)


@pytest.mark.usefixtures("cheap")
def test_preview_says_which_photos_were_replaced(run, tmp_path):
    shard = write_tar(tmp_path / "a.tar", {"bad.jpg": b"<html>", "good.jpg": jpeg(photo(0))})
    status, out, _ = run("preview", "--sources", shard, "--output", tmp_path / "p.png", "--pairs", 2, "--size", 64, 64)
    assert status == 0 and "replaced: not a JPEG, PNG or WebP: 1" in out


@pytest.mark.usefixtures("cheap")
def test_preview_refuses_in_words_and_leaves_no_file(run, tmp_path):
    shard = photo_tar(tmp_path / "a.tar", count=2)
    useless = write_tar(tmp_path / "b.tar", {"0.jpg": b"<html>", "1.jpg": b""})
    before = sorted(tmp_path.iterdir())
    for arguments, expected in (
        (["--sources", shard, "--output", tmp_path / "p.jpg"], "ends in .png"),
        (["--sources", shard, "--output", tmp_path / "missing" / "p.png"], "missing is not a folder"),
        (["--sources", tmp_path / "none.tar", "--output", tmp_path / "p.png"], "none.tar"),
        (["--sources", shard, "--output", tmp_path / "p.png", "--first-index", 2], "samples 0 to 1"),
        (["--sources", shard, "--output", tmp_path / "p.png", "--size", 8, 8], "32 or more"),
        (["--sources", useless, "--output", tmp_path / "p.png"], "no usable photo"),
    ):
        status, out, error = run("preview", *arguments)
        assert (status, out) == (2, "") and expected in in_words(error)
    assert sorted(tmp_path.iterdir()) == before


@pytest.mark.usefixtures("cheap")
def test_a_full_disk_leaves_the_old_preview_and_nothing_else(run, tmp_path, monkeypatch):
    shard, sheet = photo_tar(tmp_path / "a.tar", count=1), tmp_path / "p.png"
    sheet.write_bytes(b"old")

    def replace(source, target):
        raise OSError(28, "No space left on device", source)

    monkeypatch.setattr(cli.os, "replace", replace)
    status, _, error = run("preview", "--sources", shard, "--output", sheet, "--pairs", 1, "--size", 64, 64)
    assert status == 2 and in_words(error).endswith(": No space left on device\n")
    assert sheet.read_bytes() == b"old" and sorted(path.name for path in tmp_path.iterdir()) == ["a.tar", "p.png"]


@pytest.mark.usefixtures("cheap")
def test_export_writes_a_pair_per_photo_and_goes_on_where_it_stopped(run, tmp_path):
    shard = photo_tar(tmp_path / "a.tar", count=3)
    export = ("export", "--sources", shard, "--output", tmp_path / "my pairs", "--size", 64, 96, "--seed", 5)
    status, out, error = run(*export)
    assert (status, error) == (0, "") and out.startswith(f"{tmp_path}/my pairs: 3 pairs (") and "already" not in out
    stream = zsdata.ZeroStereoStream(shard, size=(64, 96), depth=layered_depth, inpaint=grey_fill, seed=5)
    for index, entry in enumerate(read_exported(tmp_path / "my pairs")):
        pair = load_exported(entry)
        assert np.array_equal(pair.right, stream.replay(0, index).right_clean.round().byte().permute(1, 2, 0).numpy())
    status, out, _ = run(*export, "--workers", 1)
    assert status == 0 and out.endswith(", 3 of them already there\n")


@pytest.mark.usefixtures("cheap")
def test_export_makes_pairs_of_whole_photos_unless_told_a_size(run, tmp_path):
    shard = photo_tar(tmp_path / "a.tar", count=1, height=70, width=90)
    assert run("export", "--sources", shard, "--output", tmp_path / "out")[0] == 0
    assert load_exported(read_exported(tmp_path / "out")[0]).left.shape == (70, 90, 3)
    status, _, error = run("export", "--sources", shard, "--output", tmp_path / "out", "--size", 64, 64)
    assert status == 2 and "size was null and is [64, 64]" in in_words(error)


@pytest.mark.usefixtures("cheap")
def test_export_says_which_photos_were_replaced(run, tmp_path):
    shard = write_tar(tmp_path / "a.tar", {"bad.jpg": b"<html>", "good.jpg": jpeg(photo(0))})
    status, out, _ = run("export", "--sources", shard, "--output", tmp_path / "out", "--size", 64, 64)
    assert status == 0 and "2 pairs" in out and "replaced: not a JPEG, PNG or WebP: 1" in out


@pytest.mark.usefixtures("cheap")
def test_export_refuses_in_words(run, tmp_path):
    shard, output = photo_tar(tmp_path / "a.tar", count=1), tmp_path / "out"
    small = ("--size", 64, 64)
    assert run("export", "--sources", shard, "--output", output, *small)[0] == 0
    (tmp_path / "other" / "left").mkdir(parents=True)
    before = sorted(tmp_path.rglob("*"))
    for arguments, expected in (
        (["--output", output, "--size", 96, 64], "size was [64, 64] and is [96, 64]"),
        (["--output", output, *small, "--pairs", 2], "pairs was 1 and is 2"),
        (["--output", output, *small, "--depth", "other"], 'depth was "builtin" and is "other"'),
        (["--output", output, *small, "--inpaint", "other"], 'inpaint was "builtin" and is "other"'),
        (["--output", tmp_path / "other", *small], "holds left, which no export made"),
        (["--output", shard, *small], "a.tar is not a folder"),
        (["--output", tmp_path / "new", "--size", 8, 8], "32 or more"),
        (["--output", tmp_path / "new", "--sources", tmp_path / "none.tar"], "none.tar"),
    ):
        status, out, error = run("export", "--sources", shard, *arguments)
        assert (status, out) == (2, "") and expected in in_words(error)
    assert sorted(tmp_path.rglob("*")) == before


def test_an_export_that_is_killed_goes_on_to_the_same_bytes(tmp_path):
    shard = photo_tar(tmp_path / "a.tar", count=12)
    arguments = ("export", "--sources", shard, "--size", 64, 96, "--workers", 1, "--output")
    process = command(*arguments, tmp_path / "killed")
    filelist, deadline = tmp_path / "killed" / "filelist.txt", time.monotonic() + 60
    while not (filelist.exists() and filelist.read_bytes()):
        assert process.poll() is None and time.monotonic() < deadline
        time.sleep(0.005)
    process.kill()
    process.wait()  # its worker may live a little longer
    for pipe in (process.stdout, process.stderr):
        assert pipe is not None
        pipe.close()
    lines = filelist.read_text().splitlines(keepends=True)
    assert 0 < len(lines) < 12 and all((tmp_path / "killed" / name).is_file() for line in lines for name in line.split())
    for folder in ("killed", "unbroken"):
        out, _ = command(*arguments, tmp_path / folder).communicate()
        assert "12 pairs" in out and ("already there" in out) == (folder == "killed")
    trees = [
        {path.relative_to(tmp_path / folder): path.read_bytes() for path in (tmp_path / folder).rglob("*") if path.is_file()}
        for folder in ("killed", "unbroken")
    ]
    assert trees[0] == trees[1]


@pytest.mark.filterwarnings("always")
def test_a_warning_is_told_in_words(run, tmp_path, monkeypatch):
    def depth(images):
        warnings.warn("only for trying out", stacklevel=1)
        return layered_depth(images)

    monkeypatch.setattr(cli, "load_depth", lambda name: depth)
    monkeypatch.setattr(cli, "load_inpainter", lambda name: grey_fill)
    shard, shown = photo_tar(tmp_path / "a.tar", count=1), warnings.showwarning
    status, _, error = run("preview", "--sources", shard, "--output", tmp_path / "p.png", "--pairs", 1, "--size", 64, 64)
    assert status == 0 and set(error.splitlines()) == {"zsdata: only for trying out"}
    assert warnings.showwarning is shown


def test_a_failure_inside_keeps_its_traceback(tmp_path, monkeypatch):
    monkeypatch.setattr(cli, "load_depth", lambda name: lambda images: images / 0 + "no depth")
    monkeypatch.setattr(cli, "load_inpainter", lambda name: grey_fill)
    shard = photo_tar(tmp_path / "a.tar", count=1)
    with pytest.raises(RuntimeError, match="sample 0 of epoch 0") as raised:
        cli.main(["preview", "--sources", shard, "--output", str(tmp_path / "p.png")])
    assert isinstance(raised.value.__cause__, TypeError)


@pytest.mark.parametrize(
    ("error", "told"),
    [
        (WorkerLost("worker 0 of 1 was killed"), "worker 0 of 1 was killed"),
        (MemoryError(), "memory ran out; fewer workers"),
        (MemoryError("no memory to decode a photo"), "no memory to decode a photo"),
    ],
)
def test_a_lost_worker_and_memory_that_ran_out_are_told_in_words(run, tmp_path, monkeypatch, error, told):
    def fail(*given, **more):
        raise error

    monkeypatch.setattr(cli, "verify", fail)
    status, out, said = run("verify", tmp_path)
    assert (status, out) == (2, "") and in_words(said).startswith(f"zsdata: {told}")


@pytest.mark.parametrize(
    ("cause", "told"),
    [
        (OSError(errno.ENOSPC, "No space left on device"), "failed: No space left on device"),
        (ValueError("no such depth"), "failed: no such depth"),
        (MemoryError(), "failed: memory ran out; fewer workers"),
    ],
)
def test_a_sample_that_failed_for_what_the_user_can_mend_is_told_in_words(run, tmp_path, monkeypatch, cause, told):
    def depth(images):
        raise cause

    monkeypatch.setattr(cli, "load_depth", lambda name: depth)
    monkeypatch.setattr(cli, "load_inpainter", lambda name: grey_fill)
    shard = photo_tar(tmp_path / "a.tar", count=1)
    status, out, error = run("preview", "--sources", shard, "--output", tmp_path / "p.png")
    assert (status, out) == (2, "") and in_words(error).startswith("zsdata: sample 0 of epoch 0 ") and told in error


def test_python_m_zsdata_is_the_command(folder, tmp_path):
    process = command("pack", folder, tmp_path / "shards", cwd=tmp_path)
    out, error = process.communicate()
    assert (process.returncode, error) == (0, "") and "packed 3 photos" in out
    process = command("pack", tmp_path / "missing", tmp_path / "shards")
    out, error = process.communicate()
    assert (process.returncode, out) == (2, "") and in_words(error)


def test_an_interrupt_is_told_in_words(tmp_path):
    slow = jpeg(np.full((2000, 2000, 3), 99, np.uint8))
    shard = write_tar(tmp_path / "a.tar", {"bad.jpg": b"", **{f"{i}.jpg": slow for i in range(400)}})
    # A shell starts what runs in its background with Ctrl-C ignored, and tests may run there.
    process = command("verify", shard, preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL))
    assert process.stdout is not None
    assert "empty file" in process.stdout.readline()
    process.send_signal(signal.SIGINT)
    _, error = process.communicate()
    assert (process.returncode, error) == (130, "zsdata: interrupted\n")


def test_a_reader_that_has_enough_ends_the_command_quietly(tmp_path):
    shard = write_tar(tmp_path / "a.tar", {f"{i}.jpg": b"" for i in range(3000)})
    process = command("verify", shard)
    assert process.stdout is not None and process.stderr is not None
    assert "empty file" in process.stdout.readline()
    process.stdout.close()
    error = process.stderr.read()
    assert (process.wait(), error) == (141, "")
    process.stderr.close()


def shows(sheet, image):
    """Whether an image, float [3, H, W], is somewhere on the sheet, pixel by pixel."""
    wanted = (image.permute(1, 2, 0) + 0.5).byte().numpy()
    height, width = wanted.shape[:2]
    _, _, (x, y), _ = cv2.minMaxLoc(cv2.matchTemplate(np.ascontiguousarray(sheet), wanted, cv2.TM_SQDIFF))
    return np.array_equal(sheet[y : y + height, x : x + width], wanted)
