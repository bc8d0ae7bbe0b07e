"""Run by ``test_solve_batch.py`` with four devices: 64 problems of 512 matches, against one device."""

import json

import jax
import numpy as np

import teaser_jax as tj
from teaser_jax.engine.programs import on_mesh


def main() -> None:
    drawn = [tj.synthetic.random_problem(k, n=512, outlier_rate=0.9) for k in range(64)]
    stack = tj.stack_problems([tj.host_problem(d.src, d.dst, noise_bound=d.noise_bound) for d in drawn])
    four = tj.solve_batch(stack)
    mesh = jax.make_mesh((1,), ("x",), devices=jax.devices()[:1])
    one = tj.solve_batch(stack, mesh=mesh)
    same = all(np.array_equal(a, b) for a, b in zip(jax.tree.leaves(four), jax.tree.leaves(one), strict=True))
    truth = jax.tree.map(lambda *x: np.stack(x), *[d.truth for d in drawn])
    right = int((np.degrees(tj.metrics.rotation_error(four.pose, truth)) < 5).sum())
    whole = jax.sharding.Mesh(np.array(jax.devices()), ("problems",))
    compiled = on_mesh(jax.tree.structure(tj.Settings()), whole)
    count = compiled.before._cache_size() + compiled.after._cache_size()
    said = {"devices": len(jax.devices()), "same": same, "right": right, "compiled": count}
    print(json.dumps(said))


if __name__ == "__main__":
    main()
