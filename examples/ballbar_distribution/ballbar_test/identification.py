"""From a raw dataset to an error dataset, and the plan."""

import numpy as np
import xarray as xr

from ballbar_test import circles, evaluation, result
from ballbar_test.simulation import Machine, measure
from errormotion.datasets import provenance
from errormotion.datasets.timing import start_of

MISFIT = 2.0
"""Chi-square of the model by degree of freedom above which a note reports it."""


def identify(raw, settings, method, version):
    """Return an error dataset of radial deviations over direction of travel and angle.

    Raises
    ------
    MethodError
        The readings are not full circles in both directions of travel, or their constants are inconsistent.
    """
    notes = []
    read = circles.read(raw, notes)
    found = evaluation.evaluate(read, settings, notes)
    errors = dataset(
        found,
        read,
        settings,
        machine=str(raw.attrs.get("machine", "unknown")),
        frame=str(raw.attrs.get("frame", "machine")),
        reference=result.REFERENCE,
        method=method,
        method_version=version,
        provenance=provenance.make(effective(settings, read), raw, None, steps=steps(found)),
        start=start_of(raw),
    )
    return errors.assign_attrs(notes=[*notes, *remarks(found, read)] or [""], **limits(settings))


def effective(settings, read):
    """Return the settings with the test of the raw dataset."""
    runs, samples = read.length.shape[1:]
    test = {"plane": read.plane, "centre": tuple(read.centre), "nominal_radius": read.radius, "feed": read.feed}
    return settings.model_copy(update={**test, "runs": runs, "samples": samples})


def plan(settings, method, version):
    """Return zeros with the expected covariance: the evaluation of a test without errors of machine and bar."""
    silent = settings.model_copy(update={"length_noise": 0.0, "length_uncertainty": 0.0})
    raw = measure(silent, Machine(), np.random.default_rng(0))
    for name in ("length_noise", "length_uncertainty"):
        raw[name] = raw[name].copy(data=getattr(settings, name))
    read = circles.read(raw, [])
    found = evaluation.evaluate(read, settings.model_copy(update={"noise": "stated"}), [])
    errors = dataset(
        found,
        read,
        settings,
        machine="plan",
        frame="machine",
        reference="planned, not measured",
        method=method,
        method_version=version,
        provenance=provenance.make(settings, None, None, steps=["plan"]),
    )
    zero = {name: errors[name].copy(data=np.zeros_like(errors[name].values)) for name in ("deviation", "parameters")}
    u = 2e6 * found.figures.u
    words = ", ".join(f"{name} {value:.2f} um" for name, value in zip(result.NAMES, u, strict=True))
    note = (
        f"With {settings.runs} circles of {settings.samples} readings in each direction, the expanded uncertainties "
        f"(k = 2) of a path without errors are {words}. Those of G and H are smaller where the path has distinct "
        "extremes."
    )
    return errors.assign(zero).assign_attrs(notes=[note])


def dataset(found, read, settings, **attributes):
    """Return an evaluation as an error dataset."""
    total = found.independent**2 + sum(effect**2 for effect in found.shared.values())
    over, metre = result.DIMS, {"units": "m"}
    extras = {
        "model": (over, found.model, {**metre, "long_name": "radial deviation of the fitted path"}),
        "noise_u": (over, found.independent, {**metre, "long_name": "standard uncertainty by noise"}),
        "reading_count": (over, found.averaged.count, {"units": "1", "long_name": "readings in each sector"}),
        "offset": (
            "axis",
            found.offset,
            {**metre, "long_name": "set-up error: offset from the ball on the table"},
        ),
        "offset_u": ("axis", found.offset_u, metre),
        "reading_noise": ((), found.averaged.noise, {**metre, "long_name": "standard deviation of one reading"}),
        "spike_decay": ((), settings.spike_decay, {"units": "rad", "long_name": "of the spikes of the model"}),
        "misfit": ((), found.misfit, {"units": "1", "long_name": "chi-square of the model by degree of freedom"}),
        "drift": ((), found.averaged.drift, {"units": "m/s", "long_name": "of the bar; NaN = not determined"}),
        "drift_u": ((), found.averaged.drift_u, {"units": "m/s"}),
    }
    arrays = {name: xr.DataArray(values, dims=dims, attrs=attrs) for name, (dims, values, attrs) in extras.items()}
    errors = result.build(
        found.deviation,
        total,
        read,
        shared=found.shared,
        parameters=found.parameters,
        covariance=found.parameter_covariance,
        figures=found.figures,
        extras=arrays,
        **attributes,
    )
    return errors.assign_coords(axis=list(read.plane))


def steps(found):
    """Return the steps of the evaluation, for the provenance."""
    removed = ["offset of the least-squares circle removed"]
    if np.isfinite(found.averaged.drift):
        removed.append("linear drift of the bar removed")
    return ["averaged by sectors", *removed]


def remarks(found, read):
    """Return notes on a large set-up error, and on a path that the model does not describe."""
    notes = []
    size = float(np.hypot(*found.offset))
    if size > 1e-3 * read.radius:
        notes.append(
            f"The offset of the path from the ball on the table is {1e3 * size:.3f} mm. Set up to within "
            f"{1e6 * read.radius / 1e3:.0f} um: a larger offset makes the readings depend on errors across the bar."
        )
    if found.misfit > MISFIT:
        notes.append(
            f"The path has errors beyond the model (chi-square by degree of freedom {found.misfit:.1f}); the "
            "uncertainties of its parameters are increased."
        )
    return notes


def limits(settings):
    """Return the limits of the figures in the settings as attributes."""
    stated = {name: getattr(settings, name) for name in result.LIMITS}
    return {name: value for name, value in stated.items() if value is not None}
