"""Multilateration: the solver against general ones and the published scheme, what it states, and what layouts do.

``python -m benchmarks.multilateration [--only compare coverage layout] [--most 1000000] [--peers 10000]
[--stations near wide]``

``compare`` gives every way the same readings, each in a process of its own: wall and processor time of one solution
when everything is compiled and warm, the most memory that the process held, iterations, and how far its targets are
off the truth and off ours (all as free networks on the nominal targets).
``coverage`` draws noise again and again. ``layout`` is the table of what places of the stations do.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import scipy.sparse.linalg as spl
from scipy.optimize import least_squares
from scipy.stats import norm

from errormotion.errors import MethodError
from errormotion.methods.multilateration.alternating import alternate
from errormotion.methods.multilateration.bound import bound, relative_bound
from errormotion.methods.multilateration.model import Stations, jacobian, readings
from errormotion.methods.multilateration.solver import solve
from errormotion.methods.multilateration.turning import fitted

PARTS = ("compare", "coverage", "layout")
NOISE = 1e-6
EDGE = 0.1
# Spread wide about the cube: at distances like its size, where everything is linear, and where trackers have room.
STATION = np.array([[-0.15, -0.15, -0.1], [0.16, -0.13, 0.02], [0.0, 0.17, -0.05], [0.02, 0.01, 0.2]])
LAYOUTS = {
    "near": STATION,
    "wide": np.array([[-0.35, -0.3, -0.15], [0.36, -0.33, 0.02], [0.0, 0.37, -0.15], [0.02, 0.01, 0.4]]),
}
NONE = np.zeros(0)


def nominal_targets(m: int, seed: int = 5):
    return np.random.default_rng(seed).uniform(-EDGE / 2, EDGE / 2, (m, 3))


def data(m: int, places=STATION):
    """Nominal targets, true ones (a machine with 10 um), readings, rough stations (2 mm off)."""
    rng = np.random.default_rng([1, m])
    nominal = nominal_targets(m)
    true = nominal + rng.normal(0, 10e-6, (m, 3))
    d = readings(true, Stations(places, np.linalg.norm(true[0] - places, axis=1), NONE))
    return nominal, true, d + rng.normal(0, NOISE, d.shape), places + rng.normal(0, 2e-3, (4, 3))


def on_nominal(target, station, nominal):
    stations, moved, _ = fitted(Stations(station, np.zeros(4), NONE), target, nominal, np.ones(len(target), dtype=bool))
    return moved, stations.place


# The ways. Each takes nominal targets, readings and rough stations; returns targets, stations, iterations, converged.


def ours(u, d, station):
    network = solve(d, u, station, noise=NOISE)
    return network.target, network.station, network.iterations, network.converged


def unpacked(x, m):
    s = x[3 * m :].reshape(4, 4)
    return x[: 3 * m].reshape(m, 3), Stations(s[:, :3], s[:, 3], NONE)


def general(u, d, station):
    """Residuals, sparse Jacobian and start for a general solver: the same model, the same start."""
    m, known = len(u), np.ones(d.shape, dtype=bool)
    L = np.median(np.linalg.norm(u - station[:, None], axis=-1) - d, axis=1)
    start = np.concatenate([u.ravel(), np.column_stack([station, L]).ravel()])
    return (
        lambda x: (readings(*unpacked(x, m)) - d).T.ravel() / NOISE,
        lambda x: jacobian(*unpacked(x, m), known) / NOISE,
        start,
    )


def trust_region(u, d, station, **options):
    off, slope, start = general(u, d, station)
    found = least_squares(off, start, slope, method="trf", tr_solver="lsmr", **options)
    target, stations = unpacked(found.x, len(u))
    return *on_nominal(target, stations.place, u), found.nfev, found.status > 0


def trust_region_tight(u, d, station):
    """Tolerances at rounding, and the inner solver's, too: without these it never arrives."""
    inner = {"atol": 1e-14, "btol": 1e-14, "maxiter": 2000}
    return trust_region(
        u, d, station, x_scale="jac", ftol=1e-15, xtol=1e-15, gtol=1e-15, max_nfev=300, tr_options=inner
    )


