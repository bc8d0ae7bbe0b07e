"""A page with an answer to two clouds that a browser turns: one file, which asks no network for anything.

plotly draws it through WebGL. Points are float32 about the middle of the target, and squares: two triangles
each, where a disk has dozens and takes four times as long.
"""

from __future__ import annotations

import json
from html import escape
from pathlib import Path
from string import Template
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from teaser_jax.clouds.registration import CloudRegistration
from teaser_jax.ground.io import replacing
from teaser_jax.plots.scene import ALONE, RAMP, SATURATED, Laid, Scene, scene_of
from teaser_jax.plots.style import BAD, DST, GOOD, SRC

MOST_POINTS = 50_000  # of each cloud
MOST_LINES = 300  # right and wrong ones each
POINT, LINE = 0.7, 1.5  # about three pixels, and one
FAR = 1.15  # of the eye from the middle, in diagonals of what is shown: all of it can be seen
GRAY = "#8a909a"  # of axes: it can be read on white and on black
SIDES = {"oblique": (0.0, -0.8, 0.7), "above": (0.0, 0.0, 1.0), "side": (0.0, -1.0, 0.0)}  # right, back, up


class Layer(NamedTuple):
    """What one button shows and hides.

    Attributes:
        name: What it says.
        color: The color beside it, in the words of CSS.
        traces: What is drawn, in the words of plotly.
        visible: Whether it is shown at first.
    """

    name: str
    color: str
    traces: tuple[dict[str, Any], ...]
    visible: bool

    @property
    def box(self) -> Float[np.ndarray, "2 3"]:
        """The lower and the upper corner around it [length]."""
        points = np.array([np.concatenate([trace[axis] for trace in self.traces]) for axis in "xyz"])
        return np.stack([np.nanmin(points, axis=1), np.nanmax(points, axis=1)]).astype(float)


AXIS = {
    "showbackground": False, "showspikes": False, "showgrid": False, "zeroline": False, "showline": True,
    "color": GRAY, "linecolor": GRAY, "tickfont": {"size": 10}, "nticks": 6,
}  # fmt: skip


def write_view(path: str | Path, result: CloudRegistration, *, title: str = "Two clouds") -> Path:
    """Write the page of ``view``, whole or not at all.

    Args:
        path: Where to.
        result: The answer of ``register_clouds``.
        title: What to call it.

    Returns:
        The path.

    Raises:
        ImportError: Without the extra ``viz``.
        OSError: If it cannot be written.
    """
    path, text = Path(path), view(result, title=title)
    with replacing(path) as partial:
        partial.write_text(text, encoding="utf-8")
    return path


def view(result: CloudRegistration, *, title: str = "Two clouds") -> str:
    """Make a page that shows an answer in three dimensions, with the words that ``print`` writes beside it.

    The target, the source before (beside the target, turned as given) and after, up to three
    ``equivalent`` poses, and the matches have a button each. Colors after are those of ``plot_clouds``. Of
    each cloud 50 000 points are drawn at most, spread evenly. The page has 5 MB of program and 16 to 22 bytes
    for each point of each layer; it loads nothing, and its own policy forbids it to.

    Args:
        result: The answer of ``register_clouds``.
        title: What to call it.

    Returns:
        The text of an HTML file.

    Raises:
        ImportError: Without the extra ``viz``.
    """
    scene = scene_of(result, MOST_POINTS)
    layers = _layers(scene, len(result.equivalent))
    drawing = _figure(layers, scene).to_html(
        full_html=False, include_plotlyjs=True, div_id="view",
        default_width="100%", default_height="100%",
        config={"displaylogo": False, "responsive": True, "displayModeBar": False},
    )  # fmt: skip
    return Template(PAGE).substitute(
        title=escape(title),
        verdict="ok" if result.ok else "bad",
        words="".join(f"<span>{escape(line)}</span>" for line in repr(result).splitlines()),
        buttons="\n".join(_buttons(layers)),
        sides="\n".join(_sides(scene.axes)),
        colors=_legend(scene),
        drawing=drawing,
    )


def _layers(scene: Scene, rivals: int) -> list[Layer]:
    """List what can be shown, the uppermost button first."""
    layers = [
        Layer("target", DST, (_points(scene.target, DST),), True),
        Layer("source before", SRC, (_points(scene.before, SRC),), scene.after is None),
    ]
    ramp = f"linear-gradient(90deg, {', '.join(RAMP)})"
    if scene.after is not None:
        layers.append(Layer("source after", ramp, _laid(scene.after, scene.voxel_size), True))
    for k, laid in enumerate(scene.rivals, 1):
        name = f"other pose {k} of {rivals}: {laid.words}"
        layers.append(Layer(name, ramp, _laid(laid, scene.voxel_size), False))
    matches = scene.matches
    for name, color, rows in (("inliers", GOOD, matches.inliers), ("other matches", BAD, ~matches.inliers)):
        if rows.any():
            drawn = _lines(matches.src, matches.dst, rows, color)
            layers.append(Layer(f"{name} ({rows.sum()})", color, (drawn,), False))
    return layers


