"""An OPC UA server (package asyncua) of the virtual machine, after the published documents.

Parameters of the address in addition to those of every simulated device:

* ``style``: ``cnc`` (the default), the information model for CNC systems of OPC 40502 1.00 with its published NodeSet,
  or ``sinumerik``, the variables of a SINUMERIK: ids such as ``/Channel/GeometricAxis/actToolBasePos[u1,3]``, no units
* ``units``: location of the unit of a group of positions. ``model`` (the default): a property in the namespace of the
model, as in the NodeSet; ``ua``: in that of OPC UA, as in the text of the specification (Table 32)

A client can read, browse and subscribe, but not write. The standard nodes are those of a small server: the
object Server, the types that are used, no diagnostics.

In addition to `faults`: ``unavailable`` (values have a bad status) and ``restart`` (the server restarts once, and loses
its sessions). ``fault_at`` counts the messages of the server; the first one acknowledges a connection.
"""

from errormotion.instruments.simulators.controller.opcua.server import SimulatedServer

__all__ = ["SimulatedServer"]
