"""Thermal errors of a machine tool from balls on its table that it probes itself while it warms up (Yang et al.).

``method`` is the plugin, ``acquisition`` the measurement, ``simulation`` its replacement by the virtual machine. In
``identification``: ``reading`` reads the raw dataset, ``rigid`` determines the motion of every probing cycle in one
least-squares problem (solved by ``chain``), ``moved`` detects balls that moved and outliers among the touches,
``spheres`` and ``normals`` compute centres, planes and the published construction, ``bound`` is the Cramer-Rao bound,
and ``identify`` combines them.
"""

from errormotion.methods.normal_vector.method import NormalVector
from errormotion.methods.normal_vector.settings import Ball, Event, NormalVectorSettings

__all__ = ["Ball", "Event", "NormalVector", "NormalVectorSettings"]
