"""Remedies for a robot whose logs hold no poses."""

from __future__ import annotations

from collections.abc import Sequence

from octoreplay.config.file_url import InputFile

STILL_REMEDY = "pose: [x, y, z, qx, qy, qz, qw] (--static-pose) for a sensor that stands still"
"""Remedy for a sensor that stands still, as an error names it after 'give'."""


def odometry_remedy(logs: Sequence[InputFile]) -> str:
    """Return the command that estimates poses from the scans of some logs."""
    return f"'octoreplay odometry {' '.join(map(str, logs))} -o {logs[0].stem}.tum' estimates them from its scans"
