"""How the programs of the host's doors are compiled, with no global setting."""

from __future__ import annotations

import jax

# More optimisation than this compiles longer and runs no faster. Who asks JAX for hardly any gets that.
HARDLY_ANY = jax.config.values.get("jax_disable_most_optimizations", False)
OPTIMISED = {"xla_backend_optimization_level": 0 if HARDLY_ANY else 1}
# XLA splits each long sum into two kernels on the CPU: half as many again to compile, and no faster.
WHOLE_SUMS = {"xla_disable_hlo_passes": "tree_reduction_rewriter"} | OPTIMISED
# Lengths of a million pairs: an eighth of the time is saved where the CPU has such vectors.
WIDE_VECTORS = {"xla_cpu_prefer_vector_width": 512}
# Its older emitters compile in two thirds of the time. What they make of the small kernels behind the
# clique and of certificates is as fast; the consistency graph would be three times slower. Newer JAX may
# not have them.
OLDER_EMITTERS = {"xla_cpu_use_fusion_emitters": False} if jax.__version_info__ < (0, 11) else {}
# On GPUs XLA picks kernels by a race, which takes a third of the compile time, wins nothing for products as
# small as ours, and may end differently, in its last bits too, in the next process.
UNTIMED_KERNELS = {"xla_gpu_autotune_level": 0}

OUT_OF_MEMORY = ("RESOURCE_EXHAUSTED", "out of memory")


def is_out_of_memory(error: Exception) -> bool:
    """Tell whether an error of JAX's runtime says that memory was not enough.

    Its type is the same for every failure and it carries no code, so its text is all there is to ask.
    """
    return isinstance(error, MemoryError) or any(
        words.lower() in str(error).lower() for words in OUT_OF_MEMORY
    )
