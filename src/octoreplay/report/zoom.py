"""Limits of y axes that make crowded values distinguishable."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

import numpy as np

from octoreplay.records import Float64Array

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_SHARES = (1.0, 0.9, 0.99, 0.999, 0.9999, 0.99999, 0.0, 0.5, 0.95, 0.995, 0.9995, 0.98, 0.998, 0.9998, 0.2, 0.8)
"""Labels of an axis of shares near 1, the first ones first where there is no room for all."""
_MARGIN = 0.06
_CROWDED = 0.1
"""Part of the whole range in which the upper half of the values lies where an axis of shares is stretched near 1."""
_TICK_GAP = 0.15
"""Least distance of labels on an axis of shares near 1, as a part of its length."""
_LEAST_REST = 1e-5
"""Least share 1 - y that an axis of shares near 1 resolves."""


def finite(values: Iterable[Any]) -> Float64Array:
    """Return all finite numbers of some arrays (n,)."""
    joined = np.concatenate([np.ravel(np.asarray(part, np.float64)) for part in values] or [np.empty(0)])
    return np.asarray(joined[np.isfinite(joined)])


def zoom_shares(axes: Axes, values: Iterable[Any]) -> None:
    """Set the scale, limits and labels of a y axis of shares 0..1, so that shares near 1 can be told apart.

    The limits are those of the values. Where half of the values crowd just below 1, the axis is logarithmic in 1 - y.
    """
    shares = finite(values)
    if not shares.size:
        return
    low, high, middle = float(shares.min()), float(shares.max()), float(np.median(shares))
    if high > 0.9 and high - middle < _CROWDED * (high - low):
        _stretch(axes, low, shares)
    else:
        zoom_values(axes, [shares], 0.0, 1.0)
        axes.yaxis.set_major_formatter(_percent)


def zoom_rests(axes: Axes, values: Iterable[Any]) -> None:
    """Set the scale, limits and labels of a y axis of shares 0..1 that are small, such as those of errors.

    Where half of the values crowd just above 0, the axis is linear up to the least that it resolves, and logarithmic
    above it.
    """
    shares = finite(values)
    if not shares.size:
        return
    high, middle = float(shares.max()), float(np.median(shares))
    if high > 0.0 and middle < _CROWDED * high:
        least = max(float(np.percentile(shares[shares > 0], 5)), _LEAST_REST)
        axes.set_yscale("symlog", linthresh=least)
        axes.set_ylim(-0.1 * least, 1.5 * high)
    else:
        zoom_values(axes, [shares], 0.0, 1.0)
    axes.yaxis.set_major_formatter(_percent)


def zoom_values(axes: Axes, values: Iterable[Any], least: float = -np.inf, most: float = np.inf) -> None:
    """Set the limits of a y axis to those of the values with a margin, within ``least`` and ``most``."""
    numbers = finite(values)
    if not numbers.size:
        return
    low, high = float(numbers.min()), float(numbers.max())
    margin = _MARGIN * (high - low) or 0.05 * max(abs(high), 1e-3)
    # Curves at a limit stay visible.
    floor, ceiling = least - 0.3 * margin, most + 0.3 * margin
    axes.set_ylim(max(low - margin, floor), min(high + margin, ceiling))


def _stretch(axes: Axes, low: float, shares: Float64Array) -> None:
    """Make a y axis logarithmic in 1 - y."""
    from matplotlib import rcParams
    from matplotlib.ticker import FixedLocator, NullLocator

    rest = 1.0 - shares
    least = max(float(rest[rest > 0].min(initial=1.0)), _LEAST_REST) / 2

    def forward(share: Any) -> Any:
        return -np.log10(np.maximum(1.0 - np.asarray(share) + least, 1e-3 * least))

    def back(place: Any) -> Any:
        return 1.0 + least - np.power(10.0, -np.asarray(place))

    axes.set_yscale("function", functions=(forward, back))
    bottom, top = forward(low), forward(1.0)
    # Curves at 1 stay visible.
    axes.set_ylim(back(bottom - _MARGIN * (top - bottom)), 1.0 + 0.3 * least)
    height = 72 * axes.bbox.height / axes.figure.dpi
    gap = max(_TICK_GAP, 2.0 * rcParams["font.size"] / height) * (top - bottom)
    ticks: list[float] = []
    for share in (share for share in _SHARES if share >= low - 0.02):
        if all(abs(forward(other) - forward(share)) > gap for other in ticks):
            ticks.append(share)
    axes.yaxis.set_major_locator(FixedLocator(ticks))
    axes.yaxis.set_minor_locator(NullLocator())
    axes.yaxis.set_major_formatter(_percent)


def _percent(share: float, _: Any = None) -> str:
    """Share in percent, with as many digits as it needs."""
    return f"{100 * share:.6g} %"
