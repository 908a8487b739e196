"""The text of a chain: the bodies and axes of a machine from workpiece to tool."""

from __future__ import annotations

from errormotion.kinematics.iso import LINEAR_AXES, ROTARY_AXES

__all__ = ["parse_chain"]


def parse_chain(chain: str) -> dict[str, bool]:
    """Return the axes of a chain from workpiece to tool, and for each whether it carries the tool.

    Parameters
    ----------
    chain : str
        From ``workpiece`` over ``bed`` to ``tool``, joined by ``-``; ``spindle`` may precede ``tool``.

    Raises
    ------
    ValueError
        The text is not a chain.

    Examples
    --------
    >>> parse_chain("workpiece-X-Y-bed-Z-spindle-tool")
    {'X': False, 'Y': False, 'Z': True}
    """
    words = [word.strip() for word in chain.split("-")]
    if words[0] != "workpiece" or words[-1] != "tool" or words.count("bed") != 1:
        raise ValueError(
            f"expected a chain from 'workpiece' over one 'bed' to 'tool', "
            f"such as 'workpiece-X-Y-bed-Z-spindle-tool'; found '{chain}'"
        )
    inner = words[1:-1]
    if inner[-1] == "spindle":
        inner = inner[:-1]
    axes = [word for word in inner if word != "bed"]
    if unknown := [word for word in axes if word not in (*LINEAR_AXES, *ROTARY_AXES)]:
        known = ", ".join((*LINEAR_AXES, *ROTARY_AXES))
        raise ValueError(f"expected axes {known} in '{chain}' ('spindle' only before 'tool'); found '{unknown[0]}'")
    if twice := [axis for axis in dict.fromkeys(axes) if axes.count(axis) > 1]:
        raise ValueError(f"expected every axis of '{chain}' once; found {twice[0]} {axes.count(twice[0])} times")
    if not axes:
        raise ValueError(f"expected at least one axis in '{chain}'; found none")
    return {axis: inner.index("bed") < i for i, axis in enumerate(inner) if axis != "bed"}
