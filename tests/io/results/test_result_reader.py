import dataclasses
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import yaml

from octoreplay.config.consensus import ConsensusConfig
from octoreplay.config.packets import PacketConfig
from octoreplay.config.parameters import PARAMETERS
from octoreplay.config.team_file import dump_team
from octoreplay.errors import InputError
from octoreplay.io.containers.mcap_writer import RosMcapWriter
from octoreplay.io.messages import ros_types
from octoreplay.io.messages.ros_types import message, time_message
from octoreplay.io.results import result_metadata, result_writer
from octoreplay.io.results.result_reader import ResultReader
from octoreplay.io.results.result_writer import ResultWriter
from octoreplay.mapping.codec import encode_packet
from octoreplay.result import open_result
from support.octree_factory import octree_of
from support.result_factory import (
    CLASSES,
    SECOND,
    START,
    state,
    summary,
    team,
    tick_metrics,
    write_killed,
    write_result,
    write_until,
)


class CountedFile:
    """A file that counts the bytes read."""

    def __init__(self, file) -> None:
        self._file = file
        self.num_bytes = 0

    def read(self, *size: int) -> bytes:
        data = self._file.read(*size)
        self.num_bytes += len(data)
        return data

    def __getattr__(self, name: str):
        return getattr(self._file, name)


METRICS = [tick_metrics(tick, settling=tick == 4) for tick in range(1, 5)]


def test_a_written_result_is_read(tmp_path: Path) -> None:
    path = write_result(tmp_path)
    with ResultReader(path) as reader:
        assert reader.metrics() == METRICS
        assert reader.robots == ("alpha", "beta")
        assert reader.class_table == CLASSES
        assert reader.config == team(tmp_path).to_config()
        assert reader.prior == 0.0
        written = summary(METRICS)
        read = reader.summary(reader.metrics())
    assert np.isnan(read.wall_seconds)
    assert dataclasses.replace(read, wall_seconds=written.wall_seconds) == written
    assert read.lost_data


