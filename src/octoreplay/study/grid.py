"""Variations of a sweep parsed from text, and their combinations as run configurations."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from octoreplay.config.parameters import PARAMETERS
from octoreplay.config.presets import PRESETS, with_options
from octoreplay.config.run import RunConfig
from octoreplay.errors import ConfigError, suggestion

BASE = "-"
"""Text of the value that the team file, the options or the default give."""

SEED = "network_seed"
"""Parameter that ``--seeds`` varies."""

Values = tuple[str, ...]


@dataclass(frozen=True)
class Variation:
    """Parameters that vary together, and their values as text: each entry of ``values`` has one text per name."""

    names: tuple[str, ...]
    values: tuple[Values, ...]


@dataclass(frozen=True)
class Combination:
    """One run of a sweep: the team's label, the varied values as text by name, the seed and the configuration."""

    team: str
    values: Mapping[str, str]
    seed: int
    config: RunConfig


def parse_variation(text: str) -> Variation:
    """Parse ``NAME=V1,V2,...`` or ``NAME+NAME=V1+V1,V2+V2,...``.

    Semicolons separate the values if the text contains one, so that values can contain commas. The value '-' leaves
    the parameter unchanged. Raises ConfigError for an unknown name, a wrong value or a repeated one.
    """
    left, separator, right = text.partition("=")
    names = tuple(name.strip().replace("-", "_") for name in left.split("+"))
    if not separator or not right.strip():
        raise ConfigError(f"vary: '{text}' is not NAME=VALUE,VALUE,... or NAME+NAME=VALUE+VALUE,...")
    for name in names:
        if name not in PARAMETERS and name != "preset":
            raise ConfigError(f"vary: {name}: unknown parameter{suggestion(name, (*PARAMETERS, 'preset'))}")
    _check_distinct("vary", names)
    values = tuple(_parts(names, entry) for entry in right.split(";" if ";" in right else ","))
    _check_distinct(f"vary: {left}", ["+".join(entry) for entry in values])
    return Variation(names, values)


def check_variations(variations: Sequence[Variation], settings: Mapping[str, Any], num_seeds: int | None) -> None:
    """Check that no parameter is set twice. Raises ConfigError."""
    if num_seeds is not None and num_seeds < 1:
        raise ConfigError(f"seeds: {num_seeds} is below the least value 1")
    varied = [name for variation in variations for name in variation.names]
    _check_distinct("vary", varied)
    if num_seeds is not None and SEED in varied:
        raise ConfigError(f"{SEED}: is set by --vary and by --seeds; leave one out")
    names = (*varied, *(() if num_seeds is None else (SEED,)))
    for name in names:
        if settings.get(name) is not None:
            raise ConfigError(f"{name}: is varied and also set to {settings[name]}; leave one out")


def combinations(
    bases: Mapping[str, RunConfig],
    variations: Sequence[Variation],
    settings: Mapping[str, Any],
    num_seeds: int | None,
) -> Iterator[Combination]:
    """Yield every combination, the team outermost and the seed innermost.

    ``bases`` are the teams' configurations by label, ``settings`` the parameters (and ``preset``) of all runs. Raises
    ConfigError that names the combination if its configuration is invalid.
    """
    seeds: list[int | None] = [None] if num_seeds is None else list(range(num_seeds))
    names = [name for variation in variations for name in variation.names]
    entries = list(itertools.product(*(variation.values for variation in variations)))
    for team, values, seed in itertools.product(bases, entries, seeds):
        texts = dict(zip(names, itertools.chain(*values), strict=True))
        given = {**settings, **{name: _value(name, text) for name, text in texts.items() if text != BASE}}
        if seed is not None:
            given[SEED] = seed
        preset = given.pop("preset", None)
        try:
            config = with_options(bases[team], preset, None, given)
        except ConfigError as error:
            where = "".join(f"{name}={text} " for name, text in texts.items()).rstrip()
            raise ConfigError(f"{where}: {error}" if where else str(error)) from error
        yield Combination(team, texts, config.network.network_seed, config)


def _parts(names: Sequence[str], entry: str) -> Values:
    """Texts of one entry, one for each name."""
    parts = tuple(part.strip() for part in (entry.split("+") if len(names) > 1 else [entry]))
    if not all(parts):
        raise ConfigError(f"vary: {'+'.join(names)}: has an empty value; use '-' to leave a parameter unchanged")
    if len(parts) != len(names):
        raise ConfigError(f"vary: '{entry}' has {len(parts)} values for the {len(names)} names {'+'.join(names)}")
    for name, part in zip(names, parts, strict=True):
        if part != BASE:
            _value(name, part)
    return parts


def _value(name: str, text: str) -> Any:
    """Value of a parameter from its text. Raises ConfigError."""
    if name == "preset":
        if text not in PRESETS:
            raise ConfigError(f"preset: '{text}' is not one of {', '.join(PRESETS)}")
        return text
    parameter = PARAMETERS[name]
    if text == "none" and parameter.default is None:
        return None
    if parameter.kind == "bool":
        return parameter.coerce({"true": True, "false": False}.get(text.lower(), text))
    if parameter.kind == "int":
        return parameter.coerce(int(text) if text.lstrip("-").isdecimal() else text)
    return parameter.coerce(text)


def _check_distinct(subject: str, entries: Sequence[str]) -> None:
    """Check that no entry is listed twice. Raises ConfigError."""
    for index, entry in enumerate(entries):
        if entry in entries[:index]:
            raise ConfigError(f"{subject}: '{entry}' is listed twice")
