"""Repeatability of the machine: its estimation from returns, and the coverage of intervals.

``python -m benchmarks.multilateration_repeatability [--machines 100]``

Virtual C-frames with 48 targets, four successive stations, 0.5 um noise of a length: the repeatability found, its
scatter over the machines, its mean stated uncertainty, um, and the share of true errors within 95 % intervals.
"""

from __future__ import annotations

import argparse
import logging

import numpy as np

from errormotion.methods.multilateration import Multilateration, MultilaterationSettings, simulation
from errormotion.twin import VirtualMachine

COORDINATES = ("EX", "EY", "EZ")
CASES = (
    (0.0, 6, None, 0.0),
    (0.5e-6, 6, None, 0.0),
    (2e-6, 6, None, 0.0),
    (2e-6, 6, 1.8e-6, 0.3e-6),
    (2e-6, 0, 2e-6, 0.0),
    (2e-6, 0, None, 0.0),
)  # true repeatability, returns, stated repeatability and its uncertainty


def one(seed: int, true: float, returns: int, settings: MultilaterationSettings) -> tuple[float, float, float]:
    """Return the share within 95 % of one machine, the estimated repeatability and its uncertainty, m."""
    machine = VirtualMachine("cframe", seed=seed)
    q = simulation.target_grid(machine, (4, 4, 3))
    if returns:
        q = np.concatenate([q, q[:: len(q) // returns][:returns]])
    found = Multilateration().identify(simulation.raw(machine, q, seed=seed, repeatability=true), settings)
    truth = simulation.true_errors(machine, q)
    left = np.stack([found[name].values - truth[name].values for name in COORDINATES], axis=-1)
    u = np.sqrt(np.einsum("tii->ti", found["covariance"].values[:, :3, :3]))
    reported = [float(found[name]) if name in found else float("nan") for name in ("repeatability", "repeatability_u")]
    return float(np.mean(np.abs(left) < 1.96 * u)), reported[0], reported[1]


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--machines", type=int, default=100)
    machines = parser.parse_args().machines
    logging.disable()
    print("true/um  returns  stated/um        found/um  its u/um  within 95 %")
    for true, returns, stated, uncertain in CASES:
        settings = MultilaterationSettings(parametric=False, repeatability=stated, repeatability_uncertainty=uncertain)
        each = np.array([one(seed, true, returns, settings) for seed in range(machines)])
        words = "-" if stated is None else f"{stated * 1e6:.1f} +- {uncertain * 1e6:.1f}"
        found = "-" if np.isnan(each[0, 1]) else f"{each[:, 1].mean() * 1e6:.2f} +- {each[:, 1].std() * 1e6:.2f}"
        u = "-" if np.isnan(each[0, 2]) else f"{each[:, 2].mean() * 1e6:.2f}"
        held = f"{100 * each[:, 0].mean():.1f} +- {100 * each[:, 0].std() / np.sqrt(machines):.1f}"
        print(f"{true * 1e6:>7.1f} {returns:>8} {words:>10} {found:>15} {u:>9} {held:>12}", flush=True)


if __name__ == "__main__":
    main()
