"""Sources as a command line names them."""

import math

import pytest

from zsdata.sources import ImageSource, parse_sources


@pytest.mark.parametrize(
    "url", ["/data/year=2020/a.tar", "./year=2020/a.tar", "s3://b/c=d.tar", "https://host/get?id=1", "https://user:a=b@host/x.tar"]
)
def test_a_sign_behind_a_slash_is_part_of_the_url(url):
    assert parse_sources([url]) == [url]
    assert parse_sources([f"in={url}"]) == {"in": ImageSource(url)}


def test_a_path_that_exists_is_taken_as_it_is(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "year=2020").mkdir()
    (tmp_path / "year=2020" / "a.tar").touch()
    assert parse_sources(["year=2020/a.tar", "year=2020"]) == ["year=2020/a.tar", "year=2020"]
    assert parse_sources(["year=2021/a.tar"]) == {"year": ImageSource("2021/a.tar")}


@pytest.mark.parametrize(
    "url", ["s3://b/x@y/z.tar", "hf://datasets/o/r@0123abc/x.tar", "https://user:secret@host/x.tar", "photos@home.tar", "a.tar@", "5"]
)
def test_a_weight_is_a_number_behind_the_last_at_sign(url):
    assert parse_sources([f"in={url}"]) == {"in": ImageSource(url)}
    for weight in (0.7, 2.0, 1e-3, -1.0, math.inf):  # which of them can be used is said where they are
        assert parse_sources([f"in={url}@{weight}"]) == {"in": ImageSource(url, weight)}


def test_what_is_refused_is_shown_without_secrets():
    url = "https://user:secret@host/x.tar?token=secret"
    for specs, shown in (
        ([f"in={url}"] * 2, "in=https://host/x.tar"),
        (["in=a.tar", url], "https://host/x.tar"),
        ([f"={url}"], "=https://"),
    ):
        with pytest.raises(ValueError, match="a named source is NAME=URL or NAME=URL@WEIGHT") as caught:
            parse_sources(specs)
        assert f"got '{shown}" in str(caught.value) and "secret" not in str(caught.value)
