"""Theory of mixing against known spectra, and against mixing itself."""

import numpy as np
import pytest

from octoreplay.evaluate import mixing


def test_known_spectra() -> None:
    # Metropolis: 1/6 on every link of a complete graph of six, 1/3 on a ring.
    assert mixing.eigenvalues("complete", 6) == pytest.approx([0, 1, 1, 1, 1, 1])
    assert mixing.eigenvalues("ring", 6) == pytest.approx(
        sorted((2 - 2 * np.cos(2 * np.pi * k / 6)) / 3 for k in range(6))
    )
    # A star of four: 1/4 on each of its three links.
    assert mixing.eigenvalues("star", 4) == pytest.approx([0, 1 / 4, 1 / 4, 1])
    assert mixing.eigenvalues("line", 2) == pytest.approx([0, 1])


def test_the_complete_graph_agrees_in_one_step() -> None:
    assert mixing.contraction("complete", 6, 0.5) == pytest.approx(0.0, abs=1e-20)


@pytest.mark.parametrize("topology", ["complete", "ring", "line", "star"])
@pytest.mark.parametrize("share", [0.3, 0.7, 0.95, 1.02])
def test_mixing_shrinks_and_grows_as_theory_says(topology: str, share: float) -> None:
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
        # Mixing is linear: deviations from the mean may be scaled so that they do not vanish.
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
