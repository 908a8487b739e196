"""Interface of a model for online compensation: predictions of the errors from the latest readings."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import xarray as xr

from errormotion import plugins
from errormotion.arrays import Array
from errormotion.compensation.online.settings import Limits
from errormotion.errors import CompensationError

PARAMETERS = ("spindle_speed", "feed")
"""Working parameters, 1/min and m/s, by their names in a controller's state and in a log."""


@dataclass(frozen=True)
class Prediction:
    """Predicted errors at one time.

    Attributes
    ----------
    errors, uncertainty : (6,)
        Translations in m at the functional point, rotations in rad; standard uncertainty. NaN where unknown.
    missing : tuple of str
        Inputs that are unknown.
    outside : tuple of str
        Inputs outside the range of the training.
    """

    errors: Array
    uncertainty: Array
    missing: tuple[str, ...] = ()
    outside: tuple[str, ...] = ()


def refusal(prediction: Prediction, limits: Limits) -> str:
    """Return why a prediction must not be used; empty if it may be."""
    if prediction.missing:
        return f"no reading for {limits.oldest:g} s: {', '.join(prediction.missing)}"
    if prediction.outside:
        return f"outside the training range: {', '.join(prediction.outside)}"
    widest = 2 * float(prediction.uncertainty[:3].max())
    if not widest <= limits.uncertainty:
        return f"U of the prediction is {widest * 1e6:.1f} um, above {limits.uncertainty * 1e6:g} um"
    return ""


class Predictor(Protocol):
    """Predicts the errors of a machine from its latest readings.

    Attributes
    ----------
    temperatures, parameters : sequence of str
        Required names of sensors, and of `PARAMETERS`.
    """

    @property
    def temperatures(self) -> Sequence[str]:
        """Names of the sensors."""

    @property
    def parameters(self) -> Sequence[str]:
        """Names of the working parameters."""

    def update(self, time: float, temperature: Mapping[str, float], parameter: Mapping[str, float]) -> Prediction:
        """Process the readings of one time, and return the prediction for it.

        Parameters
        ----------
        time : float
            s, later than before. The first readings are the reference state.
        temperature : mapping of str to float
            degC by sensor; NaN or absent: unknown.
        parameter : mapping of str to float
            `PARAMETERS`; NaN or absent: unknown.
        """


def predicts(schema: str) -> bool:
    """Return whether datasets of a schema are models that predict errors from readings."""
    owner = plugins.owner_of_schema(schema)
    return owner is not None and plugins.states(owner, "predictor")


def predictor(model: xr.Dataset, functional_point: Array | None = None) -> Predictor:
    """Return the predictor of a model by the plugin of its schema (``predictor`` of a kind of dataset).

    Parameters
    ----------
    model : Dataset
    functional_point : (3,), optional
        Point of the translations, m, in the frame of the model; default: that of the model.

    Raises
    ------
    CompensationError
        No plugin predicts from such a dataset, or the model does not predict all freedoms that an offset requires.
    """
    schema = str(model.attrs.get("schema", "none"))
    owner = plugins.owner_of_schema(schema)
    if not predicts(schema):
        raise CompensationError(
            f"Expected a model that predicts errors from readings; found the schema '{schema}'",
            code="schema.other",
        )
    found: Predictor = owner().predictor(model, functional_point)
    return found
