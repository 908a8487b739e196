"""Compiled loops for large campaigns, where they save more time than it takes to compile them.

Threads share the rows of blocks, and every row is computed within one thread: the result has the same bits on any
number of threads. ``reduction`` and ``comparison`` do the same by array operations; both differ by rounding only.
"""

from errormotion.compiling import Compiler

MANY = 10000
"""Points or blocks beyond which several threads share them."""

# Sums may be taken in any order (so that they vectorise), but NaN stays NaN.
FAST = {"reassoc", "contract", "nsz", "arcp"}

compiled = Compiler("the registration of scans", seconds=4, error_model="numpy")
