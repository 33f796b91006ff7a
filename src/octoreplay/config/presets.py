"""Presets and parameters on top of a configuration: what counts, from weak to strong, is in docs/cli.md."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

from octoreplay.config.run import RunConfig
from octoreplay.errors import ConfigError

PRESETS: Mapping[str, Mapping[str, Any]] = MappingProxyType(
    {
        "paper": MappingProxyType(
            {
                "rule": "gradient", "evidence": "time-average", "mode": "on-arrival", "gamma_per_arrival": "full",
                "topology": "complete", "publish_period": 1.0, "weights": "degree", "settle": 0, "gamma": 1.0,
            }
        )
    }
)  # fmt: skip
"""Named sets of parameters. 'paper' is the literal reading of the paper."""


def with_options(base: RunConfig, preset: str | None, edges: str | None, given: Mapping[str, Any]) -> RunConfig:
    """The configuration with preset and options: an option beats the preset, which beats the file."""
    parameters = {**(PRESETS[preset] if preset is not None else {}), **given}
    network: dict[str, Any] = {name: parameters.pop(name) for name in ("topology", "weights") if name in parameters}
    config = base.with_parameters(parameters)
    if edges is not None:
        links = _links(edges)
        weighted = any(weight is not None for *_, weight in links)
        network = {"topology": "edges", "weights": "given" if weighted else "metropolis", **network, "edges": links}
    elif network.get("topology", "edges") != "edges":
        # A topology by name replaces the file's list of edges, and with it the weights given there.
        network["edges"] = ()
        if base.network.weights == "given":
            network.setdefault("weights", "metropolis")
    return dataclasses.replace(config, network=dataclasses.replace(config.network, **network))


def _links(text: str) -> tuple[tuple[str, str, float | None], ...]:
    """Edges from A:B[:W],C:D[:W],..."""
    links = []
    for entry in text.split(","):
        ends = entry.strip().split(":")
        if len(ends) not in (2, 3) or not all(ends):
            raise ConfigError(f"edges: '{entry}' is not A:B or A:B:WEIGHT")
        try:
            links.append((ends[0], ends[1], float(ends[2]) if len(ends) == 3 else None))
        except ValueError:
            raise ConfigError(f"edges: the weight in '{entry}' is not a number") from None
    return tuple(links)
