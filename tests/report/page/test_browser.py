"""The page of a result in a real browser."""

from __future__ import annotations

import socket
import struct
import urllib.request
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from octoreplay.report.page.page import write_page
from octoreplay.report.page.server import served
from octoreplay.result import open_result
from support.browser import Browser, Window, started_browser
from support.command_line import started
from support.long_suite import long
from support.result_factory import write_result

pytestmark = [long, pytest.mark.xdist_group("browser")]


@pytest.fixture(scope="module")
def address(trio_result: Path, tmp_path_factory: pytest.TempPathFactory) -> str:
    path = tmp_path_factory.mktemp("page") / "trio.html"
    write_page(trio_result, path)
    return f"file://{path}"


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with started_browser() as found:
        yield found


@pytest.fixture(scope="module")
def shown(browser: Browser, address: str) -> Iterator[Window]:
    with browser.window(address) as found:
        yield found


Pixels = npt.NDArray[np.uint8]


def share_drawn(pixels: Pixels) -> float:
    """Share of the pixels that are not background."""
    return float((pixels[:, :, 3] > 0).mean())


def same(first: Pixels, second: Pixels) -> bool:
    """Whether two pictures are equal."""
    return np.array_equal(first, second)


def set_state(shown: Window, **changes: object) -> Pixels:
    """Change the state of the page and return the picture."""
    shown.run("(changes) => page.set(changes)", changes)
    return shown.pixels()


def test_the_map_is_drawn_without_messages(shown: Window) -> None:
    assert share_drawn(shown.pixels()) > 0.05
    assert shown.messages == []


def test_the_slider_changes_the_picture_and_the_cursor(shown: Window) -> None:
    shown.run("() => page.set({ paths: false })")
    last = shown.pixels()
    shown.page.locator("#time").evaluate("(slider) => { slider.value = 2; slider.dispatchEvent(new Event('input')); }")
    early = shown.pixels()
    assert not same(early, last)
    assert shown.page.locator("#now").inner_text().startswith(f"{shown.run('() => page.data.times[2]'):.1f} s")
    cursor = shown.run("() => page.charts.map((chart) => chart.row)")
    assert set(cursor) == {2}
    shown.run("() => page.set({ row: page.data.times.length - 1 })")
    assert same(shown.pixels(), last)


@pytest.mark.parametrize("color", ["height", "seen", "probability", "disagreement", "contradiction"])
def test_every_colour_differs_from_the_classes(shown: Window, color: str) -> None:
    # While the robots explore, their maps differ.
    plain = set_state(shown, color="label", paths=False, row=3)
    assert not same(set_state(shown, color=color, row=3), plain)
    shown.run("() => page.set({ row: page.data.times.length - 1, color: 'label' })")
    assert shown.messages == []


def test_hidden_classes_robots_and_heights(shown: Window) -> None:
    whole = set_state(shown, paths=False)
    box = shown.page.locator("#classes input").first
    box.uncheck()
    assert share_drawn(shown.pixels()) < share_drawn(whole)
    box.check()
    assert same(shown.pixels(), whole)
    assert share_drawn(set_state(shown, heights=[1.0, 9.0])) < share_drawn(whole)
    shown.run("() => page.set({ heights: [...page.data.heights] })")
    for box in shown.page.locator("#robots input").all():
        box.uncheck()
    assert share_drawn(shown.pixels()) < 0.001
    for box in shown.page.locator("#robots input").all():
        box.check()
    assert share_drawn(set_state(shown, free=True)) > share_drawn(whole)
    shown.run("() => page.set({ free: false })")


def test_a_picked_cell_has_the_values_of_the_result(shown: Window, trio_result: Path) -> None:
    shown.run("() => page.set({ row: page.data.times.length - 1, color: 'label', paths: false })")
    shown.pixels()
    answers = []
    for share in (0.4, 0.5, 0.6):
        answer = shown.run(
            """(share) => {
                const canvas = document.getElementById("canvas");
                const answer = page.pick(canvas.clientWidth * share, canvas.clientHeight * 0.55);
                return answer && { point: answer.point, edge: answer.edge, rows: answer.rows.map(({ layer, ...rest }) =>
                    ({ name: layer.name, kind: layer.kind, robot: layer.robot, ...rest })) };
            }""",
            share,
        )
        text = shown.page.locator("#picked").inner_text()
        assert ("cell at" in text) == (answer is not None)
        heads = shown.page.locator("#picked thead th").all_inner_texts()
        assert heads == (["map", "state", "probability"] if answer else [])
        answers += [answer] if answer else []
    assert answers
    with open_result(trio_result) as result:
        for answer in answers:
            for row in answer["rows"]:
                if row["kind"] == "team":
                    continue
                stored = result.evidence(row["robot"]) if row["kind"] == "evidence" else result.map(row["robot"])
                found = stored.query([answer["point"]])
                if not found.known[0]:
                    assert row["state"] == "unknown"
                elif found.labels[0] == 0:
                    assert row["state"] == "free"
                else:
                    assert row["state"] == "occupied"
                    assert row["label"] == found.labels[0]
                    assert row["probability"] == pytest.approx(found.probabilities[0].max(), abs=1e-4)


