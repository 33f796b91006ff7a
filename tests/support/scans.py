"""Random scans, and the cells that they touch, from the caster and from the reference."""

from __future__ import annotations

import dataclasses

import numpy as np

from octoreplay.config.sensor import MapConfig, SensorConfig
from octoreplay.mapping.kernels import storage
from octoreplay.mapping.octree import SemanticOctree
from octoreplay.mapping.sensor import (
    ScanCaster,
    add_scan,
)
from octoreplay.records import BodyBox, CameraModel, CloudFrame, DepthFrame
from reference.sensor import scan_update

NUM_CLASSES = 5
SENSOR = SensorConfig(max_range=4.0)
MAP = MapConfig(resolution=0.2)


def cells_of_scan(frame, sensor=SENSOR, region=MAP, num_classes=NUM_CLASSES, caster=None):
    """(freed keys, {hit key: class_id}) of a scan, from the caster."""
    freed, hit = weighted_cells(frame, sensor, region, num_classes, caster)
    return freed, {key: class_id for key, (class_id, _) in hit.items()}


def weighted_cells(frame, sensor=SENSOR, region=MAP, num_classes=NUM_CLASSES, caster=None):
    """(freed keys, {hit key: (class_id, strength)}) of a scan, from the caster."""
    touched = (caster or ScanCaster(sensor, region, num_classes)).cast(frame)
    assert len(set(touched.codes.tolist())) == len(touched.codes)
    marks = touched.marks.view(np.uint8)
    rows, cells = np.nonzero(marks)
    keys = np.empty((len(rows), 3), np.int64)
    storage.codes_to_keys((touched.codes[rows] << storage.CELL_BITS) + cells, keys)
    kinds = marks[rows, cells].tolist()
    strengths = np.full(len(kinds), 255)
    if touched.strengths.size:
        strengths = touched.strengths.view(np.uint8)[rows, cells]
    content = dict(zip(map(tuple, keys.tolist()), zip(kinds, strengths.tolist(), strict=True), strict=True))
    freed = {key for key, (kind, _) in content.items() if kind == 1}
    return freed, {key: (kind - 1, strength) for key, (kind, strength) in content.items() if kind > 1}


def expected_cells(frame, sensor=SENSOR, region=MAP):
    freed, hit = expected_weighted_cells(frame, sensor, region)
    return freed, {key: class_id for key, (class_id, _) in hit.items()}


def expected_weighted_cells(frame, sensor=SENSOR, region=MAP):
    update = scan_update(frame, sensor, region)
    winners = zip(update.hit_classes.tolist(), update.hit_strengths.tolist(), strict=True)
    freed = {tuple(key) for key in update.freed.tolist()}
    return freed, dict(zip(map(tuple, update.hit.tolist()), winners, strict=True))


def check_scan(frame, sensor=SENSOR, region=MAP, num_classes=NUM_CLASSES):
    freed, hit = weighted_cells(frame, sensor, region, num_classes)
    expected_freed, expected_hit = expected_weighted_cells(frame, sensor, region)
    assert hit == expected_hit
    assert freed - expected_freed == set()
    assert expected_freed - freed == set()
    return freed, {key: class_id for key, (class_id, _) in hit.items()}


def random_pose(rng, spread=3.0):
    """A pose with a random rotation near the origin."""
    x, y, z, w = (q := rng.normal(size=4)) / np.linalg.norm(q)
    pose = np.eye(4)
    pose[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    pose[:3, 3] = rng.uniform(-spread, spread, 3)
    return pose


def random_depth(rng, dtype=np.float32, size=(11, 14)):
    depth = rng.uniform(0.0, 6.0, size)
    image = depth.astype(np.float32) if dtype == np.float32 else (depth * 1000).astype(np.uint16)
    classes = rng.integers(0, NUM_CLASSES + 1, size).astype(np.uint8)
    camera = CameraModel(size[1], size[0], 9.0, 8.5, 6.3, 5.2)
    return DepthFrame("r", 0, image, 1.0 if dtype == np.float32 else 0.001, classes, camera, random_pose(rng))


def random_cloud(rng, dtype=np.float32, size=150):
    points = (rng.normal(size=(size, 3)) * 2.5).astype(dtype)
    points[rng.random(size) < 0.1] = np.nan
    classes = rng.integers(0, NUM_CLASSES + 1, size).astype(np.uint8)
    return CloudFrame("r", 0, points, classes, random_pose(rng))


def strided(array):
    """The same values with gaps in memory."""
    wide = np.zeros(tuple(2 * n for n in array.shape), array.dtype)
    view = wide[tuple(slice(None, None, 2) for _ in array.shape)]
    view[...] = array
    return view


def read_only_copy(array):
    copy = array.copy()
    copy.setflags(write=False)
    return copy


# --- confidences, bodies, lenses -------------------------------------------------------------------------------------


def with_confidences(frame, confidences):
    name = "confidence_image" if isinstance(frame, DepthFrame) else "confidences"
    return dataclasses.replace(frame, **{name: np.asarray(confidences, np.uint8)})


def random_boxes(rng, frame, count):
    """Boxes of any rotation within the range of the scan; some contain the sensor."""
    boxes = []
    for _ in range(count):
        low = rng.uniform(-3.0, 0.2, 3)
        turned = random_pose(rng)
        turned[:3, 3] -= turned[:3, :3] @ frame.T_team_sensor[:3, 3]
        boxes.append(BodyBox(low, low + rng.uniform(0.2, 4.0, 3), turned, bool(rng.random() < 0.5)))
    return tuple(boxes)


# --- sums ------------------------------------------------------------------------------------------------------------


def sum_of_scans(frames, increments, num_classes=NUM_CLASSES, sensor=SENSOR, region=MAP):
    octree = SemanticOctree(region.resolution, num_classes)
    caster = ScanCaster(sensor, region, NUM_CLASSES)
    for revision, frame in enumerate(frames):
        add_scan(octree, caster.cast(frame), increments, revision)
    return octree
