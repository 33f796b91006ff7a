"""Picture of a result's page, as in the README: ``python docs/tools/page_pictures.py PAGE.html PICTURE.png``.

Needs Chromium (``CHROMIUM=path`` where it has another name) and the extra ``test``. docs/page.md names the pages and
options of the pictures in docs/images.
"""

from __future__ import annotations

import argparse
import io
import os
import shutil
from pathlib import Path

from PIL import Image
from playwright.sync_api import sync_playwright

# Chromium without a graphics card draws with SwiftShader; root needs --no-sandbox.
OPTIONS = ("--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--no-sandbox")
READY = "canvas[data-state=ready]"
MOVE = """([azimuth, elevation, zoom]) => {
  const { camera } = window.page;
  if (azimuth !== null || elevation !== null) camera.target = [0, 0, 0];  // the middle of the map's box
  if (azimuth !== null) camera.azimuth = (azimuth * Math.PI) / 180;
  if (elevation !== null) camera.elevation = (elevation * Math.PI) / 180;
  camera.zoom(1 / zoom);
  window.page.redraw();
  return new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)));
}"""


def main() -> None:
    """Write the picture that the command line describes."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("page", type=Path, help="page of octoreplay report")
    parser.add_argument("picture", type=Path, help="PNG to write")
    parser.add_argument("--view", default="", help="first view, as after # in the address: time=30&color=height")
    parser.add_argument("--azimuth", type=float, help="direction from the map to the eye about z [degree]")
    parser.add_argument("--elevation", type=float, help="height of the eye above the map [degree]")
    parser.add_argument("--zoom", type=float, default=1.0, help="factor by which the eye is nearer")
    parser.add_argument("--size", type=int, nargs=2, default=(1000, 760), metavar=("WIDTH", "HEIGHT"), help="pixels")
    wanted = parser.parse_args()
    path = os.environ.get("CHROMIUM") or shutil.which("chromium") or shutil.which("chromium-browser")
    if path is None:
        parser.error("needs Chromium: apt-get install chromium, or CHROMIUM=path")
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=path, args=list(OPTIONS))
        window = browser.new_page(viewport={"width": wanted.size[0], "height": wanted.size[1]})
        window.goto(f"{wanted.page.resolve().as_uri()}#{wanted.view}")
        window.wait_for_selector(READY, timeout=120_000)
        window.evaluate(MOVE, [wanted.azimuth, wanted.elevation, wanted.zoom])
        window.wait_for_selector(READY, timeout=120_000)
        content = window.screenshot()
        browser.close()
    picture = Image.open(io.BytesIO(content)).convert("RGB")
    picture.save(wanted.picture, optimize=True)


if __name__ == "__main__":
    main()
