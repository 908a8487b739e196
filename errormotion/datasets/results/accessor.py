"""``ds.em``: the accessor of error datasets."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike, NDArray

from errormotion import plugins
from errormotion.arrays import Array
from errormotion.datasets.schemas import COMPONENTS, DOF, SCHEMA
from errormotion.errors import DatasetError
from errormotion.kinematics import iso, twists

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from scipy.spatial.transform import RigidTransform

    from errormotion.datasets.results.plotting.figure import Form
    from errormotion.estimation.extremes import Extremes, Largest
    from errormotion.plugins import FigureOfMerit

FAR = 10.0
"""Distance of a functional point from the origin beyond which its coordinates are probably in mm, m."""
INDEPENDENT = "independent"
"""Name of the independent contribution in a budget."""


class Combination(NamedTuple):
    """A linear combination of errors: ``value(..., dof)`` and ``covariance(..., dof, dof_)``, SI."""

    value: xr.DataArray
    covariance: xr.DataArray


class Pictured:
    """The accessor ``ds.em`` of datasets whose plugin plots them, such as comparisons: ``ds.em.plot()`` only."""

    def __init__(self, ds: xr.Dataset, draw: Callable[[xr.Dataset], Figure]) -> None:
        self._ds = ds
        self._draw = draw

    def plot(self) -> Figure:
        """Return the figure of the dataset."""
        return self._draw(self._ds)

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_"):
            raise AttributeError(name)
        raise _no_errors(self._ds, f"'.em.{name}'")


def _no_errors(ds: xr.Dataset, asked: str) -> DatasetError:
    schema = ds.attrs.get("schema")
    hint = ". Identify a raw dataset first" if str(schema).startswith("errormotion.raw.") or schema is None else ""
    return DatasetError(
        f"{asked} belongs to error datasets (attribute schema = '{SCHEMA}'); found schema = {schema!r}{hint}",
        code="schema.other",
    )


def _accessor(ds: xr.Dataset) -> ErrorMotion | Pictured:
    schema = ds.attrs.get("schema")
    owner = plugins.owner_of_schema(schema) if isinstance(schema, str) and schema != SCHEMA else None
    if owner is None or not issubclass(owner, plugins.DatasetPlugin) or not plugins.states(owner, "plot"):
        return ErrorMotion(ds)
    return Pictured(ds, owner().plot)


xr.register_dataset_accessor("em")(_accessor)  # type: ignore[no-untyped-call]


class ErrorMotion:
    """The accessor ``ds.em`` of error datasets.

    Raises
    ------
    DatasetError
        On first use, if the dataset does not have the error schema.
    """

    def __init__(self, ds: xr.Dataset) -> None:
        if ds.attrs.get("schema") != SCHEMA:
            raise _no_errors(ds, "'.em'")
        self._ds = ds

    def __repr__(self) -> str:
        """Return what was measured, where the errors hold, and how many notes there are."""
        attrs, shape = self._ds.attrs, ", ".join(f"{self._ds.sizes[dim]} {dim}" for dim in self.dims)
        point = ", ".join(f"{1e3 * x:g}" for x in np.ravel(attrs.get("functional_point", ())))
        lines = [
            "<em> errors of {} of {} by {}".format(
                *(attrs.get(key, "?") for key in ("component", "machine", "method"))
            ),
            f"    {', '.join(self.iso_names().values())} over {shape or 'one place'}",
            f"    at ({point}) mm in the frame {attrs.get('frame', '?')!r}",
            f"    {len(self.notes)} notes (.notes), of which {len(self.doubts)} doubt an uncertainty (.doubts)",
            "    .expanded()  .budget()  .figures()  .at(point)  .mean(dim)  .plot()  .to_dataframe()",
        ]
        return "\n".join(lines)

    @property
    def dims(self) -> tuple[str, ...]:
        """Dimensions of the errors, without ``dof``."""
        return tuple(str(dim) for dim in self._ds["EX"].dims)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the estimates: the six freedoms, or ``deviation`` if the method measures one direction only."""
        return ("deviation",) if "deviation" in self._ds.variables else DOF

    def twist(self) -> xr.DataArray:
        """Return all six freedoms in one array.

        Returns
        -------
        DataArray, (..., dof)
            m and rad; NaN where unknown.
        """
        coords = {**self._coords(), "dof": list(DOF)}
        return xr.DataArray(self._stacked(DOF), dims=(*self.dims, "dof"), coords=coords, name="twist")

    def estimates(self) -> xr.DataArray:
        """Return the estimates: the six freedoms, or the deviation as the only ``dof``.

        Returns
        -------
        DataArray, (..., dof)
            m and rad; NaN where unknown.
        """
        values = self._stacked(self.names)
        return xr.DataArray(values, dims=(*self.dims, "dof"), coords=self._coords("dof"), name="estimates")

    def covariance(self) -> xr.DataArray:
        """Return the total covariance of `estimates` at every position.

        Returns
        -------
        DataArray, (..., dof, dof_)
            m^2, m rad, rad^2.
        """
        values = self._covariance()
        return xr.DataArray(values, dims=(*self.dims, "dof", "dof_"), coords=self._coords("dof", "dof_"))

    def expanded(self, k: float = 2.0) -> xr.DataArray:
        """Return the expanded uncertainty ``k u`` of every estimate.

        Returns
        -------
        DataArray, (..., dof)
            m and rad.
        """
        variance = np.diagonal(self._covariance(), axis1=-2, axis2=-1)
        values = k * np.sqrt(np.maximum(variance, 0.0))
        return xr.DataArray(values, dims=(*self.dims, "dof"), coords=self._coords("dof"), name="uncertainty")

    def iso_names(self) -> dict[str, str]:
        """Return the ISO 230-1 name of each estimate, such as ``{"EX": "EXX", ...}``; else its name."""
        component = self._ds.attrs["component"]
        if component not in COMPONENTS or self.names != DOF:
            return {name: name for name in self.names}
        return iso.iso_names(component)

    def at(self, point: ArrayLike) -> xr.Dataset:
        """Return the same errors at another functional point.

        Values, covariance and influence are transformed by ``E' = E + R x r``; of a deviation, the sensitivity.
        Further results of the method are not changed.

        Parameters
        ----------
        point : array_like, (3,)
            m, in the dataset's frame.

        Warns
        -----
        UserWarning
            The point is further than 10 m from the origin: its coordinates may be in mm.

        Raises
        ------
        DatasetError
            Not three finite coordinates; errors of beams, each of which has another zero point; a shift along an axis
            that is not a lever of the rotations (attribute ``lever_axes``).
        """
        target = _point(point)
        if self._ds.attrs.get("component") == "beam":
            raise DatasetError(
                "The errors of beams are stated about each beam's own zero point and have no common functional point. "
                "A beam's origin and direction are in the dataset.",
                code="errors.point.of_beams",
            )
        shift = target - _point(self._ds.attrs["functional_point"])
        self._check_levers(shift)
        if np.linalg.norm(target) > FAR:
            warnings.warn(
                f"The point is {np.linalg.norm(target):.3g} m from the origin of its frame. Coordinates are in m; are "
                "these in mm?",
                stacklevel=2,
            )
        moved = self._transformed(twists.adjoint(shift=shift))
        return moved.assign_attrs(functional_point=target)

    def in_frame(self, pose: RigidTransform, name: str) -> xr.Dataset:
        """Return the same errors, at the same physical point, in another frame.

        Values, covariance, influence, sensitivity, functional point and the commanded ``x y z`` change their
        coordinates. Further results of the method are not changed.

        Parameters
        ----------
        pose : RigidTransform
            Transforms coordinates of the present frame to coordinates of the new one.
        name : str
            Name of the new frame.

        Raises
        ------
        DatasetError
            Only some of ``x y z`` are known, so that they cannot be transformed; a rotation of errors with the
            attribute ``lever_axes``.
        """
        if "lever_axes" in self._ds.attrs and pose.rotation.magnitude() > 1e-9:
            raise DatasetError(
                "The errors are not those of one rigid motion (attribute lever_axes): they are known along the axes "
                "only, and cannot be rotated into another frame",
                code="errors.frame.not_rigid",
            )
        ds = self._transformed(twists.adjoint(rotation=pose.rotation))
        present = [axis for axis in "xyz" if axis in ds.variables]
        if len(present) == 3:
            before = np.stack(np.broadcast_arrays(*(ds[axis].values for axis in "xyz")), axis=-1)
            after = pose.apply(before.reshape(-1, 3)).reshape(before.shape)
            for k, axis in enumerate("xyz"):
                ds[axis] = ds[axis].copy(data=after[..., k])
        elif present:
            raise DatasetError(
                f"A change of frame needs the commanded x, y and z together; found {', '.join(present)} alone. "
                "Add the others as coordinates, or drop them",
                code="errors.frame.coordinates",
            )
        return ds.assign_attrs(functional_point=pose.apply(_point(ds.attrs["functional_point"])), frame=name)

    def covariance_between(self, i: Any, j: Any) -> xr.DataArray:
        """Return the covariance of the errors at two places.

        The sum over sources of ``influence_i influence_j``, plus the independent covariance if i = j.

        Parameters
        ----------
        i, j : int, sequence of int or mapping of str to int
            Index of each place along the dims.

        Returns
        -------
        DataArray, (dof, dof_)
            m^2, m rad, rad^2.
        """
        first, second = self._index(i), self._index(j)
        if first == second:
            covariance = self._covariance()[first]
        else:
            F = np.moveaxis(self._influence(), 0, -1)
            covariance = F[first] @ F[second].T
            if not F.size:  # no shared source: 0 where both values are known
                covariance = covariance + 0 * np.add.outer(self._values()[first], self._values()[second])
        labels = {"dof": list(self.names), "dof_": list(self.names)}
        return xr.DataArray(covariance, dims=("dof", "dof_"), coords=labels)

    def combine(self, weights: ArrayLike, dim: str) -> Combination:
        """Return a linear combination of the errors along a dimension, with its covariance.

        A mean, a difference, a slope: ``sum_k w_k E_k``. The effects of a source are added with their signs before
        they are squared, independent contributions are added in squares. A NaN value with weight 0 has no effect.

        Parameters
        ----------
        weights : array_like, (n,)
            One for each place along ``dim``; finite.
        dim : str

        Returns
        -------
        Combination
            ``value`` (..., dof) and ``covariance`` (..., dof, dof_) over the other dims.

        Raises
        ------
        DatasetError
            No such dim, or weights that do not fit.
        """
        if dim not in self.dims:
            raise DatasetError(
                f"Expected one of the dims {', '.join(self.dims) or '(none)'}; found '{dim}'", code="errors.dim.unknown"
            )
        w = np.asarray(weights, dtype=float)
        if w.shape != (self._ds.sizes[dim],) or not np.isfinite(w).all():
            raise DatasetError(
                f"Expected {self._ds.sizes[dim]} finite weights along '{dim}'; found shape {w.shape}",
                code="errors.weights.shape",
            )
        axis = self.dims.index(dim)
        used = np.flatnonzero(w)
        w = w[used]
        E = np.moveaxis(self._values().take(used, axis), axis, -1) @ w if used.size else self._nothing(axis)
        F = np.moveaxis(self._influence().take(used, axis + 1), axis + 1, -1) @ w
        independent = self._independent().take(used, axis)
        C = np.moveaxis(independent, axis, -1) @ w**2 + np.einsum("s...i,s...j->...ij", F, F)
        rest = tuple(name for name in self.dims if name != dim)
        return Combination(
            xr.DataArray(E, dims=(*rest, "dof"), coords=self._coords("dof", without=dim), name="value"),
            xr.DataArray(C, dims=(*rest, "dof", "dof_"), coords=self._coords("dof", "dof_", without=dim)),
        )

    def largest(self, *names: str, among: ArrayLike | None = None) -> Largest | None:
        """Return the largest error of one freedom, or the longest vector of several, over all places.

        The largest of noisy values is too large on average; its expanded uncertainty contains this bias.

        Parameters
        ----------
        names : str
            One or more of `names`.
        among : array_like of bool, optional
            Places, of the shape of the errors; default all. Only places where all of ``names`` are known are used.

        Returns
        -------
        Largest or None
            ``place`` is a flat index; None if no place is known.
        """
        from errormotion.estimation.extremes import largest

        places, e, C, F = self._known(names, among)
        if not places.size:
            return None
        result = largest(e, C, F)
        return replace(result, place=int(places[result.place]))

    def root_mean_square(self, *names: str) -> Extremes | None:
        """Return the root mean square of one freedom, or of the length of several, over all places where it is known.

        Noise makes it too large on average, as of `largest`. None if no place is known.
        """
        from errormotion.estimation.extremes import root_mean_square

        places, e, C, F = self._known(names)
        return root_mean_square(e, C, F) if places.size else None

    def _known(
        self, names: Sequence[str], among: ArrayLike | None = None
    ) -> tuple[NDArray[np.intp], Array, Array, Array]:
        """Return flat places where all ``names`` are known; their errors, independent covariance and influence."""
        index = [self.names.index(name) for name in names]
        e = self._values()[..., index].reshape(-1, len(index))
        places = np.flatnonzero(np.isfinite(e).all(axis=1) & (True if among is None else np.ravel(among)))
        F = self._influence()[..., index].reshape(-1, *e.shape)[:, places]
        C = self._covariance()[..., index, :][..., index].reshape(-1, len(index), len(index))[places]
        return places, e[places], C - np.einsum("sti,stj->tij", F, F), F

    def since(self, time: float | tuple[float, float]) -> xr.Dataset:
        """Return the changes since an instant, or since the mean of an interval; see `reduction.since`."""
        from errormotion.datasets.results.reduction import since

        return since(self._ds, time)

    def change_from(self, before: xr.Dataset) -> xr.Dataset:
        """Return the changes since another measurement of the same places; see `reduction.change`."""
        from errormotion.datasets.results.reduction import change

        return change(self._ds, before)

    def to_times(self, times: ArrayLike) -> xr.Dataset:
        """Return the errors at other instants, s, by interpolation; see `interpolation.to_points`."""
        from errormotion.datasets.results.interpolation import to_points

        return to_points(self._ds, "time", "time", times)

    def to_positions(self, positions: ArrayLike, coordinate: str = "") -> xr.Dataset:
        """Return the errors at other positions of an axis, m; see `interpolation.to_points`.

        ``coordinate`` is ``x``, ``y`` or ``z`` along ``position``; it may be omitted if there is only one.
        """
        from errormotion.datasets.results.interpolation import to_points

        own = [name for name in "xyz" if name in self._ds.variables and self._ds[name].dims == ("position",)]
        if not coordinate and len(own) != 1:
            raise DatasetError(
                f"Expected one coordinate along 'position'; found {', '.join(own) or 'none'}: state one",
                code="errors.coordinate.ambiguous",
            )
        return to_points(self._ds, "position", coordinate or own[0], positions)

    def mean(self, dim: str) -> xr.Dataset:
        """Return the mean over a dimension with its covariance; see `reduction.mean`."""
        from errormotion.datasets.results.reduction import mean

        return mean(self._ds, dim)

    def figures(self) -> list[FigureOfMerit]:
        """Return the figures of merit of the method, or the last values over time; a plan has none."""
        from errormotion.datasets.results.merit import figures_of

        return figures_of(self._ds)

    @property
    def notes(self) -> list[str]:
        """Sentences for the reader."""
        return self._sentences("notes")

    @property
    def doubts(self) -> list[str]:
        """Those of the notes that state why an uncertainty may be too small."""
        return self._sentences("doubts_uncertainty")

    def _sentences(self, name: str) -> list[str]:
        stated = self._ds.attrs.get(name, [])
        return [note for note in ([stated] if isinstance(stated, str) else list(stated)) if note]

    def budget(self) -> xr.DataArray:
        """Return the uncertainty budget: standard uncertainty (k = 1) by group of sources, and independent part.

        The groups' root sum of squares is the total.

        Returns
        -------
        DataArray, (group, ..., dof)
            m and rad; the last group is ``independent``.
        """
        F = self._influence()
        groups = [str(group) for group in self._ds["source_group"].values] if F.shape[0] else []
        names = list(dict.fromkeys(groups))
        rows = [np.sqrt((F[[group == name for group in groups]] ** 2).sum(axis=0)) for name in names]
        rest = np.sqrt(np.maximum(np.diagonal(self._independent(), axis1=-2, axis2=-1), 0.0))
        coords = {"group": [*names, INDEPENDENT], **self._coords("dof")}
        return xr.DataArray(np.stack([*rows, rest]), dims=("group", *self.dims, "dof"), coords=coords, name="budget")

    def plot(
        self,
        freedoms: str | Sequence[str] | None = None,
        at: ArrayLike | None = None,
        k: float = 2.0,
        ax: Axes | Sequence[Axes] | None = None,
        form: Form = "auto",
    ) -> Figure:
        """Return a figure: displacements in um and rotations in arcsec with their uncertainty; see `plot_errors`.

        Curves, maps over two dims, or arrows in a volume, of some ``freedoms``, ``at`` a functional point (m), with the
        coverage factor ``k``, in the axes ``ax``.
        """
        from errormotion.datasets.results.plotting import plot_errors  # imports matplotlib

        return plot_errors(self._ds, freedoms, at, k, ax, form)

    def to_dataframe(self, freedoms: str | Sequence[str] | None = None, k: float = 2.0) -> pd.DataFrame:
        """Return errors and expanded uncertainties as a table in field units; see `tables.to_dataframe`."""
        from errormotion.datasets.results.tables import to_dataframe

        return to_dataframe(self._ds, freedoms, k)

    def _check_levers(self, shift: Array) -> None:
        """Refuse a shift along axes whose travel is not a lever of the rotations."""
        levers = str(self._ds.attrs.get("lever_axes", "XYZ"))
        wrong = [axis for axis, length in zip("XYZ", shift, strict=True) if axis not in levers and abs(length) > 1e-9]
        if wrong and self._ds.attrs.get("component") != "beam":
            raise DatasetError(
                "The errors are not those of one rigid motion (attribute lever_axes): only the travel of "
                f"{' and '.join(levers)} is a lever of their rotations, and they cannot be moved along "
                f"{' and '.join(wrong)}. Identify them at the other functional point",
                code="errors.point.not_rigid",
            )

    def _stacked(self, names: Sequence[str]) -> Array:
        return np.stack([self._ds.variables[name].values for name in names], axis=-1)

    def _values(self) -> Array:
        return np.asarray(self._stacked(self.names), dtype=float)

    def _covariance(self) -> Array:
        name = "covariance" if self.names == DOF else "deviation_variance"
        expected = {*self.dims, *(("dof", "dof_") if name == "covariance" else ())}
        if not expected <= set(self._ds.variables[name].dims):
            raise DatasetError(
                f"{name}: expected the dims {', '.join(sorted(expected))}; found "
                f"{', '.join(map(str, self._ds.variables[name].dims)) or 'none'}, as after a reduction of the whole "
                "dataset. The mean with its covariance is ds.em.mean(dim)",
                code="errors.covariance.reduced",
            )
        if self.names == DOF:
            return np.asarray(self._ds.variables["covariance"].values, dtype=float)
        return np.asarray(self._ds.variables["deviation_variance"].values, dtype=float)[..., None, None]

    def _influence(self) -> Array:
        if self.names == DOF and "influence" in self._ds.variables:
            return np.asarray(self._ds.variables["influence"].values, dtype=float)
        if self.names != DOF and "deviation_influence" in self._ds.variables:
            return np.asarray(self._ds.variables["deviation_influence"].values, dtype=float)[..., None]
        return np.zeros((0, *self._values().shape))

    def _independent(self) -> Array:
        F = self._influence()
        C: Array = self._covariance() - np.einsum("s...i,s...j->...ij", F, F, optimize=True)
        return C

    def _nothing(self, axis: int) -> Array:
        return np.zeros(np.delete(self._values().shape, axis))

    def _coords(self, *dof: str, without: str = "") -> dict[str, Any]:
        kept = {name: self._ds.coords[name] for name in self.dims if name != without and name in self._ds.coords}
        return {**kept, **{name: list(self.names) for name in dof}}

    def _index(self, place: int | Sequence[int] | Mapping[str, int]) -> tuple[int, ...]:
        if isinstance(place, Mapping):
            if set(place) != set(self.dims):
                raise DatasetError(
                    f"Expected an index for each of {', '.join(self.dims)}; found {dict(place)}",
                    code="errors.index.dims",
                )
            place = [place[dim] for dim in self.dims]
        index = (int(place),) if isinstance(place, (int, np.integer)) else tuple(int(number) for number in place)
        if len(index) != len(self.dims):
            raise DatasetError(
                f"Expected an index for each of {', '.join(self.dims)}; found {index}", code="errors.index.dims"
            )
        sizes = [self._ds.sizes[dim] for dim in self.dims]
        for number, size in zip(index, sizes, strict=True):
            if not -size <= number < size:
                raise DatasetError(f"Expected an index below {size}; found {number}", code="errors.index.outside")
        return tuple(number % size for number, size in zip(index, sizes, strict=True))

    def _transformed(self, A: Array) -> xr.Dataset:
        """Return a copy with twist, covariance, influence and sensitivity transformed by a 6x6 matrix."""
        old = self._ds.variables
        E = twists.transform(self._stacked(DOF), A)
        new = {name: E[..., k].copy() for k, name in enumerate(DOF)}
        new["covariance"] = twists.transform_covariance(old["covariance"].values, A)
        if "influence" in old:
            new["influence"] = twists.transform(old["influence"].values, A)
        if "sensitivity" in old:  # h . E = h' . E'
            new["sensitivity"] = old["sensitivity"].values @ np.linalg.inv(A)
        return self._ds.assign({name: old[name].copy(data=values) for name, values in new.items()})


def _point(point: ArrayLike) -> Array:
    array = np.array(point, dtype=float)
    if array.shape != (3,) or not np.isfinite(array).all():
        raise DatasetError(
            f"Expected a point: three finite coordinates in m; found {point!r}", code="errors.point.form"
        )
    return array
