"""Scans along the crossbeam of the virtual gantry: raw data without any wire, and the truth behind them."""

from __future__ import annotations

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike

from errormotion.arrays import Array
from errormotion.errors import BenchError
from errormotion.twin import crossbeam as crossbeams
from errormotion.twin import truth
from errormotion.twin.artefacts import Artefact, circular_pocket, swept
from errormotion.twin.profiler import Profiler


class CrossbeamMeasurements:
    """What a line profiler in the spindle of the gantry can measure."""

    kind: str
    name: str
    seed: int
    crossbeam: crossbeams.Crossbeam

    def _origin(self) -> truth.Origin:
        raise NotImplementedError

    def truth_crossbeam(self, times: ArrayLike, positions: ArrayLike) -> xr.Dataset:
        """Return the thermal errors of the gantry's Y axis as an error dataset over ``time`` and ``position``.

        The axis goes to and fro without end from time 0 on. The errors are those of the carriage at its own origin,
        relative to the cold state.

        Parameters
        ----------
        times : (n,)
            s, increasing.
        positions : (m,)
            Of the axis, m.

        Raises
        ------
        BenchError
            The machine has no crossbeam.
        """
        self._need_crossbeam()
        t, y = _times(times), _times(positions)
        coords = {"time": t, "y": ("position", y, {"units": "m"})}
        twist = self.crossbeam.twist(t[:, None], y)
        where = ("time", "position"), coords, "Y", np.zeros(3), "cold state at time 0", self._origin()
        return truth.dataset(twist, *where, frame="carriage")

    def _need_crossbeam(self) -> None:
        if self.kind != "gantry":
            raise BenchError(f"Only the virtual machine 'gantry' has a crossbeam; this one is '{self.kind}'.")

    def raw_crossbeam_scan(
        self,
        times: ArrayLike,
        positions: ArrayLike,
        *,
        seed: int,
        artefact: Artefact | None = None,
        profiler: Profiler | None = None,
        profiles: int = 800,
        feed: float = 70e-6,
        motion: str = "axis",
        pose: ArrayLike | None = None,
    ) -> xr.Dataset:
        """Return a raw dataset of scans of artefacts along the crossbeam.

        Parameters
        ----------
        times : (cycle,)
            When each cycle is scanned, s; the first is the cold one and the reference. A cycle takes no time.
        positions : (artefact,)
            Of the Y axis over the middle of each artefact, m.
        seed : int
            Of noise and sampling phase alone; machine and artefacts stay as they are.
        artefact : Artefact, optional
            What stands at every position, a little crooked; the swept free form where not given.
        profiler : Profiler, optional
            LJ-X8000A with all its disturbances where not given.
        profiles : int
            Lines of a scan.
        feed : float
            Distance of two lines, m.
        motion : {"axis", "rigid"}
            Whether the carriage has at each line the error that the axis has there, as in truth, or all along the
            scan moves as one rigid body by the error at its middle, which a registration can find exactly.
        pose : (4, 4), optional
            Profiler pose that the dataset states; the true one where not given.

        Returns
        -------
        Dataset
            Heights as float32.

        Raises
        ------
        BenchError
            The machine has no crossbeam, a position is out of travel, or ``motion`` is none of those.
        """
        self._need_crossbeam()
        scans = crossbeams.Scans(artefact or swept(), profiler or Profiler(), profiles, feed, motion)
        labels = {"machine": self.name, "instruments": crossbeams.instrument_note(self.seed)}
        return self.crossbeam.raw(_times(times), _times(positions), scans, (self.seed, seed), pose, labels)

    def raw_pocket_scan(
        self,
        *,
        seed: int,
        lifts: ArrayLike = (0.166, 0.182),
        profiler: Profiler | None = None,
        profiles: int = 400,
        feed: float = 70e-6,
    ) -> xr.Dataset:
        """Return a raw dataset of scans of a circular pocket that the cold gantry has cut: for the profiler's pose.

        Parameters
        ----------
        seed : int
            Of the noise alone.
        lifts : (scan,)
            How far the spindle is lifted from where it was when the pocket was cut, m.
        profiler : Profiler, optional
            LJ-X8000A with all its disturbances where not given.
        profiles : int
            Lines of a scan.
        feed : float
            Distance of two lines, m.
        """
        self._need_crossbeam()
        profiler, pocket = profiler or Profiler(), circular_pocket()
        along = np.asarray((np.arange(profiles) - (profiles - 1) / 2) * feed, dtype=float)
        scans = self.crossbeam.pocket_scans(pocket, profiler, along, _times(lifts), (self.seed, seed))
        labels = {"machine": self.name, "instruments": crossbeams.instrument_note(self.seed)}
        return crossbeams.pocket_dataset(profiler.x, *scans, float(pocket.parameters[2]), labels)


def _times(t: ArrayLike) -> Array:
    return np.atleast_1d(np.asarray(t, dtype=float))
