"""Effect of moving stations only in Z and of distributing them in X and Y, for different known quantities.

``python -m benchmarks.multilateration_heights``

40 targets in a cube of 100 mm, noise 1 um; standard uncertainty of a target, three coordinates together, mean over the
targets, um, and the factor by which it is smaller than with the stations close together. Three stations are close
together in front of the cube, or are moved; if four are needed, a fourth is above it in all cases.
"""

from __future__ import annotations

import numpy as np

from errormotion.methods.multilateration.networks import bound
from errormotion.methods.multilateration.start import directions

NOISE = 1e-6
OVERHEAD = (0.05, 0.05, 0.45)
# By the description of the paper: A B C close together in front of the cube, D E F the same at other heights, G and H
# on both sides of the cube. a b c are closer together, and move up or down independently.
PLACES = {
    "A": (-0.12, -0.40, -0.15), "B": (0.10, -0.42, -0.15), "C": (0.0, -0.38, -0.20), "D": (-0.12, -0.40, 0.15),
    "E": (0.10, -0.42, 0.15), "F": (0.0, -0.38, 0.20), "G": (0.30, 0.05, 0.30), "H": (-0.30, 0.10, 0.20),
    "a": (-0.3, -0.1, 0.0), "b": (-0.3, 0.0, 0.1), "c": (-0.3, 0.1, 0.0), "d": (-0.3, -0.1, -0.2),
    "e": (-0.3, 0.0, 0.35), "f": (-0.3, 0.1, -0.2), "g": (0.2, -0.3, 0.1), "h": (0.2, 0.3, 0.0),
}  # fmt: skip
LAYOUTS = (
    {"together": "ABC", "all lifted": "DEF", "one lifted": "ABF", "spread": "AGH", "both": "EGH"},
    {"together": "abc", "up and down": "def", "one lifted": "aec", "spread": "agh", "both": "egf"},
)


def targets() -> np.ndarray:
    """Return 40 targets drawn in the cube."""
    return np.random.default_rng(2).uniform(-0.05, 0.05, (40, 3))


def known(u: np.ndarray, U: np.ndarray) -> np.ndarray:
    """Return the uncertainty (m,) of targets, m, from known stations, when displacements count from the first target.

    Its position is known, and its noise is in all readings of a station.
    """
    e = directions(u, U).transpose(1, 0, 2)
    inverse = np.linalg.pinv(e)
    return NOISE * np.sqrt(2 * np.trace(inverse @ inverse.transpose(0, 2, 1), axis1=1, axis2=2))


def free(u: np.ndarray, U: np.ndarray) -> np.ndarray:
    """Return the uncertainty (m,) of targets, m, with unknown positions and dead paths of the stations."""
    return bound(u, U, noise=NOISE).uncertainty


def main() -> None:
    """Print the tables."""
    u = targets()
    rows = {
        "three stations known, relative (the paper's)": lambda U: known(u, U),
        "four stations known, relative": lambda U: known(u, np.vstack([U, OVERHEAD])),
        "four stations, places and dead paths free": lambda U: free(u, np.vstack([U, OVERHEAD])),
    }
    for layouts in LAYOUTS:
        print(f"{'':46}" + "".join(f"{f'{name} ({letters})':>22}" for name, letters in layouts.items()))
        places = [np.array([PLACES[letter] for letter in letters]) for letters in layouts.values()]
        for name, worth in rows.items():
            means = [1e6 * float(np.mean(worth(U))) for U in places]
            print(f"{name:46}" + "".join(f"{value:>11.1f} ({means[0] / value:>5.1f} x)" for value in means))


if __name__ == "__main__":
    main()
