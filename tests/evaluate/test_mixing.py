"""Theory of mixing against known spectra and against simulated mixing."""

import numpy as np
import pytest

from octoreplay.evaluate import mixing

SPECTRA = {
    # Metropolis weights are 1/6 on every link of a complete graph of six, 1/3 on a ring, 1/4 on a star of four.
    ("complete", 6): [1, 1, 1, 1, 1],
    ("ring", 6): [(2 - 2 * np.cos(2 * np.pi * k / 6)) / 3 for k in range(1, 6)],
    ("star", 4): [1 / 4, 1 / 4, 1],
    ("line", 2): [1],
}
"""Non-zero eigenvalues of L by topology and number of robots."""


@pytest.mark.parametrize(("graph", "spectrum"), SPECTRA.items())
def test_bound_and_contraction_follow_from_known_spectra(graph: tuple[str, int], spectrum: list[float]) -> None:
    assert mixing.epsilon_bound(*graph) == pytest.approx(1 / max(spectrum))
    for epsilon in (0.1, 0.5, 0.7, 1.1):
        slowest = max(abs(1 - 2 * epsilon * mu) for mu in spectrum)
        assert mixing.contraction(*graph, epsilon) == pytest.approx(slowest**2, rel=1e-9, abs=1e-20)


def test_a_complete_graph_agrees_in_one_step() -> None:
    assert mixing.contraction("complete", 6, 0.5) == pytest.approx(0.0, abs=1e-20)


@pytest.mark.parametrize("topology", ["complete", "ring", "line", "star"])
@pytest.mark.parametrize("share", [0.3, 0.7, 0.95, 1.02])
def test_simulated_mixing_contracts_as_in_theory(topology: str, share: float) -> None:
    edges = {
        "complete": [(i, j) for i in range(6) for j in range(i)],
        "ring": [(i, (i + 1) % 6) for i in range(6)],
        "line": [(i, i + 1) for i in range(5)],
        "star": [(0, i) for i in range(1, 6)],
    }[topology]
    degrees = np.bincount(np.array(edges).ravel(), minlength=6)
    epsilon = share * mixing.epsilon_bound(topology, 6)
    values = np.random.default_rng(0).normal(size=6)

    def distance() -> float:
        return float(sum((values[i] - values[j]) ** 2 for i, j in edges))

    for _ in range(400):
        # Mixing is linear, so the deviations from the mean are scaled in every step to keep them from vanishing.
        values = (values - values.mean()) / values.std()
        before = distance()
        change = np.zeros(6)
        for i, j in edges:
            weight = 1 / (1 + max(degrees[i], degrees[j]))
            change[i] += weight * (values[j] - values[i])
            change[j] += weight * (values[i] - values[j])
        values = values + 2 * epsilon * change
    factor = distance() / before
    assert factor == pytest.approx(mixing.contraction(topology, 6, epsilon), rel=1e-3)
    assert (factor > 1) == (share > 1)
