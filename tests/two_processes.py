"""Run by ``test_solve_batch.py``, once a process: ADDRESS COUNT NUMBER."""

import json
import sys

import jax
import numpy as np

import teaser_jax as tj
from teaser_jax.engine.processes import all_of, share


def main(address: str, count: str, number: str) -> None:
    jax.distributed.initialize(address, int(count), int(number))
    drawn = [tj.synthetic.random_problem(k, n=20 + k, outlier_rate=0.4) for k in range(11)]
    problems = [tj.host_problem(d.src, d.dst, noise_bound=d.noise_bound) for d in drawn]
    together = tj.solve_batch(problems)
    stacked = tj.solve_batch(tj.stack_problems(problems))
    alone = [tj.register(p.src, p.dst, noise_bound=p.noise_bound) for p in problems]
    same = all(
        np.array_equal(a.inliers, b.inliers)
        and np.array_equal(stacked.inliers[k, : len(a.inliers)], a.inliers)
        and np.allclose(a.pose.matrix, b.pose.matrix, atol=1e-12)
        for k, (a, b) in enumerate(zip(together, alone, strict=True))
    )
    try:
        tj.solve_batch(problems[: 10 + int(number)])
        refused = False
    except ValueError as error:
        refused = "each must call with the same ones" in str(error)
    shares = all_of(len(range(11)[share(11, None)]))
    print(json.dumps({"processes": jax.process_count(), "same": same, "shares": shares, "refused": refused}))


if __name__ == "__main__":
    main(*sys.argv[1:])
