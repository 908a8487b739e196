"""Rates of comparisons of different methods on one virtual machine, and of datasets that share sources."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import xarray as xr
from scipy.stats import kstest

from errormotion import datasets, plugins
from errormotion.compare import compare
from errormotion.methods.normal_vector import simulation as probing
from errormotion.methods.spindle_drift import simulation as drifting
from errormotion.twin import Event, VirtualMachine
from validation.comparisons.drawn import START, Drawn, at
from validation.comparisons.pool import Pool

Z95 = 1.959964
STEP, INTERVAL, DURATION = 20.0, 600.0, 7200.0
AVERAGED = 400_000
"""Number of samples in the mean of one step at 20 kHz."""
UNSEEN = 5e-6
"""Rotation about the spindle axis, which is not measured with the bar, as large as on this machine, rad."""
POINT = {"functional_point": (0.0, 0.0, 0.0)}
DISPLACEMENTS = ("EX", "EY", "EZ")


def identified(method: str, raw: xr.Dataset, **settings: object) -> xr.Dataset:
    """Return the result of a method on raw data that start at the common instant."""
    cls = plugins.get("methods", method)
    return cls().identify(raw.assign_attrs(start=START), cls.Settings.model_validate(settings))


def warm_machine(seed: int, kind: str = "cframe") -> VirtualMachine:
    """Return a machine that is at rest for two minutes and then turns its spindle."""
    machine = VirtualMachine(kind, seed=seed)
    machine.start([Event(120.0, 12000.0, None)])
    return machine


def drift(machine: VirtualMachine, seed: int, **settings: object) -> xr.Dataset:
    """Return the result of five sensors around a bar, with the beams of the calibration of the machine."""
    beams = drifting.calibrated_beams(machine, machine.seed)
    times = np.arange(STEP / 2, DURATION, STEP)
    raw = drifting.raw_drift(
        machine, times, seed=seed, beams=beams, averaged=AVERAGED, warm_up=False, radius_error=False
    )
    return identified("spindle_drift", raw, noise="stated", **POINT, **settings)


def methods(seed: int) -> dict:
    """Compare a bar with sensors and probed balls; the uncertainty of the unmeasured rotation is its true size."""
    return _methods(seed, unseen_rotation=UNSEEN)


def cautious(seed: int) -> dict:
    """Compare the same with the default for this rotation, which is larger than on this machine."""
    return _methods(seed)


def gantry(seed: int) -> dict:
    """Compare the same on a gantry, with the rotation about X, which both measure there."""
    return _methods(seed, "gantry", (*DISPLACEMENTS, "EA"))


def _methods(seed: int, kind: str = "cframe", freedoms: tuple[str, ...] = DISPLACEMENTS, **settings: object) -> dict:
    logging.getLogger("errormotion").setLevel(logging.ERROR)
    machine = warm_machine(seed, kind)
    balls = probing.raw(machine, np.arange(0.0, DURATION - INTERVAL, INTERVAL), seed=seed)
    sets = {
        "drift": drift(machine, seed, **settings),
        "probing": identified("normal_vector", balls, **({"tool_axes": "Z"} if kind == "cframe" else {}), **POINT),
    }
    return {"shared": counted(sets, _truth(machine), {"freedoms": freedoms})}


def records(seed: int) -> dict:
    """Compare two records of one warm-up with the same calibrated beams and other noise."""
    logging.getLogger("errormotion").setLevel(logging.ERROR)
    machine = warm_machine(seed)
    sets = {"one": drift(machine, 2 * seed), "other": drift(machine, 2 * seed + 1)}
    return _judged(sets, _truth(machine), freedoms=DISPLACEMENTS)


def _truth(machine: VirtualMachine):
    def errors(t: np.ndarray) -> np.ndarray:
        return np.asarray(machine.truth_spindle(t + STEP / 2, (0.0, 0.0, 0.0)).em.twist())

    return errors


def drawn(task: tuple[int, bool]) -> dict:
    """Compare three datasets with a common bar and thermometer; ``opposite``: with inverted sign in the third one."""
    seed, opposite = task
    found = {}
    rng = np.random.default_rng([seed, 7])
    z = {"bar": rng.normal(), "thermometer": rng.normal()}
    for name, sign in (("A", 1.0), ("B", -1.0 if opposite else 1.0)):
        each = at(seed, 240.0, name)
        found[name] = replace(each, sources=_shared(each, sign), ids={"bar": "bar 7", "thermometer": "sensor 3"})
    E = at(seed, 240.0, "A")
    return _judged({name: each.dataset(rng, z) for name, each in found.items()}, lambda t: E.values[np.isin(E.time, t)])


def _shared(each: Drawn, sign: float) -> Mapping[str, np.ndarray]:
    heat = each.temperature[:, 1] - each.temperature[0, 1]
    return {
        "bar": sign * 0.05 * each.values * [1, 1, 1, 0, 0, 0],
        "thermometer": sign * 1e-7 * np.multiply.outer(heat, [0, 1, 1, 10, 0, 0]),
    }


def _judged(sets: Mapping[str, xr.Dataset], truth, **options: object) -> dict:
    """Return the counts, with the identities of the sources and without them."""
    apart = {name: ds.assign_coords(source_id=("source", [""] * ds.sizes["source"])) for name, ds in sets.items()}
    return {"shared": counted(sets, truth, options), "apart": counted(apart, truth, options)}


def counted(sets: Mapping[str, xr.Dataset], truth, options: Mapping) -> dict:
    """Return the counts of a comparison over time, in which the first instant is the reference."""
    found = compare(sets, causes=False, **options)
    freedoms = [datasets.DOF.index(name) for name in found["dof"].values]
    E = truth(found["time"].values)[:, freedoms]
    return against(found, E - E[0])


def against(found: xr.Dataset, E: np.ndarray) -> dict:
    """Return which values of a comparison agree, and which intervals of its consensus contain the truth."""
    u = np.sqrt(np.diagonal(found["consensus_covariance"].values, axis1=1, axis2=2))
    known = np.isfinite(found["en"].values[0]) & (u > 0)
    score = (found["consensus"].values[known] - E[known]) / u[known]
    return {
        "en": np.abs(found["en"].values[0][known]) <= 1,
        "p": found["p"].item(),
        "held": np.abs(score) <= Z95,
    }


CASES = (
    ("bar before sensors, probed balls", methods, None),
    ("the same, rotation about the spindle: default", cautious, None),
    ("the same on a gantry, with EA", gantry, None),
    ("two records with the same beams", records, None),
    ("one bar and one thermometer in both", drawn, False),
    ("the same, seen inverted by one of them", drawn, True),
)


def section(seeds: int, pool: Pool) -> list[str]:
    """Return the lines of the section."""
    rows = []
    for name, function, option in CASES:
        runs = pool.mapped(function, [seed if option is None else (seed, option) for seed in range(seeds)])
        rows += [row(name, "as stated", [run["shared"] for run in runs])]
        if "apart" in runs[0]:
            rows += [row("", "left out", [run["apart"] for run in runs])]
    return [
        f"{seeds} virtual machines each. The first four cases are results of methods on simulated raw data of one "
        f"machine that warms up for two hours, a C-frame or a gantry: a bar before five sensors (every {STEP:g} s) "
        f"and four balls probed every {INTERVAL / 60:g} minutes; displacements at the origin. The rotation about the "
        f"spindle axis, which is not measured with the bar, is stated as {UNSEEN * 1e6:g} urad, its size on a "
        "C-frame; with the default of 20 urad, intervals are wider. The last two cases are drawn from their own "
        "covariance about the true errors of a gantry: six freedoms, a bar whose radius scales the displacements by "
        "5 % (k = 1), and a thermometer. `correlation`: sources with the same identity are one draw (as stated) or "
        "independent (left out). Of datasets that agree 95.4 % of the |En| are below 1 (k = 2), p is uniform, and 95 "
        "% of the 95 % intervals of the consensus contain the true errors. After ±: standard error of the mean over "
        "machines, because the instants of one machine share their sources.",
        *HEAD,
        *rows,
    ]


HEAD = (
    "",
    "| datasets | correlation | abs(En) <= 1 | p uniform (Kolmogorov-Smirnov) | p < 0.05 | consensus: coverage |",
    "|---|---|---|---|---|---|",
)


def row(name: str, how: str, runs: list[dict]) -> str:
    """Return one row of the table."""
    en, held = (_share([run[key].mean() for run in runs]) for key in ("en", "held"))
    p = np.array([run["p"] for run in runs])
    return f"| {name} | {how} | {en} | {_p(kstest(p, 'uniform').pvalue)} | {np.mean(p < 0.05):.1%} | {held} |"


def _share(means: list[float]) -> str:
    return f"{np.mean(means):.1%} ± {np.std(means) / np.sqrt(len(means)):.1%}"


def _p(p: float) -> str:
    return "< 0.0001" if p < 1e-4 else f"{p:.2g}"
