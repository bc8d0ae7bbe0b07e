"""A child of a fork: it works where JAX had not run before, and says what to do where it had."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

needs_fork = pytest.mark.skipif(not hasattr(os, "fork"), reason="a system without forks")

START = """
import multiprocessing, warnings
import jax, numpy as np
import teaser_jax as tj
warnings.simplefilter("ignore")  # JAX warns at each fork that it will hang
points = np.random.default_rng(0).normal(size=(20, 3))
fork = multiprocessing.get_context("fork").Pool

def register(_=0):
    return tj.register(points, points + 1, noise_bound=0.1)

def is_ok(_):
    return register().ok

def refused(name):
    try:
        DOORS[name]()
    except RuntimeError as error:
        return "spawn" in str(error)
    return False
"""
DOORS = """
from teaser_jax import learn
answer, key = register(), jax.random.key(0)
stated = tj.make_problem(points, points, noise_bound=0.1)
host = tj.host_problem(points, points, noise_bound=0.1)
solved = jax.jit(tj.solve)(stated)
DOORS = {
    "register": register,
    "solve_batch": lambda: tj.solve_batch([host]),
    "make_problem": lambda: tj.make_problem(points, points, noise_bound=0.1),
    "stack_problems": lambda: tj.stack_problems([stated, stated]),
    "solve": lambda: tj.solve(stated),
    "jit": lambda: jax.jit(lambda problem: tj.solve(problem))(stated),
    "select": lambda: tj.select(stated),
    "soft_solve": lambda: tj.soft_solve(stated),
    "refit": lambda: tj.refit(stated, solved.selection),
    "refit in numpy": lambda: tj.refit(answer.problem, answer.solution.selection),
    "certify": lambda: tj.certify(answer),
    "covariance": lambda: tj.covariance(answer),
    "error_bounds": lambda: tj.error_bounds(answer),
    "solve_rotation": lambda: tj.solve_rotation(points, points, noise_bound=0.1),
    "certify_rotation": lambda: tj.certify_rotation(points, points, np.eye(3), noise_bound=0.1),
    "profile": lambda: tj.profile(points, points, noise_bound=0.1),
    "read_scan": lambda: learn.read_scan(points, np.zeros(3)),
    "teacher": lambda: learn.teacher(points, points, noise_bound=0.1),
    "init_network": lambda: learn.init_network(key),
}
with fork(1) as pool:
    answers = dict(zip(DOORS, pool.map(refused, DOORS)))
assert all(answers.values()), answers
assert register().ok  # the parent goes on
"""


def ran(lines: str) -> None:
    """Run lines in a process of their own, which may hang."""
    done = subprocess.run([sys.executable, "-c", START + lines], capture_output=True, text=True, timeout=200)
    assert done.returncode == 0, done.stderr[-2000:]


@needs_fork
@pytest.mark.long
def test_a_fork_before_any_use_works():
    ran("with fork(1) as pool:\n    assert pool.map(is_ok, [0]) == [True]\nassert register().ok")


@needs_fork
@pytest.mark.long
def test_every_door_refuses_a_child_of_a_process_that_used_the_package():
    ran(DOORS)


@pytest.mark.long
@needs_fork
@pytest.mark.parametrize(
    "use",
    [
        "jax.numpy.zeros(3)",  # and nothing of this package but its name
        # A JAX that cannot be asked whether it has run: what the package itself did is known.
        "del jax._src.xla_bridge.backends_are_initialized; register()",
    ],
)
def test_a_child_of_a_process_that_used(use):
    ran(f"{use}\nDOORS = dict(register=register)\nwith fork(1) as pool: assert all(pool.map(refused, DOORS))")