def sparse_newton(u, d, station):
    """Gauss-Newton on the normal equations by sparse LU, six coordinates of the stations held."""
    off, slope, x = general(u, d, station)
    b = 3 * len(u)
    keep = np.setdiff1d(np.arange(len(x)), [b, b + 1, b + 2, b + 5, b + 6, b + 10])
    done, size = 0, np.inf
    while size > 1e-12 and done < 30:
        J = slope(x)
        g, A = J.T @ off(x), (J.T @ J).tocsc()[:, keep][keep]
        step = -spl.splu(A, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True}).solve(
            g[keep]
        )
        x[keep] += step
        done, size = done + 1, np.abs(step).max()
    target, stations = unpacked(x, len(u))
    return *on_nominal(target, stations.place, u), done, size <= 1e-12


def published(u, d, station):
    found = alternate(d, u, station, tolerance=1e-13, iterations=3000)
    return found.target, found.station, found.iterations, found.converged


WAYS = {
    "errormotion": ours,
    "least_squares, default": trust_region,
    "least_squares, tight": trust_region_tight,
    "sparse Gauss-Newton (splu)": sparse_newton,
    "alternating (published)": published,
}


def one(way: str, m: int, places, out: str) -> None:
    """Solve once to warm up, on few targets, then once for the figures."""
    u, _, d, station = data(30_000 if way == "errormotion" else 50)
    WAYS[way](u, d, station)
    u, true, d, station = data(m, places)
    work, repeats, walls, processors = WAYS[way], 5 if way == "errormotion" and m < 500_000 else 1, [], []
    for _ in range(repeats):
        wall, processor = time.perf_counter(), time.process_time()
        target, place, iterations, converged = work(u, d, station)
        walls.append(time.perf_counter() - wall)
        processors.append(time.process_time() - processor)
    np.savez(out + ".npz", target=target, place=place)
    truth, _ = on_nominal(true, places, u)
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    figures = {
        "wall": min(walls), "processor": min(processors), "memory": memory, "iterations": int(iterations),
        "converged": bool(converged), "error": float(np.sqrt(np.mean(np.sum((target - truth) ** 2, axis=1)))),
    }  # fmt: skip
    Path(out + ".json").write_text(json.dumps(figures))


def compare(layout: str, most: int, peers: int) -> None:
    far = np.linalg.norm(LAYOUTS[layout], axis=1).mean()
    print(f"The same readings for all, four stations {far * 1e3:.0f} mm from the cube's middle, 1 um of noise;")
    print("error: rms of the targets against the truth; off ours: the furthest target.")
    print(f"Load while this ran: {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores.")
    print(
        f"{'targets':>9} {'way':>28} {'wall':>11} {'cpu':>10} {'times ours':>11} {'peak':>9} {'its':>6} {'done':>5} "
        f"{'error':>9} {'off ours':>10}"
    )
    with tempfile.TemporaryDirectory() as folder:
        for m in (m for m in (100, 1000, 10_000, 100_000, 1_000_000) if m <= most):
            first, reference = None, None
            for way in WAYS if m <= peers else ["errormotion"]:
                out = str(Path(folder) / "out")
                done = subprocess.run(
                    [sys.executable, "-m", "benchmarks.multilateration", "--one", way, str(m), layout, out], check=False
                )
                if done.returncode:
                    print(f"{m:>9} {way:>28} failed", flush=True)
                    continue
                f = json.loads(Path(out + ".json").read_text())
                found = np.load(out + ".npz")["target"]
                first, reference = first or f, found if reference is None else reference
                off = np.linalg.norm(found - reference, axis=1).max()
                print(
                    f"{m:>9} {way:>28} {f['wall'] * 1e3:>8.1f} ms {f['processor'] * 1e3:>7.0f} ms "
                    f"{f['wall'] / first['wall']:>9.0f} x {f['memory']:>5.0f} MiB {f['iterations']:>6} "
                    f"{'yes' if f['converged'] else 'no':>5} {f['error'] * 1e6:>6.3f} um {off:>8.1e} m",
                    flush=True,
                )


