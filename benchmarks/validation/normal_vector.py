"""Balls touched by the machine: spread against the bound, coverage, loss of the normals of planes."""

from __future__ import annotations

import logging
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from errormotion.kinematics.iso import DOF
from errormotion.methods.normal_vector import NormalVector, NormalVectorSettings, simulation
from errormotion.methods.normal_vector.identification.freedoms import Motion
from errormotion.twin import Event, VirtualMachine

sys.path.append(str(Path(__file__).parents[2] / "tests" / "support"))
from probing_bound import bound

TITLE = "Balls touched by the machine"
SEEDS = 300
Z95 = 1.959964
#: draws of the noise on each machine
DRAWS = 8
#: a probing cycle every ten minutes of the first hour, s; the spindle runs from the end of the cold one on
BEGINS, CYCLE, SPEED = 600.0 * np.arange(7), 120.0, 12000.0
BALLS, TOUCHES = 4, 5


def section(seeds: int) -> Iterator[str]:
    """Yield the lines of the section."""
    logging.getLogger("errormotion").setLevel(logging.ERROR)
    found = {kind: honesty(kind, seeds) for kind in ("gantry", "cframe")}
    deviation = np.sqrt((0.5 + 1.5 / (len(BEGINS) - 1)) / (seeds * DRAWS)) / 2
    yield (
        f"{seeds} virtual machines of each kind, {DRAWS} draws of the noise on each: {BALLS} balls, {TOUCHES} touches "
        f"of each with 0.25 um noise, in {len(BEGINS)} cycles of {CYCLE:g} s, one every {BEGINS[1] / 60:g} minutes; "
        f"the spindle turns at {SPEED:g} /min from the end of the cold cycle on. The touches include pre-travel with "
        "three lobes, the form of the balls and geometric errors of the machine. Errors are relative to the cold "
        "cycle, at the centre of the balls; their coverage is the mean over the cycles. The ratio of spread to bound "
        f"has a standard deviation of about {deviation:.1%} (half of each variance is that of the cold cycle, one "
        "draw for all others)."
    )
    for kind, (rows, text) in found.items():
        yield from (
            "",
            f"### {'A gantry: all axes move the tool' if kind == 'gantry' else 'A C-frame: X and Y move the table'}",
            "",
            text,
            "",
            "| | bound | spread/bound | stated/bound | coverage of 95 % intervals | normals: stated loss | spread |",
            "|---|---|---|---|---|---|---|",
            *rows,
        )
    yield from ("", "### A C-frame, evaluated as a gantry", "", *wrong(min(seeds, 20)))


def probed(kind: str, seed: int, draw: int = 0):
    """Return machine and raw dataset of a warm-up."""
    machine = VirtualMachine(kind, seed=seed)
    machine.start((Event(time=CYCLE, spindle_speed=SPEED),))
    return machine, simulation.raw(machine, BEGINS, seed=draw, balls=BALLS, touches=TOUCHES, cycle=CYCLE)


def off(machine: VirtualMachine, errors) -> np.ndarray:
    """Return the truth relative to the cold cycle, (cycle, 6)."""
    truth = machine.truth_probing(errors["time"].values, errors.attrs["functional_point"])
    values = np.stack([truth[name].values for name in DOF], axis=-1)
    return values - values[0]


def vectors(errors) -> np.ndarray:
    return np.stack([errors[name].values for name in DOF], axis=-1)


def least(machine: VirtualMachine, errors, raw) -> np.ndarray:
    """Return the bound of the standard uncertainties, (cycle, 6)."""
    normal = np.tile(simulation.touch_normals(TOUCHES), (BALLS, 1, 1))
    balls = machine.balls_on_table(BALLS)
    place = balls.centre[:, None] + (balls.nominal_radius + machine.probe.tip_radius) * normal
    motion = Motion(machine.tool_axes, np.asarray(errors.attrs["functional_point"]))
    C = bound(
        place, normal, motion,
        noise=float(raw["touch_noise"]), time=errors["time"].values, touch_time=raw["touch_time"].values,
    )  # fmt: skip
    return np.sqrt(np.einsum("kii->ki", C))


def honesty(kind: str, seeds: int) -> tuple[list[str], str]:
    """Spread against the bound and coverage, every seed another machine."""
    method, settings = NormalVector(), NormalVectorSettings(noise="stated")
    z, spread, stated, loss, lost, largest, alarms = [], [], [], [], [], [], 0
    for seed in range(seeds):
        for draw in range(DRAWS):
            machine, raw = probed(kind, seed, draw)
            errors = method.identify(raw, settings)
            if not draw:
                u_least = least(machine, errors, raw)[1:]
                true = off(machine, errors)
            alarms += int((errors["left_out"].values > 1).any())
            error = (vectors(errors) - true)[1:]
            u = np.sqrt(np.einsum("kii->ki", errors["covariance"].values))[1:]
            z.append(error / u)
            spread.append(error / u_least)
            stated.append(u / u_least)
            loss.append(errors["normals_loss"].values[1:])
            lost.append((errors["normals_errors"].values - true)[1:] / u_least)
            largest.append(np.abs(true[-1]))
    rms = [np.sqrt(np.mean(np.square(part), axis=(0, 1))) for part in (spread, stated, lost)]
    held = np.mean(np.abs(z) <= Z95, axis=(0, 1))
    losses = np.mean(loss, axis=(0, 1))
    scale, unit = np.array([1e6] * 3 + [np.degrees(3600)] * 3), ["um"] * 3 + ["arcsec"] * 3
    rows = []
    for k, name in enumerate(DOF):
        if np.isnan(rms[0][k]):
            rows.append(f"| {name} | not seen | | | | | |")
            continue
        normals = f"{losses[k]:.2f} | {rms[2][k]:.2f}" if np.isfinite(losses[k]) else "- | -"
        rows.append(
            f"| {name} | {u_least[-1, k] * scale[k]:.3f} {unit[k]} | {rms[0][k]:.3f} | {rms[1][k]:.3f} | "
            f"{held[k]:.1%} | {normals} |"
        )
    size = ", ".join(f"{name} {np.mean(largest, axis=0)[k] * scale[k]:.1f} {unit[k]}" for k, name in enumerate(DOF))
    return rows, (
        f"Mean size of the true error at the end: {size}. In {alarms} of {seeds * DRAWS} records a correct touch was "
        "rejected, or a ball was reported as moved."
    )


def wrong(seeds: int) -> list[str]:
    """Result of the assumption of a rigid motion of the balls on a machine whose table moves."""
    ratio, off_by, named = [], [], 0
    for seed in range(seeds):
        machine, raw = probed("cframe", seed)
        del raw.attrs["tool_axes"]
        errors = NormalVector().identify(raw, NormalVectorSettings(tool_axes="XYZ", robust=False))
        named += any("scatter" in note for note in errors.attrs["notes"])
        ratio.append(float(errors["noise"]) / float(raw["touch_noise"]))
        off_by.append((vectors(errors) - off(machine, errors))[-1])
    size = np.sqrt(np.mean(np.square(off_by), axis=0))
    turn = np.degrees(size[3:]) * 3600
    return [
        f"The same touches, with `tool_axes` set to XYZ, on {seeds} machines: the touches then scatter "
        f"{np.mean(ratio):.2f} times as much as stated on average; {named} of {seeds} results contain a warning, and "
        f"the errors at the end deviate by (rms) {size[0] * 1e6:.2f}, {size[1] * 1e6:.2f} and {size[2] * 1e6:.2f} um, "
        f"{turn[0]:.2f}, {turn[1]:.2f} and {turn[2]:.2f} arcsec.",
    ]
