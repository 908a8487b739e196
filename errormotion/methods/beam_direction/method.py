"""The plugin ``beam_direction``."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

from errormotion.errors import DatasetError
from errormotion.measurement.method import ModelMethod
from errormotion.methods.beam_direction.schema import SCHEMA
from errormotion.methods.beam_direction.settings import BeamDirectionSettings
from errormotion.plugins import Bench, MethodInfo, Needs, PluginSettings, lazy, unarmed

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator, Mapping, Sequence

    import xarray as xr

    from errormotion.measurement.observed import Observed


class BeamDirection(ModelMethod):
    """Origin and direction of the beam of a point sensor, from its readings on planes while a stage moves it."""

    info: ClassVar[MethodInfo] = MethodInfo(
        id="beam_direction",
        summary="Origin and direction of a point sensor's beam from planes of a sine gauge, inclination compensated",
        status="simulated_only",
        version="3",
        cannot_see=(
            "the rotation of the beam about its axis",
            "the zero point, if fewer than three planes have a known point",
            "errors of the stage, whose axes are assumed to be straight and square",
        ),
    )
    needs: ClassVar[Needs] = Needs(instruments=("point_lds", "controller"), raw_schema=SCHEMA)
    Settings: ClassVar[type[PluginSettings]] = BeamDirectionSettings
    acquisition_settings: ClassVar[Sequence[str]] = ("planes",)
    raw_schemas = lazy("errormotion.methods.beam_direction.schema:RAW_SCHEMAS")
    chapters = lazy("errormotion.methods.beam_direction.report:chapters")
    texts = lazy("errormotion.methods.beam_direction.report:texts")
    figures = lazy("errormotion.methods.beam_direction.figures:figures")
    calibrations = lazy("errormotion.methods.beam_direction.identification.inclination.figures:CALIBRATIONS")
    motions = lazy("errormotion.methods.beam_direction.motions:steps")
    conformance = lazy("errormotion.methods.beam_direction.conformance:subjects")
    grows = "plane"

    def acquire(
        self,
        bench: Bench,
        settings: BeamDirectionSettings,
        *,
        inputs: Mapping[str, xr.Dataset],
        done: xr.Dataset | None = None,
    ) -> Iterator[xr.Dataset]:
        """Measure; yield one raw dataset per plane."""
        from errormotion.methods.beam_direction import acquisition

        return acquisition.measure_planes(bench, settings, inputs, done)

    def check(self, settings: BeamDirectionSettings) -> dict[str, str]:
        """Return by setting why the compensation of the settings is not possible; empty if it is."""
        if settings.compensation is None:
            return {}
        from errormotion.datasets.calibrations.inclination import InclinationCalibration
        from errormotion.methods.beam_direction.identification.reading import NORMAL_NEEDED, RECEIVER_NEEDED

        mistakes = {}
        try:
            InclinationCalibration.find(settings.compensation)
        except DatasetError as error:
            mistakes["compensation"] = str(error)
        if settings.layout.triangulation_normal is None:
            mistakes["layout.triangulation_normal"] = NORMAL_NEEDED
        if settings.receiver is None:
            mistakes["receiver"] = RECEIVER_NEEDED
        return mistakes

    def check_bench(
        self,
        settings: BeamDirectionSettings,  # noqa: ARG002 - part of the protocol
        bench: Bench,
        inputs: Collection[str],  # noqa: ARG002 - part of the protocol
    ) -> list[str]:
        """Return why the bench cannot move the sensor over the faces of the gauge."""
        from errormotion.methods.beam_direction.acquisition import control_of

        control_of(bench)
        return unarmed(bench, "controller")

    def progress(self, settings: BeamDirectionSettings) -> float:
        """Return the number of planes."""
        return float(len(settings.planes))

    def observe(self, raw: xr.Dataset, settings: BeamDirectionSettings) -> Observed:
        """Return readings on planes as a model of the beam."""
        from errormotion.methods.beam_direction.identification.beam import observe
        from errormotion.methods.beam_direction.identification.sensor import Sensor

        return observe(raw, settings, Sensor.of(raw, settings))

    def identify(self, raw: xr.Dataset, settings: BeamDirectionSettings | None = None) -> xr.Dataset:
        """Return the error dataset of component ``beam``.

        A check bar without planes is evaluated with the beam stated in the data; the errors of the beam are then NaN.

        Parameters
        ----------
        raw : Dataset
            Schema ``errormotion.raw.beam_direction/1``; not modified.
        settings : BeamDirectionSettings, optional

        Raises
        ------
        DatasetError
            The raw dataset violates its schema (all violations are reported together), or the calibration is not found.
        MethodError
            The data do not determine the result.
        """
        from errormotion.datasets.validation import checked_raw
        from errormotion.methods.beam_direction.identification.result import identify

        return identify(self, checked_raw(raw, self), settings or BeamDirectionSettings())

    def plan(self, settings: BeamDirectionSettings | None = None) -> xr.Dataset:
        """Return an error dataset of zeros with the expected covariance, and that of the best set-ups."""
        from errormotion.methods.beam_direction.planning.plan import plan

        return plan(self, settings or BeamDirectionSettings())

    def expected(self, settings: BeamDirectionSettings) -> xr.Dataset:
        """Return the readings of a nominal beam on the planes of the settings."""
        from errormotion.methods.beam_direction.planning.plan import expected

        return expected(settings)
