"""Flat parameters: one name each in the team file, on the command line and in Python."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, NamedTuple

from octoreplay.config.alignment import AlignmentConfig
from octoreplay.config.consensus import ConsensusConfig
from octoreplay.config.fields import as_number, is_number
from octoreplay.config.network import LinkConfig, NetworkConfig
from octoreplay.config.output import OutputConfig
from octoreplay.config.packets import PacketConfig
from octoreplay.config.sensor import MapConfig, SensorConfig
from octoreplay.config.time import TimeConfig
from octoreplay.errors import ConfigError, suggestion


@dataclass(frozen=True)
class Parameter:
    """One flat parameter: name, section, type, default, help text, choices, and whether ``--help`` shows it."""

    name: str
    section: str
    kind: str
    default: Any
    help: str
    choices: tuple[str, ...] | None
    is_common: bool

    @property
    def unit(self) -> str:
        """Unit, as the help text gives it in brackets; empty without one."""
        found = re.search(r"\[([^]]+)]", self.help)
        return found[1] if found else ""

    def coerce(self, value: Any) -> Any:
        """Value in the parameter's type. Raises ConfigError for another type."""
        try:
            return self._coerce(value)
        except (TypeError, ValueError, OverflowError):
            expected = {"float": "a number", "int": "a whole number", "bool": "true or false", "str": "a word",
                        "floats": "numbers"}[self.kind]  # fmt: skip
            raise ConfigError(f"{self.name}: expects {expected}, got {value!r}") from None

    def _coerce(self, value: Any) -> Any:
        if value is None and self.default is None:
            return None
        if self.kind == "floats":
            numbers = value.split(",") if isinstance(value, str) else value
            return tuple(as_number(number) for number in ([numbers] if is_number(numbers) else numbers))
        if self.kind == "bool":
            if not isinstance(value, bool):
                raise TypeError
            return value
        if self.kind == "int":
            if not is_number(value) or int(value) != value:
                raise TypeError
            return int(value)
        if self.kind == "float":
            return as_number(value)
        if not isinstance(value, str):
            raise TypeError
        return value


class Section(NamedTuple):
    """One group of parameters: its dataclass and its title in templates and help."""

    config_type: type
    title: str


SECTIONS: Mapping[str, Section] = MappingProxyType(
    {
        "sensor": Section(SensorConfig, "Inverse sensor model"),
        "map": Section(MapConfig, "Map"),
        "consensus": Section(ConsensusConfig, "Consensus"),
        "network": Section(NetworkConfig, "Communication graph"),
        "link": Section(LinkConfig, "Links"),
        "packet": Section(PacketConfig, "Packets"),
        "alignment": Section(AlignmentConfig, "Alignment during the run"),
        "time": Section(TimeConfig, "Time and pairing"),
        "output": Section(OutputConfig, "What the result holds"),
    }
)
"""Every section by the name of its field in ``RunConfig``, in the order of templates and help."""


def _parameters() -> Iterator[Parameter]:
    """Flat parameters in the order of the sections and their fields."""
    kinds = {"float": "float", "float | None": "float", "int": "int", "int | None": "int", "bool": "bool",
             "str": "str", "str | None": "str", "tuple[float, ...]": "floats"}  # fmt: skip
    for name, section in SECTIONS.items():
        for item in dataclasses.fields(section.config_type):
            if item.metadata:
                yield Parameter(
                    item.name, name, kinds[str(item.type)], item.default, item.metadata["help"],
                    item.metadata["choices"], item.metadata["is_common"],
                )  # fmt: skip


PARAMETERS: Mapping[str, Parameter] = MappingProxyType({parameter.name: parameter for parameter in _parameters()})
"""Every flat parameter by name."""


def coerced(values: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """Values of flat parameters in their types, by section. Raises ConfigError for an unknown name or a wrong type."""
    changes: dict[str, dict[str, Any]] = {}
    for name, value in values.items():
        parameter = PARAMETERS.get(name)
        if parameter is None:
            raise ConfigError(f"{name}: unknown parameter{suggestion(name, PARAMETERS)}")
        changes.setdefault(parameter.section, {})[name] = parameter.coerce(value)
    return changes
