"""Warnings of a run that finished."""

from __future__ import annotations

from octoreplay.config.resolved import ResolvedRun
from octoreplay.config.rules import RULES


def rule_warnings(config: ResolvedRun, is_symmetric: bool) -> tuple[str, ...]:
    """Sentences on the rule and the faults of this network that it does not tolerate.

    ``is_symmetric`` says whether every link of all graphs carried both ways with the same weight.
    """
    rule, ids = config.consensus.traits, [robot.robot_id for robot in config.robots]
    if rule.warning:
        return (rule.warning,)
    if not rule.needs_symmetric_links:
        return ()
    links = [config.link_config(a, b) for a in ids for b in ids if a != b]
    has_budget = config.packet.budget is not None
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
        f"'{other.name}'"
        for other in RULES.values()
        if other.survives_losses
        and (other.survives_restarts or not has_restarts)
        and (config.packet.packets in other.packets or not has_budget)
    ]
    sentence = (
        f"rule '{rule.name}' keeps the team's sum only when both ends of a link exchange maps in every tick; with"
        f" {', '.join([*found[:-2], ' and '.join(found[-2:])])} it drifts from the mean; rule {' or '.join(others)}"
        " does not"
    )
    return (sentence,)


def map_warnings(num_known_cells: int) -> tuple[str, ...]:
    """Sentences on the maps at the end of a run, which know a number of cells together."""
    if num_known_cells > 0:
        return ()
    return ("the maps are empty: no ray passes the mapped region; check bounds, max_range, body_box and the poses",)
