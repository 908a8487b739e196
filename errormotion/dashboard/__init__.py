"""The dashboard: runs, instruments and comparisons in a browser; a thin layer over functions of the other packages.

``access`` decides who may ask, ``lab`` finds runs and their files, ``course`` reduces results to curves, ``figures``
draws them, ``pages`` holds the handlers, ``server`` puts them together. Nothing here needs bokeh or tornado before
``server`` is imported.
"""
