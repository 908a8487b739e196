"""Registration of two noisy height maps, compared with Open3D, small_gicp and the published chain on the same data.

``python -m benchmarks.registration [--quick] [--only compare warm ...]``; ``--quick`` uses 1600 x 400 points, not
3200 x 800, and fewer seeds. Packages that are not installed are skipped with the reason. The folder of small_gicp may
be stated: ``SMALL_GICP=/path/to/site-packages``.
"""

from __future__ import annotations

import argparse
import itertools
import os
import resource
import sys
import time
import tracemalloc
from collections.abc import Callable
from functools import partial

import numba
import numpy as np
from scipy.ndimage import gaussian_filter1d

from errormotion.errors import MethodError
from errormotion.kinematics import poses
from errormotion.methods.crossbeam_scan.identification import registration
from errormotion.methods.crossbeam_scan.identification.registration import clouds, register

PITCH_X, PITCH_Y, NOISE = 12.5e-6, 70e-6, 0.5e-6
TWIST = np.array([23e-6, -41e-6, 17e-6, 30e-6, -55e-6, 80e-6])
Pose = np.ndarray
prepare = partial(registration.prepare, scans=160)  # with the compiled loops of a large campaign, as that of 1.6 GB
PARTS = ("compare", "warm", "coverage", "phases", "yaw", "dirt", "extra")


def surface(X, Y):
    """Waves with slopes up to 0.3 and their derivatives."""
    z, zx, zy = np.zeros_like(X), np.zeros_like(X), np.zeros_like(X)
    for a, lx, ly, phase in [(0.5e-3, 17e-3, 40e-3, 0.3), (0.45e-3, -35e-3, 15e-3, 1.1), (0.12e-3, 9e-3, 11e-3, 2.0)]:
        kx, ky = 2 * np.pi / lx, 2 * np.pi / ly
        angle = kx * X + ky * Y + phase
        z += a * np.sin(angle)
        zx += a * kx * np.cos(angle)
        zy += a * ky * np.cos(angle)
    return z, zx, zy


class Artefact:
    """True height maps of the artefact, cold and moved, and the bound of a registration of both."""

    def __init__(self, rows: int, columns: int) -> None:
        self.x = (np.arange(columns) - columns / 2) * PITCH_X
        self.y = (np.arange(rows) - rows / 2) * PITCH_Y
        X, Y = np.meshgrid(self.x, self.y)
        self.cold, Sx, Sy = surface(X, Y)
        Z = self.cold
        J = np.stack([-Sx, -Sy, np.ones_like(X), Y + Sy * Z, -X - Sx * Z, Sx * Y - Sy * X]).reshape(6, -1)
        self.bound = 2 * NOISE**2 * np.linalg.inv(J @ J.T)
        self.warm = self.moved(TWIST)

    def moved(self, twist):
        """Heights measured by a profiler that has moved."""
        X, Y = np.meshgrid(self.x, self.y)
        M = poses.displaced(twist).as_matrix()
        z = self.cold.copy()
        for _ in range(8):
            P, Q, R = (M[i, 0] * X + M[i, 1] * Y + M[i, 2] * z + M[i, 3] for i in range(3))
            S, Sx, Sy = surface(P, Q)
            step = (R - S) / (M[2, 2] - Sx * M[0, 2] - Sy * M[1, 2])
            z -= step
            if np.max(np.abs(step)) < 1e-9:
                break
        return z

    def scans(self, seed: int, jitter: float = 0.0, along: float = 0.0, speckle: float = 0.0):
        """Return both scans with noise of points, and optionally with noise of lines along z and y.

        ``speckle`` (points): correlation length of the noise along a profile.
        """
        rng = np.random.default_rng([3, seed])
        noisy = []
        for z in (self.cold, self.warm):
            noise = rng.standard_normal(z.shape, dtype=np.float32)
            if speckle:
                noise = gaussian_filter1d(noise, speckle, axis=1)
                noise /= noise.std()
            noisy_z = z + NOISE * noise
            if jitter:
                noisy_z += rng.normal(0, jitter, (len(z), 1))
            if along:
                noisy_z += np.gradient(z, self.y, axis=0) * rng.normal(0, along, (len(z), 1))
            noisy.append((noisy_z.astype(np.float32), self.x, self.y))
        return noisy

    def nees(self, error, covariance=None) -> float:
        """Squared error in units of a covariance, else of the bound, per freedom."""
        return float(error @ np.linalg.solve(self.bound if covariance is None else covariance, error)) / 6


