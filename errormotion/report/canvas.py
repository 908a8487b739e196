"""Drawings of the page: common style, curves reduced to the visible resolution, and SVG for HTML."""

from __future__ import annotations

import io
import re
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any
from xml.etree import ElementTree

import matplotlib
import numpy as np
from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.figure import Figure

#: After Okabe and Ito, distinguishable with any colour vision; light colours are darkened so that text is legible.
BLUE, SKY, VERMILLION, ORANGE, GREEN, PURPLE, BLACK = (
    "#0072B2",
    "#3291C8",
    "#D55E00",
    "#B07800",
    "#009E73",
    "#B5558A",
    "#222222",
)
COLOURS = (BLUE, VERMILLION, GREEN, PURPLE, SKY, ORANGE, BLACK)
DASHES: tuple[tuple[float, ...] | None, ...] = (None, (5, 2), (1.5, 1.5), (6, 2, 1.5, 2))
WIDTH = 6.9  # inch: the text width of an A4 page
LEFT, RIGHT, TOP, BOTTOM, GAP = 0.52, 0.36, 0.24, 0.4, 0.26  # inch: margins around and between panels
_STYLE: Any = {
    "svg.fonttype": "none",
    "svg.hashsalt": "errormotion",
    "text.parse_math": False,
    "font.family": "DejaVu Sans",
    "font.size": 8,
    "axes.labelsize": 8,
    "axes.titlesize": 8.5,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.linewidth": 0.6,
    "axes.edgecolor": "#444444",
    "axes.labelcolor": "#222222",
    "xtick.labelsize": 7.5,
    "ytick.labelsize": 7.5,
    "axes.formatter.useoffset": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "#e4e4e4",
    "grid.linewidth": 0.5,
    "lines.linewidth": 1.1,
    "lines.solid_joinstyle": "round",
    "legend.frameon": False,
    "legend.fontsize": 7.5,
    "path.simplify": False,
    "figure.facecolor": "none",
    "axes.facecolor": "none",
}


@contextmanager
def style() -> Iterator[None]:
    """Apply the style of the report; special characters in names are shown unchanged."""
    with matplotlib.rc_context(_STYLE), warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Glyph .* missing", category=UserWarning)
        yield


def draw(paint: Callable[[Figure], None], key: str, height: float, width: float = WIDTH) -> Markup:
    """Return the SVG of a figure that ``paint`` fills; ``key`` makes its identifiers unique."""
    with style():
        figure = Figure(figsize=(width, height))
        paint(figure)
        buffer = io.StringIO()
        figure.savefig(buffer, format="svg", metadata={"Date": None, "Creator": None})
    return inline(buffer.getvalue(), key)


def stack(figure: Figure, heights: Sequence[float], right: float = RIGHT) -> list[Axes]:
    """Return stacked panels with one time axis at fixed positions, so that figures on a page are aligned.

    ``heights`` of the panels are in inches; the height of the figure is `stack_height`.
    """
    wide, high = figure.get_size_inches()
    made: list[Axes] = []
    top = high - TOP
    for height in heights:
        place = (LEFT / wide, (top - height) / high, (wide - LEFT - right) / wide, height / high)
        made.append(figure.add_axes(place, sharex=made[0] if made else None))
        top -= height + GAP
    for axes in made[:-1]:
        axes.tick_params(labelbottom=False)
    return made


def stack_height(heights: Sequence[float]) -> float:
    """Return the height of a figure with these panels, inches."""
    return TOP + sum(heights) + GAP * (len(heights) - 1) + BOTTOM


def decimate(time: np.ndarray, values: np.ndarray, bins: int = 450) -> tuple[np.ndarray, np.ndarray]:
    """Return (t, y) with at most two points for each bin, the lowest and the highest in chronological order.

    Parameters
    ----------
    time, values : ndarray, (n,)
        ``values`` may contain NaN; a bin of NaN alone gives one NaN, so that the gap is visible.
    """
    if values.size <= 2 * bins:
        return time, values
    t, y = [], []
    for part in np.array_split(np.arange(values.size), bins):
        known = part[np.isfinite(values[part])]
        if known.size == 0:
            picks = part[:1]
        else:
            picks = np.unique([known[np.argmin(values[known])], known[np.argmax(values[known])]])
        t.append(time[picks])
        y.append(values[picks])
    return np.concatenate(t), np.concatenate(y)


