"""A compensation in simulated time: the offsets for given readings, by the same decisions as in operation."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from errormotion.arrays import Array
from errormotion.compensation.online.follower import Conditions, Follower
from errormotion.compensation.online.prediction import Predictor, refusal
from errormotion.compensation.online.settings import Limits


@dataclass(frozen=True)
class Rehearsal:
    """The decisions at n times.

    Attributes
    ----------
    time : (n,)
        s.
    offset : (n, 3)
        m.
    state, cause : tuple of str
        State, and why the offset did not follow the prediction.
    """

    time: Array
    offset: Array
    state: tuple[str, ...]
    cause: tuple[str, ...]

    def fraction(self, state: str) -> float:
        """Return the fraction of the times in a state."""
        return self.state.count(state) / len(self.state)


def rehearse(
    predictor: Predictor,
    limits: Limits,
    time: Array,
    temperature: Mapping[str, Array],
    parameter: Mapping[str, Array],
    busy: NDArray[np.bool_] | None = None,
) -> Rehearsal:
    """Return the decisions for readings from the reference state on, armed with an offset of 0.

    Parameters
    ----------
    predictor : Predictor
    limits : Limits
    time : (n,)
        s, increasing; usually ``limits.period`` apart.
    temperature, parameter : mapping of str to (n,)
        Readings by their names; NaN: unknown.
    busy : (n,) of bool, optional
        Times at which the offset must not change, for example during probing.
    """
    follower = Follower(limits)
    follower.arm(np.zeros(3))
    offset, states, causes = np.zeros((len(time), 3)), [], []
    for k, now in enumerate(time):
        measured = {name: float(values[k]) for name, values in temperature.items()}
        speeds = {name: float(values[k]) for name, values in parameter.items()}
        prediction = predictor.update(float(now), measured, speeds)
        cause = refusal(prediction, limits)
        target = None if cause else -prediction.errors[:3]
        probing = "probing" if busy is not None and busy[k] else ""
        step = follower.step(float(now), Conditions(target, cause, probing))
        offset[k] = step.offset
        states.append(str(step.state))
        causes.append(step.cause)
    return Rehearsal(np.asarray(time, dtype=float), offset, tuple(states), tuple(causes))
