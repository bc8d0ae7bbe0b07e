"""What the import hook of jaxtyping asks about every annotation of the package (see ``conftest.py``)."""

from __future__ import annotations

from beartype import BeartypeConf, beartype

# As type checkers do (PEP 484): a whole number may stand where a float is asked for.
checked = beartype(conf=BeartypeConf(is_pep484_tower=True))
