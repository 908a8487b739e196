"""Multilateration: spread of targets and stations against the bound, coverage, and the errors of the axes."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.polynomial.legendre import leggauss

from errormotion.kinematics.iso import DOF
from errormotion.kinematics.twists import move
from errormotion.methods.multilateration import Multilateration, Settings, simulation
from errormotion.methods.multilateration.identification.volume import grid, volumetric_errors
from errormotion.methods.multilateration.network.model import motions
from errormotion.methods.multilateration.planning.bound import bound
from errormotion.methods.multilateration.simulation import NOISE, REFLECTOR
from errormotion.twin import VirtualMachine

TITLE = "Multilateration"
SEEDS = 300
Z95 = 1.959964
XYZ = ("EX", "EY", "EZ")
COUNT = (5, 5, 4)
#: relative error of the tracker's lengths, one sigma
SCALE = 0.3e-6
REFERENCE = np.array(REFLECTOR)


def section(seeds: int) -> Iterator[str]:
    """Yield the lines of the section."""
    yield from ("### Targets and stations", "", *honesty(seeds), "")
    yield from ("### Errors of the axes, and the volume between the targets", "", *axes(min(seeds, 60)))


def of_the_datum(place: np.ndarray, error: np.ndarray, everywhere: np.ndarray) -> np.ndarray:
    """Return the rigid motion that fits errors (m, 3) best, at other positions (k, 3)."""
    centre = place.mean(axis=0)
    motion = np.linalg.lstsq(motions(place, centre).reshape(-1, 6), error.ravel())[0]
    return motions(everywhere, centre) @ motion


def vectors(ds) -> np.ndarray:
    return np.stack([ds[name].values for name in XYZ], axis=-1)


def honesty(seeds: int) -> list[str]:
    """Spread against the bound and coverage, every seed another machine."""
    method, settings = Multilateration(), Settings(noise="stated", scale_uncertainty=SCALE, parametric=False)
    z, station_z, spread, chi2, station_spread, lost = [], [], [], [], [], 0
    for seed in range(seeds):
        machine = VirtualMachine("cframe", seed=seed)
        q = simulation.target_grid(machine, COUNT)
        scale = SCALE * np.random.default_rng([seed, 1]).normal()
        errors = method.identify(simulation.raw(machine, q, seed=seed, scale=scale), settings)
        left = vectors(errors) - vectors(simulation.true_errors(machine, q))
        C = errors["covariance"].values[:, :3, :3]
        z.append(left / np.sqrt(np.einsum("tii->ti", C)))
        known = np.isfinite(left).all(axis=1)
        lost += int(np.count_nonzero(~known))
        chi2.append(np.mean([e @ np.linalg.solve(c, e) / 3 for e, c in zip(left[known], C[known], strict=True)]))
        place = simulation.reflector_positions(machine, q)
        station = simulation.stations(machine)
        true_station = station - of_the_datum(place, place - q - REFERENCE, station)
        least = bound(place, station, noise=NOISE)
        # The scale is one draw for all, added to the bound of the noise.
        stretch = SCALE * (place - place.mean(axis=0))
        spread.append(left / np.sqrt(np.einsum("tii->ti", least.target_covariance) + stretch**2))
        off = errors["station_place"].values - true_station
        away = SCALE * (station - place.mean(axis=0))
        u = np.sqrt(np.einsum("sii->si", errors["station_covariance"].values) + away**2)
        station_z.append(off / u)
        station_spread.append(off / np.sqrt(np.einsum("sii->si", least.station_covariance) + away**2))
    ratio = [np.sqrt(np.nanmean(np.square(part))) for part in (spread, station_spread)]
    held = [np.mean(np.abs(part)[np.isfinite(part)] <= Z95) for part in (z, station_z)]
    least_u = np.sqrt(np.mean(np.einsum("tii->ti", least.target_covariance), axis=0)) * 1e6
    return [
        f"{seeds} virtual machines, each with its own errors and tracker: {np.prod(COUNT)} targets, four successive "
        f"positions of one tracker, {NOISE * 1e6:.2g} um noise of a reading, free dead paths, an error of lengths of "
        f"{SCALE * 1e6:.1g} um/m (one sigma). The bound of a target's coordinates is {least_u[0]:.2f}, "
        f"{least_u[1]:.2f} and {least_u[2]:.2f} um in the mean over the grid (noise alone). Mean squared error of a "
        f"target over its stated covariance: {np.mean(chi2):.3f} per freedom. {lost} of {seeds * np.prod(COUNT)} "
        "targets were excluded because a correct reading was rejected.",
        "",
        "| | spread/bound | coverage of 95 % intervals |",
        "|---|---|---|",
        f"| targets | {ratio[0]:.3f} | {held[0]:.1%} |",
        f"| stations | {ratio[1]:.3f} | {held[1]:.1%} |",
    ]


def axes(seeds: int) -> list[str]:
    """Coverage of the 21 curves and of the volume between the targets."""
    rows = [
        "| machine | targets | curves: coverage | spread/stated | volume: coverage | off by (rms) | stated |",
        "|---|---|---|---|---|---|---|",
    ]
    for kind, count in (("cframe", COUNT), ("cframe", (9, 8, 7)), ("gantry", (9, 8, 7))):
        held, ratio, inside, off = [], [], [], []
        for seed in range(seeds):
            machine = VirtualMachine(kind, seed=seed)
            q = simulation.target_grid(machine, count)
            errors = Multilateration().identify(simulation.raw(machine, q, seed=seed))
            for name, value, u, true in curves(machine, errors):
                held.append(np.mean(np.abs(value - true) <= Z95 * u))
                ratio.append(np.mean((value - true) ** 2) / np.mean(u**2))
                assert name
            between = grid(errors["axes_low"].values, errors["axes_high"].values, (6, 5, 5))
            volume = volumetric_errors(errors, between)
            true = vectors(simulation.true_errors(machine, np.concatenate([q, between])))
            true -= of_the_datum(q, true[: len(q)], np.concatenate([q, between]))
            left, C = vectors(volume) - true[len(q) :], volume["covariance"].values[:, :3, :3]
            u = np.sqrt(np.einsum("tii->ti", C))
            inside.append(np.mean(np.abs(left) <= Z95 * u))
            off.append([np.mean(left**2), np.mean(u**2)])
        size = np.sqrt(np.mean(off, axis=0)) * 1e6
        rows.append(
            f"| {kind} | {np.prod(count)} | {np.mean(held):.1%} | {np.sqrt(np.mean(ratio)):.2f} | "
            f"{np.mean(inside):.1%} | {size[0]:.2f} um | {size[1]:.2f} um |"
        )
    return [
        f"{seeds} machines each. Curves are compared with the truth minus its mean, and straightness minus its slope, "
        "at 41 positions; the volume at 150 positions between the targets. The prior of the curves is estimated from "
        "the data; the waves of the machine are not drawn from it, so that the coverage need not be exactly 95 %.",
        "",
        *rows,
    ]


def curves(machine: VirtualMachine, errors) -> Iterator[tuple[str, np.ndarray, np.ndarray, np.ndarray]]:
    """Yield name, value, standard uncertainty and truth of every measured error motion."""
    x, w = leggauss(40)
    for axis in "XYZ":
        q = errors[f"{axis}_position"].values
        middle, half = (q[0] + q[-1]) / 2, (q[-1] - q[0]) / 2
        for k, dof in enumerate(DOF):
            name = dof + axis
            value = errors[name].values
            if np.isnan(value).any():
                continue
            everywhere, inside = (as_seen(machine, name, k, axis, at) for at in (q, middle + x * half))
            mean, slope = (w * inside).sum() / 2, 1.5 * (w * inside * x).sum()
            straight = k < 3 and dof[1] != axis
            yield name, value, errors[f"{name}_u"].values, everywhere - mean - straight * slope * (q - middle) / half


def as_seen(machine: VirtualMachine, name: str, k: int, axis: str, at: np.ndarray) -> np.ndarray:
    """Return an error motion as measured with one reflector, including unmeasured rotations of a table."""
    twist = move(machine.geometry.motions[axis](at), REFERENCE)
    return twist[:, k] - (at * twist[:, 5] if name == "EXY" and "-Y-bed" in machine.chain else 0.0)
