"""Identification: from touches to the errors of every cycle."""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr
from scipy import special

from errormotion.arrays import Array
from errormotion.datasets import build_errors, provenance
from errormotion.datasets.timing import start_of
from errormotion.errors import MethodError
from errormotion.estimation.variance import expansion
from errormotion.methods.normal_vector.identification import normals, rigid
from errormotion.methods.normal_vector.identification.contradiction import agreeing_axes
from errormotion.methods.normal_vector.identification.freedoms import Motion, check_layout
from errormotion.methods.normal_vector.identification.moved import Cleaned, clean
from errormotion.methods.normal_vector.identification.reading import Readings, check_balls, check_jumps, read
from errormotion.methods.normal_vector.identification.spheres import Centres, centres

if TYPE_CHECKING:
    from errormotion.methods.normal_vector.settings import Settings

log = logging.getLogger(__name__)

FALSE_ALARM = 1e-3
"""Probability at which touches with the stated noise are reported as noisier."""
MIN_SOURCE = 1e-4
"""Smallest variance of a common source, relative to the largest one, that is stated separately."""


@dataclass(frozen=True)
class Estimate:
    """Twists (k, 6), their covariance (k, 6, 6) and effects common to all cycles (k, 6, q); NaN where unknown."""

    twist: Array
    covariance: Array
    shared: Array


def identify_motion(raw: xr.Dataset, settings: Settings, method: str, version: str) -> xr.Dataset:
    """Return an error dataset of component ``tool`` over ``time``.

    Raises
    ------
    MethodError
        The data do not determine the motion, or contradict the stated balls.
    """
    notes: list[str] = []
    data = read(raw, settings, notes)
    stated = bool(np.isfinite(data.noise))
    data, motion, cleaned = fitted(data, settings)
    if settings.robust:
        notes += _contradiction(data, motion, cleaned, settings, stated)
    factor = _noise_factor(cleaned.fit, stated, settings, notes)
    notes += _exclusions(cleaned, data)
    best = _rigid_estimate(cleaned, motion, factor, len(data.seen.cycle_time))
    time = _times(cleaned, data, settings)
    seen = data.seen.without(cleaned.wrong)
    measured = centres(seen, cleaned.fit.anchor, cleaned.fit.reach)
    other = _normals_estimate(data, cleaned, seen, motion, settings, factor, notes)
    if settings.procedure == "normals" and other is None:
        raise MethodError("procedure = normals: " + notes[-1])
    chosen = other if settings.procedure == "normals" and other is not None else best
    influence = _sources(chosen)
    cold = [f"cold reference {i + 1}" for i in range(len(influence))]
    for note in notes:
        log.warning(note)
    ds = build_errors(
        chosen.twist,
        chosen.covariance,
        dims=("time",),
        coords=_coordinates(raw, data, time),
        component="tool",
        machine=str(raw.attrs.get("machine", "unknown")),
        frame=str(raw.attrs.get("frame", "machine")),
        functional_point=motion.point,
        reference=f"mean state of the {'cold' if settings.reference == 'cold' else 'first'} probing cycle",
        method=method,
        method_version=version,
        measured=raw.attrs,
        lever_axes="" if data.tool_axes == "XYZ" else data.tool_axes,
        provenance=provenance.make(settings, raw, None, steps=_steps(cleaned, settings)),
        influence=influence,
        sources=cold,
        source_groups=["cold reference"] * len(influence),
        extras=_extras(data, cleaned, measured, factor, best, other),
        start=start_of(raw),
        reference_sources=cold,
        reference_interval=(float(time[0]), float(time[0])),
    )
    return ds.assign_attrs(notes=notes or [""], tool_axes=data.tool_axes)


def fitted(data: Readings, settings: Settings) -> tuple[Readings, Motion, Cleaned]:
    """Return the readings with their weights, the model of the motion, and its fit without outliers."""
    stated = bool(np.isfinite(data.noise))
    if stated:
        data = replace(data, seen=replace(data.seen, weight=data.seen.weight / data.noise**2))
    motion = _motion(data, settings)
    cleaned = clean(
        data.seen,
        motion,
        interpolate=settings.interpolate and data.timed,
        stated=stated,
        robust=settings.robust,
        smallest_move=settings.smallest_move,
    )
    return data, motion, cleaned


