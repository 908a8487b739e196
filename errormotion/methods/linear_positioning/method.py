"""The plugin ``linear_positioning``."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any, ClassVar

from errormotion.measurement import ModelMethod
from errormotion.methods.linear_positioning.schema import SCHEMA
from errormotion.methods.linear_positioning.settings import LIMITS, LinearPositioningSettings
from errormotion.plugins import Bench, MethodInfo, Needs, PluginSettings, Step, lazy, unarmed

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator, Mapping, Sequence

    import xarray as xr

    from errormotion.estimation.datum import Relative
    from errormotion.estimation.fit import Fit
    from errormotion.kinematics.description import MachineDescription
    from errormotion.measurement import Observed


class LinearPositioning(ModelMethod):
    """Errors of one linear axis at target positions, approached repeatedly from both directions (ISO 230-2)."""

    info: ClassVar[MethodInfo] = MethodInfo(
        id="linear_positioning",
        summary="Positioning accuracy and repeatability of a linear axis after ISO 230-2; its straightness and angles",
        status="simulated_only",
        version="5",
        cannot_see=(
            "freedoms that were not measured",
            "errors between the targets that vary over less than the interval of the targets",
            "the slope of a straightness: its reference line joins the first and the last target",
            "errors of the instrument that its stated uncertainty does not include",
            "the contribution of each axis to the errors along a diagonal: body diagonals alone do not separate them",
        ),
    )
    needs: ClassVar[Needs] = Needs(instruments=("controller",), raw_schema=SCHEMA)
    Settings: ClassVar[type[PluginSettings]] = LinearPositioningSettings
    acquisition_settings: ClassVar[Sequence[str]] = (
        "axis",
        "freedoms",
        "travel",
        "limits",
        "targets",
        "count",
        "random_part",
        "seed",
        "runs",
        "moving",
        "diagonals",
        "start",
        "overrun",
        "feed",
        "dwell",
        "settle",
        "channels",
        "average",
        "arrival",
        "timeout",
    )
    raw_schemas = lazy("errormotion.methods.linear_positioning.schema:RAW_SCHEMAS")
    chapters = lazy("errormotion.methods.linear_positioning.report:chapters")
    texts = lazy("errormotion.methods.linear_positioning.report:texts")
    conformance = lazy("errormotion.methods.linear_positioning.conformance:subjects")
    log_readers = lazy("errormotion.methods.linear_positioning.rtl:LOG_READERS")
    log_maps = lazy("errormotion.methods.linear_positioning.rtl:LOG_MAPS")
    figures = lazy("errormotion.methods.linear_positioning.figures:figures")

    def acquire(
        self,
        bench: Bench,
        settings: LinearPositioningSettings,
        *,
        inputs: Mapping[str, xr.Dataset],  # noqa: ARG002 - part of the protocol
        done: xr.Dataset | None = None,
    ) -> Iterator[xr.Dataset]:
        """Measure; yield one raw dataset per run, target, reading or diagonal, along `append_dim`."""
        from errormotion.methods.linear_positioning.acquisition.measure import measure_axis
        from errormotion.methods.linear_positioning.acquisition.warming import measure_moving
        from errormotion.methods.linear_positioning.diagonals.acquisition import measure_diagonals

        if settings.diagonals is not None:
            return measure_diagonals(bench, settings, done)
        if settings.moving is not None:
            return measure_moving(bench, settings, done)
        return measure_axis(bench, settings, done)

    def motions(
        self,
        settings: LinearPositioningSettings,
        instruments: Mapping[str, Any] | None = None,  # noqa: ARG002 - part of the protocol
    ) -> list[Step]:
        """Return every step of the machine, for the check of its limits and for a dry run."""
        from errormotion.methods.linear_positioning.diagonals import planning
        from errormotion.methods.linear_positioning.planning.motions import steps

        return planning.steps(settings) if settings.diagonals is not None else steps(settings)

    def programs(
        self,
        settings: LinearPositioningSettings,
        instruments: Mapping[str, Any] | None = None,  # noqa: ARG002 - part of the protocol
    ) -> Mapping[str, str]:
        """Return the NC program of the test by file name."""
        from errormotion.methods.linear_positioning.diagonals import planning
        from errormotion.methods.linear_positioning.planning.motions import programs

        return planning.programs(settings) if settings.diagonals is not None else programs(settings)

    def check(self, settings: LinearPositioningSettings) -> dict[str, str]:
        """Return that the runs cannot determine their scatter or drift, and the settings do not state them."""
        if settings.diagonals is not None or settings.moving is not None:
            return {}
        from errormotion.methods.linear_positioning.identification.scatter import lacking

        return lacking(settings)

    def machine_defaults(self, machine: MachineDescription, settings: LinearPositioningSettings) -> dict[str, Any]:
        """Return the whole travel of the axis, less the overrun and what random positions of targets go beyond."""
        from errormotion.methods.linear_positioning.planning.targets import within

        span = machine.travel.get(settings.axis)
        if span is None or settings.diagonals is not None or settings.targets:
            return {}
        travel = span if settings.moving is not None else within(settings, span)
        return {} if travel is None else {"travel": travel}

    def check_machine(self, settings: LinearPositioningSettings, machine: MachineDescription) -> dict[str, str]:
        """Return by setting what the machine cannot do: an axis that it does not have, targets outside its travel."""
        from errormotion.methods.linear_positioning.diagonals import planning
        from errormotion.methods.linear_positioning.planning.targets import reach

        if settings.diagonals is not None:
            return planning.outside(settings, machine)
        if settings.axis not in machine.travel:
            return {"axis": f"expected one of {', '.join(machine.travel)}; found '{settings.axis}'"}
        low, high = machine.travel[settings.axis]
        first, last = settings.travel if settings.moving is not None else reach(settings)
        if first < low - 1e-9 or last > high + 1e-9:
            return {
                "travel": f"expected targets and overrun within {low * 1e3:g} mm to {high * 1e3:g} mm; found "
                f"{first * 1e3:.3f} mm to {last * 1e3:.3f} mm"
            }
        return {}

    def cannot_continue(self, settings: LinearPositioningSettings) -> str:
        """Return why an interrupted test of a moving axis cannot be continued."""
        from errormotion.methods.linear_positioning.acquisition.warming import NOT_CONTINUED

        return NOT_CONTINUED if settings.moving is not None else ""

    def check_bench(
        self,
        settings: LinearPositioningSettings,
        bench: Bench,
        inputs: Collection[str],  # noqa: ARG002 - part of the protocol
    ) -> list[str]:
        """Return what the instruments of the bench cannot do: move the axis, or read its freedoms."""
        from errormotion.methods.linear_positioning.acquisition.measure import AxisMeasurement, Motion
        from errormotion.methods.linear_positioning.diagonals.acquisition import readers_of

        if settings.diagonals is not None:
            Motion(bench, settings)
            readers_of(bench, settings)
        else:
            AxisMeasurement(bench, settings)
        return unarmed(bench, "controller")

    def append_dim(self, settings: LinearPositioningSettings) -> str:
        """Return ``run``, ``target`` for pendulum cycles, ``cycle`` for a moving axis, ``diagonal`` for diagonals."""
        if settings.diagonals is not None:
            return "diagonal"
        if settings.moving is not None:
            return "cycle"
        return "run" if settings.cycle == "linear" else "target"

    def progress(self, settings: LinearPositioningSettings) -> float:
        """Return the number of runs, of targets for pendulum cycles, of readings of a moving axis, of diagonals."""
        from errormotion.methods.linear_positioning import moving
        from errormotion.methods.linear_positioning.planning.targets import positions

        if settings.diagonals is not None:
            return float(len(settings.diagonals.names))
        if settings.moving is not None:
            return float(sum(1 for _ in moving.cycles(settings)))
        return float(settings.runs if settings.cycle == "linear" else positions(settings).size)

    def observe(self, raw: xr.Dataset, settings: LinearPositioningSettings) -> Observed:
        """Return what raw data mean, as stated in `identification.model`, or in `identification.moving`."""
        its = _evaluation(raw)
        observed: Observed = its.observe(raw, its.evaluate(raw, settings), settings)
        return observed

    def expected(self, settings: LinearPositioningSettings) -> xr.Dataset:
        """Return the readings of a test without noise, of an axis of the virtual machine."""
        from errormotion.methods.linear_positioning import simulation

        return simulation.expected(settings)

    def results(self, observed: Observed, fit: Fit, relative: Relative) -> Mapping[str, xr.DataArray]:  # noqa: ARG002
        """Return the squareness that diagonals determine."""
        if observed.sensitivity is None:
            return {}
        from errormotion.methods.linear_positioning.diagonals.identification import squareness

        return squareness(observed, relative)

    def identify(self, raw: xr.Dataset, settings: LinearPositioningSettings | None = None) -> xr.Dataset:
        """Return the error dataset of an axis over ``position``, or of diagonals over their stops.

        The model states the errors; the figures of the standard are added, which no trial and no plan needs.

        Parameters
        ----------
        raw : Dataset
            Schema ``errormotion.raw.linear_positioning/1``; not modified.
        settings : LinearPositioningSettings, optional

        Raises
        ------
        DatasetError
            The raw dataset violates its schema; all violations are reported together.
        MethodError
            The data do not determine the result.
        """
        from errormotion.datasets import provenance
        from errormotion.datasets.validation import checked_raw
        from errormotion.measurement.identification import dataset, solve

        settings = settings or LinearPositioningSettings()
        checked = checked_raw(raw, self)
        its = _evaluation(checked)
        evaluated = its.evaluate(checked, settings)
        solved = solve(its.observe(checked, evaluated, settings))
        more = dict(solved.observed.extras) | its.extras(evaluated, solved, settings)
        solved = replace(solved, observed=replace(solved.observed, extras=more))
        origin = provenance.make(settings, checked, None, steps=evaluated.steps)
        limits = {name: limit for name in LIMITS.values() if (limit := getattr(settings, name)) is not None}
        errors = dataset(self, solved, checked, self.info, origin)
        if "cycle" not in checked.dims:
            errors = errors.assign_attrs(limits)
        place = settings.straightness_reference
        if not place or "diagonal" in checked.dims:
            return errors
        return errors.assign_attrs({"straightness_reference": place} | errors.attrs)

    def simulate(self, settings: LinearPositioningSettings, seed: int) -> tuple[xr.Dataset, xr.Dataset]:
        """Return raw data with every source of the model drawn once, and the true errors.

        They do not state the scatter, which a test estimates, unless it has too few runs.
        """
        from errormotion.methods.linear_positioning.identification.scatter import MIN_RUNS

        raw, true = super().simulate(settings, seed)
        few = settings.moving is None and settings.runs < MIN_RUNS
        return (raw if few else raw.drop_vars(["reading_scatter", "run_drift"], errors="ignore")), true

    def plan(self, settings: LinearPositioningSettings | None = None) -> xr.Dataset:
        """Return an error dataset of zeros with the expected covariance."""
        from errormotion.methods.linear_positioning.plan import summary

        settings = settings or LinearPositioningSettings()
        planned = super().plan(settings)
        return planned.assign_attrs(notes=[*planned.em.notes, summary(planned, settings)])


def _evaluation(raw: xr.Dataset) -> Any:
    """Return the module that evaluates an axis, a moving axis, or diagonals."""
    from errormotion.methods.linear_positioning.diagonals import identification as diagonals
    from errormotion.methods.linear_positioning.identification import identify, moving

    return diagonals if "diagonal" in raw.dims else moving if "cycle" in raw.dims else identify
