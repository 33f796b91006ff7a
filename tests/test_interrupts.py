"""Signals: one KeyboardInterrupt, deferral, and the handlers of the calling program."""

from __future__ import annotations

import signal
import subprocess
import sys
import threading
from collections.abc import Iterator

import click
import pytest

from octoreplay import cli, interrupts
from octoreplay.errors import InputError

NUMBERS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


@pytest.fixture
def installed(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Handlers of the command line, removed after the test."""
    monkeypatch.setattr(interrupts, "_state", interrupts._State())
    # The parent of the tests may have set a signal to be ignored.
    previous = {number: signal.signal(number, signal.SIG_DFL) for number in NUMBERS}
    interrupts.install()
    yield
    for number, handler in previous.items():
        signal.signal(number, handler)


@pytest.mark.parametrize("number", NUMBERS)
def test_each_signal_raises_an_interrupt_and_stays_noted(installed: None, number: int) -> None:
    assert not interrupts.is_received()
    with pytest.raises(KeyboardInterrupt):
        signal.raise_signal(number)
    assert interrupts.is_received()
    with pytest.raises(KeyboardInterrupt):
        interrupts.check()


def test_a_deferred_signal_is_delivered_at_the_end_of_the_outermost_body(installed: None) -> None:
    steps = []

    def body() -> None:
        with interrupts.deferred():
            with interrupts.deferred():
                signal.raise_signal(signal.SIGTERM)
                steps.append("inner")
            steps.append("outer")
        steps.append("never")

    with pytest.raises(KeyboardInterrupt):
        body()
    assert steps == ["inner", "outer"]


def test_a_deferred_signal_can_be_delivered_before(installed: None) -> None:
    with interrupts.deferred() as deliver:
        deliver()
        signal.raise_signal(signal.SIGINT)
        with pytest.raises(KeyboardInterrupt):
            deliver()


def test_signals_after_the_last_output_are_ignored(installed: None) -> None:
    with interrupts.deferred():
        signal.raise_signal(signal.SIGINT)
        interrupts.finish()
    signal.raise_signal(signal.SIGTERM)
    interrupts.check()
    assert not interrupts.is_received()


def test_handlers_of_the_calling_program_are_borrowed_and_given_back() -> None:
    received: list[int] = []
    previous = signal.signal(signal.SIGTERM, lambda number, _: received.append(number))
    handlers = [signal.getsignal(number) for number in NUMBERS]
    try:
        with interrupts.deferred():
            signal.raise_signal(signal.SIGTERM)
            assert not received
        assert received == [signal.SIGTERM]
        assert [signal.getsignal(number) for number in NUMBERS] == handlers
        with interrupts.deferred():
            interrupts.finish()
            signal.raise_signal(signal.SIGTERM)
        assert received == [signal.SIGTERM] * 2
    finally:
        signal.signal(signal.SIGTERM, previous)


def test_other_threads_defer_nothing() -> None:
    before, inside = signal.getsignal(signal.SIGINT), []

    def body() -> None:
        with interrupts.deferred() as deliver:
            inside.append(signal.getsignal(signal.SIGINT))
            deliver()

    thread = threading.Thread(target=body)
    thread.start()
    thread.join()
    assert inside == [before]


def test_ignored_signals_stay_ignored() -> None:
    code = (
        "import signal; signal.signal(signal.SIGHUP, signal.SIG_IGN); from octoreplay import interrupts;"
        " interrupts.install(); signal.raise_signal(signal.SIGHUP); print(interrupts.is_received())"
    )
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout == "False\n"


# --- exit codes -------------------------------------------------------------------------------------------------------


def command(monkeypatch: pytest.MonkeyPatch, action: object) -> int:
    """Run a command that does only this action, and return its exit code."""
    monkeypatch.setitem(cli.cli.commands, "act", click.Command("act", callback=action))
    return cli._exit_code(["act"])


def test_an_import_error_after_a_signal_is_an_interrupt(
    installed: None, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def load() -> None:
        try:
            signal.raise_signal(signal.SIGINT)
        except KeyboardInterrupt:
            # As a library does that cannot be loaded.
            raise InputError("needs Open3D, which cannot be loaded") from None

    assert command(monkeypatch, load) == 130
    assert capsys.readouterr().err == "interrupted\n"


def test_a_stray_end_of_file_is_no_interrupt(monkeypatch: pytest.MonkeyPatch) -> None:
    def read() -> None:
        raise EOFError("Ran out of input")

    with pytest.raises(EOFError):
        command(monkeypatch, read)