def _motion(data: Readings, settings: Settings) -> Motion:
    """Return the model of the motion; check the balls."""
    seen, names = data.seen, data.names
    ever = np.any(seen.valid, axis=(0, 2))
    if not ever.all():
        lost = ", ".join(name for name, touched in zip(names, ever, strict=True) if not touched)
        raise MethodError(f"Ball {lost} was never touched: remove it from the data, or touch it.")
    check_jumps(seen, names, settings.ball_tolerance)
    if seen.touched:
        touched = seen.valid.any(axis=0).sum(axis=1)
        if (touched < 4).any():
            i = int(np.argmin(touched))
            raise MethodError(
                f"Ball {names[i]} was touched in {touched[i]} directions; a sphere needs four, preferably five: "
                "around it and on top."
            )
        centre, radius = seen.spheres
    else:
        count = np.maximum(seen.valid[..., 0].sum(axis=0), 1)[:, None]
        centre = np.where(seen.valid[..., :1], seen.position[:, :, 0], 0.0).sum(axis=0) / count
        radius = np.full(len(names), np.nan)
    check_balls(centre, radius, data, settings.ball_tolerance)
    check_layout(centre, names, data.tool_axes)
    point = settings.functional_point
    return Motion(data.tool_axes, np.round(centre.mean(axis=0), 4) if point is None else np.array(point, float))


def _contradiction(data: Readings, motion: Motion, cleaned: Cleaned, settings: Settings, stated: bool) -> list[str]:
    """Return a note if the touches may contradict the axes that carry the tool; raise MethodError if they do."""
    found = agreeing_axes(
        data.seen,
        motion,
        cleaned,
        interpolate=settings.interpolate and data.timed,
        stated=stated,
        smallest_move=settings.smallest_move,
    )
    if not found:
        return []
    other = " or ".join(axes or "none" for axes in found)
    if len(cleaned.moves) + int(cleaned.wrong.sum()) == 1 and len(cleaned.used) == len(data.seen.cycle_time):
        return [
            f"All touches would agree without any exclusion if other axes carried the tool: {other} instead of "
            f"{motion.tool_axes or 'none'} (tool_axes). Check the machine."
        ]
    raise MethodError(
        f"The touches contradict tool_axes = {motion.tool_axes or 'none'}, the axes that carry the tool: balls seem to "
        f"move, or touches scatter. All of them agree with {other}. State the axes that carry the tool (attribute "
        "tool_axes of the data, which has priority, or the setting)."
    )


def _noise_factor(found: rigid.Rigid, stated: bool, settings: Settings, notes: list[str]) -> float:
    """Return the variance of unit weight (variance factor)."""
    if found.freedom < 1 and not stated:
        raise MethodError(
            "The noise of a touch is not stated (touch_noise), and there are no redundant touches to estimate it. "
            "State it."
        )
    if not stated:
        variance = found.chi2 / found.freedom
        notes.append(
            f"The noise of a touch is not stated; {np.sqrt(variance) * 1e6:.3g} um from the residuals, with "
            f"{found.freedom} degrees of freedom."
        )
        return float(variance * expansion(found.freedom) ** 2)
    if found.freedom > 0 and found.chi2 > special.chdtri(found.freedom, FALSE_ALARM):
        ratio = found.chi2 / found.freedom
        raised = settings.noise == "auto"
        what = "the uncertainties were increased" if raised else "the stated noise was used (noise = stated)"
        notes.append(
            f"The touches scatter {np.sqrt(ratio):.3g} times as much as stated; {what}. Check the mounting of the "
            "balls and the axes that carry the tool (tool_axes)."
        )
        return float(ratio) if raised else 1.0
    return 1.0


def _rigid_estimate(cleaned: Cleaned, motion: Motion, factor: float, cycles: int) -> Estimate:
    found = cleaned.fit
    twist = np.full((cycles, 6), np.nan)
    covariance = np.full((cycles, 6, 6), np.nan)
    shared = np.full((cycles, 6, found.shared.shape[2]), np.nan)
    twist[cleaned.used], shared[cleaned.used] = found.twist, np.sqrt(factor) * found.shared
    covariance[cleaned.used] = factor * found.covariance
    unseen = [k for k in range(6) if k not in motion.seen]
    twist[:, unseen] = np.nan
    return Estimate(twist, covariance, shared)


