"""Interpolated pose tracks and trees of frames."""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Iterator, Sequence

import numpy as np

from octoreplay.errors import InputError
from octoreplay.io.messages.sensor_messages import Transforms
from octoreplay.records import Float64Array
from octoreplay.transforms import Pose, interpolate, inverse, normalise, pose_matrix


class PoseTrack:
    """Poses over time, interpolated between neighbours: linearly in position, by slerp in rotation.

    At the stamp of a pose the result is that pose. At any other stamp there is a pose only between two poses that are
    at most ``pose_gap_ns`` apart. Poses may be added in any order; of two with the same stamp the last one is kept.
    """

    def __init__(self, pose_gap_ns: int) -> None:
        self._pose_gap_ns = pose_gap_ns
        self._stamps: list[int] = []
        self._poses: list[Pose] = []
        self.num_added = 0
        """Number of poses added, including dropped ones."""

    def __len__(self) -> int:
        return len(self._stamps)

    @property
    def first_ns(self) -> int | None:
        """Stamp of the first pose; None in an empty track."""
        return self._stamps[0] if self._stamps else None

    @property
    def last_ns(self) -> int | None:
        """Stamp of the last pose; None in an empty track."""
        return self._stamps[-1] if self._stamps else None

    def add(self, stamp_ns: int, position: Sequence[float], quaternion: Sequence[float]) -> bool:
        """Add a pose; return False and add nothing where a number is not finite or the quaternion is zero."""
        x, y, z = (float(value) for value in position)
        rotation = normalise(quaternion)
        if rotation is None or not math.isfinite(x + y + z):
            return False
        pose = ((x, y, z), rotation)
        self.num_added += 1
        if not self._stamps or stamp_ns > self._stamps[-1]:
            self._stamps.append(stamp_ns)
            self._poses.append(pose)
            return True
        index = bisect_left(self._stamps, stamp_ns)
        if self._stamps[index] == stamp_ns:
            self._poses[index] = pose
        else:
            self._stamps.insert(index, stamp_ns)
            self._poses.insert(index, pose)
        return True

    def at(self, stamp_ns: int) -> Pose | None:
        """Pose at a stamp; None where there is none (see the class)."""
        index = bisect_left(self._stamps, stamp_ns)
        if index < len(self._stamps) and self._stamps[index] == stamp_ns:
            return self._poses[index]
        if index == 0 or index == len(self._stamps):
            return None
        before, after = self._stamps[index - 1], self._stamps[index]
        if after - before > self._pose_gap_ns:
            return None
        return interpolate(self._poses[index - 1], self._poses[index], (stamp_ns - before) / (after - before))

    def matrix_at(self, stamp_ns: int, *, hold: bool = False) -> Float64Array | None:
        """Pose at a stamp as a (4, 4) transform, or None.

        With ``hold`` a pose applies until the next one where the two are too far apart to be interpolated, the first
        one also before its stamp, and the last one from its stamp on.
        """
        pose = self.at(stamp_ns)
        if pose is None and hold and self._poses:
            pose = self._poses[max(bisect_left(self._stamps, stamp_ns) - 1, 0)]
        return None if pose is None else pose_matrix(*pose)

    @property
    def first_matrix(self) -> Float64Array:
        """Earliest pose of a track that is not empty, as a (4, 4) transform."""
        return pose_matrix(*self._poses[0])

    @property
    def is_constant(self) -> bool:
        """True where all poses are equal."""
        return all(pose == self._poses[0] for pose in self._poses)

    def forget_before(self, stamp_ns: int) -> None:
        """Drop poses that no stamp from ``stamp_ns`` on needs."""
        keep = bisect_left(self._stamps, stamp_ns) - 1
        if keep > 0:
            del self._stamps[:keep]
            del self._poses[:keep]


