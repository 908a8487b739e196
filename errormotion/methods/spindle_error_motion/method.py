"""The plugin ``spindle_error_motion``."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import TYPE_CHECKING, Any, ClassVar

import xarray as xr

from errormotion.measurement import ModelMethod
from errormotion.methods.spindle_error_motion.schema import SCHEMA
from errormotion.methods.spindle_error_motion.settings import SpindleErrorMotionSettings
from errormotion.plugins import FigureOfMerit, MethodInfo, Needs, PluginSettings, lazy

if TYPE_CHECKING:
    from errormotion.measurement import Observed


class SpindleErrorMotion(ModelMethod):
    """Error motions of a turning spindle after ISO 230-7, from displacement sensors on a ball or a bar."""

    info: ClassVar[MethodInfo] = MethodInfo(
        id="spindle_error_motion",
        summary="Error motions of a turning spindle by sensors on a ball or a bar, ISO 230-7",
        status="simulated_only",
        cannot_see=(
            "what occurs once a turn across the axis, as far as the eccentricity of the artefact imitates it",
            "the form of the artefact, unless it is stated: it counts as synchronous error motion",
            "an uneven rotation within a turn, without an encoder",
            "motions of the sensors and of their fixture relative to the table",
            "the squareness of a face to the axis, which is a fundamental axial motion for a sensor beside the axis",
        ),
    )
    needs: ClassVar[Needs] = Needs(instruments=(), raw_schema=SCHEMA)
    Settings: ClassVar[type[PluginSettings]] = SpindleErrorMotionSettings
    acquisition_settings: ClassVar[Sequence[str]] = (
        "axis",
        "sensors",
        "height",
        "artefact_radius",
        "spindle_speed",
        "turns",
        "sample_rate",
        "angle_from",
        "noise",
        "asynchronous",
        "eccentricity",
        "gain_uncertainty",
        "direction_uncertainty",
        "position_uncertainty",
        "roundness",
    )
    raw_schemas = lazy("errormotion.methods.spindle_error_motion.schema:RAW_SCHEMAS")
    conformance = lazy("errormotion.methods.spindle_error_motion.conformance:subjects")
    chapters = lazy("errormotion.methods.spindle_error_motion.report:chapters")
    texts = lazy("errormotion.methods.spindle_error_motion.report:texts")
    grows = "time"

    def also_append(self, settings: Any) -> Sequence[str]:
        """Return the dim of the index pulses."""
        return ("index",) if settings.angle_from == "index" else ()

    def observe(self, raw: xr.Dataset, settings: Any = None) -> Observed:
        """Return what a record means; see ``model``."""
        from errormotion.methods.spindle_error_motion.model import observe

        return observe(raw, settings or SpindleErrorMotionSettings())

    def expected(self, settings: Any) -> xr.Dataset:
        """Return the readings of a spindle with typical error motions; see ``simulation``."""
        from errormotion.methods.spindle_error_motion.simulation import expected

        return expected(settings)

    def simulate(self, settings: Any, seed: int) -> tuple[xr.Dataset, xr.Dataset]:
        """Return raw data of the virtual spindle with every source drawn once, and the true error motions."""
        from errormotion.methods.spindle_error_motion import simulation

        raw, other = simulation.simulate(settings, seed)
        return raw, simulation.truth_of(_planned(settings), settings, simulation.spindle_of(settings), raw, other)

    def plan(self, settings: Any = None) -> xr.Dataset:
        """Return an error dataset of zeros with the expected covariance, and a note on the figures."""
        planned = super().plan(settings)
        zero = {name: 0.0 * planned[name] for name in ("figure_value", "synchronous", "eccentricity")}
        words = [
            f"{figure.name} {1e6 * figure.expanded_uncertainty:.3f} {'um' if figure.unit == 'm' else 'urad'}"
            for figure in self.figures(planned)
        ]
        note = f"Expanded uncertainties (k = 2) for a typical spindle: {', '.join(words)}."
        return planned.assign(zero).assign_attrs(notes=[note])

    @staticmethod
    def figures(errors: xr.Dataset) -> list[FigureOfMerit]:
        """Return the values of ISO 230-7 with U, which contains the bias of an extreme value (JCGM 100, F.2.4.5)."""
        from errormotion.estimation.extremes import expanded

        sources, merits = errors["source"].values.tolist(), []
        U = expanded(errors["figure_bias"].values, errors["figure_u"].values)
        for k, name in enumerate(errors["figure"].values.tolist()):
            limit = None
            if name.startswith("synchronous"):
                limit = errors.attrs.get("axial_limit" if name.endswith("axial") else "radial_limit")
                limit = None if limit is None or "tilt" in name else float(limit)
            effect = dict(zip(sources, errors["figure_influence"].values[:, k].tolist(), strict=True))
            value, unit = float(errors["figure_value"][k]), str(errors["figure_unit"].values[k])
            merits.append(FigureOfMerit(name, value, float(U[k]), unit, limit, effect))
        return merits


@lru_cache(maxsize=4)
def _planned(settings: SpindleErrorMotionSettings) -> xr.Dataset:
    """Return the plan of a test, in whose form the truth of its simulations is stated; not to be changed."""
    return SpindleErrorMotion().plan(settings)
