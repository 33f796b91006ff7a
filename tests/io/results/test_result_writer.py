import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore
from scipy.spatial.transform import Rotation

from octoreplay.errors import InputError, OutputError
from octoreplay.io.results.geometry_messages import quaternion
from octoreplay.io.results.map_views import view_points
from octoreplay.io.results.result_reader import ResultReader
from octoreplay.io.results.result_writer import ResultWriter, partial_path
from octoreplay.records import FrameCounts
from support.result_factory import (
    CLASSES,
    SECOND,
    START,
    leaf_table,
    pose,
    state,
    summary,
    team,
    tick_metrics,
    write_killed,
    write_result,
    write_until,
)


def fill(writer: ResultWriter) -> None:
    writer.write_state(state("alpha", 0, 1, b"key frame", key=True))
    writer.write_state(state("alpha", 1, 3, b""))
    writer.write_evidence(state("beta", 0, 3, b"evidence", key=True))
    writer.write_view("alpha", START + 3 * SECOND, view_points(leaf_table(), CLASSES))
    writer.write_packet("beta", START + 3 * SECOND, 3, b"\x00\xffpacket")


def metadata(path: Path) -> dict[str, dict[str, str]]:
    with path.open("rb") as stream:
        return {record.name: record.metadata for record in make_reader(stream).iter_metadata()}


def test_rosbags_reads_every_message_by_the_schemas_in_the_file(tmp_path: Path) -> None:
    path = write_result(tmp_path, fill)
    # An empty type store: octoreplay's types can only come from the file.
    with AnyReader([path], default_typestore=get_typestore(Stores.EMPTY)) as reader:
        seen: dict[str, list[tuple[int, object]]] = {}
        for connection, stamp, raw in reader.messages():
            seen.setdefault(connection.topic, []).append((stamp, reader.deserialize(raw, connection.msgtype)))
    counts = {topic: len(entries) for topic, entries in seen.items()}
    assert counts == {
        "/tf_static": 1, "/metrics": 4, "/contradiction": 4, "/alpha/pose": 4, "/beta/pose": 4, "/tf": 4, "/graph": 4,
        "/alpha/map_state": 2, "/alpha/map": 1, "/beta/packet": 1, "/beta/evidence": 1,
    }  # fmt: skip
    stamp, metrics = seen["/metrics"][2]
    assert stamp == START + 3 * SECOND
    assert (metrics.tick, metrics.total_distance, metrics.robots[1].packet_bytes) == (3, 1.0 / 3.0 + 3, 340)
    assert [(link.sender, link.receiver) for link in metrics.links] == [("alpha", "beta"), ("beta", "alpha")]
    contradiction = seen["/contradiction"][2][1]
    assert (contradiction.tick, contradiction.clear_contradiction, contradiction.label_contradiction) == (
        3,
        0.03,
        0.125,
    )
    assert [(pair.first, pair.second, pair.overlap_cells) for pair in contradiction.pairs] == [("alpha", "beta", 5003)]
    assert seen["/beta/evidence"][0][1].data.tobytes() == b"evidence"
    (_, first), (_, second) = seen["/alpha/map_state"]
    assert (first.data.tobytes(), first.is_key_frame, first.sequence) == (b"key frame", True, 0)
    assert (second.data.tobytes(), second.is_key_frame, second.base_sequence) == (b"", False, 0)
    assert seen["/beta/packet"][0][1].data.tobytes() == b"\x00\xffpacket"
    assert seen["/beta/packet"][0][1].sender == "beta"


def test_mcap_finds_the_profile_the_schemas_and_ros2_encodings(tmp_path: Path) -> None:
    path = write_result(tmp_path, fill)
    with path.open("rb") as stream:
        reader = make_reader(stream)
        assert reader.get_header().profile == "ros2"
        found = reader.get_summary()
    assert found is not None
    assert {channel.message_encoding for channel in found.channels.values()} == {"cdr"}
    assert {schema.encoding for schema in found.schemas.values()} == {"ros2msg"}
    assert "octoreplay_msgs/msg/TickMetrics" in {schema.name for schema in found.schemas.values()}


