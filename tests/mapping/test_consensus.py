"""One iteration against the reference's rules, and invariants and results of whole runs."""

from __future__ import annotations

import dataclasses
import functools
from concurrent.futures import ThreadPoolExecutor

import numba
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from octoreplay.mapping.consensus import Evidence, Step, Update, gamma_at, sum_of_evidence, team_step
from octoreplay.mapping.kernels import consensus as consensus_kernels
from octoreplay.mapping.kernels import storage
from octoreplay.records import CONVERGED
from octoreplay.replay.session import Session
from reference import rules
from reference.hand_made import team_config
from reference.scenarios import TeamShape, make_scenario
from support.long_suite import examples, long, one_in
from support.octree_factory import cells_of, cube, octree_of
from support.sessions import frame_lists

NUM_CLASSES = 3
UPDATES = (Update.GRADIENT, Update.NATURAL, Update.ADD, Update.COPY)
TOPOLOGIES = ("complete", "ring", "line", "star")


def consensus_step(own, neighbours, step_weights, log_likelihood, *, update, gamma, revision, **others):
    """One robot's iteration."""
    step = Step(own, neighbours, step_weights, log_likelihood, gamma, **others)
    return team_step([step], update=update, revision=revision)[0]


# --- one iteration ---------------------------------------------------------------------------------------------------


def _random_cells(rng, scale=3.0):
    """Cubes with one value for all classes, cubes with one value for each class, and single cells; some overlap."""
    cells = {}
    for _ in range(rng.integers(0, 4)):
        edge = int(rng.choice([1, 3, 8]))
        corner = (rng.integers(-2, 2, 3) * (8 if edge == 8 else 5)).tolist()
        values = (rng.normal(size=NUM_CLASSES) * scale).astype(np.float32)
        cells.update(cube(corner, edge, values if rng.random() < 0.5 else np.full(NUM_CLASSES, values[0])))
    return cells


def _dense(keys, cells):
    """(M, K) float64 of a map including the column of free space; 0 where it is unknown."""
    dense = np.zeros((len(keys), NUM_CLASSES + 1))
    for row, key in enumerate(keys):
        if key in cells:
            dense[row, 1:] = cells[key]
    return dense


def _expected(update, own, base, neighbours, weights, log_q, last, gamma):
    """The reference's step; weights are 2 epsilon A_ij, so epsilon is a half."""
    mixed = rules.mix(own, [(w, other - base) for w, other in zip(weights, neighbours, strict=True)], 0.5)
    if update is Update.GRADIENT:
        return rules.gradient_step(mixed, log_q, gamma)
    if update is Update.NATURAL:
        return rules.natural_step(mixed, log_q, gamma)
    return rules.with_evidence(mixed, log_q, last) if update is Update.ADD else log_q


@examples(50)
@given(
    seed=st.integers(0, 100_000),
    update=st.sampled_from(UPDATES),
    gamma=st.sampled_from([0.0, 0.5, 1.0]),
    with_base=st.booleans(),
)
def test_step_on_octrees_equals_the_step_cell_by_cell(seed, update, gamma, with_base):
    """All cells, including those known in some of the maps only, in bricks of any layout."""
    rng = np.random.default_rng(seed)
    own, base, log_q, last = (_random_cells(rng) for _ in range(4))
    neighbours = [_random_cells(rng) for _ in range(rng.integers(0, 4))]
    neighbours = [] if update is Update.COPY else neighbours
    weights = rng.uniform(0.0, 0.5, len(neighbours)).astype(np.float32)
    keys = sorted(set().union(own, base, log_q, last, *neighbours))
    dense_own = _dense(keys, own)
    expected = _expected(
        update, dense_own, _dense(keys, base) if with_base else dense_own, [_dense(keys, n) for n in neighbours],
        weights, _dense(keys, log_q), _dense(keys, last), gamma,
    )  # fmt: skip
    octree, evidence = _octree(own), _octree(log_q)
    change = consensus_step(
        octree, [_octree(n) for n in neighbours], weights.tolist(), evidence, update=update, gamma=gamma,
        revision=4, base=_octree(base) if with_base else None, last_evidence=_last(_octree(last), evidence),
    )  # fmt: skip
    found = {key: np.frombuffer(value, np.float32) for key, value in cells_of(octree).items()}
    keys_known = set(keys) if with_base else set().union(own, log_q, last, *neighbours)
    assert found.keys() == keys_known
    compared = [row for row, key in enumerate(keys) if key in keys_known]
    for row in compared:
        np.testing.assert_allclose(found[keys[row]], expected[row, 1:], atol=3e-5, rtol=1e-5)
    most = np.abs(expected - dense_own)[compared].max(initial=0.0)
    assert change == pytest.approx(most, rel=1e-4, abs=3e-5) or change > most
    changed = {key for key in keys_known if np.abs(expected[keys.index(key)] - dense_own[keys.index(key)]).max() > 1e-4}
    revised = set(octree.codes[octree.revisions == 4].tolist())
    assert {int(storage.key_to_code(*key)) >> storage.CELL_BITS for key in changed} <= revised


