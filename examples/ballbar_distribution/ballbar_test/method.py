"""The plugin ``ballbar``."""

from ballbar_test.result import figures_of
from ballbar_test.schema import RAW_SCHEMAS, SCHEMA
from ballbar_test.settings import Settings
from errormotion.datasets import validate
from errormotion.errors import MethodError
from errormotion.plugins import Method, MethodInfo, Needs, lazy


class Ballbar(Method):
    """Circular test after ISO 230-4 with a telescoping ballbar."""

    info = MethodInfo(
        id="ballbar",
        summary="Circular test after ISO 230-4 with a telescoping ballbar",
        status="simulated_only",
        version="2",
        cannot_see=(
            "errors across the bar: only the radial displacement is measured",
            "the position of the circle: its centre is that of the least-squares circle",
            "arcs: only full circles can be centred",
            "a drift of the bar, if each direction of travel has only one circle",
        ),
    )
    needs = Needs(instruments=(), raw_schema=SCHEMA)
    Settings = Settings
    raw_schemas = RAW_SCHEMAS
    simulate = lazy("ballbar_test.simulation:simulate")
    chapters = lazy("ballbar_test.report:chapters")
    conformance = lazy("ballbar_test.conformance:subjects")
    figures = staticmethod(figures_of)

    def acquire(self, bench, settings, *, inputs, done=None):
        """Raise an error: readings of a ballbar are imported as a CSV file of its software."""
        raise MethodError(
            "ballbar does not acquire. Record with the software of the ballbar, write the readings to a CSV file of "
            f"schema {SCHEMA}, and use 'errormotion identify FILE'."
        )

    def append_dim(self, settings):
        """Return ``run``."""
        return "run"

    def progress(self, settings):
        """Return the number of circles in each direction of travel."""
        return float(settings.runs)

    def identify(self, raw, settings=None):
        """Return the error dataset of a raw dataset; see ``identification``."""
        from ballbar_test.identification import identify

        checked = raw if "schema" in raw.attrs else raw.assign_attrs(schema=SCHEMA)
        if checked.attrs["schema"] != SCHEMA:
            raise MethodError(f"ballbar reads raw data of schema {SCHEMA}; found {checked.attrs['schema']}.")
        validate(checked, RAW_SCHEMAS)
        return identify(checked, settings or Settings(), self.info.id, self.info.version)

    def plan(self, settings=None):
        """Return zeros with the expected covariance; see ``identification``."""
        from ballbar_test.identification import plan

        return plan(settings or Settings(), self.info.id, self.info.version)
