"""Figures of error datasets, behind ``ds.em.plot()``: curves, lines, maps, and arrows in the volume."""

from errormotion.datasets.results.plotting.figure import plot_errors

__all__ = ["plot_errors"]
