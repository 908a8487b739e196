"""Circular tests with a telescoping ballbar after ISO 230-4, as a method of `errormotion`.

``method`` is the plugin. From lengths to result: ``circles`` reads the raw dataset, ``path`` is the model of the
circular path, ``sectors`` averages the readings by angle, ``evaluation`` removes the set-up error, ``extremes``
computes the figures of the standard, and ``identification`` returns the error dataset.
"""
