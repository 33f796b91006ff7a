"""Experiments on the questions that the paper leaves open (docs/experiments.md)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from octoreplay.evaluate import mixing
from octoreplay.evaluate.evaluation import truth_beside_logs
from octoreplay.evaluate.repairs import repairs
from octoreplay.evaluate.truth import load_truth
from octoreplay.result import open_result
from octoreplay.simulate.settings import SimulationConfig
from octoreplay.simulate.world import village_classes
from octoreplay.study.experiments import Experiment, Plan, SimulatedTeam
from octoreplay.study.sweep import Sweep
from octoreplay.study.task import Row

RADIO_RANGE = 25.0
"""Radio range [m] with which six robots in the village, a square of 70 m, separate into groups and reconnect."""

_FINAL_STATES = {"state_every": 1e6, "view_every": 1e6}
"""Settings that store only the last maps, the only ones that are read."""

_SHORT_SETTLING = {"settle_max": 60}
"""Settings that end settling after a minute; slow links and sparse graphs would need hundreds of ticks."""

_LABEL_NOISES = (0.0, 0.1, 0.2, 0.3, 0.4)
_POSE_NOISES = (0.05, 0.1, 0.2, 0.4)
_DEPTH_NOISES = (2.0, 4.0, 8.0)
_NUM_ROBOTS = (2, 4, 8, 16, 32)
_RESOLUTIONS = (0.1, 0.15, 0.2, 0.3, 0.5)
_EPSILON_SHARES = (0.1, 0.25, 0.5, 0.67, 0.8, 0.9, 0.95, 0.99)


def rules(duration: float, num_villages: int) -> Experiment:
    """Compare the consensus rules on four graphs."""
    teams = _villages(duration, num_villages)
    variants = (
        *(f"gradient+{evidence}+{steps}" for evidence in ("sum", "time-average", "cell-average")
          for steps in ("0.5+0", "1+0", "1+1")),
        "natural+sum+0.5+0", "natural+sum+1+1", "bayes+-+-+-", "ratio+-+-+-", "flood+-+-+-", "merge+-+-+-",
        "local+-+-+-",
    )  # fmt: skip
    vary = (
        f"rule+evidence+gamma+gamma_power={','.join(variants)}",
        "topology=complete,ring,line,range",
    )
    settings = {"radio_range": RADIO_RANGE, "packets": "full", **_FINAL_STATES}
    return Experiment(teams, (Plan("rules", tuple(teams), vary, settings),))


def steps(duration: float, num_villages: int) -> Experiment:
    """Vary the step sizes epsilon and gamma, and epsilon near its bound."""
    teams = _villages(duration, num_villages)
    bounds = ",".join(
        f"{topology}+{share * mixing.epsilon_bound(topology, 6):.6g}"
        for topology in ("complete", "ring", "line", "star")
        for share in _EPSILON_SHARES
    )
    return Experiment(
        teams,
        (
            Plan(
                "steps",
                tuple(teams),
                ("rule=gradient,natural", "epsilon=0.1,0.2,0.35,0.5,0.7", "gamma=0.05,0.1,0.25,0.5,1,1.5"),
                {"topology": "ring", "packets": "full", **_SHORT_SETTLING, **_FINAL_STATES},
            ),
            Plan(
                "bound",
                tuple(teams)[:1],
                (f"topology+epsilon={bounds}",),
                {"rule": "bayes", "flow_bits": 0, "duration": min(duration, 20.0), "settle_max": 200, **_FINAL_STATES},
                has_truth=False,
                extra_columns=_theory,
            ),
        ),
    )


def scale(duration: float, num_villages: int) -> Experiment:
    """Measure run times for numbers of robots, cells and classes."""
    del num_villages  # run times hardly depend on the village
    robots = {
        f"robots_{count:02d}": SimulatedTeam(SimulationConfig(num_robots=count, duration=duration))
        for count in _NUM_ROBOTS
    }
    six = {"six": SimulatedTeam(SimulationConfig(duration=duration))}
    classes = {
        "classes_04": SimulatedTeam(
            SimulationConfig(duration=duration),
            (("ground", ("grass", "dirt_road")), ("house", ("building", "roof")), ("tree", ("trunk", "foliage")),
             ("obstacle", ("fence", "car"))),
        ),
        "classes_08": SimulatedTeam(SimulationConfig(duration=duration)),
        "classes_16": SimulatedTeam(SimulationConfig(duration=duration, kinds_per_class=2)),
        "classes_32": SimulatedTeam(SimulationConfig(duration=duration, kinds_per_class=4)),
    }  # fmt: skip
    resolutions = ",".join(f"{resolution:g}" for resolution in _RESOLUTIONS)
    return Experiment(
        {**robots, **six, **classes},
        (
            _timed(
                "robots",
                robots,
                ("topology+resolution=complete+0.3,nearest+0.3,nearest+0.2,nearest+0.1",),
                {"num_nearest": 3, "rule": "gradient"},
            ),
            _timed("resolution", six, (f"resolution={resolutions}", "rule=gradient,bayes"), {}),
            _timed("classes", classes, ("rule=gradient,bayes",), {}),
        ),
    )


def noise(duration: float, num_villages: int) -> Experiment:
    """Count the errors of noisy labels, poses and depths that consensus repairs and spreads."""
    levels: dict[str, dict[str, Any]] = {
        **{f"label_{level:g}": {"label_noise": level} for level in _LABEL_NOISES},
        **{f"pose_{level:g}": {"pose_noise": level} for level in _POSE_NOISES},
        **{f"depth_{level:g}": {"depth_noise": level} for level in _DEPTH_NOISES},
    }
    teams = {
        f"{label}_{seed}": SimulatedTeam(SimulationConfig(duration=duration, seed=seed, **values))
        for label, values in levels.items()
        for seed in range(num_villages)
    }
    plan = Plan(
        "noise",
        tuple(teams),
        ("rule=local,gradient,bayes",),
        {"packets": "full", **_FINAL_STATES},
        keep=True,
        extra_columns=_noise_and_repairs,
    )
    return Experiment(teams, (plan,))


def choose(duration: float, num_villages: int) -> Experiment:
    """Compare rules and packet contents on a good radio, on a poor one, and with many robots."""
    teams = _villages(duration, num_villages)
    many = {"many": SimulatedTeam(SimulationConfig(num_robots=16, duration=duration / 2))}
    variants = (
        *(f"{rule}+{sent}" for rule in ("gradient", "natural", "bayes", "flood")
          for sent in ("full+float32", "delta+float32", "delta+int8")),
        "ratio+full+float32",
    )  # fmt: skip
    vary = (f"rule+packets+content={','.join(variants)}",)
    poor = {
        **_SHORT_SETTLING, "topology": "range", "radio_range": RADIO_RANGE, "loss": 0.3, "latency": 0.2, "rate": 50_000,
    }  # fmt: skip
    return Experiment(
        {**teams, **many},
        (
            Plan("good_radio", tuple(teams), vary, _FINAL_STATES),
            Plan("poor_radio", tuple(teams), vary, {**poor, **_FINAL_STATES}),
            Plan(
                "many_robots",
                tuple(many),
                vary,
                {**_SHORT_SETTLING, "topology": "nearest", "num_nearest": 3, **_FINAL_STATES},
            ),
        ),
    )


QUESTIONS = {make.__name__: make for make in (rules, steps, scale, noise, choose)}
"""Functions that make the experiments, by name, from the length of the logs [s] and the number of villages."""


def _villages(duration: float, num_villages: int) -> dict[str, SimulatedTeam]:
    """Teams of six robots, each in a village of its own."""
    return {
        f"village_{seed}": SimulatedTeam(SimulationConfig(duration=duration, seed=seed)) for seed in range(num_villages)
    }


def _timed(
    name: str, teams: Mapping[str, SimulatedTeam], vary: tuple[str, ...], settings: Mapping[str, object]
) -> Plan:
    """Plan that measures time: two threads, one run at once, without settling and evaluation."""
    return Plan(
        name,
        tuple(teams),
        vary,
        {**settings, "packets": "full", "settle": 0, **_FINAL_STATES},
        has_truth=False,
        num_threads=2,
        extra_columns=_sizes,
    )


def _theory(team: SimulatedTeam, row: Row, _: Sweep) -> Row:
    """Epsilon as a share of its bound, and the theoretical factor per tick by which Phi shrinks."""
    graph, epsilon = (row["topology"], team.simulation.num_robots), float(row["epsilon"])
    bound = mixing.epsilon_bound(*graph)
    return {"epsilon_share": epsilon / bound, "contraction_theory": mixing.contraction(*graph, epsilon)}


def _sizes(team: SimulatedTeam, *_: object) -> Row:
    """Numbers of robots and classes of a team."""
    simulation = team.simulation
    return {
        "num_robots": simulation.num_robots,
        "num_classes": len(team.merge_classes) or len(village_classes(simulation.kinds_per_class).classes),
    }


def _noise_and_repairs(team: SimulatedTeam, row: Row, sweep: Sweep) -> Row:
    """Noise levels of a team, and the shares of its cells that are wrong, repaired and spoiled (``Repairs``)."""
    simulation = team.simulation
    noise = {name: getattr(simulation, name) for name in ("label_noise", "pose_noise", "depth_noise")}
    with (
        open_result(sweep.result({**row, "rule": "local"})) as own,
        open_result(sweep.result(row)) as after,
    ):
        world = truth_beside_logs(own.path)
        assert world is not None
        truth = load_truth(world, own.class_table, own.config.map.resolution)
        counts = [repairs(own.map(robot_id), after.map(robot_id), truth) for robot_id in own.robots]
    num_cells, *changes = (sum(count) for count in zip(*counts, strict=True))
    return {
        **noise,
        **dict(zip(("wrong", "repaired", "spread"), (change / num_cells for change in changes), strict=True)),
    }
