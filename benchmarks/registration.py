"""Registration of two noisy height maps: ours against Open3D, small_gicp and the published chain, one data set for all.

``python -m benchmarks.registration [--quick]``; ``--quick`` takes 1600 x 400 points instead of 3200 x 800 and fewer
seeds. What is not installed is left out, with the reason. small_gicp may be named by its folder:
``SMALL_GICP=/path/to/site-packages``.
"""

from __future__ import annotations

import argparse
import os
import resource
import sys
import time
from collections.abc import Callable

import numba
import numpy as np

from errormotion.errors import MethodError
from errormotion.kinematics import poses
from errormotion.methods.crossbeam_scan.registration import clouds, prepare, register

PITCH_X, PITCH_Y, NOISE = 12.5e-6, 70e-6, 0.5e-6
TWIST = np.array([23e-6, -41e-6, 17e-6, 30e-6, -55e-6, 80e-6])
Pose = np.ndarray


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
        M = poses.displaced(TWIST).as_matrix()
        z = self.cold.copy()
        for _ in range(8):
            P, Q, R = (M[i, 0] * X + M[i, 1] * Y + M[i, 2] * z + M[i, 3] for i in range(3))
            S, Sx, Sy = surface(P, Q)
            z -= (R - S) / (M[2, 2] - Sx * M[0, 2] - Sy * M[1, 2])
        self.warm = z

    def scans(self, seed: int, jitter: float = 0.0):
        """Return both scans with noise from point to point and, where asked for, from line to line."""
        rng = np.random.default_rng([3, seed])
        noisy = []
        for z in (self.cold, self.warm):
            z = z + NOISE * rng.standard_normal(z.shape, dtype=np.float32)
            z += rng.normal(0, jitter, (len(z), 1)) if jitter else 0.0
            noisy.append((z.astype(np.float32), self.x, self.y))
        return noisy


@numba.njit(parallel=True, fastmath=True)
def plain_read(z):
    """Add up an array: the least that a reader can do."""
    total = np.float32(0.0)
    for i in numba.prange(z.size):
        total += z[i]
    return total


def times(work: Callable[[], object], repeats: int) -> tuple[float, float]:
    """Return the shortest and the median of several times, s; the first call, which compiles, does not count."""
    work()
    found = []
    for _ in range(repeats):
        start = time.perf_counter()
        work()
        found.append(time.perf_counter() - start)
    return min(found), float(np.median(found))


