"""Plugins: the contracts of instruments, methods, kinds of dataset and compensators, and the registry.

A plugin is a class, named in the entry-point group ``errormotion.instruments``, ``errormotion.methods``,
``errormotion.datasets`` or ``errormotion.compensators`` of any distribution. The built-in plugins are registered in
the same way.
"""

from errormotion.plugins.base import DatasetPlugin, Method, Owner, states
from errormotion.plugins.commanding import unarmed
from errormotion.plugins.contracts import (
    ERRORS_SCHEMA,
    Applied,
    Bench,
    Calibration,
    Compensator,
    Contact,
    DatasetInfo,
    FigureOfMerit,
    Identity,
    Instrument,
    InstrumentInfo,
    MachineLimits,
    MethodInfo,
    Needs,
    PluginSettings,
    Samples,
    Status,
    Step,
    Touch,
)
from errormotion.plugins.kind_registry import contract
from errormotion.plugins.lazy import lazy, load_object
from errormotion.plugins.readings import Environment, FrameGeometry, Measurement, Profiles, Scan
from errormotion.plugins.registry import (
    GROUPS,
    Group,
    Plugin,
    available,
    brought,
    get,
    loaded,
    owner_of_method,
    owner_of_schema,
    present_schema,
    refresh,
)
from errormotion.plugins.subjects import CompensatorSubject, InstrumentSubject, MethodSubject
from errormotion.plugins.trial_model import RandomSource, TrialModel, replaced

__all__ = [
    "ERRORS_SCHEMA",
    "GROUPS",
    "Applied",
    "Bench",
    "Calibration",
    "Compensator",
    "CompensatorSubject",
    "Contact",
    "DatasetInfo",
    "DatasetPlugin",
    "Environment",
    "FigureOfMerit",
    "FrameGeometry",
    "Group",
    "Identity",
    "Instrument",
    "InstrumentInfo",
    "InstrumentSubject",
    "MachineLimits",
    "Measurement",
    "Method",
    "MethodInfo",
    "MethodSubject",
    "Needs",
    "Owner",
    "Plugin",
    "PluginSettings",
    "Profiles",
    "RandomSource",
    "Samples",
    "Scan",
    "Status",
    "Step",
    "Touch",
    "TrialModel",
    "available",
    "brought",
    "contract",
    "get",
    "lazy",
    "load_object",
    "loaded",
    "owner_of_method",
    "owner_of_schema",
    "present_schema",
    "refresh",
    "replaced",
    "states",
    "unarmed",
]
