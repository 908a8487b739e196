"""The plugin ``spindle_drift``."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, ClassVar

from errormotion.measurement import ModelMethod
from errormotion.methods.spindle_drift.schema import SCHEMA
from errormotion.methods.spindle_drift.settings import SpindleDriftSettings, TrialSettings
from errormotion.plugins import Bench, MethodInfo, Needs, PluginSettings, lazy, unarmed

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterator, Mapping, Sequence

    import xarray as xr

    from errormotion.kinematics.description import MachineDescription
    from errormotion.measurement import Observed
    from errormotion.plugins import TrialModel


class SpindleDrift(ModelMethod):
    """Thermal displacement and tilt of a spindle, from five distance sensors on a bar."""

    info: ClassVar[MethodInfo] = MethodInfo(
        id="spindle_drift",
        summary="Spindle drift with five sensors on a bar, ISO 230-3: beam detection and drift",
        status="simulated_only",
        version="6",
        cannot_see=(
            "the rotation about the spindle axis (EC)",
            "errors within one turn of the spindle, which are averaged out",
            "motion of the sensor frame that is not related to its temperature",
            "noise of the sensors that is as slow as the drift",
        ),
    )
    needs: ClassVar[Needs] = Needs(instruments=("spindle_frame",), raw_schema=SCHEMA)
    Settings: ClassVar[type[PluginSettings]] = SpindleDriftSettings
    acquisition_settings: ClassVar[Sequence[str]] = (
        "procedure",
        "duration",
        "sphere_radius",
        "depths",
        "scan_length",
        "steps",
        "layout",
    )
    raw_schemas = lazy("errormotion.methods.spindle_drift.schema:RAW_SCHEMAS")
    chapters = lazy("errormotion.methods.spindle_drift.report:chapters")
    texts = lazy("errormotion.methods.spindle_drift.report:texts")
    log_readers = lazy("errormotion.methods.spindle_drift.log_import.importer:LOG_READERS")
    figures = lazy("errormotion.methods.spindle_drift.figures:figures")
    motions = lazy("errormotion.methods.spindle_drift.acquisition.motions:steps")
    simulate = lazy("errormotion.methods.spindle_drift.simulation:simulate")
    truth = lazy("errormotion.methods.spindle_drift.simulation:truth_of")
    conformance = lazy("errormotion.methods.spindle_drift.conformance:subjects")

    def acquire(
        self,
        bench: Bench,
        settings: SpindleDriftSettings,
        *,
        inputs: Mapping[str, xr.Dataset],
        done: xr.Dataset | None = None,
    ) -> Iterator[xr.Dataset]:
        """Measure; yield raw datasets to be joined along ``append_dim``.

        For a drift, ``inputs`` may contain the ``beams`` of a detection, or single beams by the names of the channels.
        """
        from errormotion.methods.spindle_drift.acquisition import beams as scanning
        from errormotion.methods.spindle_drift.acquisition import drift as acquisition
        from errormotion.methods.spindle_drift.acquisition.given_beams import given_beams

        if settings.procedure == "beam_detection":
            return scanning.detect_beams(bench, settings, done)
        return acquisition.record_drift(bench, settings, given_beams(inputs), done)

    def check_machine(self, settings: SpindleDriftSettings, machine: MachineDescription) -> dict[str, str]:  # noqa: ARG002
        """Return what contradicts the machine: a spindle axis other than Z, the axis of the measuring frame."""
        if machine.spindle_axis == "Z":
            return {}
        return {
            "": "expected a spindle axis Z, the direction of the channel Z of the measuring frame; found "
            f"{machine.spindle_axis}"
        }

    def check_bench(
        self,
        settings: SpindleDriftSettings,
        bench: Bench,
        inputs: Collection[str],  # noqa: ARG002 - part of the protocol
    ) -> list[str]:
        """Return why the bench cannot move the sphere, or start the schedule."""
        from errormotion.methods.spindle_drift.acquisition.beams import control_of
        from errormotion.methods.spindle_drift.acquisition.drift import starts_schedules

        if settings.procedure == "beam_detection":
            control_of(bench)
        elif not starts_schedules(bench):
            return []
        return unarmed(bench, "controller")

    def append_dim(self, settings: SpindleDriftSettings) -> str:
        """Return ``sample`` for a beam detection (scan after scan), ``time`` for a drift record."""
        return "sample" if settings.procedure == "beam_detection" else "time"

    def progress(self, settings: SpindleDriftSettings) -> float:
        """Return the expected length of the record, s."""
        if settings.procedure == "beam_detection":
            from errormotion.methods.spindle_drift.identification.segmentation import scan_seconds

            return 5 * 2 * len(settings.depths) * scan_seconds(settings.steps, settings.dwell)
        return settings.duration

    def follow(self, settings: SpindleDriftSettings) -> Callable[[xr.Dataset], str]:
        """Return a function that describes each acquired chunk in a line of text."""
        if settings.procedure == "beam_detection":
            return _beam_text
        from errormotion.methods.spindle_drift.acquisition.live import LiveDrift

        return LiveDrift(settings).update

    def identify(self, raw: xr.Dataset, settings: SpindleDriftSettings | None = None) -> xr.Dataset:
        """Return the error dataset of a raw dataset: of component ``spindle`` for a drift, ``beam`` for a detection.

        The raw dataset is not modified, and may be larger than memory. Errors as for `ModelMethod.identify`.
        """
        if "sphere_radius" not in raw:
            return super().identify(raw, settings)
        from errormotion.datasets.validation import checked_raw
        from errormotion.methods.spindle_drift.identification.detection import identify_beams

        return identify_beams(
            checked_raw(raw, self), settings or SpindleDriftSettings(), self.info.id, self.info.version
        )

    def observe(self, raw: xr.Dataset, settings: SpindleDriftSettings) -> Observed:
        """Return what a drift record means; see ``model``."""
        from errormotion.methods.spindle_drift.model import observe

        return observe(raw, settings)

    def expected(self, settings: SpindleDriftSettings) -> xr.Dataset:
        """Return the raw data of a test without noise; see ``planning``."""
        from errormotion.methods.spindle_drift.planning import expected

        return expected(settings)

    def planning_settings(self, settings: SpindleDriftSettings, instruments: Mapping[str, Any]) -> SpindleDriftSettings:
        """Return the settings with bar, levels, noise and expansion of the frame on the bench, where none is stated."""
        frame = instruments.get("spindle_frame")
        names = {"bar_radius": "bar_radius", "levels": "levels", "noise": "noise"}
        if "thermometer" in instruments:  # otherwise the expansion is not corrected
            names["frame_expansion"] = "expansion"
        of_frame = {name: getattr(frame, own, None) for name, own in names.items()}
        stated = settings.layout.model_fields_set
        update = {name: value for name, value in of_frame.items() if value is not None and name not in stated}
        return settings.model_copy(update={"layout": settings.layout.model_copy(update=update)})

    def plan(self, settings: SpindleDriftSettings | None = None) -> xr.Dataset:
        """Return an error dataset of zeros with the expected covariance."""
        its = TrialSettings.of(settings or SpindleDriftSettings())
        if its.procedure == "beam_detection":
            from errormotion.methods.spindle_drift.planning import plan_beams

            return plan_beams(its, self.info.id, self.info.version)
        return super().plan(its)

    def trial_model(self, raw: xr.Dataset, settings: SpindleDriftSettings, errors: xr.Dataset) -> TrialModel:
        """Return the sources of the uncertainty of raw data, for the Monte Carlo evaluation."""
        if "sphere_radius" in raw:
            from errormotion.methods.spindle_drift.trial_model import trial_model_of_beams

            return trial_model_of_beams(raw, settings, errors)
        return super().trial_model(raw, TrialSettings.of(settings), errors)


def _beam_text(chunk: xr.Dataset) -> str:
    channel, profile = divmod(int(chunk["scan"].values[-1]), chunk.sizes["profile"])
    return f"beam {chunk['channel'].values[channel]}, profile {profile + 1} of {chunk.sizes['profile']}"
