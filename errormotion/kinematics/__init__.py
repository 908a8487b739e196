"""Rigid bodies and machines: arrays in, arrays out.

==============  ====================================================================================
module          what it holds
==============  ====================================================================================
``twists``      small errors as twists; functional points, frames, covariance
``poses``       twists and exact poses (scipy's ``RigidTransform``)
``iso``         the six freedoms and their names in ISO 230-1
``axes``        linear and rotary axes with their error motions
``machines``    chains such as ``workpiece-X-Y-bed-Z-spindle-tool``, forward model and Jacobian
``fits``        geometric least squares: line, plane, circle, sphere, cylinder, cone
==============  ====================================================================================

A module is imported when it is first used.
"""

from importlib import import_module
from types import ModuleType

__all__ = ["axes", "fits", "iso", "machines", "poses", "twists"]


def __getattr__(name: str) -> ModuleType:
    if name in __all__:
        return import_module(f"{__name__}.{name}")
    raise AttributeError(f"module '{__name__}' has no attribute '{name}'")
