"""The dashboard: runs, instruments and comparisons in a browser.

``access`` contains the rules of access, ``lab`` the runs and their files, ``curves`` the reduction of results to
curves, ``figures`` the drawings, ``pages`` the request handlers, ``server`` the server. The packages bokeh and tornado
are imported with ``server`` only.
"""