def _normals_estimate(
    data: Readings,
    cleaned: Cleaned,
    seen: rigid.Observations,
    motion: Motion,
    settings: Settings,
    factor: float,
    notes: list[str],
) -> Estimate | None:
    """Return the result of the published construction from four balls; None, with a note, if it is not applicable."""
    if motion.tool_axes != "XYZ":
        notes.append(
            "The normals of planes through balls are not applicable: where axes carry the workpiece, a rotation of "
            "their frame shears the apparent arrangement of the balls instead of rotating it."
        )
        return None
    if len(data.names) < 4:
        notes.append(f"The normals of two planes need four balls; found {len(data.names)}.")
        return None
    four = normals.chosen(data.names, settings.normals_balls)
    simultaneous = centres(_at_cycle_time(seen, cleaned, motion, settings), cleaned.fit.anchor, cleaned.fit.reach)
    centre, cofactor = simultaneous.centre[:, four], factor * simultaneous.cofactor[:, four]
    for move in cleaned.moves:
        if move.ball in four:
            centre[move.cycle :] = np.nan
    known = np.all(np.isfinite(centre), axis=(1, 2))
    if not known[0]:
        notes.append("The normals are unknown: one of their balls is missing in the cold cycle.")
        return None
    if not normals.planes_apart(centre[0]):
        notes.append(normals.ONE_PLANE)
        return None
    twist = np.full((len(centre), 6), np.nan)
    covariance = np.full((len(centre), 6, 6), np.nan)
    shared = np.full((len(centre), 6, 12), np.nan)
    twist[known] = normals.twist(centre[0], centre[known], motion.point)
    covariance[known] = normals.covariance(cofactor[0], cofactor[known], motion.point, centre[0])
    cold = normals.jacobian(centre[0], motion.point)
    shared[known] = np.einsum("ubi,bij->ubj", cold, np.linalg.cholesky(cofactor[0])).reshape(6, 12)
    for array in (covariance, shared):
        array[0] = 0.0
    return Estimate(twist, covariance, shared)


def _at_cycle_time(
    seen: rigid.Observations, cleaned: Cleaned, motion: Motion, settings: Settings
) -> rigid.Observations:
    """Return the touches corrected for the drift within each cycle, as if made simultaneously."""
    if not settings.interpolate or not seen.touched or not np.ptp(seen.time):
        return seen
    used, found = cleaned.used, cleaned.fit
    weights = rigid.knot_weights(found.time, np.where(seen.valid, seen.time, 0.0)[used], interpolate=True)
    lever = motion.lever(seen.position[used])
    drift = motion.error(rigid.at_times(weights, found.twist), lever)
    drift -= motion.error(found.twist[:, None, None], lever)
    position = seen.position.copy()
    position[used] += np.where(seen.valid[used][..., None], drift, 0.0)
    return replace(seen, position=position)


def _sources(estimate: Estimate) -> Array:
    """Return the effects common to all cycles as a few independent sources, (source, k, 6)."""
    u = np.sqrt(np.einsum("kii->ki", estimate.covariance))
    F = np.where(u[..., None] > 0, estimate.shared / np.where(u > 0, u, 1.0)[..., None], 0.0)
    F = np.nan_to_num(F).reshape(-1, F.shape[2])
    values, vectors = np.linalg.eigh(F.T @ F)
    vectors = vectors[:, values > MIN_SOURCE * max(values[-1], 1e-300)][:, ::-1]
    return np.moveaxis(estimate.shared @ vectors, 2, 0)


def _times(cleaned: Cleaned, data: Readings, settings: Settings) -> Array:
    """Return the time of each cycle: the mean of its valid touches if these have times, else its start."""
    time = data.seen.cycle_time.copy()
    if not data.timed:
        return time
    mean, known = rigid.mean_time(data.seen), data.seen.valid.any(axis=(1, 2))
    time[known] = mean[known]
    if settings.interpolate:
        time[cleaned.used] = cleaned.fit.time
    return time


def _exclusions(cleaned: Cleaned, data: Readings) -> list[str]:
    """Return notes on outliers, balls that moved, and cycles without a result."""
    notes: list[str] = []
    names = data.names
    wrong = cleaned.wrong.any(axis=2) if not data.seen.touched else cleaned.wrong
    if wrong.any():
        count = int(wrong.sum())
        k, i = (int(index) for index in np.argwhere(wrong)[0][:2])
        what = "touches" if data.seen.touched else "centres"
        notes.append(f"{count} outliers among the {what} were excluded, the first of ball {names[i]} in cycle {k}.")
    for move in cleaned.moves:
        shift = ", ".join(f"{value * 1e6:.2g}" for value in move.shift)
        also = f" It may also have been ball {' or '.join(names[i] for i in move.others)}." if move.others else ""
        notes.append(
            f"Ball {names[move.ball]} moved before cycle {move.cycle} "
            f"({data.seen.cycle_time[move.cycle]:g} s), by about ({shift}) um as measured; excluded from this cycle "
            f"on.{also}"
        )
    if len(cleaned.moves) > 1:
        notes.append(
            "More than one ball appears to have moved. Check their mounting and the axes that carry the tool "
            "(tool_axes). A machine that does not move as one rigid frame has the same effect."
        )
    lost = sorted(set(range(len(data.seen.cycle_time))) - set(cleaned.used.tolist()))
    if lost:
        shown = ", ".join(map(str, lost[:8])) + (f" and {len(lost) - 8} more" if len(lost) > 8 else "")
        notes.append(f"{len(lost)} cycles do not determine the motion and are unknown: {shown}.")
    return notes


