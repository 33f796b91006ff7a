"""State machines of Hypothesis in random trials: few steps by default, many in a campaign."""

from __future__ import annotations

from hypothesis import HealthCheck, Phase, seed, settings
from hypothesis.stateful import RuleBasedStateMachine, run_state_machine_as_test

from support.trials import Trials


def run_machine(machine: type[RuleBasedStateMachine], trials: Trials, *, num_examples: int, num_steps: int) -> None:
    """Run a state machine in trials of ``num_examples`` sequences with ``num_steps`` steps at most."""
    few, many = 1, 100_000
    for rng in trials.rounds(few, many):
        seeded = seed(int(rng.integers(1 << 31)))(type(machine.__name__, (machine,), {}))
        run_state_machine_as_test(
            seeded,
            settings=settings(
                max_examples=num_examples, stateful_step_count=num_steps, deadline=None, database=None,
                derandomize=False, suppress_health_check=list(HealthCheck), phases=[Phase.generate, Phase.shrink],
            ),
        )  # fmt: skip
