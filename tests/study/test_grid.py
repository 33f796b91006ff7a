"""Tests of variations, from text to run configurations."""

from __future__ import annotations

import itertools
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from octoreplay.config.robot import RobotConfig
from octoreplay.config.run import RunConfig
from octoreplay.errors import ConfigError
from octoreplay.study.grid import Variation, check_variations, combinations, parse_variation
from support.long_suite import examples

BASE = RunConfig(robots=tuple(RobotConfig(name, (Path(f"{name}.mcap"),)) for name in ("a", "b")))
VALUES = {
    "topology": ("complete", "ring", "line"),
    "resolution": ("0.1", "0.25", "0.5"),
    "rule": ("gradient", "bayes", "natural"),
    "loss": ("0", "0.125"),
    "every": ("1", "2", "3"),
}


def runs(*texts: str, num_seeds: int | None = None, **settings: object) -> list[RunConfig]:
    variations = [parse_variation(text) for text in texts]
    return [run.config for run in combinations({"team": BASE}, variations, settings, num_seeds)]


@st.composite
def grids(draw: st.DrawFn) -> dict[str, list[str]]:
    names = draw(st.lists(st.sampled_from(sorted(VALUES)), unique=True, max_size=3))
    return {name: draw(st.lists(st.sampled_from(VALUES[name]), unique=True, min_size=1)) for name in names}


@examples(100)
@given(grid=grids(), num_seeds=st.none() | st.integers(1, 3))
def test_every_combination_occurs_once_and_in_order(grid: dict[str, list[str]], num_seeds: int | None) -> None:
    variations = [parse_variation(f"{name}={','.join(values)}") for name, values in grid.items()]
    found = list(combinations({"one": BASE, "two": BASE}, variations, {}, num_seeds))
    expected = itertools.product(("one", "two"), *grid.values(), range(num_seeds or 1))
    assert [(run.team, *run.values.values(), run.seed) for run in found] == list(expected)
    for run in found:
        config = {
            "topology": run.config.network.topology, "resolution": run.config.map.resolution,
            "rule": run.config.consensus.rule, "loss": run.config.link.loss, "every": run.config.time.every,
        }  # fmt: skip
        for name, text in run.values.items():
            assert str(config[name]) == text or float(config[name]) == float(text)
        assert run.config.network.network_seed == run.seed


def test_parameters_vary_together() -> None:
    assert parse_variation("loss+latency=0+0.5,0.25+-") == Variation(("loss", "latency"), (("0", "0.5"), ("0.25", "-")))
    found = runs("loss+latency=0+0.5,0.25+-", latency=0.125)
    assert [(run.link.loss, run.link.latency) for run in found] == [(0.0, 0.5), (0.25, 0.125)]


def test_semicolons_separate_values_with_commas() -> None:
    assert [run.map.bounds for run in runs("bounds=-1,2.5;0,3;-")] == [(-1.0, 2.5), (0.0, 3.0), BASE.map.bounds]


def test_names_may_have_dashes_and_values_may_be_words() -> None:
    found = runs("publish-period=0.5,2", "hash=true,FALSE", "epsilon=none,0.25")
    assert [run.network.publish_period for run in found] == [0.5] * 4 + [2.0] * 4
    assert [run.output.hash for run in found] == [True, True, False, False] * 2
    assert [run.consensus.epsilon for run in found] == [None, 0.25] * 4


def test_a_varied_value_overrides_a_varied_preset() -> None:
    found = runs("preset=-,paper", "gamma=-,0.125", resolution=0.5)
    assert [run.consensus.evidence for run in found] == ["sum", "sum", "time-average", "time-average"]
    assert [run.consensus.gamma for run in found] == [0.5, 0.125, 1.0, 0.125]
    assert {run.map.resolution for run in found} == {0.5}


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("topology", "vary: 'topology' is not NAME=VALUE"),
        ("topology=", "vary: 'topology=' is not NAME=VALUE"),
        ("topologie=ring", "vary: topologie: unknown parameter; did you mean 'topology'?"),
        ("preset=papr", "preset: 'papr' is not one of paper"),
        ("loss=0,,1", "vary: loss: has an empty value; use '-' to leave a parameter unchanged"),
        ("loss=0,much", "loss: expects a number, got 'much'"),
        ("every=1.5", "every: expects a whole number, got '1.5'"),
        ("hash=yes", "hash: expects true or false, got 'yes'"),
        ("loss=0.1,0.2,0.1", "vary: loss: '0.1' is listed twice"),
        ("loss+loss=0+1", "vary: 'loss' is listed twice"),
        ("loss+latency=0.1,0.2+3", "vary: '0.1' has 1 values for the 2 names loss+latency"),
        ("resolution=0.1,-2", "resolution=-2: "),
        ("topology=complete,star,disc", "topology=disc: "),
    ],
)
def test_an_invalid_text_is_reported_in_one_sentence(text: str, sentence: str) -> None:
    with pytest.raises(ConfigError) as caught:
        runs(text)
    assert str(caught.value).startswith(sentence)
    assert "\n" not in str(caught.value)


def test_a_parameter_that_is_set_twice_is_refused() -> None:
    loss = parse_variation("loss=0,0.5")
    with pytest.raises(ConfigError, match="vary: 'loss' is listed twice"):
        check_variations([loss, parse_variation("loss+latency=0+1")], {}, None)
    with pytest.raises(ConfigError, match=r"loss: is varied and also set to 0\.25; leave one out"):
        check_variations([loss], {"loss": 0.25}, None)
    with pytest.raises(ConfigError, match="network_seed: is set by --vary and by --seeds; leave one out"):
        check_variations([parse_variation("network_seed=1,2")], {}, 3)
    with pytest.raises(ConfigError, match="seeds: 0 is below the least value 1"):
        check_variations([loss], {}, 0)
    check_variations([loss], {"latency": 1.0}, 3)
