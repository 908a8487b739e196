"""The base class of methods that have a measurement model.

A subclass states ``info``, ``needs``, ``Settings``, ``raw_schemas`` and ``grows``, and writes ``observe`` and
``expected``. Identification, plan, Monte Carlo, simulated data with their truth, the check of the schema and the parts
that only a method with instruments needs are given. Whatever a method does otherwise, it overrides.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, ClassVar

from errormotion.errors import MethodError
from errormotion.plugins import Method

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    import xarray as xr

    from errormotion.estimation.datum import Relative
    from errormotion.estimation.fit import Fit
    from errormotion.measurement.observed import Observed
    from errormotion.plugins import Bench, TrialModel

__all__ = ["ModelMethod"]


class ModelMethod(Method):
    """A method with a measurement model; without ``acquire`` it evaluates imported data only."""

    grows: ClassVar[str] = "time"
    """The dim along which the parts of an acquisition are joined."""

    def observe(self, raw: xr.Dataset, settings: Any) -> Observed:
        """Return what raw data mean; see `errormotion.measurement.Model`."""
        raise NotImplementedError

    def expected(self, settings: Any) -> xr.Dataset:
        """Return raw data without noise, for errors of typical size; see `errormotion.measurement.Model`."""
        raise NotImplementedError

    def results(self, observed: Observed, fit: Fit, relative: Relative) -> Mapping[str, xr.DataArray]:  # noqa: ARG002
        """Return further variables of the result; none by default."""
        return {}

    def identify(self, raw: xr.Dataset, settings: Any = None) -> xr.Dataset:
        """Return the error dataset of a raw dataset, which is not changed.

        Raises
        ------
        DatasetError
            The raw dataset violates its schema; all violations are reported together.
        MethodError
            The data do not determine the errors.
        """
        from errormotion.datasets.validation import checked_raw
        from errormotion.measurement.identification import identify

        return identify(self, checked_raw(raw, self), settings or self.Settings(), self.info)

    def plan(self, settings: Any = None) -> xr.Dataset:
        """Return an error dataset of zeros with the expected covariance."""
        from errormotion.measurement.planning import plan

        return plan(self, settings or self.Settings(), self.info)

    def trial_model(self, raw: xr.Dataset, settings: Any, errors: xr.Dataset) -> TrialModel:  # noqa: ARG002
        """Return the sources of the uncertainty of raw data, for the Monte Carlo evaluation."""
        from errormotion.datasets.validation import checked_raw
        from errormotion.measurement.drawing import trial_model

        return trial_model(self, checked_raw(raw, self), settings, self.info)

    def simulate(self, settings: Any, seed: int) -> tuple[xr.Dataset, xr.Dataset]:
        """Return raw data with every source of the model drawn once, and the true errors."""
        from errormotion.measurement.drawing import simulate

        return simulate(self, settings, seed, self.info)

    def append_dim(self, settings: Any) -> str:  # noqa: ARG002
        """Return the dim along which the parts of an acquisition are joined."""
        return self.grows

    def progress(self, settings: Any) -> float:
        """Return the expected size of the test along this dim."""
        return float(self.expected(settings).sizes[self.grows])

    def acquire(
        self,
        bench: Bench,  # noqa: ARG002
        settings: Any,  # noqa: ARG002
        *,
        inputs: Mapping[str, xr.Dataset],  # noqa: ARG002
        done: xr.Dataset | None = None,  # noqa: ARG002
    ) -> Iterator[xr.Dataset]:
        """Refuse: the method measures nothing itself."""
        raise MethodError(
            f"The method {self.info.id} evaluates imported data only: import a file of its readings, and identify it.",
            code="method.imported_only",
        )
