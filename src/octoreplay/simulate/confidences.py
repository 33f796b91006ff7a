"""Confidences of a simulated network's labels: how probable errors are, and what the network says about it."""

from __future__ import annotations

import numpy as np

from octoreplay.records import Float64Array, UInt8Array
from octoreplay.simulate.camera import PATCH_GRID, patch_cells

_PLACES, _PIXELS = 2.0, 4.0
"""Concentrations of the beta distributions of places and of pixels: smaller ones spread the probabilities more."""
_LEAST = 1e-9
"""Least parameter of a beta distribution, which must be above 0."""


def largest_label_noise(num_candidates: int) -> float:
    """Share of wrong labels with which a label is a random one of ``num_candidates`` classes.

    No network is wrong more often where it says so: its label is its most probable class.
    """
    return 1.0 - 1.0 / num_candidates


class LabelErrors:
    """Probabilities with which the labels of a robot's network are wrong.

    Cubes of 2 m have probabilities of their own, the pixels in them others around these, drawn for each image. Both
    are beta distributed from 0 to ``largest_label_noise(num_candidates)``, with the mean ``share`` over all pixels.
    """

    def __init__(self, share: float, num_candidates: int, rng: np.random.Generator) -> None:
        self._most = largest_label_noise(num_candidates)
        self._places = _beta(np.full(PATCH_GRID, share / self._most), _PLACES, rng)

    def probabilities(self, points: Float64Array, rng: np.random.Generator) -> Float64Array:
        """Return the probabilities (H, W) of an image's pixels, which are at ``points`` (H, W, 3) in the world [m]."""
        return self._most * _beta(self._places[patch_cells(points)], _PIXELS, rng)


def softmax_confidences(errors: Float64Array, num_candidates: int, temperature: float) -> UInt8Array:
    """Return the confidences uint8, in 255ths, of labels that are wrong with the probabilities ``errors``.

    Without a ``temperature`` other than 1 a confidence is 1 - error. The other classes share the error evenly, and the
    logits of this distribution are divided by the temperature: below 1 the network is too certain.
    """
    num_others = num_candidates - 1
    right = (1.0 - errors) ** (1.0 / temperature)
    wrong = num_others * (errors / num_others) ** (1.0 / temperature)
    return np.rint(255.0 * right / (right + wrong)).astype(np.uint8)


def _beta(means: Float64Array, concentration: float, rng: np.random.Generator) -> Float64Array:
    """Beta distributed numbers with these means; the smaller ``concentration``, the more are near 0 and 1."""
    return rng.beta(*(np.maximum(concentration * part, _LEAST) for part in (means, 1.0 - means)))
