"""Tolerances: limits of figures and freedoms, and the decision on them with the measurement uncertainty.

``table`` is what a person writes, ``decision`` the rule, ``conformity`` the decision on an error dataset.
"""
