"""Consensus rules and their traits.

This table is the only place that knows what distinguishes one rule from another. Other modules read the traits and
never compare names. The class that runs a rule is in ``replay/robots/team.py``.
"""

from __future__ import annotations

import enum
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType


class Exchanged(enum.Enum):
    """Content of the packets that a robot publishes."""

    NOTHING = "nothing"
    MAP = "the robot's map h_i"
    EVIDENCE = "the evidence of every robot, by origin"
    RUNNING_SUMS = "running sums of shares"


@dataclass(frozen=True, kw_only=True)
class Rule:
    """Traits of one consensus rule.

    Attributes
    ----------
    name : str
        Name in team files, on the command line and in results.
    exchanges : Exchanged
        Content of the packets.
    has_step_size : bool
        True where the rule mixes maps with the step size epsilon, which the graph bounds.
    has_gamma : bool
        True where a gradient step of size gamma_k towards the own evidence follows the mixing; gamma ramps to 0 while
        the team settles. The pull is anchored while other robots are absent (``anchor_after``).
    has_flows : bool
        True where maps mix in coarse amounts that are equal at both ends of a link (``flow_bits``).
    default_quantum : float
        Default step of log-odds with evidence 'sum', a power of two; 0 where the rule has none.
    adds_evidence_first : bool
        True where new evidence enters the map before it is published, in every tick.
    weighs_certainty : bool
        True where a neighbour's cell counts by its certainty relative to the receiver's. Maps that agree then mix with
        half the step size, and epsilon is bounded so that the mixed map stays a weighted mean of maps.
    mixes_differences : bool
        True where neighbours' maps enter as differences h_j - h_i, False where they are added whole.
    map_is_mean : bool
        True where a robot's map is the mean over the robots, with evidence 'sum': N times it is the team's posterior.
    needs_symmetric_links : bool
        True where the team's sum is kept only if both ends of a link receive a map in the same tick.
    keeps_last_evidence : bool
        True where an iteration adds the change of the evidence since the last iteration.
    survives_losses : bool
        True where the maps end exact although packets are lost or late.
    survives_restarts : bool
        True where the maps end exact although robots lose their memory.
    modes : tuple of str
        Modes of iteration that the rule supports.
    packets : tuple of str
        Packet kinds that the rule can send; the first is its default.
    needs_exact_packets : bool
        True where receivers need exactly the published values.
    warning : str
        Sentence that every run with this rule reports; '' for none.
    """

    name: str
    exchanges: Exchanged
    has_step_size: bool = False
    has_gamma: bool = False
    has_flows: bool = False
    default_quantum: float = 0.0
    adds_evidence_first: bool = False
    weighs_certainty: bool = False
    mixes_differences: bool = True
    map_is_mean: bool = True
    needs_symmetric_links: bool = False
    keeps_last_evidence: bool = False
    survives_losses: bool = False
    survives_restarts: bool = False
    modes: tuple[str, ...] = ("sync", "on-arrival")
    packets: tuple[str, ...] = ("delta", "full")
    needs_exact_packets: bool = False
    warning: str = ""


_RULES = (
    Rule(name="gradient", exchanges=Exchanged.MAP, has_step_size=True, has_gamma=True, default_quantum=2.0**-10),
    Rule(
        name="bayes",
        exchanges=Exchanged.MAP,
        has_step_size=True,
        has_flows=True,
        default_quantum=2.0**-16,
        adds_evidence_first=True,
        needs_symmetric_links=True,
        keeps_last_evidence=True,
    ),
    Rule(name="natural", exchanges=Exchanged.MAP, has_step_size=True, has_gamma=True, default_quantum=2.0**-10),
    Rule(
        name="ratio",
        exchanges=Exchanged.RUNNING_SUMS,
        keeps_last_evidence=True,
        survives_losses=True,
        modes=("sync",),
        packets=("full",),
        needs_exact_packets=True,
    ),
    Rule(name="flood", exchanges=Exchanged.EVIDENCE, survives_losses=True, survives_restarts=True, modes=("sync",)),
    Rule(
        name="merge",
        exchanges=Exchanged.MAP,
        mixes_differences=False,
        map_is_mean=False,
        keeps_last_evidence=True,
        warning="rule 'merge' counts received evidence again in every tick; it is a baseline, not a map to trust;"
        " --rule bayes counts it once",
    ),
    Rule(
        name="weighted",
        exchanges=Exchanged.MAP,
        has_step_size=True,
        default_quantum=2.0**-10,
        adds_evidence_first=True,
        weighs_certainty=True,
        map_is_mean=False,
        keeps_last_evidence=True,
        warning="rule 'weighted' does not keep the sum of the team's evidence, because certain cells count more;"
        " it is a baseline, not a map to trust; --rule bayes and --rule flood keep the sum",
    ),
    Rule(
        name="latest",
        exchanges=Exchanged.EVIDENCE,
        map_is_mean=False,
        keeps_last_evidence=True,
        modes=("sync",),
        warning="rule 'latest' keeps the evidence of one robot in each cell and drops that of the others; it is a"
        " baseline, not a map to trust; --rule flood sums the evidence of all robots",
    ),
    Rule(name="local", exchanges=Exchanged.NOTHING, map_is_mean=False),
)

RULES: Mapping[str, Rule] = MappingProxyType({rule.name: rule for rule in _RULES})
"""Every rule by name, in the order of help texts and tables."""
