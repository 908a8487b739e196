"""The evaluation as an error dataset, and its figures."""

import numpy as np
import xarray as xr

from ballbar_test.extremes import MEANINGS, NAMES, Figures
from ballbar_test.path import DIRECTIONS, PARAMETERS, UNITS, middles
from errormotion.datasets import build_deviations
from errormotion.plugins import FigureOfMerit

DIMS = ("direction_of_travel", "angle")
LIMITS = ("circular_deviation_limit", "hysteresis_limit")
REFERENCE = "nominal circle around the centre of the least-squares circle of both paths"


def build(deviation, variance, circles, *, shared, parameters, covariance, figures, extras=None, **attributes):
    """Return an error dataset over direction of travel and angle.

    Parameters
    ----------
    deviation, variance : ndarray, (2, place)
        m, m^2.
    circles : Circles
        Or another object with ``axes``, ``centre``, ``radius``, ``feed`` and ``plane``.
    shared : mapping of str to ndarray
        Source to the effect of one standard uncertainty, (2, place), m.
    parameters, covariance : ndarray, (9,) and (9, 9)
        In the order of ``path.PARAMETERS``.
    figures : Figures
    extras : mapping of str to DataArray, optional
    """
    angle = middles(deviation.shape[1])
    unit = np.stack([np.cos(angle), np.sin(angle)], axis=-1) @ circles.axes
    sensitivity = np.hstack([unit, np.zeros_like(unit)])  # a rotation about the centre moves the ball across the bar
    arrays = {
        "parameters": xr.DataArray(parameters, dims="parameter", attrs={"long_name": "of the path"}),
        "parameter_covariance": xr.DataArray(covariance, dims=("parameter", "parameter_")),
        "figures": xr.DataArray(figures.value, dims="figure", attrs={"units": "m", "long_name": "of ISO 230-4"}),
        "figure_covariance": xr.DataArray(figures.covariance, dims=("figure", "figure_"), attrs={"units": "m^2"}),
    }
    errors = build_deviations(
        deviation,
        variance,
        np.broadcast_to(sensitivity, (2, *sensitivity.shape)),
        dims=DIMS,
        coords={
            "direction_of_travel": (DIMS[0], list(DIRECTIONS), {"long_name": "direction of travel"}),
            "angle": (DIMS[1], angle, {"long_name": "middle of a sector, from the first axis", "units": "rad"}),
            "parameter": list(PARAMETERS),
            "parameter_": list(PARAMETERS),
            "parameter_unit": ("parameter", list(UNITS)),
            "figure": list(NAMES),
            "figure_": list(NAMES),
            "meaning": ("figure", list(MEANINGS)),
        },
        component="tool",
        functional_point=circles.centre,
        influence=np.array(list(shared.values())) if shared else None,
        sources=list(shared),
        source_groups=list(shared),
        extras={**arrays, **(extras or {})},
        **attributes,
    )
    return errors.assign_attrs(plane=circles.plane, nominal_radius=circles.radius, feed=circles.feed)


def figures_of(errors):
    """Return the figures of ISO 230-4 of a result, with their limits."""
    limits = {name: float(errors.attrs[name]) for name in LIMITS if name in errors.attrs}
    u = np.sqrt(np.diagonal(errors["figure_covariance"].values))
    return [
        FigureOfMerit(
            f"{name} {errors.attrs['plane']}", float(value), 2 * float(sigma), "m", limit_of(str(name), limits)
        )
        for name, value, sigma in zip(errors["figure"].values, errors["figures"].values, u, strict=True)
    ]


def limit_of(name, limits):
    """Return the limit of a figure, m; None if there is none."""
    return limits.get("hysteresis_limit" if name == "H" else "circular_deviation_limit" if name[0] == "G" else "")


def exact(values):
    """Return figures without uncertainty: those of a known path."""
    return Figures(values, np.zeros((len(values), len(values))))