def test_side_by_side(shown: Window) -> None:
    shown.run("() => page.set({ beside: '/evidence/husky_1' })")
    shown.pixels()
    titles = shown.page.locator("#titles span").all_inner_texts()
    assert len(titles) == 2
    assert titles[1] == "husky_1, own scans"
    shown.run("() => page.set({ beside: '' })")


def test_keys_move_the_camera(shown: Window) -> None:
    before = shown.pixels()
    shown.page.locator("#canvas").focus()
    for key in ("ArrowLeft", "ArrowUp", "+", "Alt+ArrowRight"):
        shown.page.keyboard.press(key)
    assert not same(shown.pixels(), before)
    shown.page.keyboard.press("0")
    assert same(shown.pixels(), before)


def test_controls_have_names(shown: Window) -> None:
    unnamed = shown.run(
        """() => [...document.querySelectorAll("button, input, select")].filter((element) =>
            !(element.getAttribute("aria-label") || element.closest("label")?.textContent.trim())).length"""
    )
    assert unnamed == 0


def test_a_narrow_window_has_no_sideways_scroll(browser: Browser, address: str) -> None:
    with browser.window(address, size=(390, 800)) as narrow:
        assert narrow.run("() => document.documentElement.scrollWidth") <= 390
        assert share_drawn(narrow.pixels()) > 0.05


def test_without_webgl_the_page_shows_pictures(browser: Browser, address: str) -> None:
    with browser.window(address, options=("--disable-gpu", "--disable-3d-apis")) as plain:
        assert "no WebGL 2" in plain.page.locator("#problem").inner_text()
        assert plain.page.locator("#pictures img").count() == 2
        assert plain.page.locator("#pictures img").first.is_visible()
        assert plain.page.locator(".chart .line").count() > 3


def test_a_result_without_maps_says_so(browser: Browser, tmp_path: Path) -> None:
    write_page(write_result(tmp_path, lambda writer: None), tmp_path / "empty.html")
    with browser.window(f"file://{tmp_path / 'empty.html'}") as found:
        assert "holds no map" in found.page.locator("#problem").inner_text()
        found.page.locator("#canvas").focus()
        found.page.keyboard.press("Enter")
        found.run("() => new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")
        assert found.messages == []


def test_a_chart_of_zeros_has_axes(browser: Browser, trio_result: Path, tmp_path: Path) -> None:
    path = tmp_path / "zeros.html"
    write_page(trio_result, path)
    with browser.window(f"file://{path}") as found:
        found.run("() => { page.data.charts[0].lines.forEach((line) => line.values.fill(0)); page.charts[0].draw(); }")
        assert found.page.locator(".chart").first.locator(".grid").count() > 0
        assert found.messages == []


def test_the_server_outlives_bad_requests(trio_result: Path) -> None:
    with open_result(trio_result) as result, served(result) as url:
        port = int(url.rsplit(":", 1)[1].strip("/"))
        for request in (
            b"GET http://[/ HTTP/1.1\r\nHost: localhost\r\n\r\n",
            b"GET /tiles/cubes?ids=-1 HTTP/1.0\r\n\r\n",
        ):
            with socket.create_connection(("127.0.0.1", port)) as connection:
                connection.sendall(request)
                assert b" 404 " in connection.recv(100)
        with socket.create_connection(("127.0.0.1", port)) as connection:
            connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
            connection.sendall(b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n")
        with urllib.request.urlopen(url) as answer:
            assert answer.status == 200


def test_settings_in_the_address(browser: Browser, address: str) -> None:
    with browser.window(f"{address}#time=2&color=height&beside=central") as found:
        state = found.run("() => ({ row: page.state.row, color: page.state.color, beside: page.state.beside })")
    assert state["color"] == "height"
    assert state["beside"] == "central"
    assert state["row"] >= 1


def test_a_served_page_shows_the_same_picture(trio_result: Path, browser: Browser, shown: Window) -> None:
    shown.run("() => page.set({ row: page.data.times.length - 1, color: 'label', paths: true })")
    expected = shown.pixels()
    with open_result(trio_result) as result, served(result) as url, browser.window(url) as found:
        assert same(found.pixels(), expected)
        assert found.messages == []


def test_view_ends_with_an_interrupt(trio_result: Path) -> None:
    with started("view", trio_result, "--no-browser") as process:
        assert process.stdout is not None
        line = process.stdout.readline()
        assert "is shown at http://127.0.0.1:" in line
        process.send_signal(2)
        assert process.wait(timeout=60) == 0
