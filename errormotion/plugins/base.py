"""Base classes of plugins whose datasets people read: the optional parts, and what holds where one is not stated.

Generic code asks for a part here, and never for an attribute that a plugin may have. A part that takes long to import
is stated by `lazy`: ``chapters = lazy("my_lab.report:chapters")``, a function of the same arguments.
"""

from __future__ import annotations

import inspect
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cache
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, ClassVar

import xarray as xr
from pydantic import BaseModel

from errormotion.errors import PluginWarning
from errormotion.plugins.contracts import (
    Bench,
    Calibration,
    DatasetInfo,
    FigureOfMerit,
    MethodInfo,
    Needs,
    PluginSettings,
    Step,
)

if TYPE_CHECKING:
    from errormotion.kinematics.description import MachineDescription
    from errormotion.plugins.trial_model import TrialModel

__all__ = ["DatasetPlugin", "Method", "Owner", "adapted", "states"]

_NONE: Mapping[str, Any] = MappingProxyType({})


class Owner:
    """A plugin that owns datasets: what they contain, and how people read them."""

    raw_schemas: ClassVar[Sequence[Any]] = ()
    """Tables (`errormotion.datasets.schemas.RawSchema`) for validation, CSV reading, import and reference pages."""
    calibrations: ClassVar[Mapping[str, Calibration]] = _NONE
    """Raw schema of readings to the calibration that ``errormotion calibrate`` computes from them."""
    log_readers: ClassVar[Mapping[str, Callable[[Path, Path], xr.Dataset]]] = _NONE
    """Formats of maps for ``errormotion import``: value of the key ``schema`` of a map to a function ``(log, map)``.

    The function returns the raw dataset. A map whose key ``schema`` is a raw schema needs none.
    """

    log_maps: ClassVar[Mapping[str, type[BaseModel]]] = _NONE
    """Ending of a file, such as ``.rtl``, to the model of its map, for formats that a reader of `log_readers` reads.

    ``errormotion add`` asks for the required fields of the model, and writes the map.
    """

    def texts(self, language: str) -> Mapping[str, str]:  # noqa: ARG002
        """Return the texts of the chapters: English to this language (``de``)."""
        return _NONE

    def chapters(self, source: Any) -> Sequence[Any]:  # noqa: ARG002
        """Return the report of a dataset (`errormotion.report.document.Part`); by default the generic chapter."""
        return ()

    def figures(self, errors: xr.Dataset) -> Sequence[FigureOfMerit] | None:  # noqa: ARG002
        """Return the numbers for the command line and summaries; by default the last values."""
        return None


class DatasetPlugin(Owner):
    """A kind of dataset that is neither raw data nor errors of a method: a log, a model."""

    info: ClassVar[DatasetInfo]

    def violations(self, dataset: xr.Dataset) -> Sequence[str]:  # noqa: ARG002
        """Return how a dataset breaks its schema, one sentence each."""
        return ()

    def plot(self, dataset: xr.Dataset) -> Any:  # noqa: ARG002
        """Draw a dataset; returns None if there is no drawing."""
        return None

    def predictor(self, model: xr.Dataset, functional_point: Any = None) -> Any:  # noqa: ARG002
        """Return the `Predictor` of a model; only a plugin of models states it."""
        return None


