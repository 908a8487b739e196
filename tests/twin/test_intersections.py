"""Intersections of beams with surfaces."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from errormotion.twin import intersections

small = arrays(float, 3, elements=st.floats(-1e-4, 1e-4))
tilt = arrays(float, 3, elements=st.floats(-0.02, 0.02))


def unit(v):
    return v / np.linalg.norm(v)


@given(small, tilt, tilt)
def test_point_on_the_cylinder_has_the_radius_and_faces_the_sensor(shift, lean, aim):
    origin, u, a = (
        np.array([6e-3, 0, 0.01]) + shift,
        unit(np.array([-1.0, 0, 0]) + aim),
        unit(np.array([0, 0, 1.0]) + lean),
    )
    d = intersections.to_cylinder(origin, u, shift[::-1].copy(), a, 5e-3)
    radial = origin + d * u - shift[::-1]
    radial = radial - (radial @ a) * a
    assert np.linalg.norm(radial) == pytest.approx(5e-3, abs=1e-15)
    assert radial @ u < 0


@given(small, tilt)
def test_point_on_the_sphere_has_the_radius_and_faces_the_sensor(shift, aim):
    origin, u = np.array([6e-3, 0, 0]) + shift, unit(np.array([-1.0, 0, 0]) + aim)
    d = intersections.to_sphere(origin, u, np.zeros(3), 5e-3)
    hit = origin + d * u
    assert np.linalg.norm(hit) == pytest.approx(5e-3, abs=1e-15)
    assert hit @ u < 0


@given(small, tilt, tilt)
def test_point_on_the_plane_lies_in_it(shift, lean, aim):
    u, n = unit(np.array([0, 0, 1.0]) + aim), unit(np.array([0, 0, 1.0]) + lean)
    d = intersections.to_plane(np.array([0, 0, -1e-3]), u, shift, n)
    assert (np.array([0, 0, -1e-3]) + d * u - shift) @ n == pytest.approx(0, abs=1e-17)


def test_missed_surface_is_nan():
    beam = np.array([6e-3, 6e-3, 0.0]), np.array([-1.0, 0, 0])
    assert np.isnan(intersections.to_sphere(*beam, np.zeros(3), 5e-3))
    assert np.isnan(intersections.to_cylinder(*beam, np.zeros(3), np.array([0, 0, 1.0]), 5e-3))
