"""Corrections of commands from noisy measurements of virtual machines, compared with the true remaining errors."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import xarray as xr

from errormotion.compensation.correction import correction
from errormotion.kinematics.iso import DOF
from errormotion.twin import VirtualMachine

TITLE = "Correction"
SEEDS = 100
NOISE = 0.5e-6
TURN_NOISE = 1e-6
PLACES = 40
TOOL = np.array([0.03, -0.02, -0.15])
"""Functional point, m, which differs from that of the measurement."""


def section(seeds: int) -> Iterator[str]:
    """Yield the lines of the section."""
    yield (
        f"{seeds} virtual machines of each kind, each measured once with {1e6 * NOISE:g} um and {1e6 * TURN_NOISE:g} "
        "urad of noise: the volume on a grid of 7 x 7 x 7 positions, and at 400 random positions. The correction of "
        f"{PLACES} commands in the volume is applied for a tool that is 0.15 m longer, and the true displacement of "
        "the tool is computed by multiplication of poses. `remaining`: RMS of its components; `stated`: RMS of their "
        "standard uncertainties; `held`: share of components within their 95 % interval; `chi2`: mean of the squared "
        "remaining displacement over its covariance, 3 for a correct covariance and less for one that is too large. "
        "The interpolation of a grid adds the variance of a Wiener process, up to twice the variance needed for "
        "smooth errors."
    )
    yield from (
        "",
        "| machine | measured at | uncorrected/um | remaining/um | stated/um | held | chi2 |",
        "|---|---|---|---|---|---|---|",
    )
    for kind in ("cframe", "gantry"):
        for layout in ("grid", "anywhere"):
            yield row(kind, layout, seeds)


def row(kind: str, layout: str, seeds: int) -> str:
    """Return one line of the table."""
    before, after, stated, chi2 = [], [], [], []
    for seed in range(seeds):
        machine, rng = VirtualMachine(kind, seed), np.random.default_rng([seed, 1])
        low, high = np.array([machine.travel[axis] for axis in "XYZ"]).T
        nodes = rng.uniform(low, high, (400, 3)) if layout == "anywhere" else _grid(low, high)
        places = rng.uniform(low, high, (8 * PLACES, 3))
        found = correction(_measured(machine, nodes, rng), TOOL).at(places, covariance=True)
        assert found.covariance is not None
        inside = np.flatnonzero(found.valid)[:PLACES]
        C, asked = found.covariance[inside], places[inside]
        remaining = found.offset[inside] + _true(machine, asked + found.offset[inside])
        before.append(_true(machine, asked))
        after.append(remaining)
        stated.append(np.sqrt(np.diagonal(C, axis1=1, axis2=2)))
        chi2.append(np.einsum("ni,nij,nj->n", remaining, np.linalg.inv(C), remaining))
    r, u = np.concatenate(after), np.concatenate(stated)
    figures = [1e6 * np.sqrt(np.mean(np.square(each))) for each in (np.concatenate(before), r, u)]
    held = 100 * np.mean(np.abs(r) <= 1.96 * u)
    sizes = f"{figures[0]:.2f} | {figures[1]:.3f} | {figures[2]:.3f}"
    return f"| {kind} | {layout} | {sizes} | {held:.1f}% | {np.mean(chi2):.2f} |"


def _grid(low: np.ndarray, high: np.ndarray) -> np.ndarray:
    lines = [np.linspace(a, b, 7) for a, b in zip(low, high, strict=True)]
    return np.stack(np.meshgrid(*lines, indexing="ij"), axis=-1).reshape(-1, 3)


def _measured(machine: VirtualMachine, nodes: np.ndarray, rng: np.random.Generator) -> xr.Dataset:
    ds = machine.volumetric_truth(nodes).load()
    sigma = np.array([NOISE] * 3 + [TURN_NOISE] * 3)
    for name, size in zip(DOF, sigma, strict=True):
        ds[name] = ds[name] + size * rng.normal(size=len(nodes))
    return ds.assign(covariance=(ds["covariance"].dims, np.tile(np.diag(sigma**2), (len(nodes), 1, 1))))


def _true(machine: VirtualMachine, commanded: np.ndarray) -> np.ndarray:
    geometry = machine.geometry
    errors = geometry.machine.errors_at(commanded, geometry.motions, geometry.locations)
    return geometry.machine.volumetric_error(commanded, errors, TOOL, exact=True)[:, :3]
