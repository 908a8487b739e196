"""Heat in the machine: a network of lumped bodies, solved in closed form.

The equation is ``C dT/dt = -G T + g T_ambient + h P``, with C the heat capacities (J/K), G the conductances among the
bodies and to the air (W/K), g the conductances to the air, and h the share of each body in the spindle's heat P (W).
The eigenvectors of C^-1/2 G C^-1/2 decouple it into first-order lags, whose response to a piecewise constant P and to a
sinusoidal T_ambient is known exactly: temperatures at any time need no time steps.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from errormotion.arrays import Array


@dataclass(frozen=True)
class LagResponse:
    """z(t) of dz/dt = -rate z + u, at rest before times[0], for a piecewise constant input u.

    Attributes
    ----------
    rates : (mode,)
        Reciprocal time constants, 1/s.
    times, inputs : (piece,)
        The input is inputs[i] from times[i] on.
    """

    rates: Array
    times: Array
    inputs: Array
    _begin: Array = field(init=False, repr=False)

    def __post_init__(self) -> None:
        begin = np.zeros((self.times.size, self.rates.size))
        for i in range(1, self.times.size):
            decay = np.exp(-self.rates * (self.times[i] - self.times[i - 1]))
            begin[i] = begin[i - 1] * decay + self.inputs[i - 1] * (1 - decay) / self.rates
        object.__setattr__(self, "_begin", begin)

    def __call__(self, t: ArrayLike) -> Array:
        """Return z at times t (n,), s, shape (n, mode)."""
        t = np.asarray(t, dtype=float)
        at = np.searchsorted(self.times, t, side="right") - 1
        early = at < 0
        at = np.maximum(at, 0)
        exponent = -self.rates * np.where(early, 0.0, t - self.times[at])[:, None]
        z = self._begin[at] * np.exp(exponent) - self.inputs[at][:, None] * np.expm1(exponent) / self.rates
        return np.asarray(np.where(early[:, None], 0.0, z))


@dataclass(frozen=True)
class Ambient:
    """Air temperature: a mean and waves, ``mean + sum amplitude sin(omega t + phase)``, degC.

    Attributes
    ----------
    mean : float
        degC.
    amplitude, omega, phase : ndarray, (wave,)
        K, rad/s, rad.
    """

    mean: float
    amplitude: Array
    omega: Array
    phase: Array

    def __call__(self, t: ArrayLike) -> Array:
        """Return the air's temperature at times t, degC."""
        t = np.asarray(t, dtype=float)
        waves = self.amplitude * np.sin(self.omega * t[..., None] + self.phase)
        return np.asarray(self.mean + np.sum(waves, axis=-1))


@dataclass(frozen=True)
class ThermalNetwork:
    """Bodies that exchange heat.

    Attributes
    ----------
    names : tuple of str
        Bodies.
    capacity : ndarray, (body,)
        Heat capacities, J/K.
    conductance : ndarray, (body, body)
        Between bodies, W/K; symmetric, zero diagonal.
    to_air : ndarray, (body,)
        W/K.
    heat_share : ndarray, (body,)
        Share of each body in the spindle's heat; the sum is at most 1.
    """

    names: tuple[str, ...]
    capacity: Array
    conductance: Array
    to_air: Array
    heat_share: Array
    rates: Array = field(init=False, repr=False)
    _modes: Array = field(init=False, repr=False)
    _heat: Array = field(init=False, repr=False)
    _air: Array = field(init=False, repr=False)

    def __post_init__(self) -> None:
        root = np.sqrt(self.capacity)
        total = np.diag(self.conductance.sum(axis=1) + self.to_air) - self.conductance
        rates, vectors = np.linalg.eigh(total / np.outer(root, root))
        object.__setattr__(self, "rates", rates)
        object.__setattr__(self, "_modes", vectors / root[:, None])  # T = modes @ z
        object.__setattr__(self, "_heat", vectors.T @ (self.heat_share / root))
        object.__setattr__(self, "_air", vectors.T @ (self.to_air / root))

    @classmethod
    def of(
        cls,
        capacity: Mapping[str, float],
        links: Sequence[tuple[str, str, float]],
        to_air: Mapping[str, float],
        heat_share: Mapping[str, float],
    ) -> ThermalNetwork:
        """Return a network from tables by name (J/K, W/K, W/K, 1)."""
        names = tuple(capacity)
        conductance = np.zeros((len(names), len(names)))
        for one, other, value in links:
            i, j = names.index(one), names.index(other)
            conductance[i, j] = conductance[j, i] = value
        vectors = (np.array([table.get(name, 0.0) for name in names]) for table in (capacity, to_air, heat_share))
        c, g, h = vectors
        return cls(names, c, conductance, g, h)

    def heated(self, times: Array, power: Array) -> LagResponse:
        """Return the response of the modes to the spindle's heat ``power`` (W, from ``times`` on)."""
        return LagResponse(self.rates, times, power)

    def heating(self, t: ArrayLike, heated: LagResponse) -> Array:
        """Return the temperature rise due to the spindle's heat at times t (n,), s; K, shape (n, body)."""
        return _combine(heated(t) * self._heat, self._modes)

    def transfer(self, ambient: Ambient) -> NDArray[np.complex128]:
        """Return the waves of the bodies' temperatures for waves of the air of 1 K, shape (body, wave)."""
        return np.asarray(self._modes @ (self._air[:, None] / (self.rates[:, None] + 1j * ambient.omega)), complex)

    def air_response(self, t: ArrayLike, ambient: Ambient, transfer: NDArray[np.complex128] | None = None) -> Array:
        """Return each body's temperature in the steady state of a machine at standstill, degC, shape (n, body).

        ``transfer`` is that of the ambient air, if it is known.
        """
        t = np.asarray(t, dtype=float)
        transfer = self.transfer(ambient) if transfer is None else transfer
        wave = ambient.amplitude * np.exp(1j * (ambient.omega * t[:, None] + ambient.phase))
        return ambient.mean + _combine(wave.imag, transfer.real) + _combine(wave.real, transfer.imag)


def _combine(values: Array, weights: Array) -> Array:
    """Return values @ weights.T, (n, k) and (m, k), in an order of summation that does not depend on n."""
    return np.asarray(np.multiply(values.T[:, :, None], weights.T[:, None], order="C").sum(axis=0))
