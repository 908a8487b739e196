"""Measure how machine tools move wrongly: many sensors, many methods, one kind of result.

The packages, from the bottom up (imports run one way, and a contract holds it):

``errors``       every exception that a user may meet, from one root
``kinematics``   poses, twists, ISO 230-1 axes, machine chains, geometric fits; arrays in and out
``datasets``     raw and error datasets: schemas, units, provenance, reading and writing
``twin``         the virtual machine: truth for everything
``plugins``      what an instrument and a method are, and the registry that finds them
``instruments``  transports, codecs, drivers and their wire simulators
``methods``      from raw datasets to error datasets
``campaign``     bench and campaign files, the runner, run folders
``report``       the page that a lab hands to its customer
``testing``      the conformance kit that every plugin passes
``cli``          the command ``errormotion``
"""

import logging

__version__ = "0.1.0"

# A library speaks when its user listens: without this, Python prints every warning of every call.
logging.getLogger(__name__).addHandler(logging.NullHandler())
