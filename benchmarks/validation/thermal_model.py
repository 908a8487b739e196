"""A thermal model of two warm-ups against a third with another speed profile, all of them measured by probing."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Iterator

import numpy as np

from errormotion.compensation.thermal_model import check, fit
from errormotion.kinematics.iso import DOF
from errormotion.methods.normal_vector import NormalVector, NormalVectorSettings, simulation
from errormotion.twin import Event, VirtualMachine

TITLE = "Thermal model"
SEEDS = 12
#: three hours, a probing cycle every ten minutes, s
BEGINS, CYCLE = 600.0 * np.arange(19), 120.0
#: spindle speeds (1/min) from times on (min): two warm-ups for the fit, one for the assessment
PROFILES = (
    ((2, 6000), (60, 12000), (120, 0)),
    ((2, 15000), (40, 3000), (100, 9000)),
    ((2, 10000), (30, 0), (60, 14000), (90, 5000), (150, 12000)),
)
OFF = {"X": False, "Y": False, "Z": False}


def section(seeds: int) -> Iterator[str]:
    """Yield the lines of the section."""
    logging.getLogger("errormotion").setLevel(logging.ERROR)
    said = ", then ".join(", ".join(f"{speed} /min from {at} min" for at, speed in profile) for profile in PROFILES)
    yield (
        f"{seeds} virtual machines of each kind warm up three times for {BEGINS[-1] / 3600:g} h, without the "
        f"compensation of the control, and are probed every {BEGINS[1] / 60:g} minutes ({said}). A thermal model, "
        "selected by cross-validation, is fitted to the first two and predicts the third. `removed`: share of the "
        "RMS that the prediction removes, of the measured errors and of the true ones; `held`: share of times at "
        "which measured minus predicted, or true minus predicted, is within its 95 % interval. For the displacement, "
        "the RMS is that of its length at the centre of the balls. The misfit of a model is one draw for a whole "
        "warm-up, so that `held` varies from machine to machine; the lowest value of a machine is stated in addition "
        "to the mean."
    )
    yield from (
        "",
        "| machine | errors | RMS | removed (measured) | lowest | removed (true) | held (measured) | lowest "
        "| held (true) |",
        "|---|---|---|---|---|---|---|---|---|",
    )
    notes = []
    for kind in ("gantry", "cframe"):
        rows, note = judged(kind, seeds)
        yield from rows
        notes.append(note)
    yield from ("", *notes)


def judged(kind: str, seeds: int) -> tuple[list[str], str]:
    """Return the rows of one kind of machine, and the sensors of the models."""
    method = NormalVector()
    sizes: dict[str, list] = {"displacement": [], "turn": []}
    sensors, variants = Counter(), Counter()
    for seed in range(seeds):
        machine = VirtualMachine(kind, seed=seed)
        campaigns = []
        for number, profile in enumerate(PROFILES):
            events = [Event(60.0 * at, float(speed), OFF if i == 0 else None) for i, (at, speed) in enumerate(profile)]
            machine.start(events)
            raw = simulation.raw(machine, BEGINS, seed=10 * seed + number, cycle=CYCLE)
            campaigns.append(method.identify(raw, NormalVectorSettings(noise="stated", functional_point=POINTS[kind])))
        model = fit(campaigns[:2])
        found = check(model, campaigns[2])
        truth = machine.truth_probing(campaigns[2]["time"].values, campaigns[2].attrs["functional_point"])
        true = np.column_stack([truth[name].values - float(truth[name][0]) for name in DOF])
        predicted = np.column_stack([found.predicted[name].values for name in DOF])
        u = np.sqrt(np.einsum("tkk->tk", found.predicted["covariance"].values))
        inside = np.abs(true - predicted) <= 1.96 * u
        sensors.update(model.sensors)
        variants[str(model.dataset.attrs["variant"])] += 1
        for name, part in (("displacement", slice(0, 3)), ("turn", slice(3, 6))):
            seen = np.flatnonzero(np.isfinite(found.rms[part])) + part.start
            before, after = (np.sqrt((each[seen] ** 2).sum()) for each in (found.rms, found.remaining))
            real, left = (np.sqrt((each[:, seen] ** 2).mean(axis=0).sum()) for each in (true, true - predicted))
            sizes[name].append(
                (before, 1 - after / before, 1 - left / real, found.held[seen].mean(), inside[1:, seen].mean())
            )
    rows = []
    for name, values in sizes.items():
        mean, least = np.mean(values, axis=0), np.min(values, axis=0)
        size = f"{mean[0] * 1e6:.1f} um" if name == "displacement" else f"{np.degrees(mean[0]) * 3600:.1f} arcsec"
        rows.append(
            f"| {kind} | {name} | {size} | {mean[1]:.1%} | {least[1]:.1%} | {mean[2]:.1%} | {mean[3]:.1%} "
            f"| {least[3]:.1%} | {mean[4]:.1%} |"
        )
    chosen = ", ".join(f"{name} ({count})" for name, count in sensors.most_common())
    made = ", ".join(f"{name} {count}" for name, count in variants.most_common())
    return rows, f"Sensors in the models of the {kind} (number of models of {seeds}): {chosen}. Variants: {made}."


#: functional point, m: the centre of the balls
POINTS = {
    kind: tuple(np.round(VirtualMachine(kind).balls.nominal[:4].mean(axis=0), 4)) for kind in ("gantry", "cframe")
}
