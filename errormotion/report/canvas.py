"""Drawings of the page: common style, curves reduced to the visible resolution, and SVG for HTML."""

from __future__ import annotations

import io
import re
import warnings
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any
from xml.etree import ElementTree

import matplotlib
import numpy as np
from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from errormotion.report.marks import Marks, marks, name_parts, state_uncertainty
from errormotion.report.text import laid_out, typographic

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
    "axes.titley": 1.0,
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
        _translate_legends(figure)
        _spread_ticks(figure)
        _fix_places(figure)
        name_parts(figure)
        buffer = io.StringIO()
        figure.savefig(buffer, format="svg", metadata={"Date": None, "Creator": None})
        found = marks(figure)
    return inline(buffer.getvalue(), key, found)


def _translate_legends(figure: Figure) -> None:
    legends = [*figure.legends, *(axes.get_legend() for axes in figure.axes)]
    for text in [text for legend in legends if legend is not None for text in legend.get_texts()]:
        text.set_text(laid_out(text.get_text()))


def _spread_ticks(figure: Figure) -> None:
    """Use fewer ticks if the numbers of an abscissa would overlap."""
    for axes in figure.axes:
        if not isinstance(axes.xaxis.get_major_locator(), MaxNLocator) or axes.get_xscale() != "linear":
            continue
        points = 72 * figure.get_figwidth() * axes.get_position().width
        low, high = sorted(axes.get_xlim())
        for most in (8, 6, 5, 4, 3, 2):
            ticks = [each for each in axes.xaxis.get_major_locator()() if low <= each <= high]
            texts = axes.xaxis.get_major_formatter().format_ticks(ticks)
            room = points * float(np.diff(ticks).min()) / (high - low) if len(ticks) > 1 else points
            if len(ticks) < 2 or _LETTER * max(map(len, texts)) + 4.0 <= room:
                break
            axes.xaxis.set_major_locator(MaxNLocator(most, steps=[1, 2, 2.5, 5, 10]))


_LETTER = 4.6
"""Width of a digit of a tick, points."""


def _fix_places(figure: Figure) -> None:
    """Fix the places of titles and empty labels: matplotlib would lay out all ticks again to find places for them."""
    for axes in figure.axes:
        if axes.get_title(loc="left"):
            axes.yaxis.set_offset_position("right")  # a power of ten is not written into the title
        for axis in (axes.xaxis, axes.yaxis):
            if not axis.get_label_text():
                axis.set_label_coords(0.0, 0.0)


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
    picks = _picks(values, bins)
    return (time, values) if picks is None else (time[picks], values[picks])


def _picks(values: np.ndarray, bins: int) -> np.ndarray | None:
    """Return the indices of the points of a curve that are drawn; None for all."""
    if values.size <= 2 * bins:
        return None
    bin_of = np.arange(bins).repeat([part.size for part in np.array_split(values, bins)])
    starts = np.flatnonzero(np.diff(bin_of, prepend=-1))
    known = np.isfinite(values)
    lowest = np.minimum.reduceat(np.where(known, values, np.inf), starts)
    highest = np.maximum.reduceat(np.where(known, values, -np.inf), starts)
    found = [starts[np.isinf(lowest)]]
    for extreme in (lowest, highest):
        places = np.flatnonzero(known & (values == extreme[bin_of]))
        found.append(places[np.unique(bin_of[places], return_index=True)[1]])
    return np.unique(np.concatenate(found))


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
    name: str = "",
    bins: int = 450,
) -> None:
    """Draw one curve, with a band if an expanded uncertainty is given; ``name`` is shown with values in the page."""
    if expanded is not None and np.isfinite(expanded).any():
        t, low, high = envelope(time, values - expanded, values + expanded)
        axes.fill_between(t, low, high, color=colour, alpha=0.22, linewidth=0)
    picks = _picks(values, bins)
    drawn = slice(None) if picks is None else picks
    label = name or "_curve"
    look = (0, dash) if dash else "-"
    (line,) = axes.plot(time[drawn], values[drawn], color=colour, linewidth=width, linestyle=look, label=label)
    if expanded is not None:
        state_uncertainty(line, np.asarray(expanded)[drawn])


