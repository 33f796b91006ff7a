"""Work files of the ticks of a tile."""

from __future__ import annotations

import numpy as np
import pytest

from octoreplay.config.network import NetworkConfig
from octoreplay.errors import InputError
from octoreplay.replay.network.graph import build_graph
from octoreplay.replay.tick_counts import TickCounts
from octoreplay.run_metrics import LinkMetrics
from octoreplay.study.tiles.work import TileTick, WorkFile, read_ticks

LINKS = (
    LinkMetrics("a", "b", 1, 80, 1, 80, 0, 0, 0, 0, 0, 0, 80.0),
    LinkMetrics("b", "a", 2, 90, 0, 0, 2, 0, 0, 0, 0, 0, 90.5),
)


def graph(is_linked):
    hears = np.array([[False, is_linked], [is_linked, False]])
    return build_graph(NetworkConfig(), ("a", "b"), [True, True], hears)


def tick(number, of_tick, links):
    counts = TickCounts(1.5, None, 0.0, (), links, ())
    return TileTick(number, number * 10**9, False, of_tick, (), counts)


def test_ticks_come_back_with_their_graphs_and_links(tmp_path) -> None:
    path, linked, apart = tmp_path / "tile.ticks", graph(True), graph(False)
    with WorkFile(path, 0) as file:
        for number, of_tick in enumerate([linked, linked, apart]):
            file.write_tick(tick(number, of_tick, LINKS[:number]))
        length = file.flush()
    # A file that is continued does not know the graph before.
    with WorkFile(path, length) as file:
        file.write_tick(tick(3, apart, LINKS))
        file.flush()
    found = list(read_ticks(path))
    assert [each.number for each in found] == [0, 1, 2, 3]
    assert [each.graph.links for each in found] == [linked.links, linked.links, (), ()]
    assert [each.counts.links for each in found] == [(), LINKS[:1], LINKS, LINKS]
    assert [each.counts.published_distance for each in found] == [1.5] * 4


def test_a_cut_file_is_refused(tmp_path) -> None:
    path = tmp_path / "tile.ticks"
    with WorkFile(path, 0) as file:
        file.write_tick(tick(0, graph(True), LINKS))
        length = file.flush()
    path.write_bytes(path.read_bytes()[: length - 1])
    with pytest.raises(InputError, match=r"tile\.ticks: cannot be read: it is cut; run with --restart"):
        list(read_ticks(path))
