"""The README's examples run as they stand, one after the other."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

pytest.importorskip("small_gicp", reason="needs the extra clouds")

README = Path(__file__).parents[1] / "README.md"


@pytest.mark.long
def test_the_examples_run(capsys):
    blocks = re.findall(r"```python\n(.*?)```", README.read_text(), re.DOTALL)
    assert len(blocks) == 7
    names: dict = {}
    for block in blocks:
        exec(block, names)
    assert names["found"].ok
    assert names["result"].ok
    assert names["answer"].ok
    assert names["batch"].ok.all()
    assert names["stacked"].ok.mean() > 0.9
    assert names["certificate"].is_optimal
    said = capsys.readouterr().out
    assert "ok: OK" in said
    assert "clique, host" in said
