"""Rigid bodies and machines: arrays in, arrays out.

===============  ===================================================================================
module           content
===============  ===================================================================================
``twists``       small errors as twists; functional points, frames, covariance
``poses``        twists and exact poses (scipy's ``RigidTransform``)
``iso``          the six freedoms and their names in ISO 230-1
``axes``         linear and rotary axes with their error motions
``chains``       the text of a chain, such as ``workpiece-X-Y-bed-Z-spindle-tool``
``machines``     machines of any chain: forward model and Jacobian
``volumes``      errors of the axes from errors of the tool in the volume
``description``  one machine tool: chain, travel, spindle axis, rotary axes
``beams``        directions of beams and inclinations of surfaces
``fits``         geometric least squares: line, plane, circle, sphere, cylinder, cone
===============  ===================================================================================

A module is imported when it is first used.
"""

from importlib import import_module
from types import ModuleType

__all__ = ["axes", "beams", "chains", "description", "fits", "iso", "machines", "poses", "twists", "volumes"]


def __getattr__(name: str) -> ModuleType:
    if name in __all__:
        return import_module(f"{__name__}.{name}")
    raise AttributeError(f"module '{__name__}' has no attribute '{name}'")