def test_the_view_is_a_cloud_of_the_occupied_leaves(tmp_path: Path) -> None:
    path = write_result(tmp_path, fill)
    with AnyReader([path]) as reader:
        (connection,) = [c for c in reader.connections if c.topic == "/alpha/map"]
        ((_, _, raw),) = reader.messages([connection])
        cloud = reader.deserialize(raw, connection.msgtype)
    assert [field.name for field in cloud.fields] == ["x", "y", "z", "rgb", "label", "size", "probability"]
    formats = {7: "<f4", 2: "u1"}
    points = np.frombuffer(
        cloud.data.tobytes(),
        dtype=np.dtype(
            {
                "names": [f.name for f in cloud.fields],
                "formats": [formats[f.datatype] for f in cloud.fields],
                "offsets": [f.offset for f in cloud.fields],
                "itemsize": cloud.point_step,
            }
        ),
    )
    assert (cloud.height, cloud.width, cloud.row_step, len(cloud.data)) == (1, 3, 3 * 28, 3 * 28)
    assert cloud.header.frame_id == "team"
    leaves = leaf_table()
    np.testing.assert_allclose(np.column_stack([points[n] for n in "xyz"]), leaves.centers[:3], rtol=1e-6)
    assert points["label"].tolist() == [1, 2, 1]
    assert points["size"].tolist() == pytest.approx([0.2, 0.4, 0.2])
    assert [f"{number:06x}" for number in points["rgb"].copy().view(np.uint32)] == ["0a141e", "0102fa", "0a141e"]
    weights = np.exp(np.column_stack([np.zeros(4), leaves.log_odds]))
    np.testing.assert_allclose(points["probability"], (weights / weights.sum(1, keepdims=True)).max(1)[:3], rtol=1e-6)


def test_frames_and_graph_show_where_the_robots_are(tmp_path: Path) -> None:
    path = write_result(tmp_path)
    latest = {}
    with AnyReader([path]) as reader:
        for connection, _, raw in reader.messages():
            latest[connection.topic] = reader.deserialize(raw, connection.msgtype)
    static = latest["/tf_static"].transforms
    assert [(t.header.frame_id, t.child_frame_id) for t in static] == [("team", "alpha/map"), ("team", "beta/map")]
    assert static[0].transform.translation.z == 3.0
    moving = latest["/tf"].transforms
    assert [t.child_frame_id for t in moving] == ["alpha/sensor", "beta/sensor"]
    turn = moving[0].transform.rotation
    assert (turn.x, turn.y) == (0.0, 0.0)
    assert (turn.z, turn.w) == pytest.approx((0.5**0.5, 0.5**0.5))
    assert latest["/alpha/pose"].pose.position.x == 4.0
    _, lines, *names = latest["/graph"].markers
    assert [(p.x, p.y, p.z) for p in lines.points] == [(4.0, 2.0, 3.0), (0.0, 2.0, 3.0)]
    assert (lines.type, lines.action) == (5, 0)
    assert [name.text for name in names] == ["alpha", "beta"]


def test_every_graph_deletes_the_markers_before_it(tmp_path: Path) -> None:
    poses = [pose("alpha", 1.0), pose("beta", 2.0)]
    path = write_result(tmp_path, lambda writer: writer.write_graph(START + 9 * SECOND, [], poses))
    with AnyReader([path]) as reader:
        graph = [c for c in reader.connections if c.topic == "/graph"]
        messages = [reader.deserialize(raw, c.msgtype) for c, _, raw in reader.messages(graph)]
    assert {(message.markers[0].action, message.markers[0].header.frame_id) for message in messages} == {(3, "team")}
    assert [entry.ns for entry in messages[-1].markers[1:]] == ["robots", "robots"]


def test_cubes_are_the_occupied_leaves_by_class_and_size(tmp_path: Path) -> None:
    points = view_points(leaf_table(), CLASSES)
    path = write_result(tmp_path, lambda writer: writer.write_cubes("alpha", START + SECOND, points, "alpha/map"))
    with AnyReader([path]) as reader:
        (connection,) = [c for c in reader.connections if c.topic == "/alpha/markers"]
        ((_, _, raw),) = reader.messages([connection])
        clear, *cubes = reader.deserialize(raw, connection.msgtype).markers
    assert clear.action == 3
    # The leaves 0 and 2 have one class and size.
    assert [(cube.type, cube.action, cube.ns, cube.header.frame_id) for cube in cubes] == [
        (6, 0, "ground", "alpha/map"), (6, 0, "tree", "alpha/map")
    ]  # fmt: skip
    assert [cube.scale.x for cube in cubes] == pytest.approx([0.2, 0.4])
    found = [[(p.x, p.y, p.z) for p in cube.points] for cube in cubes]
    np.testing.assert_allclose(found[0], leaf_table().centers[[0, 2]], rtol=1e-6)
    np.testing.assert_allclose(found[1], leaf_table().centers[[1]], rtol=1e-6)
    color = cubes[0].color
    assert [color.r * 255, color.g * 255, color.b * 255, color.a] == pytest.approx([10, 20, 30, 1], rel=1e-6)


