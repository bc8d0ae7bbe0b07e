"""Raw clouds beside KISS-Matcher and Open3D: recall, what ``ok`` is worth, displacements, time and memory."""

from __future__ import annotations

from collections import Counter
from itertools import groupby
from pathlib import Path

import numpy as np
from tqdm import tqdm

from benchmarks.baseline import Metric
from benchmarks.clouds.cases import FAMILIES, SCENE_NAMES, CloudPair, pairs
from benchmarks.clouds.kept import Kept, code
from benchmarks.clouds.methods import OURS, SILENT, Answer, asked, find_methods
from benchmarks.clouds.rates import SHARES, Rate, rates
from benchmarks.clouds.scenes import REPEATS, SLIDES
from benchmarks.clouds.timing import timed

RESULTS = Path(__file__).parents[1] / "results"
WANTED = {SCENE_NAMES[SLIDES]: "DEGENERATE", SCENE_NAMES[REPEATS]: "AMBIGUOUS"}  # NO_CONSENSUS elsewhere


def run(quick: bool) -> list[dict]:
    """A row a kind of pairs and method, then a row a timed pair and method; a row for missing peers.

    Answers are kept on the way: a run that ended goes on where it was, if the code is the same.
    """
    methods, missing = find_methods()
    RESULTS.mkdir(exist_ok=True)
    kept = Kept(RESULTS / f"clouds-{code():08x}.partial.jsonl", {"code": code()})
    rows: list[dict] = [{"part": "missing", "package": k, "why": v} for k, v in missing.items()]
    asked_about = pairs(quick)
    with tqdm(total=len(asked_about), disable=None) as bar:
        for kind, some in groupby(asked_about, key=lambda pair: pair.kind):
            answers: dict[str, list[tuple[CloudPair, Answer]]] = {name: [] for name in methods}
            for pair in some:
                bar.set_description(f"{kind}: {pair.name}")
                for name, method in methods.items():
                    if pair.truths or name not in SILENT:
                        if (key := (kind, pair.name, name)) not in kept.rows:
                            kept.add(key, asked(method, pair).as_row())
                        answers[name].append((pair, Answer.of_row(kept.rows[key])))
                bar.update()
            rows += [{"part": "asked", **_row(kind, name, known)} for name, known in answers.items() if known]
    rows += [{"part": "timed", **row} for row in timed(quick)]
    if not quick:
        kept.path.unlink()
    return rows


def _row(kind: str, method: str, answers: list[tuple[CloudPair, Answer]]) -> dict:
    """Count the answers of a method to the pairs of a kind."""
    right = [(p, a) for p, a in answers if a.pose is not None and p.is_right(a.pose)]
    off = np.array([p.displacement(a.pose) for p, a in right])
    far = [
        p.displacement(a.pose) > 2 * a.voxel for p, a in answers if p.truths and a.ok and a.pose is not None
    ]
    listed = sum(any(p.is_right(x) for x in (a.pose, *a.others) if x is not None) for p, a in answers)
    times = np.array([[a.wall, a.cpu] for _, a in answers if np.isfinite(a.wall)])
    return {
        "kind": kind,
        "method": method,
        "pairs": len(answers),
        "answers": sum(bool(p.truths) for p, _ in answers),
        "right": len(right),
        "right_or_equivalent": listed,
        "says_ok": method not in SILENT,
        "ok": sum(bool(a.ok) for _, a in answers),
        "ok_right": sum(bool(a.ok) for _, a in right),
        "ok_beyond_two_voxels": int(sum(far)),
        "displacement": [float(np.quantile(off, q)) for q in (0.5, 0.9)] if len(off) else None,
        "seconds": [float(x) for x in np.median(times, axis=0)] if len(times) else None,
        "statuses": dict(Counter(a.status for _, a in answers)),
        "status_right": sum(a.status == WANTED.get(kind, "NO_CONSENSUS") for _, a in answers),
        "wrong_ok": [p.name for p, a in answers if a.ok and (a.pose is None or not p.is_right(a.pose))],
    }


def _asked(rows: list[dict], method: str | None = None) -> list[dict]:
    return [r for r in rows if r["part"] == "asked" and method in (None, r["method"])]


def _methods(rows: list[dict]) -> list[str]:
    return list(dict.fromkeys(r["method"] for r in _asked(rows)))


