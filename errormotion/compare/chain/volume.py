"""The errors of an axis from those of the volume, by the kinematic chain of the machine.

The volume gives the errors of its axes (`errormotion.kinematics.volumes`), and thus those of one axis at chosen
positions. Components that cannot be distinguished from squareness, datum and the other axes are removed on both sides:
positioning and rotations are relative to one position, straightness to the line through two positions. The derivation
is in the explanation of comparisons.
"""

from __future__ import annotations

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike

from errormotion.compare.chain.curve import Curve, sources_of
from errormotion.datasets.results.reduction import influence_of
from errormotion.errors import DatasetError
from errormotion.estimation.polynomials import ORDERS
from errormotion.kinematics.iso import DOF
from errormotion.kinematics.machines import Machine
from errormotion.kinematics.volumes import AxisErrors, Targets, Volume, fitted

SAME = 1e-6
"""Distance below which two positions of an axis are regarded as equal, m."""


def predict(
    volume: xr.Dataset,
    axis: str,
    positions: ArrayLike,
    point: ArrayLike,
    *,
    notes: list[str] | None = None,
    name: str = "volume",
) -> Curve:
    """Return the errors of an axis that follow from a volume.

    Parameters
    ----------
    volume : Dataset
        Errors of the tool over ``target`` with ``x y z`` and the attribute ``chain``.
    axis : str
    positions : array_like, (n,)
        Positions of the axis within the volume, m.
    point : array_like, (3,)
        Functional point of the errors of the axis, m, in machine coordinates with all axes at zero.
    notes : list of str, optional
        Order of the polynomials and misfit are appended.

    Returns
    -------
    Curve
        Errors up to constants, for straightness up to a line; a freedom that the volume does not determine is NaN.

    Raises
    ------
    DatasetError
        The targets do not determine any error of the axis.
    """
    positions = np.asarray(positions, dtype=float)
    fit = _errors_of_axes(volume, Machine(str(volume.attrs["chain"]), {axis: point}))
    names = [dof + axis for dof in DOF]
    seen = np.array([fit.distinguished(name) for name in names])
    if not seen.any():
        raise DatasetError(
            f"'{name}': its targets do not determine the errors of {axis}; measure more targets",
            code="compare.targets.undetermined",
        )
    S = np.stack([fit.design(each, positions) for each in names], axis=1)
    if notes is not None:
        notes.append(
            f"'{name}': error motions as polynomials up to order {ORDERS}, with priors of the coefficients of order n "
            f"proportional to n^-p, weighted by their evidence; mean p {fit.exponent:.2g}."
        )
        if fit.factor > 1:
            notes.append(
                f"'{name}': the residuals of the fit are {np.sqrt(fit.factor):.2g} times as large as its uncertainty "
                "allows; the uncertainty of the derived errors is increased by this factor."
            )
    value = S @ fit.coefficient
    F = np.concatenate([np.moveaxis(S @ fit.shared, 2, 0), np.moveaxis(S @ fit.root, 2, 0)])
    own = np.zeros((positions.size, 6, 6))
    for k, each in enumerate(names):
        if seen[k]:
            own[:, k, k] = fit.rest_at(each, positions)
    value[:, ~seen], F[:, :, ~seen], own[:, ~seen], own[:, :, ~seen] = np.nan, np.nan, np.nan, np.nan
    number = volume.sizes.get("source", 0)
    source, group, identity = sources_of(volume)
    parts = len(F) - number
    return Curve(
        value, own, F, [*source, *(f"{name}, errors of the axes, part {k + 1}" for k in range(parts))],
        [*group, *["errors of the axes"] * parts], [*identity, *[""] * parts],
    )  # fmt: skip


def _errors_of_axes(volume: xr.Dataset, machine: Machine) -> AxisErrors:
    """Return the errors of the axes of a machine from those of its tool."""
    q = np.stack([np.asarray(volume[axis.lower()].values, dtype=float) for axis in machine.axis_names], axis=-1)
    error = np.asarray(volume.em.twist().values, dtype=float)
    F = influence_of(volume)
    own = np.asarray(volume["covariance"].values, dtype=float) - np.einsum("sti,stj->tij", F, F)
    known = np.isfinite(error).any(axis=1)
    tool = np.tile(np.asarray(volume.attrs["functional_point"], dtype=float), (len(q), 1))
    targets = Targets(q[known], tool[known], error[known], own[known], F[:, known])
    return fitted(Volume.of(machine, q[known]), targets)
