"""What is known of each pair, kept line by line, so that whatever ends a run, the same command goes on."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

import teaser_jax as tj
from benchmarks.verdict.pairs import RIGHT, Pair, pairs


def record(path: Path, count: int, *, viewpoints: bool) -> list[dict[str, Any]]:
    """Register all pairs of so many places of each kind, but for those that the file has already.

    Args:
        path: A line of JSON for each pair.
        count: Places of each kind.
        viewpoints: Whether to tell where the sensors stood.
    """
    rows = [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []
    done = {row["name"] for row in rows}
    with path.open("a") as file:
        for pair in tqdm(pairs(count), unit="pair", disable=None):
            if pair.name not in done:
                rows.append(_row(pair, viewpoints))
                file.write(json.dumps(rows[-1]) + "\n")
                file.flush()
    return rows


def _row(pair: Pair, viewpoints: bool) -> dict[str, Any]:
    eyes = dict(src_viewpoint=pair.src_viewpoint, dst_viewpoint=pair.dst_viewpoint) if viewpoints else {}
    found = tj.register_clouds(pair.src, pair.dst, **eyes)
    row: dict[str, Any] = dict(kind=pair.kind, place=pair.place, name=pair.name)
    row.update(status=found.status.name, doubt=found.doubt, seconds=sum(found.seconds.values()))
    e = found.evidence
    if e is None:
        return row | dict(answer=pair.truth is not None, right=False, evidence=None)
    near = RIGHT * e.voxel_size
    off = pair.displacement(found.pose, near)
    row["pose"] = found.T_dst_src.tolist()
    row.update(answer=bool(np.isfinite(off)), off=off / e.voxel_size, right=bool(off < near))
    row["evidence"] = dict(
        cells=e.cells, fit=e.fit, fine_fit=e.fine_fit, overlap=e.overlap, support=e.support,
        in_front=e.in_front, visible=e.seen.visible.tolist(), equal=e.rivals.equal,
        rival_fit=e.rivals.fit, lead=e.rivals.lead.share, against=min(e.rivals.lead.against, 1e9),
        displacement=e.displacement / e.voxel_size, beyond_planes=e.beyond_planes, agreement=found.agreement,
        candidates=len(found.candidates),
    )  # fmt: skip
    return row
