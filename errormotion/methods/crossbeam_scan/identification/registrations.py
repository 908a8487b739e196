"""Registrations of all warm scans of a campaign onto their cold scans.

Scans are read and reduced to blocks one at a time, artefact by artefact, each while the previous one is registered:
the campaign may be larger than memory.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike, NDArray

from errormotion.arrays import Array
from errormotion.errors import MethodError
from errormotion.estimation.checks.resolution import NOTICEABLE, step_of
from errormotion.methods.crossbeam_scan.identification.cutting import Scan
from errormotion.methods.crossbeam_scan.identification.registration import BlockMap, Registration, prepare, register
from errormotion.methods.crossbeam_scan.identification.registration.freedoms import Extra
from errormotion.methods.crossbeam_scan.identification.registration.solver import Problem, State

if TYPE_CHECKING:
    from errormotion.methods.crossbeam_scan.settings import CrossbeamScanSettings

log = logging.getLogger(__name__)

FEED = ("feed_x", "feed_y", "feed_z")
"""Parameters of the registration that describe the drift along a scan."""
DRIFT = 1e-3
"""Standard deviation of their prior, 1: a millimetre per metre, far more than the drift of any carriage. With it, an
artefact of little relief results in a large uncertainty instead of an error."""
STRAINS = ("scale_x", "scale_z", "expansion")
"""Scales of the profiler and expansion of the artefact between cold and warm, whose uncertainty settings state."""
COARSE = 1.5
"""Ratio of the bending of a block to the noise of a point beyond which a note is given."""
MAP_SIZE = 40
"""Number of points along both directions of the stored maps."""


class Scans(Protocol):
    """The scans of a campaign, each loaded on request."""

    @property
    def cycles(self) -> int:
        """Cold and warm passes."""

    @property
    def artefacts(self) -> int:
        """Number of artefacts."""

    def scan(self, cycle: int, artefact: int) -> Scan:
        """Return heights (profile, point), x (point,), y (profile,), m, and time, s; MethodError if there is none."""


@dataclass
class Registrations:
    """Registrations over (cycle, artefact); that of the cold reference is zero.

    Attributes
    ----------
    cold : ndarray of int, (artefact,)
        Cycle onto which the others are registered; -1 where no cold scan is usable.
    twist : ndarray, (cycle, artefact, 9)
        (T_Q, R_Q, drift per feed) at the map's origin; NaN where there is none.
    covariance : ndarray, (cycle, artefact, 9, 9)
        Of ``twist``, from the noise of both scans.
    effect : ndarray, (cycle, artefact, 9, 3)
        Error of ``twist`` by one unit of each of the `STRAINS`, m/m, which are taken as 0 within their priors.
    cold_share : ndarray, (cycle, artefact)
        Share of the covariance that is caused by the noise of the cold scan.
    bound : ndarray, (artefact, 9, 9)
        Covariance from surface and stated noise alone.
    reason : ndarray of str, (cycle, artefact)
        Why there is no registration; empty where there is one.
    quality : dict of str to ndarray, (cycle, artefact)
        residual_rms, noise_found, jitter_z, jitter_y (m), condition, points_used, variance_factor.
    time : ndarray, (cycle, artefact)
        Of each scan, s.
    maps : list of Maps or None
        By artefact.
    notes, doubts : list of str
        Notes for the user, and those that doubt the stated uncertainties.
    """

    cold: NDArray[np.int64]
    twist: Array
    covariance: Array
    effect: Array
    cold_share: Array
    bound: Array
    reason: NDArray[np.object_]
    quality: dict[str, Array]
    time: Array
    maps: list[Maps | None] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    doubts: list[str] = field(default_factory=list)

    @classmethod
    def empty(cls, cycles: int, artefacts: int, cold: ArrayLike = -1) -> Registrations:
        """Return what is filled in; nothing is registered."""
        shape = cycles, artefacts
        return cls(
            cold=np.zeros(artefacts, dtype=int) + np.asarray(cold),
            twist=np.full((*shape, 9), np.nan),
            covariance=np.full((*shape, 9, 9), np.nan),
            effect=np.zeros((*shape, 9, 3)),
            cold_share=np.full(shape, np.nan),
            bound=np.full((artefacts, 9, 9), np.nan),
            reason=np.full(shape, "", dtype=object),
            quality={name: np.full(shape, np.nan) for name in QUALITY} | {"points_used": np.zeros(shape)},
            time=np.full(shape, np.nan),
        )

    @classmethod
    def stated(cls, raw: xr.Dataset) -> Registrations:
        """Return the registrations of raw data that contain them instead of scans."""

        def values(name: str, *dims: str) -> Array:
            return np.array(raw[name].transpose("cycle", *dims).values, dtype=float)

        registrations = cls.empty(raw.sizes["cycle"], raw.sizes["artefact"])
        for name, part in (("displacement", slice(0, 3)), ("rotation", slice(3, 6))):
            registrations.twist[..., part] = values(name, "artefact", "direction")
        registrations.twist[..., 6:] = 0.0
        registrations.covariance[:] = 0.0
        registrations.covariance[..., :6, :6] = values(
            "registration_covariance", "artefact", "registered", "registered_"
        )
        known = np.isfinite(registrations.twist).all(axis=-1) & np.isfinite(registrations.covariance).all(axis=(-2, -1))
        registrations.twist[~known], registrations.covariance[~known] = np.nan, np.nan
        registrations.reason[~known] = "there is no registration"
        registrations.cold[known.any(axis=0)] = 0
        if "strain_effect" in raw:
            registrations.effect[..., :6, :] = values("strain_effect", "artefact", "registered", "strain")
        registrations.cold_share[:] = values("cold_share", "artefact")
        registrations.time[:] = values("time")[:, None]
        registrations.add_rounding()
        return registrations

    def add_rounding(self) -> None:
        """Add the variance ``q^2 / 12`` (JCGM 100, F.2.2.1) of values that are multiples of a step q, with a note.

        It is that of a single rounded value, which the covariance of another program does not contain.
        """
        for k, (what, unit) in enumerate((("displacements", "um"), ("rotations", "urad"))):
            part = slice(3 * k, 3 * k + 3)
            variance = np.einsum("caii->cai", self.covariance[1:, :, part, part])  # the cold ones are 0 by definition
            step = step_of(self.twist[1:, :, part])
            if (step**2 / 12 > NOTICEABLE * variance).any():
                variance += step**2 / 12
                self.notes.append(
                    f"The {what} of the registrations are multiples of {1e6 * step:.3g} {unit}: rounding is a part of "
                    "the uncertainties."
                )

    def of_cycles(self, rows: Sequence[int], excluded: NDArray[np.bool_] | None = None) -> Registrations:
        """Return the registrations of some cycles, NaN where ``excluded`` (cycle, artefact) is True."""
        out = np.zeros(self.reason.shape, dtype=bool) if excluded is None else excluded
        return replace(
            self,
            twist=np.where(out[..., None], np.nan, self.twist)[rows],
            covariance=self.covariance[rows],
            effect=self.effect[rows],
            cold_share=self.cold_share[rows],
            reason=self.reason[rows],
            quality={name: values[rows] for name, values in self.quality.items()},
            time=self.time[rows],
        )


@dataclass
class Maps:
    """Thinned maps of one artefact, m: positions, cold heights, warm minus cold before and after registration."""

    x: Array
    y: Array
    surface: Array
    before: dict[int, Array] = field(default_factory=dict)
    after: dict[int, Array] = field(default_factory=dict)


QUALITY = ("residual_rms", "noise_found", "jitter_z", "jitter_y", "condition", "points_used", "variance_factor")


def register_all(
    scans: Scans, cold_cycles: Sequence[int], height_noise: float, settings: CrossbeamScanSettings
) -> Registrations:
    """Register every scan onto the first usable cold scan of its artefact.

    Parameters
    ----------
    scans : Scans
    cold_cycles : sequence of int
        Cycles that may be the reference, in order of preference.
    height_noise : float
        Stated standard deviation of one height, m, for the bound.
    settings : CrossbeamScanSettings
    """
    registrations = Registrations.empty(scans.cycles, scans.artefacts)
    for artefact in range(scans.artefacts):
        registrations.maps.append(_artefact(scans, artefact, cold_cycles, height_noise, settings, registrations))
    return registrations


def _artefact(
    scans: Scans,
    k: int,
    cold_cycles: Sequence[int],
    noise: float,
    settings: CrossbeamScanSettings,
    registrations: Registrations,
) -> Maps | None:
    """Register all scans of one artefact; return its maps."""
    order = [*cold_cycles, *(c for c in range(scans.cycles) if c not in cold_cycles)]
    cold: BlockMap | None = None
    maps: Maps | None = None
    for cycle, scan in zip(order, _prefetched(scans, order, k), strict=True):
        if cold is None and cycle not in cold_cycles:
            registrations.reason[cycle, k] = "there is no cold scan to register it onto"
            continue
        try:
            registrations.time[cycle, k], warm = scan
            if isinstance(warm, MethodError):
                raise warm
            if cold is None:
                cold, maps = warm, _maps(warm)
                registrations.cold[k] = cycle
                registrations.bound[k] = bound(cold, noise, with_drift=settings.strain != "rigid")
                registrations.twist[cycle, k] = 0.0
                registrations.covariance[cycle, k] = 0.0
                registrations.cold_share[cycle, k] = 0.0
                registrations.doubts += _coarse(cold, k)
                registrations.quality["noise_found"][cycle, k] = cold.noise
                registrations.quality["points_used"][cycle, k] = cold.points.sum()
                continue
            result = _register(cold, warm, settings)
            _store(result, settings.strains(), registrations, cycle, k)
            if settings.registration != "height_map":
                registrations.effect[cycle, k, :6] = _of_strains(cold, warm, result)
            _store_maps(maps, cold, warm, result, cycle)
            _store_quality(result, warm, registrations.quality, cycle, k)
        except MethodError as error:
            registrations.reason[cycle, k] = str(error)
            log.warning("cycle %d, artefact %d: %s", cycle, k, error)
    return maps


def _coarse(cold: BlockMap, artefact: int) -> list[str]:
    """Return a note if the points are too far apart for the relief."""
    if cold.bending < COARSE * cold.noise:
        return []
    return [
        f"Artefact {artefact + 1}: blocks of 16 points and 4 lines are bent by {cold.bending * 1e6:.1f} um, where the "
        f"noise is {cold.noise * 1e6:.1f} um; the stated uncertainty of its registrations may be too small. "
        "Reduce the pitch of points and lines, or use a smoother artefact."
    ]


def _prefetched(scans: Scans, cycles: Sequence[int], artefact: int) -> Iterator[tuple[float, BlockMap | MethodError]]:
    """Yield time and blocks of scans; the next one is loaded and reduced to blocks in a thread."""

    def load(cycle: int) -> tuple[float, BlockMap | MethodError]:
        time = np.nan
        try:
            height, x, y, time = scans.scan(cycle, artefact)
            return time, prepare(height, x, y, scans.cycles * scans.artefacts)
        except MethodError as error:
            return time, error

    with ThreadPoolExecutor(1) as pool:
        future = pool.submit(load, cycles[0])
        for following in cycles[1:]:
            scan = future.result()
            future = pool.submit(load, following)
            yield scan
        yield future.result()


def _register(cold: BlockMap, warm: BlockMap, settings: CrossbeamScanSettings) -> Registration:
    extra: dict[str, float] = {}
    if settings.registration == "height_map":
        if settings.strain != "rigid":
            extra |= dict.fromkeys(FEED, DRIFT)
        extra |= estimated(settings)
    return register(
        cold, warm, registration=settings.registration, point=np.zeros(3), line_effects=settings.line_effects,
        extra=extra,
    )  # fmt: skip


def estimated(settings: CrossbeamScanSettings) -> dict[str, float]:
    """Return the priors of the strains that are not exact, by their parameter."""
    return {name: sigma for name, sigma in settings.strains().items() if name in STRAINS and sigma > 0}


def _store(
    result: Registration, strains: Mapping[str, float], registrations: Registrations, cycle: int, k: int
) -> None:
    """Store the twist and the drift along the feed; where it is no parameter, the drift is 0 without uncertainty.

    The estimate z shifts with the mean m of the prior of a strain s by dz/dm = C_zs / sigma^2. A strain s about which
    the prior is 0 is therefore an error -C_zs / sigma^2 s of it, and C_zz - C_zs C_sz / sigma^2 is left to the noise.
    """
    extra = {name: 6 + i for i, name in enumerate(result.extra_names)}
    source = [*range(6), *(extra[name] for name in FEED if name in extra)]
    target = [*range(6), *(6 + i for i, name in enumerate(FEED) if name in extra)]
    C = result.joint_covariance
    registrations.twist[cycle, k] = 0.0
    registrations.twist[cycle, k, target] = np.concatenate([result.twist, result.extra])[source]
    registrations.covariance[cycle, k] = 0.0
    registrations.covariance[cycle, k][np.ix_(target, target)] = C[np.ix_(source, source)]
    for column, name in enumerate(STRAINS):
        if name in extra:
            effect = -C[source, extra[name]] / strains[name] ** 2
            registrations.effect[cycle, k, target, column] = effect
            registrations.covariance[cycle, k][np.ix_(target, target)] -= strains[name] ** 2 * np.outer(effect, effect)
    registrations.cold_share[cycle, k] = result.cold_share


def _of_strains(cold: BlockMap, warm: BlockMap, result: Registration) -> Array:
    """Return the error (6, 3) by a unit of each strain of a registration that estimates none of them.

    The strains s move the blocks by J_s s, which rigid motions take on as (J'J)^-1 J'J_s s; about the origin instead of
    the middle c of the map, a strain moves the artefact by -G c besides.
    """
    terms = Extra.of(dict.fromkeys(STRAINS, np.inf))
    problem = Problem.of(cold, warm, extra=terms)
    A = problem.evaluate(State.of(result.pose, len(STRAINS))).A.sum(axis=0)
    moved = terms.about(result.point - problem.centre)
    return np.asarray(moved[:6, :6] @ np.linalg.solve(A[:6, :6], A[:6, 6:]) - moved[:6, 6:])


def _store_quality(result: Registration, warm: BlockMap, quality: dict[str, Array], cycle: int, k: int) -> None:
    values: dict[str, Any] = {
        "residual_rms": result.rms,
        "noise_found": warm.noise,
        "jitter_z": result.line_jitter[0],
        "jitter_y": result.line_jitter[1],
        "condition": result.condition,
        "points_used": result.points,
        "variance_factor": result.variance_factor,
    }
    for name, value in values.items():
        quality[name][cycle, k] = value


def bound(cold: BlockMap, noise: float, *, with_drift: bool) -> Array:
    """Return the covariance (9, 9) of (T_Q, R_Q, drift) that follows from white noise (m) of two scans of a surface.

    Rows and columns of the drift are 0 where it is no parameter.
    """
    known = cold.known
    x, y = np.meshgrid(cold.x, cold.y)
    Q = np.stack([x, y, cold.height], axis=-1)[known]
    n = np.stack([-cold.slope_x, -cold.slope_y, np.ones_like(x)], axis=-1)[known]
    J = np.concatenate([n, np.cross(Q, n), n * Q[:, 1:2]], axis=-1)
    used = 9 if with_drift else 6
    J, weight = J[:, :used], cold.points[known] / (2 * noise**2)
    scale = 1 / np.linalg.norm(J, axis=0)
    C = np.zeros((9, 9))
    information = (J * weight[:, None]).T @ J
    information[range(6, used), range(6, used)] += DRIFT**-2
    C[:used, :used] = np.linalg.inv(information * np.outer(scale, scale)) * np.outer(scale, scale)
    return C


def _maps(cold: BlockMap) -> Maps:
    rows, columns = _thin(cold)
    surface = np.where(cold.known, cold.height, np.nan)[rows][:, columns]
    return Maps(cold.x[columns], cold.y[rows], surface)


def _thin(block_map: BlockMap) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the block rows and columns that are kept."""
    rows, columns = (np.linspace(0, n - 1, min(n, MAP_SIZE)).round().astype(int) for n in block_map.height.shape)
    return rows, columns


def _store_maps(maps: Maps | None, cold: BlockMap, warm: BlockMap, result: Registration, cycle: int) -> None:
    if maps is None or result.residual.size == 0:
        return
    rows, columns = _thin(warm)
    if (rows.size, columns.size) != maps.surface.shape:
        return
    problem = Problem.of(cold, warm).at(rows, columns)
    maps.before[cycle] = problem.evaluate(problem.rest).residual
    maps.after[cycle] = result.residual[rows][:, columns]
