"""The measurement model of multilateration: readings from targets, stations, drift, and what is known uncertainly.

    d_ij (1 + s) + g_ij . z = |u_i - U_j| - L_j + c_ij . p_j

u_i is target i, U_j station j, L_j its dead path, and p_j the drift of its set-up in standard uncertainties, with known
effects c_ij. s are relative errors of all lengths, z errors of the machine's scales, both 0 but for their uncertainty.
The targets are eliminated, so that time and memory are proportional to their number.

Distances do not determine the six rigid motions of the whole, which are the gauge. Each solution is moved to the best
fit of its targets to the nominal ones, and the errors are relative to it: a free network.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from dataclasses import replace as changed
from typing import Any, Generic, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from errormotion.arrays import Array
from errormotion.errors import FitError, MethodError
from errormotion.estimation.blocks import Block, Constant, Index, Noise
from errormotion.estimation.datum import Datum
from errormotion.estimation.problem import READINGS, Problem
from errormotion.estimation.sources import Places
from errormotion.kinematics.twists import rigid_motions
from errormotion.measurement.observed import Observed, Solved
from errormotion.methods.multilateration import determinacy
from errormotion.methods.multilateration.start import Stations, directions

T = TypeVar("T")

STATIONS, TARGETS = "stations", "targets"
"""Groups of the noise of readings: by the stations, and by the targets that define the datum."""
DRIFT, AIR, TRACKER, SCALES = "drift", "refraction", "scale of the tracker", "scales"
"""Groups of the drift of set-ups, of lengths by the air and by the tracker, and of the expansion of the scales."""
REFERENCE = (
    "best rigid fit of all targets to their commanded positions; the six rigid motions of the whole, three "
    "translations and three rotations, are not determined"
)
BY_READINGS = (STATIONS, TARGETS, DRIFT)
"""Groups of the sources that follow from the readings."""
XYZ = ("EX", "EY", "EZ")
LINEAR = 1e6
"""Scale, in standard uncertainties, of what the equation is linear in."""


@dataclass(frozen=True)
class Shared:
    """A source that many readings share, as the change of the readings by its standard uncertainty, (n, m), m."""

    name: str
    change: Array = field(repr=False)


@dataclass(frozen=True)
class Sources:
    """What is uncertain besides the noise of the readings.

    Attributes
    ----------
    air, tracker : mapping of str to float
        Relative standard uncertainties of all lengths by name.
    scales : sequence of Shared
        Expansion of the machine's scales.
    drift : sequence of Shared
        Of single set-ups; the readings may improve it.
    identity : mapping of str to str
        Of sources by name, such as a certificate.
    """

    air: Mapping[str, float] = field(default_factory=dict)
    tracker: Mapping[str, float] = field(default_factory=dict)
    scales: Sequence[Shared] = ()
    drift: Sequence[Shared] = ()
    identity: Mapping[str, str] = field(default_factory=dict)


class Unknowns(NamedTuple, Generic[T]):
    """Targets (m, 3), stations with their dead paths (n, 4), m, and drift (n, k)."""

    target: T
    station: T
    drift: T


class Known(NamedTuple, Generic[T]):
    """Relative errors of lengths (1, 1), and errors of the scales in standard uncertainties (1, k)."""

    air: T
    tracker: T
    scales: T


def network(
    reading: Array,
    sd: Array | float,
    nominal: Array,
    start: Stations,
    sources: Sources | None = None,
    *,
    noise_freedom: float = np.inf,
    **further: Any,
) -> Observed:
    """Return the model of a network.

    Parameters
    ----------
    reading : ndarray (n, m)
        Displacements of station j for target i, m; NaN where there is none.
    sd : float or ndarray, broadcast to (n, m)
        Standard deviations, m.
    nominal : ndarray (m, 3)
        Targets, m: start and datum.
    start : Stations
        Approximate ones.
    sources : Sources, optional
    noise_freedom : float
        Degrees of freedom of the variance of the noise.
    **further
        Of `Observed`.

    Raises
    ------
    MethodError
        Fewer readings than unknowns, or too few targets with a position.
    """
    n, m = reading.shape
    with np.errstate(all="ignore"):  # a target at a station is refused
        e = directions(nominal, start.position)
    sd = np.broadcast_to(np.asarray(sd, dtype=float), (n, m))
    structure = _structure(nominal, start, e, sd)
    try:
        problem = structure(_stated(reading, sd, nominal, start, sources or Sources(), noise_freedom))
    except FitError as error:
        raise MethodError(str(error), code=error.code) from error
    defaults: dict[str, Any] = {
        "coords": {},
        "functional_point": np.zeros(3),
        "finish": lambda solved: determined(solved, start.position)[0] if solved.propagated else solved,
        "name": lambda at: f"station {at[0] // m + 1} of target {at[0] % m + 1}",
    }
    return Observed(
        problem=problem,
        places=Places(lambda x, _: x.target - nominal, m, only=("target",), estimated=True),
        datum=Datum(rigid_motions(nominal, nominal.mean(axis=0)), np.ones((m, 3)), TARGETS),
        freedoms=XYZ,
        dims=("target",),
        component="tool",
        reference=REFERENCE,
        shared=STATIONS,
        what="the distances",
        structure=structure,
        undetermined=lambda of: determinacy.undetermined(structure(of), start.position),
        **(defaults | further),
    )


def determined(solved: Solved, approximate: Array) -> tuple[Solved, float]:
    """Return a solution with a note on an unsuitable layout, and the condition of its stations.

    Raises
    ------
    FitError
        A freedom is undetermined; its cause is described by the approximate stations (n, 3), m.
    """
    condition, errors = determinacy.condition(solved.fit, approximate), solved.relative.errors
    notes = determinacy.weak_layout(
        np.where(np.isfinite(errors.value)[..., None], errors.own, np.nan),
        [each.effect for each in errors.sources if each.group in BY_READINGS],
        float(np.sqrt(solved.factor) * np.median(np.asarray(solved.fit.problem.noise.sd))),
        approximate,
        solved.fit.unknowns.target,
    )
    observed = changed(solved.observed, notes=[*solved.observed.notes, *notes])
    return changed(solved, observed=observed), condition


def _structure(nominal: Array, start: Stations, e: Array, sd: Array) -> Callable[[Problem], Problem]:
    """Return what determines from the readings that are used which targets have a position; the others use none."""

    def structured(problem: Problem) -> Problem:
        known = np.isfinite(problem.readings).reshape(sd.shape)
        lost = determinacy.lost_targets(known, e, sd)
        try:
            determinacy.refuse_too_few(known & ~lost, start.position, nominal)
        except MethodError as error:
            raise FitError(str(error), code=error.code) from error
        target = changed(problem.unknowns.target, free=~lost)
        readings = np.where(lost, np.nan, problem.readings.reshape(sd.shape)).ravel()
        return changed(problem, readings=readings, unknowns=problem.unknowns._replace(target=target))

    return structured


def _stated(reading: Array, sd: Array, nominal: Array, start: Stations, sources: Sources, freedom: float) -> Problem:
    """Return the problem; see `network`."""
    n, m = reading.shape
    station, every = np.repeat(np.arange(n), m), np.zeros(n * m, dtype=np.intp)
    c, has_drift = _by_station(sources.drift, n, m)
    g = np.array([np.nan_to_num(scale.change).ravel() for scale in sources.scales]).reshape(-1, n * m).T

    def equation(y: Array, x: Unknowns[Array], known: Known[Array]) -> Array:
        length = y * (1.0 + known.air[:, 0] + known.tracker[:, 0]) + np.einsum("ns,ns->n", g, known.scales)
        v = x.target - x.station[:, :3]
        distance = np.sqrt(np.einsum("na,na->n", v, v))
        return np.asarray(length - distance + x.station[:, 3] - np.einsum("nk,nk->n", c, x.drift))

    def derivatives(_: Array, x: Unknowns[Array], __: Known[Array]) -> Mapping[str, Array]:
        v = x.target - x.station[:, :3]
        e = v / np.sqrt(np.einsum("na,na->n", v, v))[:, None]
        one = np.ones((len(e), 1))
        by_station = np.concatenate([e, one], axis=1)
        return {"target": -e[:, None], "station": by_station[:, None], "drift": -c[:, None], READINGS: one[:, None]}

    def constant_derivatives(y: Array, _: Unknowns[Array], __: Known[Array]) -> Mapping[str, Array]:
        return {"air": y[:, None, None], "tracker": y[:, None, None], "scales": g[:, None]}

    return Problem(
        equation=equation,
        derivatives=derivatives,
        constant_derivatives=constant_derivatives,
        readings=reading.ravel(),
        unknowns=Unknowns(
            target=Block(start=nominal, index=np.tile(np.arange(m), n), scale=1.0),
            station=Block(start=start.table, index=station, scale=1.0, group=STATIONS),
            drift=Block(
                start=np.zeros(has_drift.shape), index=station, scale=1.0, free=has_drift, prior=1.0, group=DRIFT
            ),
        ),
        constants=Known(
            air=_relative(sources.air, every, AIR, sources.identity),
            tracker=_relative(sources.tracker, every, TRACKER, sources.identity),
            scales=Constant(
                value=np.zeros((1, g.shape[1])),
                factor=np.eye(g.shape[1])[None],
                index=every,
                scale=LINEAR,
                group=SCALES,
                names=[scale.name for scale in sources.scales],
                identity=[sources.identity.get(scale.name, "") for scale in sources.scales],
            ),
        ),
        noise=Noise(sd=sd.ravel(), freedom=freedom),
        gauge={"station": np.moveaxis(start.motions(nominal.mean(axis=0)), 2, 0)},
        settled=lambda problem, x: _moved(x, nominal, problem.unknowns.target.freed[:, 0]),
    )


def _moved(x: Unknowns[Array], nominal: Array, known: NDArray[np.bool_]) -> Unknowns[Array]:
    """Return the unknowns moved as a whole to the best fit of the known targets to the nominal ones.

    The rotation is that of Kabsch, from the singular vectors of the cross products.
    """
    a, b = x.target[known].mean(axis=0), nominal[known].mean(axis=0)
    U, _, Vt = np.linalg.svd((nominal[known] - b).T @ (x.target[known] - a))
    if np.linalg.det(U @ Vt) < 0.0:
        U[:, 2] *= -1.0
    R = U @ Vt
    station = x.station.copy()
    station[:, :3] = (station[:, :3] - a) @ R.T + b
    return x._replace(target=(x.target - a) @ R.T + b, station=station)


def _relative(by_name: Mapping[str, float], index: Index, group: str, identity: Mapping[str, str]) -> Constant:
    """Return the relative errors of all lengths by independent causes."""
    causes = {name: u for name, u in by_name.items() if u > 0}
    factor = np.array([*causes.values()], dtype=float).reshape(1, 1, -1)
    ids = [identity.get(name, "") for name in causes]
    return Constant(
        value=np.zeros((1, 1)), factor=factor, index=index, scale=1.0, group=group, names=[*causes], identity=ids
    )


def _by_station(drift: Sequence[Shared], n: int, m: int) -> tuple[Array, NDArray[np.bool_]]:
    """Return the effects (n m, k) of drift on each reading, and which of the k parts each station has, (n, k)."""
    parts: list[list[Array]] = [[] for _ in range(n)]
    for each in drift:
        [j] = np.flatnonzero(np.nan_to_num(each.change).any(axis=1))
        parts[j].append(np.nan_to_num(each.change[j]))
    most = max(map(len, parts), default=0)
    c, has = np.zeros((n, m, most)), np.zeros((n, most), dtype=bool)
    for station, its in enumerate(parts):
        has[station, : len(its)] = True
        for k, effect in enumerate(its):
            c[station, :, k] = effect
    return c.reshape(n * m, most), has
