"""Logs that are damaged in any way give messages and a sentence, or are refused with one; never anything else."""

from __future__ import annotations

import random
import shutil

import pytest

from support.log_damage import CONTAINERS, damage_log, read_all

CASES = 60


@pytest.mark.parametrize("container", CONTAINERS)
def test_damage_is_a_sentence_never_a_traceback(tmp_path, container):
    (tmp_path / "good").mkdir()
    good = CONTAINERS[container](tmp_path / "good")
    written = read_all(good)
    assert (len(written.messages), written.damage, written.refusal) == (60, None, None)
    genuine = set(written.messages)
    num_refused = num_kept = 0
    for seed in range(CASES):
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
    # Much of what was written survives most damage, or the reader gives up too early; a small file that is compressed
    # as a whole is one block of zstd, of which nothing survives.
    if not container.endswith("files"):
        assert num_refused < 0.55 * CASES
        assert num_kept > 60 * CASES / 4
