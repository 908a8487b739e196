"""The 21 errors of a three-axis machine from the errors of targets, and the volumetric errors by them anywhere.

The fit is that of `errormotion.kinematics.volumes` with a reflector as tool. With one position of the reflector, errors
without effect on it, or with the same effect as others, are not determined: rotations of the axis that carries it, and
those of others with a constant lever.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr

from errormotion.arrays import Array
from errormotion.datasets import build_errors, provenance
from errormotion.errors import MethodError
from errormotion.estimation.low_rank import root_of
from errormotion.kinematics.machines import Machine
from errormotion.kinematics.volumes import AxisErrors, Targets, Term, Undetermined, Volume, fitted

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import ArrayLike, NDArray

AXES = ("X", "Y", "Z")
CURVE_POINTS = 41
"""Number of positions at which an error motion is tabulated."""
_DOFS = 6


def volume_of(chain: str, position: Array, reflector: Array) -> Volume:
    """Return the volume of targets at axis positions (m, 3) with reflectors (m, 3), m; errors are stated at their mean.

    Raises
    ------
    MethodError
        Not a chain, or other axes than X, Y and Z.
    """
    reference = np.asarray(reflector, dtype=float).mean(axis=0)
    try:
        machine = Machine(chain, dict.fromkeys(AXES, reference))
    except ValueError as error:
        raise MethodError(f"Chain of the machine: {error}", code="network.chain.form") from error
    if machine.axis_names != AXES:
        raise MethodError(
            f"Parametric errors: expected a machine with the axes X, Y and Z; found {', '.join(machine.axis_names)}",
            code="network.chain.axes",
        )
    return Volume.of(machine, position)


def reference_of(axes: AxisErrors) -> Array:
    """Return the point with all axes at zero at which the error motions are stated, (3,), m."""
    return axes.volume.machine.joints[0].reference


def fit_machine(
    chain: str,
    position: Array,
    error: Array,
    own: Array,
    influence: Array,
    *,
    reflector: Array | None = None,
    max_order: int = 12,
) -> AxisErrors:
    """Estimate the errors of the axes from displacements at targets.

    Parameters
    ----------
    chain : str
        Such as ``workpiece-X-Y-bed-Z-spindle-tool``.
    position : ndarray (m, 3)
        Commanded axis positions, m.
    error : ndarray (m, 3)
        Displacements in any datum, m; NaN if unknown.
    own : ndarray (m, 3, 3)
        Independent covariance of each target, m^2.
    influence : ndarray (source, m, 3)
        Effect of one standard uncertainty of each shared source, m.
    reflector : ndarray (m, 3), optional
        Position of the reflector of each target with all axes at zero, m; default: the origin.
    max_order : int
        Of the polynomials.

    Raises
    ------
    MethodError
        Not a chain of X, Y and Z; too few known targets.
    """
    known = np.flatnonzero(np.isfinite(error).all(axis=1) & np.isfinite(own).all(axis=(1, 2)))
    if len(known) < 10:
        raise MethodError(
            f"Parametric errors: expected at least ten known targets; found {len(known)}. Measure more.",
            code="network.targets.too_few",
        )
    at = np.zeros_like(position) if reflector is None else reflector
    q, tool = position[known], at[known]
    targets = Targets(q, tool, error[known], own[known], influence[:, known])
    return fitted(volume_of(chain, q, tool), targets, max_order)


def misfit_note(axes: AxisErrors, max_order: int) -> list[str]:
    """Return a note on targets whose errors the axes do not explain."""
    if axes.factor == 1.0:
        return []
    return [
        f"The residuals of the targets' errors after the errors of the axes are {axes.sigma0:.3g} times their "
        "uncertainty. Possible causes: a machine that is not rigid, hysteresis, or error motions of higher order "
        f"than {max_order}. The uncertainties of the axes are increased accordingly."
    ]


def parametric_extras(axes: AxisErrors) -> dict[str, xr.DataArray]:
    """Return the errors of the axes as variables of an error dataset.

    ``EXX(X_position)`` ... and ``EXX_u``: error motions and standard uncertainties, NaN if not determined, with the
    reason as attribute ``unseen``; the attribute ``includes`` states errors with the same effect; ``EC0Y`` ... and
    ``EC0Y_u``: squareness; ``coefficient(term)`` with ``coefficient_covariance``, and the inputs of
    `volumetric_errors`. Their coordinates are `parametric_labels`.
    """
    extras: dict[str, xr.DataArray] = {}
    volume, orders = axes.volume, axes.orders
    includes = _includes(axes.undetermined)
    for k, (dim, q) in enumerate(_curve_positions(volume).items()):
        for error in volume.motions[6 * k : 6 * k + 6]:
            unit = _unit(error)
            attrs = {
                "units": unit, "order": orders.get(error, 0), "unseen": _reason(axes, error),
                "includes": includes.get(error, ""),
            }  # fmt: skip
            value, u = axes.curve(error, q)
            extras[error] = xr.DataArray(value, dims=dim, attrs=attrs)
            extras[f"{error}_u"] = xr.DataArray(u, dims=dim, attrs={"units": unit})
    for error, (number, uncertainty) in axes.locations().items():
        attrs = {"units": "rad", "unseen": _reason(axes, error), "includes": includes.get(error, "")}
        extras[error] = xr.DataArray(number, attrs=attrs)
        extras[f"{error}_u"] = xr.DataArray(uncertainty, attrs={"units": "rad"})
    reasons = [f"{name}: {each.reason}" for name, each in axes.undetermined.items()]
    attrs_of_terms = {"chain": volume.machine.chain, "unseen": reasons or [""]}
    extras["coefficient"] = xr.DataArray(axes.coefficient, dims="term", attrs=attrs_of_terms)
    extras["coefficient_covariance"] = xr.DataArray(axes.covariance, dims=("term", "term_"))
    extras["determined"] = xr.DataArray(
        axes.determined, dims="term", attrs={"units": "1", "long_name": "1: by the targets, 0: by the prior"}
    )
    extras["axes_datum"] = xr.DataArray(axes.datum, dims=("motion", "term"))
    rest = np.zeros((len(volume.motions), max(map(len, axes.rest.values()))))
    for motion, variance in axes.rest.items():
        rest[volume.motions.index(motion)] = variance
    meaning = {"long_name": "variance of the coefficients above the fitted orders, m^2 or rad^2"}
    extras["axes_rest"] = xr.DataArray(rest, dims=("error_motion", "rest_order"), attrs=meaning)
    m = {"units": "m"}
    for name, vector in {
        "axes_centre": axes.centre,
        "axes_reference": reference_of(axes),
        "axes_low": volume.low,
        "axes_high": volume.high,
    }.items():
        extras[name] = xr.DataArray(vector, dims="direction", attrs=m)
    extras["axes_sigma0"] = xr.DataArray(axes.sigma0, attrs={"units": "1"})
    extras["axes_freedom"] = xr.DataArray(axes.freedom)
    return extras


def parametric_labels(axes: AxisErrors) -> dict[str, Any]:
    """Return the coordinates of the variables by `parametric_extras`: name to (dims, values, attributes)."""
    return {
        **{dim: (dim, q, {"units": "m"}) for dim, q in _curve_positions(axes.volume).items()},
        "term_error": ("term", [term.error for term in axes.terms], {}),
        "term_order": ("term", [term.order for term in axes.terms], {}),
        "error_motion": ("error_motion", list(axes.volume.motions), {}),
    }


def _curve_positions(volume: Volume) -> dict[str, Array]:
    """Return the positions of each axis at which its errors are tabulated, m, by the name of the dimension."""
    ends = zip(AXES, volume.low, volume.high, strict=True)
    return {f"{axis}_position": np.linspace(low, high, CURVE_POINTS) for axis, low, high in ends}


def _reason(axes: AxisErrors, error: str) -> str:
    return axes.undetermined[error].reason if error in axes.undetermined else ""


def _includes(undetermined: Mapping[str, Undetermined]) -> dict[str, str]:
    """Return for each error the others that it includes, since they have the same effect at the reflector."""
    included: dict[str, list[str]] = {}
    for error, each in undetermined.items():
        for name in each.like:
            included.setdefault(name, []).append(error)
    return {name: f"the effect of {' and '.join(others)} at the reflector" for name, others in included.items()}


def axes_of(errors: xr.Dataset) -> AxisErrors:
    """Return the errors of the axes in a dataset of this method.

    Raises
    ------
    MethodError
        The dataset contains none.
    """
    if "coefficient" not in errors:
        raise MethodError(
            "The dataset contains no errors of the axes. Identify the raw data with the chain of the machine (setting "
            "'chain').",
            code="network.no_errors_of_axes",
        )
    c = errors["coefficient"]
    pairs = zip(c["term_error"].values, c["term_order"].values, strict=True)
    terms = [Term(str(error), int(order)) for error, order in pairs]
    vector = {name: np.asarray(errors[f"axes_{name}"].values, dtype=float) for name in
              ("centre", "reference", "low", "high")}  # fmt: skip
    volume = volume_of(str(c.attrs["chain"]), np.stack([vector["low"], vector["high"]]), vector["reference"][None])
    reasons = {name: str(errors[name].attrs.get("unseen", "")) for name in volume.machine.error_names}
    undetermined = {name: Undetermined(reason) for name, reason in reasons.items() if reason}
    rest = errors["axes_rest"].values if "axes_rest" in errors else np.zeros((len(volume.motions), 0))
    return AxisErrors(
        volume, terms, c.values, errors["coefficient_covariance"].values, np.zeros((len(terms), 0)),
        dict(zip(volume.motions, rest, strict=True)), errors["determined"].values, undetermined, float("nan"),
        float(errors["axes_sigma0"]), 1.0, float(errors["axes_freedom"]), errors["axes_datum"].values, vector["centre"],
    )  # fmt: skip


def volumetric_errors(errors: xr.Dataset, position: ArrayLike, tool: ArrayLike | None = None) -> xr.Dataset:
    """Return the volumetric errors at any axis positions, from the errors of the axes.

    Parameters
    ----------
    errors : Dataset
        Of this method, with errors of the axes.
    position : array_like (k, 3)
        Commanded axis positions, m. Outside the measured part of the axes the errors are NaN.
    tool : array_like (3,), optional
        Position of the tool with all axes at zero, m; default: that of the reflector. At another position, freedoms
        that depend on undetermined errors are NaN.

    Returns
    -------
    Dataset
        Error dataset over ``target`` in the datum of ``errors``. The parts of the covariance of the coefficients are
        the sources of ``influence``; the covariance also contains the orders that were not fitted.

    Raises
    ------
    MethodError
        No errors of the axes, or positions that are not (k, 3).
    """
    axes = axes_of(errors)
    q = np.atleast_2d(np.asarray(position, dtype=float))
    if q.ndim != 2 or q.shape[1] != 3 or not np.isfinite(q).all():
        raise MethodError(
            f"position: expected finite axis positions (k, 3) in m; found shape {q.shape}, or NaN",
            code="network.position.form",
        )
    at = reference_of(axes) if tool is None else np.asarray(tool, dtype=float)
    A = _field(axes, q, at)
    values = A @ axes.coefficient
    inside = axes.volume.inside(q)
    unknown = ~(_known_dofs(axes, q, at) & inside[:, None])
    root = root_of(axes.covariance, smallest=1e-14)
    influence = np.moveaxis(A @ root, 2, 0)
    values[unknown] = np.nan
    influence[:, unknown] = np.nan
    covariance = np.einsum("ska,skb->kab", influence, influence) + _rest(axes, q, at)
    notes = []
    if outside := int(np.count_nonzero(~inside)):
        notes.append(f"{outside} of {len(q)} positions are outside the measured volume: their errors are unknown.")
    attrs = errors.attrs
    ds = build_errors(
        values,
        covariance,
        dims=("target",),
        coords={name: ("target", q[:, k], {"units": "m"}) for k, name in enumerate("xyz")},
        component="tool",
        machine=str(attrs["machine"]),
        frame=str(attrs["frame"]),
        functional_point=at,
        reference=str(attrs["reference"]),
        method=str(attrs["method"]),
        method_version=str(attrs["method_version"]),
        provenance=provenance.make({}, errors, (), steps=["volumetric errors from the errors of the axes"]),
        influence=influence,
        sources=[f"axes.{k}" for k in range(len(influence))],
        source_groups=["errors of the axes"] * len(influence),
    )
    return ds.assign_attrs(notes=notes or [""])


def grid(low: Sequence[float], high: Sequence[float], count: Sequence[int]) -> Array:
    """Return the axis positions of a grid, (k, 3), m; a count of 1 is a slice in the middle of low and high."""
    axes = [
        np.linspace(a, b, n) if n > 1 else np.array([(a + b) / 2]) for a, b, n in zip(low, high, count, strict=True)
    ]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


def diagonals(low: Sequence[float], high: Sequence[float], count: int = 11) -> Array:
    """Return positions along the four body diagonals, (4, count, 3), m; each starts at the lowest Z (ISO 230-6)."""
    a, b = np.asarray(low, dtype=float), np.asarray(high, dtype=float)
    starts = np.array([(0, 0, 0), (1, 0, 0), (0, 1, 0), (1, 1, 0)], dtype=float)
    t = np.linspace(0.0, 1.0, count)[None, :, None]
    share = starts[:, None] + t * (1 - 2 * starts[:, None])
    return np.asarray(a + share * (b - a))


def _unit(error: str) -> str:
    return "m" if error[1] in AXES else "rad"


def _field(axes: AxisErrors, q: Array, tool: Array) -> Array:
    """Return the derivative of the twists by the coefficients, (k, 6, term), in the datum."""
    at = np.tile(tool, (len(q), 1))
    A = axes.volume.columns(axes.terms, q, at, _DOFS)
    A[:, :3] -= axes.volume.wholes(q, at, axes.centre) @ axes.datum
    A[:, 3:] -= axes.datum[3:]
    return A


def _rest(axes: AxisErrors, q: Array, tool: Array) -> Array:
    """Return the covariance (k, 6, 6) of the twists by the orders of the error motions that were not fitted."""
    J = axes.volume.machine.jacobian(q, tool)
    covariance = np.zeros((len(q), _DOFS, _DOFS))
    for k, motion in enumerate(axes.volume.motions):
        if motion not in axes.undetermined and len(axes.rest[motion]):
            variance = axes.rest_at(motion, q[:, axes.volume.axis(motion)])
            covariance += variance[:, None, None] * J[:, :, k, None] * J[:, None, :, k]
    return covariance


def _known_dofs(axes: AxisErrors, q: Array, tool: Array) -> NDArray[np.bool_]:
    """Return whether each freedom is known, (k, 6).

    Displacements at the position of the reflector are known: errors that are not distinguishable have the same effect
    there. Elsewhere, and for rotations, every error with an effect must be determined.
    """
    J = axes.volume.machine.jacobian(q, tool)
    undetermined = [axes.volume.machine.error_names.index(name) for name in axes.undetermined]
    known = np.asarray((J[:, :, undetermined] == 0).all(axis=2), dtype=bool)
    if np.allclose(tool, reference_of(axes), rtol=0, atol=1e-9):
        known[:, :3] = True
    return known
