"""Damaged logs give messages and a sentence, or are refused with a sentence; nothing else is raised."""

from __future__ import annotations

import random
import shutil

import pytest

from support.log_damage import CONTAINERS, damage_log, read_all

CASES = [pytest.param(range(30), id="few"), pytest.param(range(30, 300), id="many", marks=pytest.mark.long)]


@pytest.mark.parametrize("cases", CASES)
@pytest.mark.parametrize("container", CONTAINERS)
def test_damage_gives_messages_or_a_sentence(tmp_path, container, cases):
    (tmp_path / "good").mkdir()
    good = CONTAINERS[container](tmp_path / "good")
    written = read_all(good)
    assert (len(written.messages), written.damage, written.refusal) == (60, None, None)
    genuine = set(written.messages)
    num_refused = num_kept = 0
    for seed in cases:
        rng = random.Random(f"{container} {seed}")
        path = tmp_path / good.name
        if good.is_dir():
            shutil.rmtree(path, ignore_errors=True)
            shutil.copytree(good, path)
        else:
            shutil.copyfile(good, path)
        what = damage_log(path, rng)
        outcome = read_all(path)
        for sentence in (outcome.damage, outcome.refusal):
            assert sentence is None or sentence.startswith(str(path)), (seed, what)
        num_refused += outcome.refusal is not None
        num_kept += len(genuine.intersection(outcome.messages))
    # Most messages survive most damage. Nothing survives in a small file that is compressed as a whole, since it is one
    # block of zstd.
    if not container.endswith("files"):
        assert num_refused < 0.55 * len(cases)
        assert num_kept > 60 * len(cases) / 4
