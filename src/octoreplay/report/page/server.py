"""Server of a result's page on this machine: tiles of large maps are sent when they are looked at."""

from __future__ import annotations

import json
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any
from urllib.parse import parse_qs, urlsplit

from octoreplay.errors import OutputError
from octoreplay.report.page.columns import Columns
from octoreplay.report.page.page import PageContents
from octoreplay.result import Result

ADDRESS = "127.0.0.1"
_MOST_TILES = 256
"""Largest number of tiles in an answer."""


@contextmanager
def served(result: Result, port: int = 0, max_depth: int | None = None) -> Iterator[str]:
    """Serve the page of a result on the loopback interface; yields its URL.

    ``port`` is that of the server, 0 for a free one. ``max_depth`` is as in ``StoredMap.coarsened``. The server answers
    only requests that name this machine as their host, so that pages of other sites cannot read the map through a name
    that resolves to it.

    Raises InputError where the result holds no tick, and OutputError where the port cannot be used, or where the
    temporary file of the tiles cannot be written.
    """
    with PageContents(result, max_depth) as contents:
        answers = _Answers(contents)

        class Handler(_Handler):
            answer = answers

        try:
            server = ThreadingHTTPServer((ADDRESS, port), Handler)
        except (OSError, OverflowError) as error:
            reason = getattr(error, "strerror", None) or str(error)
            raise OutputError(
                f"port {port} of {ADDRESS} cannot be used: {reason}; choose another one with --port"
            ) from error
        server.daemon_threads = True
        thread = threading.Thread(target=server.serve_forever, daemon=True)
        thread.start()
        try:
            yield f"http://{ADDRESS}:{server.server_port}/"
        finally:
            server.shutdown()
            server.server_close()
            thread.join()


class _Answers:
    """Answers to requests: content type, further headers and body, by path and query."""

    def __init__(self, contents: PageContents) -> None:
        columns = Columns()
        header, self._pools = contents.served_header(columns)
        self._page = contents.html(b"", header).encode()
        self._columns = columns.compressed()

    def __call__(self, path: str, query: dict[str, list[str]]) -> tuple[str, dict[str, str], bytes] | None:
        """Return the answer to a request, None for an unknown path or tile."""
        if path == "/":
            return "text/html; charset=utf-8", {}, self._page
        if path == "/columns":
            return "application/octet-stream", {}, self._columns
        pool = self._pools.get(path.removeprefix("/tiles/"))
        if pool is None:
            return None
        try:
            wanted = [int(number) for number in ",".join(query.get("ids", [])).split(",")]
        except ValueError:
            return None
        if not 0 < len(wanted) <= _MOST_TILES or not all(0 <= index < len(pool) for index in wanted):
            return None
        columns = Columns()
        places = columns.add_all(pool.columns(wanted))
        return "application/octet-stream", {"X-Columns": json.dumps(places)}, columns.compressed()


class _Handler(BaseHTTPRequestHandler):
    """Handler of one request."""

    answer: Callable[[str, dict[str, list[str]]], tuple[str, dict[str, str], bytes] | None]
    server: ThreadingHTTPServer

    def do_GET(self) -> None:
        """Send the page, its columns or tiles."""
        host = self.headers.get("Host", "").rsplit(":", 1)[0]
        answer = None
        if host in (ADDRESS, "localhost"):
            with suppress(ValueError):
                parts = urlsplit(self.path)
                answer = type(self).answer(parts.path, parse_qs(parts.query))
        if answer is None:
            self.send_error(404)
            return
        kind, headers, body = answer
        self.send_response(200)
        for name, value in {"Content-Type": kind, "Content-Length": str(len(body)), **headers}.items():
            self.send_header(name, value)
        # A browser may close the connection when it does not need the answer any more.
        with suppress(ConnectionError):
            self.end_headers()
            self.wfile.write(body)

    def log_message(self, *_: Any) -> None:
        """Write no log: a page makes hundreds of requests."""
