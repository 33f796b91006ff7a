import importlib
import subprocess
import sys

import pytest

import octoreplay


def test_every_public_name_comes_from_its_module() -> None:
    for name in octoreplay.__all__:
        value = getattr(octoreplay, name)
        if name != "__version__":
            module = importlib.import_module(f"octoreplay.{octoreplay._MODULES[name]}")
            assert value is getattr(module, name)


def test_the_lists_of_names_agree() -> None:
    assert sorted(octoreplay.__all__) == sorted([*octoreplay._MODULES, "__version__"])
    assert set(octoreplay.__all__) <= set(dir(octoreplay))
    assert len(set(octoreplay.__all__)) == len(octoreplay.__all__)


def test_other_names_raise_attribute_error() -> None:
    with pytest.raises(AttributeError, match="module 'octoreplay' has no attribute 'fly'"):
        octoreplay.fly  # noqa: B018


def test_importing_the_package_imports_nothing_heavy() -> None:
    code = (
        "import octoreplay, sys; print([name for name in ('numpy', 'numba', 'mcap', 'click') if name in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], text=True, capture_output=True, check=True)
    assert done.stdout == "[]\n"


def test_imports_for_type_checkers_name_the_same_modules() -> None:
    source = importlib.util.find_spec("octoreplay").loader.get_source("octoreplay")
    typed = {}
    for line in source.splitlines():
        words = line.replace(",", " ").split()
        if line.startswith("    from octoreplay.") and words[2] == "import":
            typed.update({name: words[1].removeprefix("octoreplay.") for name in words[3:]})
    assert typed == octoreplay._MODULES
