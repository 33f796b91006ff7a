"""Mutated files of every kind: no exception but octoreplay's own, no hang, and no more memory than the bound."""

from __future__ import annotations

import itertools
import random
import struct
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from octoreplay.config.class_file import with_classes
from octoreplay.config.frames_file import load_frames_file
from octoreplay.config.robot import POSE_FORMATS
from octoreplay.config.run import RunConfig
from octoreplay.config.team_file import dump_team, load_schedule, load_team_file, parse_team
from octoreplay.config.yaml_file import load_yaml
from octoreplay.errors import PacketError
from octoreplay.evaluate.comparison import compare_results
from octoreplay.io.datasets.cloud_files import read_cloud
from octoreplay.io.datasets.pose_files import read_keyframe, read_pose_graph, read_poses, read_tum_track
from octoreplay.io.robots.trajectories import read_rows, read_times
from octoreplay.mapping.codec import DELTA, FULL, MapVersion, PacketFormat, apply_delta, decode_packet, pack
from octoreplay.mapping.octree import SemanticOctree
from octoreplay.mapping.quantise import CONTENTS, quantised
from octoreplay.report import tables
from octoreplay.report.export import export_map
from octoreplay.result import open_result
from support.bounded import outcomes
from support.cloud_folders import save_pcd, tum_table
from support.fixture_paths import FIXTURES, PAIR_TEAM, TRIO_TEAM
from support.hostile_logs import LOGS, map_of_log, write_hostile_log
from support.mutations import mutated, mutated_packet, mutated_result, mutated_text, mutated_yaml
from support.octree_factory import cube, octree_of
from support.trials import Trials

BATCH, SECONDS, LARGEST = 100, 20.0, 750_000_000

Case = Callable[[], Any]

TEAM = """
robots:
- {id: a, log: [a.mcap, b.bag], depth_topic: /d, pose_file: p.txt, intrinsics: [1, 1, 0, 0], clock_offset: 0.5,
   T_team_map: [0, 0, 0, 0, 0, 0, 1], T_team_map_sigma: [1, 1, 1, 1, 1, 1], body_box: [-1, -1, -1, 1, 1, 1],
   publish_period: 2.0}
- {id: b, log: b.mcap, cloud_topic: /c, label_field: label, depth_unit: 0.001, rectified: true}
- {id: c, log: c.mcap, T_body_sensor: [0, 0, 0, 0, 0, 0, 1]}
classes: [{name: road, color: [1, 2, 3], raw_labels: [1, 2]}, {name: tree, raw_labels: 7, raw_colors: [[9, 9, 9]]}]
ignored_raw_labels: [255]
merge_classes: {all: [road, tree]}
topology: edges
weights: given
edges: [[a, b, 0.5], [b, c, 0.25]]
one_way: [[a, c]]
schedule: [{from: 1, to: 2.5, robots_off: [a], forget: true}, {from: 3, links_down: [[a, b]], groups: [[a], [b, c]]}]
links: [{between: [a, b], loss: 0.5}, {from: b, to: c, latency: 1}]
settle: 5
bounds: [-9, -9, -1, 9, 9, 4]
prune_tolerance: 0.1
"""
SCHEDULE = (
    "- {from: 1, to: 2.5, robots_off: [a], forget: true}\n- {from: 3, links_down: [[a, b]], groups: [[a], [b]]}\n"
)
CLASSES = """
classes:
- {name: road, color: [1, 2, 3], raw_labels: [1, 2]}
- {name: tree, raw_labels: 7}
ignore_hits: [tree]
"""
HYDRA = (
    "label_names:\n- {label: 0, name: unknown}\n- {label: 1, name: road}\ndynamic_labels: [1]\ninvalid_labels: [0]\n"
)
KIMERA = 'name,red,green,blue,alpha,id\nroad,1,2,3,255,1\n"a, tree",4,5,6,255,2\n'
FRAMES = "T_team_map:\n  a: [0, 0, 0, 0, 0, 0, 1]\n  b: [1, 2, 3, 0, 0, 0, 1]\n"


def written(path: Path, content: bytes | str) -> Path:
    """A file."""
    path.write_bytes(content.encode("utf-8", "surrogatepass") if isinstance(content, str) else content)
    return path


