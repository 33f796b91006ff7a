"""Headless Chromium for the tests of pages."""

from __future__ import annotations

import base64
import contextlib
import io
import os
import shutil
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from PIL import Image

# Chromium without a graphics card draws with SwiftShader; root needs --no-sandbox.
_OPTIONS = ["--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--no-sandbox"]
_READY = "canvas[data-state=ready], #problem:not([hidden])"


@dataclass
class Window:
    """Page of a result in a browser, and everything that its console said."""

    page: Any
    messages: list[str] = field(default_factory=list)

    def wait(self) -> None:
        """Wait until the map is drawn, or a problem is shown."""
        self.page.wait_for_selector(_READY, state="attached", timeout=120_000)

    def run(self, code: str, *arguments: Any) -> Any:
        """Value of a JavaScript function of the page."""
        return self.page.evaluate(code, *arguments)

    def pixels(self) -> npt.NDArray[np.uint8]:
        """Pixels of the canvas (height, width, 4), RGBA."""
        self.run("() => new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")
        self.wait()
        picture = self.run("() => { page.draw(); return page.renderer.canvas.toDataURL('image/png'); }")
        return np.asarray(Image.open(io.BytesIO(base64.b64decode(picture.partition(",")[2]))).convert("RGBA"))


class Browser:
    """Chromium; skips the test without it, except in continuous integration."""

    def __init__(self, playwright: Any) -> None:
        self._playwright = playwright
        self._path = os.environ.get("CHROMIUM") or shutil.which("chromium") or shutil.which("chromium-browser")
        if self._path is None:
            assert "CI" not in os.environ, "Chromium is missing"
            pytest.skip("needs Chromium: apt-get install chromium, or CHROMIUM=path")

    @contextlib.contextmanager
    def window(
        self, address: str, *, size: tuple[int, int] = (900, 700), options: tuple[str, ...] = ()
    ) -> Iterator[Window]:
        """Open an address with a window of a size [pixel] and more options of Chromium."""
        browser = self._playwright.chromium.launch(executable_path=self._path, args=[*_OPTIONS, *options])
        found = Window(browser.new_page(viewport={"width": size[0], "height": size[1]}))
        found.page.on("console", lambda message: found.messages.append(message.text))
        found.page.on("pageerror", lambda error: found.messages.append(str(error)))
        try:
            found.page.goto(address)
            found.wait()
            yield found
        finally:
            browser.close()


@contextlib.contextmanager
def started_browser() -> Iterator[Browser]:
    """Chromium for some tests; only one may be started in a thread."""
    sync_api = pytest.importorskip("playwright.sync_api")
    with sync_api.sync_playwright() as playwright:
        yield Browser(playwright)
