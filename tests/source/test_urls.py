"""From what a user writes to the list of shards."""

from pathlib import Path

import pytest

from zsdata.source.urls import _names_in, base_name, expand_urls, lasting_url, local_path, shown_url, without_secrets


@pytest.fixture
def folder(tmp_path):
    for number in range(12):
        (tmp_path / f"s-{number:02d}.tar").write_bytes(b"")
    (tmp_path / "notes.txt").write_text("no shard")
    (tmp_path / ".s-99.tar").write_bytes(b"")
    return tmp_path


def named(folder, *numbers):
    return [f"{folder}/s-{number:02d}.tar" for number in numbers]


def test_braces_expand_in_order(folder):
    assert expand_urls(f"{folder}/s-{{00..11}}.tar") == named(folder, *range(12))
    assert expand_urls(f"{folder}/s-{{03,01}}.tar") == named(folder, 3, 1)


def test_a_glob_and_a_folder_are_sorted(folder):
    assert expand_urls(f"{folder}/*.tar") == expand_urls(str(folder)) == expand_urls(folder) == named(folder, *range(12))


def test_a_list_keeps_its_order(folder):
    assert expand_urls([folder / "s-05.tar", f"{folder}/s-0{{1,0}}.tar"]) == named(folder, 5, 1, 0)


def test_a_path_that_exists_is_taken_as_it_is(tmp_path):
    odd = tmp_path / "s-{0..1}[*].tar"
    odd.write_bytes(b"")
    assert expand_urls(odd) == [str(odd)]


@pytest.mark.parametrize("url", ["http://host/s-{00..01}.tar?x=1", "memory://a/s-{00..01}.tar"])
def test_remote_urls_pass_with_their_braces_expanded(url):
    assert expand_urls(url) == [url.replace("{00..01}", "00"), url.replace("{00..01}", "01")]


def test_file_urls_are_local(folder):
    url = f"file://{folder}/s-00.tar"
    assert expand_urls(url) == [url] and local_path(url) == f"{folder}/s-00.tar"
    with pytest.raises(FileNotFoundError):
        expand_urls(f"file://{folder}/missing.tar")


@pytest.mark.parametrize("url", ["pipe:cat x.tar", "{pipe:curl x,a.tar}", Path("pipe:cat x.tar")])
def test_pipe_urls_are_refused_by_name(url):
    with pytest.raises(ValueError, match=r"pipe: urls run shell commands.* always refused; name the tar itself"):
        expand_urls(url)


@pytest.mark.parametrize(
    ("spec", "error", "says"),
    [
        ("a.tar::b.tar", ValueError, '"::" is not supported; give a list'),
        ("simplecache::http://host/a.tar", ValueError, '"::" is not supported'),
        ("nonsense://host/a.tar", ValueError, "fsspec"),
        ("http://host/*.tar", ValueError, "globs find local shards only"),
        ("http:///a.tar", ValueError, "'http:///a.tar' has no host"),
        ("https://host:99999/a.tar?token=1", ValueError, "'https://host:99999/a.tar' has no host, or no port that exists"),
        ("http://[::1/a.tar", ValueError, "has no host"),
        ("http://a..b/a.tar", ValueError, "has no host"),
        ("s-{00..11.tar", ValueError, "unbalanced braces"),
        ("", ValueError, "empty"),
        ([], ValueError, "at least one tar"),
        (7, TypeError, "got 7"),
        (b"a.tar", TypeError, "got b'a.tar'"),
        ([b"a.tar"], TypeError, "got b'a.tar'"),
        ("missing.tar", FileNotFoundError, "missing.tar does not exist; check the path"),
        ("missing-*.tar", FileNotFoundError, "matches no file; check the pattern"),
        ("/dev/null", ValueError, "neither a file nor a folder"),
    ],
)
def test_a_bad_specification_is_an_error_with_its_cure(spec, error, says):
    with pytest.raises(error, match=says):
        expand_urls(spec)


def test_a_missing_shard_of_a_range_is_named(folder):
    with pytest.raises(FileNotFoundError, match=r"s-12.tar \(from '.*s-\{00..12\}.tar'\) does not exist; check .* the range"):
        expand_urls(f"{folder}/s-{{00..12}}.tar")


def test_a_folder_without_tars_says_what_to_do(tmp_path):
    with pytest.raises(FileNotFoundError, match="zsdata pack"):
        expand_urls(tmp_path)
    (tmp_path / "a.tar.gz").write_bytes(b"")
    with pytest.raises(FileNotFoundError, match="gunzip"):
        expand_urls(tmp_path)


def test_a_shard_named_twice_is_an_error(folder):
    for twice in (f"{folder}/./s-03.tar", f"file://{folder}/s-03.tar"):
        with pytest.raises(ValueError, match=r"s-03.tar is named twice"):
            expand_urls([folder, twice])


