"""``python -m teaser_jax`` is ``teaser-jax``."""

import sys

from teaser_jax.cli import main

sys.exit(main())
