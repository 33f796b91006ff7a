"""A web server in this process, which can refuse, stall and end a file before its end."""

from __future__ import annotations

import hashlib
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer


class WebServer(ThreadingHTTPServer):
    """Server of ``files`` by path; the attributes may be changed while it runs."""

    daemon_threads = True

    def __init__(self) -> None:
        super().__init__(("127.0.0.1", 0), _Handler)
        self.files: dict[str, bytes] = {}
        self.requests: list[tuple[str, str]] = []
        self.authorizations: list[str | None] = []
        self.status = 200
        self.has_etag = True
        self.last_modified: str | None = None
        self.has_length = True
        self.cut_at: int | None = None
        self.after_half = threading.Event()
        self.may_go_on = threading.Event()
        self.may_go_on.set()

    @property
    def address(self) -> str:
        return f"127.0.0.1:{self.server_port}"

    def url(self, path: str) -> str:
        return f"http://{self.address}{path}"

    def num_downloads(self) -> int:
        return sum(method == "GET" for method, _ in self.requests)

    def handle_error(self, request, client_address) -> None:
        """A client that goes away is part of the tests."""


class _Handler(BaseHTTPRequestHandler):
    server: WebServer

    def do_HEAD(self) -> None:
        self._head()

    def do_GET(self) -> None:
        data = self._head()
        if data is None:
            return
        end = len(data) if self.server.cut_at is None else self.server.cut_at
        self.wfile.write(data[: end // 2])
        self.server.after_half.set()
        self.server.may_go_on.wait(60)
        self.wfile.write(data[end // 2 : end])

    def _head(self) -> bytes | None:
        """Write status and headers; return the file if there is one."""
        path = self.path.partition("?")[0]
        self.server.requests.append((self.command, self.path))
        self.server.authorizations.append(self.headers.get("Authorization"))
        data = self.server.files.get(path)
        status = 404 if data is None else self.server.status
        self.send_response(status)
        if status == 200:
            if self.server.has_etag:
                self.send_header("ETag", f'"{hashlib.sha256(data).hexdigest()[:16]}"')
            if self.server.last_modified is not None:
                self.send_header("Last-Modified", self.server.last_modified)
            if self.server.has_length:
                self.send_header("Content-Length", str(len(data)))
        else:
            data = None
            self.send_header("Content-Length", "0")
        self.end_headers()
        return data

    def log_message(self, *arguments: object) -> None:
        """Print nothing."""


@contextmanager
def web_server() -> Iterator[WebServer]:
    """Run a server in a thread of its own."""
    with WebServer() as server:
        thread = threading.Thread(target=server.serve_forever, args=(0.01,), daemon=True)
        thread.start()
        try:
            yield server
        finally:
            server.may_go_on.set()
            server.shutdown()
            thread.join()
