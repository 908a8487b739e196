"""Thermal distortion by a moving axis after ISO 230-3."""

import numpy as np
import pytest
import xarray as xr
from scipy import stats
from test_acquisition_doubles import Bench, Interferometer, Machine

from errormotion import datasets
from errormotion.datasets.merit import figures_of
from errormotion.errors import MethodError
from errormotion.methods.linear_positioning import LinearPositioning, Settings
from errormotion.methods.linear_positioning.acquisition.warming import measure_moving
from errormotion.methods.linear_positioning.report import chapters
from errormotion.methods.linear_positioning.simulation import simulate
from errormotion.report.document import Source