def _last(last, evidence):
    """Evidence at the last iteration: bricks that are new in the evidence are in it without known cells."""
    last.find_or_add(evidence.codes)
    return last


def _octree(cells):
    return octree_of(cells, num_classes=NUM_CLASSES)


def _step(own, log_q, update=Update.GRADIENT, gamma=1.0, neighbours=(), weights=(), num_classes=2, **others):
    octree = octree_of({(0, 0, 0): own}, num_classes=num_classes)
    evidence = octree_of({(0, 0, 0): log_q}, num_classes=num_classes)
    maps = [octree_of({(0, 0, 0): values}, num_classes=num_classes) for values in neighbours]
    consensus_step(octree, maps, weights, evidence, update=update, gamma=gamma, revision=1, **others)
    return np.frombuffer(cells_of(octree)[0, 0, 0], np.float32)


def test_gradient_by_hand():
    """sigma = 1/3 each, D = (0, -3, 0): g_1 = 1/3 (-1 + 3) and g_2 = 1/3 (-1 - 0)."""
    np.testing.assert_allclose(_step([0.0, 0.0], [3.0, 0.0]), [2 / 3, -1 / 3], rtol=1e-6)


def test_mixing_by_hand():
    found = _step(
        [1.0, 0.0], [0.0, 0.0], Update.NATURAL, 0.0, neighbours=[[3.0, -1.0], [0.0, 2.0]], weights=[0.25, 0.5]
    )
    np.testing.assert_allclose(found, [1.0 + 0.25 * 2.0 - 0.5, -0.25 + 1.0])


@pytest.mark.parametrize(
    ("magnitude", "num_classes"), one_in(2, [0.0, 1e-38, 1.0, 88.0, 104.0, 1e3, 1e10, 1e18], [1, 2, 254])
)
def test_log_odds_of_any_magnitude_stay_finite(magnitude, num_classes):
    rng = np.random.default_rng(0)
    # The values of many classes are many draws already.
    for _ in range(5 if num_classes < 254 else 1):
        own, log_q, other = (rng.choice([-1.0, 0.0, 0.5, 1.0], num_classes) * magnitude for _ in range(3))
        for update in UPDATES:
            found = _step(own, log_q, update, 0.5, [other], [0.5], num_classes)
            assert np.isfinite(found).all()
            mixed = np.append(0.0, 0.5 * own + 0.5 * other)[None].astype(np.float32).astype(np.float64)
            if update is Update.GRADIENT:
                expected = rules.gradient_step(mixed, np.append(0.0, log_q)[None], 0.5)[0, 1:]
                np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-5 * max(magnitude, 1e-3))


def test_step_without_change_keeps_revisions():
    octree = octree_of(cube((0, 0, 0), 3, [1.0, 2.0]))
    before = octree.revisions.copy()
    same = octree.copy()
    assert consensus_step(octree, [same], [0.5], same, update=Update.NATURAL, gamma=0.5, revision=9) == 0.0
    assert (octree.revisions == before).all()


