"""Warnings of a run that finished."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from octoreplay.config.resolved import ResolvedRun
from octoreplay.config.rules import RULES, Exchanged
from octoreplay.mapping.contradiction import LABEL_LIMIT, MIN_OVERLAP, contradicting_pairs
from octoreplay.mapping.quantise import INT8_MAX
from octoreplay.records import MIN_GAP_NS, FrameCounts
from octoreplay.run_metrics import MIN_COMPARED_CELLS, PairMetrics, TickMetrics, ranked_pairs

_LONG_GAP = 10
"""Least length of a part that is reported, in mean distances of a robot's used images or clouds."""
_MAX_GAPS_SHOWN = 3


def rule_warnings(config: ResolvedRun, is_symmetric: bool) -> tuple[str, ...]:
    """Sentences on the rule and the faults of this network that it does not tolerate.

    ``is_symmetric`` says whether every link of all graphs carried both ways with the same weight.
    """
    rule, ids = config.consensus.traits, [robot.robot_id for robot in config.robots]
    if rule.warning:
        return (rule.warning,)
    if not rule.needs_symmetric_links:
        return ()
    return (*_flow_warnings(config), *_sum_warnings(config, ids, is_symmetric))


def _flow_warnings(config: ResolvedRun) -> tuple[str, ...]:
    """Sentence on flows between maps that packets do not hold exactly."""
    if not config.effective_flow_bits or config.has_exact_packets:
        return ()
    sentence = (
        f"flow_bits {config.effective_flow_bits} with packets that do not hold the maps exactly: the maps do not come"
        " to rest; leave --flow-bits out, or use --content float32 without --top-classes, --budget and"
        " --prune-tolerance"
    )
    return (sentence,)


def _sum_warnings(config: ResolvedRun, ids: Sequence[str], is_symmetric: bool) -> tuple[str, ...]:
    """Sentence on the faults of this network by which the team's sum drifts."""
    rule = config.consensus.traits
    links = [config.link_config(a, b) for a in ids for b in ids if a != b]
    has_budget = config.effective_packet.budget is not None
    has_restarts = any(entry.robots_off for entry in config.network.schedule)
    causes = {
        "links that do not carry the same both ways": not is_symmetric,
        "losses": any(link.mean_loss > 0 for link in links),
        "maps that arrive in a later tick": any(link.latency > 0 or link.rate is not None for link in links),
        "robots that publish at different times": len({(r.publish_period, r.publish_phase) for r in config.robots}) > 1,
        "maps that a budget holds back": has_budget,
        "robots that go off": has_restarts,
    }
    found = [cause for cause, is_there in causes.items() if is_there]
    if not found:
        return ()
    others = [
        other.name
        for other in RULES.values()
        if other.survives_losses
        and (other.survives_restarts or not has_restarts)
        and (config.effective_packet.packets in other.packets or not has_budget)
    ]
    sentence = (
        f"rule '{rule.name}' keeps the team's sum only when both ends of a link receive a map in the same tick; with"
        f" {', '.join([*found[:-2], ' and '.join(found[-2:])])} it drifts from the mean; use --rule"
        f" {' or '.join(others)}"
    )
    return (sentence,)


def packet_warnings(config: ResolvedRun) -> tuple[str, ...]:
    """Sentences on log-odds that the run's packets cannot hold."""
    packet, sensor = config.effective_packet, config.effective_sensor
    largest, allowed = INT8_MAX * packet.int8_step, max(-sensor.clamp_min, sensor.clamp_max)
    sends_sums = config.consensus.evidence == "sum" and config.consensus.traits.exchanges is not Exchanged.NOTHING
    if packet.content != "int8" or not sends_sums or allowed <= largest:
        return ()
    needed = math.ceil(1000 * allowed / INT8_MAX) / 1000
    sentence = (
        f"int8_step {packet.int8_step:g} holds log-odds up to {largest:g}, and the clamps allow {allowed:g}: larger"
        f" ones are sent as {largest:g}, so that maps differ; use --int8-step {needed:g} or more, or closer clamps"
    )
    return (sentence,)


def map_warnings(num_known_cells: int) -> tuple[str, ...]:
    """Sentences on the maps at the end of a run, which know a number of cells together."""
    if num_known_cells > 0:
        return ()
    checks = "check --bounds, --max-range, the poses, and body_box in the team file"
    return (f"the maps are empty: no ray passes the mapped region; {checks}",)


def coverage_warnings(counts: Mapping[str, FrameCounts]) -> tuple[str, ...]:
    """Sentences on the robots of which nothing was mapped for a long part of the run, from cut or late logs on.

    A part is long from MIN_GAP_NS on, if it is also ten times the mean distance of the robot's other images or clouds.
    """
    spans = [of_robot.used_span for of_robot in counts.values() if of_robot.used_span is not None]
    if not spans:
        return ()
    start_ns, end_ns = min(start for start, _ in spans), max(end for _, end in spans)
    sentences = []
    for robot_id, of_robot in counts.items():
        gaps, least_ns = [(start_ns, end_ns)], MIN_GAP_NS
        if of_robot.used_span is not None:
            first_ns, last_ns = of_robot.used_span
            gaps = [(start_ns, first_ns), *of_robot.gaps, (last_ns, end_ns)]
            least_ns = max(least_ns, _LONG_GAP * _mean_distance_ns(of_robot))
        gaps = [(start, end) for start, end in gaps if end - start >= least_ns]
        if gaps:
            total = sum(end - start for start, end in gaps) / 1e9
            shown = ", ".join(f"{start / 1e9:.3f} s to {end / 1e9:.3f} s" for start, end in gaps[:_MAX_GAPS_SHOWN])
            more = ", ..." if len(gaps) > _MAX_GAPS_SHOWN else ""
            parts = "1 part" if len(gaps) == 1 else f"{len(gaps)} parts"
            what = f"no image or cloud was mapped for {total:.1f} s, in {parts} of the run"
            sentences.append(f"{robot_id}: {what}: stamps {shown}{more};"
                             " compare the counts of its messages with 'octoreplay info'")  # fmt: skip
    return tuple(sentences)


