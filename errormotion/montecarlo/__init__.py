"""Propagation of distributions by the Monte Carlo method (JCGM 101), for models and for methods."""

from errormotion.montecarlo.adaptive import Summary, numerical_tolerance, propagate
from errormotion.montecarlo.evaluation import evaluate
from errormotion.montecarlo.validation import Validation, validate_linear

__all__ = ["Summary", "Validation", "evaluate", "numerical_tolerance", "propagate", "validate_linear"]
