"""Temperature that calibrates a map, against a cell-by-cell twin and maps of known calibration."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from octoreplay.evaluate.temperature import calibrating_temperature
from octoreplay.evaluate.truth import Truth
from octoreplay.mapping.octree import keys_to_codes
from octoreplay.stored_map import StoredMap
from support import octree_factory

Key = tuple[int, int, int]


def stored(cells: dict[Key, list[float]], prior: float = 0.0) -> StoredMap:
    """A map of two classes with these log-odds above the prior."""
    return StoredMap(octree_factory.octree_of(cells, resolution=1.0), "alpha", 1, 0, prior, 2)


def truth_of(classes: dict[Key, int]) -> Truth:
    """A truth with these surface cells; 0 is a class that the maps do not have."""
    codes = keys_to_codes(np.array(list(classes), np.int64).reshape(-1, 3))
    order = np.argsort(codes)
    return Truth(Path("world.npz"), codes[order], np.array(list(classes.values()), np.uint8)[order])


def naive_loss(cells: dict[Key, list[float]], prior: float, classes: dict[Key, int], temperature: float) -> float:
    """Mean log loss, cell by cell."""
    losses = []
    for key, values in cells.items():
        if classes.get(key) == 0:
            continue
        weights = np.exp(np.array([0.0, *(value + prior for value in values)]) / temperature)
        losses.append(-np.log(weights[classes.get(key, 0)] / weights.sum()))
    return float(np.mean(losses))


cell = st.tuples(st.integers(0, 3), st.integers(0, 3), st.integers(0, 3))
values = st.lists(st.sampled_from([-4.0, -1.0, -0.25, 0.5, 2.0]), min_size=2, max_size=2)


@given(
    st.dictionaries(cell, values, min_size=1), st.dictionaries(cell, st.integers(0, 2)), st.sampled_from([0.0, -1.0])
)
def test_it_is_that_of_all_cells_and_no_other_temperature_is_better(cells, classes, prior) -> None:
    if all(classes.get(key) == 0 for key in cells):
        return
    found = calibrating_temperature(stored(cells, prior), truth_of(classes or {(9, 9, 9): 1}))
    assert found.log_loss == pytest.approx(naive_loss(cells, prior, classes, 1.0), abs=1e-9)
    assert found.calibrated_log_loss == pytest.approx(naive_loss(cells, prior, classes, found.temperature), abs=1e-9)
    for temperature in (0.02, 0.3, 1.0, 3.0, 50.0):
        assert found.calibrated_log_loss <= naive_loss(cells, prior, classes, temperature) + 1e-4


@pytest.mark.parametrize("factor", [0.5, 1.0, 2.0])
def test_a_map_with_scaled_log_odds_has_that_temperature(factor: float) -> None:
    rng = np.random.default_rng(1)
    keys = [(x, y, z) for x in range(30) for y in range(30) for z in range(10)]
    levels = rng.choice([-2.0, -1.0, 0.0, 1.0, 2.0], (len(keys), 2))
    chances = np.exp(np.column_stack([np.zeros(len(keys)), levels]))
    chances /= chances.sum(axis=1, keepdims=True)
    labels = (rng.random(len(keys))[:, None] > np.cumsum(chances, axis=1)).sum(axis=1)
    cells = {key: (factor * level).tolist() for key, level in zip(keys, levels, strict=True)}
    classes = {key: int(label) for key, label in zip(keys, labels, strict=True) if label}
    found = calibrating_temperature(stored(cells), truth_of(classes))
    assert found.temperature == pytest.approx(factor, rel=0.05)
    assert found.calibrated_log_loss <= found.log_loss
