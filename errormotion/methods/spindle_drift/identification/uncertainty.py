"""Uncertainty of the drift: independent noise, and sources that are one draw for the whole record.

The errors of an instant are a function of its readings, of the readings of the reference state, and of the beams and
the bar radius, which both share. With a the direction of the bar, E the middle of its end face, 0 the reference state
and p the functional point,

    w = a0 x a                               rotation; the part about the axis is not measured
    T = E - E0 + w x (p - E0)                displacement of p

    dw = a0 x da - a x da0
    dT = dE - dE0 + dw x (p - E0) - w x dE0

The derivatives of a and E come from ``bar.state_jacobian``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from errormotion.arrays import Array
from errormotion.datasets.provenance import identity
from errormotion.methods.spindle_drift.identification.bar import PARAMETERS, state_jacobian
from errormotion.methods.spindle_drift.schema import CHANNELS

REFERENCE = "reference state"
"""Group of the sources that are the uncertainty of the reference state."""

if TYPE_CHECKING:
    from collections.abc import Sequence


_BLOCK = 1024


@dataclass(frozen=True)
class Source:
    """One standard uncertainty of a quantity that all instants share, as a change of the 36 parameters.

    ``now`` acts on the state of each instant, ``then`` on the reference state; (36,) in SI. ``identity`` is empty for a
    source that no other record has.
    """

    name: str
    group: str
    now: Array
    then: Array
    identity: str = ""


@dataclass(frozen=True)
class Frame:
    """Geometry common to all instants."""

    origin: Array
    direction: Array
    levels: Array
    point: Array


@dataclass(frozen=True)
class State:
    """Fitted states: readings (5, instant), axes q (instant, 4), directions a and end points E (instant, 3)."""

    distance: Array
    q: Array
    a: Array
    E: Array


def twist(now: State, then: State, point: Array) -> Array:
    """Return the error twists (instant, 6) at ``point`` relative to the one state ``then``; EC is NaN."""
    rotation = np.cross(then.a[0], now.a)
    shift = now.E - then.E[0] + np.cross(rotation, point - then.E[0])
    errors = np.concatenate([shift, rotation], axis=1)
    errors[:, 5] = np.nan
    return errors


def _cross(v: Array, m: Array) -> Array:
    """Return v x m column by column; v (..., 3), m (..., 3, k)."""
    return np.asarray(np.cross(v[..., None], m, axis=-2))


def propagate(
    now: State,
    then: State,
    frame: Frame,
    sigma: Array,
    sources: Sequence[Source],
    scaled: Sequence[Array],
    single: Array,
) -> tuple[Array, Array]:
    """Return the covariance of each instant alone, and the influence of the shared sources.

    Parameters
    ----------
    now, then : State
        All instants, and the one reference state.
    frame : Frame
        Beams, levels and functional point.
    sigma : ndarray (5, instant)
        Standard uncertainty of the mean readings, m.
    sources : sequence of Source
        Shared by all instants.
    scaled : sequence of ndarray (5, instant)
        Effects of further shared sources as changes of the readings, m, in each instant.
    single : ndarray (5, instant)
        Effect of a quantity that is one draw for each instant alone, as a change of the readings, m.

    Returns
    -------
    independent : ndarray (instant, 6, 6)
        Covariance from the noise of the readings and from the single draws.
    influence : ndarray (source, instant, 6)
        Of ``sources``, then of ``scaled``.
    """
    instants = len(now.q)
    independent = np.full((instants, 6, 6), np.nan)
    influence = np.full((len(sources) + len(scaled), instants, 6), np.nan)
    da0, dE0 = (m[0] for m in state_jacobian(then.q, then.distance, frame.origin, frame.direction, frame.levels))
    changes_now = np.array([s.now for s in sources]).reshape(-1, PARAMETERS).T
    changes_then = np.array([s.then for s in sources]).reshape(-1, PARAMETERS).T
    da0, dE0 = da0 @ changes_then, dE0 @ changes_then
    a0, arm = then.a[0], frame.point - then.E[0]
    for first in range(0, instants, _BLOCK):
        part = slice(first, first + _BLOCK)
        a = now.a[part]
        w = np.cross(a0, a)
        da, dE = state_jacobian(now.q[part], now.distance[:, part], frame.origin, frame.direction, frame.levels)
        # The noise of the readings acts on the instant alone.
        dw = _cross(a0, da[:, :, :5])
        J = np.concatenate([dE[:, :, :5] + _cross(-arm, dw), dw], axis=1)
        alone = np.einsum("tip,pt->ti", J, single[:, part])
        independent[part] = np.einsum("tip,pt,tjp->tij", J, sigma[:, part] ** 2, J) + alone[:, :, None] * alone[:, None]
        for k, change in enumerate(scaled):
            influence[len(sources) + k, part] = np.einsum("tip,pt->ti", J, change[:, part])
        # Shared sources act on the instant and on the reference state.
        da, dE = da @ changes_now, dE @ changes_now
        dw = _cross(a0, da) - _cross(a, da0[None])
        dT = dE - dE0 + _cross(-arm, dw) - _cross(w, dE0[None])
        influence[: len(sources), part] = np.moveaxis(np.concatenate([dT, dw], axis=1), 2, 0)
    return independent, influence


def reading_sources(sigma: Array) -> list[Source]:
    """Return the readings of the reference state as sources; ``sigma`` (5,), m."""
    found = []
    for i, name in enumerate(CHANNELS):
        change = np.zeros(PARAMETERS)
        change[i] = sigma[i]
        found.append(Source(f"reference {name}", REFERENCE, np.zeros(PARAMETERS), change))
    return found


def beam_sources(origin: Array, direction: Array, covariance: Array, group: str, *, calibrated: bool) -> list[Source]:
    """Return the covariance (5, 6, 6) of (origin, direction) of the beams as sources: the columns of its factors.

    The parts of beams that were ``calibrated`` are the same draws in all records with this calibration. Those of
    nominal beams have no identity: every set-up is off its nominal beams in its own way.
    """
    found = []
    for i, name in enumerate(CHANNELS):
        # Scaled, so that metres and radians have the same weight in the decision on the rank.
        size = np.sqrt(np.diag(covariance[i]))
        unit = np.where(size > 0, size, 1.0)
        values, vectors = np.linalg.eigh(covariance[i] / np.outer(unit, unit))
        for k in np.flatnonzero(values > 1e-12):
            change = np.zeros(PARAMETERS)
            change[5 + 6 * i : 11 + 6 * i] = unit * vectors[:, k] * np.sqrt(values[k])
            one = ""
            if calibrated:
                one = identity(origin[i], direction[i], covariance[i], part=f"part {k + 1}", along=vectors[:, k])
            found.append(Source(f"beam {name}.{k}", group, change, change, one))
    return found


def radius_source(sigma: float) -> Source:
    """Return the bar radius as a source."""
    change = np.zeros(PARAMETERS)
    change[-1] = sigma
    return Source("bar radius", "bar radius", change, change)
