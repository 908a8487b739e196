"""Multilateration: spread of targets and stations against the bound, coverage, and the errors of the axes."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

import numpy as np
from numpy.polynomial.legendre import leggauss, legval

from errormotion.kinematics.iso import DOF
from errormotion.kinematics.machines import Machine
from errormotion.kinematics.twists import move, rigid_motions
from errormotion.kinematics.volumes import AxisErrors, Targets, Volume, first_order, fitted, is_rotation
from errormotion.methods.multilateration import Multilateration, MultilaterationSettings, simulation
from errormotion.methods.multilateration.axes import grid, volumetric_errors
from errormotion.methods.multilateration.networks import bound
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
#: the virtual tracker has no error of scale, and measures lengths in the air as they are
NO_AIR = dict.fromkeys(("temperature", "pressure", "humidity", "wavelength"), 0.0)
EXACT_SCALE = MultilaterationSettings(
    scale_uncertainty=0.0, air={f"{name}_uncertainty": value for name, value in NO_AIR.items()}
)


def section(seeds: int) -> Iterator[str]:
    """Yield the lines of the section."""
    yield from ("### Targets and stations", "", *honesty(seeds), "")
    yield from ("### Errors of the axes, and the volume between the targets", "", *axes(min(seeds, 60)), "")
    yield from ("### Errors of the axes of smooth and rough machines", "", *roughness(min(seeds, 30)))


def of_the_datum(place: np.ndarray, error: np.ndarray, everywhere: np.ndarray) -> np.ndarray:
    """Return the rigid motion that fits errors (m, 3) best, at other positions (k, 3)."""
    centre = place.mean(axis=0)
    motion = np.linalg.lstsq(rigid_motions(place, centre).reshape(-1, 6), error.ravel())[0]
    return rigid_motions(everywhere, centre) @ motion


def vectors(ds) -> np.ndarray:
    return np.stack([ds[name].values for name in XYZ], axis=-1)


def honesty(seeds: int) -> list[str]:
    """Spread against the bound and coverage, every seed another machine."""
    method, settings = (
        Multilateration(),
        MultilaterationSettings(noise="stated", scale_uncertainty=SCALE, parametric=False),
    )
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
        spread.append(left / np.sqrt(np.einsum("tii->ti", least.covariance) + stretch**2))
        off = errors["station_place"].values - true_station
        away = SCALE * (station - place.mean(axis=0))
        u = np.sqrt(np.einsum("sii->si", errors["station_covariance"].values) + away**2)
        station_z.append(off / u)
        station_spread.append(off / np.sqrt(np.einsum("sii->si", least.station_covariance) + away**2))
    ratio = [np.sqrt(np.nanmean(np.square(part))) for part in (spread, station_spread)]
    held = [np.mean(np.abs(part)[np.isfinite(part)] <= Z95) for part in (z, station_z)]
    least_u = np.sqrt(np.mean(np.einsum("tii->ti", least.covariance), axis=0)) * 1e6
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
            errors = Multilateration().identify(simulation.raw(machine, q, seed=seed), EXACT_SCALE)
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


def roughness(seeds: int) -> list[str]:
    """Return the table of the coverage of error motions of machines of any roughness."""
    rows = ["| coefficients | targets | coverage | at the ends | mean exponent |", "|---|---|---|---|---|"]
    for of, make in (*((f"n^-{p:g}", partial(series, exponent=p)) for p in (1, 1.5, 2, 3, 4)), ("random walk", walk)):
        for count in (COUNT, (10, 10, 8)):
            held, ends, exponent = [], [], []
            for seed in range(seeds):
                found, true = fitted_to_drawn(make, count, seed)
                exponent.append(found.exponent)
                for name, x in true.items():
                    k = found.volume.axis(name)
                    value, u = found.curve(name, np.linspace(found.volume.low[k], found.volume.high[k], 41))
                    inside = np.abs(value - x) <= Z95 * u
                    held.append(inside.mean())
                    ends.append(inside[[0, 1, -2, -1]].mean())
            rows.append(
                f"| {of} | {np.prod(count)} | {np.mean(held):.1%} | {np.mean(ends):.1%} | {np.mean(exponent):.1f} |"
            )
    return [
        f"{seeds} machines in each row: the 14 error motions that one reflector shows, with a typical size of 3 um and "
        "8 urad that differs by a factor of 1.6; noise of the targets 0.5 um in each coordinate. Coefficients of "
        "Legendre polynomials up to order 60 are drawn with the stated decrease, or the curves are random walks with "
        "nine knots. Their sizes are estimated from the targets as well.",
        "",
        *rows,
    ]


def series(rng: np.random.Generator, first: int, x: np.ndarray, exponent: float) -> np.ndarray:
    """Return a curve at x, -1 to 1, whose coefficients decrease with their order."""
    n = np.arange(61.0)
    c = rng.normal(size=n.size) * np.maximum(n, 1.0) ** -exponent
    c[:first] = 0.0
    return legval(x, c)


def walk(rng: np.random.Generator, first: int, x: np.ndarray) -> np.ndarray:
    """Return a random walk with nine knots at x, -1 to 1, minus its mean and with ``first`` = 2 its slope."""
    knots = np.cumsum(rng.normal(size=9)) * 0.5
    at, w = leggauss(200)
    inside = np.interp(at, np.linspace(-1, 1, 9), knots)
    mean, slope = (w * inside).sum() / 2, 1.5 * (w * inside * at).sum()
    return np.interp(x, np.linspace(-1, 1, 9), knots) - mean - (first == 2) * slope * x


def fitted_to_drawn(make, count: tuple[int, int, int], seed: int) -> tuple[AxisErrors, dict[str, np.ndarray]]:
    """Return the errors of the axes from targets of a machine with drawn error motions, and these at 41 positions."""
    rng, half = np.random.default_rng(seed), np.array([0.25, 0.2, 0.15])
    model = Machine("workpiece-X-Y-bed-Z-spindle-tool", dict.fromkeys("XYZ", REFERENCE))
    x = np.stack(np.meshgrid(*[np.linspace(-1, 1, n) for n in count], indexing="ij"), axis=-1).reshape(-1, 3)
    fine, errors, true = np.linspace(-1, 1, 41), np.zeros((len(x), len(model.error_names))), {}
    for k, name in enumerate(model.error_names[:18]):
        if name not in ("ECY", "EAZ", "EBZ", "ECZ"):
            size = (8e-6 if is_rotation(name) else 3e-6) * np.exp(rng.normal(0, 0.5))
            at = np.concatenate([fine, x[:, "XYZ".index(name[2])]])
            curve = size * make(rng, first_order(name), at)
            true[name], errors[:, k] = curve[:41], curve[41:]
    q, noise = x * half, 0.5e-6
    error = model.volumetric_error(q, errors, REFERENCE)[:, :3] + noise * rng.normal(size=x.shape)
    own = np.tile(noise**2 * np.eye(3), (len(q), 1, 1))
    targets = Targets(q, np.tile(REFERENCE, (len(q), 1)), error, own, np.zeros((0, len(q), 3)))
    return fitted(Volume.of(model, q), targets), true


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
