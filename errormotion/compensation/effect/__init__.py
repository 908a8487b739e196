"""Effect of a compensation: two results of one machine compared, before and after.

``effect(before, after)`` returns an `Effect`: the reduction of each freedom and of each figure of merit with its
interval of 95 %, what a perfect model would have left, and decisions on limits. Derivation:
docs/explanation/compensation-effect.md.
"""

from errormotion.compensation.effect.analysis import DISPLACEMENT, effect
from errormotion.compensation.effect.result import Effect, FigurePair, Part

__all__ = ["DISPLACEMENT", "Effect", "FigurePair", "Part", "effect"]