def coverage(seeds: int = 300) -> None:
    """40 targets, four stations: coverage and spread, with free dead paths and relative to the first target."""
    u = nominal_targets(40)
    truth = bound(u, STATION, noise=NOISE)
    covariance, joint, stated = relative_bound(u, STATION, noise=NOISE)
    relative_noise = np.full((4, 40), NOISE)
    relative_noise[:, 0] *= 1e-3
    d0 = readings(u, Stations(STATION, np.zeros(4), NONE))
    print(f"{seeds} draws, 40 targets in 100 mm, 4 stations, 1 um; intervals of 95 %, all coordinates")
    wide = np.sqrt(np.trace(truth.station_covariance, axis1=1, axis2=2)).max()
    print(f"largest standard uncertainty of a station {wide * 1e6:.0f} um: linear to {wide / 0.2:.0e} of its distance")
    blocks = joint.reshape(4, 4, 4, 4)[np.arange(4), :3, np.arange(4), :3]
    for name, noise, expected, expected_stations in (
        ("dead paths free", NOISE, truth.target_covariance, truth.station_covariance),
        ("relative to target 1", relative_noise, covariance, blocks),
    ):
        targets, stations, inside, inside_stations, given_up = [], [], [], [], 0
        for seed in range(seeds):
            d = d0 + np.random.default_rng([2, seed]).normal(0, NOISE, d0.shape)
            network = solve(d, u, STATION, noise=noise, robust=noise is NOISE)
            k = norm.isf(0.025)
            targets.append(network.target - u)
            stations.append(network.station - STATION)
            ratio = np.abs(targets[-1]) / sigma(network.target_covariance)
            given_up += len(network.undecided)
            inside.append(np.where(np.isfinite(ratio), ratio < k, np.nan))
            inside_stations.append(np.abs(stations[-1]) < k * sigma(network.station_covariance))
        best = np.sqrt(np.trace(truth.target_covariance, axis1=1, axis2=2).mean())
        best_station = np.sqrt(np.trace(truth.station_covariance, axis1=1, axis2=2).mean())
        spread = np.sqrt(np.nanmean(np.sum(np.square(targets), axis=-1)))
        spread_stations = np.sqrt(np.mean(np.sum(np.square(stations), axis=-1)))
        own = np.sqrt(np.trace(expected, axis1=1, axis2=2).mean())
        own_stations = np.sqrt(np.trace(expected_stations, axis1=1, axis2=2).mean())
        print(
            f"{name:>22}: targets coverage {np.nanmean(inside):.2%}, spread {spread * 1e6:.3f} um = "
            f"{spread / best:.3f} of the bound ({own / best:.3f} expected); targets given up {given_up}"
        )
        print(
            f"{'':>22}  stations coverage {np.mean(inside_stations):.2%}, spread {spread_stations * 1e6:.2f} um = "
            f"{spread_stations / best_station:.3f} of the bound ({own_stations / best_station:.3f} expected)"
        )
    said = np.sqrt(np.trace(stated.target_covariance, axis1=1, axis2=2).mean())
    print(f"{'':>22}  the relative formulation itself states {said * 1e6:.3f} um")


def sigma(covariance):
    return np.sqrt(np.diagonal(covariance, axis1=-2, axis2=-1))


# Places after the description of the paper's figure 11, whose coordinates are not given: A B C close together in front
# of the cube and below it, D E F the same places lifted in Z alone, G and H to both sides of it and above; m.
PLACES = {
    "A": (-0.12, -0.40, -0.15), "B": (0.10, -0.42, -0.15), "C": (0.0, -0.38, -0.20), "D": (-0.12, -0.40, 0.15),
    "E": (0.10, -0.42, 0.15), "F": (0.0, -0.38, 0.20), "G": (0.30, 0.05, 0.30), "H": (-0.30, 0.10, 0.20),
}  # fmt: skip
CONDITIONS = ("ABC", "ABG", "AGH", "DEF", "DEG", "EGH")
PUBLISHED = ("14.5 +- 8.1", "3.5 +- 2.3", "2.7 +- 1.4", "13.0 +- 6.3", "4.3 +- 2.2", "3.3 +- 1.4")
FOUR = {
    "close together in front": [(-0.08, -0.45, 0.0), (0.08, -0.45, 0.0), (0.0, -0.45, 0.1), (0.0, -0.4, 0.04)],
    "one above the other (Z alone)": [(0.0, -0.45, 0.0), (0.0, -0.42, 0.2), (0.03, -0.45, 0.4), (0.0, -0.45, -0.3)],
    "on the table, all about it": [(-0.3, -0.3, -0.1), (0.3, -0.3, -0.1), (0.3, 0.3, -0.1), (-0.3, 0.3, -0.1)],
    "the same, one lifted 50 mm": [(-0.3, -0.3, -0.1), (0.3, -0.3, -0.1), (0.3, 0.3, -0.1), (-0.3, 0.3, -0.05)],
    "the same, one lifted 300 mm": [(-0.3, -0.3, -0.1), (0.3, -0.3, -0.1), (0.3, 0.3, -0.1), (-0.3, 0.3, 0.2)],
    "spread wide": [(-0.35, -0.3, -0.15), (0.36, -0.33, 0.02), (0.0, 0.37, -0.15), (0.02, 0.01, 0.4)],
    "spread wide and near": [tuple(place) for place in STATION],
}


