"""What a method brings so that its uncertainty can be evaluated by the Monte Carlo method: its sources, drawn anew."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr

Draw = Callable[[xr.Dataset, Any, np.random.Generator], tuple[xr.Dataset, Any]]
"""``draw(raw, settings, generator)`` returns raw data and settings with one source drawn anew; changes neither."""
Act = Callable[[xr.Dataset, np.random.Generator], xr.Dataset]
"""``act(errors, generator)`` returns an error dataset with a source that no raw data contain."""


@dataclass(frozen=True)
class Redraw:
    """One source of uncertainty that can be drawn anew, independent of all others.

    Attributes
    ----------
    draw : function, optional
        ``draw(raw, settings, generator)`` returns raw data and settings in which the source is drawn from its
        distribution about what was measured or stated. It leaves its arguments as they are.
    groups : tuple of str
        Values of ``source_group`` in the ``influence`` of the result that this source stands for.
    own : bool
        Whether the part of the covariance that no influence names, independent from value to value, comes from it.
    act : function, optional
        ``act(errors, generator)`` returns an error dataset: for an assumption about the machine that no reading
        contains, such as a rotation that the method does not see.
    """

    draw: Draw | None = None
    groups: tuple[str, ...] = ()
    own: bool = False
    act: Act | None = None


@dataclass(frozen=True)
class Redrawing:
    """Raw data to be drawn anew, and every source of their uncertainty.

    Attributes
    ----------
    raw : Dataset
        What was measured, reduced as far as the method allows so that it can be identified often: means instead of
        single samples, outliers that were found replaced by NaN. It is in memory.
    settings : PluginSettings
        With which ``raw`` gives the values of the measured data: what the method chose by itself is stated, tests for
        outliers are off, and results that no value depends on are left out.
    sources : mapping of str to Redraw
        By name, in the order in which they act.
    """

    raw: xr.Dataset
    settings: Any
    sources: Mapping[str, Redraw]
