"""Tolerances: limits of figures and freedoms, and decisions that take the measurement uncertainty into account.

``table`` reads the limits, ``decision`` contains the rules, ``conformity`` the decision on an error dataset.
"""