def _mean_distance_ns(counts: FrameCounts) -> int:
    """Mean distance of a robot's used images or clouds [ns], without gaps where it has others."""
    first_ns, last_ns = counts.used_span or (0, 0)
    num_short = counts.used - 1 - len(counts.gaps)
    if num_short > 0:
        return (last_ns - first_ns - sum(end - start for start, end in counts.gaps)) // num_short
    return (last_ns - first_ns) // max(counts.used - 1, 1)


def team_frame_warnings(metrics: TickMetrics, num_cells: Mapping[str, int]) -> tuple[str, ...]:
    """Sentences on the frames after the last tick: ``frame_warnings`` of each component, and the components.

    ``num_cells`` are the known cells of each robot's evidence, of robots with at least one.
    """
    sentences: list[str] = []
    for component in metrics.components:
        pairs = [pair for pair in metrics.pairs if pair.first in component]
        sentences += frame_warnings(pairs, {name: num_cells[name] for name in component if name in num_cells})
    if metrics.num_components > 1:
        names = "; ".join(_listed(component) for component in metrics.components)
        sentences.append(
            f"the robots are in {metrics.num_components} frames at the end, because no pair between them was accepted"
            f" ({names}): 'octoreplay align' on the result shows the numbers"
        )
    return tuple(sentences)


def frame_warnings(pairs: Sequence[PairMetrics], num_cells: Mapping[str, int]) -> tuple[str, ...]:
    """Sentences on pairs of robots that contradict each other, and on robots that share too little known space.

    ``pairs`` are those that share known cells. ``num_cells`` are the known cells of each robot's evidence, of robots
    with at least one.
    """
    sentences = []
    if bad := contradicting_pairs(pairs):
        worst, clear = bad[0], f"{100 * bad[0].clear_contradiction:.0f} %"
        sentences.append(
            f"{worst.first} and {worst.second} contradict each other in {100 * worst.contradiction:.0f} % of the"
            f" {worst.occupied_cells:,} occupied cells that both know, clearly in {clear}{_others(bad)}:"
            " try `octoreplay align`"
        )
    labels = [pair for pair in ranked_pairs(pairs, "label_contradiction") if pair.label_contradiction > LABEL_LIMIT]
    if labels:
        worst = labels[0]
        sentences.append(
            f"{worst.first} and {worst.second} have different labels in {100 * worst.label_contradiction:.0f} % of the"
            f" {worst.both_occupied_cells:,} cells that both call occupied{_others(labels)}: compare their labels, or"
            " try `octoreplay align`"
        )
    groups = _groups_with_common_space(pairs, num_cells)
    if len(groups) > 1:
        group_of = {robot_id: number for number, group in enumerate(groups) for robot_id in group}
        most = max((p.overlap_cells for p in pairs if group_of[p.first] != group_of[p.second]), default=0)
        shared = f"hardly any known space (at most {most:,} cells)" if most else "no known space"
        rest = "little to agree on" if most else "nothing to agree on"
        sentences.append(f"{_apart(groups, shared)}: {rest}; check the poses and T_team_map, or try `octoreplay align`")
    return tuple(sentences)


def _apart(groups: Sequence[Sequence[str]], shared: str) -> str:
    """Clause on groups of robots that share ``shared``."""
    alone = [group[0] for group in groups if len(group) == 1]
    if len(alone) == len(groups):
        return f"{_listed(alone)} share {shared}"
    if len(groups) - len(alone) == 1:
        return f"{_listed(alone)} share{'s' if len(alone) == 1 else ''} {shared} with any other robot"
    return f"the robots are in {len(groups)} groups that share {shared} ({'; '.join(map(_listed, groups))})"


def _others(pairs: Sequence[PairMetrics]) -> str:
    """Clause on the pairs after the first one."""
    if len(pairs) < 2:
        return ""
    if len(pairs) == 2:
        return f" (and {pairs[1].first} and {pairs[1].second})"
    common = set.intersection(*({pair.first, pair.second} for pair in pairs))
    names = f", all with {common.pop()}" if common else ""
    return f" ({len(pairs) - 1} more pairs{names})"


def _groups_with_common_space(pairs: Sequence[PairMetrics], num_cells: Mapping[str, int]) -> list[list[str]]:
    """Groups of robots that are connected by pairs with enough common known cells, in the robots' order."""
    group_of = {robot_id: [robot_id] for robot_id in num_cells}
    for pair in pairs:
        least = MIN_OVERLAP * min(num_cells[pair.first], num_cells[pair.second])
        first, second = group_of[pair.first], group_of[pair.second]
        if first is not second and (pair.occupied_cells >= MIN_COMPARED_CELLS or pair.overlap_cells >= least):
            first += second
            group_of.update(dict.fromkeys(second, first))
    unique = {id(group): group for group in group_of.values()}
    return [sorted(group, key=list(num_cells).index) for group in unique.values()]


def _listed(names: Sequence[str]) -> str:
    """Names as a list in a sentence: 'a', 'a and b', 'a, b and c'."""
    return " and ".join(part for part in (", ".join(names[:-1]), names[-1]) if part)