@examples(25)
@given(seed=st.integers(0, 100_000), update=st.sampled_from(UPDATES))
def test_equal_maps_do_not_change_by_a_bit(seed, update):
    """With any weights, bricks of any layout and log-odds of any size."""
    rng = np.random.default_rng(seed)
    cells = _random_cells(rng, scale=10.0 ** rng.integers(-3, 8))
    weights = rng.uniform(0.0, 0.5, rng.integers(0, 4)).tolist()
    octree, same = _octree(cells), _octree(cells)
    last = {"last_evidence": same} if update is Update.ADD else {}
    assert (
        consensus_step(octree, [same] * len(weights), weights, same, update=update, gamma=0.5, revision=4, **last)
        == 0.0
    )
    assert cells_of(octree) == cells_of(same)
    assert (octree.revisions < 4).all()


@examples(40)
@given(seed=st.integers(0, 100_000), update=st.sampled_from(UPDATES))
def test_skipping_unchanged_bricks_does_not_change_the_result(seed, update):
    """Steps on the bricks that changed since the last step, against steps on all bricks."""
    rng = np.random.default_rng(seed)
    common = _random_cells(rng)
    skipping, log_q, last, *neighbours = (
        _octree(common | (_random_cells(rng) if rng.random() < 0.5 else {})) for _ in range(5)
    )
    full = skipping.copy()
    for revision in range(5, 11):
        maps = (log_q, *neighbours)
        arguments = {"update": update, "gamma": 0.5, "revision": revision, "last_evidence": _last(last, log_q)}
        since = revision - 1 if revision > 5 else None
        changes = [
            consensus_step(full, neighbours, [0.3, 0.4], log_q, **arguments),
            consensus_step(skipping, neighbours, [0.3, 0.4], log_q, since=since, **arguments),
        ]
        assert changes[0] == changes[1]
        assert cells_of(full) == cells_of(skipping)
        np.testing.assert_array_equal(full.revisions, skipping.revisions)
        if rng.random() < 0.6:
            source = _octree(_random_cells(rng))
            maps[rng.integers(3)].overwrite(source, np.arange(source.num_bricks), revision)


def test_only_changed_bricks_are_updated():
    """A change without a revision is not noticed: only revisions mark changed bricks."""
    own, other = octree_of(cube((0, 0, 0), 4, [1.0, 2.0])), octree_of(cube((0, 0, 0), 4, [3.0, 2.0]))
    arguments = {"update": Update.NATURAL, "gamma": 0.0, "revision": 9}
    assert consensus_step(own, [other], [0.5], own.copy(), since=7, **arguments) == 0.0
    assert consensus_step(own, [other], [0.5], own.copy(), since=1, **arguments) == 1.0


def test_exp_negative():
    x = np.concatenate([np.linspace(-86.0, 0.0, 100_001), -np.logspace(-40, 1.9, 1000), [-0.0]]).astype(np.float32)
    found = np.array([consensus_kernels.exp_negative(value) for value in x])
    np.testing.assert_allclose(found, np.exp(x.astype(np.float64)), rtol=5e-7)
    for value in (-87.0, -104.0, -1e10, -3e38):
        assert 0.0 <= consensus_kernels.exp_negative(np.float32(value)) < 1e-37


def test_cells_of_a_neighbour_become_known_even_with_the_prior_value():
    octree, other = octree_of({(0, 0, 0): [1.0, 2.0]}), octree_of({(1, 1, 1): [0.0, 0.0], (40, 0, 0): [0.0, 0.0]})
    assert consensus_step(octree, [other], [0.0], octree.copy(), update=Update.NATURAL, gamma=0.5, revision=9) == 0.0
    assert set(cells_of(octree)) == {(0, 0, 0), (1, 1, 1), (40, 0, 0)}
    assert (octree.revisions == 9).all()


