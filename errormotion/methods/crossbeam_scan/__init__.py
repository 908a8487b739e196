"""Crossbeam scan by a line profiler: six thermal errors of an axis from artefacts scanned cold and warm.

Source: Zhao et al., On-machine measurement of thermal influence of the long-span crossbeam of gantry machine tools
using a 3D laser profiler.
"""
