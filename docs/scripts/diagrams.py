"""Draws the block diagrams of the concept pages, and how often names of a diagnosis are true, as SVG: python
docs/scripts/diagrams.py [out=docs/media]."""

from __future__ import annotations

import html
import json
import sys
from collections.abc import Sequence
from pathlib import Path

from dexsim.intervals import share

ROOT = Path(__file__).resolve().parents[2]
WIDE, TALL, GAP = 150, 58, 34  # pixels: of a box, and between boxes
INK, FILL, LINE = "#1c2733", "#e6f1f3", "#35808d"
STYLE = f"font-family:sans-serif;font-size:13px;fill:{INK}"

Box = tuple[int, int, str]  # column, row, text with lines separated by |


def svg(boxes: dict[str, Box], arrows: Sequence[tuple[str, str]], title: str) -> str:
    """Return a diagram: boxes by name on a grid, arrows (from, to) along rows or columns."""
    columns, rows = (1 + max(b[k] for b in boxes.values()) for k in (0, 1))
    width, height = columns * (WIDE + GAP) + GAP, rows * (TALL + GAP) + GAP
    out = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" role="img">',
        f"<title>{html.escape(title)}</title>",
        f'<rect width="{width}" height="{height}" fill="#ffffff"/>',
        '<defs><marker id="a" viewBox="0 0 8 8" refX="7" refY="4" markerWidth="7" markerHeight="7" orient="auto">'
        f'<path d="M0,0 L8,4 L0,8 z" fill="{LINE}"/></marker></defs>',
    ]

    def corner(name: str) -> tuple[int, int]:
        column, row, _ = boxes[name]
        return GAP + column * (WIDE + GAP), GAP + row * (TALL + GAP)

    for a, b in arrows:
        (x0, y0), (x1, y1) = corner(a), corner(b)
        if y0 == y1:
            middle = y0 + TALL // 2
            path = f"M{x0 + WIDE},{middle} L{x1},{middle}" if x1 > x0 else f"M{x0},{middle} L{x1 + WIDE},{middle}"
        else:
            middle = x0 + WIDE // 2
            path = f"M{middle},{y0 + TALL} L{middle},{y1}" if y1 > y0 else f"M{middle},{y0} L{middle},{y1 + TALL}"
        out.append(f'<path d="{path}" fill="none" stroke="{LINE}" stroke-width="1.8" marker-end="url(#a)"/>')
    for name, (_, _, text) in boxes.items():
        x, y = corner(name)
        out.append(
            f'<rect x="{x}" y="{y}" width="{WIDE}" height="{TALL}" rx="7" fill="{FILL}" stroke="{LINE}"'
            ' stroke-width="1.5"/>'
        )
        lines = text.split("|")
        for k, line in enumerate(lines):
            at = y + TALL // 2 + 5 + 15 * k - 15 * (len(lines) - 1) // 2
            weight = ";font-weight:bold" if k == 0 else ";font-size:11px"
            out.append(
                f'<text x="{x + WIDE // 2}" y="{at}" text-anchor="middle" style="{STYLE}{weight}">'
                f"{html.escape(line)}</text>"
            )
    return "\n".join([*out, "</svg>"]) + "\n"


def servo() -> str:
    """Return the block diagram of the servo."""
    boxes = {
        "target": (0, 0, "target|joint angle"),
        "delay": (1, 0, "delay|delay"),
        "loop": (2, 0, "control loop|kp, kd, deadband"),
        "motor": (3, 0, "motor|torque_limit,|no_load_speed, sag"),
        "lag": (4, 0, "lag|lag"),
        "gear": (4, 1, "gear|efficiency, ripple,|friction"),
        "joint": (3, 1, "joint|backlash, softness,|MuJoCo"),
        "encoder": (2, 1, "encoder|scale, offset"),
    }
    order = ("target", "delay", "loop", "motor", "lag", "gear", "joint", "encoder", "loop")
    arrows = list(zip(order, order[1:], strict=False))
    return svg(boxes, arrows, "The servo")


def task() -> str:
    """Return the data flow of a control step."""
    boxes = {
        "observe": (0, 0, "observations|joints, touch, command"),
        "policy": (1, 0, "policy|PPO, 12 actions"),
        "targets": (2, 0, "joint targets"),
        "servo": (3, 0, "servo|params[world, joint,|column]"),
        "physics": (4, 0, "physics|MuJoCo, K steps"),
        "touch": (4, 1, "touch|600 taxels"),
        "rewards": (3, 1, "rewards, ends|a named term each"),
        "reset": (0, 1, "reset|new object, drives"),
    }
    order = ("observe", "policy", "targets", "servo", "physics", "touch", "rewards", "reset", "observe")
    arrows = list(zip(order, order[1:], strict=False))
    return svg(boxes, arrows, "Data flow of a control step")


