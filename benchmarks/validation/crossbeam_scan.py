"""Crossbeam scan: complete virtual campaigns with different machines, from the pose of the profiler to the curves."""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor

import numpy as np
from scipy.spatial.transform import RigidTransform

from errormotion.datasets import DOF
from errormotion.kinematics.poses import displaced
from errormotion.methods.crossbeam_scan import CrossbeamScan, simulation
from errormotion.methods.crossbeam_scan.identification.profiler_pose.calibration import PARAMETERS, parameters
from errormotion.methods.crossbeam_scan.identification.registration import prepare, register
from errormotion.methods.crossbeam_scan.identification.registrations import FEED as FEED_NAMES
from errormotion.methods.crossbeam_scan.identification.registrations import bound
from errormotion.methods.crossbeam_scan.settings import CrossbeamScanSettings, Layout, PoseSettings
from errormotion.twin import VirtualMachine
from errormotion.twin.artefacts.pieces import swept
from errormotion.twin.crossbeam import LEVER, LIFT
from errormotion.twin.sensors.profiler import Disturbances, Profiler

TITLE = "Crossbeam scan"
SEEDS = 150
REGISTRATION_SEEDS = 2
"""Single registrations for each campaign."""
Z95 = 1.959964

TIMES = np.array([0.0, 1800.0, 4200.0, 9000.0])
PLACES = np.array([-0.6, -0.2, 0.2, 0.6])
POINTS, PITCH, LINES, FEED = 800, 25e-6, 400, 70e-6
FINE_POINTS, FINE_PITCH = 1600, 12.5e-6
LEVER_SIGMA = 1e-3
TOOL = np.add(LEVER, [0.0, 0.0, LIFT])
"""Nominal position of the profiler relative to the carriage, m."""
STRAINS = ("free", "guided")
RIGID = {"artefact_height": 0.0, "mount_expansion_uncertainty": 0.0}
"""Artefacts and mount of the virtual gantry do not expand."""
REGISTRATIONS = (
    ("White noise, six freedoms", Disturbances.white(), False),
    ("White noise, drift along the feed besides", Disturbances.white(), True),
    ("All disturbances, drift along the feed besides", Disturbances(), True),
)
"""Name, disturbances of the profiler, and whether the drift along the feed is a parameter."""
METHOD = CrossbeamScan()

Seed = dict[str, np.ndarray]


def section(seeds: int) -> Iterator[str]:
    """Yield the lines of the section."""
    campaigns = gathered(campaign, seeds)
    yield from (
        f"{seeds} virtual gantries. For each, the pose of the profiler is found from two simulated scans of a pocket, "
        f"the lever is drawn with {LEVER_SIGMA * 1e3:g} mm (k = 1) about the stated one, and {PLACES.size} artefacts "
        f"are scanned cold and {TIMES.size - 1} times warm, {POINTS} points {PITCH * 1e6:g} um apart by {LINES} lines "
        f"{FEED * 1e6:g} um apart, with all disturbances of the virtual profiler: noise, jitter of the lines along "
        "both directions, speckle, stray light, outliers and gaps. The carriage rotates along each scan with the "
        "errors of its axis. The results of one gantry share pose, lever and cold scans, so that each interval after "
        "a coverage (+-, 95 %) is that of the mean over gantries.",
        "",
    )
    for strain in STRAINS:
        yield from (f"### Errors of the axis, strain = {strain!r}", "", *errors_table(campaigns, strain), "")
    yield from ("### Smooth curves", "", *curves_table(campaigns), "")
    yield from ("### Pose of the profiler", "", *pose_table(campaigns), "")
    yield from ("### Registration", "", *registration_table(gathered(registration, REGISTRATION_SEEDS * seeds)))