def test_a_result_of_an_older_version_has_no_pairs_and_no_evidence(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write = RosMcapWriter.write

    def old_write(writer: RosMcapWriter, topic: str, *rest: object) -> None:
        if topic != "/contradiction":
            write(writer, topic, *rest)

    monkeypatch.setattr(RosMcapWriter, "write", old_write)
    with ResultReader(write_result(tmp_path)) as reader:
        assert reader.metrics() == [dataclasses.replace(tick, pairs=()) for tick in METRICS]
        assert np.isnan(reader.metrics()[-1].contradiction)
        assert reader.state_times("alpha", evidence=True) == []
        with pytest.raises(InputError, match="no evidence of robot 'alpha' is stored up to the time asked for"):
            reader.states("alpha", evidence=True)
        with pytest.raises(InputError, match="robot 'gamma' not found; robots: alpha, beta"):
            reader.states("gamma", evidence=True)
        with pytest.raises(InputError, match="the centralised map has no evidence; robots: alpha, beta"):
            reader.states("central", evidence=True)


def _write_with(
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    change: Callable[[str], str],
    name: str = "octoreplay_msgs/msg/TickMetrics",
    fill: Callable[[ResultWriter], None] | None = None,
) -> Path:
    """Write a result with a changed definition of a message."""
    changed = {**ros_types.OCTOREPLAY_MSGS, name: change(ros_types.OCTOREPLAY_MSGS[name])}
    make_message = result_writer.message

    def message(type_name: str, **fields: object) -> object:
        if type_name == name:
            fields = {key: value for key, value in fields.items() if f" {key}\n" in changed[name]}
        return make_message(type_name, **fields)

    with monkeypatch.context() as patch:
        patch.setattr(ros_types, "OCTOREPLAY_MSGS", changed)
        patch.setattr(result_writer, "message", message)
        ros_types.typestore.cache_clear()
        path = write_result(tmp_path, fill)
    ros_types.typestore.cache_clear()
    return path


def test_a_result_of_an_older_version_has_no_published_distance(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = _write_with(monkeypatch, tmp_path, lambda text: text.replace("float64 total_distance_published\n", ""))
    with ResultReader(path) as reader:
        metrics = reader.metrics()
    assert all(np.isnan(tick.total_distance_published) for tick in metrics)
    assert [dataclasses.replace(tick, total_distance_published=0.0) for tick in metrics] == [
        dataclasses.replace(tick, total_distance_published=0.0) for tick in METRICS
    ]


def test_states_of_an_older_version_do_not_name_the_number_of_robots(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fill(writer: ResultWriter) -> None:
        for write in (writer.write_state, writer.write_evidence):
            write(state("alpha", 0, 1, encode_packet(octree_of({(0, 0, 0): (1.0, 2.0)}, resolution=0.2)), key=True))
        writer.write_state(state("central", 0, 1, encode_packet(octree_of({}, resolution=0.2)), key=True))

    name = "octoreplay_msgs/msg/MapState"
    path = _write_with(monkeypatch, tmp_path, lambda text: text.replace("uint32 num_robots\n", ""), name, fill)
    with ResultReader(path) as reader:
        assert [one.num_robots for one in reader.states("alpha")] == [None]
    with open_result(path) as result:
        assert [result.map("alpha").num_robots, result.map("central").num_robots] == [2, 1]
        assert result.evidence("alpha").num_robots == 1


def test_a_result_names_every_parameter_and_older_ones_had_other_defaults(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = team(tmp_path).with_parameters({"rule": "gradient", "packets": "full", "flow_bits": 4})
    path = tmp_path / "out.mcap"
    for with_defaults in (True, False):
        with monkeypatch.context() as patch:
            if not with_defaults:
                older = dataclasses.replace(config, consensus=ConsensusConfig(), packet=PacketConfig())
                text = dump_team(older, tmp_path)
                patch.setattr(result_metadata, "dump_team", lambda *_, text=text, **__: text)
            with ResultWriter(path, config) as writer:
                writer.complete(summary(METRICS))
        with ResultReader(path) as reader:
            assert (reader.config.consensus, reader.config.packet) == (config.consensus, config.packet)
        if with_defaults:
            stored = yaml.safe_load(reader._metadata["config"]["team_file"])
            assert set(PARAMETERS) <= set(stored)


def test_a_definition_that_no_version_wrote_is_damage() -> None:
    name = "octoreplay_msgs/msg/TickMetrics"
    definition, _ = ros_types.typestore().generate_msgdef(name, ros_version=2)
    assert ros_types.typestore_of(name, definition).fielddefs[name] == ros_types.typestore().fielddefs[name]
    for old, new, sentence in (
        ("total_distance_published", "total_distance_publishec", "has the unknown field 'total_distance_publishec'"),
        ("uint64 num_known_cells", "float64 num_known_cells", "has the unknown field 'num_known_cells'"),
        ("=====", "==?==", "cannot be read"),
    ):
        assert old in definition
        with pytest.raises(ValueError, match=sentence):
            ros_types.typestore_of(name, definition.replace(old, new, 1))


def test_numbers_of_the_configuration_are_read_exactly(tmp_path: Path) -> None:
    values = {
        "resolution": 0.1 + 0.2, "miss": -1 / 3, "quantum": 0.0, "prob_free": 0.7, "bounds": (-1.5, 1e-3),
        "settle_max": 7,
    }  # fmt: skip
    config = team(tmp_path).with_parameters(values)
    with ResultWriter(tmp_path / "out.mcap", config) as writer:
        writer.complete(summary(METRICS))
    with ResultReader(tmp_path / "out.mcap") as reader:
        assert reader.config == config.to_config()
        assert reader.prior == config.map.prior(2)


def test_states_lead_from_the_last_key_frame(tmp_path: Path) -> None:
    states = [
        state("alpha", 0, 1, b"a", key=True), state("alpha", 1, 2, b"b"), state("alpha", 2, 3, b"c"),
        state("alpha", 3, 4, b"d", key=True), state("alpha", 4, 6, b"e"),
    ]  # fmt: skip

    def fill(writer: ResultWriter) -> None:
        for entry in states:
            writer.write_state(entry)
            writer.write_state(dataclasses.replace(entry, robot_id="beta", data=b"other"))

    with ResultReader(write_result(tmp_path, fill)) as reader:
        assert reader.states("alpha") == states[3:]
        assert reader.states("alpha", START + 6 * SECOND - 1) == states[3:4]
        assert reader.states("alpha", START + 3 * SECOND) == states[:3]
        assert reader.states("alpha", START + 1 * SECOND) == states[:1]
        assert [entry.data for entry in reader.states("beta")] == [b"other", b"other"]
        assert reader.state_times("alpha") == [(tick, START + tick * SECOND) for tick in (1, 2, 3, 4, 6)]
        with pytest.raises(InputError, match="no map of robot 'alpha' is stored up to the time asked for"):
            reader.states("alpha", START)


def test_one_tick_or_time_is_read_without_the_rest(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)

    def fill(writer: ResultWriter) -> None:
        # Random bytes that cannot be compressed: each chunk holds a few states. Every tenth is a key frame.
        for tick in range(1, 101):
            data = rng.bytes(300_000)
            writer.write_state(state("alpha", tick, tick, data, key=tick % 10 == 1))

    path = write_result(tmp_path, fill)
    for tick, num_chunks in ((5, 8), (50, 14), (100, 14)):
        with ResultReader(path) as reader:
            stamp = reader.state_stamp("alpha", tick)
            assert stamp == START + tick * SECOND
            assert [entry.tick for entry in reader.states("alpha", stamp)] == list(
                range((tick - 1) // 10 * 10 + 1, tick + 1)
            )
        with ResultReader(path) as reader:
            reader._reader._file = counted = CountedFile(reader._reader._file)
            reader.states("alpha", reader.state_stamp("alpha", tick))
            assert counted.num_bytes < num_chunks * 1_500_000 < path.stat().st_size


def test_stamps_of_ticks_that_are_not_evenly_spaced(tmp_path: Path) -> None:
    states = [state("alpha", 0, 1, b"a", key=True), state("alpha", 1, 3, b"b"), state("alpha", 2, 7, b"c")]
    moved = [dataclasses.replace(s, stamp_ns=s.stamp_ns + i * SECOND // 3) for i, s in enumerate(states)]
    with ResultReader(write_result(tmp_path, lambda writer: [writer.write_state(s) for s in moved] and None)) as reader:
        assert [reader.state_stamp("alpha", s.tick) for s in moved] == [s.stamp_ns for s in moved]
        assert reader.state_stamp("alpha", 2) is None
        assert reader.state_stamp("beta", 1) is None
        with pytest.raises(InputError, match="robot 'gamma' not found"):
            reader.state_stamp("gamma", 1)


def test_a_delta_may_build_on_an_older_state(tmp_path: Path) -> None:
    states = [state("alpha", 0, 1, b"a", key=True), state("alpha", 1, 2, b"b")]
    states.append(dataclasses.replace(state("alpha", 2, 3, b"c"), base_sequence=0))
    with ResultReader(
        write_result(tmp_path, lambda writer: [writer.write_state(s) for s in states] and None)
    ) as reader:
        assert [entry.sequence for entry in reader.states("alpha")] == [0, 2]


def test_a_missing_key_frame_is_damage(tmp_path: Path) -> None:
    path = write_result(tmp_path, lambda writer: writer.write_state(state("alpha", 5, 1, b"delta")))
    with ResultReader(path) as reader, pytest.raises(InputError, match="state 4 of robot 'alpha' is missing"):
        reader.states("alpha")


def test_poses_are_those_of_the_sensors(tmp_path: Path) -> None:
    with ResultReader(write_result(tmp_path)) as reader:
        stamps, poses = reader.poses("alpha")
    assert stamps == [START + tick * SECOND for tick in range(1, 5)]
    np.testing.assert_allclose(poses[:, :3], [[tick, 2, 3] for tick in range(1, 5)])
    np.testing.assert_allclose(poses[:, 3:], [[0, 0, 0.5**0.5, 0.5**0.5]] * 4)


def test_an_unknown_robot_is_named_with_the_known_ones(tmp_path: Path) -> None:
    with ResultReader(write_result(tmp_path)) as reader:
        for ask in (reader.states, reader.state_times, reader.poses):
            with pytest.raises(InputError, match="robot 'gamma' not found; robots: alpha, beta"):
                ask("gamma")


def test_changed_and_missing_inputs_are_reported(tmp_path: Path) -> None:
    path = write_result(tmp_path)
    with ResultReader(path) as reader:
        assert reader.changed_inputs() == []
        (tmp_path / "alpha.bag").write_bytes(b"another log!")
        (tmp_path / "beta.bag").unlink()
        first, second = reader.changed_inputs()
    assert first.endswith("alpha.bag: has changed since result.mcap was made from it")
    assert second.endswith("beta.bag: input of result.mcap is missing")


def test_logs_are_found_relative_to_a_moved_result(tmp_path: Path) -> None:
    (tmp_path / "before").mkdir()
    write_result(tmp_path / "before")
    (tmp_path / "before").rename(tmp_path / "after")
    with ResultReader(tmp_path / "after" / "result.mcap") as reader:
        assert reader.config.robots[0].logs == (tmp_path / "after" / "alpha.bag",)
        assert reader.changed_inputs() == []


def test_an_interrupted_result_can_be_read(tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt):
        write_until(KeyboardInterrupt, tmp_path / "o.mcap", METRICS[:2])
    with ResultReader(tmp_path / "o.partial.mcap") as reader:
        metrics = reader.metrics()
        assert metrics == METRICS[:2]
        read = reader.summary(metrics)
    assert (read.num_ticks, read.stop_reason, read.total_sent_bytes) == (2, "interrupted", 600)
    assert read.mean_packet_bytes == np.mean([100, 140, 200, 240])
    assert read.peak_total_distance == METRICS[1].total_distance


def test_a_result_without_ticks_has_no_summary(tmp_path: Path) -> None:
    with (
        ResultReader(write_killed(tmp_path / "o.mcap", [])) as reader,
        pytest.raises(InputError, match="holds no tick"),
    ):
        reader.summary(reader.metrics())


def test_files_that_are_not_results_are_input_errors(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"none\.mcap: cannot be read: No such file"):
        ResultReader(tmp_path / "none.mcap")
    for content in (b"", b"not an MCAP", b"\x89MCAP0\r\n" + bytes(100)):
        (tmp_path / "a.mcap").write_bytes(content)
        with pytest.raises(InputError, match=r"a\.mcap: not a finished MCAP file, or damaged; give the OUT\.mcap"):
            ResultReader(tmp_path / "a.mcap")
    with RosMcapWriter(tmp_path / "log.mcap") as writer:
        clock = message("rosgraph_msgs/msg/Clock", clock=time_message(0))
        writer.write("/clock", "rosgraph_msgs/msg/Clock", clock, 0)
    with pytest.raises(InputError, match=r"log\.mcap: an MCAP file, but no result of octoreplay"):
        ResultReader(tmp_path / "log.mcap")


def test_a_later_format_version_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("octoreplay.io.results.result_metadata.FORMAT_VERSION", "4")
    path = write_result(tmp_path)
    with pytest.raises(InputError, match="result format 4, this version reads 2 and 3"):
        ResultReader(path)


def test_damaged_results_raise_only_input_errors(tmp_path: Path) -> None:
    def fill(writer: ResultWriter) -> None:
        writer.write_state(state("alpha", 0, 1, bytes(range(256)), key=True))

    data = write_result(tmp_path, fill).read_bytes()
    rng = np.random.default_rng(1)
    damaged, sentences = tmp_path / "damaged.mcap", []
    for _ in range(150):
        content = bytearray(data)
        content[rng.integers(len(data))] ^= 1 << rng.integers(8)
        damaged.write_bytes(content)
        try:
            with ResultReader(damaged) as reader:
                assert reader.metrics() in (METRICS, [])
                assert [entry.data for entry in reader.states("alpha")] == [bytes(range(256))]
        except InputError as error:
            sentences.append(str(error))
    assert len(sentences) > 20
    assert all(sentence.startswith(str(damaged)) for sentence in sentences)


def test_cut_results_are_input_errors(tmp_path: Path) -> None:
    data = write_result(tmp_path).read_bytes()
    cut = tmp_path / "cut.mcap"
    for length in range(0, len(data), max(1, len(data) // 60)):
        cut.write_bytes(data[:length])
        with pytest.raises(InputError, match=r"cut\.mcap: "), ResultReader(cut) as reader:
            reader.metrics()
