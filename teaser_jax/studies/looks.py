"""What a method looks like: a colour and a marker that follow from its name, the same in every figure."""

from __future__ import annotations

from typing import NamedTuple
from zlib import crc32

from teaser_jax.plots.style import BAD, DST, GOOD, INK, SRC
from teaser_jax.studies.methods import LIMIT, OURS


class Look(NamedTuple):
    """A ``Look`` is a colour, and a marker in the words of matplotlib."""

    color: str
    marker: str


GREY, SKY, NAVY, MINT, STEEL, TEAL = "#8d949e", "#6fa8dc", "#17415f", "#7cc79f", "#5b7f95", "#149a9a"
DEFAULT, VARIANT, GLOBAL, RELAXED = Look(GOOD, "o"), Look(DST, "s"), Look(SKY, "^"), Look(NAVY, "D")
# Ours are cool and others warm. What is the same step alone and in the whole method looks the same.
KNOWN = {
    LIMIT: Look(GREY, "d"),
    "before pruning": Look(GREY, "d"),
    OURS: DEFAULT,
    "TLS": DEFAULT,
    "maximum clique": DEFAULT,
    "GNC": DEFAULT,
    "GNC, certified": DEFAULT,
    f"{OURS}, cascade": VARIANT,
    "greedy": VARIANT,
    f"{OURS}, global": GLOBAL,
    "global search": GLOBAL,
    f"{OURS}, sdp": RELAXED,
    "semidefinite relaxation": RELAXED,
    "GNC, certified by Algorithm 3 as printed": RELAXED,
    f"{OURS}, one by one": Look(MINT, "v"),
    f"{OURS}, consensus maximisation": Look(STEEL, "<"),
    "consensus maximisation": Look(STEEL, "<"),
    f"{OURS}, stage by stage": Look(TEAL, ">"),
    "kiss-matcher": Look(SRC, "P"),
    "TEASER++": Look(INK, "X"),
    "Open3D RANSAC-1k": Look(BAD, "p"),
    "Open3D RANSAC-10k": Look("#d17fa8", "h"),
    "Open3D RANSAC-60s": Look("#8e5ea2", "d"),
    "Open3D FGR": Look("#9c6b3f", "s"),
    "Open3D ICP": Look("#d9a520", "^"),
}
STRANGE_COLORS = ("#d6006c", "#5e35b1", "#00a3c4", "#7a8b00", "#b3261e", "#3b2a1a", "#ff7043")
STRANGE_MARKERS = ("*", "X", "P", "H", "D")


def look_of(method: str) -> Look:
    """Return the look of a method, whoever else is in the figure.

    That of a method nobody knows here, as one whose answers a user scores, follows from the checksum of its
    name; two of them are alike by chance once in 35 times, and another name gives another look.
    """
    if method in KNOWN:
        return KNOWN[method]
    number = crc32(method.encode())
    colors = len(STRANGE_COLORS)
    return Look(STRANGE_COLORS[number % colors], STRANGE_MARKERS[number // colors % len(STRANGE_MARKERS)])
