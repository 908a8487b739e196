"""Multilateration: the solver compared with general solvers and the published scheme, coverage, and effect of layouts.

``python -m benchmarks.multilateration [--only compare coverage layout] [--targets 100 1000 ... 1000000]
[--limit 600] [--stations near wide]``

``compare`` applies each solver to the same readings with the same start, in separate processes: wall and processor time
of one solution after compilation (the shortest within three seconds), largest memory of the process, iterations, and
deviation of its targets from the truth and from those of a tightly converged solver (all as free networks on the
nominal targets). A solver that exceeds the time limit or 16 GiB is reported, and skipped for more targets. General
solvers return targets and stations, as does ``errormotion, solution``; further results have separate rows.
``coverage`` uses many draws of noise. ``layout`` is the table of the effect of the positions of the stations.
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
import scipy.sparse as sp
import scipy.sparse.linalg as spl
from scipy.optimize import least_squares
from scipy.stats import norm

from benchmarks.multilateration_published import alternate, fitted, jacobian, relative_bound
from errormotion.errors import MethodError
from errormotion.methods.multilateration.networks import bound, solve, station_covariance
from errormotion.methods.multilateration.start import Stations, directions, readings

PARTS = ("compare", "coverage", "layout")
NOISE = 1e-6
EDGE = 0.1
# Distributed around the cube at distances similar to its size, in the linear range, and with space for trackers.
STATION = np.array([[-0.15, -0.15, -0.1], [0.16, -0.13, 0.02], [0.0, 0.17, -0.05], [0.02, 0.01, 0.2]])
LAYOUTS = {
    "near": STATION,
    "wide": np.array([[-0.35, -0.3, -0.15], [0.36, -0.33, 0.02], [0.0, 0.37, -0.15], [0.02, 0.01, 0.4]]),
}


def nominal_targets(m: int, seed: int = 5):
    return np.random.default_rng(seed).uniform(-EDGE / 2, EDGE / 2, (m, 3))


def data(m: int, places=STATION):
    """Nominal targets, true ones (a machine with 10 um), readings, rough stations (2 mm off)."""
    rng = np.random.default_rng([1, m])
    nominal = nominal_targets(m)
    true = nominal + rng.normal(0, 10e-6, (m, 3))
    d = readings(true, Stations(places, np.linalg.norm(true[0] - places, axis=1)))
    return nominal, true, d + rng.normal(0, NOISE, d.shape), places + rng.normal(0, 2e-3, (4, 3))


def on_nominal(target, station, nominal):
    return fitted(target, station, nominal)


# Solvers: from nominal targets, readings and rough stations to targets, stations, iterations, converged.


def ours(u, d, station):
    network = solve(d, u, station, noise=NOISE, robust=False)
    return network.target, network.stations.position, 0, True


def ours_checked(u, d, station):
    network = solve(d, u, station, noise=NOISE)
    return network.target, network.stations.position, 0, True


def ours_in_full(u, d, station):
    network = solve(d, u, station, noise=NOISE)
    assert network.covariance.shape == (len(u), 3, 3)
    assert station_covariance(network.solved).shape == (16, 16)
    assert network.redundancy.shape == network.residual.shape == d.shape
    return network.target, network.stations.position, 0, True


def unpacked(x, m):
    s = x[3 * m :].reshape(4, 4)
    return x[: 3 * m].reshape(m, 3), Stations(s[:, :3], s[:, 3])


def general(u, d, station):
    """Residuals, sparse Jacobian and start for a general solver: the same model, the same start.

    The sparsity pattern of the Jacobian is computed once.
    """
    m = len(u)
    L = np.median(np.linalg.norm(u - station[:, None], axis=-1) - d, axis=1)
    start = np.concatenate([u.ravel(), np.column_stack([station, L]).ravel()])
    pattern = jacobian(*unpacked(start, m), np.ones(d.shape, dtype=bool))

    def slope(x):
        e = directions(unpacked(x, m)[0], unpacked(x, m)[1].position).transpose(1, 0, 2) / NOISE
        values = np.concatenate([e, -e, np.full((m, 4, 1), -1 / NOISE)], axis=-1)
        return sp.csr_array((values.ravel(), pattern.indices, pattern.indptr), shape=pattern.shape)

    return lambda x: (readings(*unpacked(x, m)) - d).T.ravel() / NOISE, slope, start


TIGHT = {"ftol": 1e-15, "xtol": 1e-15, "gtol": 1e-15, "max_nfev": 100}
"""Tolerances at rounding; required also for the inner solver to converge."""


def least_squares_with(**options):
    def work(u, d, station):
        off, slope, start = general(u, d, station)
        dense = options.get("tr_solver") == "exact"
        found = least_squares(off, start, (lambda x: slope(x).toarray()) if dense else slope, **options)
        target, stations = unpacked(found.x, len(u))
        return *on_nominal(target, stations.position, u), found.nfev, found.status > 0

    return work


def lsmr(x_scale, inner, method="trf"):
    return least_squares_with(method=method, tr_solver="lsmr", x_scale=x_scale, tr_options=inner, **TIGHT)


def sparse_newton(u, d, station):
    """Gauss-Newton on the normal equations by sparse LU, six coordinates of the stations held, targets first."""
    off, slope, x = general(u, d, station)
    b = 3 * len(u)
    keep = np.setdiff1d(np.arange(len(x)), [b, b + 1, b + 2, b + 5, b + 6, b + 10])
    done, size = 0, np.inf
    while size > 1e-12 and done < 30:
        J = slope(x)[:, keep]
        g, A = J.T @ off(x), (J.T @ J).tocsc()
        # Elimination of the unknowns of the targets first results in the least fill-in.
        step = -spl.splu(A, permc_spec="NATURAL", diag_pivot_thresh=0.0, options={"SymmetricMode": True}).solve(g)
        x[keep] += step
        done, size = done + 1, np.abs(step).max()
    target, stations = unpacked(x, len(u))
    return *on_nominal(target, stations.position, u), done, size <= 1e-12


def published(u, d, station):
    found = alternate(d, u, station, tolerance=1e-13, iterations=3000)
    return found.target, found.station, found.iterations, found.converged


OURS = {
    "errormotion, solution": ours,
    "and outlier tests": ours_checked,
    "and all covariances": ours_in_full,
}
PEERS = {
    "sparse Gauss-Newton (splu)": sparse_newton,
    "trf, lsmr, not damped": lsmr(1.0, {"regularize": False, "maxiter": 100, "atol": 1e-12, "btol": 1e-12}),
    "the same, scaled": lsmr("jac", {"regularize": False, "maxiter": 100, "atol": 1e-12, "btol": 1e-12}),
    "trf, lsmr": lsmr(1.0, {"atol": 1e-14, "btol": 1e-14}),
    "the same, scaled ": lsmr("jac", {"atol": 1e-14, "btol": 1e-14}),
    "dogbox, lsmr": lsmr("jac", {"atol": 1e-12, "btol": 1e-12}, "dogbox"),
    "trf, exact (dense)": least_squares_with(method="trf", tr_solver="exact", x_scale=0.1, **TIGHT),
    "trf, lsmr, as it comes": least_squares_with(method="trf", tr_solver="lsmr"),
    "alternating (published)": published,
}
WAYS = OURS | PEERS
MOST = {"trf, exact (dense)": 100}
"""Targets above which a solver with dense matrices is not tried."""
SAME = 1e-11
"""A solver has the solution if its targets agree with the reference within this distance, m."""
REPEATED, SECONDS, MEMORY = 50, 3.0, 16 * 2**30


def one(way: str, m: int, places, out: str) -> None:
    """Solve once with few targets for the compilation, then repeatedly for the figures."""
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
    for some in (50, 30_000) if way in OURS else (50,):
        u, _, d, station = data(some)
        WAYS[way](u, d, station)
    u, true, d, station = data(m, places)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    work, walls, processors = WAYS[way], [], []
    while not walls or (len(walls) < REPEATED and sum(walls) < SECONDS):
        wall, processor = time.perf_counter(), time.process_time()
        target, place, iterations, converged = work(u, d, station)
        walls.append(time.perf_counter() - wall)
        processors.append(time.process_time() - processor)
    np.savez(out + ".npz", target=target, place=place)
    truth, _ = on_nominal(true, places, u)
    figures = {
        "wall": min(walls), "processor": min(processors), "before": before,
        "memory": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024, "iterations": int(iterations),
        "converged": bool(converged), "error": float(np.sqrt(np.mean(np.sum((target - truth) ** 2, axis=1)))),
    }  # fmt: skip
    Path(out + ".json").write_text(json.dumps(figures))


def measured(way: str, m: int, layout: str, out: str, limit: float):
    """Return figures and targets of a solver, or the reason of its failure and None."""
    command = [sys.executable, "-m", "benchmarks.multilateration", "--one", way, str(m), layout, out]
    # Several threads make the linear algebra of the other solvers slower, particularly on a busy computer.
    threads = {f"{library}_NUM_THREADS": "1" for library in ("OPENBLAS", "MKL")}
    try:
        done = subprocess.run(
            command, check=False, timeout=limit + 120, capture_output=True, text=True, env=os.environ | threads
        )
    except subprocess.TimeoutExpired:
        return f"longer than {limit:.0f} s", None
    if done.returncode:
        why = "more than 16 GiB" if "MemoryError" in done.stderr else done.stderr.strip().split("\n")[-1][:60]
        return why or f"stopped ({done.returncode})", None
    return json.loads(Path(out + ".json").read_text()), np.load(out + ".npz")["target"]


def compare(layout: str, counts: list[int], limit: float) -> None:
    far = np.linalg.norm(LAYOUTS[layout], axis=1).mean()
    print(f"\nThe same readings for all, four stations {far * 1e3:.0f} mm from the cube's middle, 1 um of noise;")
    print("error: rms of the targets against the truth; off: largest distance of a target from the reference.")
    print("peak: of the process; with errormotion including compiled code and a first run with 30 000 targets.")
    print(f"Load at the start: {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores; linear algebra with one thread.")
    print(
        f"{'targets':>9} {'way':>27} {'wall':>12} {'cpu':>11} {'times ours':>10} {'peak':>10} {'its':>5} {'done':>4} "
        f"{'error':>9} {'off':>9}"
    )
    gone: set[str] = set()
    for m in counts:
        found = {}
        with tempfile.TemporaryDirectory() as folder:
            for way in WAYS:
                if way not in gone and m <= MOST.get(way, m):
                    found[way] = measured(way, m, layout, str(Path(folder) / "out"), limit)
        gone |= {way for way, (_, target) in found.items() if target is None}
        summary(m, found)


def summary(m: int, found) -> None:
    solved = {way: (f, target) for way, (f, target) in found.items() if target is not None}
    reference = next(way for way in [*PEERS, *OURS] if way in solved and solved[way][0]["converged"])
    wall, processor = (found["errormotion, solution"][0][kind] for kind in ("wall", "processor"))
    same = {}
    for way, (f, target) in found.items():
        if target is None:
            print(f"{m:>9} {way:>27} {f}")
            continue
        off = np.linalg.norm(target - solved[reference][1], axis=1).max()
        if way in PEERS and f["converged"] and off < SAME:
            same[way] = f
        print(
            f"{m:>9} {way:>27} {f['wall'] * 1e3:>9.2f} ms {f['processor'] * 1e3:>8.1f} ms "
            f"{f['wall'] / wall:>8.1f} x {f['memory']:>6.0f} MiB {f['iterations']:>5} "
            f"{'yes' if f['converged'] else 'no':>4} {f['error'] * 1e6:>6.3f} um {off:>7.0e} m",
            flush=True,
        )
    # On a busy computer the processor time is more meaningful; each with its best other solver.
    for kind, name, own in (("wall", "wall", wall), ("processor", "cpu", processor)) if same else ():
        best = min(same, key=lambda way: same[way][kind])
        full = found["and all covariances"][0][kind]
        print(
            f"{'':>9} best other solver, by {name}: {best.strip()}, {same[best][kind] / own:.0f} times ours, "
            f"{same[best][kind] / full:.0f} times ours with all covariances",
            flush=True,
        )
    print(f"{'':>9} reference: {reference}", flush=True)


def coverage(seeds: int = 300) -> None:
    """40 targets, four stations: coverage and spread, with free dead paths and relative to the first target."""
    u = nominal_targets(40)
    truth = bound(u, STATION, noise=NOISE)
    covariance, stated = relative_bound(u, STATION, noise=NOISE)
    relative_noise = np.full((4, 40), NOISE)
    relative_noise[:, 0] *= 1e-3
    d0 = readings(u, Stations(STATION, np.zeros(4)))
    print(f"{seeds} draws, 40 targets in 100 mm, 4 stations, 1 um; intervals of 95 %, all coordinates")
    wide = np.sqrt(np.trace(truth.station_covariance, axis1=1, axis2=2)).max()
    print(f"largest standard uncertainty of a station {wide * 1e6:.0f} um: linear to {wide / 0.2:.0e} of its distance")
    for name, noise, expected, expected_stations in (
        ("dead paths free", NOISE, truth.covariance, truth.station_covariance),
        ("relative to target 1", relative_noise, covariance, np.full((4, 3, 3), np.nan)),
    ):
        targets, stations, inside, inside_stations, given_up = [], [], [], [], 0
        for seed in range(seeds):
            d = d0 + np.random.default_rng([2, seed]).normal(0, NOISE, d0.shape)
            network = solve(d, u, STATION, noise=noise, robust=noise is NOISE)
            k = norm.isf(0.025)
            targets.append(network.target - u)
            stations.append(network.stations.position - STATION)
            ratio = np.abs(targets[-1]) / sigma(network.covariance)
            given_up += len(network.undecided)
            inside.append(np.where(np.isfinite(ratio), ratio < k, np.nan))
            inside_stations.append(np.abs(stations[-1]) < k * sigma(network.station_covariance))
        best = np.sqrt(np.trace(truth.covariance, axis1=1, axis2=2).mean())
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
    said = np.sqrt(np.trace(stated.covariance, axis1=1, axis2=2).mean())
    print(f"{'':>22}  the relative formulation itself states {said * 1e6:.3f} um")


def sigma(covariance):
    return np.sqrt(np.diagonal(covariance, axis1=-2, axis2=-1))


# Positions by the description of figure 11 of the paper, which states no coordinates: A B C close together in front of
# the cube and below it, D E F the same positions raised in Z, G and H on both sides of it and above; m.
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
    """Targets from displacements relative to the first one with known stations (simplified simulation of the paper)."""
    reach, found = d - d[:, :1] + np.linalg.norm(u[0] - U, axis=1)[:, None], u.copy()
    for _ in range(8):
        v = found - U[:, None]
        distance = np.linalg.norm(v, axis=-1)
        e = (v / distance[..., None]).transpose(1, 0, 2)
        found = found + np.linalg.solve(e, (reach - distance).T[..., None])[..., 0]
    return found


def layout(draws: int = 200) -> None:
    """Effect of the positions of the stations, as in table 2 of the paper and with all quantities unknown."""
    u, rng = nominal_targets(40), np.random.default_rng(11)
    print("Three stations known, as in table 2 of the paper: mean and standard deviation of the targets' errors, um.")
    print("Positions are chosen by its description; they are not published as numbers.")
    print(f"{'':>4} {'stations':>9} {'random 1 um':>16} {'published':>14} {'linear 3 um / 100 mm':>22}")
    for k, (name, published_error) in enumerate(zip(CONDITIONS, PUBLISHED, strict=True)):
        U = np.array([PLACES[place] for place in name])
        d = readings(u, Stations(U, np.zeros(3)))
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
        axes = np.sqrt(np.diagonal(network.covariance, axis1=1, axis2=2).mean(axis=0)) * 1e6
        worst_station = np.sqrt(np.trace(network.station_covariance, axis1=1, axis2=2)).max() * 1e6
        each = network.uncertainty * 1e6
        print(
            f"{name:>32} {each.mean():>8.1f} {each.max():>8.1f}   {axes[0]:>6.1f} {axes[1]:>6.1f} {axes[2]:>6.1f} "
            f"{worst_station:>11.0f} um"
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", choices=PARTS, default=PARTS)
    parser.add_argument("--targets", nargs="+", type=int, default=[100, 1000, 10_000, 100_000, 1_000_000])
    parser.add_argument("--limit", type=float, default=600.0, help="time limit of a solver, s")
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
            compare(name, arguments.targets, arguments.limit)


if __name__ == "__main__":
    main()
