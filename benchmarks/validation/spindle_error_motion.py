"""Spindle error motions: coverage of error motions and of values, spread against the bound, and real records."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
import xarray as xr

from errormotion.errors import MethodError
from errormotion.kinematics.iso import DOF
from errormotion.methods.spindle_error_motion import SpindleErrorMotion, SpindleErrorMotionSettings
from errormotion.methods.spindle_error_motion.simulation import simulate, truth_of
from errormotion.twin.spindle import Spindle

TITLE = "Spindle error motions"
SEEDS = 200
Z95 = 1.959964
METHOD = SpindleErrorMotion()
SMALL = SpindleErrorMotionSettings(turns=64, sample_rate=5000.0, places=60, harmonics=15)


def section(seeds: int) -> Iterator[str]:
    """Yield the lines of the section."""
    yield from ("### Five sensors", "", *coverage(SMALL, seeds), "", "### Known sensors", "", *efficiency(seeds))
    yield from ("", "### Records as they are", "", *records(max(seeds // 4, 10)))


def outcomes(settings: SpindleErrorMotionSettings, seeds: int) -> tuple[np.ndarray, np.ndarray, list[str], np.ndarray]:
    """Return deviations and standard uncertainties (seed, angle, 6), names of values, and (seed, value, 2) of them."""
    off, u, names, values = [], [], list[str](), []
    for seed in range(seeds):
        raw, truth = METHOD.simulate(settings, seed)
        errors = METHOD.identify(raw, settings)
        off.append(np.stack([(errors[name] - truth[name]).values for name in DOF], axis=1))
        u.append(np.sqrt(np.diagonal(errors["covariance"].values, axis1=1, axis2=2)))
        names = errors["figure"].values.tolist()
        U = [each.expanded_uncertainty for each in METHOD.figures(errors)]
        values.append(np.stack([(errors["figure_value"] - truth["figure_value"]).values, U], axis=1))
    return np.array(off), np.array(u), names, np.array(values)


def coverage(settings: SpindleErrorMotionSettings, seeds: int) -> list[str]:
    """Coverage of errors over all angles, and of the values, with every source drawn for each seed."""
    off, u, names, values = outcomes(settings, seeds)
    known = np.isfinite(off)
    pooled = float((np.abs(off[known] / u[known]) <= Z95).mean())
    rows = ["| error | coverage of 95 % intervals | at single angles | spread/stated | stated (k = 1) |"]
    rows += ["|---|---|---|---|---|"]
    for k, dof in enumerate(DOF[:5]):
        z = off[..., k] / u[..., k]
        inside = (np.abs(z) <= Z95).mean(axis=0)
        unit, size = ("nm", 1e9) if k < 3 else ("nrad", 1e9)
        rows.append(
            f"| {dof}C | {inside.mean():.1%} | {inside.min():.1%} to {inside.max():.1%} | "
            f"{np.sqrt(np.mean(z**2)):.3f} | {size * u[..., k].mean():.3g} {unit} |"
        )
    rows += ["", "| value | within U (k = 2) | mean excess | spread | U |", "|---|---|---|---|---|"]
    for k, name in enumerate(names):
        d, U = values[:, k].T
        unit = "nrad" if "tilt" in name else "nm"
        rows.append(
            f"| {name} | {(np.abs(d) <= U).mean():.1%} | {1e9 * d.mean():.3g} {unit} | {1e9 * d.std():.3g} {unit} | "
            f"{1e9 * U.mean():.3g} {unit} |"
        )
    return [
        f"{seeds} simulated records of {settings.turns} turns with an index pulse; noise of a sensor "
        f"{1e9 * settings.noise:g} nm, asynchronous motion {1e9 * settings.asynchronous:g} nm, half of its variance by "
        f"vibrations of bearings, eccentricity {1e6 * settings.eccentricity:g} um, roundness deviation "
        f"{1e9 * settings.roundness:g} nm, gains uncertain by {settings.gain_uncertainty:.1%}, directions by "
        f"{1e3 * settings.direction_uncertainty:g} mrad. All errors together: {pooled:.1%}. The coverage of one "
        f"value has a standard deviation of {np.sqrt(0.05 * 0.95 / seeds):.1%}; that of an error, whose angles share "
        "sources, nearly as much. The values are extremes: U contains their bias.",
        "",
        *rows,
    ]


def efficiency(seeds: int) -> list[str]:
    """Spread against the bound, with known sensors, a perfect artefact, and white noise only."""
    settings = SMALL.model_copy(
        update={
            "gain_uncertainty": 0.0,
            "direction_uncertainty": 0.0,
            "position_uncertainty": 0.0,
            "roundness": 0.0,
            "asynchronous": 0.0,
        }
    )
    off, u, _, _ = outcomes(settings, seeds)
    samples = settings.turns * settings.sample_rate * 60 / settings.spindle_speed
    # 2 K coefficients of each sensor; of the four of once a turn, a pair of sensors keeps two
    across = settings.noise * np.sqrt((2 * settings.harmonics - 1) / samples)
    along = settings.noise * np.sqrt(2 * settings.harmonics / samples)
    bound = [across, across, along, *[np.sqrt(2) * across / settings.height] * 2]
    rows = ["| error | bound (k = 1) | spread/bound | stated/bound |", "|---|---|---|---|"]
    for k, dof in enumerate(DOF[:5]):
        spread = np.sqrt(np.mean(off[..., k] ** 2))
        unit = "nm" if k < 3 else "nrad"
        rows.append(
            f"| {dof}C | {1e9 * bound[k]:.3g} {unit} | {spread / bound[k]:.3f} | {u[..., k].mean() / bound[k]:.3f} |"
        )
    return [
        f"{seeds} records without asynchronous motion, with known sensors and a perfect artefact. The bound is that of "
        f"{settings.harmonics} harmonics in white noise. What is stated has a factor for the finite number of batches.",
        "",
        *rows,
    ]


def _rounded(raw: xr.Dataset) -> xr.Dataset:
    step = 50e-9
    return raw.assign(displacement=(np.rint(raw["displacement"] / step) * step).assign_attrs(units="m"))


def _spikes(raw: xr.Dataset) -> xr.Dataset:
    values = raw["displacement"].values.copy()
    values[137 :: len(values) // 3, 0] += 5e-6
    return raw.assign(displacement=raw["displacement"].copy(data=values))


def _missing(raw: xr.Dataset) -> xr.Dataset:
    values = raw["displacement"].values.copy()
    values[np.random.default_rng(1).uniform(size=values.shape) < 0.02] = np.nan
    return raw.assign(displacement=raw["displacement"].copy(data=values))


def _same(raw: xr.Dataset) -> xr.Dataset:
    return raw


CASES: dict[str, tuple[Callable[[xr.Dataset], xr.Dataset], dict[str, object], dict[str, object]]] = {
    "nominal": (_same, {}, {}),
    "broadband motion only": (_same, {}, {"bearing": ()}),
    "broadband motion correlated by 0.95 between samples": (_same, {}, {"bearing": (), "correlation": 0.95}),
    "one vibration with 3.59 periods in a turn": (_same, {}, {"bearing": ((3.5921, 1.0),)}),
    "one vibration with 2.004 periods in a turn": (_same, {}, {"bearing": ((2.004, 1.0),)}),
    "encoder, speed varies by 2 %": (_same, {"angle_from": "encoder"}, {"ripple": (0.02, 13.0)}),
    "index, speed varies by 2 %": (_same, {}, {"ripple": (0.02, 13.0)}),
    "angle from the eccentricity": (_same, {"angle_from": "eccentricity"}, {}),
    "30 turns": (_same, {"turns": 30}, {}),
    "rounded to 50 nm": (_rounded, {}, {}),
    "three readings wrong by 5 um": (_spikes, {}, {}),
    "2 % of the readings missing": (_missing, {}, {}),
}


def records(seeds: int) -> list[str]:
    """Coverage with other motions, other records of the angle, and readings as they are."""
    rows = ["| record | errors within 95 % intervals | values within U | noted | refused |", "|---|---|---|---|---|"]
    for name, (change, other, motion) in CASES.items():
        settings = SMALL.model_copy(update=other)
        inside, held, noted, refused = [], [], 0, 0
        for seed in range(seeds):
            spindle = Spindle(
                speed=settings.spindle_speed,
                asynchronous=settings.asynchronous,
                eccentricity=settings.eccentricity * np.exp(0.4j),
                **motion,  # type: ignore[arg-type]
            )
            raw, moved = simulate(settings, 1000 + seed, spindle)
            try:
                errors = METHOD.identify(change(raw), settings)
            except MethodError:
                refused += 1
                continue
            truth = truth_of(errors, settings, spindle, raw, moved)
            off = np.stack([(errors[dof] - truth[dof]).values for dof in DOF[:5]], axis=1)
            u = np.sqrt(np.diagonal(errors["covariance"].values, axis1=1, axis2=2))[:, :5]
            inside.append(np.abs(off / u) <= Z95)
            U = np.array([each.expanded_uncertainty for each in METHOD.figures(errors)])
            held.append(np.abs((errors["figure_value"] - truth["figure_value"]).values) <= U)
            noted += bool("".join(errors.attrs["notes"]))
        rows.append(
            f"| {name} | {np.mean(inside):.1%} | {np.mean(held):.1%} | {noted / seeds:.0%} | {refused / seeds:.0%} |"
        )
    return [f"{seeds} records each, otherwise as with five sensors.", "", *rows]
