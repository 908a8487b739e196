"""An MTConnect agent of the virtual machine, after the public standard and the documents of the reference agent.

The agent answers ``/probe``, ``/current``, ``/sample`` and ``/asset`` over HTTP, with the grammar of agents of one
schema version: it refuses the paths and parameters that these refuse, with the error document of this version.

Parameters of the address in addition to those of every simulated device:

* ``style``: the device document. ``own`` (the default), ``okuma`` (each reading in two coordinate systems, numbered
axes, the agent as a second device), ``mazak`` (several spindles, extensions, data sets), ``vmc`` (an agent of
  schema 1.3: ``SpindleSpeed``, ``PathFeedrate`` in percent, names and sources)
* ``version``: the schema version, 1.3 to 2.7; default by style
* ``buffer``: number of stored observations, 1024
* ``series=1``: adds observations with several values (``TIME_SERIES``), a data set and a table
* ``next=0``: ``/current`` has no ``nextSequence``
* ``offset``: work offset of the controller, ``x,y,z`` in mm; default by style
* ``multipart``: ``x-mixed-replace`` or ``mixed``, the type of the stream; default by style
"""

from errormotion.instruments.simulators.controller.mtconnect.agent import SimulatedAgent

__all__ = ["SimulatedAgent"]
