"""Comparison of the scatter of the readings with what is stated, and of the stations with their stated positions."""

from __future__ import annotations

import numpy as np
from scipy.special import chdtri

from errormotion.arrays import Array
from errormotion.errors import MethodError
from errormotion.methods.multilateration.identification import repeatability
from errormotion.methods.multilateration.identification.drift import positions
from errormotion.methods.multilateration.identification.moving import find_move
from errormotion.methods.multilateration.identification.state import State
from errormotion.methods.multilateration.network.diagnosis.determinacy import swapped_stations

FALSE_ALARM = 1e-3
"""Probability of a note on readings that scatter as stated."""
MANY_EXCLUDED = 0.05
"""Share of excluded readings above which a moved station is looked for."""


def judge(state: State) -> None:
    """Set repeatability, scatter and noise factor of the state, and add notes.

    Raises
    ------
    MethodError
        A station was moved between its readings.
    """
    data, settings, network = state.data, state.settings, state.network
    if settings.together:
        state.machine = repeatability.from_positions(state.machine, network, positions(data.nominal), 1.0, state.notes)
    _judge_scatter(state)
    if data.station is not None and not swapped_stations(network.station, network.rough):
        off = np.linalg.norm(network.station - data.station, axis=1)
        for j in np.flatnonzero(off > settings.station_tolerance):
            state.notes.append(
                f"Station {data.stations[j]} was found {off[j] * 1e3:.3g} mm from its approximate position. Check that "
                "position, and that the targets are given in the coordinates of the machine."
            )
    if settings.scale_uncertainty > 0:
        state.scale["tracker scale"] = settings.scale_uncertainty
    if not network.converged:
        state.notes.append(
            f"The network has not converged after {network.iterations} iterations; its results are approximate."
        )


def _judge_scatter(state: State) -> None:
    """Set by how much the noise is raised, its parts, and the repeatability; refuse readings of a moved station."""
    network, machine, data, settings = state.network, state.machine, state.data, state.settings
    freedom, excluded = network.freedom, len(network.left_out) + 4 * len(network.undecided)
    known_to = 0.0 if settings.together else machine.spread / (data.noise**2 + machine.variance)
    excess = freedom > 0 and repeatability.exceeds(network, known_to)
    if excess or excluded > MANY_EXCLUDED * np.isfinite(state.displacement).sum():
        refuse_move(state, network.station, None)
    raised = settings.noise == "auto"
    state.factor, state.scatter, state.machine = repeatability.explained(
        machine, network, data.noise, raise_it=raised, together=settings.together
    )
    if excess:
        action = "the uncertainties are raised to match" if raised else "the stated noise was kept (noise = stated)"
        cause = "" if settings.together or machine.sources else " Possible cause: repeatability of the machine."
        state.notes.append(f"The readings scatter {network.sigma0:.3g} times as much as stated; {action}.{cause}")
    elif freedom > 0 and known_to == 0 and network.sigma0**2 * freedom < chdtri(freedom, 1 - FALSE_ALARM):
        state.notes.append(
            f"The readings scatter only {network.sigma0:.3g} times as much as stated; the stated noise was kept."
        )
    found = state.machine
    if "returns" in found.sources and found.variance > 2 * found.spread:
        state.notes.append(
            f"The repeatability of the machine is {found.value * 1e6:.2g} um (standard deviation of a coordinate, "
            f"standard uncertainty {found.uncertainty * 1e6:.1g} um), from {found.source}."
        )


def refuse_move(state: State, stations: Array | None, error: Exception | None) -> None:
    """Raise MethodError where a station that was moved between its readings explains them.

    ``stations`` are approximate positions (n, 3), m; ``error`` is how the solution failed, if it did.
    """
    data = state.data
    move = find_move(state.displacement, data.nominal, stations, state.noise(), data.time)
    if move is None:
        return
    name, target = data.stations[move.station], data.targets[move.target]
    raise MethodError(
        f"Expected every station to stay in its position; station {name} was moved by about {move.distance * 1e3:.3g} "
        f"mm before target {target}: taken as two stations the readings scatter {move.sigma0:.3g} times their noise, "
        f"as one {move.sigma0_before:.3g} times. Measure this set-up again, or give its readings from there on as a "
        "further station. A set-up that drifts has the same effect: return to some targets within it."
    ) from error