def limit_lines(axes: Axes, limits: Sequence[tuple[str, float, float]]) -> None:
    """Draw the limits of curves as dashed lines; those far from the curves are named in the corner instead.

    Parameters
    ----------
    limits : sequence of (name, lower, upper)
        In the unit of the ordinate; infinite = no limit. Draw the curves first.
    """
    low, high = axes.get_ylim()
    span = high - low
    named: dict[float, list[str]] = {}
    for name, *values in limits:
        for value in values:
            if np.isfinite(value):
                named.setdefault(value, []).append(name)
    near = {value: names for value, names in named.items() if low - span <= value <= high + span}
    for value, names in near.items():
        axes.axhline(value, color=BLACK, linewidth=0.8, linestyle=(0, (6, 2)))
        axes.annotate(
            f"limit of {', '.join(names)}", (0.0, value), xycoords=("axes fraction", "data"), xytext=(3, 2),
            textcoords="offset points", fontsize=6.5, color=BLACK,
        )  # fmt: skip
    if near:
        axes.set_ylim(min(low, min(near) - 0.06 * span), max(high, max(near) + 0.12 * span))
    far = [f"{', '.join(names)} {typographic(f'{value:.4g}')}" for value, names in named.items() if value not in near]
    if far:
        text = f"limits outside of the graph: {'; '.join(far)}"
        axes.annotate(
            text, (1.0, 1.0), xycoords="axes fraction", xytext=(0, 3), textcoords="offset points", ha="right",
            fontsize=6.5, color=BLACK,
        )  # fmt: skip


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


def inline(svg: str, key: str, named: Marks | None = None) -> Markup:
    """Return an SVG file as an element for HTML: no namespaces, metadata, style sheet, font families or unused ids.

    ``named`` are attributes of elements by their identifiers, for the script of the page.
    """
    root = ElementTree.fromstring(svg)
    for element in root.iter():
        element.tag = element.tag.rpartition("}")[2]
        element.attrib = {name.rpartition("}")[2]: value for name, value in element.attrib.items()}
    for parent in list(root.iter()):
        for child in [child for child in parent if child.tag in ("metadata", "style")]:
            parent.remove(child)
    _resolve(root)
    wanted = set(_REFERENCE.findall("\n".join(value for each in root.iter() for value in each.attrib.values())))
    for element in root.iter():
        attributes = element.attrib
        if "id" in attributes:
            name = attributes.pop("id")
            attributes.update((named or {}).get(name, {}))
            if tick := re.fullmatch(r"([xy])tick_\d+", name):
                attributes["class"] = f"tick {tick[1]}"
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


def _resolve(root: ElementTree.Element) -> None:
    """Replace the use of an area, which matplotlib defines once and uses once, by its definition."""
    uses = Counter(each.attrib.get("href") for each in root.iter())
    defined = {each.attrib["id"]: each for each in root.iter("path") if "id" in each.attrib}
    for parent in list(root.iter()):
        for i, child in enumerate(list(parent)):
            name = child.attrib.get("href", "").lstrip("#")
            if child.tag != "use" or name not in defined or float(child.attrib.get("x", 1)) != 0:
                continue
            if uses[f"#{name}"] == 1:
                d = _lowered(defined[name].attrib["d"], float(child.attrib.get("y", 0)))
                style = f"{defined[name].attrib.get('style', '')}; {child.attrib.get('style', '')}".strip("; ")
                parent[i] = ElementTree.Element("path", {"d": d, "style": style})
                defined.pop(name).attrib.pop("id")
    for parent in list(root.iter("defs")):
        for child in [child for child in parent if child.tag == "path" and "id" not in child.attrib]:
            parent.remove(child)


def _lowered(path: str, down: float) -> str:
    """Return path data moved down: every second number is an ordinate."""
    tokens = path.split()
    for k in [k for k, each in enumerate(tokens) if not each.isalpha()][1::2]:
        tokens[k] = f"{float(tokens[k]) + down:.6f}"
    return " ".join(tokens)


_REFERENCE = re.compile(r"(?:^|url\()#([^)\n]+)", re.MULTILINE)


def _short(path: str) -> str:
    """Return path data with a resolution of 0.01 points."""
    tokens = path.split()
    places = [k for k, each in enumerate(tokens) if "." in each]
    # all at once, since a long curve has thousands
    rounded = "%.2f " * len(places) % tuple([float(tokens[k]) for k in places])
    for k, each in zip(places, rounded.split(), strict=True):
        tokens[k] = each.rstrip("0").rstrip(".")
    return " ".join(tokens)


def _font(text: str) -> str:
    """Return a style without font family, which is that of the page."""
    return re.sub(r"font-family: [^;]*;? ?", "", text)
