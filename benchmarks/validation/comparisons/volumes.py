"""Rates of comparisons in the volume: two trackers, and an axis against the targets through the kinematic chain."""

from __future__ import annotations

import numpy as np

from errormotion.compare import compare
from errormotion.compare.comparable import comparable_errors
from errormotion.datasets import DOF
from errormotion.methods.multilateration import Multilateration, MultilaterationSettings, simulation
from errormotion.twin import VirtualMachine
from validation.comparisons.pool import Pool
from validation.comparisons.rates import HEAD, against, row

COUNT, POSITIONS = (6, 6, 5), 9
SCALE = 0.3e-6
"""Relative standard uncertainty of the lengths of a tracker."""
U_AXIS = np.array([2e-7] * 3 + [5e-7] * 3)
"""Standard uncertainty of the axis, m, rad."""
ELSEWHERE = np.array([[0.1, -0.2, 0.0], [-0.2, 0.1, 0.15], [0.15, 0.1, -0.1], [0.0, -0.15, 0.2]])
"""Displacement of the second tracker from the positions of the first, m."""
SHORT = 60
"""Largest number of machines of the comparison through the chain, which takes seconds."""


def tracked(machine: VirtualMachine, q: np.ndarray, seed: int, station: np.ndarray | None = None):
    """Return the errors of targets by one tracker."""
    scale = SCALE * np.random.default_rng([seed, 1]).normal()
    raw = simulation.raw(machine, q, station, seed=seed, scale=scale)
    return Multilateration().identify(
        raw, MultilaterationSettings(noise="stated", scale_uncertainty=SCALE, parametric=False)
    )


def trackers(seed: int) -> dict:
    """Compare the errors of the same targets by two trackers."""
    machine = VirtualMachine("cframe", seed=seed)
    q = simulation.target_grid(machine)
    elsewhere = simulation.stations(machine) + ELSEWHERE
    one, other = tracked(machine, q, 2 * seed), tracked(machine, q, 2 * seed + 1, elsewhere)
    found = compare({"one": one, "other": other}, causes=False)
    freedoms = [DOF.index(name) for name in found["dof"].values]
    return against(found, np.asarray(simulation.true_errors(machine, q).em.twist())[:, freedoms])


def axis(task: tuple[str, str, int]) -> dict:
    """Compare an axis, drawn about its true errors, with targets by a tracker."""
    kind, name, seed = task
    machine = VirtualMachine(kind, seed=seed)
    q = simulation.target_grid(machine, COUNT)
    k = "XYZ".index(name)
    volume = tracked(machine, q, seed)
    truth = machine.truth_axis(name, np.linspace(q[:, k].min(), q[:, k].max(), POSITIONS))
    truth = truth.assign_attrs({each: volume.attrs[each] for each in ("machine", "frame")})
    noise = U_AXIS * np.random.default_rng([seed, k]).normal(size=(POSITIONS, 6))
    measured = truth.assign({each: truth[each] + noise[:, i] for i, each in enumerate(DOF)})
    measured["covariance"] = truth["covariance"] + np.diag(U_AXIS**2)
    truth["covariance"] = truth["covariance"] + 1e-9 * np.diag(U_AXIS**2)
    found = compare({"axis": measured, "volume": volume}, causes=False)
    exact = comparable_errors({"axis": truth, "volume": volume}, freedoms=[str(each) for each in found["dof"].values])
    return against(found, exact.estimates[0].value)


def section(seeds: int, pool: Pool) -> list[str]:
    """Return the lines of the section."""
    few = min(seeds, SHORT)
    rows = [row(f"two trackers ({seeds})", "as stated", pool.mapped(trackers, range(seeds)))]
    for kind, name in (("cframe", "X"), ("gantry", "Y")):
        runs = pool.mapped(axis, [(kind, name, seed) for seed in range(few)])
        rows.append(row(f"{name} of a {kind}, tracker ({few})", "as stated", runs))
    return [
        "Results of multilateration on simulated readings, each with another tracker whose lengths have an error of "
        f"{SCALE * 1e6:g} um/m (k = 1), for the number of machines after each case. Two trackers have different "
        "positions around the same 100 targets of a C-frame. An axis is drawn from its own covariance "
        f"({U_AXIS[0] * 1e6:g} um, {U_AXIS[3] * 1e6:g} urad) about its true errors at {POSITIONS} positions, and "
        f"compared with {np.prod(COUNT)} targets through the kinematic chain. The error motions of the virtual "
        "machine are waves, not draws of the prior with which the errors of the targets are extended to the "
        "positions of the axis, so that these rates need not be exact.",
        *HEAD,
        *rows,
    ]
