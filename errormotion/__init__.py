"""Measure the error motions of machine tools: many sensors, many methods, one kind of result.

The packages, from the bottom up (imports run one way, enforced by a contract):

``errors``        every exception that a user may meet, from one root
``kinematics``    poses, twists, ISO 230-1 axes, machine chains, geometric fits; arrays in and out
``plugins``       contracts of instruments, methods and kinds of dataset; the registry
``datasets``      raw and error datasets: schemas, units, provenance, reading and writing
``twin``          virtual machines with known errors
``tolerances``    limits of results, and decisions on them
``report``        what chapters are made of
``instruments``   transports, codecs, drivers and their simulators
``methods``       from raw datasets to error datasets
``montecarlo``    uncertainty by trials, beside the linear one
``testing``       the conformance kit that every plugin passes
``compare``       several results of one machine: agreement, consensus, diagnosis
``compensation``  thermal models
``campaign``      bench and campaign files, the runner, run folders
``record``        all runs of a machine: list, history, notes
``cli``           the command ``errormotion``
"""

import logging
import os

__version__ = "0.1.0"

# Without a handler, Python prints the warnings of a library whose user has configured no logging.
logging.getLogger(__name__).addHandler(logging.NullHandler())

# Numba would take the TBB that another package has brought into the process, and warn where it is too old.
os.environ.setdefault("NUMBA_THREADING_LAYER_PRIORITY", "omp tbb workqueue")
