"""The plugin ``normal_vector``."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, ClassVar

import xarray as xr

from errormotion.datasets import validate
from errormotion.errors import MethodError
from errormotion.methods.normal_vector.settings import Settings as BallSettings
from errormotion.plugins import Bench, MethodInfo, Needs, PluginSettings, Step, lazy

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping

SCHEMA = "errormotion.raw.normal_vector/1"


class NormalVector:
    """How the frame of a machine's axes moves and turns while it warms up, from balls that its own probe touches."""

    info: ClassVar[MethodInfo] = MethodInfo(
        id="normal_vector",
        summary="Thermal error from balls on the table, touched by the machine's own probe while it warms up",
        status="simulated_only",
        version="1",
        cannot_see=(
            "a tilt of the spindle behind the last axis: the tip always sits at the same place of it, and all balls "
            "seem to move alike",
            "where two axes carry the workpiece: the turn about the one that carries the tool, and the other turns "
            "without balls at different heights along it",
            "what bends or stretches the axes: they are taken to move as one rigid frame",
            "drift faster than the probing cycles follow one another",
        ),
    )
    needs: ClassVar[Needs] = Needs(instruments=("touch_probe",), raw_schema=SCHEMA)
    Settings: ClassVar[type[PluginSettings]] = BallSettings
    raw_schemas = lazy("errormotion.methods.normal_vector.schema:RAW_SCHEMAS")
    chapters = lazy("errormotion.methods.normal_vector.report:chapters")
    figures = lazy("errormotion.report.figures:last_values")
    simulate = lazy("errormotion.methods.normal_vector.simulation:simulate")
    conformance = lazy("errormotion.methods.normal_vector.conformance:subjects")

    def acquire(
        self,
        bench: Bench,
        settings: BallSettings,
        *,
        inputs: Mapping[str, xr.Dataset],  # noqa: ARG002 - part of the protocol
        done: xr.Dataset | None = None,
    ) -> Iterator[xr.Dataset]:
        """Measure; yield one raw dataset a probing cycle. See ``acquisition``."""
        from errormotion.methods.normal_vector.acquisition import measure as acquisition

        return acquisition.acquire(bench, settings, done)

    def programs(self, settings: BallSettings, instruments: Mapping[str, Any] | None = None) -> Mapping[str, str]:
        """Return the NC programs with which a machine makes the test by itself, the name of each file to its text.

        The tip is that of the settings, else that of the bench's touch probe.
        """
        from errormotion.methods.normal_vector.acquisition.programs import programs

        tip = getattr((instruments or {}).get("touch_probe"), "tip_radius", None)
        return programs(settings if settings.tip_radius or not tip else settings.model_copy(update={"tip_radius": tip}))

    def motions(self, settings: BallSettings, instruments: Mapping[str, Any] | None = None) -> list[Step]:
        """Return every step that the machine will make, for its limits and for a dry run."""
        from errormotion.methods.normal_vector.acquisition.cycle import campaign_steps

        return campaign_steps(settings, instruments)

    def check(self, settings: BallSettings) -> dict[str, str]:
        """Return what a campaign cannot be made with: too few balls, or no cycle behind the cold one."""
        found = {}
        if len(settings.balls) < 3:
            found["balls"] = f"expected the rough places of three balls or more; found {len(settings.balls)}"
        if settings.interval > settings.duration:
            found["interval"] = (
                f"expected no more than the duration, {settings.duration:g} s, so that a cycle follows the cold one; "
                f"found {settings.interval:g} s"
            )
        return found

    def append_dim(self, settings: BallSettings) -> str:  # noqa: ARG002 - part of the protocol
        """Return ``time``."""
        return "time"

    def progress(self, settings: BallSettings) -> float:
        """Return the number of probing cycles, the cold one included."""
        from errormotion.methods.normal_vector.acquisition.cycle import cycles

        return float(cycles(settings))

    def follow(self, settings: BallSettings) -> Callable[[xr.Dataset], str]:
        """Return what tells of each cycle how far the balls have gone; see ``live``."""
        from errormotion.methods.normal_vector.acquisition.live import LiveBalls

        return LiveBalls(settings).update

    def identify(self, raw: xr.Dataset, settings: BallSettings | None = None) -> xr.Dataset:
        """Turn a raw dataset into an error dataset of component ``tool`` over ``time``.

        Parameters
        ----------
        raw : Dataset
            Schema ``errormotion.raw.normal_vector/1``, either variant; stays as it is.
        settings : Settings, optional

        Raises
        ------
        DatasetError
            The raw dataset does not follow its schema; all violations at once.
        MethodError
            The data do not determine the answer, or contradict what is stated of the balls.
        """
        from errormotion.methods.normal_vector.identification.identify import identify_motion

        settings = settings or BallSettings()
        checked = raw if "schema" in raw.attrs else raw.assign_attrs(schema=SCHEMA)
        validate(checked)
        if checked.attrs["schema"] != SCHEMA:
            raise MethodError(f"normal_vector reads raw data of schema {SCHEMA}; found {checked.attrs['schema']}.")
        return identify_motion(checked, settings, self.info.id, self.info.version)

    def plan(self, settings: BallSettings | None = None) -> xr.Dataset:
        """Return an error dataset of zeros over the cycles whose covariance is the one to expect. See ``planning``."""
        from errormotion.methods.normal_vector.planning import plan

        return plan(self, settings or BallSettings())
