"""Where a point sensor's beam starts and where it goes, from planes that a stage moves it over.

``slopes`` finds how the reading changes with the stage's place on each plane, ``direction`` the beam's direction from
that, ``origin`` its zero point.
"""
