"""An MTConnect agent on the virtual machine, made from the public standard and the documents of the reference agent.

The agent answers ``/probe``, ``/current``, ``/sample`` and ``/asset`` over HTTP, with the grammar of the agents of a
schema version: paths and parameters that an agent refuses are refused, with the error document of that version.

Parameters of the address beside those of every simulated device:

* ``style``: the device document. ``own`` (the default), ``okuma`` (two coordinate systems a reading, numbered axes,
  a second device that is the agent itself), ``mazak`` (several spindles, extensions, data sets), ``vmc`` (an agent of
  schema 1.3: ``SpindleSpeed``, ``PathFeedrate`` in percent, names and sources)
* ``version``: the schema version, 1.3 to 2.7; default by style
* ``buffer``: number of observations that are kept, 1024
* ``series=1``: adds observations with several values (``TIME_SERIES``), a data set and a table
* ``next=0``: ``/current`` has no ``nextSequence``
* ``offset``: work offset of the controller, ``x,y,z`` in mm; default by style
* ``multipart``: ``x-mixed-replace`` or ``mixed``, the kind of the stream; default by style
"""

from errormotion.instruments.simulators.controller.mtconnect.agent import SimulatedAgent

__all__ = ["SimulatedAgent"]
