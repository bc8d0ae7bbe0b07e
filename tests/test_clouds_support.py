"""What two clouds say of poses, as a device computes it, beside the trees of the host."""

from __future__ import annotations

import jax
import numpy as np
import pytest
from cloud_scenes import CUPBOARD, ROOM, box, on_faces, plane, terrain
from scipy.spatial.transform import Rotation

pytest.importorskip("small_gicp", reason="needs the extra clouds")

import teaser_jax as tj
from teaser_jax.clouds.pair import Pair
from teaser_jax.clouds.prepared import prepare
from teaser_jax.clouds.support import support
from teaser_jax.clouds.trust.judge import CELLS, MOST_CELLS
from teaser_jax.clouds.trust.observability import observability
from teaser_jax.clouds.trust.pairing import lay
from teaser_jax.clouds.trust.rivals import possible
from teaser_jax.clouds.trust.space import SIDE, in_front, range_image, sight

EYE = np.array([10.0, 10.0, 3.0])


def motion(turn, shift) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = Rotation.from_rotvec(turn).as_matrix(), shift
    return pose


POSES = np.stack(
    [
        np.eye(4),
        *(motion([0, 0, 0.02 * k], [0.1 * k, 0.2, 0]) for k in range(1, 5)),
        motion([0, 0, 3], [20, 20, 0]),
    ]
)


@pytest.fixture(scope="module")
def clouds():
    return [prepare(terrain(seed, 20_000), viewpoint=EYE) for seed in (0, 1)]


@pytest.fixture(scope="module")
def found(clouds):
    return jax.device_get(support(POSES, *clouds))


def test_says_what_the_trees_of_the_host_say(clouds, found):
    pair = Pair(*clouds)
    src, dst = pair.surfaces(CELLS, MOST_CELLS)
    for k, pose in enumerate(POSES):
        centred = pair.centred(tj.Pose.from_matrix(pose))
        laid = lay(centred, src, dst)
        ways = laid.here, laid.back
        np.testing.assert_allclose(found.overlap[k], [x.overlap for x in ways], atol=2e-3)
        np.testing.assert_allclose(found.share[k], [x.support for x in ways], atol=0.02)
        np.testing.assert_allclose(found.fit[k], [x.fit for x in ways], atol=0.02)
        np.testing.assert_allclose(
            found.in_front[k].max(), in_front(centred, src, dst, pair.images), atol=2e-3
        )
        np.testing.assert_allclose(found.visible[k], observability(laid.here).visible, atol=0.03)
    assert found.fit[0].min() > 0.9
    assert found.fit[-1].max() < 0.5


def test_one_pose_many_and_traced_ones_have_the_same_numbers(clouds, found):
    one = support(tj.Pose.from_matrix(POSES[1]), *clouds)
    traced = jax.jit(jax.vmap(lambda pose: support(pose, *clouds)))(POSES.astype(np.float32))
    grid = support(POSES.reshape(2, 3, 4, 4), *clouds)
    for name in found._fields:
        every = getattr(found, name)
        np.testing.assert_allclose(getattr(one, name), every[1], rtol=1e-5, atol=1e-6)
        # Poses in single precision put some cells on the other side of a limit.
        np.testing.assert_allclose(getattr(traced, name), every, atol=5e-3)
        np.testing.assert_array_equal(getattr(grid, name), every.reshape(2, 3, *every.shape[1:]))


def test_clouds_may_be_read_inside_jit():
    a, b = terrain(0, 5_000), terrain(1, 5_000)  # nothing is known of them yet
    traced = jax.jit(lambda pose: support(pose, a, b).fit)(np.eye(4, dtype=np.float32))
    np.testing.assert_allclose(traced, support(np.eye(4), a, b).fit, atol=5e-3)


def test_lengths_are_those_of_the_clouds():
    a, b = terrain(0, 5_000), terrain(1, 5_000)
    small, large = support(np.eye(4), a, b), support(np.eye(4), 1000 * a, 1000 * b)
    np.testing.assert_allclose(large.fit, small.fit, atol=0.01)
    np.testing.assert_allclose(large.residual, 1000 * small.residual, rtol=0.05)
    assert np.isnan(small.in_front).all()