def test_an_address_of_numbers_is_no_chain_of_file_systems():
    assert expand_urls("http://[::1]:8000/a.tar") == ["http://[::1]:8000/a.tar"]


@pytest.mark.parametrize(
    ("url", "shown"),
    [
        ("https://user:pw@host:8080/a/b.tar?X-Amz-Signature=secret&x=/y@z#part", "https://host:8080/a/b.tar"),
        ("http://host?token=a@b", "http://host"),
        ("ftp://user:p@w@host/b.tar", "ftp://host/b.tar"),
        ("s3://bucket/what?.tar", "s3://bucket/what?.tar"),
        ("hf://datasets/a/b@main/c.tar", "hf://datasets/a/b@main/c.tar"),
        ("/local/user@host/a?b.tar", "/local/user@host/a?b.tar"),
    ],
)
def test_a_shown_url_has_no_secrets(url, shown):
    assert shown_url(url) == shown
    assert without_secrets(f"cannot open '{url}' (or {url})") == f"cannot open '{shown}' (or {shown})"


def test_a_message_about_an_address_has_no_secrets():
    for urls in (["https://h/a.tar?token=secret"] * 2, "https://u:secret@h/*.tar?a=secret"):
        with pytest.raises(ValueError, match=r"https://h/") as caught:
            expand_urls(urls)
        assert "secret" not in str(caught.value)


@pytest.mark.parametrize("spec", ["htps://user:secret@host/a.tar?token=secret", "simplecache::https://user:secret@host/a.tar?token=secret"])
def test_an_address_of_no_known_kind_is_told_without_secrets(spec):
    with pytest.raises(ValueError, match=r"host/a\.tar'") as caught:
        expand_urls(spec)
    assert "secret" not in str(caught.value)


@pytest.mark.parametrize(
    ("url", "lasting"),
    [
        ("https://host/get?id=1", "https://host/get?id=1"),
        ("https://u:pw@host/get?id=2&X-Amz-Signature=1&x-amz-date=2&expires=3&part=4#5", "https://host/get?id=2&part=4"),
        ("https://host/a.tar?GoogleAccessId=1&Expires=2&Signature=3", "https://host/a.tar"),
        ("https://host/a.tar?Policy=1&Key-Pair-Id=2&Signature", "https://host/a.tar"),
        ("https://host/a.tar?sv=1&st=2024-01-01T00:00:00Z&se=2024-01-02T00%3A00%3A00Z&sig=2", "https://host/a.tar?sv=1"),
        ("https://host/a.tar?st=1&access_token=2&tokens=3", "https://host/a.tar?st=1&tokens=3"),
        ("s3://bucket/a.tar?versionId=1", "s3://bucket/a.tar?versionId=1"),
        ("hf://model@main/a.tar", "hf://model@main/a.tar"),
    ],
)
def test_what_signs_a_url_does_not_name_the_shard(url, lasting):
    assert lasting_url(url) == lasting


def test_the_name_of_a_shard_has_no_folder_and_no_token():
    assert base_name("/a/b/c.tar") == base_name("https://h/x/c.tar?token=1#2") == base_name("s3://bucket/c.tar") == "c.tar"


MANY = [
    "a/{0..99999999}.tar",
    "a/{000..999}/{00000..99999}.tar",
    "{-9999999999999999..9}.tar",
    "{0..99999999..2}.tar",
    "s3://b/{0..99999999999999999999}.tar",
    "s3://b/{0.." + "9" * 5_000 + "}.tar",
    "s3://b/" + "{a,b}" * 21,
    "s3://b/" + "{a..z}" * 5,
    "s3://b/{" + "{a,b}" * 30 + "}",
]


@pytest.mark.parametrize("spec", MANY, ids=range(len(MANY)))
def test_a_range_of_too_many_shards_is_refused_at_once(spec):
    with pytest.raises(ValueError, match=r"stands for .* shards, more than 1,000,000") as caught:
        expand_urls(spec)
    assert len(str(caught.value)) < 300


@pytest.mark.parametrize(
    ("spec", "count"),
    [
        ("{x{0000..1999},y{0000..1999}}.tar", 4_000),
        ("{a,b{c,d}}-{0..9..3}-{a..c}", 3 * 4 * 3),
        ("{only}/{}", 1),
        (r"\{a,b\}{a,b}", 2),
        ("a,b}{1..2}", None),
    ],
)
def test_what_braces_stand_for_is_known_before_they_are_expanded(spec, count):
    if count is None:
        with pytest.raises(ValueError, match="unbalanced braces"):
            expand_urls("s3://b/" + spec)
    else:
        assert len(expand_urls("s3://b/" + spec)) == count == _names_in("s3://b/" + spec)


def test_braces_without_end_in_each_other_are_refused():
    with pytest.raises(ValueError, match="braces in braces, more than 50 deep"):
        expand_urls("{" * 3_000 + "a,b" + "}" * 3_000)
