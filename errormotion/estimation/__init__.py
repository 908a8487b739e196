"""Estimation: from readings, arrays, to values with covariance.

Whatever estimates from numbers belongs here, if it needs nothing of machines, files or methods: least squares and its
covariance, components of variance, smoothing, robust scales, extremes of noisy curves. The package imports numpy,
scipy, `errormotion.arrays` and `errormotion.errors` only. `scipy.stats` is slow to import; `scipy.special` has what is
needed.

A module is imported where it is used: the package itself imports none.
"""
