"""The datum: the whole, moved as one so that its targets lie on the nominal ones as well as can be."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from errormotion.methods.multilateration.kernels import Array, compiled
from errormotion.methods.multilateration.model import Stations


def fitted(stations: Stations, target: Array, nominal: Array, used: NDArray[np.bool_]) -> tuple[Stations, Array, Array]:
    """Return stations and targets (m, 3) moved onto the nominal targets, and the rotation (3, 3).

    The rotation is that of Kabsch: from the singular vectors of the targets' cross products. ``used`` (m,) are the
    targets that count.
    """
    a, b, C = _moments(target, nominal, used)
    U, _, Vt = np.linalg.svd(C)
    R: Array = U @ np.diag([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))]) @ Vt
    return replace(stations, place=(stations.place - a) @ R.T + b), _moved(target, a, b, R), R


@compiled()
def _moments(
    target: Array, nominal: Array, used: NDArray[np.bool_]
) -> tuple[Array, Array, Array]:  # pragma: no cover - compiled
    """Return means (3,) of targets and nominal ones, and the sum (3, 3) of nominal times target about them."""
    a, b, C, count = np.zeros(3), np.zeros(3), np.zeros((3, 3)), 0
    for i in range(len(target)):
        if used[i]:
            count += 1
            for k in range(3):
                a[k] += target[i, k]
                b[k] += nominal[i, k]
    for k in range(3):
        a[k] /= count
        b[k] /= count
    for i in range(len(target)):
        if used[i]:
            for k in range(3):
                for n in range(3):
                    C[k, n] += (nominal[i, k] - b[k]) * (target[i, n] - a[n])
    return a, b, C


@compiled()
def _moved(target: Array, a: Array, b: Array, R: Array) -> Array:  # pragma: no cover - compiled
    """Return R (target - a) + b."""
    moved = np.empty_like(target)
    for i in range(len(target)):
        x, y, z = target[i, 0] - a[0], target[i, 1] - a[1], target[i, 2] - a[2]
        for k in range(3):
            moved[i, k] = R[k, 0] * x + R[k, 1] * y + R[k, 2] * z + b[k]
    return moved
