"""The package's own cache: bytes by key, in a folder that is the user's alone. Host only, and
without JAX, so that `jaxguide doctor` can always look at it.

What is kept here is unpickled when it is used, so that a file by somebody else would be a program
of theirs: a folder or a file that others own or may write is not read.
"""

import contextlib
import functools
import hashlib
import os
import shutil
import stat
import tempfile
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

VARIABLE = "JAXGUIDE_CACHE_DIR"
# Bytes above which the entries that were longest unused go: some hundred programs of the library,
# at 0.1 to 3 MB each, are far below it.
LIMIT = 1_000_000_000
_SUFFIX, _UNFINISHED = ".program", ".part"
_HEAD = b"jaxguide program 1\n"  # the number is that of this format
_DIGEST = hashlib.sha256().digest_size


class CacheState(NamedTuple):
    """The cache as `doctor` shows it: its folder (None where nothing is kept), how many entries, of
    how many bytes, and why it cannot be used ("" if it can)."""

    folder: Path | None
    entries: int
    size: int
    trouble: str


def folder() -> Path | None:
    """The folder `JAXGUIDE_CACHE_DIR`; without it `jaxguide/programs` in the user's cache folder.
    None if the variable is empty, or where files have no owner that could be checked."""
    return _folder(*(os.environ.get(name) for name in (VARIABLE, "XDG_CACHE_HOME", "HOME")))


@functools.lru_cache(16)  # every call of a program asks
def _folder(given: str | None, *_: str | None) -> Path | None:
    if given == "" or not hasattr(os, "geteuid"):
        return None
    try:
        return _home() / "programs" if given is None else Path(given).expanduser()
    except RuntimeError:  # a user without a home
        return None


def folder_of_jax() -> Path:
    """Where the command line lets JAX keep its own cache of every program.

    **Raises:** `RuntimeError` for a user without a home.
    """
    return _home() / "jax"


def _home() -> Path:
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "jaxguide"


def read(key: str) -> bytes | None:
    """What was kept by `key`; None if there is nothing, or nothing to be trusted."""
    place = folder()
    if place is None or _trouble(place):
        return None
    path = place / (key + _SUFFIX)
    try:
        with open(os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_CLOEXEC), "rb") as file:
            status = os.fstat(file.fileno())
            if not (stat.S_ISREG(status.st_mode) and _own(status)):
                return None
            data = file.read()
        os.utime(path)  # used now
    except OSError:
        return None
    head, digest, packed = _split(data)
    if head != _head(key) or digest != hashlib.sha256(packed).digest():
        return None
    return zlib.decompress(packed)


def keep(key: str, data: bytes) -> None:
    """Keeps `data` by `key`, if that can be done, and removes what was longest unused beyond
    `LIMIT`."""
    place = folder()
    if place is None:
        return
    try:
        place.mkdir(mode=0o700, parents=True, exist_ok=True)
        if _trouble(place):
            return
        packed = zlib.compress(data, 1)  # a fourth of the bytes, in milliseconds
        handle, name = tempfile.mkstemp(_UNFINISHED, dir=place)
        try:
            with open(handle, "wb") as file:
                file.write(_head(key) + hashlib.sha256(packed).digest() + packed)
            os.replace(name, place / (key + _SUFFIX))
        except OSError:
            os.unlink(name)
    except OSError:  # no space, a file system that cannot be written
        return
    _trim(place)


def remove(key: str) -> None:
    """Forgets what was kept by `key`."""
    place = folder()
    if place is not None:
        with contextlib.suppress(OSError):
            os.unlink(place / (key + _SUFFIX))


def state() -> CacheState:
    """What the cache holds now."""
    place = folder()
    if place is None:
        return CacheState(None, 0, 0, "")
    sizes = [status.st_size for path, status in _files(place) if path.suffix == _SUFFIX]
    return CacheState(place, len(sizes), sum(sizes), _trouble(place))


def clear() -> None:
    """Removes every entry, and the `folder_of_jax`."""
    place = folder()
    for path, _ in _files(place) if place is not None else ():
        with contextlib.suppress(OSError):
            os.unlink(path)
    with contextlib.suppress(RuntimeError):
        shutil.rmtree(folder_of_jax(), ignore_errors=True)


def _head(key: str) -> bytes:
    # With its own key, so that an entry cannot stand for another one.
    return _HEAD + key.encode() + b"\n"


def _split(data: bytes) -> tuple[bytes, bytes, bytes]:
    """Head, digest and packed bytes of an entry; of a file too short, too short as well."""
    first = data.find(b"\n", len(_HEAD)) + 1
    return data[:first], data[first : first + _DIGEST], data[first + _DIGEST :]


def _own(status: os.stat_result) -> bool:
    """Whether this user, and nobody else, can have written it."""
    return status.st_uid == os.geteuid() and not status.st_mode & (stat.S_IWGRP | stat.S_IWOTH)


def _trouble(place: Path) -> str:
    """Why the folder is not to be used; "" if it may be, or is not there yet."""
    try:
        status = os.lstat(place)
    except FileNotFoundError:
        return ""
    except OSError as error:
        return str(error)
    if not stat.S_ISDIR(status.st_mode):
        return "it is not a folder"
    return "" if _own(status) else "others own it or may write to it"


def _files(place: Path) -> Iterator[tuple[Path, os.stat_result]]:
    """The files that this module made."""
    try:
        paths = [p for p in place.iterdir() if p.suffix in (_SUFFIX, _UNFINISHED)]
    except OSError:
        return
    for path in paths:
        with contextlib.suppress(OSError):  # another process removed it
            yield path, path.lstat()


def _trim(place: Path) -> None:
    """Removes files, the longest unused first, until no more than `LIMIT` bytes are left."""
    files = sorted(_files(place), key=lambda item: item[1].st_mtime)
    total = sum(status.st_size for _, status in files)
    for path, status in files:
        if total <= LIMIT:
            return
        with contextlib.suppress(OSError):
            os.unlink(path)
        total -= status.st_size
