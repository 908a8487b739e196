"""Measurement of the error motions of machine tools: many sensors and methods, one kind of result.

The packages from the lowest layer to the highest; a package imports only lower ones (checked by a contract):

``errors``        the exceptions of the package, with a common root
``estimation``    least squares, covariances, smoothing, extremes, for arrays
``kinematics``    poses, twists, ISO 230-1 axes, machine chains, geometric fits, for arrays
``plugins``       contracts of instruments, methods and kinds of dataset; the registry
``datasets``      raw and error datasets: schemas, units, provenance, reading and writing
``twin``          virtual machines with known errors
``tolerances``    limits of results, and decisions on them
``report``        elements of reports, the page, exports
``instruments``   transports, codecs, drivers and their simulators
``methods``       from raw datasets to error datasets
``montecarlo``    uncertainty by the Monte Carlo method, compared with the linear one
``testing``       the conformance kit for plugins
``compare``       several results of one machine: agreement, consensus, diagnosis
``compensation``  thermal models, corrections, tables of controls, NC programs, online compensation
``campaign``      bench and campaign files, the runner, run folders
``record``        all runs of a machine: list, history, notes
``cli``           the command ``errormotion``
"""

import logging
import os

__version__ = "0.1.0"

# Without a handler, Python would print the warnings of the library if the user configured no logging.
logging.getLogger(__name__).addHandler(logging.NullHandler())

# Numba would use TBB if another package has loaded it, and warn if it is too old.
os.environ.setdefault("NUMBA_THREADING_LAYER_PRIORITY", "omp tbb workqueue")