def test_a_plane_sees_three_motions():
    seen = support(np.eye(4), plane(0, noise=0.002), plane(1, noise=0.002)).visible
    assert np.all(seen[:3] < 1e-3)
    assert np.all(seen[3:] > 0.2)


def test_clouds_that_do_not_meet_fit_nowhere():
    a = terrain(0, 5_000)
    apart = support(motion([0, 0, 0], [0, 0, 100]), a, a, src_viewpoint=EYE, dst_viewpoint=EYE)
    assert np.all(apart.overlap == 0)
    assert np.all(apart.fit == 0)
    assert np.all(apart.visible == 0)
    assert np.isnan(apart.residual)


def test_what_stands_where_a_sensor_looked_through_is_in_front():
    empty, furnished = on_faces(0, 60_000, ROOM), on_faces(1, 60_000, [*ROOM, *CUPBOARD])
    low, high = empty.min(axis=0), empty.max(axis=0)
    eye = low + [0.3, 0.4, 0.5] * (high - low)
    seen = range_image(empty, eye)
    own = sight(seen, empty, np.ones(len(empty), bool), 0.1)
    assert own.asked == 1
    assert own.in_front == 0  # the nearest point of each pixel is what was seen
    there = sight(seen, furnished, np.ones(len(furnished), bool), 0.1)
    assert there.in_front > 0.01
    behind = eye + 1.5 * (empty - eye)
    assert sight(seen, behind, np.ones(len(behind), bool), 0.1).hidden > 0.9


def test_another_pose_is_no_rival_where_a_sensor_looked_through():
    src, dst = (prepare(on_faces(seed, 60_000, ROOM), viewpoint=[0.5, 0.2, 1.2]) for seed in (0, 1))
    pair = Pair(src, dst)
    still = pair.centred(tj.Pose.from_matrix(np.eye(4)))
    laid = lay(still, *pair.surfaces(CELLS, MOST_CELLS))
    assert in_front(still, laid.src, laid.dst, pair.images) < 0.01
    half, quarter = (motion([0, 0, angle], [0, 0, 0]) @ still for angle in (np.pi, np.pi / 2))
    three = np.stack([motion([0, 0, 0], [0, 1.5, 0]) @ still, quarter, half])
    assert len(list(possible(three, np.ones(3), laid, (None, None)))) == 3
    (left,) = possible(three, np.ones(3), laid, pair.images)  # half a turn leaves free what was free
    np.testing.assert_array_equal(left, half)


def test_a_pose_that_a_sensor_looked_through_is_not_ok():
    whole = terrain(0, 20_000)
    right = tj.register_clouds(whole, terrain(1, 20_000), src_viewpoint=EYE, dst_viewpoint=EYE)
    assert right.ok
    assert right.evidence.in_front < 0.05
    tower = np.concatenate([whole, on_faces(2, 6_000, box([6, 6, 3], [12, 12, 9]))])
    odd = tj.register_clouds(tower, terrain(1, 20_000), dst_viewpoint=[9, 9, 30])
    assert (odd.status, odd.doubt) == (tj.Status.NO_CONSENSUS, "space")
    assert "looked through" in odd.advice


def test_every_direction_has_a_pixel_of_its_own():
    directions = np.random.default_rng(0).normal(size=(200_000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    depth = range_image(directions, np.zeros(3)).depth
    assert depth.size == 6 * SIDE**2
    assert np.isfinite(depth).all()
    axes = range_image(np.concatenate([np.eye(3), -np.eye(3)]), np.zeros(3)).depth
    assert np.isfinite(axes).sum() == 6


def test_refuses_what_is_no_pose(clouds):
    with pytest.raises(ValueError, match="shape"):
        support(np.eye(3), *clouds)
    with pytest.raises(ValueError, match="scale"):
        support(np.diag([2.0, 2, 2, 1]), *clouds)
    with pytest.raises(ValueError, match="above 0"):
        support(np.eye(4), *clouds, voxel_size=0.0)
    with pytest.raises(ValueError, match="prepared"):
        support(np.eye(4), *clouds, src_viewpoint=EYE)
    with pytest.raises(ValueError, match="inside jit"):
        jax.jit(lambda x: support(np.eye(4), x, x))(terrain(0, 500))
