"""A simulated optoNCDT laser sensor on RS422, from the manufacturer's manuals: commands, refusals, and the data stream.

Two models, distinguished throughout: ILD2300 and ILD1420. Facts and their sources (operating instructions of
Micro-Epsilon: "2300" is optoNCDT 2300, "1420" optoNCDT 1420, "1320" the related optoNCDT 1320, "24x1" confocalDT 24x1,
which has the same command grammar):

* Commands in upper case, parameters after spaces, with spaces inside in quotation marks, ended by LF or CR LF
  (24x1 p. 92). A command without parameters returns the present setting as ``NAME parameter ...``, which can be sent
  back unchanged; after each command a line end and the prompt ``->``; before it an error ``Exx`` (2300 p. 122) or
  ``Exxx`` (1320 p. 82), or a warning ``W``.
* ``GETINFO`` (2300 p. 127, 1420 p. 97); ``SYNC`` of the 2300 always takes two parameters (p. 128); ``RESETCNT``,
  ``ECHO`` (p. 129): with ECHO ON the command is repeated before its answer, or followed by ``ok``; user levels and
  password (p. 131); ``TRIGGER`` with two parameters, ``TRIGGERAT``, ``TRIGGERLEVEL`` (German edition p. 131),
  ``TRIGGERCOUNT``, ``TRIGGERSW``, ``TRIGGEROUT`` (p. 133); ``MEASMODE``, ``MEASPEAK``, ``MEASRATE`` (p. 136);
  ``AVERAGE``, ``SPIKECORR`` (p. 139); ``STATISTICDEPTH``, ``RESETSTATISTIC``, ``MASTERMV`` with E32 (p. 140);
  ``GETOUTINFO_RS422``, ``OUTDIST_RS422``, ``OUTTHICK_RS422`` (p. 142), ``OUTSTATISTIC_RS422``, ``OUTADD_RS422``,
  ``OUTVIDEO`` (p. 143).
* Of the 1420: overview (p. 94), ``LANGUAGE`` (p. 97), ``MASTERMV`` with E104, ``OUTPUT``, ``OUTREDUCEDEVICE``
  (p. 108), ``OUTREDUCECOUNT``, ``OUTHOLD``, ``GETOUTINFO_RS422``, ``OUTADD_RS422`` (p. 109), baud rates (p. 116).
* Values: three bytes of 6 bits each, L 00, M 01, H 1x, 18 bits in all (1420 p. 85); in the H byte of the first value
  of a block bit 6 is clear, in those of the others set. The sensor continues to measure while it answers (1420 p. 85).
  Distances, reserves and their formulas (2300 p. 94, 1420 p. 65), after mastering 0.51 instead of 0.01; exposure time,
  counter of 18 bits, time stamp and temperature (2300 p. 86; 1420 p. 65-66: time stamp in two words of 16 bits of 10
  us); sensor status and error values 262075 to 262082 (1420 p. 66).

Assumptions, because the available pages do not show them: the numbers and texts of errors except E02, E06, E11 (24x1 p.
96), E32, E104 and E202; that lower case is refused; the order of the values on the 2300 (that of its table of output
values, p. 94: additional values before the distance, statistics after it) and on the 1420 (that of its table of values,
p. 65: distance first); the names that ``GETOUTINFO_RS422`` lists (its form is confocalDT 2410 p. 169); LASERPOW,
BAUDRATE, OUTPUT, OUTREDUCE and OUTHOLD of the 2300; the commands for stored settings; that ``RESETCNT`` needs a
parameter.

Simplified: the measured value counter of a sensor that was reset is 0 at the first value of the next stream; mastering
takes effect at the next value that is sent; statistics include all values, whatever ``STATISTICDEPTH`` is; exposure
time, intensity and temperature are constants; there are no external triggers.
"""

from errormotion.instruments.simulators.point_lds.optoncdt.sensor import SimulatedOptoNCDT

__all__ = ["SimulatedOptoNCDT"]
