"""A line profiler in the spindle: its properties, its disturbances, and its profiles."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from errormotion.arrays import Array
from errormotion.errors import BenchError
from errormotion.twin import kernels
from errormotion.twin.artefacts import surfaces
from errormotion.twin.artefacts.pieces import Artefact

_JITTER_Y, _BLOBS, _STREAMS = 1, 2, 10


@dataclass(frozen=True)
class Disturbances:
    """Disturbances of the heights of a real profiler; zero disables a part, infinity the limit of the slope.

    Attributes
    ----------
    noise : float
        White, standard deviation, m.
    jitter_z, jitter_y : float
        Of each line in height and along the feed, standard deviation, m.
    speckle, speckle_points : float
        Standard deviation, m, and number of points over which its correlation falls to 1/e.
    steepest : float
        Slope above which there is no reading, 1.
    edge_lift, edge_reach, edge_loss : float
        Stray light at edges: a lift, m, half of it random, which decreases within the reach, m; in the third of the
        reach next to the edge, this share of the points is lost.
    outliers, outlier_spread : float
        Ambient light: share of outliers, and their standard deviation, m.
    missing : float
        Share of points without a reading.
    blobs, blob_radius : float
        Patches without readings in each scan, and their mean radius, m.
    """

    noise: float = 0.5e-6
    jitter_z: float = 0.5e-6
    jitter_y: float = 2e-6
    speckle: float = 0.4e-6
    speckle_points: float = 3.0
    steepest: float = 1.2
    edge_lift: float = 30e-6
    edge_reach: float = 150e-6
    edge_loss: float = 0.3
    outliers: float = 1e-3
    outlier_spread: float = 0.5e-3
    missing: float = 1e-3
    blobs: int = 0
    blob_radius: float = 0.5e-3

    @classmethod
    def none(cls) -> Disturbances:
        """Return a perfect sensor."""
        return cls.white(0.0)

    @classmethod
    def white(cls, noise: float = 0.5e-6) -> Disturbances:
        """Return a sensor with white noise (m) only."""
        off = dict.fromkeys(("jitter_z", "jitter_y", "speckle", "edge_lift", "edge_reach", "edge_loss"), 0.0)
        return cls(noise=noise, steepest=np.inf, outliers=0.0, missing=0.0, blobs=0, **off)

    def sizes(self) -> Array:
        """Return the values for the compiled loop, shape (11,)."""
        keep = np.exp(-1 / self.speckle_points) if self.speckle_points > 0 else 0.0
        edge = (self.edge_lift, self.edge_reach, self.edge_loss)
        light = (self.outliers, self.outlier_spread, self.missing)
        return np.array([self.noise, self.jitter_z, self.speckle, keep, self.steepest, *edge, *light])


@dataclass(frozen=True)
class Profiler:
    """A line profiler: it measures z at positions x in its frame, in the plane y = 0.

    Attributes
    ----------
    points : int
        Number of points of a profile.
    pitch : float
        m; point i is at x = (i - points // 2) * pitch.
    low, high : float
        Measuring range in z, m.
    disturbances : Disturbances
        Of the heights.
    """

    points: int = 3200
    pitch: float = 12.5e-6
    low: float = -20.5e-3
    high: float = 20.5e-3
    disturbances: Disturbances = field(default_factory=Disturbances)

    @property
    def x(self) -> Array:
        """Positions of the points along the profile, m, shape (point,)."""
        return np.asarray((np.arange(self.points) - self.points // 2) * self.pitch, dtype=float)

    def scan(self, artefact: Artefact, poses: Array, *, key: tuple[int, ...] = (0,)) -> Array:
        """Return the profiles of an artefact.

        Parameters
        ----------
        artefact : Artefact
            The piece.
        poses : ndarray, (line, 4, 4)
            From the profiler's frame at each line to the artefact's; m. Jitter along the feed shifts a line in the
            direction from the previous line to the next one.
        key : tuple of int
            Key of the random streams, which depend on it only.

        Returns
        -------
        ndarray, (line, point)
            z in the profiler's frame, m; NaN = no reading.
        """
        if poses.ndim != 3 or poses.shape[1:] != (4, 4) or len(poses) < 2:
            raise BenchError(
                f"expected poses of shape (line, 4, 4) with at least two lines; found {poses.shape}",
                code="virtual.poses.shape",
            )
        wrong = self.disturbances
        poses = np.ascontiguousarray(poses, dtype=float)
        if wrong.jitter_y > 0:
            along = np.gradient(poses[:, :3, 3], axis=0)
            along /= np.linalg.norm(along, axis=1, keepdims=True)
            shift = wrong.jitter_y * kernels.normals(kernels.stream_key(*key, _JITTER_Y), 0, len(poses))
            poses = poses.copy()
            poses[:, :3, 3] += shift[:, None] * along
        out = np.empty((len(poses), self.points))
        keys = np.array([kernels.stream_key(*key, _STREAMS + stream) for stream in range(6)])
        surfaces.scan(
            artefact.shape,
            artefact.parameters,
            artefact.table,
            poses,
            self.x,
            out,
            wrong.sizes(),
            self.low,
            self.high,
            keys,
        )
        self._cut_blobs(out, poses, kernels.stream_key(*key, _BLOBS))
        return out

    def _cut_blobs(self, out: Array, poses: Array, key: np.uint64) -> None:
        """Remove the readings in round patches."""
        lines, x = len(out), self.x
        pitch = float(np.linalg.norm(poses[-1, :3, 3] - poses[0, :3, 3])) / (lines - 1)
        rng = np.random.default_rng(int(key))
        for _ in range(self.disturbances.blobs):
            line, centre = rng.uniform(0, lines), rng.uniform(x[0], x[-1])
            radius = self.disturbances.blob_radius * rng.uniform(0.5, 1.5)
            near = np.abs(np.arange(lines) - line) * pitch < radius
            gap = ((np.arange(lines)[near, None] - line) * pitch) ** 2 + (x - centre) ** 2 < radius**2
            out[near] = np.where(gap, np.nan, out[near])