def _figure(layers: list[Layer], scene: Scene) -> Any:
    graph = _plotly()
    figure = graph.Figure()
    for layer in layers:
        for trace in layer.traces:
            figure.add_trace(graph.Scatter3d(**trace, name=layer.name, visible=layer.visible))
    boxes = np.stack([layer.box for layer in layers if layer.visible])
    low, high = boxes[:, 0].min(axis=0), boxes[:, 1].max(axis=0)
    ratio = (high - low) / np.linalg.norm(high - low)  # equal axes, one diagonal wide
    axes = {
        f"{name}axis": AXIS | {"title": {"text": name}, "range": [low[k], high[k]]}
        for k, name in enumerate("xyz")
    }
    figure.update_layout(
        margin=dict.fromkeys("lrtb", 0), paper_bgcolor="rgba(0,0,0,0)", showlegend=False, hovermode=False,
        uirevision="kept", scene={
            "aspectmode": "manual", "aspectratio": dict(zip("xyz", ratio, strict=True)), "dragmode": "orbit",
            "bgcolor": "rgba(0,0,0,0)", "camera": _camera(scene.axes, "oblique"), **axes,
        },
    )  # fmt: skip
    return figure


def _points(points: Float[np.ndarray, "n 3"], color: Any, **marker: Any) -> dict[str, Any]:
    """Say how plotly draws points."""
    x, y, z = points.astype(np.float32).T.copy()
    look = {"size": POINT, "symbol": "square", "color": color, "line": {"width": 0}, **marker}
    return {"x": x, "y": y, "z": z, "mode": "markers", "marker": look, "hoverinfo": "skip"}


def _laid(laid: Laid, voxel_size: float) -> tuple[dict[str, Any], ...]:
    """Say how plotly draws a cloud that lies on the target: points with a partner, and those without."""
    paired, stops = laid.paired, np.linspace(0, 1, len(RAMP)).tolist()
    return (
        _points(
            laid.points[paired], laid.distance[paired].astype(np.float32),
            cmin=0, cmax=SATURATED * voxel_size, colorscale=list(zip(stops, RAMP, strict=True)),
        ),
        _points(laid.points[~paired], ALONE),
    )  # fmt: skip


def _lines(
    src: Float[np.ndarray, "m 3"], dst: Float[np.ndarray, "m 3"], rows: Bool[np.ndarray, " m"], color: str
) -> dict[str, Any]:
    """Say how plotly draws lines, in one trace: what is no number parts them."""
    drawn = np.random.default_rng(0).permutation(np.flatnonzero(rows))[:MOST_LINES]
    ends = np.stack([src[drawn], dst[drawn], np.full((len(drawn), 3), np.nan)], axis=1)
    x, y, z = ends.reshape(-1, 3).astype(np.float32).T.copy()
    look = {"color": color, "width": LINE}
    return {"x": x, "y": y, "z": z, "mode": "lines", "line": look, "hoverinfo": "skip"}


def _camera(axes: Float[np.ndarray, "3 3"], side: str) -> dict[str, Any]:
    """Place the eye on a side of the overlap."""
    towards = np.array(SIDES[side])
    up = axes[1] if side == "above" else axes[2]
    place = FAR * (towards / np.linalg.norm(towards)) @ axes
    return {key: dict(zip("xyz", x.tolist(), strict=True)) for key, x in (("eye", place), ("up", up))}


def _buttons(layers: list[Layer]) -> list[str]:
    """Write a button for each layer, which knows the traces that it shows and the box around them."""
    ends = np.cumsum([0, *(len(layer.traces) for layer in layers)])
    return [
        f'<button data-traces="{list(range(low, high))}" data-box="{layer.box.tolist()}" '
        f'aria-pressed="{str(layer.visible).lower()}"><i style="background:{layer.color}"></i>'
        f"{escape(layer.name)}</button>"
        for low, high, layer in zip(ends[:-1], ends[1:], layers, strict=True)
    ]


def _sides(axes: Float[np.ndarray, "3 3"]) -> list[str]:
    """Write a button for each side that the clouds can be seen from."""
    return [
        f'<button data-camera="{escape(json.dumps(_camera(axes, side)))}">{side}</button>' for side in SIDES
    ]


def _legend(scene: Scene) -> str:
    """Say what the colors of the source mean."""
    if scene.after is None:
        return ""
    two = f"{SATURATED * scene.voxel_size:.3g}"
    return Template(COLORS).substitute(ramp=", ".join(RAMP), two=two, alone=ALONE)


