"""Raw datasets and error datasets: schemas, units, provenance, reading and writing.

The import of this package registers the accessor ``ds.em``.
"""

from errormotion.datasets.provenance import hash_dataset
from errormotion.datasets.results.accessor import Combination, ErrorMotion
from errormotion.datasets.results.build import build_deviations, build_errors
from errormotion.datasets.schemas import DOF, SCHEMA
from errormotion.datasets.storage.disk import load, save
from errormotion.datasets.validation import validate, violations

__all__ = [
    "DOF",
    "SCHEMA",
    "Combination",
    "ErrorMotion",
    "build_deviations",
    "build_errors",
    "hash_dataset",
    "load",
    "save",
    "validate",
    "violations",
]
