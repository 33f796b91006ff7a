"""Questions of docs/experiments.md: each module has the runs of one, and the tables and figures that answer it."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

from octoreplay.study.experiments import Question
from octoreplay.study.questions import (
    confidence,
    delay,
    drift,
    forgetting,
    frames,
    graphs,
    misalignment,
    noise,
    packets,
    prediction,
    radio,
    real,
    rules,
    scale,
    steps,
)

QUESTIONS: Mapping[str, Question] = MappingProxyType(
    {
        "rules": rules.QUESTION,
        "graphs": graphs.QUESTION,
        "forgetting": forgetting.QUESTION,
        "packets": packets.QUESTION,
        "radio": radio.QUESTION,
        "delay": delay.QUESTION,
        "noise": noise.QUESTION,
        "confidence": confidence.QUESTION,
        "steps": steps.QUESTION,
        "scale": scale.QUESTION,
        "frames": frames.QUESTION,
        "drift": drift.QUESTION,
        "misalignment": misalignment.QUESTION,
        "real": real.QUESTION,
        "prediction": prediction.QUESTION,
    }
)
"""Questions by name, in the order of the page."""