def _plotly() -> Any:
    try:
        import plotly.graph_objects
    except ImportError:
        raise ImportError("pages need plotly: pip install 'teaser-jax[viz]'") from None
    return plotly.graph_objects


COLORS = """<h2>distance to the target</h2>
<div class="ramp" style="background:linear-gradient(90deg, $ramp)"></div>
<p class="ends"><span>0</span><span>$two (two voxels) and more</span></p>
<p><i style="background:$alone"></i>further than three voxels: no partner</p>"""

PAGE = """<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta http-equiv="Content-Security-Policy" content="default-src 'none'; script-src 'unsafe-inline'; \
style-src 'unsafe-inline'; img-src data: blob:">
<title>$title</title>
<style>
:root { color-scheme: light dark; --ink: #30343b; --paper: #ffffff; --line: #d8dbe0; --pale: #f1f3f6; }
@media (prefers-color-scheme: dark) {
  :root { --ink: #dfe3e8; --paper: #15181c; --line: #353a42; --pale: #22262c; }
}
* { box-sizing: border-box; }
body { margin: 0; height: 100vh; display: flex; font: 14px/1.45 system-ui, sans-serif; color: var(--ink);
  background: var(--paper); }
aside { width: 380px; flex: none; overflow: auto; padding: 16px; border-right: 1px solid var(--line); }
main { flex: 1; min-width: 0; position: relative; }
.sides { position: absolute; top: 12px; right: 12px; z-index: 1; }
.hint { margin-top: 18px; opacity: 0.7; }
h1 { font-size: 17px; margin: 0 0 8px; overflow-wrap: anywhere; }
h2 { font-size: 13px; margin: 18px 0 6px; font-weight: 600; }
p { margin: 4px 0; }
pre { font: 11.5px/1.5 ui-monospace, monospace; white-space: pre-wrap; padding: 10px; margin: 0;
  background: var(--pale); border-left: 4px solid $$good; }
pre span { display: block; padding-left: 4ch; text-indent: -4ch; }
pre.bad { border-color: $$bad; }
button { font: inherit; color: inherit; background: none; border: 1px solid var(--line); border-radius: 6px;
  padding: 4px 10px; cursor: pointer; }
.layers button { display: flex; align-items: baseline; width: 100%; text-align: left; margin: 4px 0; }
.layers button[aria-pressed=true] { background: var(--pale); border-color: currentColor; }
.layers button[aria-pressed=false] { opacity: 0.6; }
i { flex: none; display: inline-block; width: 11px; height: 11px; border-radius: 3px; margin-right: 8px; }
.ramp { height: 10px; border-radius: 3px; }
.ends { display: flex; justify-content: space-between; font-size: 12px; }
@media (max-width: 700px) {
  body { flex-direction: column-reverse; height: auto; }
  main { height: 70vh; flex: none; } aside { width: auto; border: 0; }
}
</style>
</head>
<body>
<aside>
<h1>$title</h1>
<pre class="$verdict">$words</pre>
<h2>shown</h2>
<div class="layers">
$buttons
</div>
$colors
<p class="hint">Drag to turn, scroll to come nearer, drag with the right button to move.</p>
</aside>
<main>
<div class="sides">
$sides
</div>
$drawing
</main>
<script>
const buttons = [...document.querySelectorAll("[data-traces]")];
// Equal axes around all that is shown, one diagonal wide, so that the eye keeps its place.
function around() {
  const boxes = buttons.filter(x => x.ariaPressed === "true").map(x => JSON.parse(x.dataset.box));
  const layout = {}, spans = [];
  for (const [k, name] of ["x", "y", "z"].entries()) {
    const low = Math.min(...boxes.map(x => x[0][k])), high = Math.max(...boxes.map(x => x[1][k]));
    layout[`scene.$${name}axis.range`] = [low, high];
    spans.push(high - low);
  }
  const [x, y, z] = spans.map(span => span / Math.hypot(...spans));
  return { ...layout, "scene.aspectratio": { x, y, z } };
}
for (const button of buttons) button.onclick = () => {
  const on = button.ariaPressed !== "true";
  button.ariaPressed = String(on);
  const layout = buttons.some(x => x.ariaPressed === "true") ? around() : {};
  Plotly.update("view", { visible: on }, layout, JSON.parse(button.dataset.traces));
};
for (const button of document.querySelectorAll("[data-camera]")) button.onclick = () =>
  Plotly.relayout("view", { "scene.camera": JSON.parse(button.dataset.camera) });
</script>
</body>
</html>
""".replace("$$good", GOOD).replace("$$bad", BAD)
