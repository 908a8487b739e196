"""A machine as a chain of axes from workpiece to tool, and the effect of its axes' errors at the tool.

A description such as ``workpiece-X-Y-bed-Z-spindle-tool`` lists the bodies and axes from the workpiece over the bed to
the tool. Volumetric errors are twists of the tool relative to the workpiece, actual minus commanded, at the functional
point, in the frame of the workpiece (which is the frame of the machine with all axes at zero).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cached_property, reduce
from operator import mul

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import RigidTransform

from errormotion.arrays import Array
from errormotion.kinematics.axes import Axis
from errormotion.kinematics.chains import parse_chain
from errormotion.kinematics.iso import DOF, LINEAR_AXES, ROTARY_AXES, iso_names, location_names
from errormotion.kinematics.poses import displacement
from errormotion.kinematics.twists import adjoint, known_product

__all__ = ["Machine"]

ORIGIN = (0.0, 0.0, 0.0)


class Machine:
    """A serial machine: forward model of its geometric errors, and the Jacobian of the model.

    Parameters
    ----------
    chain : str
        From ``workpiece`` over ``bed`` to ``tool``, joined by ``-``; ``spindle`` may precede ``tool``. Axes before
        ``bed`` carry the workpiece, axes after it carry the tool.
    references : mapping of str to array_like (3,), optional
        For each axis the point at which its error motion is stated (see `errormotion.kinematics.axes.Axis`), for a
        rotary axis a point of its line. Default: the origin.

    Attributes
    ----------
    axis_names : tuple of str
        Order of the commanded coordinates: X Y Z U V W A B C, as far as the machine has them.
    error_names : tuple of str
        Order of the error parameters: six error motions of every axis, then the errors of position and orientation,
        such as squareness. A machine with X, Y and Z has 21: EXX ... ECZ, EC0Y, EA0Z, EB0Z.

    Raises
    ------
    ValueError
        The description is not a chain, or a reference belongs to no axis.

    References
    ----------
    ISO 230-1:2012, clause 3 and annex A (names of the errors). The model is derived in the explanation of conventions.

    Examples
    --------
    >>> machine = Machine("workpiece-X-Y-bed-Z-spindle-tool")
    >>> len(machine.error_names)
    21
    """

    def __init__(self, chain: str, references: Mapping[str, ArrayLike] | None = None) -> None:
        carries_tool = parse_chain(chain)
        references = dict(references or {})
        if stray := set(references) - set(carries_tool):
            raise ValueError(
                f"expected references for {', '.join(carries_tool)}; found one for {', '.join(sorted(stray))}"
            )
        self.chain = chain
        self.joints = tuple(
            Axis(name, side, np.asarray(references.get(name, ORIGIN), dtype=float))
            for name, side in carries_tool.items()
        )
        self.axis_names = tuple(name for name in (*LINEAR_AXES, *ROTARY_AXES) if name in carries_tool)

    @cached_property
    def error_names(self) -> tuple[str, ...]:
        """Names of the error parameters, in order."""
        motions = [name for axis in self.axis_names for name in iso_names(axis).values()]
        positions = [name for axis in self.axis_names for name in location_names(axis, self.axis_names).values()]
        return (*motions, *positions)

    def nominal_pose(self, commanded: ArrayLike) -> RigidTransform:
        """Return the commanded poses, (n,), of the tool body in the workpiece frame, for commands (n, axis)."""
        q = self._commands(commanded).reshape(-1, len(self.axis_names))
        return reduce(mul, (joint.motion(self._of(joint, q)) for joint in self.joints))

    def errors_at(
        self,
        commanded: ArrayLike,
        motions: Mapping[str, Callable[[Array], ArrayLike]],
        locations: Mapping[str, float] | None = None,
    ) -> Array:
        """Return the error parameters at commanded positions, in the order of `error_names`.

        Parameters
        ----------
        commanded : array_like, (..., axis)
            In the order of `axis_names`; m and rad.
        motions : mapping of str to callable
            For each axis a function of its commanded position (...) that returns its error twist (..., 6), such as
            `errormotion.kinematics.axes.ErrorMotion`. The errors of other axes are unknown: NaN.
        locations : mapping of str to float, optional
            Values of errors of position by name (``EC0Y``), rad or m; the others are NaN.

        Returns
        -------
        ndarray, (..., error)

        Raises
        ------
        ValueError
            An axis or a name that this machine does not have.
        """
        q, locations = self._commands(commanded), dict(locations or {})
        if stray := [*(set(motions) - set(self.axis_names)), *(set(locations) - set(self.error_names))]:
            raise ValueError(f"the machine {self.chain} has no {', '.join(sorted(stray))}")
        errors = np.full((*q.shape[:-1], len(self.error_names)), np.nan)
        for i, axis in enumerate(self.axis_names):
            if axis in motions:
                errors[..., 6 * i : 6 * i + 6] = motions[axis](q[..., i])
        for name, value in locations.items():
            errors[..., self.error_names.index(name)] = value
        return errors

    def volumetric_error(
        self, commanded: ArrayLike, errors: ArrayLike, tool: ArrayLike = ORIGIN, *, exact: bool = False
    ) -> Array:
        """Return the error twist of the tool relative to the workpiece.

        Parameters
        ----------
        commanded : array_like, (..., axis)
            In the order of `axis_names`; m and rad.
        errors : array_like, (..., error)
            In the order of `error_names`, such as from `errors_at`.
        tool : array_like, (3,)
            The functional point: where the tool is, in machine coordinates with all axes at zero, m.
        exact : bool
            Multiply the poses. Default: first order, ``jacobian @ errors``; the neglected terms are products of two
            errors.

        Returns
        -------
        ndarray, (..., 6)
            NaN where an unknown error has an effect; the exact model needs all of them.
        """
        q, e = self._commands(commanded), np.asarray(errors, dtype=float)
        if e.ndim == 0 or e.shape[-1] != len(self.error_names):
            raise ValueError(f"expected errors of shape (..., {len(self.error_names)}), found {e.shape}")
        if not exact:
            return known_product(self.jacobian(q, tool), e)
        batch = np.broadcast_shapes(q.shape[:-1], e.shape[:-1])
        q = np.broadcast_to(q, (*batch, q.shape[-1])).reshape(-1, q.shape[-1])
        e = np.broadcast_to(e, (*batch, e.shape[-1])).reshape(-1, e.shape[-1])
        known = ~np.isnan(e).any(axis=1)
        twist = np.full((len(q), 6), np.nan)
        if known.any():
            twist[known] = self._exact(q[known], e[known], np.asarray(tool, dtype=float))
        return twist.reshape(*batch, 6)

    def jacobian(self, commanded: ArrayLike, tool: ArrayLike = ORIGIN) -> Array:
        """Return the derivative of the tool's error twist with respect to every error parameter.

        Parameters
        ----------
        commanded : array_like, (..., axis)
        tool : array_like, (3,)

        Returns
        -------
        ndarray, (..., 6, error)
            Analytic, at zero errors.
        """
        q = self._commands(commanded)
        flat = q.reshape(-1, q.shape[-1])
        at = self.nominal_pose(flat).apply(np.asarray(tool, dtype=float))
        J = np.zeros((len(flat), 6, len(self.error_names)))
        start = RigidTransform.identity(len(flat))
        for joint in self.joints:
            end = start * joint.motion(self._of(joint, flat))
            before, after = (_to_tool(pose, joint.reference, at) for pose in (start, end))
            i = 6 * self.axis_names.index(joint.name)
            J[:, :, i : i + 6] = after if joint.error_follows_motion else before
            # The line is displaced before the motion and displaced back after it.
            for column, dof in self._locations(joint):
                J[:, :, column] = (before - after)[:, :, dof]
            start = end
        return J.reshape(*q.shape[:-1], 6, -1)

    def _exact(self, q: Array, e: Array, tool: Array) -> Array:
        poses = []
        for joint in self.joints:
            i, location = 6 * self.axis_names.index(joint.name), np.zeros((len(q), 6))
            for column, dof in self._locations(joint):
                location[:, dof] = e[:, column]
            poses.append(joint.actual(self._of(joint, q), e[:, i : i + 6], location))
        nominal = self.nominal_pose(q)
        return displacement(reduce(mul, poses) * nominal.inv(), nominal.apply(tool))

    def _locations(self, joint: Axis) -> list[tuple[int, int]]:
        """Return (column among the error parameters, freedom) of the errors of position of one axis."""
        names = location_names(joint.name, self.axis_names)
        return [(self.error_names.index(name), DOF.index(dof)) for dof, name in names.items()]

    def _of(self, joint: Axis, q: Array) -> Array:
        command: Array = q[:, self.axis_names.index(joint.name)]
        return command

    def _commands(self, commanded: ArrayLike) -> Array:
        q = np.asarray(commanded, dtype=float)
        if q.ndim == 0 or q.shape[-1] != len(self.axis_names):
            raise ValueError(f"expected commands (..., {len(self.axis_names)}) for {self.axis_names}, found {q.shape}")
        return q


def _to_tool(pose: RigidTransform, reference: Array, at: Array) -> Array:
    """Return the adjoint from ``reference`` in the frame ``pose`` to the points ``at`` of the workpiece frame."""
    return adjoint(pose.rotation, pose.inv().apply(at) - reference)