def _coordinates(raw: xr.Dataset, data: Readings, time: Array) -> dict[str, Any]:
    coords: dict[str, Any] = {
        "time": ("time", time, {"units": "s"}),
        "cycle_time": ("time", data.seen.cycle_time, {"units": "s", "long_name": "start of the probing cycle"}),
        "ball": data.names,
        "direction": list("xyz"),
        "direction_": list("xyz"),
    }
    for name in ("temperature", "spindle_speed", "feed"):
        if name in raw:
            dims = ("time", "sensor") if name == "temperature" else ("time",)
            coords[name] = (
                dims,
                np.array(raw[name].transpose(*dims).values, float),
                {"units": raw[name].attrs["units"]},
            )
    if "sensor" in raw.coords and "temperature" in raw:
        coords["sensor"] = [str(name) for name in raw["sensor"].values]
    return coords


def _extras(
    data: Readings, cleaned: Cleaned, measured: Centres, factor: float, best: Estimate, other: Estimate | None
) -> dict[str, xr.DataArray]:
    k, b, m = data.seen.valid.shape
    metre = {"units": "m"}
    each = ("time", "ball", "touch" if data.seen.touched else "direction")
    residual = np.full((k, b, m), np.nan)
    residual[cleaned.used] = cleaned.fit.residual
    flag = np.where(data.seen.valid, 0, 1)
    moved = np.zeros((k, b), dtype=np.int8)
    for move in cleaned.moves:
        moved[move.cycle :, move.ball] = 1
    flag[(moved[..., None] > 0) & (flag == 0)] = 3
    flag[cleaned.wrong] = 2
    lost = np.setdiff1d(np.arange(k), cleaned.used)
    flag[lost] = np.where(flag[lost] == 0, 4, flag[lost])
    dof = ("time", "dof")
    unknown = Estimate(np.full((k, 6), np.nan), np.full((k, 6, 6), np.nan), np.empty(0))
    plain = unknown if other is None else other
    u, u_best = (np.sqrt(np.einsum("kii->ki", part.covariance)) for part in (plain, best))
    loss = np.where(u_best > 0, u / np.where(u_best > 0, u_best, 1.0), np.nan)
    extras = {
        "centre": (
            ("time", "ball", "direction"),
            measured.centre,
            {**metre, "long_name": "apparent centre in machine coordinates"},
        ),
        "centre_covariance": (
            ("time", "ball", "direction", "direction_"),
            factor * measured.cofactor,
            {"units": "m^2", "long_name": "from the touches of the cycle itself"},
        ),
        "ball_displacement": (
            ("time", "ball", "direction"),
            measured.centre - measured.centre[0],
            {**metre, "long_name": "apparent, since the cold cycle: opposite to the error"},
        ),
        "residual": (each, residual, {**metre, "long_name": "measured minus fitted distance"}),
        "left_out": (
            each,
            flag.astype(np.int8),
            {"long_name": "0 = used, 1 = missing, 2 = outlier, 3 = ball had moved, 4 = cycle not determined"},
        ),
        "ball_moved": (("time", "ball"), moved, {"long_name": "1 from the first cycle after a move of the ball"}),
        "normals_errors": (dof, plain.twist, {"long_name": "by the normals of two planes; m, rad"}),
        "normals_covariance": ((*dof, "dof_"), plain.covariance, {"long_name": "m^2, m rad, rad^2"}),
        "normals_loss": (
            dof,
            loss,
            {"units": "1", "long_name": "standard uncertainty by the normals over that by all touches"},
        ),
        "noise": ((), np.sqrt(factor) * (data.noise if np.isfinite(data.noise) else 1.0), metre),
    }
    return {name: xr.DataArray(array, dims=dims, attrs=attrs) for name, (dims, array, attrs) in extras.items()}


def _steps(cleaned: Cleaned, settings: Settings) -> list[str]:
    steps = [
        "joint least squares of all touches"
        if settings.procedure == "rigid"
        else "normals of two planes through four balls, Cayley"
    ]
    if cleaned.wrong.any():
        steps.append(f"{int(cleaned.wrong.sum())} outliers excluded")
    return steps + [f"ball {move.ball + 1} excluded from cycle {move.cycle} on" for move in cleaned.moves]
