"""Runs with a damaged kernel cache, as processes: the same result bytes and one line."""

from __future__ import annotations

import random
import shutil
from pathlib import Path

import pytest

from octoreplay.mapping.kernels import compiler
from support.command_line import octoreplay_process
from support.fixture_paths import PAIR_TEAM
from support.log_damage import MUTATIONS
from support.trials import Trials


@pytest.mark.long
def test_a_damaged_kernel_cache_does_not_change_a_result(pair_result: Path, tmp_path: Path, trials: Trials) -> None:
    cache = compiler._CACHE_FOLDER
    assert cache is not None
    # The kernels of a run are in the cache before it is damaged.
    first = tmp_path / "first.mcap"
    assert octoreplay_process("run", PAIR_TEAM, "-o", first).returncode == 0
    for number, rng in enumerate(trials.rounds(1, 100)):
        mutations = random.Random(int(rng.integers(1 << 30)))
        damaged = shutil.copytree(cache, tmp_path / f"cache {number}" / cache.name)
        # A run loads only the kernels that it calls, so many files are damaged.
        for path in mutations.sample(sorted(damaged.iterdir()), len(list(damaged.iterdir())) // 3):
            mutation = mutations.choice([*MUTATIONS, lambda data, _: b""])
            path.write_bytes(mutation(path.read_bytes(), mutations))
        output = tmp_path / f"{number}.mcap"
        done = octoreplay_process("run", PAIR_TEAM, "-o", output, NUMBA_CACHE_DIR=str(damaged.parent))
        assert done.returncode == 0, done.stderr
        assert done.stderr.count("\n") == 1, done.stderr
        assert "this compiled kernel is damaged; it is compiled anew" in done.stderr
        assert output.read_bytes() == first.read_bytes()
        shutil.rmtree(damaged.parent)
        output.unlink()
