"""The plugin ``normal_vector``."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, ClassVar

from errormotion.measurement import ModelMethod
from errormotion.methods.normal_vector.schema import SCHEMA
from errormotion.methods.normal_vector.settings import NormalVectorSettings
from errormotion.plugins import Bench, MethodInfo, Needs, PluginSettings, lazy, unarmed

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterator, Mapping, Sequence

    import xarray as xr

    from errormotion.kinematics.description import MachineDescription
    from errormotion.measurement import Observed


class NormalVector(ModelMethod):
    """Translation and rotation of the frame of the axes during warm-up, from balls touched by the machine itself."""

    info: ClassVar[MethodInfo] = MethodInfo(
        id="normal_vector",
        summary="Thermal error from balls on the table, touched by the machine's own probe while it warms up",
        status="simulated_only",
        version="3",
        cannot_see=(
            "a tilt of the spindle relative to the last axis: the tip keeps its position in the spindle, so that all "
            "balls appear displaced equally",
            "where two axes carry the workpiece: the rotation about the axis that carries the tool, and the other "
            "rotations unless the balls lie at different heights along it",
            "bending and expansion of the axes: they are assumed to move as one rigid frame",
            "drift faster than the interval of the probing cycles",
            "expansion of the balls' posts, of the stylus and of the probe: it appears as an error of the machine",
            "another angle of the spindle than in the cold cycle: the runout of the tip appears as EX and EY",
        ),
    )
    needs: ClassVar[Needs] = Needs(instruments=("touch_probe",), raw_schema=SCHEMA)
    Settings: ClassVar[type[PluginSettings]] = NormalVectorSettings
    acquisition_settings: ClassVar[Sequence[str]] = (
        "balls",
        "touches",
        "elevation",
        "order",
        "tip_radius",
        "touch_noise",
        "approach",
        "overtravel",
        "clearance",
        "probing_feed",
        "positioning_feed",
        "duration",
        "interval",
        "schedule",
        "moves",
        "moves_feed",
        "settle",
        "to_probe",
        "to_warm_up",
        "dwell",
    )
    raw_schemas = lazy("errormotion.methods.normal_vector.schema:RAW_SCHEMAS")
    chapters = lazy("errormotion.methods.normal_vector.report:chapters")
    texts = lazy("errormotion.methods.normal_vector.report:texts")
    figures = lazy("errormotion.datasets.results.merit:last_values")
    motions = lazy("errormotion.methods.normal_vector.acquisition.cycle:campaign_steps")
    simulate = lazy("errormotion.methods.normal_vector.simulation:simulate")
    truth = lazy("errormotion.methods.normal_vector.simulation:truth_of")
    conformance = lazy("errormotion.methods.normal_vector.conformance:subjects")

    def acquire(
        self,
        bench: Bench,
        settings: NormalVectorSettings,
        *,
        inputs: Mapping[str, xr.Dataset],  # noqa: ARG002 - part of the protocol
        done: xr.Dataset | None = None,
    ) -> Iterator[xr.Dataset]:
        """Measure; yield one raw dataset for each probing cycle. See ``acquisition``."""
        from errormotion.methods.normal_vector.acquisition import measure as acquisition

        return acquisition.acquire(bench, settings, done)

    def programs(
        self, settings: NormalVectorSettings, instruments: Mapping[str, Any] | None = None
    ) -> Mapping[str, str]:
        """Return the NC programs of the test, file name to text.

        The tip radius is that of the settings, else that of the bench's touch probe.
        """
        from errormotion.methods.normal_vector.acquisition.programs import programs

        tip = getattr((instruments or {}).get("touch_probe"), "tip_radius", None)
        return programs(settings if settings.tip_radius or not tip else settings.model_copy(update={"tip_radius": tip}))

    def check(self, settings: NormalVectorSettings) -> dict[str, str]:
        """Return the settings with which no campaign is possible: too few balls, or no cycle after the cold one."""
        mistakes = {}
        if len(settings.balls) < 3:
            mistakes["balls"] = f"expected the approximate centres of three or more balls; found {len(settings.balls)}"
        if settings.interval > settings.duration:
            mistakes["interval"] = (
                f"expected at most the duration, {settings.duration:g} s, so that a cycle follows the cold one; "
                f"found {settings.interval:g} s"
            )
        return mistakes

    def machine_defaults(
        self,
        machine: MachineDescription,
        settings: NormalVectorSettings,  # noqa: ARG002 - part of the protocol
    ) -> dict[str, str]:
        """Return the axes that carry the tool."""
        return {"tool_axes": machine.tool_axes}

    def check_machine(self, settings: NormalVectorSettings, machine: MachineDescription) -> dict[str, str]:
        """Return what contradicts the machine: other axes that carry the tool."""
        if settings.tool_axes == machine.tool_axes:
            return {}
        return {
            "tool_axes": f"expected '{machine.tool_axes}', the axes that carry the tool; found '{settings.tool_axes}'"
        }

    def check_bench(
        self,
        settings: NormalVectorSettings,  # noqa: ARG002 - part of the protocol
        bench: Bench,
        inputs: Collection[str],  # noqa: ARG002 - part of the protocol
    ) -> list[str]:
        """Return why the bench cannot probe and warm up the machine."""
        from errormotion.methods.normal_vector.acquisition.measure import route

        _, _, active, driven = route(bench)
        commanded = (["touch_probe"] if active else []) + (["controller"] if driven else [])
        return [text for kind in commanded for text in unarmed(bench, kind)]

    def progress(self, settings: NormalVectorSettings) -> float:
        """Return the number of probing cycles, including the cold one."""
        from errormotion.methods.normal_vector.acquisition.cycle import cycles

        return float(cycles(settings))

    def follow(self, settings: NormalVectorSettings) -> Callable[[xr.Dataset], str]:
        """Return a function that reports the displacement of the balls after each cycle; see ``live``."""
        from errormotion.methods.normal_vector.acquisition.live import LiveBalls

        return LiveBalls(settings).update

    def observe(self, raw: xr.Dataset, settings: NormalVectorSettings) -> Observed:
        """Return the touches as a problem of least squares; see ``model``."""
        from errormotion.methods.normal_vector.result import observe

        return observe(raw, settings)

    def expected(self, settings: NormalVectorSettings) -> xr.Dataset:
        """Return the touches of a machine without errors; see ``planning``."""
        from errormotion.methods.normal_vector.planning import expected

        return expected(settings)

    def identify(self, raw: xr.Dataset, settings: NormalVectorSettings | None = None) -> xr.Dataset:
        """Turn a raw dataset into an error dataset of component ``tool`` over ``time``.

        Parameters
        ----------
        raw : Dataset
            Schema ``errormotion.raw.normal_vector/1``, either variant; not modified.
        settings : NormalVectorSettings, optional

        Raises
        ------
        DatasetError
            The raw dataset violates its schema; all violations are reported together.
        MethodError
            The data do not determine the errors, or contradict the stated balls.
        """
        from errormotion.datasets.validation import checked_raw
        from errormotion.methods.normal_vector.result import identified

        return identified(self, checked_raw(raw, self), settings or NormalVectorSettings())

    def planning_settings(self, settings: NormalVectorSettings, instruments: Mapping[str, Any]) -> NormalVectorSettings:
        """Return the settings with tip radius and noise of a touch of the probe on the bench, where they state none."""
        probe = instruments.get("touch_probe")
        stated = {"tip_radius": getattr(probe, "tip_radius", None), "touch_noise": getattr(probe, "noise", None)}
        return settings.model_copy(
            update={name: value for name, value in stated.items() if value and getattr(settings, name) is None}
        )

    def plan(self, settings: NormalVectorSettings | None = None) -> xr.Dataset:
        """Return an error dataset of zeros over the cycles with the expected covariance. See ``planning``."""
        from errormotion.methods.normal_vector.planning import plan

        return plan(self, settings or NormalVectorSettings())