def reality() -> str:
    """Return how a policy is judged in a reality that its training has not seen."""
    boxes = {
        "believed": (0, 0, "believed simulator|training's physics"),
        "training": (1, 0, "training|randomized worlds"),
        "policy": (2, 0, "policy|a checkpoint"),
        "play": (3, 0, "play|reality=NAME"),
        "judged": (4, 0, "judged|held, force, turns"),
        "real": (3, 1, "reality|other physics, drawn|once from a seed"),
        "record": (2, 1, "recordings|as the bus reads"),
        "diagnose": (1, 1, "diagnose|names what differs"),
        "fit": (0, 1, "servo.yaml|what was found"),
    }
    arrows = [("believed", "training"), ("training", "policy"), ("policy", "play"), ("play", "judged"),
              ("real", "play"), ("real", "record"), ("record", "diagnose"), ("diagnose", "fit"),
              ("fit", "believed")]  # fmt: skip
    return svg(boxes, arrows, "A reality: judged in it, diagnosed from it")


def assumptions() -> str:
    """Return where the figures of the simulated hand come from."""
    boxes = {
        "read": (0, 0, "published|xHand v1.3: masses,|limits, efforts"),
        "measured": (1, 0, "one read-back|a real finger: kp, kd"),
        "ours": (2, 0, "chosen by us|rubber, friction, noise,|PPO, weights"),
        "model": (0, 1, "hand model"),
        "servo": (1, 1, "servo table"),
        "ranges": (2, 1, "randomized ranges|each world its own"),
    }
    return svg(boxes, [("read", "model"), ("measured", "servo"), ("ours", "ranges")], "Where the figures come from")


BINS = "names of each tenth of confidence that are true"
SIDE, LEFT = 300, 46  # pixels: of the diagram, and from the edge to its axis


def calibration(given: str) -> str:
    """Return the reliability diagram: the share of names that are true, with its 90 % interval, by confidence. given:
    "true/named" of each tenth, separated by commas."""
    at = lambda x: LEFT + SIDE * x  # noqa: E731
    up = lambda y: 14 + SIDE * (1 - y)  # noqa: E731
    text = lambda x, y, words, more="": (  # noqa: E731
        f'<text x="{x:.0f}" y="{y:.0f}" text-anchor="middle" style="{STYLE};font-size:11px"{more}>{words}</text>'
    )
    width, height = LEFT + SIDE + 20, SIDE + 62
    out = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" role="img">',
        "<title>Names by their confidence, and how many of them are true</title>",
        f'<rect width="{width}" height="{height}" fill="#ffffff"/>',
        f'<path d="M{at(0)},{up(1)} V{up(0)} H{at(1)}" fill="none" stroke="{INK}"/>',
        f'<path d="M{at(0)},{up(0)} L{at(1)},{up(1)}" stroke="{INK}" stroke-dasharray="4 4" stroke-width="0.8"/>',
        text(at(0.5), height - 6, "confidence of a name"),
        text(12, up(0.5), "share that is true", f' transform="rotate(-90 12 {up(0.5):.0f})"'),
    ]
    for x in (0.0, 0.5, 1.0):
        out += [text(at(x), up(0) + 30, f"{x:g}"), text(at(0) - 14, up(x) + 4, f"{x:g}")]
    for i, pair in enumerate(given.split(", ")):
        hits, count = map(int, pair.split("/"))
        out.append(text(at(i / 10 + 0.05), up(0) + 14, str(count), ' fill-opacity="0.6"'))
        if not count:
            continue
        low, high = share(hits, count, 0.9)
        middle = at(i / 10 + 0.05)
        out.append(
            f'<rect x="{middle - 11:.1f}" y="{up(hits / count):.1f}" width="22" height="{SIDE * hits / count:.1f}" '
            f'fill="{FILL}" stroke="{LINE}"/>'
            f'<path d="M{middle:.1f},{up(low):.1f} V{up(high):.1f}" stroke="{INK}" stroke-width="1.5"/>'
        )
    return "\n".join([*out, "</svg>"]) + "\n"


def measured(name: str) -> str:
    """Return the value of a figure of the results' concealed cases."""
    data = json.loads((ROOT / "docs" / "results" / "data" / "concealed.json").read_text(encoding="utf-8"))
    return next(f["value"] for m in data["measurements"] for f in m["figures"] if f["name"] == name)


def main(argv: Sequence[str]) -> int:
    """Write the diagrams; return the exit status."""
    out = Path(argv[0].removeprefix("out=")) if argv else ROOT / "docs" / "media"
    drawn = (("servo", servo()), ("task", task()), ("reality", reality()), ("assumptions", assumptions()),
             ("calibration", calibration(measured(BINS))))  # fmt: skip
    for name, text in drawn:
        (out / f"{name}.svg").write_text(text, encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