@pytest.mark.parametrize("seed", range(20))
def test_quaternions_are_those_of_scipy(seed: int) -> None:
    rotation = Rotation.random(rng=np.random.default_rng(seed))
    transform = np.eye(4)
    transform[:3, :3] = rotation.as_matrix()
    q = quaternion(transform)
    np.testing.assert_allclose([q.x, q.y, q.z, q.w], rotation.as_quat(canonical=True), atol=1e-12)


@pytest.mark.parametrize("axis", [(1, 0, 0), (0, 1, 0), (0, 0, 1)])
def test_quaternions_of_half_turns(axis: tuple[int, int, int]) -> None:
    transform = np.eye(4)
    transform[:3, :3] = Rotation.from_rotvec(np.pi * np.array(axis)).as_matrix()
    q = quaternion(transform)
    np.testing.assert_allclose(np.abs([q.x, q.y, q.z, q.w]), [*axis, 0], atol=1e-12)


def test_metadata_describe_the_run(tmp_path: Path) -> None:
    records = metadata(write_result(tmp_path))
    assert records["octoreplay"]["format_version"] == "3"
    assert json.loads(records["octoreplay"]["robots"]) == ["alpha", "beta"]
    assert json.loads(records["classes"]["classes"])[1:] == [
        {"id": 1, "name": "ground", "color": [10, 20, 30]},
        {"id": 2, "name": "tree", "color": [1, 2, 250]},
    ]
    assert "log: alpha.bag" in records["config"]["team_file"]
    assert json.loads(records["inputs"]["beta.bag"])["size"] == len("log of beta")
    assert records["summary"]["stop_reason"] == "it was over"
    assert "wall_seconds" not in records["summary"]


def test_hash_fingerprints_the_whole_input(tmp_path: Path) -> None:
    config = team(tmp_path).with_parameters({"hash": True})
    with ResultWriter(tmp_path / "out.mcap", config) as writer:
        writer.complete(summary([tick_metrics(1)]))
    assert json.loads(metadata(tmp_path / "out.mcap")["inputs"]["alpha.bag"])["method"] == "sha256"


def test_the_same_calls_give_the_same_bytes(tmp_path: Path) -> None:
    first = write_result(tmp_path, fill).read_bytes()
    (tmp_path / "elsewhere").mkdir()
    assert write_result(tmp_path / "elsewhere", fill).read_bytes() == first


def test_the_result_appears_only_when_it_is_complete(tmp_path: Path) -> None:
    out = tmp_path / "out.mcap"
    out.write_text("the result of yesterday")
    with ResultWriter(out, team(tmp_path)) as writer:
        writer.write_metrics(tick_metrics(1))
        assert out.read_text() == "the result of yesterday"
        assert partial_path(out).exists()
        writer.complete(summary([tick_metrics(1)]))
    assert out.read_bytes().startswith(b"\x89MCAP")
    assert not partial_path(out).exists()


@pytest.mark.parametrize("error", [ZeroDivisionError, KeyboardInterrupt])
def test_an_error_before_the_first_tick_leaves_nothing(tmp_path: Path, error: type[BaseException]) -> None:
    with pytest.raises(error):
        write_until(error, tmp_path / "out.mcap", [])
    assert sorted(path.name for path in tmp_path.iterdir()) == ["alpha.bag", "beta.bag"]


@pytest.mark.parametrize(
    ("error", "reason"),
    [(InputError("a.bag: gone"), "error: a.bag: gone"), (MemoryError(), "out of memory"), (OSError(5, "x"), "error: ")],
)
def test_an_error_after_a_tick_leaves_a_finished_partial_result(tmp_path: Path, error: Exception, reason: str) -> None:
    partial = tmp_path / "out.partial.mcap"

    def fail() -> None:
        with ResultWriter(tmp_path / "out.mcap", team(tmp_path)) as writer:
            writer.write_metrics(tick_metrics(1))
            raise error

    with pytest.raises(type(error)) as raised:
        fail()
    assert raised.value.__notes__ == [f"the finished part is in {partial}"]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["alpha.bag", "beta.bag", "out.partial.mcap"]
    stored = metadata(partial)["summary"]
    assert stored["complete"] == "false"
    assert stored["stop_reason"].startswith(reason)


def test_an_unfinished_result_is_kept_unless_a_restart_is_asked_for(tmp_path: Path) -> None:
    out = tmp_path / "out.mcap"
    with pytest.raises(KeyboardInterrupt):
        write_until(KeyboardInterrupt, out, [tick_metrics(1)])
    left = (tmp_path / "out.partial.mcap").read_bytes()
    with pytest.raises(OutputError, match=r"left this unfinished result; continue it with --resume, .* --restart"):
        ResultWriter(out, team(tmp_path))
    assert (tmp_path / "out.partial.mcap").read_bytes() == left
    with ResultWriter(out, team(tmp_path), restart=True) as writer:
        writer.complete(summary([tick_metrics(1)]))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["alpha.bag", "beta.bag", "out.mcap"]


