"""CoPeD: ground and aerial robots with cameras, the ground robots with a lidar."""

from __future__ import annotations

from types import MappingProxyType

from octoreplay.io.datasets.catalogue.bags import Bags

DATA_SET = Bags(
    name="coped",
    title="CoPeD",
    holds=(
        "bags of ground robots with a lidar, and of aerial robots with stereo cameras only, from which octoreplay "
        "computes no depth"
    ),
    checked="documentation (topics, types)",
    sources=("https://github.com/arplaboratory/CoPeD", "https://arxiv.org/abs/2405.14731"),
    notes=(
        (
            "Only the ground robots are mapped. The aerial robots have stereo cameras: compute depth images with a "
            "stereo matcher to map them."
        ),
    ),
    topic=r"/lidar_points",
    example="/lidar_points",
    no_poses="the published list of topics has none with poses",
    map_frame="odom",
    parameters=MappingProxyType({"max_range": 40.0}),
)
