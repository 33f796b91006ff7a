"""Batches of rigid transforms (n, 4, 4), rotations (n, 3, 3) and rotation vectors (n, 3) [rad]; all are float64."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from octoreplay.records import Float64Array


def inverses(transforms: Float64Array) -> Float64Array:
    """Return the inverses (n, 4, 4) of rigid transforms (n, 4, 4)."""
    result = np.zeros_like(transforms)
    rotations = transforms[:, :3, :3].transpose(0, 2, 1)
    result[:, :3, :3] = rotations
    result[:, :3, 3] = -np.einsum("nij,nj->ni", rotations, transforms[:, :3, 3])
    result[:, 3, 3] = 1.0
    return result


def cross_matrix(v: Float64Array) -> Float64Array:
    """Return the matrix [v]x (3, 3) of the cross product with v (3,)."""
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])


def rotation_exps(vectors: Float64Array) -> Float64Array:
    """Return the rotations (n, 3, 3) of rotation vectors (n, 3) [rad]."""
    return np.asarray(Rotation.from_rotvec(vectors).as_matrix())


def rotation_logs(rotations: Float64Array) -> Float64Array:
    """Return the rotation vectors (n, 3) [rad] of rotations (n, 3, 3)."""
    return np.asarray(Rotation.from_matrix(rotations).as_rotvec())


def cross_matrices(vectors: Float64Array) -> Float64Array:
    """Return the matrices (n, 3, 3) of the cross products with vectors (n, 3): [v]_x w = v x w."""
    result = np.zeros((len(vectors), 3, 3))
    x, y, z = vectors.T
    result[:, 0, 1], result[:, 0, 2], result[:, 1, 2] = -z, y, -x
    result[:, 1, 0], result[:, 2, 0], result[:, 2, 1] = z, -y, x
    return result


def inverse_left_jacobians(vectors: Float64Array) -> Float64Array:
    """Return Jl^-1 (n, 3, 3) of rotation vectors (n, 3): Log(Exp(d) Exp(v)) = v + Jl^-1 d to first order.

    Solà, Deray and Atchuthan, A micro Lie theory for state estimation in robotics, 2018, eq. 146.
    """
    cross = cross_matrices(vectors)
    angles = np.linalg.norm(vectors, axis=1)
    small = angles < 1e-4
    safe = np.where(small, 1.0, angles)
    quadratic = np.where(small, 1.0 / 12.0, 1.0 / safe**2 - (1.0 + np.cos(safe)) / (2.0 * safe * np.sin(safe)))
    return np.asarray(np.eye(3) - 0.5 * cross + quadratic[:, None, None] * (cross @ cross))


def moved(transforms: Float64Array, steps: Float64Array) -> Float64Array:
    """Return transforms (n, 4, 4) after steps (n, 6) of rotation phi [rad] and translation rho [m] on the left.

    Each transform turns about its own origin: (R, t) becomes (Exp(phi) R, t + rho).
    """
    result = transforms.copy()
    result[:, :3, :3] = rotation_exps(steps[:, :3]) @ transforms[:, :3, :3]
    result[:, :3, 3] += steps[:, 3:]
    return result
