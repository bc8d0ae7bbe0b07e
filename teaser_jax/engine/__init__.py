"""How the method runs outside jit: frames, precision, padded sizes, packing, programs, batches, processes."""
