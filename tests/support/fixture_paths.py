"""Paths of the committed logs (tests/fixtures/README.md)."""

from pathlib import Path

FIXTURES = Path(__file__).resolve().parents[1] / "fixtures"
PAIR = FIXTURES / "pair"
TRIO = FIXTURES / "trio"
PAIR_TEAM = PAIR / "team.yaml"
TRIO_TEAM = TRIO / "team.yaml"
CONTAINERS, STREAMS = FIXTURES / "containers", FIXTURES / "streams"
