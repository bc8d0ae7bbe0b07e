"""Points as people hold them: what is read, and what advice leads to them."""

from __future__ import annotations

import re
from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pytest

import teaser_jax as tj


@pytest.mark.parametrize(
    ("shape", "advice"),
    [
        ((3, 7), "pass src.T"), ((4, 9), "pass src[:3].T"),
        ((2, 9), "pass numpy.pad(src, ((0, 1), (0, 0))).T"),
        ((9, 4), "pass src[:, :3]"), ((9, 2), "pass numpy.pad(src, ((0, 0), (0, 1)))"),
        ((1, 9, 3), "pass src.reshape(-1, 3)"), ((9, 1, 3), "pass src.reshape(-1, 3)"),
        ((5, 4, 3), "pass src.reshape(-1, 3)"), ((12,), "pass numpy.reshape(src, (-1, 3))"),
    ],
    ids=str,
)  # fmt: skip
def test_the_advice_for_a_wrong_shape_leads_to_points(shape, advice):
    src = np.random.default_rng(0).normal(size=shape)
    with pytest.raises(ValueError, match=re.escape(f"src has shape {shape}: expected (n, 3)")) as error:
        tj.make_problem(src, src, noise_bound=0.1)
    assert advice in str(error.value)
    followed = eval(advice.removeprefix("pass "), {"src": src, "numpy": np})
    problem = tj.make_problem(followed, followed, noise_bound=0.1)
    assert problem.src.shape[1] == 3
    assert problem.src.size >= 0.74 * src.size


def test_a_stack_of_problems_is_sent_where_stacks_go():
    src = np.zeros((5, 40, 3))
    with pytest.raises(ValueError, match=r"of a stack of problems give one, src\[0\], .* solve_batch or"):
        tj.register(src, src, noise_bound=0.1)


class Tensor:
    """What matters of a tensor of PyTorch, which is not installed here."""

    def __init__(self, values, dtype="torch.float32", requires_grad=False):
        self.values, self.dtype, self.requires_grad = values, dtype, requires_grad

    def float(self):
        return Tensor(self.values)

    def __array__(self, dtype=None, copy=None):
        if self.dtype == "torch.bfloat16":
            raise TypeError("Got unsupported ScalarType BFloat16")
        return np.asarray(self.values, dtype)


def test_tensors_are_read_and_none_is_detached_in_silence():
    points = np.random.default_rng(0).normal(size=(9, 3)).astype(np.float32)
    for tensor in (Tensor(points), Tensor(points, "torch.bfloat16")):
        np.testing.assert_array_equal(tj.host_problem(tensor, tensor, noise_bound=0.1).src, points)
    learned = Tensor(points, requires_grad=True)
    with pytest.raises(ValueError, match=r"dst requires a gradient, .* pass dst.detach\(\)"):
        tj.register(points, learned, noise_bound=0.1)


def test_a_structured_array_is_read_by_its_names():
    points = np.random.default_rng(0).normal(size=(9, 3))
    fields = [("intensity", "f4"), ("x", "f4"), ("y", "f4"), ("z", "f8"), ("ring", "u2")]
    cloud = np.zeros(9, fields)
    for k, axis in enumerate("xyz"):
        cloud[axis] = points[:, k]
    np.testing.assert_allclose(tj.host_problem(cloud, points, noise_bound=0.1).src, points, rtol=1e-6)
    with pytest.raises(ValueError, match="src has dtype .* expected real numbers"):
        tj.host_problem(cloud[["intensity", "ring"]], points, noise_bound=0.1)


def test_clouds_of_open3d_are_read():
    """By what matters of their two kinds: the library itself is tried where it can be loaded."""
    points = np.random.default_rng(0).normal(size=(9, 3))
    legacy = SimpleNamespace(points=points.tolist(), has_points=lambda: True)
    tensor = SimpleNamespace(point=SimpleNamespace(positions=jnp.asarray(points)))
    clouds: list = [legacy, tensor]
    try:
        import open3d
    except ImportError:  # not installed, or without the libraries of the system that it wants
        pass
    else:
        clouds += [
            open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points)),
            open3d.t.geometry.PointCloud(open3d.core.Tensor(points)),
        ]
    for cloud in clouds:
        found = tj.host_problem(cloud, points, noise_bound=0.1).src
        np.testing.assert_allclose(found, points, rtol=1e-6)
    with pytest.raises(ValueError, match="src is empty"):
        tj.register(SimpleNamespace(points=[], has_points=lambda: False), points, noise_bound=0.1)


def test_points_at_the_end_of_all_numbers_are_refused_without_a_warning():
    points = np.full((8, 3), 1.7e308)
    with pytest.raises(ValueError, match="beyond what float64 can square"):
        tj.host_problem(points, points, noise_bound=0.1)
