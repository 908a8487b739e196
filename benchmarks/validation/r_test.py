"""R-test: coverage of error motions and location errors, efficiency against the bound, and planted faults."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
import xarray as xr

from errormotion.errors import MethodError
from errormotion.kinematics.iso import DOF
from errormotion.methods.r_test import RTest, RTestSettings

TITLE = "R-test"
SEEDS = 300
Z95 = 1.959964
METHOD = RTest()


def section(seeds: int) -> Iterator[str]:
    """Yield the lines of the section."""
    yield from ("### Uncertain sensors", "", *coverage(seeds), "", "### Known sensors", "", *efficiency(seeds))
    yield from ("", "### One sphere on the axis", "", *one_sphere(seeds), "", "### Faults", "", *faults(seeds // 6))


def outcomes(settings: RTestSettings, seeds: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return deviations and standard uncertainties of motions (seed, angle, 6) and of location errors (seed, 4)."""
    rows: list[list[np.ndarray]] = [[], [], [], []]
    for seed in range(seeds):
        raw, truth = METHOD.simulate(settings, seed)
        errors = METHOD.identify(raw, settings)
        rows[0].append(np.stack([(errors[name] - truth[name]).values for name in DOF], axis=1))
        rows[1].append(np.sqrt(np.diagonal(errors["covariance"].values, axis1=1, axis2=2)))
        rows[2].append((errors["location_error"] - truth["location_error"]).values)
        rows[3].append(np.sqrt(np.diag(errors["location_covariance"].values)))
    off, u, line, v = (np.array(each) for each in rows)
    return off, u, line, v


def table(settings: RTestSettings, seeds: int) -> list[str]:
    """Return the coverage of every freedom over all angles, and of the location errors."""
    off, u, line, v = outcomes(settings, seeds)
    names = METHOD.expected(settings).attrs["axis"]
    head = [
        "| error | coverage of 95 % intervals | at single angles | spread/stated | bias/stated | stated (k = 1) |",
        "|---|---|---|---|---|---|",
    ]
    rows = [_row(f"{dof}{names}", off[..., k], u[..., k], k < 3) for k, dof in enumerate(DOF)]
    places = METHOD.plan(settings)["location"].values.tolist()
    rows += [_row(name, line[:, k, None], v[:, k, None], name[1] in "XYZ") for k, name in enumerate(places)]
    return [*head, *(row for row in rows if row)]


def _row(name: str, off: np.ndarray, u: np.ndarray, length: bool) -> str:
    """Return the row of one error; empty if it is not determined."""
    if not np.isfinite(off).any():
        return ""
    z = off / u
    inside = np.abs(z) <= Z95
    unit, scale = ("nm", 1e9) if length else ("urad", 1e6)
    single = f"{inside.mean(axis=0).min():.1%} to {inside.mean(axis=0).max():.1%}" if z.shape[1] > 1 else ""
    return (
        f"| {name} | {inside.mean():.1%} | {single} | {np.sqrt(np.mean(z**2)):.3f} | {z.mean():+.3f} | "
        f"{u.mean() * scale:.3g} {unit} |"
    )


def coverage(seeds: int) -> list[str]:
    """Coverage with the default test: every source of its budget is drawn for each seed."""
    settings = RTestSettings()
    chance = np.sqrt(0.05 * 0.95 / seeds)
    return [
        f"{seeds} simulated tests of a table C: {settings.angles} angles, {settings.spheres} spheres on a circle of "
        f"{settings.radius * 1e3:g} mm, three sensors with {settings.noise * 1e6:g} um noise, gains uncertain by "
        f"{settings.gain_uncertainty:.1%}, directions by {settings.direction_uncertainty * 1e3:g} mrad, the zero of "
        f"the nest by {settings.nest_uncertainty * 1e6:g} um. The coverage of one value has a standard deviation of "
        f"{chance:.1%}.",
        "",
        *table(settings, seeds),
    ]


def one_sphere(seeds: int) -> list[str]:
    """Coverage with a sphere on the axis, which has no redundancy."""
    settings = RTestSettings(spheres=1, axis="A", angles=24)
    text = f"{seeds} simulated tests of a table A with {settings.angles} angles; rotations are not determined."
    return [text, "", *table(settings, seeds)]


def bound(settings: RTestSettings) -> tuple[np.ndarray, np.ndarray]:
    """Return the Cramer-Rao bounds of error motions (angle, 6) and location errors (4,), from dense matrices.

    All unknowns at once: 6 a angle, 3 a sphere. The datum is a projection of the error motions.
    """
    raw = METHOD.expected(settings)
    q, p, s = (raw[name].values for name in ("angle", "sphere_position", "sensor_direction"))
    n, m = q.size, len(p)
    J = []
    for a, angle in enumerate(q):
        c, d = np.cos(angle), np.sin(angle)
        R = np.array([[c, d, 0.0], [-d, c, 0.0], [0.0, 0.0, 1.0]])
        for i in range(m):
            x, y, z = R @ p[i]
            W = np.array([[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]])  # W x r as a matrix times W
            part = np.zeros((3, 6 * n + 3 * m))
            part[:, 6 * a : 6 * a + 3], part[:, 6 * a + 3 : 6 * a + 6] = -np.eye(3), -W
            part[:, 6 * n + 3 * i : 6 * n + 3 * i + 3] = R
            J.append(s @ part)
    A = np.concatenate(J)
    C = settings.noise**2 * np.linalg.pinv(A.T @ A, rcond=1e-12, hermitian=True)[: 6 * n, : 6 * n]
    columns = np.zeros((n, 6, 10))
    for k, dof in enumerate((0, 1, 3, 4)):
        columns[:, dof, k] = -1.0
    columns[:, 2, 4] = columns[:, 5, 5] = 1.0
    for k, first in ((6, 0), (8, 3)):
        columns[:, first, k], columns[:, first + 1, k] = np.cos(q), -np.sin(q)
        columns[:, first, k + 1], columns[:, first + 1, k + 1] = np.sin(q), np.cos(q)
    D = columns.reshape(6 * n, 10)
    H = np.linalg.pinv(D)
    P = np.eye(6 * n) - D @ H
    return np.sqrt(np.diag(P @ C @ P.T)).reshape(n, 6), np.sqrt(np.diag(H @ C @ H.T))[:4]


