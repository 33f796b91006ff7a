import importlib
import subprocess
import sys

import pytest

import octoreplay


def test_every_public_name_is_there_and_comes_from_its_home() -> None:
    for name in octoreplay.__all__:
        value = getattr(octoreplay, name)
        if name != "__version__":
            home = importlib.import_module(f"octoreplay.{octoreplay._HOMES[name]}")
            assert value is getattr(home, name)


def test_the_lists_of_names_agree() -> None:
    assert sorted(octoreplay.__all__) == sorted([*octoreplay._HOMES, "__version__"])
    assert set(octoreplay.__all__) <= set(dir(octoreplay))
    assert len(set(octoreplay.__all__)) == len(octoreplay.__all__)


def test_what_is_not_public_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="module 'octoreplay' has no attribute 'fly'"):
        octoreplay.fly  # noqa: B018


def test_importing_the_package_is_quick() -> None:
    code = (
        "import octoreplay, sys; print([name for name in ('numpy', 'numba', 'mcap', 'click') if name in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], text=True, capture_output=True, check=True)
    assert done.stdout == "[]\n"


def test_the_names_mypy_sees_are_those_that_are_there() -> None:
    """The imports that only type checkers follow name the same homes."""
    source = importlib.util.find_spec("octoreplay").loader.get_source("octoreplay")
    typed = {}
    for line in source.splitlines():
        words = line.replace(",", " ").split()
        if line.startswith("    from octoreplay.") and words[2] == "import":
            typed.update({name: words[1].removeprefix("octoreplay.") for name in words[3:]})
    assert typed == octoreplay._HOMES
