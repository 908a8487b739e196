"""The plugin ``multilateration``."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, ClassVar

from errormotion.measurement import ModelMethod
from errormotion.methods.multilateration.schema import SCHEMA
from errormotion.methods.multilateration.settings import MultilaterationSettings
from errormotion.plugins import Bench, MethodInfo, Needs, PluginSettings, Step, lazy, unarmed

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator, Mapping, Sequence

    import xarray as xr

    from errormotion.kinematics.description import MachineDescription
    from errormotion.measurement import Observed
    from errormotion.plugins import TrialModel


class Multilateration(ModelMethod):
    """Errors of the volume and of the axes from distances of a reflector to four or more positions of a tracker."""

    info: ClassVar[MethodInfo] = MethodInfo(
        id="multilateration",
        summary="Volumetric error and the errors of three axes from tracker distances, stations and dead paths unknown",
        status="simulated_only",
        version="6",
        cannot_see=(
            "the six rigid motions of the whole: position and orientation of the machine's coordinates are fitted",
            "rotations of the tool at a target: a reflector is a point",
            "with one reflector position: rotations of the axis that carries it, and others with the same effect",
            "drift that displaces and rotates the machine as a whole from one set-up to the next",
            "errors of the reflector that depend on its angle to the beam: they appear as errors of the machine",
        ),
    )
    needs: ClassVar[Needs] = Needs(instruments=("laser_tracker",), raw_schema=SCHEMA)
    Settings: ClassVar[type[PluginSettings]] = MultilaterationSettings
    acquisition_settings: ClassVar[Sequence[str]] = (
        "layout",
        "planning",
        "measuring",
    )
    raw_schemas = lazy("errormotion.methods.multilateration.schema:RAW_SCHEMAS")
    chapters = lazy("errormotion.methods.multilateration.report:chapters")
    texts = lazy("errormotion.methods.multilateration.report:texts")
    figures = lazy("errormotion.methods.multilateration.figures:figures")
    simulate = lazy("errormotion.methods.multilateration.simulation:simulate")
    truth = lazy("errormotion.methods.multilateration.simulation:truth_of")
    conformance = lazy("errormotion.methods.multilateration.conformance:subjects")

    def acquire(
        self,
        bench: Bench,
        settings: MultilaterationSettings,
        *,
        inputs: Mapping[str, xr.Dataset],
        done: xr.Dataset | None = None,
    ) -> Iterator[xr.Dataset]:
        """Measure; yield one raw dataset per set-up."""
        from errormotion.methods.multilateration.acquisition import measure as acquisition

        return acquisition.measure_stations(bench, settings, inputs, done)

    def motions(
        self,
        settings: MultilaterationSettings,
        instruments: Mapping[str, Any] | None = None,  # noqa: ARG002 - part of the protocol
    ) -> list[Step]:
        """Return every step of the machine, for the check of its limits and for a dry run."""
        from errormotion.methods.multilateration.acquisition.motions import steps

        return steps(settings)

    def machine_defaults(
        self,
        machine: MachineDescription,
        settings: MultilaterationSettings,  # noqa: ARG002 - part of the protocol
    ) -> dict[str, str]:
        """Return the chain of the moving axes."""
        return {"chain": machine.moving_chain}

    def check_machine(self, settings: MultilaterationSettings, machine: MachineDescription) -> dict[str, str]:
        """Return by setting what contradicts the machine: other axes, another chain, targets outside the travel."""
        if machine.moving_axes != ("X", "Y", "Z"):
            moving = ", ".join(machine.moving_axes)
            return {"": f"expected a machine with the moving axes X, Y and Z; found {moving}. Fix the rotary axes"}
        contradictions = {}
        if settings.chain != machine.moving_chain:
            contradictions["chain"] = f"expected '{machine.moving_chain}'; found '{settings.chain}'"
        corners = settings.layout.targets or (settings.layout.low, settings.layout.high)
        for axis, column in zip("XYZ", zip(*corners, strict=True), strict=True):
            low, high = machine.travel[axis]
            if min(column) < low - 1e-9 or max(column) > high + 1e-9:
                contradictions["layout"] = (
                    f"expected targets within the travel of {axis}, {low * 1e3:g} mm to {high * 1e3:g} mm; "
                    f"found {min(column) * 1e3:g} mm to {max(column) * 1e3:g} mm"
                )
        return contradictions

    def check_bench(
        self,
        settings: MultilaterationSettings,
        bench: Bench,
        inputs: Collection[str],  # noqa: ARG002 - part of the protocol
    ) -> list[str]:
        """Return what the instruments of the bench cannot do: move the machine, or measure its targets."""
        from errormotion.methods.multilateration.acquisition.measure import SetUps

        SetUps(bench, settings, settings.measuring)
        return unarmed(bench, "controller")

    def append_dim(self, settings: MultilaterationSettings) -> str:  # noqa: ARG002 - part of the protocol
        """Return ``station``."""
        return "station"

    def progress(self, settings: MultilaterationSettings) -> float:
        """Return the number of set-ups."""
        return float(len(settings.measuring.sequence or settings.layout.stations))

    def observe(self, raw: xr.Dataset, settings: MultilaterationSettings) -> Observed:
        """Return the readings as a network; see ``result`` and ``model``."""
        from errormotion.methods.multilateration.result import observe

        return observe(raw, settings)

    def identify(self, raw: xr.Dataset, settings: MultilaterationSettings | None = None) -> xr.Dataset:
        """Return the error dataset of component ``tool`` over ``target``, from the last set-up of each station."""
        from errormotion.methods.multilateration.readings import latest

        return super().identify(latest(raw), settings)

    def expected(self, settings: MultilaterationSettings) -> xr.Dataset:
        """Return the readings of the layout without errors; see ``planning.plan``."""
        from errormotion.methods.multilateration.planning.plan import expected

        return expected(settings)

    def trial_model(self, raw: xr.Dataset, settings: MultilaterationSettings, errors: xr.Dataset) -> TrialModel:
        """Return all sources of the model; the repeatability of simultaneous stations displaces the targets."""
        from errormotion.methods.multilateration.readings import latest
        from errormotion.methods.multilateration.repeatability import displaced

        model = super().trial_model(latest(raw), settings, errors)
        return displaced(model, errors) if settings.together and "repeatability" in errors else model

    def plan(self, settings: MultilaterationSettings | None = None) -> xr.Dataset:
        """Return an error dataset of zeros with the expected covariance of the layout, and the best layout."""
        from errormotion.methods.multilateration.planning.plan import with_best_layout

        settings = settings or MultilaterationSettings()
        return with_best_layout(super().plan(settings), settings, settings.planning)
