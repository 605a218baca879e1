"""Which shards a source names: braces, globs and folders to a list of urls."""

from __future__ import annotations

import glob
import math
import os
import re
import reprlib
from collections.abc import Sequence
from dataclasses import dataclass
from urllib.parse import urlsplit

import fsspec
from braceexpand import braceexpand

MOST_SHARDS = 1_000_000  # that one pattern may stand for; more is a slip of the range
MOST_BRACES_DEEP = 50  # one in another
LARGEST_NUMBER = 1e15  # in a range
_NUMBERS = re.compile(r"(-?\d+)\.\.(-?\d+)(?:\.\.-?(\d+))?")
_LETTERS = re.compile(r"([A-Za-z])\.\.([A-Za-z])(?:\.\.-?\d+)?")

_SIGNING = re.compile(  # parts of a query that change at each signing: S3, Google, CloudFront, Alibaba, and the times of Azure
    r"(x-(amz|goog|oss)-.*|signature|sig|expires|policy|key-pair-id|(aws|oss)accesskeyid|googleaccessid|((access|auth)_|security-)?token)(=.*)?"
    r"|sk?[et]=\d{4}-\d\d-\d\dT.*",
    re.IGNORECASE | re.DOTALL,
)

HTTP = ("http", "https")  # the protocols that are spoken here; fsspec speaks the others


def local_path(url: str) -> str | None:
    """The path of a local url (a plain path or file://...), or None for a remote one."""
    if url.startswith("file://"):
        return url[len("file://") :]
    return None if "://" in url else url


def base_name(url: str) -> str:
    """The file name in a url, without folder, host or the query of an http address (which may hold a changing token)."""
    if url.startswith(("http://", "https://")):
        url = url.split("?", 1)[0].split("#", 1)[0]
    return url.rstrip("/").rpartition("/")[2]


def shown_url(url: str) -> str:
    """A url as it may stand in a message: without user, password and the query of an http address, which may hold a token."""
    protocol, separator, rest = url.partition("://")
    if not separator:
        return url
    if protocol in HTTP:
        rest = re.split(r"[?#]", rest, maxsplit=1)[0]
    host, slash, path = rest.partition("/")
    return f"{protocol}://{host.rpartition('@')[2]}{slash}{path}"


def lasting_url(url: str) -> str:
    """What names a shard after each signing of its url: of an http address all but user, password and what signs its query."""
    if url.partition("://")[0] not in HTTP:
        return url
    query = url.partition("#")[0].partition("?")[2]
    lasting = "&".join(part for part in query.split("&") if not _SIGNING.fullmatch(part))
    return shown_url(url) + (f"?{lasting}" if lasting else "")


def without_secrets(text: str) -> str:
    """Another's message, with the urls in it as `shown_url` gives them."""
    return re.sub(r"\b[a-z][a-z0-9+.-]*://[^\s'\"<>)]+", lambda found: shown_url(found[0]), text)


def expand_urls(urls: str | os.PathLike[str] | Sequence[str | os.PathLike[str]]) -> list[str]:
    """The shards that a source names, in a fixed order.

    Args:
        urls: one specification or a sequence of them. A specification is a path; a folder (all its *.tar, sorted); a pattern with braces as
            in webdataset ("shards/{000..099}.tar"); a local glob ("shards/*.tar", sorted); or a url that fsspec can open (http, https, s3,
            gs, hf, file, memory), braces allowed. A local path that exists is taken as it is, whatever characters are in it.

    Raises:
        FileNotFoundError: a local shard is missing, or a folder or glob holds no tar.
        ValueError: nothing is named, a shard is named twice, or the url is of a kind that zsdata does not open (`pipe:`, `::`, unknown).
    """
    if isinstance(urls, (str, os.PathLike)):
        urls = [urls]
    elif not isinstance(urls, Sequence) or isinstance(urls, (bytes, bytearray)):
        raise TypeError(f'urls are a path, a pattern such as "shards/{{000..099}}.tar", or a list of them; got {urls!r}')
    expanded = [url for spec in urls for url in _expand_one(os.fspath(spec))]
    if not expanded:
        raise ValueError("no shards: the list of urls is empty; name at least one tar")
    seen: set[str] = set()
    for url in expanded:
        path = local_path(url)
        identity = url if path is None else os.path.realpath(path)
        if identity in seen:
            raise ValueError(f"{shown_url(url)} is named twice; each shard may be in a source once (weights make photos more frequent)")
        seen.add(identity)
    return expanded


