"""What linear algebra says of mixing on a fixed graph with Metropolis weights, to hold measurements against.

One synchronous step of mixing is h <- (I - 2 epsilon L) h (docs/algorithm.md). On connected graphs the distance from
the mean shrinks in the long run by max |1 - 2 epsilon mu| a step, over the eigenvalues mu > 0 of L, and Phi, which is
quadratic, by the square of that (Xiao and Boyd, Fast linear iterations for distributed averaging, 2004).
"""

from __future__ import annotations

import numpy as np

from octoreplay.records import Float64Array


def eigenvalues(topology: str, num_robots: int) -> Float64Array:
    """The eigenvalues (N,) of L in ascending order, of a ``complete``, ``ring``, ``line`` or ``star`` graph."""
    import networkx as nx

    make = {"complete": nx.complete_graph, "ring": nx.cycle_graph, "line": nx.path_graph}
    graph = nx.star_graph(num_robots - 1) if topology == "star" else make[topology](num_robots)
    for i, j in graph.edges:
        graph.edges[i, j]["weight"] = 1.0 / (1 + max(graph.degree[i], graph.degree[j]))
    found: Float64Array = np.sort(np.linalg.eigvalsh(nx.laplacian_matrix(graph).toarray()))
    return found


def epsilon_bound(topology: str, num_robots: int) -> float:
    """Mixing converges for every epsilon below this, and for none above it."""
    return 1.0 / float(eigenvalues(topology, num_robots)[-1])


def contraction(topology: str, num_robots: int, epsilon: float) -> float:
    """The factor by which Phi shrinks in a step, in the long run."""
    return float(np.abs(1.0 - 2.0 * epsilon * eigenvalues(topology, num_robots)[1:]).max() ** 2)
