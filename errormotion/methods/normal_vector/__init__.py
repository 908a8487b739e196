"""How a machine tool moves wrongly while it warms up, from balls on its table that it touches itself (Yang et al.).

``method`` is the plugin. From touches to result: ``reading`` takes them out of the raw dataset, ``rigid`` finds the
motion of every probing cycle in one least-squares problem (``chain`` solves it), ``moved`` finds balls that moved and
touches that are wrong, ``spheres`` and ``normals`` make centres, planes and the published construction of them,
``bound`` says how good any estimate can be, and ``identification`` puts them together.
"""

from errormotion.methods.normal_vector.method import NormalVector
from errormotion.methods.normal_vector.settings import Ball, Event, Settings

__all__ = ["Ball", "Event", "NormalVector", "Settings"]
