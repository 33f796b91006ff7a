"""Effect of the steps epsilon and gamma and of the evidence's reading, and the bound on epsilon."""

from __future__ import annotations

import numpy as np

from octoreplay.evaluate import mixing
from octoreplay.records import Float64Array
from octoreplay.report.comparisons import KILOBYTES, Comparison, Measure, Row
from octoreplay.report.experiment_plots import Curves, Dots, Squares
from octoreplay.study.experiments import Experiment, Plan, Question, SimulatedTeam
from octoreplay.study.questions.settings import (
    DURING,
    LAST_MAPS,
    MEAN_IOU,
    SETTLED,
    SHORT_SETTLING,
    graph_name,
    villages,
)
from octoreplay.study.sweep import Sweep

_NUM_ROBOTS = 6
_TOPOLOGIES = ("complete", "ring", "line", "star")
_SHARES = (0.1, 0.25, 0.5, 0.67, 0.8, 0.9, 0.95, 0.99)
_EVIDENCE = ("sum", "time-average", "cell-average")
_GAMMAS = {("0.5", "0"): "γ 0.5", ("1", "0"): "γ 1", ("1", "1"): "γ 1/k"}
"""Names by gamma and gamma_power."""


def experiment(duration: float, num_villages: int) -> Experiment:
    """Epsilon and gamma against each other, readings of the evidence, and mixing with epsilon near its bound."""
    teams = villages(duration, num_villages)
    bounds = ",".join(
        f"{topology}+{share * mixing.epsilon_bound(topology, _NUM_ROBOTS):.6g}"
        for topology in _TOPOLOGIES
        for share in _SHARES
    )
    return Experiment(
        teams,
        (
            Plan(
                "steps",
                tuple(teams),
                ("rule=gradient,natural", "epsilon=0.1,0.2,0.35,0.5,0.7", "gamma=0.05,0.1,0.25,0.5,1,1.5"),
                {"topology": "ring", "packets": "full", **SHORT_SETTLING, **LAST_MAPS},
                has_truth=False,
            ),
            Plan(
                "evidence",
                tuple(teams),
                (f"evidence={','.join(_EVIDENCE)}", f"gamma+gamma_power={','.join(map('+'.join, _GAMMAS))}"),
                {"rule": "gradient", **LAST_MAPS},
            ),
            Plan(
                "bound",
                tuple(teams)[:1],
                (f"topology+epsilon={bounds}",),
                {"rule": "bayes", "flow_bits": 0, "duration": min(duration, 20.0), "settle_max": 200, **LAST_MAPS},
                has_truth=False,
                extra_columns=_theory,
            ),
        ),
    )


def _theory(_: SimulatedTeam, row: Row, __: Sweep) -> dict[str, float]:
    """Epsilon as a share of its bound, and the factor per tick by which Phi shrinks in theory."""
    graph, epsilon = (row["topology"], _NUM_ROBOTS), float(row["epsilon"])
    bound = mixing.epsilon_bound(*graph)
    return {"epsilon_share": epsilon / bound, "contraction_theory": mixing.contraction(*graph, epsilon)}


def _curve(topology: str) -> tuple[Float64Array, Float64Array]:
    """Factor per tick in theory over epsilon as a share of its bound."""
    shares = np.linspace(0.0, 1.1, 400)
    bound = mixing.epsilon_bound(topology, _NUM_ROBOTS)
    return shares, np.array([mixing.contraction(topology, _NUM_ROBOTS, share * bound) for share in shares])


def _reading(row: Row) -> str:
    """Name of a reading of the evidence, and of gamma."""
    return f"{row['evidence']}, {_GAMMAS[str(row['gamma']), str(row['gamma_power'])]}"


def _point(row: Row) -> str:
    """Name of a graph and a step size."""
    return f"{row['topology']}, {float(row['epsilon']):g}"


_FACTOR = Measure("factor of Φ per tick", "contraction")
_PHI = Measure("Φ over all pairs, end of the logs", "total_distance_all_log_end", None, is_ratio=True)
_OF_STEPS = Comparison(
    "steps",
    "ε, γ",
    lambda row: f"{float(row['epsilon']):g}, {float(row['gamma']):g}",
    (_PHI, DURING, SETTLED),
    "0.5, 0.5",
    "rule",
    title="steps",
)
_OF_EVIDENCE = Comparison(
    "evidence", "evidence, γ", _reading, (_PHI, DURING, MEAN_IOU, KILOBYTES), "sum, γ 0.5", title="evidence"
)

QUESTION = Question(
    experiment,
    (
        Comparison(
            "bound",
            "graph, epsilon",
            _point,
            (
                Measure("epsilon / bound", "epsilon_share", 2),
                _FACTOR,
                Measure("factor in theory", "contraction_theory"),
                Measure("ticks to consensus", "ticks_to_consensus", None),
            ),
            title="bound",
        ),
        _OF_STEPS,
        _OF_EVIDENCE,
    ),
    {
        "steps.png": Squares("steps", "gamma", "epsilon", _OF_STEPS.measures, "rule"),
        "evidence.png": Dots(_OF_EVIDENCE),
        "bound.png": Curves("bound", "epsilon_share", "epsilon / bound", (_FACTOR,), graph_name, theory=_curve),
    },
)