class FrameTree:
    """Tree of a robot's frames from TF: each frame has one parent and a fixed or moving transform to it."""

    def __init__(self, pose_gap_ns: int) -> None:
        self._pose_gap_ns = pose_gap_ns
        self._parents: dict[str, str] = {}
        self._other_parents: dict[str, str] = {}
        self._fixed: dict[str, Float64Array] = {}
        self._moving: dict[str, PoseTrack] = {}
        self._holding: set[str] = set()

    def add(
        self,
        parent: str,
        child: str,
        stamp_ns: int | None,
        translation: Sequence[float],
        quaternion: Sequence[float],
    ) -> bool:
        """Add T_parent_child: fixed where ``stamp_ns`` is None, else the moving transform's value at that stamp.

        Returns False and adds nothing where the transform is not finite, has a zero quaternion, or gives a frame a
        second parent.
        """
        parent, child = frame_name(parent), frame_name(child)
        known = self._parents.setdefault(child, parent)
        if known != parent:
            self._other_parents[child] = parent
            return False
        if stamp_ns is None:
            rotation = normalise(quaternion)
            if rotation is None or not all(math.isfinite(value) for value in translation):
                return False
            self._fixed[child] = pose_matrix(translation, rotation)
            return True
        if child not in self._moving:
            self._moving[child] = PoseTrack(self._pose_gap_ns)
        return self._moving[child].add(stamp_ns, translation, quaternion)

    def add_transforms(self, found: Transforms, *, is_static: bool, stamp_ns: int | None = None) -> bool:
        """Add the transforms of a message at their own stamps, or all at ``stamp_ns``.

        Returns False where none was added.
        """
        num_added = 0
        for entry in found.transforms:
            stamp = None if is_static else entry.stamp_ns if stamp_ns is None else stamp_ns
            num_added += self.add(entry.parent, entry.child, stamp, entry.translation, entry.rotation)
            if found.holds:
                self._holding.add(frame_name(entry.child))
        return num_added > 0

    @property
    def frames(self) -> tuple[str, ...]:
        """Names of all frames, sorted."""
        return tuple(sorted({*self._parents, *self._parents.values()}))

    def is_cyclic(self, frame: str) -> bool:
        """True where the chain of a frame's parents never ends."""
        return self.root_of(frame) in self._parents

    def has_two_parents(self, frame: str) -> bool:
        """True where TF gave transforms of a frame to two parents."""
        return frame_name(frame) in self._other_parents

    def edge_sample(self, child: str) -> tuple[Float64Array, bool] | None:
        """Earliest T_parent_child, (4, 4), and True where it never changes; None without a usable transform."""
        if child in self._fixed:
            return self._fixed[child], True
        track = self._moving.get(child)
        return (track.first_matrix, track.is_constant) if track is not None and len(track) else None

    def ancestors(self, frame: str) -> Iterator[str]:
        """A frame and its ancestors up to the root; a cycle ends before its first repeated frame."""
        seen = set()
        while frame not in seen:
            seen.add(frame)
            yield frame
            if frame not in self._parents:
                return
            frame = self._parents[frame]

    def root_of(self, frame: str) -> str:
        """Root of the tree that a frame is in (the frame itself where it has no parent)."""
        *_, root = self.ancestors(frame_name(frame))
        return root

    def is_connected(self, a: str, b: str) -> bool:
        """True where a chain of transforms joins two frames, at any time."""
        return self.root_of(a) == self.root_of(b)

    def is_fixed(self, a: str, b: str) -> bool:
        """True where the frames are joined by fixed transforms alone."""
        if not self.is_connected(a, b):
            return False
        up, down = self._chain(frame_name(a), frame_name(b))
        return all(child in self._fixed for child in (*up, *down))

    def last_ns(self, a: str, b: str) -> int | None:
        """Stamp up to which every moving transform between two frames is known; None without moving transforms."""
        moving = self._moving_between(a, b)
        return min((track.last_ns for track in moving if track.last_ns is not None), default=None)

    def first_ns(self, a: str, b: str) -> int | None:
        """Stamp from which on every moving transform between two frames is known; None where one has no value."""
        firsts = [track.first_ns for track in self._moving_between(a, b)]
        return None if None in firsts else max((first for first in firsts if first is not None), default=None)

    def T_a_b(self, a: str, b: str, stamp_ns: int, *, hold: bool = False) -> Float64Array | None:
        """Transform from frame b to frame a at a stamp, (4, 4); None where a moving transform has no value there.

        With ``hold`` moving transforms are held as ``PoseTrack.matrix_at`` does. Raises InputError where no chain joins
        the frames, or a frame in it has two parents.
        """
        a, b = frame_name(a), frame_name(b)
        if not self.is_connected(a, b):
            raise InputError(self.why_not_connected(a, b))
        result = np.eye(4)
        up, down = self._chain(a, b)
        # Up from a to the common ancestor by inverse transforms, then down to b.
        for child in up:
            step = self._edge(child, stamp_ns, hold=hold)
            if step is None:
                return None
            result = result @ inverse(step)
        for child in reversed(down):
            step = self._edge(child, stamp_ns, hold=hold)
            if step is None:
                return None
            result = result @ step
        return result

    def why_not_connected(self, a: str, b: str) -> str:
        """Return a clause with the reason why no chain joins two frames."""
        a, b = frame_name(a), frame_name(b)
        if not self._parents:
            return f"no transform from '{b}' to '{a}': the log has no TF"
        unknown = [frame for frame in (a, b) if frame not in self.frames]
        if unknown:
            known = ", ".join(self.frames[:12]) + (", ..." if len(self.frames) > 12 else "")
            return f"no transform from '{b}' to '{a}': TF has no frame '{unknown[0]}'; its frames are {known}"
        return (
            f"no transform from '{b}' to '{a}': the root of '{b}' is '{self.root_of(b)}', that of '{a}' is "
            f"'{self.root_of(a)}', and no transform joins them"
        )

    def forget_before(self, stamp_ns: int) -> None:
        """Drop transforms that no stamp from ``stamp_ns`` on needs."""
        for track in self._moving.values():
            track.forget_before(stamp_ns)

    def _edge(self, child: str, stamp_ns: int, *, hold: bool) -> Float64Array | None:
        """T_parent_child at a stamp."""
        if child in self._other_parents:
            raise InputError(
                f"frame '{child}' has two parents in TF, '{self._parents[child]}' and '{self._other_parents[child]}'; "
                f"give a map_frame below it, or T_body_sensor"
            )
        if child in self._fixed:
            return self._fixed[child]
        track = self._moving.get(child)
        if track is None:
            return None
        if child in self._holding and track.num_added == 1:
            return track.first_matrix
        return track.matrix_at(stamp_ns, hold=hold)

    def _moving_between(self, a: str, b: str) -> list[PoseTrack]:
        """Tracks of the moving transforms between two frames."""
        up, down = self._chain(frame_name(a), frame_name(b))
        return [self._moving[child] for child in (*up, *down) if child in self._moving and child not in self._fixed]

    def _chain(self, a: str, b: str) -> tuple[list[str], list[str]]:
        """Frames below the first common ancestor of a and b: those above a, and those above b, each with a or b."""
        from_a = list(self.ancestors(a))
        depth_of = {frame: index for index, frame in enumerate(from_a)}
        down: list[str] = []
        for frame in self.ancestors(b):
            if frame in depth_of:
                return from_a[: depth_of[frame]], down
            down.append(frame)
        return from_a, down


def frame_name(name: str) -> str:
    """Return a frame's name without the leading slash of ROS 1."""
    return name.lstrip("/")
