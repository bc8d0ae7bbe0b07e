"""What methods look like: the same in every figure, and none behind another."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from teaser_jax.studies import figures, studies
from teaser_jax.studies.looks import KNOWN, look_of
from teaser_jax.studies.results import Results

ABOUT = {"model": "teapot", "seed": 0}
MINE = "my method"
PEERS = [name for name in KNOWN if "Open3D" in name or name in ("kiss-matcher", "TEASER++")]


def table(methods, values=(0.0, 0.5, 0.9)):
    """Make results in which everybody is always right."""
    right = {"rotation_deg": 1.0, "translation": 0.01, "seconds": 0.001}
    rows = [
        {"outlier_rate": v, "trial": 0.0, "method": m, **right} for v, m in itertools.product(values, methods)
    ]
    return Results(studies()["known-scale"], ABOUT, rows)


def looks_in(picture):
    """Read the legend: the colour and the marker of each method."""
    return {
        each.get_label(): (each.get_color(), each.get_marker()) for each in picture.legends[0].legend_handles
    }


def test_every_method_of_a_study_has_a_look_of_its_own():
    for study in studies().values():
        looks = [KNOWN[method.name] for method in study.methods]
        assert len(set(looks)) == len(looks)
    together = {*PEERS, *(method.name for method in studies()["known-scale"].methods)}
    assert len({KNOWN[name] for name in together}) == len(together)
    assert {look.marker for look in map(look_of, (*KNOWN, MINE))} <= set(figures.SYMBOLS)


@pytest.mark.long
def test_a_method_looks_the_same_whoever_else_is_there_and_in_whatever_order():
    everyone = ["teaser_jax", "teaser_jax, global", *PEERS, MINE, "a second of mine"]
    whole = looks_in(figures._picture(table(everyone)))
    assert len(set(whole.values())) == len(everyone)
    for some in (everyone[::-1], everyone[1::2], ["Open3D ICP", MINE], [MINE]):
        assert looks_in(figures._picture(table(some))) == {name: whole[name] for name in some}


@pytest.mark.long
def test_curves_that_coincide_do_not_hide_one_another():
    values = studies()["known-scale"].values
    everyone = [m.name for m in studies()["known-scale"].methods if "Open3D" not in m.name]
    picture = figures._picture(table([*everyone, *(n for n in PEERS if n not in everyone), MINE], values))
    picture.draw_without_rendering()
    axes = picture.axes[-1]
    marked = [line for line in axes.lines if line.get_marker() not in ("None", "", None)]
    across = np.sort(np.concatenate([axes.transData.transform(line.get_xydata())[:, 0] for line in marked]))
    assert len(across) == len(values) * len(picture.legends[0].legend_handles)
    size = marked[0].get_markersize() * picture.dpi / 72
    assert np.diff(across).min() > 0.8 * size
    assert size > 3