def found_by(cold, warm):
    """Register two scans; twists about the origin."""
    return register(prepare(*cold), prepare(*warm), point=np.zeros(3))


@numba.njit(parallel=True, fastmath=True)
def plain_read(z):
    """Add up an array: the minimum work of a reader."""
    total = np.float32(0.0)
    for i in numba.prange(z.size):
        total += z[i]
    return total


def times(work: Callable[[], object], repeats: int) -> tuple[float, float]:
    """Return the shortest and the median of several times, s, without the first call, which compiles."""
    work()
    found = []
    for _ in range(repeats):
        start = time.perf_counter()
        work()
        found.append(time.perf_counter() - start)
    return min(found), float(np.median(found))


def memory() -> float:
    """Return the largest memory of this process, MiB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def row(name: str, seconds: float, pose: Pose | None, artefact: Artefact, ours: float, rms: float = np.nan) -> None:
    """Print a line of the comparison."""
    from scipy.spatial.transform import RigidTransform

    error = poses.displacement(RigidTransform.from_matrix(np.asarray(pose))) - TWIST
    nees = artefact.nees(error)
    print(
        f"{name:>28} {seconds * 1e3:9.1f} ms {seconds / ours:7.0f} x {np.linalg.norm(error[:3]) * 1e9:10.1f} nm "
        f"{np.linalg.norm(error[3:]) * 1e6:9.3f} urad {nees**0.5:9.2f} {rms * 1e6:8.3f} um {memory():7.0f} MiB",
        flush=True,
    )


def compare(artefact: Artefact) -> None:
    """All algorithms on the same two scans."""
    cold, warm = artefact.scans(0)
    print(f"One pair of scans, {cold[0].shape[1]} x {cold[0].shape[0]} points each; error against the truth; error in")
    print("units of the Cramer-Rao bound (root of the mean over six freedoms: 1 is the bound); rms as stated")
    print(
        f"{'':>28} {'time':>12} {'':>9} {'shift error':>13} {'turn error':>14} {'/ bound':>9} {'rms':>11} {'peak':>11}"
    )
    ours, _ = times(lambda: register(prepare(*cold), prepare(*warm)), 9)
    found = register(prepare(*cold), prepare(*warm), point=np.zeros(3))
    row("height map (ours)", ours, found.pose.as_matrix(), artefact, ours, found.rms)
    try:
        against_open3d(artefact, cold, warm, ours)
    except MethodError as error:
        print(f"  skipped: Open3D ({error})")
    against_small_gicp(artefact, cold, warm, ours)


def warm_scan(artefact: Artefact) -> None:
    """Time of a warm scan on a prepared cold one, compared with reading its numbers once; its memory."""
    cold, warm = artefact.scans(0)
    reference, copies, turn = prepare(*cold), [warm[0].copy() for _ in range(24)], itertools.count()

    def following():
        return copies[next(turn) % len(copies)]

    print("\nA warm scan on a prepared cold one, and reading its numbers once (best, median)")
    for label, scan in (("its numbers in the cache", lambda: warm[0]), ("its numbers in memory", following)):
        read = times(lambda scan=scan: plain_read(scan().reshape(-1)), 48)
        took = times(lambda scan=scan: register(reference, prepare(scan(), *warm[1:])), 96)
        print(
            f"{label:>28}: {took[0] * 1e3:.2f} ms, {took[1] * 1e3:.2f} ms; reading {read[0] * 1e3:.3f} ms, "
            f"{read[1] * 1e3:.3f} ms: {took[0] / read[0]:.0f} times, {took[1] / read[1]:.0f} times"
        )
    reference = registration.prepare(*cold)
    alone = times(lambda: register(reference, registration.prepare(*warm)), 48)
    print(f"{'nothing compiled':>28}: {alone[0] * 1e3:.2f} ms, {alone[1] * 1e3:.2f} ms")
    tracemalloc.start()
    register(reference, registration.prepare(*warm))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    print(f"{'memory':>28}: {peak / 2**20:.1f} MiB in addition to {warm[0].nbytes / 2**20:.1f} MiB of the scan")


def against_open3d(artefact: Artefact, cold, warm, ours: float) -> None:
    o3d = clouds.open3d()
    fine = o3d.pipelines.registration

    def ndt(a, b):
        target, source = (o3d.geometry.PointCloud(o3d.utility.Vector3dVector(clouds.points_of(s))) for s in (a, b))
        if not hasattr(fine, "registration_ndt"):
            return None
        return fine.registration_ndt(source, target, clouds.ndt_option(o3d), np.eye(4))

    def generalised(a, b):
        target, source = (o3d.geometry.PointCloud(o3d.utility.Vector3dVector(clouds.points_of(s))) for s in (a, b))
        for cloud in (target, source):  # with its default of 20 neighbours, all would be on one profile
            cloud.estimate_covariances(o3d.geometry.KDTreeSearchParamHybrid(0.25e-3, 60))
        criteria = fine.ICPConvergenceCriteria(1e-10, 1e-12, 30)
        method = fine.TransformationEstimationForGeneralizedICP()
        return fine.registration_generalized_icp(source, target, clouds.NEAREST, np.eye(4), method, criteria)

    for name in ("open3d_plane", "paper"):
        start = time.perf_counter()
        pose, rms, _ = clouds.BACKENDS[name](cold, warm)
        label = {"open3d_plane": "Open3D point-to-plane", "paper": "published chain"}[name]
        row(label, time.perf_counter() - start, pose.as_matrix(), artefact, ours, rms)
    for label, work in (("Open3D NDT", ndt), ("Open3D generalised ICP", generalised)):
        start = time.perf_counter()
        found = work(cold, warm)
        if found is None:
            print(f"  skipped: {label} (not in Open3D {o3d.__version__})")
            continue
        row(label, time.perf_counter() - start, found.transformation, artefact, ours, found.inlier_rmse)


def against_small_gicp(artefact: Artefact, cold, warm, ours: float) -> None:
    if folder := os.environ.get("SMALL_GICP"):
        sys.path.append(folder)
    try:
        import small_gicp
    except ImportError as error:
        print(f"  skipped: small_gicp ({error}; it is not a dependency: pip install small_gicp)")
        return
    for kind in ("PLANE_ICP", "GICP"):
        start = time.perf_counter()
        # In millimetres, as its tolerances require; thinned to 0.1 mm, because its normals are computed from a fixed
        # number of neighbours, which would all be on one profile.
        target, source = (clouds.points_of(s) * 1e3 for s in (cold, warm))
        found = small_gicp.align(
            target, source, np.eye(4), kind, downsampling_resolution=0.1, max_correspondence_distance=0.3,
            num_threads=2, max_iterations=60, rotation_epsilon=1e-9, translation_epsilon=1e-8,
        )  # fmt: skip
        pose = found.T_target_source.copy()
        pose[:3, 3] *= 1e-3
        row(f"small_gicp {kind}", time.perf_counter() - start, pose, artefact, ours)


def coverage(artefact: Artefact, seeds: int) -> None:
    """Mean squared errors in units of the bound and of the stated covariance, with white and realistic noise."""
    print(f"\n{seeds} pairs; mean squared error per freedom (NEES/6: 1 is right, +- {(1 / 3 / seeds) ** 0.5:.2f})")
    kinds = {
        "white noise": {},
        "lines jitter 0.5 um in z": {"jitter": 0.5e-6},
        "0.5 um in z, 2 um in y": {"jitter": 0.5e-6, "along": 2e-6},
        "and speckle over 4 points": {"jitter": 0.5e-6, "along": 2e-6, "speckle": 4.0},
    }
    for label, kind in kinds.items():
        bound, own, yaw = [], [], []
        for seed in range(seeds):
            found = found_by(*artefact.scans(seed, **kind))
            error = found.twist - TWIST
            bound.append(artefact.nees(error))
            own.append(artefact.nees(error, found.covariance))
            yaw.append(error[5])
        print(
            f"{label:>28}: against the bound of white noise {np.mean(bound):.2f}, against the stated covariance "
            f"{np.mean(own):.2f}, yaw {np.sqrt(np.mean(np.square(yaw))) * 1e6:.3f} urad rms",
            flush=True,
        )


def phases(artefact: Artefact) -> None:
    """Bias at eight positions between the blocks along x and y, with noise and its opposite, which cancel."""
    print("\nBias in standard deviations of the bound, at eight shifts of an eighth of a block")
    for axis, block in ((0, 16 * PITCH_X), (1, 4 * PITCH_Y)):
        worst = []
        for phase in range(8):
            twist = TWIST.copy()
            twist[axis] = phase / 8 * block
            heights, errors = (artefact.cold, artefact.moved(twist)), []
            for seed in range(2):
                noise = NOISE * np.random.default_rng([5, seed]).standard_normal((2, *artefact.cold.shape))
                for sign in (1, -1):
                    scans = [
                        ((z + sign * n).astype(np.float32), artefact.x, artefact.y)
                        for z, n in zip(heights, noise, strict=True)
                    ]
                    errors.append(found_by(*scans).twist - twist)
            worst.append(np.max(np.abs(np.mean(errors, axis=0)) / np.sqrt(np.diag(artefact.bound))))
        print(f"{'along ' + 'xy'[axis]:>28}: " + " ".join(f"{b:.2f}" for b in worst), flush=True)


def yaw_of_jittering_lines(artefact: Artefact, seeds: int) -> None:
    """Yaw of scans with jitter of the lines along z, also by point-to-plane ICP."""
    print(f"\nLines jitter by 0.5 um along z: yaw error, {seeds} pairs")
    ours, theirs = [], []
    for seed in range(seeds):
        cold, warm = artefact.scans(seed, jitter=0.5e-6)
        ours.append(found_by(cold, warm).twist[5] - TWIST[5])
        try:
            theirs.append(poses.displacement(clouds.BACKENDS["open3d_plane"](cold, warm)[0])[5] - TWIST[5])
        except MethodError as error:
            print(f"  skipped: Open3D ({error})")
            return
    ours, theirs = (float(np.sqrt(np.mean(np.square(e)))) * 1e6 for e in (ours, theirs))
    print(f"{'rms':>28}: {ours:.4f} urad, Open3D point-to-plane {theirs:.4f} urad: {theirs / ours:.1f} times")


def outliers(rng, z):
    hit = rng.random(z.shape, dtype=np.float32) < 0.05
    z[hit] += rng.normal(0, 50e-6, hit.sum()).astype(np.float32)


def speckles(rng, z, share=0.05):
    z[rng.random(z.shape, dtype=np.float32) < share] = np.nan


def blobs(rng, z, share=0.05):
    """Holes of 0.3 to 1.2 mm radius."""
    while np.isnan(z).mean() < share:
        r, c, radius = rng.integers(z.shape[0]), rng.integers(z.shape[1]), rng.uniform(0.3e-3, 1.2e-3)
        rows, columns = (np.arange(n) - k for n, k in zip(z.shape, (r, c), strict=True))
        z[((rows * PITCH_Y) ** 2)[:, None] + (columns * PITCH_X) ** 2 < radius**2] = np.nan


def dirt(artefact: Artefact, seeds: int) -> None:
    """Time and error with outliers and missing points."""
    print(f"\nDirty scans, {seeds} pairs: error in units of the bound of clean ones (rms), NEES/6, time of a warm scan")
    kinds = {
        "5 % outliers": outliers,
        "5 % missing, speckles": speckles,
        "5 % missing, blobs": blobs,
        "20 % missing, speckles": lambda rng, z: speckles(rng, z, 0.2),
        "20 % missing, blobs": lambda rng, z: blobs(rng, z, 0.2),
    }
    for label, spoil in kinds.items():
        bound, own = [], []
        for seed in range(seeds):
            scans = artefact.scans(seed)
            rng = np.random.default_rng([4, seed])
            for z, *_ in scans:
                spoil(rng, z)
            cold = prepare(*scans[0])
            found = register(cold, prepare(*scans[1]), point=np.zeros(3))
            bound.append(artefact.nees(found.twist - TWIST))
            own.append(artefact.nees(found.twist - TWIST, found.covariance))
        least, middle = times(lambda c=cold, w=scans[1]: register(c, prepare(*w)), 15)
        print(
            f"{label:>28}: {np.mean(bound) ** 0.5:.2f}, {np.mean(own):.2f}, {least * 1e3:.1f} ms at best, "
            f"{middle * 1e3:.1f} ms median",
            flush=True,
        )


def extra(artefact: Artefact, seeds: int) -> None:
    """Cost of free drifts of the feed, and check of their covariance."""
    names = ("feed_x", "feed_y", "feed_z")
    joint, own = [], []
    for seed in range(seeds):
        cold, warm = (prepare(*scan) for scan in artefact.scans(seed))
        found = register(cold, warm, point=np.zeros(3), extra=dict.fromkeys(names, np.inf))
        error = np.concatenate([found.twist - TWIST, found.extra])
        joint.append(error @ np.linalg.solve(found.joint_covariance, error) / 9)
        own.append(artefact.nees(error[:6], found.covariance))
    rigid = register(cold, warm, point=np.zeros(3))
    least, middle = times(lambda: register(cold, warm, extra=dict.fromkeys(names, np.inf)), 15)
    print(
        f"\nFree drifts of the feed, {seeds} pairs: NEES of nine {np.mean(joint):.2f} "
        f"(+- {(2 / 9 / seeds) ** 0.5:.2f}), of the twist {np.mean(own):.2f}; standard deviations of the twist are "
        + ", ".join(f"{r:.1f}" for r in found.sigma / rigid.sigma)
        + f" times those of the rigid motion; {least * 1e3:.1f} ms at best, {middle * 1e3:.1f} ms median"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="a quarter of the points, fewer seeds")
    parser.add_argument("--only", nargs="+", choices=PARTS, default=PARTS, help="parts to run")
    options = parser.parse_args()
    quick = options.quick
    artefact = Artefact(400, 1600) if quick else Artefact(800, 3200)
    print(f"{os.cpu_count()} processors, load {os.getloadavg()[0]:.1f}, numba on {numba.get_num_threads()} threads")
    parts = {
        "compare": lambda: compare(artefact),
        "warm": lambda: warm_scan(artefact),
        "coverage": lambda: coverage(artefact, 20 if quick else 60),
        "phases": lambda: phases(artefact),
        "yaw": lambda: yaw_of_jittering_lines(artefact, 3 if quick else 5),
        "dirt": lambda: dirt(artefact, 6 if quick else 60),
        "extra": lambda: extra(artefact, 20 if quick else 60),
    }
    for name in options.only:
        parts[name]()
    print(f"load {os.getloadavg()[0]:.1f} at the end")


if __name__ == "__main__":
    main()
