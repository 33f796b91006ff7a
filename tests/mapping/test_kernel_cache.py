"""The cache of compiled kernels: damaged, foreign, missing and unwritable files."""

from __future__ import annotations

import errno
import os
import shutil
import time
from pathlib import Path

import numpy as np
import pytest
from numba import njit

from octoreplay.mapping.kernels import compiler, kernel_cache
from octoreplay.mapping.kernels.kernel_cache import SUFFIX, KernelCache
from support.long_suite import one_in

pytestmark = pytest.mark.skipif(os.environ.get("NUMBA_DISABLE_JIT") == "1", reason="nothing is compiled")


def doubled(values):
    return 2 * values[0]


def tripled(values):
    return 3 * values[0]


def compiled(function, folder: Path):
    """Return a function compiled as in a new process, with its cache in a folder."""
    kernel = njit(function)
    kernel._cache = KernelCache(function, folder)
    return kernel


@pytest.fixture
def said(monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture) -> pytest.LogCaptureFixture:
    """Log of a process that gave no warning yet."""
    monkeypatch.setattr(kernel_cache, "_said", set())
    return caplog


@pytest.fixture(scope="module")
def stored(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder with the compiled ``doubled`` of float64 and of int64, and ``tripled`` of float64."""
    folder = tmp_path_factory.mktemp("kernels")
    kernel = compiled(doubled, folder)
    assert (kernel(np.ones(1)), kernel(np.ones(1, np.int64))) == (2.0, 2)
    assert compiled(tripled, folder)(np.ones(1)) == 3.0
    return folder


@pytest.fixture
def folder(stored: Path, tmp_path: Path) -> Path:
    """Copy of ``stored`` that a test may damage."""
    return shutil.copytree(stored, tmp_path / "kernels")


def hits_and_misses(kernel) -> tuple[int, int]:
    return sum(kernel.stats.cache_hits.values()), sum(kernel.stats.cache_misses.values())


def test_a_stored_kernel_is_loaded_for_its_signature(folder: Path) -> None:
    kernel = compiled(doubled, folder)
    assert (kernel(np.full(1, 1.5)), kernel(np.full(1, 4, np.int64))) == (3.0, 8)
    assert hits_and_misses(kernel) == (2, 0)
    assert len(list(folder.iterdir())) == 3


DAMAGE = {
    "empty": lambda data: b"",
    "truncated digest": lambda data: data[:20],
    "truncated": lambda data: data[: len(data) // 2],
    "last byte missing": lambda data: data[:-1],
    "first bit flipped": lambda data: bytes([data[0] ^ 1]) + data[1:],
    "machine code flipped": lambda data: data[:1000] + bytes([data[1000] ^ 64]) + data[1001:],
    "foreign": lambda data: b"no compiled kernel" * 100,
    "appended": lambda data: data + b"\0",
}


@pytest.mark.parametrize("damage", one_in(5, DAMAGE.values()), ids=DAMAGE)
def test_a_damaged_kernel_is_compiled_anew_and_replaced(damage, folder: Path, said: pytest.LogCaptureFixture) -> None:
    good = {path: path.read_bytes() for path in folder.iterdir()}
    for path, data in good.items():
        path.write_bytes(damage(data))
    kernel = compiled(doubled, folder)
    assert (kernel(np.full(1, 1.5)), kernel(np.full(1, 4, np.int64))) == (3.0, 8)
    assert hits_and_misses(kernel) == (0, 2)
    # One line, however many files are damaged.
    assert [record.message.split(": ")[1] for record in said.records] == [
        "this compiled kernel is damaged; it is compiled anew"
    ]
    again = compiled(doubled, folder)
    assert (again(np.full(1, 1.5)), again(np.full(1, 4, np.int64))) == (3.0, 8)
    assert hits_and_misses(again) == (2, 0)


def test_a_kernel_in_the_place_of_another_one_is_not_used(folder: Path, said: pytest.LogCaptureFixture) -> None:
    (of_tripled,) = folder.glob("*tripled*")
    for path in folder.glob("*doubled*"):
        shutil.copy(of_tripled, path)
    assert compiled(doubled, folder)(np.ones(1)) == 2.0
    assert len(said.records) == 1


def test_an_unreadable_kernel_is_compiled_anew(folder: Path, said: pytest.LogCaptureFixture) -> None:
    for path in folder.iterdir():
        path.unlink()
        path.mkdir()
    assert compiled(doubled, folder)(np.ones(1)) == 2.0
    assert "cannot be read (Is a directory); the kernel is compiled anew" in said.messages[0]
    assert "compiled kernels cannot be stored (Is a directory)" in said.messages[1]
    assert len(said.records) == 2


def test_a_folder_that_was_removed_is_made_again(tmp_path: Path, said: pytest.LogCaptureFixture) -> None:
    assert compiled(doubled, tmp_path / "kernels")(np.ones(1)) == 2.0
    assert len(list((tmp_path / "kernels").glob(f"*{SUFFIX}"))) == 1
    assert not said.records


def test_a_full_disk_leaves_no_file_and_one_warning(
    tmp_path: Path, said: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(path: Path, other: Path) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Path, "replace", full)
    kernel = compiled(doubled, tmp_path)
    assert (kernel(np.ones(1)), kernel(np.ones(1, np.int64))) == (2.0, 2)
    assert said.messages == [
        f"{tmp_path}: compiled kernels cannot be stored (No space left on device); they are compiled anew in every run"
    ]
    assert not list(tmp_path.iterdir())


# --- the folder ------------------------------------------------------------------------------------------------------


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder that NUMBA_CACHE_DIR names."""
    monkeypatch.setattr(compiler.numba.config, "CACHE_DIR", str(tmp_path / "place"))
    return tmp_path / "place"


def test_a_folder_of_another_version_is_removed_after_a_week_without_use(place: Path) -> None:
    ages = {"kernels-00000000000000aa": 8, "kernels-00000000000000bb": 6, "kernels-mine": 99, "others": 99}
    for name, days in ages.items():
        (place / name).mkdir(parents=True)
        (place / name / "file").touch()
        os.utime(place / name, (time.time() - 86_400 * days,) * 2)
    used = compiler._cache_folder()
    assert used is not None
    assert sorted(path.name for path in place.iterdir()) == sorted([used.name, *list(ages)[1:]])


def test_a_folder_in_use_is_kept(place: Path) -> None:
    used = compiler._cache_folder()
    assert used is not None
    os.utime(used, (0, 0))
    assert compiler._cache_folder() == used
    assert time.time() - used.stat().st_mtime < 3600


def test_the_package_folder_keeps_only_the_kernels_of_this_version(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(compiler, "__file__", str(tmp_path / "compiler.py"))
    monkeypatch.setattr(compiler.numba.config, "CACHE_DIR", "")
    (tmp_path / "compiler.py").write_text("old")
    old = compiler._cache_folder()
    (tmp_path / "compiler.py").write_text("new")
    new = compiler._cache_folder()
    assert old != new
    assert list((tmp_path / "__pycache__").iterdir()) == [new]


def test_without_a_writable_folder_nothing_is_stored(
    place: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    place.write_text("a file in the place of the folder")
    assert compiler._cache_folder() is None
    assert caplog.messages == ["no folder for compiled kernels can be written; they are compiled anew in every run"]
    monkeypatch.setattr(compiler, "_CACHE_FOLDER", None)
    kernel = compiler.allocating_kernel(doubled)
    assert kernel(np.ones(1)) == 2.0
    assert kernel.stats.cache_path is None
