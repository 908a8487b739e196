"""The closed loop: a warm-up is probed, a model fitted to it, and the next two warm-ups are compensated."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace

import numpy as np

from errormotion.cli.demo.closed_loop import Duty, Loop, Speeds, close
from errormotion.compensation.online.prediction import predictor
from errormotion.compensation.thermal_model import ThermalModelSettings
from errormotion.twin import VirtualMachine

TITLE = "Closed loop"
SEEDS = 10
VARIATION = 0.2
"""Largest relative difference of a constant of a machine from that of the table."""
TRAINING: Speeds = ((0.0, 15000.0), (6600.0, 4000.0), (8400.0, 10000.0), (9600.0, 0.0))
"""Of the warm-up to which the model is fitted: the highest temperature of the machine, then cooler."""
SHORTEST, LONGEST = 1200.0, 3600.0
"""Of one speed in a compensated warm-up, s."""


def section(seeds: int) -> Iterator[str]:
    """Yield the lines of the section."""
    duty = Duty()
    yield (
        f"{seeds} virtual machines, alternately C-frames and gantries. Heat capacities, heat flows, and the growth of "
        f"each body differ from the tables by up to {VARIATION:.0%}, independently of each other. A machine warms up "
        "for three hours while four balls are probed every ten minutes; a thermal model is fitted to the result "
        "(responses to temperatures and spindle speed, sensors that warmed by 1 K or more). Two further warm-ups "
        "from the cold state with random speeds (0 to 15000 /min, 20 to 60 min each) follow, each without and with "
        "compensation: every second the model predicts from noisy readings (0.02 K), the state machine of "
        f"`errormotion compensate run` decides, and its offset acts on the tool; limits {1e6 * duty.limits.limit:g} "
        f"um and {1e6 * duty.limits.slew:g} um/s, held while the machine probes. `true`: root mean square of the true "
        "displacement (EX, EY, EZ together) at the functional point over the warm-up, with compensation over "
        "without; `least gain`: the same for the displacement with the smallest improvement. `measured`: 1 minus the "
        "reduction of `errormotion compensate effect`, with its 95 % interval, of the changes since the first cycle. "
        "All in simulated time, without communication and controller."
    )
    for title, first, model in (
        ("At most 2 sensors and 2 time constants", seeds, duty.model),
        ("Sensors and time constants as selected by default", 0, ThermalModelSettings(variant="dynamics")),
    ):
        yield from ("", f"### {title}", "")
        yield from _table(range(first, first + seeds), replace(duty, model=model))
    yield from (
        "",
        "The machines of both tables are different. One warm-up determines few coefficients, and its omitted blocks "
        "have the same speeds: they do not show the validity of the coefficients at other speeds. The selection "
        "therefore adds the variance of the prediction with heat sources that act independently, and requires at "
        "least one sensor. Without both, models were selected that are not followed (limit of U: 20 um), or that "
        "depend only on the speed.",
    )


def _table(seeds: Iterable[int], duty: Duty) -> Iterator[str]:
    yield "| machine | sensors | warm-up | without/um | with/um | true | least gain | measured | following |"
    yield "|---|---|---|---|---|---|---|---|---|"
    remaining: list[float] = []
    for seed in seeds:
        kind = ("cframe", "gantry")[seed % 2]
        loop = closed(kind, seed, duty)
        yield from rows(f"{kind}, {seed}", loop)
        remaining += [each.remaining for each in loop.warm_ups]
    yield from (
        "",
        f"Mean of `true`: {np.mean(remaining):.1%}, largest {np.max(remaining):.1%}; larger than without: "
        f"{sum(each > 1 for each in remaining)} of {len(remaining)}.",
    )


def closed(kind: str, seed: int, duty: Duty) -> Loop:
    """Return the loop of one machine."""
    rng = np.random.default_rng([seed, 15])
    machine = individual(kind, seed, rng)
    return close(machine, TRAINING, [schedule(rng, machine.top_speed, duty.duration) for _ in range(2)], duty)


def individual(kind: str, seed: int, rng: np.random.Generator) -> VirtualMachine:
    """Return a machine whose constants differ from those of its table."""
    machine = VirtualMachine(kind, seed)
    state, network = machine.state, machine.state.network

    def varied(values: np.ndarray) -> np.ndarray:
        return values * rng.uniform(1 - VARIATION, 1 + VARIATION, values.shape)

    links = np.triu(varied(network.conductance))
    machine.state = replace(
        state,
        network=replace(
            network,
            capacity=varied(network.capacity),
            conductance=links + links.T,
            to_air=varied(network.to_air),
        ),
        growth=varied(state.growth),
    )
    machine.start()
    return machine


def schedule(rng: np.random.Generator, top_speed: float, duration: float) -> Speeds:
    """Return random speeds for random times."""
    found, at = [], 0.0
    while at < duration:
        found.append((at, float(np.round(rng.uniform(0, top_speed), -2))))
        at += rng.uniform(SHORTEST, LONGEST)
    return found


def rows(name: str, loop: Loop) -> Iterator[str]:
    """Yield a line for each compensated warm-up."""
    sensors = len(predictor(loop.model.dataset).temperatures)
    for number, each in enumerate(loop.warm_ups, start=2):
        sizes = [1e6 * float(np.sqrt((e**2).sum(axis=1).mean())) for e in (each.true_before, each.true_after)]
        axes = np.sqrt((each.true_after**2).sum(axis=0) / (each.true_before**2).sum(axis=0))
        worst = int(np.argmax(axes))
        gained = each.effect.part("displacement").reduction
        measured = f"{1 - gained.value:.1%} ({1 - gained.high:.1%} to {1 - gained.low:.1%})"
        yield (
            f"| {name} | {sensors} | {number} | {sizes[0]:.2f} | {sizes[1]:.2f} | {each.remaining:.1%} "
            f"| {'XYZ'[worst]} {axes[worst]:.0%} | {measured} | {each.offsets.fraction('following'):.0%} |"
        )