def test_an_unfinished_result_without_a_message_is_replaced(tmp_path: Path) -> None:
    write_killed(tmp_path / "out.mcap", [])
    with ResultWriter(tmp_path / "out.mcap", team(tmp_path)) as writer:
        writer.complete(summary([tick_metrics(1)]))
    assert not (tmp_path / "out.partial.mcap").exists()


def test_the_file_of_another_process_is_not_published(tmp_path: Path) -> None:
    out, partial = tmp_path / "out.mcap", tmp_path / "out.partial.mcap"
    out.write_text("old")

    def complete() -> None:
        with ResultWriter(out, team(tmp_path)) as writer:
            writer.write_metrics(tick_metrics(1))
            partial.unlink()
            partial.write_text("foreign")
            writer.complete(summary([tick_metrics(1)]))

    with pytest.raises(OutputError, match=r"out\.partial\.mcap was removed during the run"):
        complete()
    assert (out.read_text(), partial.read_text()) == ("old", "foreign")


def test_an_interrupt_leaves_a_valid_partial_result(tmp_path: Path) -> None:
    out = tmp_path / "out.mcap"
    with pytest.raises(KeyboardInterrupt):
        write_until(KeyboardInterrupt, out, [tick_metrics(1)])
    assert not out.exists()
    assert metadata(tmp_path / "out.partial.mcap")["summary"]["stop_reason"] == "interrupted"
    with AnyReader([tmp_path / "out.partial.mcap"]) as reader:
        assert {connection.topic for connection in reader.connections} == {"/tf_static", "/metrics", "/contradiction"}


def test_partial_names() -> None:
    assert partial_path(Path("a/x.mcap")) == Path("a/x.partial.mcap")
    assert partial_path(Path("a/x.v2")) == Path("a/x.v2.partial.mcap")


@pytest.mark.parametrize(
    ("name", "sentence"),
    [
        ("none/out.mcap", "the folder '.*none' does not exist"),
        ("", "is a folder; give a file name"),
        ("alpha.bag", "is an input of robot 'alpha'; name another output"),
        ("a.partial.mcap", "unfinished results end in .partial.mcap; name another output"),
        ("none/../beta.bag", "is an input of robot 'beta'; name another output"),
    ],
)
def test_an_output_that_cannot_be_written_is_refused_at_once(tmp_path: Path, name: str, sentence: str) -> None:
    config = team(tmp_path)
    (tmp_path / "none").mkdir() if name.startswith("none/..") else None
    with pytest.raises(OutputError, match=sentence):
        ResultWriter(tmp_path / name, config)
    assert (tmp_path / "alpha.bag").read_bytes() == b"log of alpha"


def test_a_missing_input_is_refused_and_nothing_is_left(tmp_path: Path) -> None:
    config = team(tmp_path)
    (tmp_path / "beta.bag").unlink()
    with pytest.raises(InputError, match=r"beta\.bag: cannot be read"):
        ResultWriter(tmp_path / "out.mcap", config)
    assert [path.name for path in tmp_path.iterdir()] == ["alpha.bag"]


def test_paths_are_stored_relative_to_the_results_folder(tmp_path: Path) -> None:
    config = team(tmp_path)
    (tmp_path / "out").mkdir()
    done = summary([tick_metrics(1)])
    first, second = (str(robot.logs[0]) for robot in config.robots)
    cut = FrameCounts(truncated_files=[f"{first}: cut"], first_missing={"late": second})
    done = dataclasses.replace(done, frame_counts={"alpha": cut}, warnings=(f"{second}: has no labels",))
    with ResultWriter(tmp_path / "out" / "out.mcap", config) as writer:
        writer.complete(done)
    records = metadata(tmp_path / "out" / "out.mcap")
    assert "log: ../alpha.bag" in records["config"]["team_file"]
    assert "../beta.bag" in records["inputs"]
    assert str(tmp_path) not in str(records)
    with ResultReader(tmp_path / "out" / "out.mcap") as reader:
        assert [robot.logs[0].resolve() for robot in reader.config.robots] == [r.logs[0] for r in config.robots]
        assert reader.changed_inputs() == []


def test_the_class_table_is_stored(tmp_path: Path) -> None:
    config = team(tmp_path)
    with ResultWriter(tmp_path / "out.mcap", config) as writer:
        writer.complete(summary([tick_metrics(1)]))
    assert "name: ground" in metadata(tmp_path / "out.mcap")["config"]["team_file"]