def memory() -> float:
    """Return the most memory that this process has held, MiB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def row(name: str, seconds: float, pose: Pose | None, artefact: Artefact, ours: float, rms: float = np.nan) -> None:
    """Print a line of the comparison."""
    from scipy.spatial.transform import RigidTransform

    error = poses.displacement(RigidTransform.from_matrix(np.asarray(pose))) - TWIST
    nees = float(error @ np.linalg.solve(artefact.bound, error)) / 6
    print(
        f"{name:>28} {seconds * 1e3:9.1f} ms {seconds / ours:7.0f} x {np.linalg.norm(error[:3]) * 1e9:10.1f} nm "
        f"{np.linalg.norm(error[3:]) * 1e6:9.3f} urad {nees**0.5:9.2f} {rms * 1e6:8.3f} um {memory():7.0f} MiB",
        flush=True,
    )


def compare(artefact: Artefact) -> None:
    """Every way on the same two scans."""
    cold, warm = artefact.scans(0)
    print(f"One pair of scans, {cold[0].shape[1]} x {cold[0].shape[0]} points each; error against the truth; error in")
    print(
        "units of the Cramer-Rao bound (root of the mean over six freedoms: 1 is the bound); rms as the way states it"
    )
    print(
        f"{'':>28} {'time':>12} {'':>9} {'shift error':>13} {'turn error':>14} {'/ bound':>9} {'rms':>11} {'peak':>11}"
    )
    ours, _ = times(lambda: register(prepare(*cold), prepare(*warm)), 9)
    found = register(prepare(*cold), prepare(*warm), point=np.zeros(3))
    row("height map (ours)", ours, found.pose.as_matrix(), artefact, ours, found.rms)
    reference = prepare(*cold)
    warm_only, middle = times(lambda: register(reference, prepare(*warm)), 15)
    read, _ = times(lambda: plain_read(warm[0].reshape(-1)), 15)
    try:
        against_open3d(artefact, cold, warm, ours)
    except MethodError as error:
        print(f"  left out: Open3D ({error})")
    against_small_gicp(artefact, cold, warm, ours)
    print(
        f"A warm scan on a prepared cold one: {warm_only * 1e3:.1f} ms at best, {middle * 1e3:.1f} ms in the median; "
        f"reading its array once {read * 1e3:.2f} ms: {warm_only / read:.0f} times"
    )


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
        for cloud in (target, source):  # its own choice, 20 neighbours, would all lie on one profile
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
            print(f"  left out: {label} (this Open3D, {o3d.__version__}, has none)")
            continue
        row(label, time.perf_counter() - start, found.transformation, artefact, ours, found.inlier_rmse)


def against_small_gicp(artefact: Artefact, cold, warm, ours: float) -> None:
    if folder := os.environ.get("SMALL_GICP"):
        sys.path.append(folder)
    try:
        import small_gicp
    except ImportError as error:
        print(f"  left out: small_gicp ({error}; it is no dependency of this project: pip install small_gicp)")
        return
    for kind in ("PLANE_ICP", "GICP"):
        start = time.perf_counter()
        # In millimetres, its tolerances are made for such numbers; thinned to 0.1 mm, for its normals come from a fixed
        # number of neighbours, which would all lie on one profile.
        target, source = (clouds.points_of(s) * 1e3 for s in (cold, warm))
        found = small_gicp.align(
            target, source, np.eye(4), kind, downsampling_resolution=0.1, max_correspondence_distance=0.3,
            num_threads=2, max_iterations=60, rotation_epsilon=1e-9, translation_epsilon=1e-8,
        )  # fmt: skip
        pose = found.T_target_source.copy()
        pose[:3, 3] *= 1e-3
        row(f"small_gicp {kind}", time.perf_counter() - start, pose, artefact, ours)


def coverage(artefact: Artefact, seeds: int) -> None:
    """Mean squared errors in units of the bound and of the stated covariance, with white noise and with jitter."""
    print(f"\n{seeds} pairs; mean squared error per freedom (NEES/6: 1 is right, +- {(1 / 3 / seeds) ** 0.5:.2f})")
    for label, jitter in (("white noise", 0.0), ("lines jitter by 0.5 um in z", 0.5e-6)):
        bound, own, yaw = [], [], []
        for seed in range(seeds):
            cold, warm = artefact.scans(seed, jitter)
            found = register(prepare(*cold), prepare(*warm), point=np.zeros(3))
            error = found.twist - TWIST
            bound.append(error @ np.linalg.solve(artefact.bound, error) / 6)
            own.append(error @ np.linalg.solve(found.covariance, error) / 6)
            yaw.append(error[5])
        print(
            f"{label:>28}: against the bound of white noise {np.mean(bound):.2f}, against the stated covariance "
            f"{np.mean(own):.2f}, yaw {np.sqrt(np.mean(np.square(yaw))) * 1e6:.3f} urad rms"
        )


def dirt(artefact: Artefact) -> None:
    """Time and error with 5 % outliers, 5 % missing points."""
    print("\nDirty scans: error in units of the bound of clean ones (root mean square of 8 pairs), time of a warm scan")
    for label in ("5 % outliers", "5 % missing"):
        nees = []
        for seed in range(8):
            scans = artefact.scans(seed)
            rng = np.random.default_rng([4, seed])
            for z, *_ in scans:
                hit = rng.random(z.shape, dtype=np.float32) < 0.05
                z[hit] = np.nan if "missing" in label else z[hit] + rng.normal(0, 50e-6, hit.sum())
            cold = prepare(*scans[0])
            error = register(cold, prepare(*scans[1]), point=np.zeros(3)).twist - TWIST
            nees.append(error @ np.linalg.solve(artefact.bound, error) / 6)
        least, middle = times(lambda c=cold, w=scans[1]: register(c, prepare(*w)), 9)
        print(f"{label:>28}: {np.mean(nees) ** 0.5:.2f}, {least * 1e3:.1f} ms at best, {middle * 1e3:.1f} ms median")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="a quarter of the points, fewer seeds")
    options = parser.parse_args()
    artefact = Artefact(400, 1600) if options.quick else Artefact(800, 3200)
    print(f"{os.cpu_count()} processors, load {os.getloadavg()[0]:.1f}, numba on {numba.get_num_threads()} threads")
    compare(artefact)
    coverage(artefact, 20 if options.quick else 60)
    dirt(artefact)


if __name__ == "__main__":
    main()
