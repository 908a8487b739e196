"""The six freedoms, and the names of the errors of an axis in ISO 230-1.

A name consists of E, the direction and the moving axis: ``EYX`` is the straightness of X in Y, ``ECX`` its rotation
about Z. A zero denotes an error of position or orientation of the axis, not of its motion: ``EC0Y`` is the squareness
of Y to X.
"""

from __future__ import annotations

__all__ = ["DOF", "LINEAR_AXES", "ROTARY_AXES", "direction_of", "is_straightness", "iso_names", "location_names"]

DOF = ("EX", "EY", "EZ", "EA", "EB", "EC")
LINEAR_AXES = ("X", "Y", "Z", "U", "V", "W")
ROTARY_AXES = ("A", "B", "C")

_PARALLEL_TO = {"X": 0, "Y": 1, "Z": 2, "U": 0, "V": 1, "W": 2, "A": 0, "B": 1, "C": 2}
# Components of error datasets that are not a single axis: the standard has no name for their errors.
_NO_AXIS = ("tool", "beam")


def iso_names(component: str, *, spindle_axis: str = "C") -> dict[str, str]:
    """Return the names of the errors of a component.

    Parameters
    ----------
    component : str
        An axis (``X Y Z U V W A B C``), ``spindle``, ``tool`` (the volume) or ``beam``.
    spindle_axis : str
        Letter of the spindle's axis of rotation; the usual vertical or gantry spindle is C.

    Returns
    -------
    dict
        Freedom to name, such as ``{"EX": "EXX", "EY": "EYX", ...}``. The errors of the volume and of a beam have the
        name of the freedom.

    Raises
    ------
    ValueError
        Unknown component.
    """
    if component in _NO_AXIS:
        return {dof: dof for dof in DOF}
    axis = spindle_axis if component == "spindle" else component
    direction_of(axis)
    return {dof: dof + axis for dof in DOF}


def direction_of(axis: str) -> int:
    """Return the index (0 X, 1 Y, 2 Z) of the coordinate that an axis moves along or rotates about.

    Raises
    ------
    ValueError
        Unknown axis.
    """
    if axis not in _PARALLEL_TO:
        known = ", ".join([*LINEAR_AXES, *ROTARY_AXES, "spindle", *_NO_AXIS])
        raise ValueError(f"expected one of {known}; found '{axis}'")
    return _PARALLEL_TO[axis]


def is_straightness(freedom: int, axis: str) -> bool:
    """Return whether a freedom (0 to 5) is a displacement across an axis."""
    return freedom < 3 and freedom != direction_of(axis)


def location_names(axis: str, others: tuple[str, ...] = LINEAR_AXES) -> dict[str, str]:
    """Return the errors of position and orientation of an axis on a machine that also has the axes ``others``.

    X is the primary axis of the datum and Y the secondary one, so that a three-axis machine has three such errors:
    ``EC0Y``, ``EA0Z``, ``EB0Z``. A rotary axis has four: two offsets and two tilts of its line.

    Parameters
    ----------
    axis : str
    others : tuple of str
        Axes of the machine; a squareness is to one of them.

    Returns
    -------
    dict
        Freedom to name, such as ``{"EA": "EA0Z", "EB": "EB0Z"}``; empty for X.
    """
    along = direction_of(axis)
    if axis in ROTARY_AXES:
        return {dof: f"{dof}0{axis}" for i, dof in enumerate(DOF) if i % 3 != along}
    squareness = {"X": {}, "Y": {"EC": "X"}, "Z": {"EA": "Y", "EB": "X"}}.get(axis)
    if squareness is None:  # U, V, W: parallel axes, both tilts of their line
        return {dof: f"{dof}0{axis}" for i, dof in enumerate(DOF[3:]) if i != along}
    return {dof: f"{dof}0{axis}" for dof, datum in squareness.items() if datum in others}
