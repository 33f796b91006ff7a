"""URLs of input files, in place of paths."""

from __future__ import annotations

import os
import re
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import Self, TypeAlias
from urllib.parse import urlsplit

from octoreplay.config.fields import path_problem
from octoreplay.errors import ConfigError

SCHEMES = ("s3", "gs", "http", "https")
"""Schemes of URLs that are read."""

_URL = re.compile(r"[A-Za-z][A-Za-z0-9+.-]*://.*", re.DOTALL)


@dataclass(frozen=True)
class FileUrl:
    """URL of one file in an object store (s3, gs) or on a web server (http, https).

    ``str`` gives the URL without user name, password and query, which may hold credentials. It is what messages and
    results show. ``name``, ``stem``, ``suffix``, ``parent`` and ``resolve`` are as those of a path. Raises ConfigError
    for another scheme, for credentials in the URL of an object store, and where the URL names no file.
    """

    url: str = field(repr=False)

    def __post_init__(self) -> None:
        scheme, _, rest = self.url.partition("://")
        if scheme not in SCHEMES:
            raise ConfigError(
                f"'{scheme}://...': URLs of files begin with {', '.join(f'{name}://' for name in SCHEMES)}; mount other"
                " stores as folders"
            )
        if not self.is_web and "@" in rest.partition("/")[0]:
            raise ConfigError(
                f"'{scheme}://...@...': credentials do not belong in the URL; give them in the environment or in the"
                " files of the store's own tools"
            )
        try:
            place, _, path = str(self).partition("://")[2].partition("/")
        except ValueError as error:
            raise ConfigError(f"'{scheme}://...': is not a URL: {error}") from error
        problem = path_problem(Path(path))
        if problem is not None:
            raise ConfigError(f"'{str(self)[:100]}': {problem}")
        if not place or not path or path.endswith("/") or self.name in ("", ".", ".."):
            raise ConfigError(f"'{self}': names no file; give the URL of a file (.mcap, .bag, .db3), not of a folder")

    @property
    def is_web(self) -> bool:
        """True for a file on a web server."""
        return self.url.startswith(("http:", "https:"))

    def __str__(self) -> str:
        if not self.is_web:
            # Keys of objects may hold '?' and '#'.
            return self.url
        parts = urlsplit(self.url)
        return f"{parts.scheme}://{parts.netloc.rpartition('@')[2]}{parts.path}"

    def __repr__(self) -> str:
        return f"FileUrl({str(self)!r})"

    @property
    def _path(self) -> PurePosixPath:
        """The URL as a path, of which only the last parts are of use."""
        return PurePosixPath(str(self).partition("://")[2])

    @property
    def name(self) -> str:
        """Last part of the path."""
        return self._path.name

    @property
    def stem(self) -> str:
        """Last part of the path without its suffix."""
        return self._path.stem

    @property
    def suffix(self) -> str:
        """Suffix of the last part of the path."""
        return self._path.suffix

    @property
    def parent(self) -> PurePosixPath:
        """Host or bucket, and path without its last part."""
        return self._path.parent

    def resolve(self) -> Self:
        """Return the URL, which holds from everywhere."""
        return self

    def public(self) -> FileUrl:
        """Return the URL without what may hold credentials."""
        return FileUrl(str(self))


InputFile: TypeAlias = Path | FileUrl
"""Place of an input file."""


def is_url(text: object) -> bool:
    """Return True for a text with a scheme, of any kind."""
    return isinstance(text, str) and _URL.fullmatch(text) is not None


def without_credentials(text: str) -> str:
    """Return a text in which URLs of web servers have no user name, password and query."""
    return re.sub(r"(https?://)(?:[^/\s'\"]*@)?([^\s?'\"]*)(?:\?[^\s'\"]*)?", r"\1\2", text)


def input_file(place: str | os.PathLike[str] | FileUrl, folder: Path | None = None) -> InputFile:
    """Return the place of an input file from a path or the text of a path or URL; paths are relative to ``folder``.

    Raises ConfigError for a URL that cannot be read.
    """
    if isinstance(place, FileUrl):
        return place
    if isinstance(place, str) and is_url(place):
        return FileUrl(place)
    return Path(place) if folder is None else folder / place