def metrics(rows: list[dict]) -> list[Metric]:
    """Ours alone: recall by kind, the three rates, the right status; and times."""
    found = []
    for r in _asked(rows, OURS):
        if r["answers"]:
            share = r["right_or_equivalent"] / r["answers"]
            found.append(Metric(f"{r['kind']}: right", share, "share", "higher", 0.05))
        else:
            share = r["status_right"] / r["pairs"]
            found.append(Metric(f"{r['kind']}: right status", share, "share", "higher", 0.1))
    known = rates(_asked(rows, OURS))
    found.append(Metric("ok given a right answer", known.right.share, "share", "higher", 0.03))
    found.append(Metric("wrong ok", float(known.wrong.hits + known.none.hits), "pairs", "lower", 0.0))
    for r in rows:
        if r["part"] == "timed" and r["method"] == OURS:
            name = f"{r['kind']}, {r['pair']}"
            found.append(Metric(f"{name}: time", r["wall"], "s", "lower", 0.5, portable=False))
            found.append(Metric(f"{name}: memory", r["megabytes"], "MB", "lower", 0.3, portable=False))
    return found


def report(rows: list[dict]) -> str:
    """Recall, rates, displacements, statuses, time and memory."""
    places = sum(family.places for family in FAMILIES.values())
    lines = [
        "Raw clouds. Ours is given no parameter; KISS-Matcher and Open3D get a width of cells that suits",
        "the family, KISS-Matcher also the one that ours finds. Open3D runs FPFH, RANSAC or FGR, and ICP",
        "as its tutorial does; its normals look to the sensor where that is at the origin. KISS-Matcher's",
        "`ok` is `valid` and five final inliers, as its examples ask; Open3D says none. The real pairs are",
        f"few places ({places} in all, nine of them parts), and the limits below count pairs.",
    ]
    lines += [f"Left out: {r['package']} ({r['why']})." for r in rows if r["part"] == "missing"]
    for section in (_recall, _worth, _displacements, _statuses, _costs, _times, _memory):
        lines += ["", *section(rows)]
    return "\n".join(lines)


def _recall(rows: list[dict]) -> list[str]:
    names = _methods(rows)
    lines = [
        "Right answers of pairs that have one, and in brackets how many of them are called ok (+ wrong ones",
        "called ok). CAD to scan: `/` the listed pose among the pose and its equivalents.",
        "",
        f"| kind | {' | '.join(names)} |",
        "|---" * (len(names) + 1) + "|",
    ]
    for kind in dict.fromkeys(r["kind"] for r in _asked(rows) if r["answers"]):
        cells = [_recall_cell(r) for r in _asked(rows) if r["kind"] == kind]
        lines.append(f"| {kind} | {' | '.join(cells)} |")
    return lines


def _recall_cell(r: dict) -> str:
    more = f" / {r['right_or_equivalent']}" if r["right_or_equivalent"] > r["right"] else ""
    said = f" ({r['ok_right']} + {r['ok'] - r['ok_right']})" if r["says_ok"] else ""
    return f"{r['right']}{more} of {r['answers']}{said}"


def _worth(rows: list[dict]) -> list[str]:
    lines = [
        "What `ok` is worth: how often it is said, with limits of 95 % confidence each, and the precision",
        "that these rates mean where 0.9, 0.5 and 0.05 of the pairs have an answer (in brackets: at the",
        "worse limits of all three).",
        "",
        "| method | ok given a right answer | given a wrong one | given no answer | 0.9 | 0.5 | 0.05 |",
        "|---|---|---|---|---|---|---|",
    ]
    for name in _methods(rows):
        own = _asked(rows, name)
        if not any(r["says_ok"] for r in own):
            continue
        known = rates(own)
        precision = [f"{known.precision(s):.3f} ({known.least_precision(s):.3f})" for s in SHARES]
        right = f"{_said(known.right)}, above {known.right.low:.1%}"
        others = [f"{_said(rate)}, below {rate.high:.1%}" for rate in (known.wrong, known.none)]
        lines.append(f"| {name} | {right} | {' | '.join(others)} | {' | '.join(precision)} |")
    lines += ["", "By kind, ok of pairs without an answer:", ""]
    names = [n for n in _methods(rows) if any(r["says_ok"] for r in _asked(rows, n))]
    lines += [f"| kind | {' | '.join(names)} |", "|---" * (len(names) + 1) + "|"]
    for kind in dict.fromkeys(r["kind"] for r in _asked(rows) if not r["answers"]):
        cells = [
            f"{r['ok']} of {r['pairs']}" for r in _asked(rows) if r["kind"] == kind and r["method"] in names
        ]
        lines.append(f"| {kind} | {' | '.join(cells)} |")
    for name in names:
        wrong = [w for r in _asked(rows, name) for w in r["wrong_ok"]]
        if name == OURS and wrong:
            lines += ["", f"Wrong and ok by ours: {'; '.join(wrong)}."]
    return lines