@long
@examples(25)
@given(seed=st.integers(0, 100_000), update=st.sampled_from(UPDATES), with_threads=st.booleans())
def test_team_step_equals_steps_robot_by_robot(seed, update, with_threads):
    """Robots with different cells, neighbours, weights and gammas; all bricks or only changed ones are updated."""
    rng = np.random.default_rng(seed)
    common = _random_cells(rng)
    maps, published, evidence, last = (
        [_octree(common | (_random_cells(rng) if rng.random() < 0.5 else {})) for _ in range(4)] for _ in range(4)
    )
    for octree in (*maps, *published, *evidence, *last):
        octree.revisions[:] = rng.integers(0, 3, octree.num_bricks)
    steps = []
    for robot in range(4):
        others = [other for other in range(4) if other != robot and rng.random() < 0.6]
        steps.append(
            Step(
                maps[robot], [published[other] for other in others], rng.uniform(0, 0.3, len(others)).tolist(),
                evidence[robot], float(rng.choice([0.0, 0.5])), published[robot] if rng.random() < 0.3 else None,
                last[robot], since=1 if rng.random() < 0.5 else None,
            )
        )  # fmt: skip
    alone = [dataclasses.replace(step, own=step.own.copy()) for step in steps]
    expected = [team_step([step], update=update, revision=7)[0] for step in alone]
    with ThreadPoolExecutor(3) as threads:
        found = team_step(steps, update=update, revision=7, threads=threads if with_threads else None)
    assert found == expected
    for step, other in zip(steps, alone, strict=True):
        assert cells_of(step.own) == cells_of(other.own)
        revisions = dict(zip(step.own.codes.tolist(), step.own.revisions.tolist(), strict=True))
        assert revisions == dict(zip(other.own.codes.tolist(), other.own.revisions.tolist(), strict=True))


def test_neighbours_and_evidence_are_not_changed():
    own, other, log_q, last = (octree_of(cube((i, 0, 0), 9, [i - 1.0, -i])) for i in range(4))
    before = [cells_of(octree) for octree in (other, log_q, last)]
    for update in UPDATES:
        consensus_step(own, [other], [0.5], log_q, update=update, gamma=0.5, revision=1, last_evidence=last)
    assert [cells_of(octree) for octree in (other, log_q, last)] == before


def test_uniform_free_space_stays_uniform():
    own, other = (octree_of(cube((0, 0, 0), 16, [value, value])) for value in (-5.0, -3.0))
    for update in (Update.GRADIENT, Update.NATURAL, Update.ADD):
        consensus_step(own, [other], [0.5], own.copy(), update=update, gamma=0.5, revision=1)
        assert (own.bricks.blocks[: own.num_bricks] == -1).all()
        assert len(own.leaves()) == 1


@pytest.mark.parametrize(
    ("power", "decay", "expected"), [(0.0, 1.0, 0.8), (1.0, 1.0, 0.8 / 5), (0.5, 2.0, 0.8 / 3**0.5)]
)
def test_gamma_schedule(power, decay, expected):
    consensus = team_config("a", gamma=0.8, gamma_power=power, gamma_decay=decay).consensus
    assert gamma_at(consensus, 4) == pytest.approx(expected)
    assert gamma_at(consensus, 0) == 0.8


def test_sum_of_evidence():
    a, b = cube((0, 0, 0), 2, [1.0, -2.0]), cube((1, 0, 0), 8, [4.0, 4.0])
    counts = {key: [2.0] for key in b}
    codes = np.unique(np.concatenate([octree_of(a).codes, octree_of(b).codes]))
    target = octree_of({})
    sum_of_evidence(target, [Evidence(octree_of(a), scale=0.5), Evidence(octree_of(b))], codes, 3)
    found = {key: np.frombuffer(value, np.float32).tolist() for key, value in cells_of(target).items()}
    assert found[0, 0, 0] == [0.5, -1.0]
    assert found[1, 0, 0] == [4.5, 3.0]
    assert found[8, 7, 7] == [4.0, 4.0]
    assert found.keys() == a.keys() | b.keys()
    assert (target.revisions == 3).all()
    single = octree_of({})
    sum_of_evidence(single, [Evidence(octree_of(b), scan_counts=octree_of(counts, num_classes=1))], codes, 3)
    assert {np.frombuffer(value, np.float32)[0] for value in cells_of(single).values()} == {2.0}


