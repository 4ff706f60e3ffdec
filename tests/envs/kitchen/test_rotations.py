from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from torchrl_caiac.envs.kitchen.rotations import rotation_matrix, rotation_vector


@given(
    st.lists(
        st.floats(-1, 1, allow_nan=False).filter(lambda x: x == 0 or abs(x) > 1e-3),
        min_size=3,
        max_size=3,
    ),
    st.floats(0, np.pi - 1e-3),
)
@settings(deadline=None)
def test_both_agree_with_scipy(axis, angle):
    axis = np.array(axis)
    if np.linalg.norm(axis) == 0:
        axis = np.array([0.0, 0.0, 1.0])
    rotation = Rotation.from_rotvec(angle * axis / np.linalg.norm(axis))
    found = rotation_vector(rotation.as_matrix())
    np.testing.assert_allclose(found, rotation.as_rotvec(), atol=1e-6)
    matrix = rotation_matrix(rotation.as_rotvec())
    np.testing.assert_allclose(matrix, rotation.as_matrix(), atol=1e-6)


def test_rotation_vector_at_half_turn_and_wrong_shape():
    half = np.diag([1.0, -1.0, -1.0])
    assert np.linalg.norm(rotation_vector(half)) == pytest.approx(np.pi)
    with pytest.raises(ValueError, match=r"shape \(2, 2\)"):
        rotation_vector(np.eye(2))
