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
"""Share of excluded readings above which a moved station is searched for."""


def evaluate_scatter(state: State) -> None:
    """Set repeatability, scatter and noise factor of the state, and add notes.

    Raises
    ------
    MethodError
        A station was moved between its readings.
    """
    data, settings, network = state.data, state.settings, state.network
    if settings.together:
        state.machine = repeatability.from_positions(state.machine, network, positions(data.nominal), 1.0, state.notes)
    _set_noise_factor(state)
    if data.station is not None and not swapped_stations(network.station, network.approximate):
        off = np.linalg.norm(network.station - data.station, axis=1)
        for j in np.flatnonzero(off > settings.station_tolerance):
            state.notes.append(
                f"Station {data.stations[j]} is {off[j] * 1e3:.3g} mm from its approximate position. Check this "
                "position, and that the targets are stated in machine coordinates."
            )


def _set_noise_factor(state: State) -> None:
    """Set the noise factor, its parts, and the repeatability; raise MethodError if a station was moved."""
    network, machine, data, settings = state.network, state.machine, state.data, state.settings
    freedom, excluded = network.freedom, len(network.left_out) + 4 * len(network.undecided)
    known_to = 0.0 if settings.together else machine.spread / (data.noise**2 + machine.variance)
    excess = freedom > 0 and repeatability.exceeds(network, known_to)
    if excess or excluded > MANY_EXCLUDED * np.isfinite(state.displacement).sum():
        refuse_move(state, network.station, None)
    increase = settings.noise == "auto"
    state.factor, state.scatter, state.machine = repeatability.explained(
        machine, network, data.noise, increase=increase, together=settings.together
    )
    if excess:
        action = (
            "the uncertainties are increased accordingly" if increase else "the stated noise is used (noise = stated)"
        )
        cause = "" if settings.together or machine.sources else " Possible cause: repeatability of the machine."
        state.notes.append(
            f"The scatter of the readings is {network.sigma0:.3g} times the stated one; {action}.{cause}"
        )
    elif freedom > 0 and known_to == 0 and network.sigma0**2 * freedom < chdtri(freedom, 1 - FALSE_ALARM):
        state.notes.append(
            f"The scatter of the readings is only {network.sigma0:.3g} times the stated one; the stated noise is used."
        )
    updated = state.machine
    if "returns" in updated.sources and updated.variance > 2 * updated.spread:
        state.notes.append(
            f"The repeatability of the machine is {updated.value * 1e6:.2g} um (standard deviation of a coordinate, "
            f"standard uncertainty {updated.uncertainty * 1e6:.1g} um), from {updated.source}."
        )


def refuse_move(state: State, stations: Array | None, error: Exception | None) -> None:
    """Raise MethodError if the readings are explained by a station that was moved between them.

    ``stations`` are approximate positions (n, 3), m; ``error`` is the error of the solution, if it failed.
    """
    data = state.data
    move = find_move(state.displacement, data.nominal, stations, state.noise(), data.time)
    if move is None:
        return
    name, target = data.stations[move.station], data.targets[move.target]
    raise MethodError(
        f"Expected every station at rest; station {name} was moved by about {move.distance * 1e3:.3g} mm before target "
        f"{target}: the scatter of the readings is {move.sigma0:.3g} times their noise with two stations, and "
        f"{move.sigma0_before:.3g} times with one. Measure this set-up again, or state its readings from this target "
        "on as a separate station. A drifting set-up has the same effect: measure some of its targets twice."
    ) from error