class Kind:
    """Mutations of one kind of file; ``case`` makes one in a folder and returns what reads it."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def case(self, rng: random.Random) -> Case:
        raise NotImplementedError


class TeamFiles(Kind):
    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        texts = [TEAM, PAIR_TEAM.read_text(encoding="utf-8"), SCHEDULE, CLASSES, HYDRA, FRAMES]
        self.seeds = [(load_yaml(text, "seed"), text) for text in texts]
        self.config = load_team_file(TRIO_TEAM)

    def case(self, rng: random.Random) -> Case:
        index = rng.choice([0, 0, 0, 1, 2, 3, 4, 5, 6])
        if index == 6:
            path = written(self.folder / f"{rng.random()}.csv", mutated_text(KIMERA, rng))
            return lambda: with_classes(self.config, str(path))
        text = mutated_yaml(*self.seeds[index], rng, tuple(text for _, text in self.seeds))
        path = written(self.folder / f"{rng.random()}.yaml", text)
        readers: tuple[Case, ...] = (
            partial(self.team, path), partial(self.team, path), partial(load_schedule, path),
            partial(with_classes, self.config, str(path)), partial(with_classes, self.config, str(path)),
            partial(load_frames_file, path),
        )  # fmt: skip
        return readers[index]

    @staticmethod
    def team(path: Path) -> RunConfig:
        """A team file that is read is equal to the one that is written."""
        config = load_team_file(path)
        again = parse_team(dump_team(config, with_defaults=True), name="again", folder=Path())
        assert repr(again.network) == repr(config.network)
        return config


class Packets(Kind):
    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        octree = octree_of(
            cube((-3, -1, 0), 5, [-0.3, -0.3]) | cube((16, 16, 16), 16, [1, 1]) | {(0, 1, 2): [1.0, -0.3]}
        )
        self.octree, self.seeds = octree, []
        for content, level, kind in itertools.product(CONTENTS, (None, 1), (FULL, DELTA)):
            one = quantised(octree, content, 0.05)
            version = MapVersion(1, 2, 3, 3 * (kind == DELTA), 5)
            self.seeds.append(pack(one, one.streams(), kind, PacketFormat(content, 0.05, level), version))

    def case(self, rng: random.Random) -> Case:
        data = mutated_packet(rng.choice(self.seeds), rng, tuple(self.seeds))

        def read() -> None:
            octree: SemanticOctree = self.octree.copy()
            try:
                octree = decode_packet(data)
            except PacketError:
                apply_delta(octree, data)
            octree.lookup(np.zeros((3, 3)))

        return read


class Results(Kind):
    def case(self, rng: random.Random) -> Case:
        name = rng.choice(["result_2.mcap", "result_3.mcap"])
        path = self.folder / f"{rng.random()}.mcap"
        mutated_result((FIXTURES / name).read_bytes(), rng, path)

        def read() -> None:
            with open_result(path) as result, (self.folder / "out.txt").open("w", encoding="utf-8") as out:
                tables.show(tables.terminal(file=out), tables.results(result.summary), result.inputs)
                result.map(result.robots[0]).query(np.zeros((3, 3)))
                result.evidence(result.robots[-1]).leaves()
                for _ in result.history():
                    pass
            export_map(path, self.folder / "out.ply")
            compare_results(path, FIXTURES / name)

        return read


class Logs(Kind):
    def case(self, rng: random.Random) -> Case:
        while True:
            folder = self.folder / str(rng.random())
            folder.mkdir()
            try:
                path, _ = write_hostile_log(rng.choice(LOGS), folder, rng)
                break
            except struct.error:
                # A changed time may be one that no log can hold.
                continue
        return lambda: map_of_log(path, is_run=False)


_POSE_READERS = (read_rows, read_times, read_poses, read_tum_track, read_pose_graph, read_keyframe)


class Trajectories(Kind):
    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        tum = tum_table(folder / "tum.txt", tuple(f"170000000{n}.25" for n in range(9))).read_text(encoding="utf-8")
        graph = "VERTEX_SE3:QUAT 1 0 0 1 0 0 0 1\nVERTEX_SE3:QUAT 2 1 0 1 0 0 0 1\nEDGE_SE3:QUAT 1 2 1 0 0 0 0 0 1\n"
        matrix = "1 0 0 1\n0 1 0 2\n0 0 1 3\n0 0 0 1\n"
        keyframe = f"stamp 1700000000 5\nestimate\n{matrix}odom\n{matrix}id 7\n"
        times = "\n".join(f"{n}.5" for n in range(9))
        redwood = "".join(f"{n} {n} {n + 1}\n{matrix}" for n in range(3))
        euroc = "#timestamp_kf,x,y,z,qw,qx,qy,qz\n1403636580838555648,1,2,3,0.8,0.6,0,0\n"
        geodetic = "time latitude longitude altitude qx qy qz qw\n1 48 11 5 0 0 0.6 0.8\n"
        self.seeds = (tum, "1 0 0 1 0 1 0 2 0 0 1 3\n" * 6, times, redwood, graph, keyframe, euroc, geodetic)

    def case(self, rng: random.Random) -> Case:
        text = mutated_text(rng.choice(self.seeds), rng, self.seeds)
        data = mutated(text.encode(), rng) if rng.random() < 0.2 else text.encode()
        path = written(self.folder / f"{rng.random()}.txt", data)
        if rng.random() < 0.3:
            return partial(read_rows, path, rng.choice(POSE_FORMATS), (48.0, 11.0, 0.0))
        return partial(rng.choice(_POSE_READERS), path)


class CloudFiles(Kind):
    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        self.seeds = []
        for index in range(3):
            save_pcd(folder / "seed.pcd", index)
            self.seeds.append((".pcd", (folder / "seed.pcd").read_bytes()))
        head, _, body = self.seeds[0][1].partition(b"DATA")
        self.seeds.append((".pcd", head + b"DATA binary_compressed\n" + body))
        names = ("float x", "float y", "double z", "uchar red", "ushort label")
        head = "".join(f"property {name}\n" for name in names)
        head = f"ply\nformat {{}} 1.0\nelement vertex 20\n{head}end_header\n"
        rows = "".join(f"{n} {n / 3} -1.5 255 {n}\n" for n in range(20))
        self.seeds.append((".ply", (head.format("ascii") + rows).encode()))
        points = np.zeros(20, [("x", "<f4"), ("y", "<f4"), ("z", "<f8"), ("red", "u1"), ("label", "<u2")])
        self.seeds.append((".ply", head.format("binary_little_endian").encode() + points.tobytes()))
        self.seeds.append((".bin", np.arange(64, dtype="<f4").tobytes()))

    def case(self, rng: random.Random) -> Case:
        suffix, data = rng.choice(self.seeds)
        if rng.random() < 0.4:
            data = mutated_text(data.decode("latin-1"), rng).encode("latin-1", "replace")
        else:
            data = mutated(data, rng, tuple(seed for _, seed in self.seeds))
        return partial(read_cloud, written(self.folder / f"{rng.random()}{suffix}", data))


KINDS = {
    # Number of mutations by default, and at most in a campaign.
    "team files": (TeamFiles, 60, 12_000), "packets": (Packets, 150, 40_000), "results": (Results, 10, 8_000),
    "logs": (Logs, 5, 8_000), "trajectories": (Trajectories, 100, 20_000), "clouds": (CloudFiles, 100, 30_000),
}  # fmt: skip


@pytest.mark.parametrize("name", KINDS)
def test_mutations_give_only_foreseen_errors(tmp_path: Path, trials: Trials, name: str) -> None:
    kind, few, most = KINDS[name]
    files = kind(tmp_path)
    problems, done, size = [], 0, min(few, BATCH) if trials.seconds is None else BATCH
    for generator in trials.rounds(-(-few // BATCH), -(-most // BATCH)):
        rng = random.Random(int(generator.integers(1 << 62)))
        cases = [files.case(rng) for _ in range(size)]
        for number, outcome in enumerate(outcomes(cases, SECONDS)):
            problem = outcome.problem(SECONDS, LARGEST)
            if problem:
                problems.append(f"batch {done // size}, case {number}: {problem}")
        done += len(cases)
        if len(problems) > 20:
            break
    print(f"{name}: {done} mutations, {len(problems)} problems")
    assert not problems, "\n".join(problems)
