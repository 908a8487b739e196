"""Names of the groups of sources of uncertainty, with their meaning: one name for one meaning in all methods.

Stored results may have names of earlier versions, which `present` replaces. A method of another distribution may have
groups of its own.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from errormotion import plugins
from errormotion.errors import PluginError

if TYPE_CHECKING:
    import xarray as xr

GROUPS = {
    "alignment": "angle between the measured line and the axis",
    "asynchronous motion and noise": "scatter of the mean over turns of a spindle, by all that is not synchronous",
    "axis average line": "position and direction of the axis average line, to which the errors refer",
    "bar radius": "radius of the bar in the spindle",
    "beam calibration": "calibrated origins and directions of the beams of point sensors",
    "calibration of the bar": "calibrated length of a ballbar",
    "centre of the circle": "position of the fitted centre of a circular path",
    "coefficients": "coefficients of a thermal model",
    "cold reference": "readings in the reference state, from which all errors are changes",
    "cold scan": "scan of an artefact in the reference state",
    "drift": "motion of the stations of a tracker during the measurement",
    "drift from run to run": "motion between the instrument and the axis from one run to the next",
    "drift of the bar": "change of the length of a ballbar during the measurement",
    "eccentricity": "position of an artefact in the spindle, which is removed from the motion",
    "ends of the reference line": "readings at the ends of the line to which straightness refers",
    "errors of the axes": "errors of the axes from which the errors in a volume are computed",
    "expansion coefficient of the bar": "coefficient of expansion of a ballbar",
    "expansion of the artefacts": "coefficients of expansion and temperatures of artefacts on the table",
    "expansion of the mount": "motion of a profiler on its mount with the temperature",
    "form of the artefact": "deviations of an artefact in the spindle from a circle",
    "frame expansion": "coefficients of expansion of the frame that holds point sensors",
    "frame temperature": "temperature of the frame that holds point sensors",
    "gain of the instrument": "gain of the instrument that reads an error other than a length",
    "inclination calibration": "calibrated effect of the inclination of a surface on the reading of a sensor",
    "known points of the planes": "distances of planes from points whose positions are stated",
    "lever": "vector from the line of measurement to the functional point",
    "misfit": "errors that a thermal model does not represent",
    "nominal beams": "deviations of beams that were not calibrated from their nominal origins and directions",
    "offsets of spheres": "positions of spheres as set up, where they are unknown",
    "position of sensors": "positions of sensors along the axis of a spindle",
    "position of spheres": "stated positions of spheres",
    "profiler pose": "position and orientation of a line profiler on its carriage",
    "radius of the sphere": "radius of the sphere in the spindle",
    "readings": "noise of readings that several values share",
    "reference state": "readings in the reference state of errors that change with time",
    "refraction": "refractive index of the air: temperature, pressure, humidity, equation",
    "repeatability": "scatter of repeated approaches to one position",
    "rotation about the spindle axis": "rotation that readings of a bar in the spindle do not show",
    "run-out at rest": "run-out of the bar while the spindle does not turn",
    "scale of the lengths": "relative error of lengths of the reference instrument",
    "scale of the profiler": "relative error of the heights and lengths of a line profiler",
    "scale of the sensor": "relative error of the readings of a point sensor",
    "scale of the tracker": "relative error of the lengths of a tracker, without refraction",
    "scales": "scales of the machine and of what is compared with them: coefficients of expansion, temperatures",
    "scales of the positions": "relative errors of commanded positions",
    "scales of the stage": "relative errors of the positions of a stage",
    "sensor direction": "directions of the sensors",
    "sensor gain": "relative errors of the readings of sensors",
    "stations": "positions and zero points of the stations of a tracker",
    "targets": "targets that define the datum of a network, by the noise of their readings",
    "temperature of the bar": "temperature of a ballbar",
    "trend over the test": "change with time that the runs of a test have in common",
    "triangulation plane": "rotation of the triangulation plane of a point sensor about its beam",
    "unexplained scatter": "scatter of residuals beyond the stated noise",
    "zero of the nest": "position of the nest of a sensor head relative to the first sphere",
}
"""Meaning of each group."""
ALIASES = {
    "air": "refraction",
    "expansion": "scales",
    "points": "known points of the planes",
    "sensor": "scale of the sensor",
    "tracker": "scale of the tracker",
}
"""Names of earlier versions, and the present ones."""


def with_present_groups(dataset: xr.Dataset) -> xr.Dataset:
    """Return an error dataset whose groups of sources have their present names.

    Results of foreign methods keep theirs, which may be the same words.
    """
    if "source_group" not in dataset.coords:
        return dataset
    group = dataset["source_group"]
    names = [str(name) for name in group.values]
    if not set(names) & set(ALIASES) or not _of_this_package(str(dataset.attrs.get("method", ""))):
        return dataset
    return dataset.assign_coords(source_group=(group.dims, [present(name) for name in names], group.attrs))


def _of_this_package(method: str) -> bool:
    try:
        module = str(plugins.get("methods", method).__module__)
    except PluginError:
        return False
    return module.partition(".")[0] == __name__.partition(".")[0]


def present(name: str) -> str:
    """Return the present name of a group."""
    return ALIASES.get(name, name)
