"""Logarithms of the probabilities of extreme values, which do not underflow."""

from __future__ import annotations

import numpy as np
from scipy.special import betaln, chdtrc, fdtrc, gammaln

from errormotion.arrays import Array

__all__ = ["log_chi2_tail", "log_f_tail"]

_SMALL = 1e-280


def log_chi2_tail(x: Array, k: int) -> Array:
    """Return the logarithm of the probability of a chi-square of k degrees of freedom above x.

    Far out by ``Q = (x/2)^(k/2 - 1) exp(-x/2) / Gamma(k/2) (1 + (k/2 - 1) / (x/2) + ...)`` (Abramowitz and Stegun,
    6.5.32).
    """
    x = np.asarray(x, dtype=float)
    p = chdtrc(k, x)
    h = np.maximum(x / 2, 1.0)
    a = k / 2
    far = (a - 1) * np.log(h) - h - gammaln(a) + np.log1p((a - 1) / h * (1 + (a - 2) / h))
    return np.asarray(np.where(p > _SMALL, np.log(np.maximum(p, _SMALL)), far))


def log_f_tail(x: Array, k: int, f: float) -> Array:
    """Return the logarithm of the probability of an F of k and f degrees of freedom above x.

    It is the incomplete beta function I_z(f/2, k/2) with ``z = f / (f + k x)``, far out
    ``z^a (1 - z)^b / (a B(a, b)) (1 + q + ...)`` (Abramowitz and Stegun, 26.5.4), nearly a geometric series with
    ``q = z (a + b) / (a + 1)``.
    """
    x = np.asarray(x, dtype=float)
    p = fdtrc(k, f, x)
    a, b = f / 2, k / 2
    z = f / (f + k * np.maximum(x, 1e-300))
    with np.errstate(divide="ignore"):
        log_z, log_rest = np.log(z), np.log1p(-z)
    q = np.minimum(z * (a + b) / (a + 1), 1 - 1e-9)
    far = a * log_z + b * log_rest - np.log(a) - betaln(a, b) - np.log1p(-q)
    return np.asarray(np.where(p > _SMALL, np.log(np.maximum(p, _SMALL)), far))
