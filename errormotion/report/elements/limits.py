"""Figures of merit that have a limit, as a share of it."""

from __future__ import annotations

import math
from dataclasses import dataclass

from matplotlib.figure import Figure as Canvas

from errormotion.report import canvas
from errormotion.report.document import Block, Figure, Source
from errormotion.report.elements.figures import Names, chosen, limit_of
from errormotion.report.text import fixed

_BAR = 0.32
"""Height of one bar with its distance, inch."""


@dataclass(frozen=True)
class AgainstLimits:
    """Bars of the figures of merit that have a limit, in per cent of it, with their expanded uncertainty.

    Attributes
    ----------
    caption : str
    names : sequence of str or callable
        As in `KeyFigures`.
    """

    caption: str = (
        "Figures as a share of their limits, with U. Green: within the limit; red: above it; ochre: the limit is "
        "within the uncertainty (ISO 14253-1)."
    )
    names: Names = ()

    def blocks(self, source: Source, key: str) -> list[Block]:
        """Return the drawing; nothing without limits."""
        limits = [(each, limit_of(source, each)) for each in chosen(source, self.names)]
        bars = [
            (each.name, 100 * abs(each.value) / limit, 100 * each.expanded_uncertainty / limit)
            for each, limit in limits
            if math.isfinite(limit) and limit > 0
        ]
        if not bars:
            return []
        left = 0.2 + 0.068 * max(len(name) for name, _, _ in bars)
        high = _BAR * len(bars) + 0.1

        def paint(figure: Canvas) -> None:
            wide, tall = figure.get_size_inches()
            place = (left / wide, canvas.BOTTOM / tall, (wide - left - canvas.RIGHT) / wide, high / tall)
            axes = figure.add_axes(place)
            for row, (_, share, U) in enumerate(bars):
                colour = canvas.GREEN if share + U <= 100 else canvas.VERMILLION if share - U > 100 else canvas.ORANGE
                axes.barh(row, share, height=0.55, color=colour, alpha=0.75)
                axes.errorbar(share, row, xerr=U, color=canvas.BLACK, capsize=3, linewidth=1)
            axes.axvline(100, color=canvas.BLACK, linewidth=1.2)
            axes.set_yticks(range(len(bars)), [name for name, _, _ in bars])
            axes.set_ylim(len(bars) - 0.5, -0.5)
            axes.set_xlim(left=0)
            axes.grid(visible=False, axis="y")
            axes.set_xlabel("share of the limit / %")

        shown = ", ".join(f"{name} {fixed(share, 0)} %" for name, share, _ in bars)
        return [Figure(canvas.draw(paint, key, high + canvas.TOP + canvas.BOTTOM), self.caption, f"{shown}.")]