def envelope(
    time: np.ndarray, low: np.ndarray, high: np.ndarray, bins: int = 300
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return (t, lowest, highest) of a band in each bin; NaN in empty bins."""
    if time.size <= bins:
        return time, low, high
    parts = np.array_split(np.arange(time.size), bins)
    below, above = np.where(np.isnan(low), np.inf, low), np.where(np.isnan(high), -np.inf, high)
    lowest = np.array([below[part].min() for part in parts])
    highest = np.array([above[part].max() for part in parts])
    middle = np.array([time[part].mean() for part in parts])
    middle[0], middle[-1] = time[0], time[-1]
    return middle, np.where(np.isinf(lowest), np.nan, lowest), np.where(np.isinf(highest), np.nan, highest)


def curve(
    axes: Axes,
    time: np.ndarray,
    values: np.ndarray,
    expanded: np.ndarray | None = None,
    *,
    colour: str,
    dash: tuple[float, ...] | None = None,
    width: float = 1.1,
) -> None:
    """Draw one curve, with a band if an expanded uncertainty is given."""
    if expanded is not None and np.isfinite(expanded).any():
        t, low, high = envelope(time, values - expanded, values + expanded)
        axes.fill_between(t, low, high, color=colour, alpha=0.22, linewidth=0)
    t, y = decimate(time, values)
    axes.plot(t, y, color=colour, linewidth=width, linestyle=(0, dash) if dash else "-")


def label_ends(axes: Axes, ends: list[tuple[float, str, str]]) -> None:
    """Write the names of curves at their right ends without overlap.

    Parameters
    ----------
    ends : list of (y, name, colour)
        y in data units; NaN is set at the middle.
    """
    low, high = axes.get_ylim()
    bounds = axes.get_position().height * axes.figure.get_figheight() * 72  # type: ignore[union-attr]
    least = 9.5 / max(bounds, 1.0) * (high - low)
    placed: list[float] = []
    ordered = sorted(((y if np.isfinite(y) else (low + high) / 2), name, colour) for y, name, colour in ends)
    for y, _, _ in ordered:
        placed.append(max(y, placed[-1] + least) if placed else y)
    shift = (sum(placed) - sum(y for y, _, _ in ordered)) / max(len(placed), 1)
    for y, (_, name, colour) in zip(placed, ordered, strict=True):
        axes.annotate(
            name,
            (1.0, y - shift),
            xycoords=("axes fraction", "data"),
            xytext=(4, 0),
            textcoords="offset points",
            va="center",
            color=colour,
            fontweight="bold",
            annotation_clip=False,
        )


def inline(svg: str, key: str) -> Markup:
    """Return an SVG file as an element for HTML: no namespaces, metadata, style sheet, font families or unused ids."""
    root = ElementTree.fromstring(svg)
    for element in root.iter():
        element.tag = element.tag.rpartition("}")[2]
        element.attrib = {name.rpartition("}")[2]: value for name, value in element.attrib.items()}
    for parent in list(root.iter()):
        for child in [child for child in parent if child.tag in ("metadata", "style")]:
            parent.remove(child)
    text = ElementTree.tostring(root, encoding="unicode")
    wanted = set(re.findall(r"url\(#([^)]+)\)", text)) | set(re.findall(r'href="#([^"]+)"', text))
    for element in root.iter():
        attributes = element.attrib
        if "id" in attributes:
            name = attributes.pop("id")
            if name in wanted:
                attributes["id"] = f"{key}-{name}"
        if attributes.get("href", "").startswith("#"):
            attributes["href"] = f"#{key}-{attributes['href'].lstrip('#')}"
        if "d" in attributes:
            attributes["d"] = _short(attributes["d"])
        for name in ("clip-path", "style"):
            if name in attributes:
                attributes[name] = attributes[name].replace("url(#", f"url(#{key}-")
        if "style" in attributes:
            attributes["style"] = _font(attributes["style"])
    for name in ("width", "height", "version"):
        root.attrib.pop(name, None)
    root.set("aria-hidden", "true")
    return Markup(ElementTree.tostring(root, encoding="unicode"))


def _short(path: str) -> str:
    """Return path data with a resolution of 0.01 points."""
    numbers = re.sub(r"-?\d+\.\d+", lambda found: f"{float(found[0]):.2f}".rstrip("0").rstrip("."), path)
    return re.sub(r"\s+", " ", numbers).strip()


def _font(text: str) -> str:
    """Return a style without font family, which is that of the page."""
    return re.sub(r"font-family: [^;]*;? ?", "", text)