class Method(Owner):
    """A method: acquisition of raw data, and their identification as an error dataset.

    ``info``, ``needs``, ``Settings``, `acquire`, `append_dim`, `progress`, `identify` and `plan` are required; all
    other parts are optional. The argument ``instruments`` contains the settings of the instruments of the bench by
    kind. A method with a measurement model extends `errormotion.measurement.ModelMethod`.
    """

    info: ClassVar[MethodInfo]
    needs: ClassVar[Needs]
    Settings: ClassVar[type[PluginSettings]]
    acquisition_settings: ClassVar[Sequence[str]] = ()
    """Settings that only `acquire`, `plan` and programs use; results of imported data list them only if stated."""
    doctor: ClassVar[Mapping[str, Callable[[], str]]] = _NONE
    """Checks of this computer for ``errormotion doctor``; each returns a text or raises an error."""

    def acquire(
        self, bench: Bench, settings: Any, *, inputs: Mapping[str, xr.Dataset], done: xr.Dataset | None = None
    ) -> Iterator[xr.Dataset]:
        """Measure; yield raw datasets, which are joined along ``append_dim(settings)``.

        ``inputs`` are results of earlier tests by their names in the campaign. ``done`` contains the data of an
        interrupted run, which is continued.
        """
        raise NotImplementedError

    def append_dim(self, settings: Any) -> str:
        """Return the dimension along which the yielded datasets are joined."""
        raise NotImplementedError

    def also_append(self, settings: Any) -> Sequence[str]:  # noqa: ARG002
        """Return further dimensions along which datasets are joined independently, such as that of index pulses.

        No variable has two of them. A yielded dataset has all of its variables, without values where there are none.
        """
        return ()

    def progress(self, settings: Any) -> float:
        """Return the expected total for the progress bar: seconds for chunks with ``sample_rate``, else items."""
        raise NotImplementedError

    def identify(self, raw: xr.Dataset, settings: Any) -> xr.Dataset:
        """Return the error dataset of a raw dataset, which is not changed."""
        raise NotImplementedError

    def plan(self, settings: Any) -> xr.Dataset:
        """Return an error dataset of zeros with the expected covariance."""
        raise NotImplementedError

    # What a campaign checks before it measures

    def check(self, settings: Any) -> Mapping[str, str]:  # noqa: ARG002
        """Return mistakes that can be found before a measurement, by setting; called when a campaign is read."""
        return _NONE

    def machine_defaults(self, machine: MachineDescription, settings: Any) -> Mapping[str, Any]:  # noqa: ARG002
        """Return defaults of settings that follow from the machine of the bench; ``settings`` are those stated."""
        return _NONE

    def check_machine(self, settings: Any, machine: MachineDescription) -> Mapping[str, str]:  # noqa: ARG002
        """Return contradictions to the machine, by setting, with the expected and the found value.

        An empty key stands for all settings. Called when a campaign is read.
        """
        return _NONE

    def check_bench(self, settings: Any, bench: Bench, inputs: Sequence[str]) -> Sequence[str] | None:  # noqa: ARG002
        """Return why a test cannot be measured with these instruments, one sentence each.

        One that it commands is not armed (`unarmed`) or cannot be commanded, a channel does not exist, an input is
        missing. It may raise MethodError or BenchError instead. Called before anything is opened or created; the
        drivers of ``bench`` are not open. By default (None) a test with motions needs one armed instrument, if the
        bench has any that moves a machine.
        """
        return None

    def cannot_continue(self, settings: Any) -> str:  # noqa: ARG002
        """Return why an interrupted measurement cannot be continued, such as an axis that has cooled down."""
        return ""

    def motions(self, settings: Any, instruments: Mapping[str, Any]) -> Sequence[Step] | None:  # noqa: ARG002
        """Return all steps of the machine; checked against the limits of the bench before the first motion.

        Required for a method that moves a machine, by a controller or by programs: without it (None) no motion is
        allowed in its tests. The steps include the ends of a search. Raises MethodError if the settings do not
        determine the steps.
        """
        return None

    def programs(self, settings: Any, instruments: Mapping[str, Any]) -> Mapping[str, str]:  # noqa: ARG002
        """Return the NC programs of the test: file name to text."""
        return _NONE

    def planning_settings(self, settings: Any, instruments: Mapping[str, Any]) -> Any:  # noqa: ARG002
        """Return the settings for `plan`, completed with data of the instruments of the bench, such as their noise."""
        return settings

    def follow(self, settings: Any) -> Callable[[xr.Dataset], str] | None:  # noqa: ARG002
        """Return a function that is called with each acquired dataset and returns a line for the operator."""
        return None

    # Trust in the results

    def trial_model(self, raw: xr.Dataset, settings: Any, errors: xr.Dataset) -> TrialModel | None:  # noqa: ARG002
        """Return the sources of the uncertainty of raw data, for ``identify --monte-carlo``.

        ``errors`` is the result of `identify`.
        """
        return None

    def simulate(self, settings: Any, seed: int) -> tuple[xr.Dataset, xr.Dataset] | None:  # noqa: ARG002
        """Return raw data with known truth: a raw dataset, and an error dataset relative to the same reference."""
        return None

    def expected(self, settings: Any) -> xr.Dataset | None:  # noqa: ARG002
        """Return raw data without noise as a test with these settings would give them, for errors of typical size."""
        return None

    def truth(self, machine: Any, errors: xr.Dataset, clock: float) -> xr.Dataset | None:  # noqa: ARG002
        """Return the true errors of a `VirtualMachine` at the positions and times of an error dataset.

        Its time 0 is at ``clock`` (s) of the machine.
        """
        return None

    def conformance(self) -> Sequence[Any]:
        """Return the subjects (`errormotion.plugins.MethodSubject`) of the conformance kit."""
        return ()


_BASES: Mapping[str, type[Owner]] = {"methods": Method, "datasets": DatasetPlugin}


@cache
def adapted(cls: Any, group: str) -> Any:
    """Return a plugin class with the base class of its group; one without it has the form of version 0.1."""
    base = _BASES.get(group)
    if base is None or not inspect.isclass(cls) or issubclass(cls, base):
        return cls
    info: MethodInfo | DatasetInfo = getattr(cls, "info")  # noqa: B009 - of a class of any type
    warnings.warn(
        f"The plugin '{info.id}' does not extend errormotion.plugins.{base.__name__}; from version 0.3 on it must.",
        PluginWarning,
        stacklevel=3,
    )
    return type(cls.__name__, (cls, base), {"__module__": cls.__module__, "__doc__": cls.__doc__})


def states(plugin: Any, name: str) -> bool:
    """Return whether a plugin, or its class, states an optional part itself.

    Raises
    ------
    AttributeError
        There is no such part.
    """
    cls = plugin if isinstance(plugin, type) else type(plugin)
    own = inspect.getattr_static(cls, name, None)
    defaults = [inspect.getattr_static(base, name) for base in (Owner, DatasetPlugin, Method) if hasattr(base, name)]
    if not defaults:
        raise AttributeError(f"plugins have no part '{name}'")
    return own is not None and all(own is not default for default in defaults)
