from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as st_np
from scipy.spatial.transform import Rotation, Slerp

from octoreplay.errors import InputError
from octoreplay.io.messages.sensor_messages import Transforms, convert
from octoreplay.io.robots.poses import FrameTree, PoseTrack
from octoreplay.transforms import normalise
from support.log_factory import IDENTITY, ros2
from support.long_suite import examples

MS = 1_000_000

quaternions = (
    st_np.arrays(np.float64, 4, elements=st.floats(-1, 1))
    .filter(lambda q: np.linalg.norm(q) > 1e-2)
    .map(lambda q: tuple((q / np.linalg.norm(q)).tolist()))
)
positions = st.tuples(*[st.floats(-1e3, 1e3)] * 3)


@pytest.mark.parametrize("bad", [(0, 0, 0, 0), (np.nan, 0, 0, 1), (np.inf, 0, 0, 1)])
def test_a_zero_quaternion_is_refused(bad):
    track = PoseTrack(100 * MS)
    assert not track.add(0, (0, 0, 0), bad)
    assert len(track) == 0


@examples(100)
@given(
    st.lists(
        st.tuples(st.integers(0, 10**6), positions, quaternions), min_size=2, max_size=8, unique_by=lambda e: e[0]
    ),
    st.integers(-10, 10**6 + 10),
    st.integers(1, 10**6),
    st.randoms(),
)
def test_track_interpolates_as_scipy_does_within_gaps_only(entries, stamp, gap, random):
    shuffled = list(entries)
    random.shuffle(shuffled)
    track = PoseTrack(gap)
    for entry in shuffled:
        assert track.add(*entry)
    entries.sort(key=lambda entry: entry[0])
    stamps = [entry[0] for entry in entries]
    pose = track.at(stamp)
    if stamp in stamps:
        position, quaternion = entries[stamps.index(stamp)][1:]
        assert pose[0] == position
        assert pose[1] == pytest.approx(quaternion, abs=1e-12)
        return
    before = [entry for entry in entries if entry[0] < stamp]
    after = [entry for entry in entries if entry[0] > stamp]
    if not before or not after or after[0][0] - before[-1][0] > gap:
        assert pose is None
        return
    (t0, p0, q0), (t1, p1, q1) = before[-1], after[0]
    fraction = (stamp - t0) / (t1 - t0)
    np.testing.assert_allclose(pose[0], np.array(p0) + fraction * (np.array(p1) - p0), atol=1e-9)
    if abs(np.dot(q0, q1)) > 1e-3:
        theirs = Slerp([0, 1], Rotation.from_quat([q0, q1]))(fraction)
        assert (Rotation.from_quat(pose[1]) * theirs.inv()).magnitude() < 1e-6


@pytest.mark.parametrize(("distance", "is_bridged"), [(99, True), (100, True), (101, False)])
def test_a_gap_is_bridged_up_to_its_limit(distance, is_bridged):
    track = PoseTrack(100)
    track.add(0, (0, 0, 0), IDENTITY)
    track.add(distance, (1, 0, 0), IDENTITY)
    assert (track.at(50) is not None) == is_bridged
    assert track.at(distance) is not None


def test_the_last_of_two_equal_stamps_is_kept():
    track = PoseTrack(100)
    for stamp, x in ((0, 0.0), (10, 1.0), (10, 2.0)):
        track.add(stamp, (x, 0, 0), IDENTITY)
    assert len(track) == 2
    assert track.last_ns == 10
    assert track.at(5)[0] == pytest.approx((1.0, 0.0, 0.0))


@examples(100)
@given(st.lists(st.integers(0, 1000), min_size=1, max_size=20, unique=True), st.integers(0, 1000), st.integers(0, 1000))
def test_forgetting_changes_nothing_from_its_stamp_on(stamps, forget, later):
    whole, short = PoseTrack(300), PoseTrack(300)
    for stamp in stamps:
        whole.add(stamp, (stamp, 0, 0), IDENTITY)
        short.add(stamp, (stamp, 0, 0), IDENTITY)
    short.forget_before(forget)
    assert short.at(forget + later) == whole.at(forget + later)
    assert len(short) <= 1 + sum(stamp >= forget for stamp in stamps)


