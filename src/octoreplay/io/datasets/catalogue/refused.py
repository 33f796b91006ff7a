"""Data sets that cannot be mapped as they are published."""

from __future__ import annotations

from dataclasses import dataclass

from octoreplay.errors import InputError
from octoreplay.io.datasets.catalogue.data_set import DataSet, Team, Work


@dataclass(frozen=True, kw_only=True)
class Refused(DataSet):
    """A data set without a sensor that octoreplay reads, for a ``reason`` that ends with the remedy."""

    reason: str

    def team(self, work: Work) -> Team:
        """Raise InputError with the reason."""
        raise InputError(f"{work.folder}: {self.title}: {self.reason}")


SUBT_MRS = Refused(
    name="subt-mrs",
    title="SubT-MRS",
    holds="several ROS 1 bags for each sequence; those of the challenge of ICCV 2023 hold velodyne_msgs/VelodyneScan",
    checked="answers of users and authors to questions (message type); a user's tool (topic of one sequence)",
    sources=(
        "https://superodometry.com/iccv23_challenge_LiI",
        "https://github.com/yuanjun-gao/ICCV2023_SLAM_Challenge/issues/24",
        "https://github.com/dhchung/iccv2023_slam_bag_merger",
    ),
    reason=(
        "the topic of one sequence only was found (/velodyne_packets), and not the frame of the true poses; give the "
        "bags of one sequence to init, with the extra velodyne where they hold packets only"
    ),
)
