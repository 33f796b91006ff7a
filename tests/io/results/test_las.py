"""LAS and LAZ files, read back by laspy with the decoder of LASzip."""

from __future__ import annotations

import builtins
import datetime
import io

import numpy as np
import pytest

from octoreplay.errors import ConfigError
from octoreplay.io.results import las
from octoreplay.log_odds import label_probabilities
from support.result_factory import CLASSES, leaf_table

COLORS = np.array([[250, 1, 2], [3, 200, 5], [10, 20, 30], [255, 255, 255]], np.uint8)
DAY = datetime.date(2023, 11, 14)


def points_file(*, compressed: bool) -> bytes:
    robots = np.array([0, 1, 1, 2])
    return las.points_file(leaf_table(), COLORS, CLASSES, robots, DAY, compressed=compressed)


@pytest.mark.parametrize("compressed", [True, False])
def test_laszip_reads_points_classes_and_extra_dimensions(compressed: bool) -> None:
    laspy = pytest.importorskip("laspy")
    data = points_file(compressed=compressed)
    backend = laspy.LazBackend.Laszip if compressed else None
    points, leaves = laspy.read(io.BytesIO(data), laz_backend=backend), leaf_table()
    assert points.header.are_points_compressed == compressed
    np.testing.assert_allclose(points.xyz, leaves.centers, atol=5e-5)
    assert np.asarray(points.classification).tolist() == [1, 2, 1, 0]
    channels = np.column_stack([points.red, points.green, points.blue])
    assert (channels >> 8).tolist() == COLORS.tolist()
    np.testing.assert_allclose(points["probability"], label_probabilities(leaves.log_odds))
    np.testing.assert_allclose(points["size"], leaves.sizes, rtol=1e-6)
    assert np.asarray(points["robot"]).tolist() == [0, 1, 1, 2]
    assert points.header.creation_date == DAY
    (names,) = points.header.vlrs.get("ClassificationLookupVlr")
    assert names.lookups == {0: "free", 1: "ground", 2: "tree"}
    assert points_file(compressed=compressed) == data


def test_a_missing_package_is_named_with_its_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    original = builtins.__import__

    def without_lazrs(name: str, *rest: object, **names: object) -> object:
        if name == "lazrs":
            raise ImportError("No module named 'lazrs'", name="lazrs")
        return original(name, *rest, **names)

    monkeypatch.setattr(builtins, "__import__", without_lazrs)
    with pytest.raises(ConfigError, match=r"need the package lazrs; install it with: pip install 'octoreplay\[las\]'"):
        points_file(compressed=True)