def _expand_one(spec: str) -> list[str]:
    if not isinstance(spec, str):
        raise TypeError(f"a url is text or a path, got {spec!r}")
    if not spec:
        raise ValueError("a url is empty; name a tar, a folder of tars, or a pattern")
    if os.path.exists(spec):
        return _local_shards(spec, spec, spec)
    numbers = _names_in(spec)
    if numbers > MOST_SHARDS:
        raise ValueError(
            f"{reprlib.repr(shown_url(spec))} stands for {numbers:.4g} shards, more than {MOST_SHARDS:,}; check the range of the braces"
        )
    try:
        names = list(braceexpand(spec))
    except ValueError as error:
        raise ValueError(f'{shown_url(spec)!r} has unbalanced braces; a range is written as in "shards/{{000..099}}.tar"') from error
    shards = []
    for url in names:
        if url.startswith("pipe:"):
            raise ValueError(
                f"{without_secrets(url)!r}: pipe: urls run shell commands, and what comes out of a pipe cannot be read by range: they are "
                "always refused; name the tar itself (a path, http, s3, gs or hf url)"
            )
        if "::" in url and url.split("://", 1)[0] not in HTTP:  # [::1] is a host
            raise ValueError(
                f'{without_secrets(url)!r}: "::" is not supported; give a list of urls, or for chained file systems the url of the '
                "tar itself"
            )
        path = local_path(url)
        shards += _remote_shards(url, spec) if path is None else _local_shards(path, url, spec)
    return shards


def _names_in(spec: str) -> float:
    """At most so many names does a pattern with braces stand for; to be asked before they are made."""
    open_braces: list[_Brace] = [_Brace(0)]
    position = 0
    while position < len(spec):
        innermost = open_braces[-1]
        if spec[position] == "\\":
            position += 1
        elif spec[position] == "{":
            open_braces.append(_Brace(position + 1))
        elif spec[position] == "," and len(open_braces) > 1:
            innermost.alternatives += innermost.names
            innermost.names = 1.0
        elif spec[position] == "}" and len(open_braces) > 1:
            open_braces.pop()
            open_braces[-1].names *= _range_length(spec[innermost.start : position]) or innermost.alternatives + innermost.names
        if len(open_braces) > MOST_BRACES_DEEP:
            raise ValueError(f"{reprlib.repr(shown_url(spec))} has braces in braces, more than {MOST_BRACES_DEEP} deep")
        position += 1
    return open_braces[0].names


@dataclass
class _Brace:
    """One that is open while a pattern is read."""

    start: int
    alternatives: float = 0.0  # names that its parts before the last comma stand for
    names: float = 1.0  # and the part behind it


def _range_length(text: str) -> float:
    """How many a range between braces stands for; 0 for anything else."""
    numbers, letters = _NUMBERS.fullmatch(text), _LETTERS.fullmatch(text)
    if numbers is not None:
        first, last, step = (float(number or 1) for number in numbers.groups())
        return 1 + abs(last - first) // max(1, step) if max(abs(first), abs(last)) < LARGEST_NUMBER else math.inf
    return 0 if letters is None else 1 + abs(ord(letters[1]) - ord(letters[2]))


def _remote_shards(url: str, spec: str) -> list[str]:
    protocol = url.split("://", 1)[0]
    if "*" in url.split("?", 1)[0]:
        raise ValueError(
            f'{shown_url(spec)!r}: globs find local shards only; name remote ones with braces, as in "{protocol}://.../{{000..099}}.tar"'
        )
    if protocol in HTTP:
        _check_http(url)
        return [url]
    try:
        fsspec.get_filesystem_class(protocol)
    except ImportError:  # known, but its package is missing: an error when a shard is opened
        pass
    except ValueError as error:
        shown = shown_url(spec).partition("?")[0]  # a slip of https:// may be followed by a token
        raise ValueError(f"{shown!r}: {protocol}:// is no kind of url that fsspec knows; use http, https, s3, gs, hf or a path") from error
    return [url]


def _check_http(url: str) -> None:
    try:
        parts = urlsplit(url)
        whole = bool((parts.hostname or "").encode("idna")) and (parts.port is None or parts.port > 0)
    except ValueError:
        whole = False
    if not whole:
        raise ValueError(f'{shown_url(url)!r} has no host, or no port that exists; an address is written as in "https://host/shard.tar"')


def _local_shards(path: str, url: str, spec: str) -> list[str]:
    of_spec = "" if spec == url else f" (from {spec!r})"
    if os.path.isdir(path):
        found = sorted(os.path.join(path, name) for name in os.listdir(path) if name.endswith(".tar") and not name.startswith("."))
        if not found:
            raise FileNotFoundError(f"{url}{of_spec} is a folder without *.tar{_packed_hint(path)}")
        return found
    if os.path.isfile(path):
        return [url]
    if os.path.exists(path):
        raise ValueError(f"{url}{of_spec} is neither a file nor a folder; a shard is an uncompressed tar file")
    if glob.has_magic(path):
        found = sorted(name for name in glob.glob(path) if os.path.isfile(name))
        if not found:
            raise FileNotFoundError(f"{url}{of_spec} matches no file; check the pattern, it is taken from {os.getcwd()}")
        return found
    raise FileNotFoundError(f"{url}{of_spec} does not exist; check the path and the range of the braces")


def _packed_hint(folder: str) -> str:
    names = os.listdir(folder)
    if any(name.lower().endswith((".tar.gz", ".tgz")) for name in names):
        return "; its .tar.gz must be unpacked to .tar first (gunzip)"
    return "; photos in a folder become shards with `zsdata pack FOLDER OUTPUT`"
