"""Results of the analysis of a compensation."""

from __future__ import annotations

from dataclasses import dataclass

from errormotion.compare.comparable import ComparableErrors
from errormotion.compensation.effect.magnitude import Interval
from errormotion.tolerances.conformity import Conformity

REDUCED, WORSE, OPEN = "reduced", "larger", "not shown"


@dataclass(frozen=True)
class Part:
    """One freedom, or the displacement of the tool as a whole; m or rad.

    Attributes
    ----------
    name : str
        Freedom, or `analysis.DISPLACEMENT`.
    unit : str
        SI.
    before, after : Interval
        Root mean squares over the common points, the uncertainty of the measurement subtracted.
    reduction : Interval
        1 less their ratio.
    correctable : bool
        Whether linear axes can compensate it; False for rotations.
    floor : float
        Expected root mean square of AFTER without remaining errors: its measurement uncertainty.
    reference : float
        The part of ``floor`` due to the reference state, on which all values depend.
    """

    name: str
    unit: str
    before: Interval
    after: Interval
    reduction: Interval
    correctable: bool
    floor: float
    reference: float

    @property
    def perfect(self) -> float:
        """Expected root mean square of AFTER with a perfect model.

        ``floor`` for a displacement; BEFORE and ``floor`` together for a rotation.
        """
        left = 0.0 if self.correctable else self.before.value
        return float((left**2 + self.floor**2) ** 0.5)

    @property
    def outcome(self) -> str:
        """REDUCED or WORSE if the interval of the reduction excludes 0, else OPEN."""
        return REDUCED if self.reduction.low > 0 else WORSE if self.reduction.high < 0 else OPEN


@dataclass(frozen=True)
class FigurePair:
    """A figure of merit of both results; SI units, U with k = 2, NaN if a result does not have it."""

    name: str
    unit: str
    before: tuple[float, float]
    after: tuple[float, float]
    reduction: Interval


@dataclass(frozen=True)
class Effect:
    """Effect of a compensation.

    Attributes
    ----------
    parts : tuple of Part
        Each common freedom, then the displacement as a whole.
    figures : tuple of FigurePair
    common : ComparableErrors
        Both results, ``before`` and ``after``, at the same points.
    before, after, gained : Conformity or None
        Decisions on the limits: of both results, and on ``reduction of ...``.
    notes : tuple of str
    """

    parts: tuple[Part, ...]
    figures: tuple[FigurePair, ...]
    common: ComparableErrors
    before: Conformity | None
    after: Conformity | None
    gained: Conformity | None
    notes: tuple[str, ...]

    def part(self, name: str) -> Part:
        """Return one of the parts by its name."""
        return next(each for each in self.parts if each.name == name)
