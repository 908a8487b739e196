"""Gradient of the reading with the stage position on each plane, with the covariance that the scatter states.

On a plane the reading is d = offset + g . (s - c), with the stage position s and its mean c. Readings contain white
noise and, along a stroke, speckle: errors whose correlation decreases with the distance of the positions,
``speckle^2 exp(-|s_i - s_j| / length)``, so that a plane is one vector reading with this covariance. Without stated
speckle, the correlation of neighbouring readings is estimated (`estimation.checks.correlated`).

The gradients are free here, although those of one beam are not: planes that contradict one another, because of an
inclination error that is not compensated or a plane that moved, must not look like noise or outliers of readings.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Generic, NamedTuple, TypeVar

import numpy as np

from errormotion.arrays import Array
from errormotion.errors import MethodError
from errormotion.estimation.blocks import Block, Index, Noise
from errormotion.estimation.problem import READINGS, Problem
from errormotion.estimation.sources import Places
from errormotion.measurement.identification import solve
from errormotion.measurement.observed import Observed, Solved

if TYPE_CHECKING:
    from errormotion.methods.beam_direction.identification.reading import Readings
    from errormotion.methods.beam_direction.settings import BeamDirectionSettings

T = TypeVar("T")
UNKNOWNS = 4
"""Gradient (3) and offset."""
MIN_USED = 0.7
"""Smallest share of readings that fit the plane."""
MAX_GRADIENT_U = 0.03
"""Largest standard uncertainty of the gradient along a measured direction."""
MAX_CORRELATED = 4000
"""Largest number of readings of a plane with speckle."""


class Unknowns(NamedTuple, Generic[T]):
    """Gradient and offset of each plane."""

    plane: T


@dataclass(frozen=True, eq=False)
class Planes:
    """Fitted planes.

    Attributes
    ----------
    names : tuple of str
        For messages.
    centre : ndarray (k, 3)
        Mean position of the stage, m.
    value : ndarray (k, 4)
        Gradient of the reading with the position, and reading at ``centre``, m.
    covariance : ndarray (k, 4, 4)
        Of ``value``, SI.
    noise : float
        Standard deviation of one reading, m: the stated one, or that of the residuals where it is larger.
    doubts : tuple of str
        Why the covariance may be too small.
    solved : Solved or None
        The readings' fit with white noise, or with stated speckle; None for planes that were not read.
    """

    names: tuple[str, ...]
    centre: Array
    value: Array
    covariance: Array
    noise: float = float("nan")
    doubts: tuple[str, ...] = ()
    solved: Solved | None = None

    @property
    def gradients(self) -> Array:
        """Gradients (k, 3)."""
        return self.value[:, :3]


def fit_planes(data: Readings, settings: BeamDirectionSettings, notes: list[str]) -> Planes:
    """Return the planes through the readings without outliers; remarks are appended to ``notes``.

    Raises
    ------
    MethodError
        Too few readings, a stage that does not move along three independent directions, or readings off a plane.
    """
    distance, stage = data.distance, np.nan_to_num(data.stage)
    used = np.isfinite(distance) & np.isfinite(data.stage).all(axis=2)
    for name, its in zip(data.names, used, strict=True):
        if its.sum() < UNKNOWNS:
            raise MethodError(
                f"{name}: {its.sum()} of {its.size} readings are valid; expected at least {UNKNOWNS}, on strokes along "
                "three independent directions.",
                code="beam.plane.readings_too_few",
            )
    centre = np.stack([positions[its].mean(axis=0) for positions, its in zip(stage, used, strict=True)])
    design = np.concatenate([stage - centre[:, None], np.ones((*distance.shape, 1))], axis=2)
    total = float(np.hypot(data.noise, data.speckle))
    _check_strokes(data.names, design, used, total)
    solved = solve(_observed(data, np.where(used, distance, np.nan), design, settings))
    left = np.isfinite(solved.white.problem.readings).reshape(distance.shape)
    for name, its, before in zip(data.names, left, used, strict=True):
        if its.sum() < max(MIN_USED * before.sum(), UNKNOWNS):
            raise MethodError(
                f"{name}: {before.sum() - its.sum()} of {before.sum()} readings do not fit a plane. Check that "
                "positions and readings correspond, and that all readings are on one plane.",
                code="beam.plane.readings_differ",
            )
    _check_strokes(data.names, design, left, total)
    notes += solved.observed.notes
    doubts = list(solved.observed.doubts)
    (doubts if solved.scatter.doubtful else notes).append(solved.scatter.note)
    noise = data.noise * float(np.sqrt(solved.scatter.factor))
    value, covariance = solved.relative.errors.value, solved.relative.errors.own
    return Planes(data.names, centre, value, covariance, noise, tuple(doubts), solved)


def _observed(data: Readings, readings: Array, design: Array, settings: BeamDirectionSettings) -> Observed:
    """Return the readings as a model of planes: one vector reading each with speckle, else independent readings."""
    k, n = readings.shape
    series, order = np.indices((k, n)).reshape(2, -1)
    follows = settings.ordered and not data.has_correlated_speckle
    return Observed(
        problem=problem_of(readings, design, data.stage, data.noise, data.speckle, data.speckle_length, data.names),
        places=Places(lambda x, _: x.plane, k),
        order=order.astype(float) if follows else None,
        series=series if follows else None,
        dims=("plane",),
        coords={"plane": np.arange(k)},
        component="plane",
        functional_point=(0.0, 0.0, 0.0),
        reference="",
        recorded=("distance", ("plane", "reading")),
        what="the readings",
        noise_cause="Possible causes: speckle that is not stated (speckle, speckle_length), a plane that is not flat, "
        "or a stage that is not straight.",
        noise_increases=settings.noise == "auto",
        robust=settings.robust,
        name=lambda at: _name(data.names, at, n),
    )


def problem_of(
    readings: Array,
    design: Array,
    stage: Array,
    noise: float,
    speckle: float = 0.0,
    speckle_length: float = 0.0,
    names: tuple[str, ...] = (),
) -> Problem:
    """Return the least squares of readings (k, n), m, with the derivatives (k, n, 4) by gradient and offset.

    Raises
    ------
    MethodError
        Too many readings with speckle.
    """
    k, n = readings.shape
    index = np.arange(k)
    if not (speckle > 0 and speckle_length > 0):
        readings, design, index = readings.ravel(), design.reshape(-1, UNKNOWNS), np.repeat(index, n)
        spread = Noise(sd=np.full(k * n, np.hypot(noise, speckle)))
    else:
        if n > MAX_CORRELATED:
            raise MethodError(
                f"{names[0]}: {n} readings with speckle; expected at most {MAX_CORRELATED}. Use fewer readings: those "
                f"closer than the correlation length ({speckle_length * 1e6:g} um) add little information.",
                code="beam.plane.readings_too_many",
            )
        spread = Noise(root=np.stack([correlation_root(each, noise, speckle, speckle_length) for each in stage]))

    def equation(y: Array, x: Unknowns[Array], _: Any) -> Array:
        return np.asarray(y - np.einsum("n...i,ni->n...", design, x.plane))

    def derivatives(y: Array, x: Unknowns[Array], _: Any) -> dict[str, Array]:  # noqa: ARG001
        if design.ndim == 2:
            return {"plane": -design[:, None]}
        return {"plane": -design, READINGS: np.broadcast_to(np.eye(n), (k, n, n))}

    return Problem(
        equation=equation,
        readings=readings,
        unknowns=Unknowns(plane=Block(start=np.zeros((k, UNKNOWNS)), index=index, scale=1.0)),
        noise=spread,
        derivatives=derivatives,
    )


def correlation_root(stage: Array, noise: float, speckle: float, speckle_length: float) -> Array:
    """Return a square root (n, n) of the covariance of readings at positions (n, 3), m; NaN where there is none."""
    total = noise**2 + speckle**2
    if not (speckle > 0 and speckle_length > 0):
        return np.asarray(np.sqrt(total) * np.eye(len(stage)))
    separation = np.linalg.norm(stage[:, None] - stage[None], axis=2)
    C = np.nan_to_num(speckle**2 * np.exp(-separation / speckle_length))
    C[np.diag_indices_from(C)] = total
    return np.asarray(np.linalg.cholesky(C))


def _name(names: tuple[str, ...], at: Index, n: int) -> str:
    """Return the name of a reading from (plane, reading), or from its number among the readings of all planes."""
    plane, reading = divmod(int(at[0]), n) if at.size == 1 else at.tolist()
    return f"{names[plane].lower()}, reading {reading + 1}"


def _check_strokes(names: tuple[str, ...], design: Array, used: Any, total: float) -> None:
    """Raise MethodError for positions that do not spread along three directions, which the gradient requires."""
    for name, rows, its in zip(names, design, used, strict=True):
        A = rows[its, :3]
        values, vectors = np.linalg.eigh(A.T @ A)
        least = max((total / MAX_GRADIENT_U) ** 2, 1e-14 * float(values[2]))
        missing = vectors.T[values <= least]
        if not len(missing):
            continue
        missing = missing * np.sign(missing[np.arange(len(missing)), np.argmax(np.abs(missing), axis=1)])[:, None]
        spread = float(np.sqrt(max(values[0], 0.0) / len(A)))
        along = ", ".join("({:.2f}, {:.2f}, {:.2f})".format(*(np.round(v, 2) + 0.0)) for v in missing)
        raise MethodError(
            f"{name}: the stage moves along {3 - len(missing)} of three independent directions; along {along} the "
            f"spread (rms) of its positions is {spread * 1e6:.3g} um. Expected strokes along three directions, such as "
            f"X, Y and Z, with a spread of more than {np.sqrt(least / len(A)) * 1e6:.2g} um, to determine the "
            "gradient.",
            code="beam.plane.strokes",
        )
