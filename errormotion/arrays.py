"""The type of the arrays that the package computes with."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
"""Array of float64; its shape and unit stand in the docstring of the function that takes it."""
