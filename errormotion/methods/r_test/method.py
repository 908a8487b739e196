"""The plugin ``r_test``: its measurement model, and the location errors as results."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any, ClassVar, Generic, NamedTuple, TypeVar

import numpy as np
import xarray as xr

from errormotion.arrays import Array
from errormotion.errors import MethodError
from errormotion.measurement import Block, Constant, Datum, ModelMethod, Noise, Observed, Places, Problem
from errormotion.methods.r_test.schema import ASSUMED_POSITION, SCHEMA
from errormotion.methods.r_test.settings import RTestSettings
from errormotion.plugins import FigureOfMerit, MethodInfo, Needs, PluginSettings, lazy

if TYPE_CHECKING:
    from errormotion.estimation.checks.candidates import Candidate
    from errormotion.estimation.datum import Relative
    from errormotion.estimation.fit import Fit
    from errormotion.methods.r_test.layout import Layout

T = TypeVar("T")
LINE = "axis average line"
"""Group of the uncertainty of the datum."""
WRONG_SENSE = 4.0
"""Ratio of the sums of squares from which the opposite sense of rotation is the right one."""


class Unknowns(NamedTuple, Generic[T]):
    """Tables of what is estimated: six errors for each angle, and the offset of each sphere on the table."""

    motion: T
    offset: T


class Known(NamedTuple, Generic[T]):
    """Tables of what is known with an uncertainty."""

    direction: T
    gain: T
    place: T
    nest: T


class RTest(ModelMethod):
    """Location errors and error motions of a rotary table, from spheres on it and a nest of sensors (R-test)."""

    info: ClassVar[MethodInfo] = MethodInfo(
        id="r_test",
        summary="Location errors and error motions of a rotary table by spheres and a nest of sensors (R-test)",
        status="simulated_only",
        version="3",
        cannot_see=(
            "the mean of the axial displacement and of the rotation about the axis, and once-per-revolution terms that "
            "a displaced or tilted plate of spheres imitates",
            "errors of the linear axes, which follow the spheres: they count as errors of the rotary axis",
            "rotations, if there is one sphere only",
            "an angle of all readings that is shifted by the same amount",
            "a slow drift of the spheres or of the nest during the test, which looks like an error motion",
        ),
    )
    needs: ClassVar[Needs] = Needs(instruments=("point_lds",), raw_schema=SCHEMA)
    Settings: ClassVar[type[PluginSettings]] = RTestSettings
    acquisition_settings: ClassVar[Sequence[str]] = (
        "axis",
        "angles",
        "spheres",
        "radius",
        "height",
        "inclination",
        "noise",
        "gain_uncertainty",
        "direction_uncertainty",
        "position_uncertainty",
        "nest_uncertainty",
    )
    raw_schemas = lazy("errormotion.methods.r_test.schema:RAW_SCHEMAS")
    conformance = lazy("errormotion.methods.r_test.conformance:subjects")
    chapters = lazy("errormotion.methods.r_test.report:chapters")
    texts = lazy("errormotion.methods.r_test.report:texts")
    grows = "angle"

    def observe(self, raw: xr.Dataset, settings: Any = None) -> Observed:  # noqa: ARG002 - the data state everything
        """Return the model: reading = gain times direction times displacement of the sphere in the nest."""
        from errormotion.methods.r_test.layout import Layout

        layout = Layout.of(raw)
        problem = _problem(raw, layout)
        _check_sense(raw, problem)
        known = np.where(layout.determined, 0.0, np.nan)
        angle, sphere, sensor = (index.ravel() for index in np.indices(layout.reading.shape))
        lines = {name: k for name, k in layout.locations.items() if layout.seen[k]}
        # The line of the axis displaced by +1 displaces the table by +1: an error motion of -1 (tool relative to it).
        shift = [np.tile(-np.eye(6)[k], (len(layout.angle), 1)) for k in lines.values()]
        return Observed(
            problem=problem,
            places=Places(lambda x, _: x.motion + known, len(layout.angle)),
            datum=Datum(np.stack([*shift, *layout.gauge[1]], axis=2), ~np.isnan(known), LINE, tuple(lines)),
            recorded=("displacement", ("angle", "sphere", "sensor")),
            order=angle.astype(float),
            series=sphere * layout.reading.shape[2] + sensor,
            suspects=_suspects(layout, problem),
            name=layout.name_of,
            refuses_contradictions=True,
            dims=("angle",),
            coords={"angle": ("angle", layout.angle, {"units": "rad", "long_name": f"angle of {layout.axis}"})},
            component=layout.axis,
            functional_point=layout.origin.tolist(),
            reference="axis average line; mean axial displacement and mean rotation about the axis are 0",
            what="the displacements",
            noise_cause="Possible causes: errors that do not repeat, spheres or sensors that have moved, drift.",
            notes=_notes(raw, layout),
        )

    def expected(self, settings: Any) -> xr.Dataset:
        """Return the readings of a test with offsets, error motions and location errors of typical size."""
        from errormotion.methods.r_test.layout import expected

        return expected(settings)

    def results(self, observed: Observed, fit: Fit, relative: Relative) -> Mapping[str, xr.DataArray]:  # noqa: ARG002
        """Return the location errors with covariance, and the effect of every source on them."""
        from errormotion.kinematics.iso import location_names

        names = tuple(location_names(observed.component).values())
        own = list(observed.datum.names) if observed.datum else []
        at = [names.index(name) for name in own]
        value, C = np.full(len(names), np.nan), np.full((len(names), len(names)), np.nan)
        F = np.full((len(relative.errors.sources), len(names)), np.nan)
        value[at], C[np.ix_(at, at)] = relative.coefficient[: len(at)], relative.covariance[: len(at), : len(at)]
        F[:, at] = relative.influence[:, : len(at)]
        label = {"location": list(names)}
        what = "at the functional point of the method; m, rad"
        return {
            "location_error": xr.DataArray(value, label, "location", attrs={"long_name": f"line of the axis, {what}"}),
            "location_covariance": xr.DataArray(C, label, ("location", "location_"), attrs={"long_name": what}),
            "location_influence": xr.DataArray(F, label, ("source", "location"), attrs={"long_name": what}),
        }

    @staticmethod
    def figures(errors: xr.Dataset) -> list[FigureOfMerit]:
        """Return the location errors with ``U = 2 u``, and the range of each error motion over the angles, if measured.

        The range of noisy values is too large on average: its U contains this bias (JCGM 100, F.2.4.5).
        """
        from errormotion.datasets.results.merit import is_planned

        merits, sources = [], errors["source"].values.tolist()
        for k, name in enumerate(errors["location"].values.tolist()):
            value, C = float(errors["location_error"][k]), errors["location_covariance"].values
            if np.isfinite(value):
                effect = dict(zip(sources, errors["location_influence"].values[:, k].tolist(), strict=True))
                unit, U = "m" if name[1] in "XYZ" else "rad", 2 * float(np.sqrt(C[k, k]))
                merits.append(FigureOfMerit(name, value, U, unit, influence=effect))
        return merits if is_planned(errors) else merits + _ranges(errors)


def _problem(raw: xr.Dataset, layout: Layout) -> Problem:
    """Return readings, unknowns and constants."""
    n, _, sensors = layout.reading.shape
    angle, sphere, sensor = (index.ravel() for index in np.indices(layout.reading.shape))
    y: Array = np.where(np.any(layout.determined, axis=1, keepdims=True)[..., None], layout.reading, np.nan)
    start, turn, gauge = layout.offset(), layout.turn[angle], layout.gauge[0]
    free = np.asarray(np.isfinite(y).any(axis=(0, 2)))
    redundancy = np.isfinite(y).sum() - layout.determined.sum() - 3 * free.sum() + len(gauge)
    if "displacement_noise" not in raw and redundancy < 1:
        raise MethodError(
            "displacement_noise is not stated, and the displacements have no redundancy to estimate it. State it, or "
            "measure three spheres, or one with more than three sensors.",
            code="raw.noise.unknown",
        )

    def stated(name: str, default: float = 0.0) -> float:
        return float(raw[name]) if name in raw else default

    def equation(y: Array, x: Unknowns[Array], c: Known[Array]) -> Array:
        turned = np.einsum("nij,nkj->kni", turn, np.stack([x.offset, c.place], axis=1))
        d = turned[0] - x.motion[:, :3] - np.cross(x.motion[:, 3:], turned[1]) - c.nest
        return np.asarray(y - c.gain[:, 0] * np.sum(c.direction * d, axis=1))

    across = np.linalg.svd(layout.sensor[:, None, :])[2][:, 1:]  # two unit vectors across each sensor
    turned = stated("sensor_direction_uncertainty") * np.einsum("st,ski->sitk", np.eye(sensors), across)
    return Problem(
        equation=equation,
        readings=y.ravel(),
        unknowns=Unknowns(
            motion=Block(start=np.zeros((n, 6)), index=angle, scale=1.0, free=layout.determined),
            offset=Block(start=start, index=sphere, scale=1.0, free=free, group="offsets of spheres"),
        ),
        constants=Known(
            direction=_constant(layout.sensor, turned.reshape(sensors, 3, -1), sensor, "sensor direction"),
            gain=_constant(np.ones((sensors, 1)), stated("gain_uncertainty"), sensor, "sensor gain"),
            place=_constant(
                layout.place + start, stated("position_uncertainty", ASSUMED_POSITION), sphere, "position of spheres"
            ),
            nest=_constant(
                np.zeros((1, 3)), stated("nest_uncertainty"), np.zeros_like(angle), "zero of the nest", adjust=False
            ),
        ),
        noise=Noise(sd=np.full(y.size, stated("displacement_noise", 1.0)), stated="displacement_noise" in raw),
        gauge={"offset": gauge},
    )


def _constant(value: Array, factor: Array | float, index: Any, group: str, *, adjust: bool = True) -> Constant:
    """Return a constant; with a number as factor, each value has this standard uncertainty independently."""
    if isinstance(factor, float):
        factor = factor * np.eye(value.size).reshape(*value.shape, value.size)
    return Constant(value=value, factor=factor, index=index, scale=1.0, group=group, adjust=adjust)


def _check_sense(raw: xr.Dataset, problem: Problem) -> None:
    """Refuse readings that fit the opposite sense of rotation: the offsets of spheres turn with the table.

    The constants are taken as they are, so that both fits are linear.
    """
    from errormotion.estimation.fit import fit
    from errormotion.methods.r_test.layout import Layout

    def misfit(one: Problem) -> tuple[float, int]:
        solution = fit(replace(one, constants=Known(*(replace(c, adjust=False) for c in one.constants))))
        return solution.chi2, solution.freedom

    chi2, freedom = misfit(problem)
    if freedom < 1 or (problem.noise.stated and chi2 < WRONG_SENSE * freedom):
        return
    other = raw.isel(angle=slice(None, None, -1))
    other = other.assign_coords(angle=-other["angle"])
    if WRONG_SENSE * misfit(_problem(other, Layout.of(other)))[0] < chi2:
        raise MethodError(
            "The displacements fit the opposite sense of rotation. State angles as commanded (ISO 841: a positive "
            "command turns the tool in the positive direction relative to the workpiece, the table in the negative "
            "one).",
            code="readings.sense.opposite",
        )


def _suspects(layout: Layout, problem: Problem) -> Callable[[Fit], Sequence[Candidate]]:
    """Return the search for a sphere that has moved on the table, and for a sensor with another gain."""
    from errormotion.estimation.checks.candidates import Candidate, steps

    angle, sphere, sensor = (index.ravel() for index in np.indices(layout.reading.shape))
    moved = steps(
        angle.astype(float),
        sphere,
        -np.einsum("ni,nij->nj", layout.sensor[sensor], layout.turn[angle]),
        lambda which, cut: f"sphere {which + 1} has moved on the table before {layout.degrees(int(cut))}",
    )

    def found(fitted: Fit) -> Sequence[Candidate]:
        predicted = problem.y - np.nan_to_num(fitted.residual[:, 0])
        gains = [
            Candidate(
                words=f"the gain of sensor {k + 1} is not the stated one", design=-(predicted * (sensor == k))[:, None]
            )
            for k in range(len(layout.sensor))
        ]
        return [*moved(fitted), *gains]

    return found


def _notes(raw: xr.Dataset, layout: Layout) -> list[str]:
    """Return what the data do not state or determine."""
    from errormotion.kinematics.iso import DOF

    notes = []
    unseen = [dof for dof, seen in zip(DOF, layout.seen, strict=True) if not seen]
    if unseen:
        notes.append(
            f"The spheres do not determine {', '.join(unseen)}: "
            + ("the only sphere is on the axis." if len(layout.place) == 1 else "they are on the axis.")
            + " Errors are those at the functional point."
        )
    some = int((~layout.determined[:, layout.seen].all(axis=1)).sum())
    if some:
        notes.append(f"At {some} of {len(layout.angle)} angles, missing readings leave errors unknown.")
    if "nest_uncertainty" not in raw:
        line = " and ".join(name for name, k in layout.locations.items() if k < 3)
        notes.append(f"The uncertainty of the nest's zero is not stated: {line} are those relative to the nest.")
    if "position_uncertainty" not in raw:
        notes.append(
            f"The uncertainty of the positions of the spheres is not stated; {1e3 * ASSUMED_POSITION:g} mm is assumed."
        )
    return notes


def _ranges(errors: xr.Dataset) -> list[FigureOfMerit]:
    """Return the range of each error motion."""
    from errormotion.estimation.extremes import expanded, of_noisy_values
    from errormotion.kinematics.iso import DOF, iso_names

    ranges = []
    names = iso_names(str(errors.attrs["component"]))
    for k, dof in enumerate(DOF):
        value = errors[dof].values
        known = np.isfinite(value)
        if known.sum() < 2:
            continue
        shared = errors["influence"].values[:, known, k]
        own = errors["covariance"].values[known, k, k] - np.square(shared).sum(axis=0)
        of = of_noisy_values(lambda v: np.ptp(v, axis=-1), value[known], np.sqrt(np.maximum(own, 0.0)), shared)
        U = float(expanded(of.bias, of.u))
        ranges.append(FigureOfMerit(f"range of {names[dof]}", float(of.value), U, "m" if k < 3 else "rad"))
    return ranges
