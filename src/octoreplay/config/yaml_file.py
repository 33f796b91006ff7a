"""Reading and writing of YAML files, with errors of one sentence."""

from __future__ import annotations

import io
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from octoreplay.errors import ConfigError


def read_text(path: Path, kind: str) -> str:
    """Return the text of a configuration file. Raises ConfigError if it is unreadable or not UTF-8."""
    try:
        return path.read_text(encoding="utf-8")
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path}: not a {kind} file: its text is not UTF-8") from error


def load_yaml(text: str, name: str) -> Any:
    """Return the content of a YAML text. Raises ConfigError that starts with ``name``."""
    from ruamel.yaml import YAML
    from ruamel.yaml.error import YAMLError

    try:
        return YAML(typ="safe", pure=True).load(text)
    except YAMLError as error:
        line = getattr(getattr(error, "problem_mark", None), "line", None)
        where = "" if line is None else f" (line {line + 1})"
        raise ConfigError(f"{name}: not valid YAML{where}: {getattr(error, 'problem', None) or error}") from error


def dump_yaml(content: Mapping[str, Any]) -> str:
    """Return the text of a mapping as YAML in its own order of keys; the innermost lists and mappings take one line."""
    from ruamel.yaml import YAML

    buffer = io.StringIO()
    yaml = YAML(typ="safe", pure=True)
    yaml.default_flow_style = None
    yaml.representer.sort_base_mapping_type_on_output = False
    yaml.width = 110
    yaml.dump(content, buffer)
    return buffer.getvalue()
