"""Schemas as tables with one row for each variable, used by validation, readers and the reference page.

This module contains the table of error datasets. The tables of raw datasets are in the plugins of their methods.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import xarray as xr

from errormotion import plugins
from errormotion.kinematics.iso import DOF

SCHEMA = plugins.ERRORS_SCHEMA
"""Schema of every error dataset."""

SIGN = "actual minus commanded, tool side relative to workpiece side"
"""The sign convention of all errors, and value of the attribute ``sign``."""

ERROR_DIMS = ("time", "position", "target", "beam")
"""Dimensions that errors may have; others are declared by a coordinate of the same name."""

INDEX = "_index"
"""Suffix of the variables that number the values along each dimension, such as ``time_index``.

They are whole numbers after a selection, but not after an interpolation or a mean of plain xarray, which do not
propagate the covariance. The validator uses them to detect this.
"""

ERROR_UNITS = ("m", "m", "m", "rad", "rad", "rad")
"""Units of the six freedoms."""

COMPONENTS = (*"XYZABCUVW", "spindle", "tool", "beam")
"""Values of the attribute ``component``; others are declared by the attribute ``component_description``."""


@dataclass(frozen=True)
class Row:
    """One variable of a schema.

    Attributes
    ----------
    name : str
    dims : tuple of str
        ``...`` stands for the dimensions of the errors themselves.
    unit : str
        Unit in datasets; "1" for a pure number, "" if the elements differ in unit or the values are text.
    low, high : float
        Plausible range, both ends included; infinite for none.
    meaning : str
    required : bool
    missing : bool
        Whether single values of a required variable may be NaN, for missing readings.
    units : tuple of str
        Units of the elements, if they differ and a column of a text file contains elements of one unit.
    """

    name: str
    dims: tuple[str, ...]
    unit: str
    low: float
    high: float
    meaning: str
    required: bool = True
    missing: bool = False
    units: tuple[str, ...] = ()


@dataclass(frozen=True)
class RawSchema:
    """The content of the raw dataset of one method; a method with two procedures has two.

    Attributes
    ----------
    id : str
        Value of the attribute ``schema``.
    variant : str
        Name of the procedure; empty if there is only one.
    marker : str
        Variable or dimension that only this variant has.
    rows : tuple of Row
    sizes : mapping of str to int
        Dimensions of fixed length.
    labels : mapping of str to tuple of str
        Labels that a dimension must have, all of them and no others.
    aliases : mapping of str to str
        Short names of columns in text files, and the full names.
    words : mapping of str to tuple of str
        Names that columns of others' files have for a variable, a dimension or one of its labels, in lower case; any
        language. The usual ones, such as time and temperature, are known without.
    attributes : mapping of str to tuple of str
        Attributes that an imported dataset needs, and their values; no values: any text.
    asked : tuple of str
        Optional variables that a person is asked for at an import.
    longest_interval : float
        Interval of readings, s, beyond which the data are of another kind.
    stated : tuple of Row
        Values that a map may state in place of variables; `imported` converts them.
    derived : tuple of str
        Required variables that `imported` computes.
    imported : callable, optional
        Returns an imported dataset, with the values of `stated`, as one of the schema; None: it is one.
    """

    id: str
    variant: str
    marker: str
    rows: tuple[Row, ...]
    sizes: Mapping[str, int] = field(default_factory=dict)
    labels: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    aliases: Mapping[str, str] = field(default_factory=dict)
    words: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    attributes: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    asked: tuple[str, ...] = ()
    longest_interval: float = float("inf")
    stated: tuple[Row, ...] = ()
    derived: tuple[str, ...] = ()
    imported: Callable[[xr.Dataset], xr.Dataset] | None = None

    @property
    def title(self) -> str:
        """Id and variant as text."""
        return f"{self.id}, {self.variant}" if self.variant else self.id


NO_LIMIT = float("inf")
POSITION = (-20.0, 20.0)
"""Plausible coordinates of the largest machine tools, m; detects coordinates in mm."""
READING = (-0.1, 0.1)
"""Plausible readings of point sensors, m."""
RADIUS = (0.0005, 0.1)
"""Plausible radii of bars and spheres, m."""
NOISE = (0.0, 1e-3)
"""Plausible standard deviations of a length, m."""
UNIT_VECTOR = (-1.000001, 1.000001)
"""Components of a unit vector."""
DIRECTION = {"direction": 3}
"""Size of the dimension of a vector."""
XYZ = {"direction": ("x", "y", "z")}
"""Labels of the dimension of a vector."""

ERROR_ROWS = (
    *(
        Row(f"E{letter}", ("...",), "m", -0.1, 0.1, f"displacement of the functional point along {letter}")
        for letter in "XYZ"
    ),
    *(
        Row(f"E{letter}", ("...",), "rad", -0.2, 0.2, f"small rotation about {axis}")
        for letter, axis in zip("ABC", "XYZ", strict=True)
    ),
    Row(
        "covariance",
        ("...", "dof", "dof_"),
        "",
        -NO_LIMIT,
        NO_LIMIT,
        "total covariance of the six freedoms at one place, including influences; m^2, m rad, rad^2",
    ),
    Row(
        "influence",
        ("source", "...", "dof"),
        "",
        -NO_LIMIT,
        NO_LIMIT,
        "signed effect of one standard uncertainty of a source that is one draw for many values; m, rad",
        required=False,
    ),
    Row(
        "deviation",
        ("...",),
        "m",
        -0.1,
        0.1,
        "error along one known direction, if the method determines no single freedom: `sensitivity` times the freedoms",
        required=False,
    ),
    Row(
        "sensitivity",
        ("...", "dof"),
        "",
        -20.0,
        20.0,
        "effect of one unit of each freedom on `deviation`: a unit vector, and the lever of the rotations; 1, m",
        required=False,
    ),
    Row("deviation_variance", ("...",), "m^2", 0.0, 1e-2, "total variance of `deviation`", required=False),
    Row(
        "deviation_influence",
        ("source", "..."),
        "m",
        -0.1,
        0.1,
        "effect of one standard uncertainty of each source on `deviation`, as in `influence`",
        required=False,
    ),
    Row("source_group", ("source",), "", -NO_LIMIT, NO_LIMIT, "group of a source in the budget", required=False),
    Row(
        "source_id",
        ("source",),
        "",
        -NO_LIMIT,
        NO_LIMIT,
        "identity of a source, equal in datasets that share the draw: hash of a calibration, number of a certificate; "
        "empty if it is not shared",
        required=False,
    ),
    Row(
        "source_reference",
        ("source",),
        "",
        0.0,
        1.0,
        "1 for the uncertainty of the reference state, else 0",
        required=False,
    ),
    Row("time", ("time",), "s", -NO_LIMIT, NO_LIMIT, "time since the reference state, increasing", required=False),
    *(
        Row(name, ("position|target",), "m", *POSITION, f"commanded {name.upper()}", required=False)
        for name in ("x", "y", "z")
    ),
)

ERROR_ATTRIBUTES = {
    "schema": f"`{SCHEMA}`",
    "component": "the part with the errors: an axis (X, Y, Z, A, B, C, U, V, W), `spindle`, `tool` (the volume) or "
    "`beam`; another name with the attribute `component_description`",
    "machine": "name of the machine",
    "frame": "coordinate system of the components",
    "functional_point": "three coordinates in that frame, m",
    "reference": "the state to which the errors are relative",
    "method": "id of the method",
    "method_version": "its version",
    "sign": f"`{SIGN}`",
    "provenance": "JSON text: settings with defaults, hash of the raw dataset, instruments, software, seed, steps",
}

OPTIONAL_ATTRIBUTES = {
    "start": "instant of time 0: ISO 8601 with an offset from UTC",
    "reference_interval": "first and last time of the reference state, s on `time`",
    "reference_position": "position whose errors are zero by definition",
    "notes": "list of sentences for the reader",
    "doubts_uncertainty": "those of the notes that state why an uncertainty may be too small",
    "component_description": "description of a component that the schema does not list",
    "chain": "kinematic chain of the machine, such as `workpiece-X-Y-bed-Z-spindle-tool`",
    "operator": "name of the operator",
    "certificates": "JSON object: certificates of artefacts and instruments, by item",
    "frame_origin": "origin of `frame` in machine coordinates with all axes at zero, m, if its directions are those "
    "of the machine",
    "lever_axes": "linear axes whose travel is a lever of the rotations, such as `Z`, if the errors are not those "
    "of one rigid motion: the displacement at another point is `E + R x r` along these directions only, and EA, EB "
    "and EC are rotations of the frame of the axes",
    "straightness_reference": "of a linear axis: `table` if its straightness is read at a point that is fixed to the "
    "table, `tool` if it is read at a point that is fixed to the tool; missing: unknown",
}
"""Attributes that an error dataset may have."""

STRAIGHTNESS_REFERENCES = ("table", "tool")
"""Values of the attribute ``straightness_reference`` of raw and error datasets."""

CARRIED = ("chain", "operator", "certificates", "straightness_reference")
"""Attributes of a raw dataset that are copied to its error dataset."""


def variants(schema: str) -> tuple[RawSchema, ...]:
    """Return the raw schemas of one id, or of a former one, from the plugin that provides them; none if unknown."""
    owner = plugins.owner_of_schema(schema)
    if owner is None:
        return ()
    now = plugins.present_schema(schema, owner)
    return tuple(table for table in owner.raw_schemas if table.id == now)


def raw_schemas() -> tuple[RawSchema, ...]:
    """Return the raw schemas of all plugins."""
    schemas = (table for _, tables in plugins.brought("raw_schemas", "methods", "datasets") for table in tables)
    return tuple(table for table in schemas if isinstance(table, RawSchema))


def known_schemas() -> set[str]:
    """Return the ids of all known schemas."""
    known = {SCHEMA} | {table.id for table in raw_schemas()}
    return known.union(*(cls.info.schemas for cls in plugins.loaded("datasets")))


__all__ = [
    "CARRIED",
    "COMPONENTS",
    "DIRECTION",
    "DOF",
    "ERROR_ATTRIBUTES",
    "ERROR_DIMS",
    "ERROR_ROWS",
    "ERROR_UNITS",
    "NOISE",
    "NO_LIMIT",
    "POSITION",
    "RADIUS",
    "READING",
    "SCHEMA",
    "SIGN",
    "STRAIGHTNESS_REFERENCES",
    "UNIT_VECTOR",
    "XYZ",
    "RawSchema",
    "Row",
    "known_schemas",
    "raw_schemas",
    "variants",
]
