"""Planted mistakes: rate of detection compared with the prediction, and rate of the correct cause."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import chi2, kstest, ncx2

from errormotion.compare import compare, explain
from errormotion.compare.comparable import comparable_errors
from errormotion.compare.diagnosis import SCORE_MARGIN
from errormotion.compare.pairs import pair as judged
from errormotion.compare.stack import difference
from errormotion.datasets.timing import later
from errormotion.estimation.low_rank import whitener
from errormotion.kinematics import twists
from validation.comparisons.drawn import Drawn, at
from validation.comparisons.pool import Pool

LEVEL, POWER = 0.05, 0.9
STEP_AT = 3600.0
DRAWS = 50
"""Draws of each machine without a mistake."""
ARCSEC = np.pi / 180 / 3600


@dataclass(frozen=True)
class Mistake:
    """A mistake in the second dataset: its effect by size, and the cause that should be reported.

    ``fixed`` mistakes have one size; the uncertainties of both datasets are scaled instead.
    """

    name: str
    cause: str
    apply: Callable[[Drawn, float], Drawn]
    size: float
    unit: tuple[float, str]
    fixed: bool = False


def _point(axis: int) -> Callable[[Drawn, float], Drawn]:
    return lambda b, size: replace(b, mapping=twists.adjoint(shift=size * np.eye(3)[axis]))


def _yaw(b: Drawn, size: float) -> Drawn:
    c, s = np.cos(size), np.sin(size)
    R = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    return replace(b, mapping=np.kron(np.eye(2), R))


def _scaled(columns: slice) -> Callable[[Drawn, float], Drawn]:
    def apply(b: Drawn, size: float) -> Drawn:
        factors = np.ones(6)
        factors[columns] = 1 + size
        return replace(b, mapping=np.diag(factors))

    return apply


def _moved(b: Drawn, size: float) -> Drawn:
    direction = np.array([0.6, 0.0, -0.8, 0, 0, 0])
    return replace(b, values=b.values + size * np.multiply.outer(b.time >= STEP_AT, direction))


def _expansion(b: Drawn, size: float) -> Drawn:
    change = b.temperature[:, 0] - b.temperature[0, 0]
    return replace(b, values=b.values + size * np.multiply.outer(change, [0, 0, 1.0, 0, 0, 0]))


MISTAKES = (
    Mistake("functional point off along X", "functional point", _point(0), 0.02, (1e3, "mm")),
    Mistake("functional point off along Z", "functional point", _point(2), 0.02, (1e3, "mm")),
    Mistake("yaw of the frame", "yaw of the frame (about Z)", _yaw, 1e-3, (1e3, "mrad"), fixed=True),
    Mistake("radius: displacements scaled", "scale of the displacements", _scaled(slice(0, 3)), 0.02, (1e2, "%")),
    Mistake("sign of EY", "sign of EY", _scaled(slice(1, 2)), -2.0, (1, ""), fixed=True),
    Mistake(
        "arcsec taken as urad",
        "unit of 'B': arcsec taken as urad",
        _scaled(slice(3, 6)),
        1e-6 / ARCSEC - 1,
        (1, ""),
        fixed=True,
    ),
    Mistake("shift in time", "shift in time", lambda b, s: replace(b, start=later(b.start, s)), 20.0, (1, "s")),
    Mistake("artefact moved at 3600 s", "step at 3600 s (something moved)", _moved, 3e-7, (1e6, "um")),
    Mistake("holder expands", "expansion with temperature frame of 'B'", _expansion, 3e-7, (1e6, "um/K")),
)


def pair(seed: int) -> tuple[Drawn, Drawn]:
    """Return two datasets of one warm-up: every minute with the radius of a bar, every 4 minutes with an expansion."""
    a, b = at(seed, 60.0, "A"), at(seed, 240.0, "B")
    a.temperature = a.temperature[:0]
    a.sources["radius"] = 0.002 * a.values * [1, 1, 1, 0, 0, 0]
    b.sources["expansion"] = 3e-8 * np.multiply.outer(b.temperature[:, 1] - b.temperature[0, 1], [0, 0, 1.0, 0, 0, 0])
    return a, b


def noncentrality(a: Drawn, b: Drawn) -> tuple[float, int]:
    """Return the non-centrality of the joint chi-square of two datasets without noise, and its degrees of freedom."""
    common = comparable_errors({"A": a.dataset(None), "B": b.dataset(None)})
    d = difference(*common.estimates)
    white = whitener(d.own, d.influence)
    return white.square(d.value), white.degrees


def power(squares: float, degrees: int) -> float:
    """Return the probability of detection."""
    return float(ncx2.sf(chi2.isf(LEVEL, degrees), degrees, squares))


def needed(degrees: int) -> float:
    """Return the non-centrality at which a joint chi-square has the required power."""
    low, high = 0.0, 1e4
    for _ in range(60):
        middle = (low + high) / 2
        low, high = (middle, high) if power(middle, degrees) < POWER else (low, middle)
    return (low + high) / 2


def planned(mistake: Mistake) -> tuple[float, float]:
    """Return the size, and the factor on all uncertainties, at which the test has the power on the first machine."""
    size, factor = mistake.size, 1.0
    for _ in range(8):
        a, b = (replace(each, factor=factor) for each in pair(0))
        found, degrees = noncentrality(a, mistake.apply(b, size))
        ratio = np.sqrt(needed(degrees) / found)
        size, factor = (size, factor / ratio) if mistake.fixed else (size * ratio, factor)
    return float(size), float(factor)


def margin(mistake: Mistake, size: float, factor: float) -> float:
    """Return the difference of the scores of the planted cause and of the next one, without noise.

    NaN if the planted cause is not named: a curve of the size of its noise is not significant without the noise.
    """
    a, b = (replace(each, factor=factor) for each in pair(0))
    sets = {"A": a.dataset(None), "B": mistake.apply(b, size).dataset(None)}
    common = comparable_errors(sets)
    causes = explain(*common.estimates, sets, common)
    planted = next((cause.score for cause in causes if _same(cause.name, mistake.cause)), float("nan"))
    return planted - max([0.0, *(cause.score for cause in causes if not _same(cause.name, mistake.cause))])


def one(task: tuple[int, int, float, float]) -> dict:
    """Return the result of a comparison for one machine with one mistake."""
    seed, number, size, factor = task
    a, b = (replace(each, factor=factor) for each in pair(seed))
    b = MISTAKES[number].apply(b, size)
    rng = np.random.default_rng([seed, number + 1])
    found = compare({"A": a.dataset(rng), "B": b.dataset(rng)})
    first = found.isel(pair=0, rank=0)
    sizes, u = first["size"].values, first["size_u"].values
    return {
        "p": found["p"].item(),
        "predicted": power(*noncentrality(a, b)),
        "cause": first["cause"].item(),
        "alike": [name for name in first["alike"].item().split("; ") if name],
        "sizes": sizes[np.isfinite(sizes)],
        "u": u[np.isfinite(sizes)],
        "names": [str(name) for name in first["size_name"].values if str(name)],
    }


def clean(seed: int) -> list[float]:
    """Return the joint p of draws of one machine without a mistake."""
    a, b = pair(seed)
    found = []
    for number in range(DRAWS):
        rng = np.random.default_rng([seed, len(MISTAKES) + 1, number])
        common = comparable_errors({"A": a.dataset(rng), "B": b.dataset(rng)})
        found.append(judged(*common.estimates).joint.p)
    return found


def section(seeds: int, pool: Pool) -> list[str]:
    """Return the lines of the section."""
    plans = [planned(mistake) for mistake in MISTAKES]
    margins = [margin(mistake, *plan) for mistake, plan in zip(MISTAKES, plans, strict=True)]
    alarms = np.ravel(pool.mapped(clean, range(2 * seeds)))
    rows = []
    for number, (mistake, (size, factor), ahead) in enumerate(zip(MISTAKES, plans, margins, strict=True)):
        runs = pool.mapped(one, [(seed, number, size, factor) for seed in range(seeds)])
        rows.append(_row(mistake, size, factor, ahead, runs))
    degrees = noncentrality(*pair(0))[1]
    spread = np.sqrt(LEVEL * (1 - LEVEL) / alarms.size)
    return [
        f"{seeds} virtual gantries warm up for two hours at 12000 /min. Two datasets of six freedoms are drawn from "
        "their own covariance about the true errors: A every minute, with the radius of a bar as a source of all "
        "values; B every 4 minutes, with an expansion; 0.1 um and 0.5 urad of noise. B has one mistake. The joint "
        f"chi-square has {degrees} degrees of freedom. With the effect d of the mistake and the covariance V its "
        f"non-centrality is d' V^-1 d; {needed(degrees):.1f} is detected with a probability of {POWER:.0%} at the "
        f"level {LEVEL:g}. Sizes are those of this power on the first machine; for a mistake without size, all "
        "uncertainties are multiplied by the factor instead. `margin`: difference of the scores (twice the logarithm "
        "of the likelihood ratio, minus the penalties) of the planted cause and of the next one, without noise; "
        f"below {SCORE_MARGIN:g} the two cannot be distinguished at this size. `right first`: of the detected "
        "mistakes, the planted cause has the first rank; `or alike`: it has, or the first one is reported as "
        "indistinguishable from it.",
        "",
        "| mistake | size | uncertainties | predicted power | detected | margin | right first | or alike | first "
        "instead | named as alike |",
        "|---|---|---|---|---|---|---|---|---|---|",
        *rows,
        "",
        f"Without a mistake {np.mean(alarms < LEVEL):.2%} of {alarms.size} comparisons ({DRAWS} draws of each of "
        f"{2 * seeds} machines) are alarms at the level {LEVEL:g} (standard deviation {spread:.2%}); p is uniform "
        f"(Kolmogorov-Smirnov {kstest(alarms, 'uniform').pvalue:.2g}). The test is exact for datasets with a correct "
        "covariance: its rate is the level, by construction.",
    ]


def _row(mistake: Mistake, size: float, factor: float, ahead: float, runs: list[dict]) -> str:
    hits = [run for run in runs if run["p"] < LEVEL]
    first = [run for run in hits if _same(run["cause"], mistake.cause)]
    named = [run for run in hits if any(_same(name, mistake.cause) for name in (run["cause"], *run["alike"]))]
    wrong = Counter(_short(run["cause"]) for run in hits if not _same(run["cause"], mistake.cause))
    alike = Counter(_short(name) for run in first for name in run["alike"])
    scale, unit = mistake.unit
    shown = f"{ahead:+.0f}" if np.isfinite(ahead) else "-"
    right, alike_too = len(first) / max(len(hits), 1), len(named) / max(len(hits), 1)
    return (
        f"| {mistake.name} | {f'{scale * size:.3g} {unit}' if unit else '-'} | {factor:.3g} | "
        f"{np.mean([run['predicted'] for run in runs]):.0%} | {len(hits) / len(runs):.0%} | {shown} | "
        f"{right:.0%} | {alike_too:.0%} | {_most(wrong)} | {_most(alike)} |"
    )


def _same(found: str, planted: str) -> bool:
    """Whether a cause is the planted one; a step may differ by one instant of the grid."""
    steps = [re.match(r"step at (\d+) s", name) for name in (found, planted)]
    if all(steps):
        return abs(int(steps[0][1]) - int(steps[1][1])) <= 240  # type: ignore[index]
    return found == planted


def _short(name: str) -> str:
    return re.sub(r"step at \d+ s.*", "a step", name)


def _most(names: Counter[str]) -> str:
    return "; ".join(f"{name} ({count})" for name, count in names.most_common(2)) or "-"