def trilaterated(d, u, U):
    """Targets from displacements relative to the first one, the stations known (the paper's simplified simulation)."""
    reach, found = d - d[:, :1] + np.linalg.norm(u[0] - U, axis=1)[:, None], u.copy()
    for _ in range(8):
        v = found - U[:, None]
        distance = np.linalg.norm(v, axis=-1)
        e = (v / distance[..., None]).transpose(1, 0, 2)
        found = found + np.linalg.solve(e, (reach - distance).T[..., None])[..., 0]
    return found


def layout(draws: int = 200) -> None:
    """What places of the stations do, as in the paper's table 2 and with everything unknown."""
    u, rng = nominal_targets(40), np.random.default_rng(11)
    print("Three stations known, as in table 2 of the paper: mean and standard deviation of the targets' errors, um.")
    print("Places are chosen to follow its description; its own are not published as figures.")
    print(f"{'':>4} {'stations':>9} {'random 1 um':>16} {'published':>14} {'linear 3 um / 100 mm':>22}")
    for k, (name, published_error) in enumerate(zip(CONDITIONS, PUBLISHED, strict=True)):
        U = np.array([PLACES[place] for place in name])
        d = readings(u, Stations(U, np.zeros(3), NONE))
        errors = []
        for _ in range(draws):
            errors.append(np.linalg.norm(trilaterated(d + rng.normal(0, NOISE, d.shape), u, U) - u, axis=1))
        linear = np.linalg.norm(trilaterated(d + 3e-5 * (d - d[:, :1]), u, U) - u, axis=1) * 1e6
        random = np.array(errors) * 1e6
        print(
            f"{k + 1:>4} {', '.join(name):>9} {random.mean():>7.1f} +- {random.std():>4.1f} {published_error:>15} "
            f"{linear.mean():>13.1f} +- {linear.std():.1f}"
        )
    print("\nFour stations and dead paths unknown, free network: standard uncertainty of a target (root of trace), um.")
    print(f"{'':>32} {'mean':>8} {'worst':>8}   {'x':>6} {'y':>6} {'z':>6} {'of a station':>14}")
    for name, places in FOUR.items():
        try:
            network = bound(u, places, noise=NOISE)
        except MethodError as error:
            print(f"{name:>32} {str(error).split('What is special: ')[-1]}")
            continue
        axes = np.sqrt(np.diagonal(network.target_covariance, axis1=1, axis2=2).mean(axis=0)) * 1e6
        worst_station = np.sqrt(np.trace(network.station_covariance, axis1=1, axis2=2)).max() * 1e6
        each = network.uncertainty * 1e6
        print(
            f"{name:>32} {each.mean():>8.1f} {each.max():>8.1f}   {axes[0]:>6.1f} {axes[1]:>6.1f} {axes[2]:>6.1f} "
            f"{worst_station:>11.0f} um"
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", choices=PARTS, default=PARTS)
    parser.add_argument("--most", type=int, default=1_000_000, help="most targets for ours")
    parser.add_argument("--peers", type=int, default=10_000, help="most targets for the other ways")
    parser.add_argument("--stations", nargs="+", choices=tuple(LAYOUTS), default=tuple(LAYOUTS), help="for compare")
    parser.add_argument("--one", nargs=4, metavar=("WAY", "M", "LAYOUT", "OUT"), help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.one:
        way, m, name, out = arguments.one
        one(way, int(m), LAYOUTS[name], out)
        return
    if "layout" in arguments.only:
        layout()
    if "coverage" in arguments.only:
        coverage()
    if "compare" in arguments.only:
        for name in arguments.stations:
            compare(name, arguments.most, arguments.peers)


if __name__ == "__main__":
    main()
