"""From displacements to the errors of every target, and to those of the axes.

The steps work on one `State` in sequence: `prepare` reads the data, corrects displacements for the refractive index of
the air, and excludes targets that are weakly determined; `solve` estimates stations and targets; `correct` subtracts
drift and expansion from the readings and solves again; `scatter` compares the scatter with the stated one; `result`
computes uncertainties and builds the error dataset.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import xarray as xr

from errormotion.arrays import Array
from errormotion.errors import MethodError
from errormotion.methods.multilateration.identification import repeatability
from errormotion.methods.multilateration.identification.assumed import assumptions
from errormotion.methods.multilateration.identification.drift import estimate_drift, positions
from errormotion.methods.multilateration.identification.expansion import (
    air_scale,
    along_beams,
    expansion_sources,
    scale_strain,
)
from errormotion.methods.multilateration.identification.result import result
from errormotion.methods.multilateration.identification.scatter import evaluate_scatter, refuse_move
from errormotion.methods.multilateration.identification.state import State, read, short
from errormotion.methods.multilateration.network import solver
from errormotion.methods.multilateration.network.diagnosis.weakness import weak_targets

if TYPE_CHECKING:
    from errormotion.methods.multilateration.identification.drift import Drift
    from errormotion.methods.multilateration.network.network import Network
    from errormotion.methods.multilateration.settings import Settings


def identify_targets(raw: xr.Dataset, settings: Settings, method: str, version: str) -> xr.Dataset:
    """Return an error dataset of component ``tool`` over ``target``: estimated positions minus commanded ones.

    Raises
    ------
    MethodError
        Readings that do not determine the network, contradict one another, or are in another unit.
    """
    return result(estimated(raw, settings), method, version)


def estimated(raw: xr.Dataset, settings: Settings) -> State:
    """Return the solution of raw data, with what their scatter says about the noise."""
    state = prepare(raw, settings)
    solve(state)
    correct(state)
    evaluate_scatter(state)
    return state


def prepare(raw: xr.Dataset, settings: Settings) -> State:
    """Return the state with readings at the refractive index of the air, without weakly determined targets."""
    notes: list[str] = []
    data = read(raw, notes)
    notes += assumptions(raw, settings)
    factor, air = air_scale(raw, settings.air, notes)
    machine = repeatability.stated(settings.repeatability, settings.repeatability_uncertainty)
    state = State(raw, settings, data, notes, data.displacement * factor, air, machine)
    weak = weak_targets(state.displacement, data.nominal, state.stations, state.noise())
    if weak.any():
        state.displacement[:, weak] = np.nan
        names = short([name for name, excluded in zip(data.targets, weak, strict=True) if excluded])
        notes.append(
            f"{int(weak.sum())} of {len(weak)} targets are weakly determined, since they lie nearly in one plane with "
            f"the stations that measured them; their errors are unknown: {names}."
        )
    return state


def solve(state: State) -> None:
    """Solve the network of the present readings, with the uncertainty of the drift as further parameters.

    Raises
    ------
    MethodError
        Readings that do not fit a network; the message states the station if one was moved.
    """
    try:
        state.network = _network(state, state.settings.robust)
    except MethodError as error:
        try:
            _network(state, robust=False)
        except MethodError:  # not the outliers, but the network is the cause
            raise error from None
        refuse_move(state, state.stations, error)
        raise


def _network(state: State, robust: bool) -> Network:
    """Return the network of the present readings and sources."""
    return solver.solve(
        state.displacement, state.data.nominal, state.stations, noise=state.noise(), robust=robust,
        sources=state.sources,
    )  # fmt: skip


def correct(state: State) -> None:
    """Subtract drift and expansion of the scales from the readings, and solve again if that changes them."""
    data, expansion = state.data, state.settings.expansion
    noise, beams, correction = state.noise()[0, 0], state.beams(), np.zeros(())
    if _determines_drift(state):
        state.drift = _drift(state, beams)
        correction = state.drift.correction
    if expansion is not None:
        excess, strain = scale_strain(state.raw, expansion)
        correction = correction + along_beams(strain, data.position - data.position.mean(axis=0), beams)
        state.scales += expansion_sources(excess, data.position, beams, expansion)
    if expansion is not None or correction.any():
        state.displacement = state.displacement - correction
        solve(state)
    elif state.noise()[0, 0] != noise:
        solve(state)


def _determines_drift(state: State) -> bool:
    """Return whether drift and repeatability are to be determined from returns."""
    if state.settings.drift == "none" or state.settings.together:
        return False
    if not state.data.timed:
        state.notes.append("The data contain no times of the readings (reading_time): drift is not determined.")
    return state.data.timed


def _drift(state: State, beams: Array) -> Drift:
    """Return the drift, and update the repeatability of the state: each is estimated with the other one known."""
    data, stated = state.data, state.machine
    certain = bool(stated.sources) and stated.spread == 0

    def estimate(noise: Array) -> tuple[Drift, list[str]]:
        notes: list[str] = []
        number = positions(data.nominal)
        return estimate_drift(
            state.displacement, data.time, number, beams, noise, data.stations, notes, certain=certain
        ), notes

    noise = state.noise()
    drift, notes = estimate(noise)
    state.machine = repeatability.from_returns(stated, drift, data.noise, float(noise[0, 0]), [])
    if drift.freedom and state.machine != stated:
        noise = state.noise()
        drift, notes = estimate(noise)
    state.notes += notes
    state.machine = repeatability.from_returns(stated, drift, data.noise, float(noise[0, 0]), state.notes)
    return drift
