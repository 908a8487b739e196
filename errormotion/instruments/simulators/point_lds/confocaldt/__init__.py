"""A simulated confocalDT IFC2451, IFC2461 or IFC2471 on Ethernet, from the manufacturer's manual.

Facts and their sources (operating instructions confocalDT 24x1 of Micro-Epsilon, pages as at
manualshive.com/en/manual/micro-epsilon/confocal-dt2471/1785336; "2300" is optoNCDT 2300, which has the same grammar):

* Commands on TCP port 23, parameters after spaces, with spaces inside in quotation marks, ended by LF or CR LF. A
  command without parameters returns the present setting, which can be sent back unchanged; after each command a line
  end and the prompt ``->``; before it an error ``Exx`` or a warning ``Wxx`` (p. 92).
* ``GETINFO``, ``ECHO``, ``PRINT`` (p. 95); ``SYNC`` with E02 and E11, ``RESET``, ``GETTEMP``, ``LOGIN`` with E06 and
  E11, ``LOGOUT``, ``GETUSERLEVEL``, ``STDUSER`` (p. 96); ``PASSWD``, ``SENSORTABLE``, ``SENSORHEAD`` with E39,
  ``SENSORINFO``, ``DARKCORR``, ``DARKCORRTHRES`` (p. 97); exposure modes, ``MEASRATE`` in kHz with at most one decimal
  place and its limits by model, ``SHUTTER``, ``ROI``, video averaging (p. 102); averages (p. 53); ``RESETSTATISTIC``,
  ``MASTERSIGNAL``, ``MASTERMV``, ``OUTPUT``, ``OUTREDUCE``, ``OUTHOLD`` (p. 105); ``OUTDIST_ETH`` (p. 106),
  ``OUTTHICK_ETH``, ``OUTSTATISTIC_ETH``, ``OUTADD_ETH``, ``SWITCHMD2`` (p. 107).
* Order of the values in a frame (p. 110), exposure time and rate (p. 111), time stamp in us, distances in signed nm,
  intensity (p. 112), error status (p. 113); header and flags (p. 115, 116), little-endian.
* ``MEASTRANSFER SERVER/TCP 1024`` and the data port 1024: a client of the related IFC242x.

Assumptions, because the available pages do not show them: texts of errors, and all numbers except E02, E06, E11, E32,
E39; that commands in lower case are unknown; ``ok`` with ECHO ON (2300 p. 129); the name and values of ``SHUTTERMODE``,
``MEASMODE``, ``AVERAGE``, ``IPCONFIG`` and ``MEASTRANSFER`` (2300); error values 7FFFFFFB, 7FFFFFFA and 7FFFFFF9 (2300
p. 98); on the line, bytes per frame precede the number of frames, as capaNCDT controllers send them (``header=frames``
reverses this); the preamble is a little-endian number, ``SAEM`` on the line; the default rate of 1 kHz. Triggers, light
source and stored settings are omitted.

The models IFC2421 and IFC2422 have another grammar (``OUT_ETH 01DIST1``) and another header (``DATA``): not simulated.
"""

from errormotion.instruments.simulators.point_lds.confocaldt.controller import SimulatedConfocal

__all__ = ["SimulatedConfocal"]