def _said(rate: Rate) -> str:
    return f"{rate.hits} of {rate.of}"


def _displacements(rows: list[dict]) -> list[str]:
    names = _methods(rows)
    lines = [
        "How far right answers have the points of the overlap from where the given pose has them: median and",
        "90 % of pairs [mm]. The given poses of KITTI and of the kitchen are not exact themselves.",
        "",
        f"| kind | {' | '.join(names)} |",
        "|---" * (len(names) + 1) + "|",
    ]
    for kind in dict.fromkeys(r["kind"] for r in _asked(rows) if r["answers"]):
        found = [r["displacement"] for r in _asked(rows) if r["kind"] == kind]
        cells = ["none" if x is None else f"{1e3 * x[0]:.3g}, {1e3 * x[1]:.3g}" for x in found]
        lines.append(f"| {kind} | {' | '.join(cells)} |")
    beyond = sum(r["ok_beyond_two_voxels"] for r in _asked(rows, OURS))
    ok = sum(r["ok"] for r in _asked(rows, OURS) if r["answers"])
    return [*lines, "", f"Ours called ok and off by more than two voxels there: {beyond} of {ok}."]


def _statuses(rows: list[dict]) -> list[str]:
    lines = [
        "What ours says of pairs that have no answer. Wanted: DEGENERATE of what slides or turns, AMBIGUOUS",
        "of what repeats, NO_CONSENSUS of all else.",
        "",
        "| kind | as wanted | all |",
        "|---|---|---|",
    ]
    for r in _asked(rows, OURS):
        if not r["answers"]:
            every = ", ".join(f"{k} {v}" for k, v in sorted(r["statuses"].items()))
            lines.append(f"| {r['kind']} | {r['status_right']} of {r['pairs']} | {every} |")
    return lines


def _costs(rows: list[dict]) -> list[str]:
    names = _methods(rows)
    lines = [
        "Time of a call on all cores together, the median of a kind [s]; a new size of clouds compiles.",
        "",
        f"| kind | {' | '.join(names)} |",
        "|---" * (len(names) + 1) + "|",
    ]
    for kind in dict.fromkeys(r["kind"] for r in _asked(rows)):
        own = {r["method"]: r["seconds"] for r in _asked(rows) if r["kind"] == kind}
        cells = [f"{own[name][1]:.1f}" if own.get(name) else "" for name in names]
        lines.append(f"| {kind} | {' | '.join(cells)} |")
    return lines


def _times(rows: list[dict]) -> list[str]:
    lines = [
        "Time of a warm call, methods in turns, all cores; in brackets on all cores together.",
        "",
        "| pair | points | method | seconds | by stage [s] |",
        "|---|---|---|---|---|",
    ]
    for r in rows:
        if r["part"] == "timed":
            stages = ", ".join(f"{k} {v:.2f}" for k, v in r["stages"].items() if v >= 0.005)
            name = f"{r['kind']}: {r['pair']}"
            lines.append(
                f"| {name} | {r['points']} | {r['method']} | {r['wall']:.2f} ({r['cpu']:.2f}) | {stages} |"
            )
    return lines


def _memory(rows: list[dict]) -> list[str]:
    lines = [
        "Peak of memory above that before the call [MB]; for ours also by step.",
        "",
        "| pair | method | MB | by step |",
        "|---|---|---|---|",
    ]
    for r in rows:
        if r["part"] == "timed":
            steps = ", ".join(f"{k} {v:.0f}" for k, v in r["stage_megabytes"].items())
            lines.append(f"| {r['kind']}: {r['pair']} | {r['method']} | {r['megabytes']:.0f} | {steps} |")
    return lines