# --- whole runs ------------------------------------------------------------------------------------------------------

SHAPE = TeamShape(num_robots=5, num_ticks=24, image=(16, 12), resolution=0.4, scan_period=0.5, sensors="mixed")


@functools.lru_cache(maxsize=2)
def _scenario(shape=SHAPE):
    return make_scenario(2, shape)


def _session(shape=SHAPE, **parameters):
    if numba.config.DISABLE_JIT:
        pytest.skip("a whole run takes too long without the compiler")
    scenario = _scenario(shape)
    sources = frame_lists(scenario.robot_ids, scenario.frames)
    return Session(scenario.config(**parameters), sources, ThreadPoolExecutor(1))


@functools.lru_cache(maxsize=1)
def _every_cell():
    """Centres (M, 3) of all cells in the team's scans."""
    *_, tick = _session(rule="local", settle=0).ticks()
    keys = np.array(sorted(set().union(*(cells_of(octree) for octree in tick.maps))))
    return (keys + 0.5) * SHAPE.resolution


def _values(octree):
    """(M, C) float64 of a map at every cell."""
    return octree.lookup(_every_cell())[0].astype(np.float64)


@pytest.mark.parametrize(("mode", "topology"), one_in(9, ["sync", "on-arrival"], TOPOLOGIES))
def test_bayes_conserves_the_mean_and_converges_to_the_oracle(mode, topology):
    session = _session(rule="bayes", mode=mode, topology=topology)
    num_robots = len(_scenario().robot_ids)
    for tick in session.ticks():
        if tick.settling and tick.number % 10:
            continue
        total = np.sum([_values(octree) for octree in tick.maps], axis=0)
        evidence = np.sum([_values(robot.evidence.octree) for robot in session.team.robots], axis=0)
        np.testing.assert_array_equal(total, evidence)
    # Neighbours at rest differ by less than quantum / (2 epsilon A_ij), here at most N quanta.
    difference = num_robots**3 * session.config.consensus.effective_quantum
    for octree in tick.maps:
        np.testing.assert_allclose(num_robots * _values(octree), _values(tick.oracle), atol=difference)
    assert min(robot.agreement for robot in tick.metrics.robots) > 0.999


@pytest.mark.parametrize(("rule", "topology"), one_in(9, ["gradient", "natural", "bayes"], TOPOLOGIES))
def test_settling_removes_the_disagreement(rule, topology):
    session = _session(rule=rule, topology=topology)
    peak = 0.0
    for tick in session.ticks():
        peak = max(peak, tick.metrics.total_distance_all)
    assert tick.metrics.total_distance_all < (1e-6 if rule == "bayes" else 1e-9) * peak
    assert session.stop_reason == CONVERGED
    assert tick.metrics.label_disagreement < 1e-3
    assert min(robot.agreement_occupied for robot in tick.metrics.robots) >= 0.995


@long
def test_labels_of_gradient_are_those_of_the_oracle():
    """Cells that are barely free in the oracle converge slowly: classes hit once decrease at a rate of gamma."""
    session = _session(dataclasses.replace(SHAPE, num_ticks=120), rule="gradient", settle=100)
    *_, tick = session.ticks()
    assert min(robot.agreement for robot in tick.metrics.robots) >= 0.995
    assert min(robot.agreement_occupied for robot in tick.metrics.robots) >= 0.995


def test_without_exchange_the_maps_disagree():
    *_, tick = _session(rule="local").ticks()
    assert max(robot.agreement_occupied for robot in tick.metrics.robots) < 0.9
    assert tick.metrics.total_distance_all > 1000.0