def efficiency(seeds: int) -> list[str]:
    """Spread against the bound, with all constants known."""
    settings = RTestSettings(gain_uncertainty=0, direction_uncertainty=0, nest_uncertainty=0, position_uncertainty=0)
    off, u, line, v = outcomes(settings, seeds)
    motion, location = bound(settings)
    rows = ["| error | bound (k = 1) | spread/bound | stated/bound |", "|---|---|---|---|"]
    values = [(f"{dof}C", off[..., k] / motion[:, k], u[..., k] / motion[:, k], motion[:, k].mean(), k < 3)
              for k, dof in enumerate(DOF)]  # fmt: skip
    values += [(name, line[:, k] / location[k], v[:, k] / location[k], location[k], k < 2)
               for k, name in enumerate(("EX0C", "EY0C", "EA0C", "EB0C"))]  # fmt: skip
    for name, spread, stated, size, length in values:
        unit, scale = ("nm", 1e9) if length else ("urad", 1e6)
        rows.append(f"| {name} | {size * scale:.3g} {unit} | {np.sqrt(np.mean(spread**2)):.3f} | {stated.mean():.4f} |")
    return [
        f"{seeds} simulated tests without uncertainty of sensors and places. The bound is computed from the dense "
        "information matrix of all unknowns. The spread of a location error has a standard deviation of "
        f"{1 / np.sqrt(2 * seeds):.1%}.",
        "",
        *rows,
    ]


def _moved(raw: xr.Dataset, size: float) -> xr.Dataset:
    """Return readings of a second sphere that has moved on the table before 140 deg."""
    angle = raw["angle"].values[14:]
    c, d = np.cos(angle), np.sin(angle)
    shift = size * np.stack([0.6 * c - 0.64 * d, -0.6 * d - 0.64 * c, np.full(angle.size, 0.48)], axis=1)
    raw["displacement"][14:, 1] += shift @ raw["sensor_direction"].values.T
    return raw


def _scaled(raw: xr.Dataset) -> xr.Dataset:
    raw["displacement"][..., 1] *= 1.1
    return raw


def _reversed(raw: xr.Dataset) -> xr.Dataset:
    back = raw.isel(angle=slice(None, None, -1))
    return back.assign_coords(angle=("angle", -back["angle"].values, {"units": "rad"}))


def _shifted(raw: xr.Dataset, which: slice) -> xr.Dataset:
    angle = raw["angle"].values.copy()
    angle[which] += np.radians(2)
    return raw.assign_coords(angle=("angle", angle, {"units": "rad"}))


FAULTS: dict[str, tuple[Callable[[xr.Dataset], xr.Dataset], str]] = {
    "none": (lambda raw: raw, ""),
    "four spheres: one moved by 20 um": (lambda raw: _moved(raw, 20e-6), "sphere 2 has moved"),
    "four spheres: one moved by 2 um": (lambda raw: _moved(raw, 2e-6), "sphere 2 has moved"),
    "a sphere moved by 20 um": (lambda raw: _moved(raw, 20e-6), "sphere 2 has moved"),
    "a sphere moved by 2 um": (lambda raw: _moved(raw, 2e-6), "sphere 2 has moved"),
    "gain of a sensor wrong by 10 %": (_scaled, "gain of sensor 2"),
    "sense of rotation reversed": (_reversed, "opposite sense"),
    "one angle wrong by 2 deg": (lambda raw: _shifted(raw, slice(11, 12)), "112 deg"),
    "all angles shifted by 2 deg": (lambda raw: _shifted(raw, slice(None)), "index"),
}


def faults(seeds: int) -> list[str]:
    """How often a planted fault has a note, and is named; and the coverage of what is stated."""
    rows = ["| fault | with a note or refused | named | coverage of 95 % intervals |", "|---|---|---|---|"]
    for fault, (plant, word) in FAULTS.items():
        noted = named = 0
        inside: list[np.ndarray] = []
        for seed in range(seeds):
            raw, truth = METHOD.simulate(RTestSettings(spheres=4 if fault.startswith("four") else 3), seed)
            try:
                errors = METHOD.identify(plant(raw.copy(deep=True)))
            except MethodError as error:
                noted, named = noted + 1, named + (word in str(error))
                continue
            text = " ".join(errors.attrs["notes"])
            noted, named = noted + bool(text), named + bool(word and word in text)
            off = np.stack([errors[name].values - truth[name].values for name in DOF], axis=1)
            u = np.sqrt(np.diagonal(errors["covariance"].values, axis1=1, axis2=2))
            line = (errors["location_error"] - truth["location_error"]).values
            v = np.sqrt(np.diag(errors["location_covariance"].values))
            inside.append(np.abs(np.concatenate([(off / u).ravel(), line / v])) <= Z95)
        covered = f"{np.nanmean(np.array(inside)):.1%}" if inside else "refused"
        rows.append(f"| {fault} | {noted / seeds:.0%} | {f'{named / seeds:.0%}' if word else ''} | {covered} |")
    return [f"{seeds} tests each, as above with uncertain sensors.", "", *rows]
