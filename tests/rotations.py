"""Rotation matrices."""

import numpy as np


def rotation(angle, axis=(0, 0, 1)):
    """Matrix (3, 3) of a rotation by an angle [rad] about an axis of any length."""
    x, y, z = np.asarray(axis) / np.linalg.norm(axis)
    k = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * k + (1 - np.cos(angle)) * k @ k


def random_rotation(rng):
    """Matrix (3, 3) of a random rotation."""
    q, r = np.linalg.qr(rng.normal(size=(3, 3)))
    q *= np.sign(np.diag(r))
    return q * np.sign(np.linalg.det(q))
