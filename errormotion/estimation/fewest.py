"""The fewest sources: effects below rounding are exactly 0 or dropped, and draws that nobody names are joined.

The sources of the readings, of random effects and of a datum are independent draws without a meaning of their own: any
orthogonal combination of them has the same covariance. Where they are more than the directions in which they have an
effect, the principal ones of these replace them.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from errormotion.arrays import Array
from errormotion.estimation.datum import Relative
from errormotion.estimation.sources import Source

__all__ = ["NEGLIGIBLE", "fewest"]

NEGLIGIBLE = 1e-6
"""Largest effect of a source that counts as none, in standard uncertainties of the errors and of the coefficients.

A thousand of such sources change no standard uncertainty by more than 1e-9 of it.
"""
ROUNDING = 1e-9
"""Effect at one place, in its standard uncertainties, that is rounding: derivatives are accurate to some 1e-10."""
_LARGE = 2e8
"""Operations beyond which sources are not joined."""


def fewest(relative: Relative) -> Relative:
    """Return the same errors with the fewest sources; each covariance is the same but for rounding."""
    sources, of_h = relative.errors.sources, relative.influence
    if not sources:
        return relative
    own = np.diagonal(relative.errors.own, axis1=1, axis2=2)
    variance = own.copy()
    for source in sources:
        variance += np.square(source.effect)
    u = np.sqrt(np.where(variance == 0, np.inf, variance))  # NaN where unknown
    u_h = np.sqrt(np.diagonal(relative.covariance))
    u_h = np.where(u_h > 0, u_h, np.inf)
    least, rounding = NEGLIGIBLE * u, ROUNDING * u
    kept, influence = list[Source](), list[Array]()
    for name in dict.fromkeys(source.joined or str(k) for k, source in enumerate(sources)):
        at = [k for k, source in enumerate(sources) if (source.joined or str(k)) == name]
        its, effects = [sources[k] for k in at], of_h[at]
        if its[0].joined and (joined := _joined(its, effects, u, u_h)) is not None:
            its, effects = joined
        for source, effect in zip(its, effects, strict=True):
            size = np.abs(source.effect)
            if (size > least).any() or (np.abs(effect) > NEGLIGIBLE * u_h).any():
                small = size <= rounding  # False for NaN
                kept.append(replace(source, effect=np.where(small, 0.0, source.effect)) if small.any() else source)
                influence.append(effect)
    errors = replace(relative.errors, sources=kept)
    return replace(relative, errors=errors, influence=np.reshape(influence, (len(kept), of_h.shape[1])))


def _joined(sources: list[Source], of_h: Array, u: Array, u_h: Array) -> tuple[list[Source], Array] | None:
    """Return the principal sources, largest first; None if they are not fewer."""
    count, size = len(sources), u.size + u_h.size
    if count < 2 or min(count, size) * count * size > _LARGE:
        return None
    effects = np.array([np.nan_to_num(source.effect / u).ravel() for source in sources])
    both = np.concatenate([effects, of_h / u_h], axis=1)
    _, power, rows = np.linalg.svd(both, full_matrices=False)
    kept = power > NEGLIGIBLE
    if kept.sum() == count:
        return None
    unit, unknown = np.where(np.isfinite(u), u, 0.0), np.isnan(u)
    scaled = power[kept, None] * rows[kept]
    joined = []
    for k, row in enumerate(scaled):
        effect = np.where(unknown, np.nan, row[: u.size].reshape(u.shape) * unit)
        joined.append(replace(sources[0], name=sources[0].joined + (f" {k + 1}" if k else ""), effect=effect))
    return joined, scaled[:, u.size :] * np.where(np.isfinite(u_h), u_h, 0.0)
