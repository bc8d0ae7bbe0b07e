"""The main job on real input: every pair of the data folder, and the numbers of another program."""

from __future__ import annotations

import numpy as np
import pytest

import teaser_jax as tj

# folder: noise bound [m], accepted rotation error [deg] and translation error [m]
ACCEPTED = {"kitti_fpfh": (0.6, 5.0, 0.6), "eth_tls": (0.1, 5.0, 0.5), "threedmatch": (0.05, 10.0, 0.3)}


@pytest.mark.long
@pytest.mark.parametrize("folder", ACCEPTED)
def test_every_real_pair_is_right_and_ok(data_dir, folder):
    bound, rotation_limit, translation_limit = ACCEPTED[folder]
    paths = sorted((data_dir / folder).glob("*.npz"))
    assert paths
    for path in paths:
        pair = np.load(path)
        truth = tj.Pose.from_matrix(pair["T_dst_src"])
        result = tj.register(pair["src"], pair["dst"], noise_bound=bound)
        assert result.ok, (path.name, result.status)
        assert result.solution.clique_is_maximum, path.name
        assert np.degrees(tj.metrics.rotation_error(result.pose, truth)) < rotation_limit, path.name
        assert tj.metrics.translation_error(result.pose, truth) < translation_limit, path.name


@pytest.mark.long
def test_a_source_with_another_pairs_target_is_not_ok(data_dir):
    pairs = [np.load(path) for path in sorted((data_dir / "kitti_fpfh").glob("*.npz"))]
    for a, b in zip(pairs, pairs[1:] + pairs[:1], strict=True):
        n = 1800  # one size: one program
        result = tj.register(a["src"][:n], b["dst"][:n], noise_bound=0.6)
        assert result.status == tj.Status.NO_CONSENSUS or result.status == tj.Status.DEGENERATE


@pytest.mark.long
@pytest.mark.parametrize("folder", ["kitti_fpfh", "eth_tls"])  # the wall of 3DMatch fits both ways
@pytest.mark.parametrize("axis", range(3))
def test_a_mirrored_target_is_not_ok(data_dir, folder, axis):
    """KITTI 000 and 040 were called ok: a street is flat, and its plane fits a rotation by itself."""
    mirror = np.where(np.arange(3) == axis, -1, 1)
    for path in sorted((data_dir / folder).glob("*.npz")):
        pair = np.load(path)
        result = tj.register(pair["src"], pair["dst"] * mirror, noise_bound=ACCEPTED[folder][0])
        assert result.status in (tj.Status.MIRRORED, tj.Status.NO_CONSENSUS), path.name


@pytest.mark.long
@pytest.mark.parametrize("number", [1, 3, 5])
def test_golden_problems_with_unknown_scale(data_dir, number):
    """TEASER++'s test problems (10, 10 and 100 points; 0, 30 and 90 % wrong), free of noise.

    The C++ answers ``*_est`` came from its default parameters at the stored noise bound.
    """
    golden = np.load(data_dir / "teaser_fixtures" / f"benchmark_{number}.npz")

    def pose(kind: str) -> tj.Pose:
        return tj.Pose(golden[f"R_{kind}"], golden[f"t_{kind}"].ravel(), golden[f"s_{kind}"].ravel()[0])

    bound = float(golden["param_Noise Bound"])
    result = tj.register(golden["src"], golden["dst"], noise_bound=bound, scale=None)
    assert result.ok
    for error in (tj.metrics.rotation_error, tj.metrics.translation_error, tj.metrics.scale_error):
        # The files keep 15 digits, so that much is nobody's error.
        assert error(result.pose, pose("ref")) <= 2 * error(pose("est"), pose("ref")) + 1e-9
    expected = round(len(golden["src"]) * (1 - float(golden["param_Outlier Ratio"])))
    assert result.inliers.sum() == expected
