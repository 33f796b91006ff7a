"""Submaps: labelled surfaces of a few seconds of one robot's scans, and the edges between overlapping ones."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from octoreplay.records import Float64Array, Int64Array, UInt8Array
from octoreplay.registration.pose_graph import PoseGraphEdge
from octoreplay.registration.rigid import moved
from octoreplay.transforms import inverse

VOXEL = 0.2
_CLASS_DISTANCE = 1e3
_NUM_NEIGHBOURS = 14
_NORMAL_RADIUS = 0.7
_FLATNESS = 0.12
CONS = 0.9


@dataclass(frozen=True, eq=False)
class Submap:
    """Surface seen in a few seconds: points (n, 3) with class ids (n,), normals (n, 3) in the frame of the anchor."""

    robot: int
    stamp_ns: int
    T_team_anchor: Float64Array
    points: Float64Array
    class_ids: UInt8Array
    normals: Float64Array
    is_flat: np.ndarray
    sample: Int64Array
    tree: cKDTree


def surface(points, class_ids, num_samples, rng):
    """points, majority class per voxel"""
    keys = np.floor(points / VOXEL).astype(np.int64) + (1 << 19)
    cell = (keys[:, 0] << 40) | (keys[:, 1] << 20) | keys[:, 2]
    code = cell * 256 + class_ids
    order = np.argsort(code, kind="stable")
    code = code[order]
    start = np.flatnonzero(np.r_[True, code[1:] != code[:-1]])
    count = np.diff(np.r_[start, code.size])
    mean = np.add.reduceat(points[order], start, axis=0) / count[:, None]
    cells, classes = code[start] // 256, (code[start] % 256).astype(np.uint8)
    # majority class of each voxel
    best = np.lexsort((-count, cells))
    first = best[np.r_[True, cells[best][1:] != cells[best][:-1]]]
    first = first[(count[first] >= 3) & (classes[first] > 0)]
    return mean[first], classes[first]


def make_submap(robot, stamp_ns, T_team_anchor, points, class_ids, num_samples=1000):
    rng = np.random.default_rng(0)
    p, c = surface(points, class_ids, num_samples, rng)
    tree4 = cKDTree(np.column_stack([p, c * _CLASS_DISTANCE]))
    tree = cKDTree(p)
    d, i = tree.query(p, k=min(_NUM_NEIGHBOURS, len(p)), distance_upper_bound=_NORMAL_RADIUS)
    ok = i < len(p)
    x = np.where(ok[..., None], p[np.minimum(i, len(p) - 1)], 0.0)
    n = ok.sum(1)
    mean = x.sum(1) / n[:, None]
    y = np.where(ok[..., None], x - mean[:, None], 0.0)
    cov = np.einsum("nki,nkj->nij", y, y) / n[:, None, None]
    w, v = np.linalg.eigh(cov)
    normals = v[:, :, 0]
    flat = (n >= 6) & (w[:, 0] < _FLATNESS * w[:, 1])
    # Samples spread over the directions of normals: each of 13 bins alike.
    axis = np.abs(normals).argmax(1)
    chosen = []
    for k in range(3):
        of = np.flatnonzero(flat & (axis == k))
        m = min(len(of), num_samples // 3)
        chosen.append(rng.choice(of, m, replace=False))
    return Submap(robot, stamp_ns, T_team_anchor, p, c, normals, flat, np.sort(np.concatenate(chosen)), tree4)


def _half(a, b, T, gate, sigma, frame_is_b):
    """Samples of b matched in a. T maps b to a. H, g in the right perturbation of T (first a, second b)."""
    s = b.sample
    p = b.points[s]
    q = p @ T[:3, :3].T + T[:3, 3]
    d, i = a.tree.query(np.column_stack([q, b.class_ids[s] * _CLASS_DISTANCE]), distance_upper_bound=gate)
    ok = i < len(a.points)
    i = np.minimum(i, len(a.points) - 1)
    nb = b.normals[s] @ T[:3, :3].T
    na = a.normals[i]
    ok &= a.is_flat[i] & (np.abs(np.einsum("ni,ni->n", nb, na)) > 0.75)
    r = np.einsum("ni,ni->n", na, q - a.points[i])[ok]
    n = na[ok] @ T[:3, :3]  # in b's frame
    J = np.concatenate([n, np.cross(p[ok], n)], axis=1)
    return r, J


def step(a, b, T, gate, sigma):
    r1, J1 = _half(a, b, T, gate, sigma, True)
    Ti = inverse(T)
    r2, J2 = _half(b, a, Ti, gate, sigma, False)
    # A right step xi of T is a right step of T^-1 by -Ad(T) xi.
    R, t = T[:3, :3], T[:3, 3]
    Ad = np.zeros((6, 6))
    Ad[:3, :3] = R
    Ad[3:, 3:] = R
    tx = np.array([[0, -t[2], t[1]], [t[2], 0, -t[0]], [-t[1], t[0], 0]])
    Ad[:3, 3:] = tx @ R
    J2 = -J2 @ Ad
    r = np.concatenate([r1, r2])
    J = np.concatenate([J1, J2])
    k = gate / 3
    w = 1.0 / (1.0 + (r / k) ** 2) ** 2
    H = (J * w[:, None]).T @ J
    g = J.T @ (w * r)
    return H, g, float((np.abs(r) < 0.12).mean()) if len(r) else 0.0, len(r), float(np.sqrt((w * r * r).sum() / max(w.sum(), 1e-9)))


def register(a, b, T, gates, sigma=0.15, num_per_one=20.0):
    """T_ab and information after GN steps"""
    for gate in gates:
        H, g, n, num, rms = step(a, b, T, gate, sigma)
        if num < 60 or (gate < 0.45 and n < CONS):
            return None
        scale = num_per_one * sigma**2
        # Weak directions stay: a prior of the start pose
        prior = np.diag([1 / 0.5**2] * 3 + [1 / 0.05**2] * 3)
        x = np.linalg.solve(H / scale + prior, -g / scale)
        T = moved(T[None], x[None])[0]
    return T, H / scale, num, rms