def gathered(work: Callable[[int], Seed], seeds: int) -> Seed:
    """Return the stacked results of all seeds, computed with one process for each processor."""
    os.environ |= dict.fromkeys(("NUMBA_NUM_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(os.cpu_count(), mp_context=context) as pool:
        found = list(pool.map(work, range(seeds)))
    return {name: np.array([one[name] for one in found]) for name in found[0]}


# ------------------------------------------------------------------ one seed


def campaign(seed: int) -> Seed:
    """Return deviations of a campaign and their stated covariance: pose, errors, errors at the tool, curves."""
    machine = VirtualMachine("gantry", seed=seed)
    beam = machine.crossbeam
    posed = METHOD.identify(
        simulation.raw_pocket(machine, seed=10_000 + seed), CrossbeamScanSettings(procedure="profiler_pose")
    )
    pose, covariance = posed["profiler_pose"].values, posed["pose_covariance"].values
    true_pose, found_pose = (parameters(RigidTransform.from_matrix(matrix)) for matrix in (beam.pose, pose))
    out = {"pose": found_pose - true_pose, "pose_covariance": covariance}

    raw = simulation.raw_scans(
        machine, TIMES, PLACES, seed=seed, profiler=Profiler(POINTS, PITCH), profiles=LINES, feed=FEED, pose=pose
    )
    off = np.random.default_rng([seed, 2]).normal(0, LEVER_SIGMA, 3)
    metres = {"units": "m"}
    raw["pose_covariance"] = (("p", "p_"), covariance)
    raw["lever"] = ("direction", beam.lever + off, metres)
    raw["lever_uncertainty"] = ("direction", np.full(3, LEVER_SIGMA), metres)
    truth = simulation.truth_axis(machine, TIMES, PLACES)
    for strain in STRAINS:
        errors = METHOD.identify(raw, CrossbeamScanSettings(strain=strain, **RIGID))
        for name, ours, true in (("", errors, truth), ("_tool", errors.em.at(TOOL), truth.em.at(TOOL))):
            out[f"{strain}{name}"] = (ours.em.twist().values - true.em.twist().values)[1:]
            out[f"{strain}{name}_covariance"] = ours["covariance"].values[1:]
        place, moment = errors["place"].values, errors["moment"].values[1:]
        along = errors["smooth_position"].values[1:] - beam.twist(TIMES[1:, None], place)
        over = errors["smooth_time"].values[1:] - beam.twist(moment[:, None], PLACES)
        out |= {f"{strain}_position": along, f"{strain}_position_u": errors["smooth_position_u"].values[1:]}
        out |= {f"{strain}_time": over, f"{strain}_time_u": errors["smooth_time_u"].values[1:]}
    return out


def registration(seed: int) -> Seed:
    """Return errors of three registrations at the real pitch of the points, their stated covariance and the bound.

    White noise with six freedoms, white noise with drift along the feed, and all disturbances with drift.
    """
    rng = np.random.default_rng([seed, 3])
    artefact, y = swept(), (np.arange(LINES) - (LINES - 1) / 2) * FEED
    stands = displaced(rng.normal(0, [0.2e-3] * 3 + [3e-3] * 3)).as_matrix()
    moved = np.concatenate([rng.normal(0, 20e-6, 6), np.zeros(3)])
    out: Seed = {}
    for name, wrong, drift in REGISTRATIONS:
        profiler = Profiler(FINE_POINTS, FINE_PITCH, disturbances=wrong)
        maps = []
        for cycle, motion in enumerate((np.zeros(6), moved[:6])):
            places = y + rng.uniform(-0.5, 0.5) * FEED
            steps = np.tile(np.eye(4), (LINES, 1, 1))
            steps[:, 1, 3] = places
            poses = stands @ displaced(motion).as_matrix() @ steps
            maps.append(prepare(profiler.scan(artefact, poses, key=(seed, cycle)), profiler.x, places))
        found = register(*maps, point=np.zeros(3), extra=dict.fromkeys(FEED_NAMES, np.inf) if drift else None)
        error = np.zeros(9)
        error[: 6 + found.extra.size] = np.concatenate([found.twist, found.extra]) - moved[: 6 + found.extra.size]
        covariance = np.zeros((9, 9))
        covariance[: len(found.joint_covariance), : len(found.joint_covariance)] = found.joint_covariance
        out |= {name: error, f"{name}_covariance": covariance}
        out[f"{name}_bound"] = bound(maps[0], wrong.noise, with_drift=drift)
    return out


# ------------------------------------------------------------------ tables


def errors_table(found: Seed, strain: str) -> Iterable[str]:
    """Return coverage and spread of the six errors, at the carriage and at the tool."""
    scores = {
        name: found[f"{strain}{name}"] / np.sqrt(np.diagonal(found[f"{strain}{name}_covariance"], axis1=-2, axis2=-1))
        for name in ("", "_tool")
    }
    yield (
        "| error | coverage of 95 % intervals | spread/stated | bias/stated | stated (k = 1) | "
        "at the tool: coverage | stated |"
    )
    yield "|---|---|---|---|---|---|---|"
    for k, name in enumerate(DOF):
        here, tool = scores[""][..., k], scores["_tool"][..., k]
        u, u_tool = (np.sqrt(found[f"{strain}{at}_covariance"][..., k, k]) for at in ("", "_tool"))
        yield (
            f"| {name}Y | {coverage(here)} | {rms(here):.3f} | {np.nanmean(here):+.3f} | {quantity(u, k)} | "
            f"{coverage(tool)} | {quantity(u_tool, k)} |"
        )
    lost = np.isnan(scores[""][..., 0]).mean()
    yield ""
    yield (
        f"All six together, NEES/6: {mean_of(nees(found[strain], found[f'{strain}_covariance']))} (1 is right). "
        f"Scans without a result, or omitted because a motion of the artefact was assumed: {lost:.2%}."
    )


def curves_table(found: Seed) -> Iterable[str]:
    """Return the coverage of the smooth curves, point by point."""
    yield "Point by point along the curves; data for a curve over position exist only at the artefacts."
    yield ""
    yield "| error | over position, free | guided | over time, free | guided |"
    yield "|---|---|---|---|---|"
    for k, name in enumerate(DOF):
        cells = [
            coverage(found[f"{strain}_{over}"][..., k] / found[f"{strain}_{over}_u"][..., k])
            for over in ("position", "time")
            for strain in STRAINS
        ]
        yield f"| {name}Y | " + " | ".join(cells) + " |"


def pose_table(found: Seed) -> Iterable[str]:
    """Return coverage and efficiency of the pose of the profiler."""
    expected = METHOD.plan(CrossbeamScanSettings(procedure="profiler_pose", profiler_pose=PoseSettings(dz=LIFT)))
    bounds = np.sqrt(np.diagonal(expected["covariance"].values[0]))[[3, 4, 5, 0, 1, 2]]
    error, u = found["pose"], np.sqrt(np.diagonal(found["pose_covariance"], axis1=-2, axis2=-1))
    yield (
        "Two scans of a circular pocket, 16 mm apart in height. The bound is that of the plan, with a scatter of the "
        f"edge of {Layout().edge * 1e6:g} um in each line."
    )
    yield ""
    yield "| parameter | coverage of 95 % intervals | spread/stated | bias/stated | stated (k = 1) | spread/bound |"
    yield "|---|---|---|---|---|---|"
    for k, name in enumerate(PARAMETERS):
        score = error[:, k] / u[:, k]
        yield (
            f"| {name} | {coverage(score)} | {rms(score):.3f} | {score.mean():+.3f} | "
            f"{quantity(u[:, k], (k + 3) % 6)} | {rms(error[:, k]) / bounds[k]:.2f} |"
        )
    yield ""
    yield f"All six together, NEES/6: {mean_of(nees(error, found['pose_covariance']))}."


def registration_table(found: Seed) -> Iterable[str]:
    """Return efficiency and coverage of single registrations."""
    yield (
        f"{len(found[REGISTRATIONS[0][0]])} pairs of scans of {FINE_POINTS} points {FINE_PITCH * 1e6:g} um apart by "
        f"{LINES} lines, moved by 20 um and 20 urad (k = 1). The bound is that of white noise in all points of both "
        "scans, without line jitter."
    )
    for name, wrong, drift in REGISTRATIONS:
        n = 9 if drift else 6
        error, covariance = found[name][:, :n], found[f"{name}_covariance"][:, :n, :n]
        u, limit = (np.sqrt(np.diagonal(C[:, :n, :n], axis1=1, axis2=2)) for C in (covariance, found[f"{name}_bound"]))
        white = wrong.jitter_z == 0
        yield from ("", f"{name}: NEES/{n} {mean_of(nees(error, covariance))} against the stated covariance", "")
        yield "| freedom | coverage of 95 % intervals | spread/stated | stated (k = 1) |" + white * " spread/bound |"
        yield "|---|---|---|---|" + white * "---|"
        for k, freedom in enumerate((*DOF, *FEED_NAMES)[:n]):
            shown = f"{np.median(u[:, k]) * 1e6:.2f}e-6" if k >= 6 else quantity(u[:, k], k)
            yield (
                f"| {freedom} | {coverage(error[:, k] / u[:, k])} | {rms(error[:, k] / u[:, k]):.3f} | {shown} |"
                + white * f" {rms(error[:, k] / limit[:, k]):.3f} |"
            )


# ------------------------------------------------------------------ figures


def rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.nanmean(np.square(values))))


