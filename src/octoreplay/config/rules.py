"""Consensus rules and their traits."""

from __future__ import annotations

RULES = ("gradient", "bayes", "natural", "ratio", "flood", "merge", "local")
