"""The plugin ``circular_test``: the measurement model, and further results of a circular test.

The errors are the mean radial deviations over sectors, without the offset of the common least-squares circle. The
radius is not removed: it compares the scales of the machine with the calibrated bar.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import xarray as xr

from errormotion.measurement import Datum, ModelMethod, Observed
from errormotion.methods.circular_test.schema import READINGS, SCHEMA
from errormotion.methods.circular_test.settings import CircularTestSettings
from errormotion.plugins import FigureOfMerit, MethodInfo, Needs, PluginSettings, lazy

if TYPE_CHECKING:
    from errormotion.arrays import Array
    from errormotion.measurement.observed import Solved
    from errormotion.methods.circular_test.circles import Circles, Sectors

CENTRE = "centre of the circle"
"""Group of the uncertainty of the datum."""
LIMITS = ("circular_deviation_limit", "hysteresis_limit")
MISFIT = 2.0
"""Chi-square of the model by degree of freedom above which a note reports it."""


class CircularTest(ModelMethod):
    """Circular test after ISO 230-4 with a telescoping ballbar."""

    info: ClassVar[MethodInfo] = MethodInfo(
        id="circular_test",
        summary="Circular test after ISO 230-4 with a telescoping ballbar",
        status="simulated_only",
        version="5",
        former=("ballbar",),
        cannot_see=(
            "errors across the bar: only the radial displacement is measured",
            "the position of the circle: its centre is that of the least-squares circle",
            "arcs: only full circles can be centred",
            "a drift of the bar, if each direction of travel has only one circle",
        ),
    )
    needs: ClassVar[Needs] = Needs(instruments=(), raw_schema=SCHEMA)
    Settings: ClassVar[type[PluginSettings]] = CircularTestSettings
    acquisition_settings: ClassVar[Sequence[str]] = (
        "plane",
        "centre",
        "nominal_radius",
        "feed",
        "runs",
        "samples",
        "length_noise",
        "length_uncertainty",
    )
    raw_schemas = lazy("errormotion.methods.circular_test.schema:RAW_SCHEMAS")
    conformance = lazy("errormotion.methods.circular_test.conformance:subjects")
    chapters = lazy("errormotion.methods.circular_test.report:chapters")
    texts = lazy("errormotion.methods.circular_test.report:texts")
    grows = "run"

    def observe(self, raw: xr.Dataset, settings: Any = None) -> Observed:
        """Return the model: reading = radius plus deviation of its sector plus drift, by a bar that is known so far."""
        from errormotion.methods.circular_test.circles import DRIFT, places_of, problem_of, read
        from errormotion.methods.circular_test.path import DIRECTIONS, middles

        settings, notes = settings or CircularTestSettings(), list[str]()
        circles = read(raw, settings, notes)
        sectors = problem_of(circles, settings, settings.places, settings.spike_decay, notes)
        known = sectors.count.ravel() > 0
        if missing := int((~known).sum()):
            notes.append(
                f"{missing} of {known.size} sectors of the circles have no reading; their deviation is unknown."
            )
        angle = middles(settings.places)
        unit = np.stack([np.cos(angle), np.sin(angle)], axis=-1) @ circles.axes
        circle = circles.over_sectors(settings.places, settings.spike_decay)[..., :3].reshape(-1, 1, 3)
        limits = {name: getattr(settings, name) for name in LIMITS if getattr(settings, name) is not None}
        return Observed(
            problem=sectors.problem,
            places=places_of(sectors),
            datum=Datum(circle[..., 1:], known[:, None].astype(float), CENTRE, tuple(circles.plane), circle[..., :1]),
            # A rotation about the centre moves the ball across the bar
            sensitivity=np.tile(np.hstack([unit, np.zeros_like(unit)]), (2, 1)),
            recorded=("length", READINGS),
            order=sectors.order,
            series=sectors.series,
            shared=DRIFT,
            robust=False,  # a reading at a step of the path is no outlier
            noise_increases=False,  # the noise follows from the scatter within sectors already
            finish=partial(_finished, circles=circles, sectors=sectors, settings=settings),
            dims=("direction_of_travel", "angle"),
            coords={
                "direction_of_travel": ("direction_of_travel", list(DIRECTIONS), {"long_name": "direction of travel"}),
                "angle": ("angle", angle, {"units": "rad", "long_name": "middle of a sector, from the first axis"}),
            },
            component="tool",
            frame=str(raw.attrs.get("frame", "machine")),
            functional_point=circles.centre.tolist(),
            reference="nominal circle around the centre of the least-squares circle of both paths",
            what="the lengths",
            attrs={"plane": circles.plane, "nominal_radius": circles.radius, "feed": circles.feed, **limits},
            notes=notes,
        )

    def expected(self, settings: Any) -> xr.Dataset:
        """Return the readings of a test of a machine with typical errors."""
        from errormotion.methods.circular_test.path import expected

        return expected(settings)

    def simulate(self, settings: Any, seed: int) -> tuple[xr.Dataset, xr.Dataset]:
        """Return raw data with every source drawn once, and the true errors, with the true figures and parameters."""
        from errormotion.methods.circular_test import figures, path

        raw, truth = super().simulate(settings, seed)
        angle = np.array([path.middles(7200)] * 2)
        sense = np.broadcast_to(path.SENSE[:, None], angle.shape)
        true = np.linalg.norm(path.position(path.TYPICAL, angle, sense, settings), axis=-1) - settings.nominal_radius
        values = {"figures": figures.evaluate(true), "parameters": [path.TYPICAL[name] for name in path.PARAMETERS]}
        none = {name: 0.0 * truth[name] for name in ("figure_covariance", "parameter_covariance", "figure_influence")}
        return raw, truth.assign(none | {name: truth[name].copy(data=value) for name, value in values.items()})

    def plan(self, settings: Any = None) -> xr.Dataset:
        """Return an error dataset of zeros with the expected covariance, and a note on the figures."""
        planned = super().plan(settings)
        u = 2e6 * np.sqrt(np.diagonal(planned["figure_covariance"].values))
        words = ", ".join(f"{name} {value:.2f} um" for name, value in zip(planned["figure"].values, u, strict=True))
        note = f"Expanded uncertainties (k = 2) of the figures of a machine with typical errors: {words}."
        zero = {name: 0.0 * planned[name] for name in ("figures", "parameters", "model", "offset", "drift", "misfit")}
        return planned.assign(zero).assign_attrs(notes=[note])

    @staticmethod
    def figures(errors: xr.Dataset) -> list[FigureOfMerit]:
        """Return the figures of ISO 230-4, with their limits."""
        limits = {name: float(errors.attrs[name]) for name in LIMITS if name in errors.attrs}
        effects = errors["figure_influence"].values if "figure_influence" in errors else None
        sources, merits = errors["source"].values.tolist(), []
        for k, name in enumerate(errors["figure"].values.tolist()):
            U = 2 * float(np.sqrt(errors["figure_covariance"].values[k, k]))
            limit = limits.get(LIMITS[1] if name == "H" else LIMITS[0] if name[0] == "G" else "")
            effect = None if effects is None else dict(zip(sources, effects[:, k].tolist(), strict=True))
            value = float(errors["figures"][k])
            if name == "D":  # follows from the errors alone
                value, U, effect = *_mean(errors), None
            merits.append(FigureOfMerit(f"{name} {errors.attrs['plane']}", value, U, "m", limit, effect))
        return merits


def _finished(solved: Solved, *, circles: Circles, sectors: Sectors, settings: Any) -> Solved:
    """Return the solution with the figures, and the parameters of the path; a trial of Monte Carlo needs neither."""
    from errormotion.estimation.variance import Verdict
    from errormotion.methods.circular_test import figures
    from errormotion.methods.circular_test.path import PARAMETERS

    observed, relative = solved.observed, solved.relative
    if settings.noise == "auto":  # `circles` says what the scatter within sectors means
        solved = replace(solved, scatter=replace(solved.scatter, verdict=Verdict.CONSISTENT, note=""))
    if not solved.propagated:
        return solved
    errors, count = relative.errors, sectors.count.ravel()
    shared = np.array([each.effect[:, 0] for each in errors.sources if each.group != CENTRE]).reshape(-1, count.size)
    known = count > 0
    # Weighted least squares of the means over sectors: it has the circle as well, so that their datum has no effect
    phi = observed.correlation or 0.0
    value, u = errors.value[:, 0], sectors.sd(phi)
    if phi > 0:  # the errors are no simple means then
        value = np.where(known, solved.white.linear.at.tables[0][:, 0], np.nan)
    M = circles.over_sectors(settings.places, settings.spike_decay).reshape(count.size, -1)
    scale = np.linalg.norm(M[known] / u[known, None], axis=0)
    to_path = np.linalg.pinv(M[known] / u[known, None] / scale) / u[known] / scale[:, None]
    path = to_path @ value[known]
    misfit = float(np.sum(((value[known] - M[known] @ path) / u[known]) ** 2) / (known.sum() - M.shape[1]))
    effect, weights = shared[:, known] @ to_path.T, np.zeros((M.shape[1], count.size))
    weights[:, known] = to_path
    C = max(1.0, misfit) * sectors.covariance(weights, phi) + effect.T @ effect
    offset = np.linalg.pinv(M[known, :3])[1:] @ M[known] @ path
    model = np.where(known, M @ path - M[:, 1:3] @ offset, np.nan)
    noise = np.sqrt(np.maximum(errors.covariance[:, 0, 0] - np.square(shared).sum(axis=0), 0.0))
    of_path = figures.of_circles(circles, settings, phi)
    influence = [of_path.influence.get(each.name, np.zeros(len(figures.NAMES))) for each in errors.sources]
    drift, drift_u = _drift(solved, drifts=sectors.drifts)
    over, shape, m = ("direction_of_travel", "angle"), sectors.count.shape, {"units": "m"}
    label = {"parameter": list(PARAMETERS), "parameter_unit": ("parameter", list(PARAMETERS.values()))}
    figure = {"figure": list(figures.NAMES), "meaning": ("figure", list(figures.MEANINGS.values()))}
    extras = {
        "parameters": xr.DataArray(path[3:], label, "parameter", attrs={"long_name": "of the path"}),
        "parameter_covariance": xr.DataArray(C[3:, 3:], label, ("parameter", "parameter_")),
        "figures": xr.DataArray(of_path.value, figure, "figure", attrs={**m, "long_name": "of ISO 230-4"}),
        "figure_covariance": xr.DataArray(of_path.covariance, figure, ("figure", "figure_"), attrs={"units": "m^2"}),
        "figure_influence": xr.DataArray(np.array(influence).reshape(-1, 7), figure, ("source", "figure"), attrs=m),
        "model": _array(over, model.reshape(shape), "m", "radial deviation of the fitted path"),
        "noise_u": _array(over, noise.reshape(shape), "m", "standard uncertainty by noise"),
        "reading_count": _array(over, sectors.count, "1", "readings in each sector"),
        "offset": _array("axis", relative.coefficient, "m", "set-up error: offset from the ball on the table"),
        "offset_u": _array(
            "axis", np.sqrt(np.diagonal(relative.covariance)), "m", "standard uncertainty of the offset"
        ),
        "reading_noise": _array((), sectors.noise, "m", "standard deviation of one reading"),
        "spike_decay": _array((), settings.spike_decay, "rad", "of the spikes of the model"),
        "misfit": _array((), misfit, "1", "chi-square of the model by degree of freedom"),
        "drift": _array((), drift, "m/s", "of the bar; NaN = not determined"),
        "drift_u": _array((), drift_u, "m/s", "standard uncertainty of the drift"),
    }
    extras["offset"] = extras["offset"].assign_coords(axis=list(circles.plane))
    notes = [*observed.notes, *_remarks(relative.coefficient, misfit, circles.radius)]
    return replace(solved, observed=replace(observed, extras={**observed.extras, **extras}, notes=notes))


def _mean(errors: xr.Dataset) -> tuple[float, float]:
    """Return the radius of the least-squares circle of the deviations, and its expanded uncertainty, m."""
    over = ("direction_of_travel", "angle")
    deviation = errors["deviation"].transpose(*over).values.ravel()
    known, angle = np.isfinite(deviation), np.tile(errors["angle"].values, 2)
    circle = np.stack([np.ones(angle.size), np.cos(angle), np.sin(angle)], axis=1)
    h = np.linalg.pinv(circle[known])[0]
    effect = errors["deviation_influence"].transpose("source", *over).values.reshape(-1, angle.size)[:, known]
    own = errors["deviation_variance"].transpose(*over).values.ravel()[known] - np.square(effect).sum(axis=0)
    variance = np.square(effect @ h).sum() + np.square(h) @ np.maximum(own, 0.0)
    return float(h @ deviation[known]), 2 * float(np.sqrt(variance))


def _array(dims: Any, values: Any, unit: str, meaning: str) -> xr.DataArray:
    return xr.DataArray(values, dims=dims, attrs={"units": unit, "long_name": meaning})


def _drift(solved: Solved, *, drifts: bool) -> tuple[float, float]:
    """Return the drift of the bar and its standard uncertainty, m/s; NaN if it is not determined."""
    if not drifts:
        return np.nan, np.nan
    root: Array = solved.fit.normal.root
    return float(solved.fit.linear.at.tables[1][0, 0]), float(np.sqrt((root @ root.T)[0, 0]))


def _remarks(offset: Array, misfit: float, radius: float) -> list[str]:
    """Return notes on a large set-up error, and on a path that the model does not describe."""
    notes, size = [], float(np.hypot(*offset))
    if size > 1e-3 * radius:
        notes.append(
            f"The offset of the path from the ball on the table is {1e3 * size:.3f} mm. Set up to within "
            f"{1e3 * radius:.0f} um: a larger offset makes the readings depend on errors across the bar."
        )
    if misfit > MISFIT:
        notes.append(
            f"The path has errors beyond the model (chi-square by degree of freedom {misfit:.1f}); the "
            "uncertainties of its parameters are increased."
        )
    return notes
