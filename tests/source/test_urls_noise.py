"""Any text as a specification of shards: urls or an error in words, nothing else."""

import os

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from zsdata.source.urls import base_name, expand_urls, local_path, shown_url, without_secrets

PARTS = """
    .. 000..003 a,b {a,b} {0..2} {z..x..2} {01..03} s-0 .tar .gz // :: pipe: http:// https://host/ file:// s3:// gs:// hf:// memory://
    simplecache:: user:secret@ ?token=x é
"""
pieces = st.sampled_from([*"{}[],*?~/.:;|&$@#%-\\ \0\n\udcff0", *PARTS.split()])
specs = st.one_of(st.lists(pieces, max_size=9).map("".join), st.text(max_size=30))


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("noise")
    for number in range(3):
        (folder / f"s-{number}.tar").touch()
    return folder


@given(specs)
@settings(max_examples=600)
def test_any_specification_gives_urls_or_an_error_in_words(folder, spec):
    before = os.getcwd()
    os.chdir(folder)
    try:
        urls = expand_urls(spec)
    except (ValueError, FileNotFoundError) as error:
        assert str(error)
    else:
        assert urls and len(set(urls)) == len(urls)
        assert all(isinstance(url, str) and not url.startswith("pipe:") for url in urls)
        assert all(path is None or os.path.isfile(path) for path in map(local_path, urls))
    finally:
        os.chdir(before)


@given(specs)
def test_what_is_shown_of_a_url_holds_no_user_and_no_query(text):
    assert isinstance(base_name(text), str) and isinstance(without_secrets(text), str)
    for secret in (
        "https://user:secret@host/a.tar",
        "https://host/a.tar?token=secret",
        "https://host/a.tar?x=" + text.replace("\n", "") + "secret",
    ):
        assert "secret" not in shown_url(secret)


@pytest.mark.parametrize("spec", [None, 5, 5.0, b"a.tar", {"a.tar"}, [None], [b"a.tar"], [["a.tar"]], iter(["a.tar"])])
def test_what_is_no_text_is_an_error_in_words(spec):
    with pytest.raises(TypeError):
        expand_urls(spec)
