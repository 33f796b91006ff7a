"""Presets, and the precedence of command line, preset and team file (docs/cli.md)."""

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
                "flow_bits": 0, "quantum": 0.0, "anchor_after": 0, "packets": "full",
            }
        ),
        "roam": MappingProxyType(
            {
                "rule": "merge", "merge_weight": 0.2, "merge_maps": 1, "publish_period": 5.0, "packets": "full",
                "topology": "complete", "evidence": "sum", "mode": "sync", "settle": 0,
            }
        ),
    }
)  # fmt: skip
"""Sets of parameters by name.

'paper' follows the paper's text literally. 'roam' has the weight and the periods of the paper's authors' public code,
https://github.com/ExistentialRobotics/ROAM, branch demo, ROAM-Mapping/params/multi_robot_semantic_mapping_params.yaml:
consensus_weight 0.2, pub_timer 5 and sub_timer 5. The code adds the weighted log-odds of a received map to its own and
merges one map per sub_timer, of whichever robot (octomapCallback of octomap_generator_semantic_ros.cpp).
"""


def with_options(base: RunConfig, preset: str | None, edges: str | None, given: Mapping[str, Any]) -> RunConfig:
    """Return the configuration with a preset and options applied; precedence: options, preset, base.

    ``edges`` is the text of the option ``--edges``. Raises ConfigError for an invalid value.
    """
    parameters = {**(PRESETS[preset] if preset is not None else {}), **given}
    network: dict[str, Any] = {name: parameters.pop(name) for name in ("topology", "weights") if name in parameters}
    config = base.with_parameters(parameters)
    if edges is not None:
        links = _links(edges)
        weighted = any(weight is not None for *_, weight in links)
        network = {"topology": "edges", "weights": "given" if weighted else "metropolis", **network, "edges": links}
    elif network.get("topology", "edges") != "edges":
        # A topology of another kind replaces the file's list of edges and the weights in it.
        network["edges"] = ()
        if base.network.weights == "given":
            network.setdefault("weights", "metropolis")
    return dataclasses.replace(config, network=dataclasses.replace(config.network, **network))


def _links(text: str) -> tuple[tuple[str, str, float | None], ...]:
    """Edges of a text A:B[:W],C:D[:W],..."""
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
