"""The plugin ``crossbeam_scan``."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, ClassVar

from errormotion.measurement import ModelMethod
from errormotion.methods.crossbeam_scan.schema import SCHEMA
from errormotion.methods.crossbeam_scan.settings import CrossbeamScanSettings
from errormotion.plugins import Bench, MethodInfo, Needs, PluginSettings, Step, lazy, unarmed

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterator, Mapping, Sequence

    import xarray as xr

    from errormotion.kinematics.description import MachineDescription
    from errormotion.measurement import Observed
    from errormotion.plugins import TrialModel


class CrossbeamScan(ModelMethod):
    """Thermal errors of the carriage on a crossbeam, from repeated scans of artefacts below it."""

    info: ClassVar[MethodInfo] = MethodInfo(
        id="crossbeam_scan",
        summary="Six thermal errors of a crossbeam's axis from repeated scans of artefacts with a line profiler",
        status="simulated_only",
        version="5",
        cannot_see=(
            "errors of the cold machine: all errors are relative to the cold scans",
            "motion of the table and its artefacts together with the crossbeam",
            "errors between two artefacts that affect neither of them",
            "expansion of ram and spindle between carriage and tool, and of the table: they are a part of the errors",
        ),
    )
    needs: ClassVar[Needs] = Needs(instruments=("line_profiler",), raw_schema=SCHEMA)
    Settings: ClassVar[type[PluginSettings]] = CrossbeamScanSettings
    acquisition_settings: ClassVar[Sequence[str]] = (
        "procedure",
        "positions",
        "scan_length",
        "line_pitch",
        "warm_up",
        "cold_repeats",
        "measuring_feed",
        "warm_up_feed",
        "warm_up_travel",
        "margin",
        "travel",
        "scan_z",
        "encoder_pitch",
        "encoder_zero",
        "height_noise",
        "pocket_position",
        "pocket_z",
        "pocket_radius",
        "pocket_radius_uncertainty",
        "pocket_lifts",
        "pocket_scan_length",
        "layout",
    )
    raw_schemas = lazy("errormotion.methods.crossbeam_scan.schema:RAW_SCHEMAS")
    chapters = lazy("errormotion.methods.crossbeam_scan.report:chapters")
    texts = lazy("errormotion.methods.crossbeam_scan.report:texts")
    figures = lazy("errormotion.methods.crossbeam_scan.report.figures:figures")
    simulate = lazy("errormotion.methods.crossbeam_scan.simulation:simulate")
    truth = lazy("errormotion.methods.crossbeam_scan.simulation:truth_of")
    conformance = lazy("errormotion.methods.crossbeam_scan.conformance:subjects")

    def acquire(
        self,
        bench: Bench,
        settings: CrossbeamScanSettings,
        *,
        inputs: Mapping[str, xr.Dataset],
        done: xr.Dataset | None = None,
    ) -> Iterator[xr.Dataset]:
        """Measure; yield raw datasets to be joined along ``append_dim``. See ``acquisition`` and ``pocket``."""
        from errormotion.methods.crossbeam_scan.acquisition import pocket
        from errormotion.methods.crossbeam_scan.acquisition import scans as acquisition

        if settings.procedure == "profiler_pose":
            return pocket.record_pocket(bench, settings, done)
        return acquisition.record_scans(bench, settings, inputs.get("pose"), done)

    def machine_defaults(
        self,
        machine: MachineDescription,
        settings: CrossbeamScanSettings,  # noqa: ARG002 - part of the protocol
    ) -> dict[str, Any]:
        """Return the travel of Y."""
        return {"travel": machine.travel["Y"]} if "Y" in machine.travel else {}

    def check_machine(self, settings: CrossbeamScanSettings, machine: MachineDescription) -> dict[str, str]:
        """Return what contradicts the machine: Y does not carry the tool, or passes outside of its travel."""
        if "Y" not in machine.tool_axes:
            return {"": f"expected a machine whose axis Y carries the tool; found the chain '{machine.chain}'"}
        mistakes = {}
        low, high = machine.travel["Y"]
        if settings.travel and (settings.travel[0] < low - 1e-9 or settings.travel[1] > high + 1e-9):
            mistakes["travel"] = (
                f"expected ends within the travel of Y, {low * 1e3:g} mm to {high * 1e3:g} mm; "
                f"found {settings.travel[0] * 1e3:g} mm to {settings.travel[1] * 1e3:g} mm"
            )
        positions = settings.positions if settings.procedure == "scan" else (settings.pocket_position,)
        if outside := [y for y in positions if not low <= y <= high]:
            mistakes["positions"] = (
                f"expected positions within the travel of Y, {low * 1e3:g} mm to {high * 1e3:g} mm; "
                f"found {outside[0] * 1e3:g} mm"
            )
        return mistakes

    def check_bench(
        self,
        settings: CrossbeamScanSettings,
        bench: Bench,
        inputs: Collection[str],
    ) -> list[str]:
        """Return why the scans cannot be made: no pose of the profiler, a control that must not move the axis."""
        from errormotion.methods.crossbeam_scan.acquisition.moving import Controlled, mover
        from errormotion.methods.crossbeam_scan.acquisition.pocket import require_streaming
        from errormotion.methods.crossbeam_scan.acquisition.scans import pose_of

        profiler = bench.of_kind("line_profiler")
        if settings.procedure == "profiler_pose":
            require_streaming(profiler)
        elif "pose" not in inputs:
            pose_of(settings, None)
        moves = not hasattr(profiler, "scans") and isinstance(mover(bench), Controlled)
        return unarmed(bench, "controller") if moves else []

    def append_dim(self, settings: CrossbeamScanSettings) -> str:
        """Return ``scan`` for the profiler's pose, ``line`` for scans."""
        return "scan" if settings.procedure == "profiler_pose" else "line"

    def progress(self, settings: CrossbeamScanSettings) -> float:
        """Return the expected number of lines, or of scans of the pocket."""
        from errormotion.methods.crossbeam_scan.acquisition.scans import expected_lines

        return float(len(settings.pocket_lifts) if settings.procedure == "profiler_pose" else expected_lines(settings))

    def follow(self, settings: CrossbeamScanSettings) -> Callable[[xr.Dataset], str]:
        """Return a function that reports the progress for each chunk."""
        from errormotion.methods.crossbeam_scan.acquisition.live import LiveScans

        return LiveScans(settings).update

    def programs(
        self,
        settings: CrossbeamScanSettings,
        instruments: Mapping[str, Any] | None = None,  # noqa: ARG002 - part of the protocol
    ) -> Mapping[str, str]:
        """Return the NC programs of a campaign, name to text."""
        from errormotion.methods.crossbeam_scan.acquisition.schedule import program_texts

        return program_texts(settings)

    def motions(
        self,
        settings: CrossbeamScanSettings,
        instruments: Mapping[str, Any] | None = None,  # noqa: ARG002 - part of the protocol
    ) -> list[Step]:
        """Return every step of the machine, for the check of its limits and for a dry run."""
        from errormotion.methods.crossbeam_scan.acquisition.schedule import steps

        return steps(settings)

    def observe(self, raw: xr.Dataset, settings: CrossbeamScanSettings) -> Observed:
        """Return the registrations of scans as a problem of least squares; see ``identification.model``."""
        from errormotion.methods.crossbeam_scan.identification.scans import observe

        return observe(raw, settings)[0]

    def expected(self, settings: CrossbeamScanSettings) -> xr.Dataset:
        """Return the registrations of a campaign, without noise; see ``planning``."""
        from errormotion.methods.crossbeam_scan.planning import expected

        if settings.procedure == "profiler_pose":
            raise NotImplementedError("edges of a pocket scatter as the sensor sees them: nothing is expected of scans")
        return expected(settings)

    def plan(self, settings: CrossbeamScanSettings | None = None) -> xr.Dataset:
        """Return an error dataset of zeros with the expected covariance. See ``planning``."""
        from errormotion.methods.crossbeam_scan.planning import plan_pose

        settings = settings or CrossbeamScanSettings()
        return plan_pose(self.info, settings) if settings.procedure == "profiler_pose" else super().plan(settings)

    def trial_model(self, raw: xr.Dataset, settings: CrossbeamScanSettings, errors: xr.Dataset) -> TrialModel:
        """Return the sources of scans, or those of a pocket, for the Monte Carlo evaluation."""
        from errormotion.methods.crossbeam_scan.identification.profiler_pose.pose_errors import trial_model

        return trial_model(raw, settings) if "pocket_radius" in raw else super().trial_model(raw, settings, errors)

    def identify(self, raw: xr.Dataset, settings: CrossbeamScanSettings | None = None) -> xr.Dataset:
        """Return the error dataset of a raw dataset: of component ``Y`` for scans, ``beam`` for scans of a pocket.

        Parameters
        ----------
        raw : Dataset
            Schema ``errormotion.raw.crossbeam_scan/1``, any variant; not modified; it may be larger than memory.
        settings : CrossbeamScanSettings, optional

        Raises
        ------
        DatasetError
            The raw dataset violates its schema; all violations are reported together.
        MethodError
            The data do not determine the result.
        """
        from errormotion.datasets.validation import checked_raw

        settings = settings or CrossbeamScanSettings()
        checked = checked_raw(raw, self)
        if "pocket_radius" in checked:
            from errormotion.methods.crossbeam_scan.identification.profiler_pose.pose_errors import identify_pose

            return identify_pose(checked, settings, self.info.id, self.info.version)
        from errormotion.methods.crossbeam_scan.identification.scans import identify_scans

        return identify_scans(self, checked, settings)
