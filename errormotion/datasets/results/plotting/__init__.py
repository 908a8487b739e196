"""Figures of error datasets for ``ds.em.plot()``: curves, maps, and arrows in the volume."""

from errormotion.datasets.results.plotting.figure import plot_errors

__all__ = ["plot_errors"]