def make_tree() -> FrameTree:
    """map -> odom -> base -> arm (moving), base -> camera (fixed), and a separate world -> drone."""
    tree = FrameTree(200 * MS)
    quarter = normalise((0.0, 0.0, 1.0, 1.0))
    tree.add("base", "camera", None, (1, 0, 0), IDENTITY)
    tree.add("/map", "odom", None, (10, 0, 0), quarter)
    for step in range(5):
        tree.add("odom", "/base", step * 100 * MS, (step, 0, 0), IDENTITY)
        tree.add("base", "arm", step * 100 * MS, (0, step, 0), IDENTITY)
    tree.add("world", "drone", None, (0, 0, 0), IDENTITY)
    return tree


def test_tree_chains_fixed_and_moving_transforms_up_and_down():
    tree = make_tree()
    # odom is turned by 90 degrees about z: its x is the map's y. The base has moved 1.5, the camera is 1 ahead.
    np.testing.assert_allclose(tree.T_a_b("map", "camera", 150 * MS)[:3, 3], (10, 2.5, 0), atol=1e-12)
    # From the camera to the arm, with the base as common ancestor.
    np.testing.assert_allclose(tree.T_a_b("camera", "arm", 250 * MS)[:3, 3], (-1, 2.5, 0), atol=1e-12)
    for a, b in (("map", "arm"), ("arm", "camera"), ("base", "base")):
        there, back = tree.T_a_b(a, b, 50 * MS), tree.T_a_b(b, a, 50 * MS)
        np.testing.assert_allclose(there @ back, np.eye(4), atol=1e-12)


def test_tree_gives_fixed_links_roots_and_the_last_known_stamp():
    tree = make_tree()
    assert tree.root_of("camera") == "map"
    assert tree.root_of("never_heard_of") == "never_heard_of"
    assert tree.is_fixed("base", "camera")
    assert not tree.is_fixed("map", "camera")
    assert not tree.is_fixed("map", "drone")
    assert tree.last_ns("map", "camera") == 400 * MS
    assert tree.last_ns("base", "camera") is None
    assert tree.T_a_b("map", "camera", 401 * MS) is None
    assert tree.T_a_b("base", "camera", 10**12) is not None


def test_tree_names_both_frames_that_nothing_joins():
    tree = make_tree()
    with pytest.raises(InputError, match="the root of 'drone' is 'world', that of 'map' is 'map'"):
        tree.T_a_b("map", "drone", 0)
    with pytest.raises(InputError, match="from 'gripper' to 'map': TF has no frame 'gripper'; its frames are arm, "):
        tree.T_a_b("map", "gripper", 0)
    with pytest.raises(InputError, match="from 'b' to 'a': the log has no TF"):
        FrameTree(1).T_a_b("a", "b", 0)


def test_tree_refuses_a_frame_with_two_parents_and_survives_a_loop():
    tree = make_tree()
    tree.add("odom", "camera", None, (0, 0, 0), IDENTITY)
    with pytest.raises(InputError, match="'camera' has two parents in TF, 'base' and 'odom'"):
        tree.T_a_b("map", "camera", 0)
    loop = FrameTree(1)
    loop.add("a", "b", None, (0, 0, 0), IDENTITY)
    loop.add("b", "a", None, (0, 0, 0), IDENTITY)
    assert loop.root_of("a") in ("a", "b")


def transforms_of(*edges) -> Transforms:
    return convert("tf2_msgs/msg/TFMessage", ros2.tf(*edges))


def test_tree_ignores_invalid_transforms_of_messages():
    tree = FrameTree(200 * MS)
    found = transforms_of(("map", "base", 0, (1, 2, 3), IDENTITY), ("map", "dead", 0, (0, 0, 0), (0, 0, 0, 0)))
    tree.add_transforms(found, is_static=False)
    tree.add_transforms(transforms_of(("map", "still", 0, (0, 0, np.nan), IDENTITY)), is_static=True)
    np.testing.assert_allclose(tree.T_a_b("map", "base", 0)[:3, 3], (1, 2, 3))
    assert tree.T_a_b("map", "dead", 0) is None
    assert tree.T_a_b("map", "still", 0) is None
    tree.add_transforms(found, is_static=False, stamp_ns=50 * MS)
    assert tree.last_ns("map", "base") == 50 * MS
