"""Spindle drift: coverage of the intervals of the drift, and the beam detection against its bound."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from errormotion.methods.spindle_drift import SpindleDrift, simulation
from errormotion.methods.spindle_drift.identification.beams import (
    circles_and_line,
    fisher_bound,
    likelihood_fit,
    sphere_reading,
)
from errormotion.twin import Event, VirtualMachine

TITLE = "Spindle drift"
SEEDS = 1000
FREEDOMS = ("EX", "EY", "EZ", "EA", "EB")
TIMES = np.array([0.0, 300.0, 900.0, 1800.0, 3600.0, 5400.0, 6000.0])
Z95 = 1.959964


def section(seeds: int) -> Iterator[str]:
    """Yield the lines of the section."""
    yield from ("### Drift", "", *drift(seeds), "", "### Beam detection", "", *beams(seeds))


def drift(seeds: int) -> list[str]:
    """Coverage of the intervals of the drift, with another beam detection for each seed."""
    method = SpindleDrift()
    miss, sigma = [], []
    for seed in range(seeds):
        machine = VirtualMachine("cframe", seed=seed)
        machine.start([Event(0.0, 15000.0)])
        beams = method.identify(simulation.raw_beam_detection(machine, seed=10_000 + seed))
        known = tuple(beams[name].values for name in ("beam_origin", "beam_direction", "beam_covariance"))
        raw = simulation.raw_drift(machine, TIMES, seed=seed, beams=known, expansion=True)
        raw["frame_expansion"] = (("channel", "direction"), machine.frame.expansion)
        errors = method.identify(raw)
        twist = np.asarray(machine.truth_spindle(TIMES, errors.attrs["functional_point"]).em.twist())
        truth = (twist - twist[0])[:, :5]
        miss.append(np.asarray(errors.em.twist())[1:, :5] - truth[1:])
        sigma.append(np.sqrt(np.diagonal(errors["covariance"].values[1:], axis1=1, axis2=2))[:, :5])
    score = np.array(miss) / np.array(sigma)
    chance = np.sqrt(0.05 * 0.95 / seeds)
    rows = [
        "| freedom | coverage of 95 % intervals | at single instants | spread/stated | bias/stated | stated (k = 1) |",
        "|---|---|---|---|---|---|",
    ]
    for k, name in enumerate(FREEDOMS):
        inside = np.abs(score[:, :, k]) <= Z95
        unit, scale = ("nm", 1e9) if k < 3 else ("nrad", 1e9)
        rows.append(
            f"| {name} | {inside.mean():.1%} | {inside.mean(axis=0).min():.1%} to {inside.mean(axis=0).max():.1%} | "
            f"{np.sqrt(np.mean(score[:, :, k] ** 2)):.3f} | {score[:, :, k].mean():+.3f} | "
            f"{np.mean(sigma, axis=(0, 1))[k] * scale:.1f} {unit} |"
        )
    return [
        f"{seeds} virtual machines, {TIMES.size - 1} instants of a warm-up each; each machine with its own beam "
        "detection, and with a frame whose true expansion differs from nominal. The instants of one machine share "
        "their reference state, beams and frame, so that the coverage has a standard deviation of up to "
        f"{chance:.1%}. The sensors have been on for four hours: 0.5 nm of their warm-up remains, which is not part "
        "of the uncertainty.",
        "",
        *rows,
    ]


def beams(seeds: int) -> list[str]:
    """Spread of the beam detection and of the construction of the paper, against the Cramer-Rao bound."""
    rng = np.random.default_rng(0)
    radius, noise = 5e-3, 0.5e-6
    u0, p0 = np.array([-1.0, 0, 0]), np.array([6e-3, 0, 0.01])
    scans = np.array([[0.0, 1, 0], [0, 0, 1]] * 3)
    depths = np.repeat([0.2e-3, 1e-3, 1.8e-3], 2)
    centre = (p0 + (depths + radius)[:, None] * u0)[:, None] + np.linspace(-1e-3, 1e-3, 101)[:, None] * scans[:, None]
    ours, stated, paper, bounds = [], [], [], []
    for _ in range(seeds):
        u = u0 + np.array([0.0, *rng.normal(0, 5e-3, 2)])
        u /= np.linalg.norm(u)
        p = p0 + rng.normal(0, 1e-4, 3)
        readings = sphere_reading(p, u, centre, radius)[0] + rng.normal(0, noise, centre.shape[:2])
        found = likelihood_fit(readings, centre, radius, p0, u0)
        bound = np.sqrt(np.diag(fisher_bound(p, u, centre, radius, noise)))
        miss = np.concatenate([found.origin - p, found.direction - u])
        ours.append(miss / bound)
        stated.append(miss / np.sqrt(np.diag(found.covariance)))
        geometric = circles_and_line(readings, centre, scans, radius, u0)
        paper.append(np.concatenate([geometric[0] - p, geometric[1] - u]) / bound)
        bounds.append(bound)
    names = (
        *("origin along the beam", "origin across, first", "origin across, second"),
        *("direction along", "direction across, first", "direction across, second"),
    )
    units = [("um", 1e6)] * 3 + [("urad", 1e6)] * 3
    rows = [
        "| parameter | bound (k = 1) | likelihood fit/bound | circles and line/bound | coverage of 95 % intervals |",
        "|---|---|---|---|---|",
    ]
    ratio, construction = (np.sqrt(np.mean(np.square(part), axis=0)) for part in (ours, paper))
    for k in (0, 1, 2, 4, 5):
        unit, scale = units[k]
        rows.append(
            f"| {names[k]} | {np.mean(bounds, axis=0)[k] * scale:.3f} {unit} | {ratio[k]:.3f} | {construction[k]:.3f} "
            f"| {np.mean(np.abs(stated) <= Z95, axis=0)[k]:.1%} |"
        )
    return [
        f"{seeds} seeds; six scans of 101 steps over a sphere of 5 mm radius, {noise * 1e6:g} um noise of a step, and "
        "beams with deviations of 0.1 mm and 5 mrad. The ratio of spreads has a standard deviation of "
        f"{1 / np.sqrt(2 * seeds):.1%}.",
        "",
        *rows,
    ]