def quantity(u: np.ndarray, freedom: int) -> str:
    """Return the middle of standard uncertainties, of a length for the first three freedoms."""
    size, unit = np.nanmedian(u), "m" if freedom < 3 else "rad"
    return f"{size * 1e6:.2f} u{unit}" if size > 0.5e-6 else f"{size * 1e9:.1f} n{unit}"


def coverage(score: np.ndarray) -> str:
    """Return the share of errors within 1.96 standard uncertainties, seeds first, and its 95 % interval over seeds."""
    inside = np.where(np.isfinite(score), np.abs(score) <= Z95, np.nan).reshape(len(score), -1)
    share, of_seed = np.nanmean(inside), np.nanmean(inside, axis=1)
    return f"{share:.1%} +- {Z95 * np.nanstd(of_seed, ddof=1) / np.sqrt(len(of_seed)):.1%}"


def nees(error: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """Return the squared error in units of the covariance, per freedom, by seed (seed, rest)."""
    scale = np.sqrt(np.diagonal(covariance, axis1=-2, axis2=-1))
    e = np.where(np.isfinite(error), error / scale, 0.0)
    C = np.where(
        np.isfinite(covariance), covariance / (scale[..., :, None] * scale[..., None, :]), np.eye(scale.shape[-1])
    )
    ratio = np.einsum("...i,...i->...", e, np.linalg.solve(C, e[..., None])[..., 0]) / scale.shape[-1]
    return np.where(np.isfinite(error).all(axis=-1), ratio, np.nan).reshape(len(error), -1)


def mean_of(values: np.ndarray) -> str:
    """Return the mean of (seed, rest) with its 95 % interval over seeds."""
    of_seed = np.nanmean(values, axis=1)
    return f"{np.nanmean(values):.2f} +- {Z95 * np.nanstd(of_seed, ddof=1) / np.sqrt(len(of_seed)):.2f}"
