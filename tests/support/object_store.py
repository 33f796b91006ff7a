"""A store with the interface of S3 on this machine, in a process of its own."""

from __future__ import annotations

import subprocess
import sys
import urllib.parse
import urllib.request
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

_SERVER = """
from moto.server import ThreadedMotoServer
server = ThreadedMotoServer("127.0.0.1", 0, verbose=False)
server.start()
print(server.get_host_and_port()[1], flush=True)
input()
"""


@dataclass
class ObjectStore:
    """Store at ``endpoint``; ``environment`` gives a process the address and credentials."""

    endpoint: str

    @property
    def environment(self) -> dict[str, str]:
        return {
            "AWS_ENDPOINT_URL": self.endpoint, "AWS_ACCESS_KEY_ID": "key", "AWS_SECRET_ACCESS_KEY": "secret",
            "AWS_DEFAULT_REGION": "us-east-1", "AWS_EC2_METADATA_DISABLED": "true",
        }  # fmt: skip

    def put(self, place: str, data: bytes | Path = b"") -> None:
        """Make a bucket, or an object BUCKET/KEY."""
        content = data.read_bytes() if isinstance(data, Path) else data
        url = f"{self.endpoint}/{urllib.parse.quote(place)}"
        # Without a type urllib calls the content a form. moto does not check signatures.
        credential = "Credential=key/20250101/us-east-1/s3/aws4_request, SignedHeaders=host, Signature=0"
        headers = {"Content-Type": "application/octet-stream", "Authorization": f"AWS4-HMAC-SHA256 {credential}"}
        request = urllib.request.Request(url, content or None, headers, method="PUT")
        urllib.request.urlopen(request, timeout=60).close()


@pytest.fixture(scope="module")
def store() -> Iterator[ObjectStore]:
    """Empty store."""
    for package in ("moto", "flask", "s3fs"):
        pytest.importorskip(package)
    with subprocess.Popen(
        [sys.executable, "-c", _SERVER], stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL,
        text=True,
    ) as process:  # fmt: skip
        try:
            yield ObjectStore(f"http://127.0.0.1:{int(process.stdout.readline())}")
        finally:
            process.kill()
