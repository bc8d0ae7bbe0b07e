"""Files that were damaged and command lines that were mistyped, for the fuzz."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from fuzzing import BOUND, draw_pose, noise, seeds


def _good_files(folder: Path) -> dict[str, bytes]:
    """One file of each kind that can be read."""
    rng = np.random.default_rng(0)
    src = rng.normal(size=(20, 3))
    truth = draw_pose(rng)
    dst = truth.apply(src) + noise(rng, 20)
    table, good = np.hstack([src, dst]), folder / "good"
    good.mkdir()
    more = {"noise_bound": BOUND, "scale": 1.0, "mask": np.ones(20, bool), "T_dst_src": truth.matrix}
    np.savez(good / "all.npz", src=src, dst=dst, **more)
    np.savez_compressed(good / "small.npz", src=src, dst=dst)
    np.save(good / "table.npy", table)
    np.save(good / "model.npy", src)
    np.savetxt(good / "table.txt", table)
    np.savetxt(good / "table.csv", table, delimiter=",", header="a,b,c,d,e,f", comments="")
    np.savetxt(good / "table.tsv", table, delimiter="\t")
    comma = "\n".join(";".join(f"{x:.4f}".replace(".", ",") for x in row) for row in table)
    (good / "comma.dat").write_text(comma)
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], float)
    faces = [[0, 1, 2], [0, 1, 3], [0, 2, 3], [1, 2, 3]]
    ply = "ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\n"
    ply += "element face 4\nproperty list uchar int vertex_indices\nend_header\n"
    rows = "".join(f"{x:g} {y:g} {z:g}\n" for x, y, z in corners)
    listed = "".join(f"3 {i} {j} {k}\n" for i, j, k in faces)
    (good / "model.ply").write_text(ply + rows + listed)
    (good / "model.off").write_text(f"OFF\n4 4 0\n{rows}{listed}")
    obj = "".join(f"v {x:g} {y:g} {z:g}\n" for x, y, z in corners)
    (good / "model.obj").write_text(obj + "".join(f"f {i + 1} {j + 1} {k + 1}\n" for i, j, k in faces))
    return {path.name: path.read_bytes() for path in sorted(good.iterdir())}


WORDS = [
    b"nan", b"inf", b"-", b"", b",", b";", b"\t", b"\n", b"\r\n", b"\0", b"x", b"1e999", b"1,5", b"#", b'"',
    b"\xff", b"\xef\xbb\xbf", b"99999999999", b"0", b"-1", b" ", "\u00b2".encode(), b"True", b"None", b"1_0",
]  # fmt: skip


def _mutated(rng: np.random.Generator, data: bytes) -> bytes:
    """Change a file in one to three places."""
    for _ in range(rng.integers(1, 4)):
        a, b = sorted(rng.integers(0, len(data) + 1, 2))
        near = min(b, a + int(rng.integers(1, 9)))
        word = WORDS[rng.integers(len(WORDS))]
        changes = [
            data[:a], data[:a] + data[b:], data[:a] + data[near:], data[:a] + word + data[near:],
            data[:a] + word + data[a:], data[:a] + data[a:b] + data[a:], data[a:b],
            data[:a] + rng.bytes(near - a) + data[near:],
            data.replace(b" " if rng.random() < 0.5 else b",", word), data.replace(b"\n", word),
        ]  # fmt: skip
        data = changes[rng.integers(len(changes))][:20_000]
    return data


def broken_files(door: int, count: int, folder: Path) -> Iterator[tuple[Path, str]]:
    """Write files that were changed, each over the one before, and say what each was to be."""
    good = _good_files(folder)
    for rng in seeds(door, count):
        name = list(good)[rng.integers(len(good))]
        data = good[name] if rng.random() < 0.05 else _mutated(rng, good[name])
        path = folder / f"changed{Path(name).suffix}"
        path.write_bytes(data)
        yield path, "model" if name.startswith("model") else "matches"


# The command line

COMMANDS = [
    ["register", "good/all.npz"],
    ["register", "good/small.npz", "--noise-bound", "0.05"],
    ["register", "good/table.csv", "--noise-bound", "0.05", "--json"],
    ["register", "good/table.txt", "--noise-bound", "0.05", "--scale", "estimate"],
    ["register", "good/comma.dat", "--noise-bound", "0.05", "--clique", "greedy"],
    ["register", "wrong.csv", "--noise-bound", "0.05", "-o", "pose.txt"],
    ["register", "good/table.npy", "--noise-bound", "0.05", "--clique-seconds", "1", "--no-refine"],
    ["register", "good/model.ply", "--noise-bound", "0.05"],
    ["demo", "--plot", "nowhere/demo.png", "--seed", "1"],
    ["study", "nothing", "--runs", "1", "--seed", "2", "--folder", "f", "--method", "m", "--quick"],
]
TOKENS = [
    "", "-", "--", "0.05", "-1", "0", "nan", "inf", "1e400", "x", "estimate", "exact", "greedy", "nonsense",
    "--noise", "--noise-bound", "--noise_bound", "--scale", "--cbar2", "--json", "--certify", "--help",
    "--version", "-o", "--output", "pose.txt", "good", "good/all.npz", "nothing.npz", "a\0b", "n" * 300,
    "--no-refine", "--clique", "--clique-nodes", "--clique-seconds", "--plot", "x.gif", "nowhere/x.png",
    "--seed", "--scale=2", "--noise-bound=", "--json=1", "\u00e4", "\n", "%s", "{}", "@x", "-h", "9" * 5000,
]  # fmt: skip


def argument_lists(door: int, count: int, folder: Path) -> Iterator[list[str]]:
    """Argument lists typed in a hurry; none asks for a picture or a study, which take their time."""
    _good_files(folder)
    rng = np.random.default_rng(0)
    np.savetxt(folder / "wrong.csv", rng.normal(size=(20, 6)), delimiter=",")
    for rng in seeds(door, count):
        given = list(COMMANDS[rng.integers(len(COMMANDS))])
        for _ in range(rng.choice([0, 1, 1, 1, 2, 3])):
            k, token = int(rng.integers(0, len(given) + 1)), TOKENS[rng.integers(len(TOKENS))]
            change = rng.integers(5)
            if change == 0:
                given.insert(k, token)
            elif change == 1:
                given[k : k + 1] = [token]
            elif change == 2:
                del given[k : k + 1]
            elif change == 3:
                given[k:k] = given[k : k + 2]
            else:
                given[k : k + 1] = [x[: int(rng.integers(1, len(x) + 1))] for x in given[k : k + 1] if x]
        if given[:1] != ["study"] or "nothing" in given[1:2]:
            yield given
