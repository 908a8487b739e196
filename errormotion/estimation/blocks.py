"""What an equation refers to: tables of unknowns and of constants, and the rows of them that each reading sees.

A model states the residual of a reading as a function of a few rows of each table. The index maps of this module state
which rows these are. The structure of the least squares (which unknowns can be eliminated, which are coupled along a
chain), all derivatives, and the effect of every uncertain constant follow from them.

>>> import numpy as np
>>> slope = Block(start=np.zeros((1, 2)), index=np.zeros(3, dtype=int), scale=1.0)
>>> slope.rows(np.array([[1.0, 2.0]]))
array([[1., 2.],
       [1., 2.],
       [1., 2.]])
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from errormotion.arrays import Array
from errormotion.errors import FitError

__all__ = ["Block", "Constant", "Index", "Noise", "Table"]

Index = NDArray[np.intp]


@dataclass(frozen=True, eq=False, kw_only=True)
class Table:
    """The rows that each reading sees.

    Attributes
    ----------
    index : ndarray of int, (n,) or (n, w)
        Row, or rows, of the table that each of n readings sees. The equation receives (n, width) for one row each,
        (n, w, width) for several.
    weight : ndarray, (n, w), optional
        The equation receives the sum of the rows with these weights, (n, width), such as a value between knots.
    scale : float or ndarray, (width,)
        The change of a value over which the model bends noticeably: the radius of a ball, a lever, 1 rad. Derivatives
        are differences over a small part of it.
    group : str
        The name in the budget. A block of unknowns without one is seen by a single place each, such as the errors of
        an instant: its uncertainty is independent from place to place, and it can be eliminated.
    """

    index: Index
    scale: float | Array
    weight: Array | None = None
    group: str = ""

    @property
    def slots(self) -> int:
        """Number of rows that a reading sees."""
        return 1 if self.index.ndim == 1 else self.index.shape[1]

    @cached_property
    def index2(self) -> Index:
        """The index as (n, w)."""
        return self.index.reshape(len(self.index), self.slots)

    @cached_property
    def common(self) -> bool:
        """Whether all readings see the same rows without weights, such as those of a table of one row."""
        return self.weight is None and len(self.index) > 0 and bool((self.index == self.index[0]).all())

    def rows(self, table: Array) -> Array:
        """Return the rows of a table (size, width) as the equation receives them; read-only where all are the same."""
        if self.common:
            one = table[self.index[0]]
            return np.broadcast_to(one, (len(self.index), *one.shape))
        if self.index.ndim == 1:
            return np.asarray(table[self.index])
        if self.weight is None:
            return np.asarray(table[self.index])
        rows = self.weight[:, :1] * table[self.index[:, 0]]
        for slot in range(1, self.slots):
            rows += self.weight[:, slot, None] * table[self.index[:, slot]]
        return np.asarray(rows)


@dataclass(frozen=True, eq=False, kw_only=True)
class Block(Table):
    """A table of unknowns.

    Attributes
    ----------
    start : ndarray, (size, width)
        Start of the iteration, and the expected values of the prior.
    free : ndarray of bool, (size,) or (size, width), optional
        What is estimated; the others keep their start. Default: all.
    prior : float or ndarray, broadcast to (size, width), optional
        Standard deviation about ``start``; infinite without a prior.
    component : sequence of str, (width,), optional
        Columns whose rows are random effects, independent from row to row about ``start``, with a variance that the
        readings determine (`components`): its name, or "" for columns without. Columns of the same name have the same
        variance.
    """

    start: Array
    free: NDArray[np.bool_] | None = None
    prior: float | Array | None = None
    component: Sequence[str] = ()

    def __post_init__(self) -> None:
        _check(self, self.start)
        if len(self.component) not in (0, self.start.shape[1]):
            raise FitError(
                f"'{self.group}': expected {self.start.shape[1]} components; found {len(self.component)}",
                code="estimation.block.components",
            )
        if self.prior is not None and not (np.asarray(self.prior) > 0).all():
            raise FitError(
                f"'{self.group}': expected standard deviations above 0 of the prior; found {self.prior}",
                code="estimation.prior.not_positive",
            )

    @cached_property
    def freed(self) -> NDArray[np.bool_]:
        """What is estimated, (size, width)."""
        free = np.ones(len(self.start), dtype=bool) if self.free is None else self.free
        whole = free[:, None] if free.ndim == 1 else free
        return np.broadcast_to(whole, self.start.shape)

    @cached_property
    def information(self) -> Array:
        """Information of the prior, (size, width): 1 over its variance, or 0."""
        if self.prior is None:
            return np.zeros(self.start.shape)
        sd = np.broadcast_to(np.asarray(self.prior, dtype=float), self.start.shape)
        return np.where(np.isfinite(sd), 1.0 / np.square(np.where(sd > 0, sd, 1.0)), 0.0)


@dataclass(frozen=True, eq=False, kw_only=True)
class Constant(Table):
    """A table of known values with their uncertainty: a calibration, a scale, a temperature.

    Attributes
    ----------
    value : ndarray, (size, width)
    factor : ndarray, (size, width, k)
        The effect of k independent sources, each of one standard uncertainty: the covariance of all values is
        ``factor factor'``.
    names : sequence of str, (k,)
        What each source is called; by default the group, numbered.
    identity : sequence of str, (k,)
        What each source is, so that two results that share it share its error ("certificate 17: bar, radius");
        empty texts, or none, for sources of this result alone.
    adjust : bool
        Whether the readings may improve the values (their uncertainty is then a prior); otherwise the values are taken
        as they are, and their uncertainty propagates.
    """

    value: Array
    factor: Array
    names: Sequence[str] = ()
    identity: Sequence[str] = ()
    adjust: bool = False

    def __post_init__(self) -> None:
        _check(self, self.value)
        if self.factor.shape[:2] != self.value.shape:
            raise FitError(
                f"constant '{self.group}': expected a factor of shape {(*self.value.shape, 'k')}; "
                f"found {self.factor.shape}",
                code="estimation.constant.factor",
            )
        for what in ("names", "identity"):
            if len(given := getattr(self, what)) not in (0, self.sources):
                raise FitError(
                    f"constant '{self.group}': expected {self.sources} {what}; found {len(given)}",
                    code="estimation.constant.sources",
                )

    @property
    def sources(self) -> int:
        """Number of independent sources k."""
        return int(self.factor.shape[2])


@dataclass(frozen=True, eq=False, kw_only=True)
class Noise:
    """The noise of the readings, independent from reading to reading.

    Attributes
    ----------
    sd : ndarray, (n,) or (n, r)
        Standard deviation of each number of each reading, in the unit of the readings.
    root : ndarray, (n, r, r), optional
        In place of ``sd``: a square root of the covariance of each reading with r numbers.
    stated : bool
        Whether the size is known; otherwise only the ratios are, and the residuals give the size.
    freedom : float
        Degrees of freedom of a stated variance (GUM G.4.2): ``1/2 (u(s) / s)^-2``. If finite, it is combined with that
        of the residuals as long as they agree.
    """

    sd: Array | None = None
    root: Array | None = None
    stated: bool = True
    freedom: float = np.inf

    def __post_init__(self) -> None:
        if (self.sd is None) == (self.root is None):
            raise FitError("expected either sd or root of the noise", code="estimation.noise.both")

    def effect(self, L: Array) -> Array:
        """Return the effect of independent noise of unit size on residuals with derivatives L (n, m, r), (n, m, k)."""
        if self.root is not None:
            return np.asarray(L @ self.root)
        sd = np.asarray(self.sd, dtype=float)
        return np.asarray(L * (sd[:, None, None] if sd.ndim == 1 else sd[:, None, :]))

    def covariance(self, shape: tuple[int, int]) -> Array:
        """Return the covariance of the numbers of each reading, (n, r, r)."""
        if self.root is not None:
            return np.asarray(self.root @ np.swapaxes(self.root, -1, -2))
        sd = np.asarray(self.sd, dtype=float)
        sd = np.broadcast_to(sd[:, None] if sd.ndim == 1 else sd, shape)
        return np.asarray(np.square(sd)[:, :, None] * np.eye(shape[1]))


def _check(table: Table, values: Array) -> None:
    """Raise an error if index, weight and table do not fit together."""
    name = f"'{table.group}': " if table.group else ""
    if values.ndim != 2:
        raise FitError(f"{name}expected a table (size, width); found {values.shape}", code="estimation.table.shape")
    if table.index.ndim not in (1, 2):
        raise FitError(
            f"{name}expected an index (n,) or (n, w); found {table.index.shape}", code="estimation.index.shape"
        )
    if table.weight is not None and table.weight.shape != table.index.shape:
        raise FitError(
            f"{name}expected weights of shape {table.index.shape}; found {table.weight.shape}",
            code="estimation.weights.shape",
        )
    if table.index.size and (table.index.min() < 0 or table.index.max() >= len(values)):
        raise FitError(
            f"{name}expected rows of a table of {len(values)}; found {table.index.min()} to {table.index.max()}",
            code="estimation.index.outside",
        )
