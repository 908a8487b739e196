"""A simulated capaNCDT 6200 controller for capacitive sensors on Ethernet, from the manufacturer's manuals.

Facts and their sources (operating instructions of Micro-Epsilon: "6200" is capaNCDT 6200, pages as at
easymanua.ls/micro-epsilon/cs02; "6400" is combiSENSOR 6400, "6500" is capaNCDT 6500 and "6228" is capaNCDT 6228/6238,
controllers with the same commands):

* Two TCP ports: commands (23, Telnet) and measured values (10001). A command is ``$``, three letters and parameters,
  ended by CR or CR LF; characters before the ``$`` are ignored; every character is echoed; a command that is not ended
  within about 10 s after its last character times out (6200 p. 59).
* ``STI`` (6200 p. 59), ``TRG`` and ``GMD`` (6400 p. 38), ``AVT`` (6500 p. 37, 6228 p. 55), ``AVN`` with 2 to 8
  (6228 p. 55), ``CHS`` and ``LIN`` (6200 p. 63), ``SLP`` (6500 p. 40 of the German edition), ``GLP`` (6500 p. 40),
  ``STS`` (6400 p. 41), ``VER``, and ``SMF``, whose answer has a comma before its ``OK`` (6200 p. 66),
  ``GMF`` and ``CMF`` (6200 p. 68), ``IPS`` (6400 p. 41), ``GDP``, ``SDP``, ``CHI``, ``COI``, ``LGI`` and ``LGO`` (6500
  p. 44 of the German edition).
* Blocks: a header of 32 bytes and frames of one 32-bit value per channel, little-endian (6200 p. 55); the measuring
  range corresponds to 24 bits, and the result of a math function may be larger or negative (6200 p. 56). By default
  values are sent continuously; none is sent while a command is answered (6200 p. 56, 59).

From other clients, which work with real controllers: the answer completes the echo, so that ``$STI1200`` is followed by
``,960OK``, and errors follow the echo as ``$UNKNOWN COMMAND`` and ``$WRONG PARAMETER`` (benjamingmeiner/kapascan); the
answer to ``VER`` ends with ``OK`` (kapascan, epics-modules/microEpsilon; the manuals print it without), and a new
connection is greeted with a line of text (both expect it); the preamble is a little-endian number, ``SAEM`` on the line
(iotfablab/micro-epsilon-optoNCDT); bytes per frame precede the number of frames (kapascan,
sourcehawk/microepsilon-capancdt-reader; epics-modules/microEpsilon reads them the other way round).

Assumptions, because the available pages do not show them: CR and LF are not echoed; the text of the greeting;
``$TIMEOUT`` and ``$WRONG PASSWORD``; commands in lower case are unknown; the list of sample times (2.6 to 3906.3 Sa/s,
all multiples of 32 us: they agree with 1200 -> 960 and with 256 us) and that the nearest one is used; the micro sign in
Latin-1; a channel that does not exist is a wrong parameter; targets out of range are sent as FFFFFF; the counter counts
the values sent since power-on; dynamic noise rejection has no effect here; linearisation has no effect because the
virtual sensor is linear; a new data port is used from the next power-on; ``GMD`` during continuous transmission is
answered and adds no value.

``GDP`` returns the port on which the simulator listens.
"""

from errormotion.instruments.simulators.point_lds.capancdt.controller import SimulatedCapaNCDT

__all__ = ["SimulatedCapaNCDT"]
