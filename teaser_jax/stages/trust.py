import jax.numpy as jnp
def judge(p, pose, inliers, clique_size, *, converged, pruned):
    return jnp.zeros((), jnp.int32)
